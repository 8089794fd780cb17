"""Budget: so many seconds of rendering, or photons of exposure, split between views, realisations and samples.

The Cramér-Rao bound foretells the error of every split (`foresee`), a few splits are run with noise of the variance that was
assumed, and of those some are rendered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF
from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.foresight import foresee
from wallmirror.derendering.solve import solve
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import scan_angles
from wallmirror.scene import Scene, load_scene
from wallmirror.tradeoff.clock import once
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]
Advance = Callable[[int, int], None]

FORETOLD, DRAWN, RENDERED = "foretold by the bound", "run with drawn noise", "rendered and solved"
#: Largest factor between foretold and measured error for the forecast to count as confirmed.
CONFIRMED = 1.5
#: The thesis's split.
THESIS = (20, 20)

#: Samples per pixel of one of the path tracer's passes.
PASS = 1024

_STEP_DEG = 0.5
_ENOUGH = 4  # draws of the noise for a verdict
_SCAN = math.radians(90)
# Share of the brightest pixel's standard deviation below which no pixel's is taken to be: `solve` does the same.
_DARKEST = 1e-2
_READ_NOISE = 2.0  # counts, of each pixel of each exposure


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


def budget(*, quick: bool = False, seed: int = 0, mitsuba: bool = True, progress: Advance | None = None) -> Panel:
    """Measure the panel; without `mitsuba` the costs of rendering are not measured and only photons are split."""
    scene = load_scene("flat_wall_lobes")
    scene = replace(scene, observer=replace(scene.observer, pixels=100 if quick else 200))
    views, realisations = ((3, 20), (4, 20)) if quick else ((2, 3, 5, 10, 20, 40), (4, 6, 10, 20, 40))
    source = scene.source.max() * np.random.default_rng((41, seed)).random((scene.card.elements, max(realisations)))
    world = _World(scene, source)
    runs: list[Run] = []
    conclusions: list[Statement] = []
    numbers: dict[str, Any] = {}
    omissions = [Omission("splits with fewer realisations than elements", "they need the search for few captures")]
    groups: list[tuple[str, _Noise, Callable[[int, int], float], bool]] = []
    for photons in (1e4,) if quick else (1e3, 1e5):
        groups.append((f"{photons:g} photons a pixel in all", _shot(photons, world), _exposure, False))
    if mitsuba:
        costs = measure_costs(world, spp=256, seed=seed)
        numbers["costs"] = vars(costs)
        for seconds in (1.0,) if quick else (2.0, 20.0):
            split = partial(_samples, seconds, costs)
            groups.append((f"{seconds:g} s of rendering", _sampled(costs, world), split, True))
    else:
        omissions.append(Omission("rendering", "left out on request"))
    for number, (group, noise, each, rendered) in enumerate(groups):
        splits = [Split(a, b, each(a, b)) for a in views for b in realisations]
        found = [_foretold(group, world, split, noise) for split in splits]
        runs += found
        chosen = _chosen(found)
        measured = [_drawn(group, world, run, noise, draw, seed) for run in chosen for draw in range(1 if quick else 4)]
        if rendered:
            measured += [_rendered(group, world, run, seed) for run in chosen[: 1 if quick else 3]]
        runs += measured
        conclusions += conclude(group, found, measured)
        if progress is not None:
            progress(number + 1, len(groups))
    return Panel(
        name="budget",
        title="Budget: how to split seconds or photons",
        question="How should a budget be split between views A, realisations B and samples to get the smallest error?",
        setting=(
            f"{scene.observer.pixels} pixels a view, the views spread evenly over a scan of 90°, 4 strips, four lobes of sigma "
            "1°. Error: of all B patterns together, relative, after the best global scale. Photons: shot noise and "
            f"{_READ_NOISE:g} counts of read noise a pixel and exposure. Rendering: independent samples of the variance that a "
            "pilot run measured, at its price a sample and a render. The error of a split is foretold by the Cramér-Rao bound "
            f"on knots every {_STEP_DEG:g}°, then measured by solving captures with drawn noise, and rendered ones."
        ),
        runs=tuple(runs),
        conclusions=tuple(conclusions),
        omissions=tuple(omissions),
        numbers=numbers,
    )


class _World:
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
_Noise = Callable[[Split], Array]


def _floored(variance: Array) -> Array:
    """Standard deviations, none below the share of the largest that solvers trust."""
    std = np.sqrt(variance)
    return np.asarray(np.maximum(std, _DARKEST * std.max()), dtype=np.float64)


def _shot(photons: float, world: _World) -> _Noise:
    """`photons`: counts that a pixel of mean brightness would collect in the whole budget."""
    mean = float(radiance(world.transport(20), world.source).mean())

    def noise(split: Split) -> Array:
        films = radiance(world.transport(split.views), world.source[:, : split.realisations])
        gain = photons * split.each / mean  # counts of a radiance of 1 in one exposure
        return _floored((films * gain + _READ_NOISE**2) / gain**2)

    return noise


def _exposure(views: int, realisations: int) -> float:
    return 1 / (views * realisations)


def _sampled(costs: Costs, world: _World) -> _Noise:
    def noise(split: Split) -> Array:
        source = world.source[:, : split.realisations]
        squares = world.transport(split.views) ** 2 @ source**2
        return _floored(costs.scatter * world.scene.card.elements * squares / max(1.0, split.each))

    return noise


def affordable(seconds: float, costs: Costs) -> int:
    """Samples per pixel of one render that so many seconds pay for, 0 if not one."""
    whole = costs.start + PASS * costs.sample
    passes = math.floor(seconds / whole)
    rest = seconds - passes * whole - costs.start
    return PASS * passes + max(0, math.floor(rest / costs.sample))


def _samples(seconds: float, costs: Costs, views: int, realisations: int) -> float:
    return float(affordable(seconds / (views * realisations), costs))


def measure_costs(world: _World, *, spp: int, seed: int = 0) -> Costs:
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


def _foretold(group: str, world: _World, split: Split, noise: _Noise) -> Run:
    knobs = {"views": split.views, "realisations": split.realisations, "each": split.each}
    if split.each < 1 and "rendering" in group:
        return Run(
            group=group,
            method=FORETOLD,
            knobs=knobs,
            seconds=math.nan,
            failure="the budget does not pay for one sample a pixel",
        )
    scene = world.seen_by(split.views)
    # The noise's mean square over the patterns: the bound knows it pixel by pixel, and is quicker by the number of patterns.
    std = np.sqrt(np.mean(noise(split) ** 2, axis=-1, keepdims=True))

    def forecast() -> float:
        source = world.source[:, : split.realisations]
        return foresee(scene.observer, scene.card, world.brdf, source, noise=std, step_deg=_STEP_DEG).source_error

    error, timing = once(forecast)
    failure = "" if math.isfinite(error) else "the captures would not determine the pattern"
    return Run(
        group=group,
        method=FORETOLD,
        knobs=knobs,
        seconds=timing.seconds,
        wall_seconds=timing.wall_seconds,
        error=error if not failure else math.nan,
        failure=failure,
    )


def _chosen(found: Sequence[Run]) -> list[Run]:
    """What is run: the best split, the best with other numbers of realisations, the thesis's, a middling one and the worst."""
    good = sorted((run for run in found if not run.failure), key=lambda r: r.error)
    if not good:
        return []
    best_of = {run.knobs["realisations"]: run for run in reversed(good)}
    thesis = [run for run in good if (run.knobs["views"], run.knobs["realisations"]) == THESIS]
    others = sorted(best_of.values(), key=lambda r: r.error)[:3]
    picked = [*others, *thesis, good[len(good) // 2], good[-1]]
    return list({id(run): run for run in picked}.values())


def _drawn(group: str, world: _World, foretold: Run, noise: _Noise, draw: int, seed: int) -> Run:
    split = Split(foretold.knobs["views"], foretold.knobs["realisations"], foretold.knobs["each"])
    std = noise(split)
    clean = radiance(world.transport(split.views), world.source[:, : split.realisations])
    rng = np.random.default_rng((43, seed, draw, split.views, split.realisations))
    scene = world.seen_by(split.views)
    captures = CaptureSet(
        observer=scene.observer,
        card=scene.card,
        radiance=clean + std * rng.standard_normal(clean.shape),
        variance=std**2,
    )
    return _solved(group, DRAWN, {**foretold.knobs, "draw": draw}, captures, world, foretold)


def _rendered(group: str, world: _World, foretold: Run, seed: int) -> Run:
    from wallmirror.pathtracing.filming import render_captures

    views, realisations = foretold.knobs["views"], foretold.knobs["realisations"]
    scene = replace(world.seen_by(views), source=world.source[:, :realisations])
    captures, timing = once(lambda: render_captures(scene, spp=int(foretold.knobs["each"]), seed=seed + 7, max_depth=2))
    return _solved(group, RENDERED, dict(foretold.knobs), captures, world, foretold, rendering=timing.seconds)


def _solved(
    group: str, method: str, knobs: dict[str, Any], captures: CaptureSet, world: _World, foretold: Run, **extra: float
) -> Run:
    failure = ""

    def attempt() -> Array | None:
        nonlocal failure
        try:
            return solve(captures, method="maximum_likelihood", nonnegative=False, step_deg=_STEP_DEG).source
        except UndeterminedError as refusal:
            failure = str(refusal)
            return None

    found, timing = once(attempt)
    truth = world.source[:, : captures.realisations]
    return Run(
        group=group,
        method=method,
        knobs=knobs,
        seconds=timing.seconds,
        wall_seconds=timing.wall_seconds,
        error=math.nan if found is None else scale_free_error(found, truth),
        failure=failure,
        extra={"foretold": foretold.error, **extra},
    )


def conclude(group: str, found: Sequence[Run], measured: Sequence[Run]) -> list[Statement]:
    """The best split and what others cost, and whether the forecast was confirmed."""
    good = sorted((run for run in found if not run.failure), key=lambda r: r.error)
    if not good:
        return [Statement(f"{group.capitalize()}: no split can be afforded.")]
    best, worst = good[0], good[-1]
    text = f"{group.capitalize()}: best is {_name(best)}, {100 * best.error:.2g} % off as foretold"
    thesis = next((run for run in good if (run.knobs["views"], run.knobs["realisations"]) == THESIS), None)
    if thesis is not None and thesis is not best:
        text += f"; the thesis's split, A {THESIS[0]} and B {THESIS[1]}, {thesis.error / best.error:.2f} times that"
    text += f"; worst is {_name(worst)}, {worst.error / best.error:.2g} times. "
    text += _along(good, "views", "realisations") + " " + _along(good, "realisations", "views")
    statements = [Statement(text)]
    solved = [run for run in measured if not run.failure]
    if solved:
        ratios = _ratios(solved)
        drawn = {
            name: [r for r in solved if r.method == DRAWN and _name(r) == name]
            for name, method in ratios
            if method == DRAWN
        }
        enough = min((len(rs) for rs in drawn.values()), default=0) >= _ENOUGH
        within = all(1 / CONFIRMED <= ratios[name, DRAWN] <= CONFIRMED for name in drawn)
        parts = [f"{name} {ratio:.2f} ({method})" for (name, method), ratio in ratios.items()]
        measured_best = min(drawn, key=lambda name: _rms([r.error for r in drawn[name]]), default="")
        foretold_best = min(drawn, key=lambda name: drawn[name][0].extra["foretold"], default="")
        ranked = (
            "the best of them is the one foretold"
            if measured_best == foretold_best
            else f"the best of them is {measured_best}"
        )
        asked = f"asked within {CONFIRMED:g}" if enough else f"fewer than {_ENOUGH} draws, so no verdict"
        statements.append(
            Statement(
                f"{group.capitalize()}, error measured over foretold: {'; '.join(parts)}; {ranked} ({asked}).",
                within if enough else None,
            )
        )
    refused = {_name(run): run for run in measured if run.failure}
    if refused:
        statements.append(
            Statement(
                f"{group.capitalize()}: the solver refuses {', '.join(refused)}, although the bound would allow it: "
                f"“{next(iter(refused.values())).failure}”. More realisations than elements are its safeguard."
            )
        )
    return statements


def _ratios(solved: Sequence[Run]) -> dict[tuple[str, str], float]:
    """Root mean square of measured over foretold error, by split and way of measuring."""
    groups: dict[tuple[str, str], list[float]] = {}
    for run in solved:
        groups.setdefault((_name(run), run.method), []).append(run.error / run.extra["foretold"])
    return {key: _rms(values) for key, values in groups.items()}


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def _along(good: Sequence[Run], knob: str, other: str) -> str:
    """How far the error moves along one knob at the best value of the other."""
    best = good[0]
    line = sorted((run for run in good if run.knobs[other] == best.knobs[other]), key=lambda r: r.knobs[knob])
    low, high = line[0], line[-1]
    spread = max(run.error for run in line) / best.error
    if spread < 1.1:
        return f"The number of {knob} hardly matters ({low.knobs[knob]} to {high.knobs[knob]}: {100 * (spread - 1):.0f} %)."
    return (
        f"From {low.knobs[knob]} to {high.knobs[knob]} {knob} the error goes from {low.error / best.error:.2f} to "
        f"{high.error / best.error:.2f} times the best."
    )


def _name(run: Run) -> str:
    return f"A {run.knobs['views']} B {run.knobs['realisations']}"
