"""Small renders from which the cost of large ones is foretold: what shallow paths leave out, noise, and the gain's scatter."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, Mirror
from wallmirror.comparison import detectable_gain
from wallmirror.geometry import Card, Observer
from wallmirror.interreflection import from_card
from wallmirror.jobs.bouncing import DEEP, RR_DEPTH, spread
from wallmirror.jobs.expecting import Transport, expect
from wallmirror.jobs.validating_one import SEEDS, render_seeds
from wallmirror.pathtracing.filming import steadied
from wallmirror.pathtracing.rendering import Renderer, largest_pass, spread_seeds
from wallmirror.planning.sampling import MOST_SPP, NoiseLevel, Sampler, Sampling
from wallmirror.scene import Scene
from wallmirror.transport import Kernel, build_kernel, mirror_matrix

Array = NDArray[np.float64]

# Samples that one part of the pilot may take, and its seeds.
_SAMPLES = 2_000_000
_INDEPENDENT_SPP = 64
_INDEPENDENT_FILMS = 32
_STRATIFIED_SPP = (16, 64, 256, 1024)
_STRATIFIED_FILMS = 3
_STRATIFIED_SEEDS = 4
_DEPTH_PIXELS = 128
_DEPTH_SPP = 256
_DEPTH_SEEDS = 4
_OPEN_DEPTHS = (2, 4, 6, 10)  # in the open only odd numbers of bounces reach the camera
_ROOM_DEPTHS = (2, 3, 4, 6, 10)
_GAIN_SPP = (36, 144)
_GAIN_SEEDS = 8
_GAIN_VIEWS = 3


@dataclass(frozen=True)
class Truncation:
    """What paths of one depth leave out: relative L2 error of the films, and its upper 99 % limit."""

    depth: int
    error: float
    upper: float

    @property
    def is_seen(self) -> bool:
        """Whether the error stands out of the pilot's noise."""
        return self.upper <= 1.5 * self.error or self.upper == 0


@dataclass(frozen=True)
class LeftOut:
    """What paths of each depth leave out, shallowest first, and what is left with the card's computed glow added.

    Parameters
    ----------
    depths:
        From one bounce to DEEP, which stands for all and leaves out nothing.
    with_glow:
        One bounce and `from_card`; None where the card is black, in a room, or before a mirror.
    glow_seconds:
        What computing the glow takes for all films of the scene.
    """

    depths: tuple[Truncation, ...]
    with_glow: Truncation | None = None
    glow_seconds: float = 0.0


def left_out(scene: Scene, *, seed: int) -> LeftOut:
    """Measure each depth's error by differences with common random numbers, on at most 128 pixels."""
    if scene.is_one_bounce:
        return LeftOut((Truncation(2, 0.0, 0.0),))
    pixels = min(_DEPTH_PIXELS, scene.observer.pixels)
    views, patterns = spread(scene.observer.views, 2), spread(scene.source.shape[1], 2)
    angles = tuple(scene.observer.view_angles[v] for v in views)
    few = replace(scene, observer=replace(scene.observer, pixels=pixels, view_angles=angles))
    renderer = Renderer(few)
    depths = (*(_OPEN_DEPTHS if scene.room is None else _ROOM_DEPTHS), DEEP)
    roots = spread_seeds(seed, len(views) * len(patterns) * _DEPTH_SEEDS)
    light = np.empty((len(depths), _DEPTH_SEEDS, len(views), pixels, len(patterns)))
    for view in range(len(views)):
        for b, pattern in enumerate(patterns):
            first = (view * len(patterns) + b) * _DEPTH_SEEDS
            for d, depth in enumerate(depths):
                render = renderer.render(
                    view,
                    scene.source[:, pattern],
                    spp=_DEPTH_SPP,
                    seeds=roots[first : first + _DEPTH_SEEDS],
                    max_depth=depth,
                    rr_depth=RR_DEPTH,
                    sampler="multijitter",
                )
                light[d, :, view, :, b] = render.per_seed
    flat = light.reshape(len(depths), _DEPTH_SEEDS, -1)
    found = truncations_of(depths, flat)
    brdf = scene.wall.brdf
    if scene.room is not None or not isinstance(brdf, AngleSumBRDF):
        return LeftOut(found)
    started = time.perf_counter()
    glow = from_card(few.observer, scene.card, brdf, scene.source[:, list(patterns)])
    # Nearly all of it goes into the card's nodes, view by view, whatever the number of pixels.
    seconds = (time.perf_counter() - started) * scene.observer.views / len(views)
    rest = truncations_of((2, DEEP), np.stack([flat[0] + glow.ravel(), flat[-1]]))[0]
    return LeftOut(found, rest, seconds)


def truncations_of(depths: Sequence[int], light: Array) -> tuple[Truncation, ...]:
    """The errors from the light of each depth and seed, shape (D, S, P); the last depth stands for all bounces.

    The square of a norm is taken between different seeds, so that noise adds nothing to it.
    """
    whole = _cross_square(light[-1])[0]
    found = []
    for depth, film in zip(depths[:-1], light[:-1], strict=True):
        square, error = _cross_square(light[-1] - film)
        upper = math.sqrt(max(0.0, square + 2.6 * error) / whole)
        found.append(Truncation(depth, math.sqrt(max(0.0, square) / whole), upper))
    return (*found, Truncation(depths[-1], 0.0, 0.0))


def _cross_square(films: Array) -> tuple[float, float]:
    """|E film|^2 without the noise's own square, from seeds (S, P), and its standard error by the jackknife."""
    seeds = films.shape[0]
    gram = films @ films.T
    off = gram.sum() - np.trace(gram)
    value = off / (seeds * (seeds - 1))
    without = (off - 2 * (gram.sum(axis=1) - np.diag(gram))) / ((seeds - 1) * (seeds - 2))
    error = math.sqrt((seeds - 1) / seeds * float(np.sum((without - without.mean()) ** 2)))
    return float(value), error


@dataclass(frozen=True)
class NoisePilot:
    """Noise of small renders of one scene at one depth.

    Parameters
    ----------
    levels:
        For `cheapest_sampling`.
    views, patterns:
        The films behind `std`.
    std:
        Standard deviation of the radiance for one independent sample per pixel, shape (A', N, B').
    stratified_views:
        Positions in `views` of those that were rendered with stratified samples as well, A'' of them.
    ratios:
        For each stratified level, standard deviation of one seed over that of one independent sample, (A'', N).
    """

    levels: tuple[NoiseLevel, ...]
    views: tuple[int, ...]
    patterns: tuple[int, ...]
    std: Array = field(repr=False)
    stratified_views: tuple[int, ...]
    ratios: dict[int, Array] = field(repr=False)

    def film_std(self, sampling: Sampling) -> tuple[tuple[int, ...], Array]:
        """Standard deviation of the radiance in some views with a sampling: the views, and (A', N, B').

        Stratified samples make pixels quiet where the light is smooth, which the recovered pattern profits from.
        """
        if sampling.sampler == "independent":
            return self.views, self.std / math.sqrt(sampling.total)
        some = list(self.stratified_views)
        quiet = self.ratios[sampling.spp][:, :, None] * self.std[some]
        return tuple(self.views[k] for k in some), quiet / math.sqrt(sampling.seeds)


@dataclass(frozen=True)
class _Film:
    """One film of a pilot: noise-free square of its radiance, variance of one seed, each (N,), and seconds of a seed."""

    square: Array
    variance: Array
    seconds: float


class _Camera:
    """Renders films of one scene at one depth, each with seeds of its own."""

    def __init__(self, scene: Scene, renderer: Renderer, *, max_depth: int, rr_depth: int, seed: int) -> None:
        self._scene, self._renderer, self._depths = scene, renderer, (max_depth, rr_depth)
        self._first, self._used = spread_seeds(seed, 1)[0], 0

    def film(self, view: int, pattern: int, sampler: Sampler, spp: int, seeds: int) -> _Film:
        mine = [(self._first + self._used + k) % 2**32 for k in range(seeds)]
        self._used += seeds
        started = time.perf_counter()
        made = self._renderer.render(
            view,
            self._scene.source[:, pattern],
            spp=spp,
            seeds=mine,
            max_depth=self._depths[0],
            rr_depth=self._depths[1],
            sampler=sampler,
        )
        seconds = (time.perf_counter() - started) / seeds
        return _Film(made.mean**2 - made.variance, made.variance * seeds, seconds)


def pilot_noise(scene: Scene, renderer: Renderer, *, max_depth: int, rr_depth: int, seed: int) -> NoisePilot:
    """Render a few films with few samples, independent and stratified."""
    pixels, realisations = scene.observer.pixels, scene.source.shape[1]
    most = min(MOST_SPP, largest_pass(pixels))
    spp = min(_INDEPENDENT_SPP, most)
    films = max(1, min(_INDEPENDENT_FILMS, _SAMPLES // (spp * pixels)))
    patterns = spread(realisations, max(1, min(realisations, films, 2 * scene.card.elements)))
    views = spread(scene.observer.views, max(1, min(scene.observer.views, films // len(patterns))))
    camera = _Camera(scene, renderer, max_depth=max_depth, rr_depth=rr_depth, seed=seed)
    camera.film(views[0], patterns[0], "independent", spp, 1)  # compiles
    made = [[camera.film(view, pattern, "independent", spp, 1) for pattern in patterns] for view in views]
    level = _level("independent", spp, [film for line in made for film in line])
    longer = camera.film(views[0], patterns[0], "independent", most, 1).seconds
    levels = [level]
    if most > spp:
        levels.append(replace(level, spp=most, noise=level.noise * math.sqrt(spp / most), seconds=longer))
    std = np.sqrt(spp * np.array([[film.variance for film in line] for line in made]).transpose(0, 2, 1))
    positions = spread(len(views), _STRATIFIED_FILMS)
    chosen = [(k, n % len(patterns)) for n, k in enumerate(positions)]
    camera.film(views[0], patterns[0], "multijitter", _STRATIFIED_SPP[0], 2)
    ratios = {}
    for stratified in _STRATIFIED_SPP:
        seeds = min(_STRATIFIED_SEEDS, _SAMPLES // (len(chosen) * stratified * pixels))
        if stratified > most or seeds < 2:
            break
        several = [camera.film(views[a], patterns[b], "multijitter", stratified, seeds) for a, b in chosen]
        levels.append(_level("multijitter", stratified, several))
        ratios[stratified] = np.array(
            [
                np.sqrt(steadied(film.variance, seeds)) / np.maximum(std[a, :, b], 1e-3 * std[a, :, b].max())
                for film, (a, b) in zip(several, chosen, strict=True)
            ]
        )
    return NoisePilot(tuple(levels), views, patterns, std, positions, ratios)


def _level(sampler: Sampler, spp: int, films: Sequence[_Film]) -> NoiseLevel:
    variance, square = (sum(float(getattr(film, name).sum()) for film in films) for name in ("variance", "square"))
    return NoiseLevel(
        sampler=sampler,
        spp=spp,
        noise=math.sqrt(variance / max(square, 1e-300)),
        seconds=float(np.median([film.seconds for film in films])),
    )


@dataclass(frozen=True)
class GainLevel:
    """Smallest gain error that `validate` would reject with one view and its 32 seeds of `spp` samples, and the cost."""

    spp: int
    detectable: float
    seconds: float


def pilot_gain(scene: Scene, *, seed: int) -> tuple[GainLevel, ...]:
    """Foretell what `validate` can see from a few seeds of a few views, the fewest samples first."""
    found: list[GainLevel] = []
    render_seeds(scene, views=1, spp=_GAIN_SPP[0], seed=seed, count=2)  # compiles
    for spp in _GAIN_SPP:
        if found and spp * _GAIN_SEEDS * _GAIN_VIEWS * scene.observer.pixels > _SAMPLES:
            break
        started = time.perf_counter()
        sample = render_seeds(scene, views=_GAIN_VIEWS, spp=spp, seed=seed, count=_GAIN_SEEDS)
        seconds = (time.perf_counter() - started) / (len(sample.views) * _GAIN_SEEDS)
        if not found:
            expectation = expect(scene, sample.views, transport=_rough_transport())
        detectable = detectable_gain(
            sample.seeds,
            expectation.reference,
            planned=SEEDS,
            templates=len(expectation.templates),
            edges=expectation.edges,
        )
        found.append(GainLevel(spp, detectable * math.sqrt(len(sample.views)), SEEDS * seconds))
    return tuple(found)


def _rough_transport() -> Transport:
    """F to 1e-4 of a lobe's peak, far below the noise of a pilot's seed, with one kernel for all BRDFs of a scale."""
    kernels: dict[float, Kernel] = {}

    def transport(observer: Observer, card: Card, brdf: BRDF) -> Array:
        if isinstance(brdf, Mirror):
            return mirror_matrix(observer, card, brdf)
        scale = brdf.angular_scale
        if scale not in kernels:
            kernels[scale] = build_kernel(observer, card, resolution=scale, tolerance=1e-4)
        return kernels[scale].apply(brdf)

    return transport
