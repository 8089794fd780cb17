"""The solvers under stated noise: variances at their ends, lost pixels whatever they hold, dark films."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import wallmirror as wm

from .harness import Case, must_answer, must_refuse
from .inverse import NOISE, Check, judged, made_for
from .scenes import films, lobes

Array = NDArray[np.float64]


def lost_pixels(method: str, spoil: Callable[[Array, Array], None], *, stated: bool = True) -> Check:
    """Films with stated noise, of which `spoil` changes radiance and variance in place."""

    def check() -> tuple[float, float]:
        captures, source, options = made_for(method)
        level = (NOISE * float(captures.radiance.max())) ** 2
        radiance, variance = captures.radiance.copy(), np.full(captures.radiance.shape, level)
        spoil(radiance, variance)
        spoilt = replace(captures, radiance=radiance, variance=variance, variance_is_floor=not stated)
        return judged(wm.solve(spoilt, **options), source)

    return check


def _pixel(radiance: float | None, variance: float | None) -> Callable[[Array, Array], None]:
    def spoil(films: Array, variances: Array) -> None:
        if radiance is not None:
            films[1, 100, 1] = radiance
        if variance is not None:
            variances[1, 100, 1] = variance

    return spoil


def _saturated(where: Callable[[Array], NDArray[np.bool_]]) -> Callable[[Array, Array], None]:
    def spoil(films: Array, variances: Array) -> None:
        lost = where(films)
        variances[lost] = np.inf
        films[lost] = 1e300

    return spoil


def _view_two(films: Array) -> NDArray[np.bool_]:
    mask = np.zeros(films.shape, dtype=bool)
    mask[2] = True
    return mask


def _film_one(films: Array) -> NDArray[np.bool_]:
    mask = np.zeros(films.shape, dtype=bool)
    mask[:, :, 1] = True
    return mask


def cases() -> Iterator[Case]:
    for method in ("maximum_likelihood", "few_captures", "poisson"):
        entry = f"solve, {method}"
        for value in (0.0, 1e-320, 1e-300, 1e300, math.inf):
            yield Case(
                entry, "variance of one pixel", f"{value:g}", must_answer(lost_pixels(method, _pixel(None, value)))
            )
        for value in (math.nan, -1.0):
            yield Case(
                entry, "variance of one pixel", f"{value:g}", must_refuse(lost_pixels(method, _pixel(None, value)))
            )
        yield Case(entry, "lost pixel holds", "1e300", must_answer(lost_pixels(method, _pixel(1e300, math.inf))))
        yield Case(entry, "lost pixel holds", "-1e300", must_answer(lost_pixels(method, _pixel(-1e300, math.inf))))
        yield Case(entry, "lost pixel holds", "NaN", must_refuse(lost_pixels(method, _pixel(math.nan, math.inf))))
        for share in (0.5, 0.99, 1.0):
            yield Case(entry, "saturated pixels", f"brightest {100 * share:g} %", lost_pixels(
                method, _saturated(lambda films, s=share: films >= np.quantile(films, 1 - s))))  # fmt: skip
        yield Case(entry, "saturated pixels", "one view", lost_pixels(method, _saturated(_view_two)))
        yield Case(entry, "saturated pixels", "one film", lost_pixels(method, _saturated(_film_one)))
    method = "maximum_likelihood"
    for value in (0.0, 1e-320, 1e-300, 1e300, math.inf):
        yield Case(f"solve, {method}", "variance of all", f"{value:g}", lost_pixels(
            method, lambda _, variances, v=value: variances.fill(v)))  # fmt: skip
        yield Case(f"solve, {method}", "variance of all, a floor", f"{value:g}", lost_pixels(
            method, lambda _, variances, v=value: variances.fill(v), stated=False))  # fmt: skip
    for noise in (1e-16, 1e-12, 1.0, 1e6):

        def noisy(n: float = noise) -> tuple[float, float]:
            captures, source = films(noise=n)
            return judged(wm.solve(captures, method="maximum_likelihood"), source)

        yield Case(f"solve, {method}", "noise over signal", f"{noise:g}", noisy)
    for unit in (1e-150, 1e150):  # the same films in another unit, with their variance

        def scaled(level: float = unit) -> tuple[float, float]:
            captures, source = films(noise=NOISE)
            variance = np.full(captures.radiance.shape, (NOISE * float(captures.radiance.max()) * level) ** 2)
            other = replace(captures, radiance=captures.radiance * level, variance=variance)
            return judged(wm.solve(other, method="maximum_likelihood"), source, sure=True)

        yield Case(f"solve, {method}", "unit of films and variance", f"{unit:g}", must_answer(scaled))
    for value in (0.0, 1e-300, 1e300):
        yield Case(f"solve, {method}", "variance of one film", f"{value:g}", lost_pixels(
            method, lambda _, variances, v=value: variances[:, :, 1].fill(v)))  # fmt: skip
    yield Case(f"solve, {method}", "lost pixel holds", "1e100, with its variance", lost_pixels(
        method, _pixel(1e100, 1e200)))  # fmt: skip
    for dark in ("a film", "a view", "an element"):

        def darkened(what: str = dark) -> tuple[float, float]:
            captures, source = films(noise=0.0)
            transport = wm.transport_matrix(captures.observer, captures.card, lobes(), weights="cosine")
            source = source.copy()
            if what == "a film":
                source[:, 2] = 0.0
            if what == "an element":
                source[1] = 0.0
            clean = wm.radiance(transport, source)
            if what == "a view":
                clean[0] = 0.0
            dirty = clean + NOISE * float(clean.max()) * np.random.default_rng(2).standard_normal(clean.shape)
            return judged(wm.solve(replace(captures, radiance=dirty), method="maximum_likelihood"), source)

        yield Case(f"solve, {method}", "dark", dark, darkened)
