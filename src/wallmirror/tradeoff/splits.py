"""A budget split between views, realisations and samples: the scene, the noise of a split, and what rendering costs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF
from wallmirror.errors import InputError
from wallmirror.geometry import scan_angles
from wallmirror.scene import Scene
from wallmirror.tradeoff.clock import once
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

#: Samples per pixel of one of the path tracer's passes.
PASS = 1024
_SCAN = math.radians(90)
# Share of the brightest pixel's standard deviation below which no pixel's is taken to be: `solve` does the same.
_DARKEST = 1e-2
READ_NOISE = 2.0  # counts, of each pixel of each exposure


@dataclass(frozen=True)
class Split:
    """A way to spend a budget: A views and B realisations, and what is left for each capture."""

    views: int
    realisations: int
    each: float

    @property
    def name(self) -> str:
        """The two numbers."""
        return f"A {self.views}, B {self.realisations}"


@dataclass(frozen=True)
class Costs:
    """What a render costs, from a pilot, and how its samples scatter.

    Parameters
    ----------
    start, sample:
        Processor seconds of starting a pass of up to 1024 samples, and of one sample a pixel in it.
    scatter:
        Variance of one sample over M sum_i (F_i V_i)^2, what choosing one of M strips at random makes.
    doubt:
        Relative standard deviation of that ratio over the pixels that matter.
    """

    start: float
    sample: float
    scatter: float
    doubt: float

    def __post_init__(self) -> None:
        if not (0 <= self.start < math.inf and 0 < self.sample < math.inf):
            raise InputError(
                f"are {self.start:g} and {self.sample:g} s; give a start >= 0 and a sample > 0", field="costs"
            )


class World:
    """The scene with its patterns; F of so many views, made once each."""

    def __init__(self, scene: Scene, source: Array) -> None:
        self.scene = scene
        self.source = source
        self._transports: dict[int, Array] = {}

    def seen_by(self, views: int) -> Scene:
        observer = self.scene.observer
        angles = scan_angles(views, scan=_SCAN, fov=observer.fov)
        return replace(self.scene, observer=replace(observer, view_angles=angles))

    def transport(self, views: int) -> Array:
        if views not in self._transports:
            scene = self.seen_by(views)
            self._transports[views] = transport_matrix(scene.observer, scene.card, scene.wall.brdf, tolerance=1e-6)
        return self._transports[views]

    @property
    def brdf(self) -> AngleSumBRDF:
        brdf = self.scene.wall.brdf
        assert isinstance(brdf, AngleSumBRDF)
        return brdf


#: Standard deviation of the radiance, (A, N, B), of a split.
Noise = Callable[[Split], Array]


def _floored(variance: Array) -> Array:
    """Standard deviations, none below the share of the largest that solvers trust."""
    std = np.sqrt(variance)
    return np.asarray(np.maximum(std, _DARKEST * std.max()), dtype=np.float64)


def shot_noise(photons: float, world: World) -> Noise:
    """`photons`: counts that a pixel of mean brightness would collect in the whole budget."""
    mean = float(radiance(world.transport(20), world.source).mean())

    def noise(split: Split) -> Array:
        films = radiance(world.transport(split.views), world.source[:, : split.realisations])
        gain = photons * split.each / mean  # counts of a radiance of 1 in one exposure
        return _floored((films * gain + READ_NOISE**2) / gain**2)

    return noise


def exposure(views: int, realisations: int) -> float:
    """Share of the whole exposure that each capture gets."""
    return 1 / (views * realisations)


def sampling_noise(costs: Costs, world: World) -> Noise:
    """The noise of rendering with independent samples, at the pilot's scatter."""

    def noise(split: Split) -> Array:
        source = world.source[:, : split.realisations]
        squares = world.transport(split.views) ** 2 @ source**2
        return _floored(costs.scatter * world.scene.card.elements * squares / max(1.0, split.each))

    return noise


def affordable(seconds: float, costs: Costs) -> int:
    """Samples per pixel of one render that so many seconds pay for, 0 if not one; InputError where they are no number >= 0."""
    if not 0 <= seconds < math.inf:
        raise InputError(f"is {seconds:g}; give a number >= 0", field="seconds")
    whole = costs.start + PASS * costs.sample
    passes = math.floor(seconds / whole)
    rest = seconds - passes * whole - costs.start
    return PASS * passes + max(0, math.floor(rest / costs.sample))


def samples(seconds: float, costs: Costs, views: int, realisations: int) -> float:
    """Samples per pixel of each capture that so many seconds pay for."""
    return float(affordable(seconds / (views * realisations), costs))


def measure_costs(world: World, *, spp: int, seed: int = 0) -> Costs:
    """Pilot renders: what starting one and a sample in it cost, and the variance of a sample."""
    from wallmirror.pathtracing.rendering import Renderer, spread_seeds

    scene = world.seen_by(5)
    renderer = Renderer(scene)
    pattern = world.source[:, 0]
    seeds = spread_seeds(seed + 1, 5)
    renderer.render(0, pattern, spp=16, max_depth=2)
    renders = [renderer.render(view, pattern, spp=spp, seeds=(seeds[view],), max_depth=2) for view in range(5)]
    prices = []
    for samples in (16, PASS):
        times = [
            once(partial(renderer.render, 2, pattern, spp=samples, seeds=(s,), max_depth=2))[1].seconds for s in seeds
        ]
        prices.append(float(np.median(times)))
    sample = max((prices[1] - prices[0]) / (PASS - 16), 1e-12)
    measured = np.stack([np.asarray(r.moment_variance) * spp for r in renders])
    expected = scene.card.elements * (world.transport(5) ** 2 @ pattern**2)
    matter = expected > 0.01 * expected.max()
    ratios = measured[matter] / expected[matter]
    weights = expected[matter] / expected[matter].sum()
    scatter = float(weights @ ratios)
    return Costs(
        start=max(prices[0] - 16 * sample, 0.0),
        sample=sample,
        scatter=scatter,
        doubt=float(np.sqrt(weights @ (ratios - scatter) ** 2)) / scatter,
    )
