"""Every method of recovering a pattern: intensities, noise, lost pixels, small and large sizes, options at their ends.

The reference is the truth that made the films. A solution is right if its pattern lies within five of its own error bars
+ 1e-6, or if it says itself that it is doubtful; a forecast and a bound, if they follow the scaling laws of the information,
or agree with its inverse at 50 digits (`bounds`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.brdf import BRDF
from wallmirror.derendering.calibration import calibrate, moved
from wallmirror.derendering.general import solve_general
from wallmirror.derendering.unstructured import de_render_unstructured

from .harness import REFUSALS, Case
from .scenes import card, films, lobes, observer

Array = NDArray[np.float64]
Check = Callable[[], tuple[float, float]]

_NOISE = 1e-3
_PHOTONS = 1e4  # counts of the brightest pixel


def answered(check: Check) -> Check:
    """The check, with a refusal counted as a fault: where the answer is known to be within reach."""

    def strict() -> tuple[float, float]:
        try:
            return check()
        except REFUSALS as refusal:
            raise RuntimeError(f"refused what it can answer: {refusal}") from None

    return strict


def refused(check: Callable[[], object]) -> Check:
    """The check, with any answer counted as a fault: where there is none."""

    def strict() -> tuple[float, float]:
        raise RuntimeError(f"answered what has no answer: {check()}")

    return strict


def judged(found: wm.Solution, source: Array, *, sure: bool = False) -> tuple[float, float]:
    """Error of the pattern and what it may be; a doubtful one says so itself unless the verdict must be good."""
    for array in (found.source, found.brdf, found.brdf_std, found.transport, found.source_std, found.shape_std):
        if np.any(np.isnan(array)):
            return math.nan, 0.0
    if found.verdict != "good":
        if sure:
            raise RuntimeError(f"doubts what it knows: {found.warnings[0]}")
        return 0.0, 1.0
    error = wm.scale_free_error(found.source, source, found.groups if found.components > 1 else ())
    return error, 5 * found.predicted_error + 1e-6


# -- films that each method is made for -------------------------------------------------------------------------------


def counted(captures: wm.CaptureSet, photons: float = _PHOTONS) -> tuple[wm.CaptureSet, dict[str, Any]]:
    """Captures as photon counts of so many in the brightest pixel, in the captures' own unit, and the options that say so."""
    brightest = float(captures.radiance.max()) or 1.0
    mean = captures.radiance / brightest * photons
    drawn = np.random.default_rng(5).poisson(mean).astype(np.float64)
    return replace(captures, radiance=drawn / photons * brightest), {"counts_per_radiance": photons / brightest}


def made_for(method: str, **changes: Any) -> tuple[wm.CaptureSet, Array, dict[str, Any]]:
    """Films that a method can solve, their truth and the options that it needs."""
    scale = changes.pop("scale", 1.0)
    if method == "few_captures":
        changes = {"realisations": 2, **changes}
    captures, source = films(noise=_NOISE if method == "maximum_likelihood" else 0.0, **changes)
    options: dict[str, Any] = {"method": method}
    if method == "poisson":
        captures, counts = counted(captures)
        options["counts_per_radiance"] = counts["counts_per_radiance"] / (scale or 1.0)
    if method == "few_captures":
        options["support_deg"] = 60.0
    return replace(captures, radiance=captures.radiance * scale), source, options


METHODS = ("closed_form", "maximum_likelihood", "few_captures", "poisson")


def by_method(method: str, *, sure: bool = False, **changes: Any) -> Check:
    def check() -> tuple[float, float]:
        captures, source, options = made_for(method, **changes)
        return judged(wm.solve(captures, **options), source, sure=sure)

    return check


def method_cases() -> Iterator[Case]:
    for method in METHODS:
        entry = f"solve, {method}"
        for power in (-300, -150, 150, 300):
            yield Case(entry, "intensity", f"1e{power:+d}", answered(by_method(method, scale=10.0**power)))
        yield Case(entry, "intensity", "denormal (1e-310)", by_method(method, scale=1e-310))
        yield Case(entry, "intensity", "0", refused(by_method(method, scale=0.0)))
        for name in ("float32", "float16"):
            yield Case(entry, "precision of the films", name, by_method(method, dtype=name))
        for number in (1, 2):
            yield Case(entry, "pixels N", str(number), by_method(
                method, observer=observer(pixels=number, pixels_at="centres")))  # fmt: skip
        yield Case(entry, "views A", "1", by_method(method, observer=observer(view_angles=(0.0,), pixels=200)))
        yield Case(entry, "pixels N, views A", "1, 1", refused(by_method(
            method, observer=observer(view_angles=(0.0,), pixels=1))))  # fmt: skip
        for number in (1, 2, 10):
            strips = card(elements_x=tuple(np.linspace(-1, 1, number)), element_width=0.0, element_height=0.0)
            fewer = 1 + number // 3 if method == "few_captures" else number + 2
            yield Case(entry, "elements M", str(number), by_method(method, card=strips, realisations=fewer))
        for number in (1, 3, 100):
            yield Case(entry, "realisations B", str(number), by_method(method, realisations=number))
        for apart in (0.0, 1e-300, 1e-12):
            strips = card(elements_x=(-1.0, -1.0 + apart, 1.0), element_width=0.0, element_height=0.0)
            yield Case(entry, "elements apart", f"{apart:g} m", refused(by_method(method, card=strips)))
        for metres in (1e-6, 1e-2, 1e2, 1e8):
            strips = card(y=-metres, element_width=0.0, element_height=0.0)
            yield Case(entry, "card's distance", f"{metres:g} m", by_method(method, card=strips))
            eye = observer(position=(0.0, -metres), pixels=200)
            yield Case(entry, "observer's distance", f"{metres:g} m", by_method(method, observer=eye))
        for degrees in (1e-3, 0.3, 90.0):
            yield Case(entry, "lobe's width", f"{degrees:g}°", by_method(method, brdf=lobes(degrees)))


# -- noise, weights and lost pixels -----------------------------------------------------------------------------------


def lost_pixels(method: str, spoil: Callable[[Array, Array], None], *, stated: bool = True) -> Check:
    """Films with stated noise, of which `spoil` changes radiance and variance in place."""

    def check() -> tuple[float, float]:
        captures, source, options = made_for(method)
        level = (_NOISE * float(captures.radiance.max())) ** 2
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


def weight_cases() -> Iterator[Case]:
    for method in ("maximum_likelihood", "few_captures", "poisson"):
        entry = f"solve, {method}"
        for value in (0.0, 1e-320, 1e-300, 1e300, math.inf):
            yield Case(entry, "variance of one pixel", f"{value:g}", answered(lost_pixels(method, _pixel(None, value))))
        for value in (math.nan, -1.0):
            yield Case(entry, "variance of one pixel", f"{value:g}", refused(lost_pixels(method, _pixel(None, value))))
        yield Case(entry, "lost pixel holds", "1e300", answered(lost_pixels(method, _pixel(1e300, math.inf))))
        yield Case(entry, "lost pixel holds", "-1e300", answered(lost_pixels(method, _pixel(-1e300, math.inf))))
        yield Case(entry, "lost pixel holds", "NaN", refused(lost_pixels(method, _pixel(math.nan, math.inf))))
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
            captures, source = films(noise=_NOISE)
            variance = np.full(captures.radiance.shape, (_NOISE * float(captures.radiance.max()) * level) ** 2)
            other = replace(captures, radiance=captures.radiance * level, variance=variance)
            return judged(wm.solve(other, method="maximum_likelihood"), source, sure=True)

        yield Case(f"solve, {method}", "unit of films and variance", f"{unit:g}", answered(scaled))
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
            dirty = clean + _NOISE * float(clean.max()) * np.random.default_rng(2).standard_normal(clean.shape)
            return judged(wm.solve(replace(captures, radiance=dirty), method="maximum_likelihood"), source)

        yield Case(f"solve, {method}", "dark", dark, darkened)


# -- options ----------------------------------------------------------------------------------------------------------


def option_cases() -> Iterator[Case]:
    def each(method: str, name: str, value: float, good: bool | None, **more: Any) -> Case:
        def check() -> tuple[float, float]:
            captures, source, options = made_for(method)
            return judged(wm.solve(captures, **{**options, **more, name: value}), source)

        wrapped = check if good is None else answered(check) if good else refused(check)
        return Case(f"solve, {method}", name, f"{value:g}", wrapped)

    bad = (0.0, -1.0, math.nan, math.inf)
    for value in bad:
        yield each("maximum_likelihood", "tolerance", value, False)
        yield each("few_captures", "support_deg", value, False)
        yield each("poisson", "counts_per_radiance", value, False)
        yield each("maximum_likelihood", "source_level", value, False, scale="level")
        yield each("maximum_likelihood", "wall_albedo", value, False, scale="albedo")
        yield each("maximum_likelihood", "step_deg", value, False)
    for value in (-1.0, math.nan, math.inf, -math.inf):
        yield each("poisson", "background", value, False)
    for value in (1e-300, 1e-16, 0.999):
        yield each("maximum_likelihood", "tolerance", value, True)
    for value in (1e-300, 1e-6, 1.0, 180.0):
        yield each("few_captures", "support_deg", value, None)
    for value in (1e-300, 1e-6, 1.0, 1e12, 1e300):
        yield each("poisson", "counts_per_radiance", value, None)
    for value in (0.0, 1e-300, 1e6, 1e300):
        yield each("poisson", "background", value, None)
    for value in (1e-300, 1e300):
        yield each("maximum_likelihood", "source_level", value, True, scale="level")
        yield each("maximum_likelihood", "source_level", value, True)
    for value in (1e-300, 1e-6, 1.0):
        yield each("maximum_likelihood", "wall_albedo", value, True, scale="albedo")
    for value in (0.001, 0.01, 45.0):
        yield each("closed_form", "step_deg", value, None)
        yield each("maximum_likelihood", "step_deg", value, None)
        yield each("few_captures", "step_deg", value, None)
    for value in (2**63, 2**200):
        yield each("few_captures", "seed", value, True)
    yield each("few_captures", "seed", -1, False)


# -- the moving camera, the rough card, the thesis's alternation --------------------------------------------------------


class _Broadening(BRDF):
    """A lobe whose width follows theta_s - theta_o: no function of the angle sum."""

    def __call__(self, theta_s: Any, theta_o: Any) -> Array:
        u, d = np.asarray(theta_s) + np.asarray(theta_o), np.asarray(theta_s) - np.asarray(theta_o)
        width = math.radians(14) * (1 + 0.5 * np.sin(d) ** 2)
        return np.asarray((np.exp(-0.5 * (u / width) ** 2) + 0.2) * (1 + 0.3 * np.cos(2 * d)))


def positions(
    number: int = 5, *, scale: float = 1.0, noise: float = 0.0, elements: int = 2, realisations: int = 5, **changes: Any
) -> tuple[list[wm.CaptureSet], Array]:
    """Captures of one card from several positions of the camera."""
    strips = changes.pop("card", wm.Card(elements_x=tuple(np.linspace(-1.0, 1.0, elements)), y=-1.0))
    pixels = changes.pop("pixels", 40)
    source = np.random.default_rng(3).random((strips.elements, realisations))
    rng, sets = np.random.default_rng(4), []
    for c, x in enumerate(np.linspace(-3, 3, number) if number > 1 else [0.0]):
        eye = wm.Observer(
            position=(float(x), -3 - 1.5 * (c * 0.618 % 1)),
            fov=math.radians(60),
            view_angles=(0.26, 0.0, -0.26),
            pixels=pixels,
        )
        clean = wm.radiance(wm.transport_matrix(eye, strips, _Broadening(), weights="thesis"), source)
        dirty = clean + noise * float(clean.max()) * rng.standard_normal(clean.shape)
        sets.append(wm.CaptureSet(observer=eye, card=strips, transport="thesis", radiance=dirty * scale, **changes))
    return sets, source


def general_cases() -> Iterator[Case]:
    def each(quantity: str, value: str, good: bool | None, **changes: Any) -> Case:
        options = {name: changes.pop(name) for name in ("step_deg", "reciprocal") if name in changes}
        spoil = changes.pop("spoil", None)

        def check() -> tuple[float, float]:
            sets, source = positions(**changes)
            if spoil is not None:
                sets = spoil(sets)
            found = solve_general(sets, **options)
            if np.any(np.isnan(found.source)) or np.any(np.isnan(found.source_std)):
                return math.nan, 0.0
            if found.verdict != "good":
                return 0.0, 1.0
            return wm.scale_free_error(found.source, source), 5 * found.predicted_error + 1e-6

        wrapped = check if good is None else answered(check) if good else refused(check)
        return Case("solve_general", quantity, value, wrapped)

    for power in (-300, 300):
        yield each("intensity", f"1e{power:+d}", True, scale=10.0**power)
        yield each("intensity, noisy", f"1e{power:+d}", True, scale=10.0**power, noise=_NOISE)
    yield each("intensity", "denormal (1e-310)", None, scale=1e-310)
    yield each("intensity", "0", False, scale=0.0)
    for number in (0, 1):
        yield each("positions", str(number), False, number=number)
    for number in (1, 2):
        yield each("pixels N", str(number), None, pixels=number)
    for number in (1, 3):
        yield each("elements M", str(number), None, elements=number, noise=_NOISE)
    yield each("realisations B", "1", False, realisations=1)
    yield each("elements apart", "0 m", False, card=wm.Card(elements_x=(0.5, 0.5), y=-1.0))
    for metres in (1e-6, 1e8):
        yield each("card's distance", f"{metres:g} m", None, card=wm.Card(elements_x=(-1.0, 1.0), y=-metres))
    for step in (0.0, -1.0, math.nan, math.inf):
        yield each("step_deg", f"{step:g}", False, step_deg=step)
    yield each("step_deg", "45", None, step_deg=45.0)
    shape = (3, 40, 5)
    for level in (0.0, 1e-320, 1e300, math.inf):
        yield each("variance of all", f"{level:g}", None, noise=_NOISE, variance=np.full(shape, level))

    def lost(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [
            replace(c, variance=np.where(np.arange(40)[:, None] == 7, np.inf, np.full(c.radiance.shape, 1e-6)))
            for c in sets
        ]

    def no_film(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [replace(c, variance=np.where(np.arange(5) == 1, np.inf, np.full(c.radiance.shape, 1e-6))) for c in sets]

    yield each("weight 0", "one film from everywhere", None, noise=_NOISE, spoil=no_film)
    yield each(
        "weight 0", "one film from one position", None, noise=_NOISE, spoil=lambda s: [no_film(s)[0], *lost(s)[1:]]
    )
    yield each("weight 0", "one pixel of each film", True, noise=_NOISE, spoil=lost)

    def one_dark(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [replace(sets[0], radiance=np.zeros(sets[0].radiance.shape)), *sets[1:]]

    yield each("one position dark", "0", None, spoil=one_dark)
    yield each("positions", "the same one twice", False, number=1, spoil=lambda sets: [sets[0], sets[0]])


def calibration_cases() -> Iterator[Case]:
    def each(
        quantity: str,
        value: str,
        good: bool | None,
        *,
        by: tuple[float, float, float] = (0.02, 1.0, 1.0),
        **changes: Any,
    ) -> Case:
        options = {"parameters": ("x",), **{k: changes.pop(k) for k in ("search", "parameters") if k in changes}}
        variance = changes.pop("variance", None)

        def check() -> tuple[float, float]:
            captures, _ = films(**changes)
            if variance is not None:
                captures = replace(captures, variance=np.full(captures.radiance.shape, variance))
            found = calibrate(replace(captures, card=moved(captures.card, *by)), **options)
            std = found.position_std[:, 0]
            if np.any(np.isnan(found.position_std)):
                return math.nan, 0.0
            off = np.asarray(found.card.elements_x) - np.asarray(captures.card.elements_x)
            return float(np.max(np.abs(off))), 5 * float(np.max(std)) + 1e-9

        wrapped = check if good is None else answered(check) if good else refused(check)
        return Case("calibrate", quantity, value, wrapped)

    for power in (-300, 300):
        for noise in (0.0, _NOISE):
            yield each(
                "intensity" + (", noisy" if noise else ""), f"1e{power:+d}", True, scale=10.0**power, noise=noise
            )
    yield each("intensity", "0", False, scale=0.0)
    for search in (0.0, -1.0, math.nan, math.inf, 1.0):
        yield each("search", f"{search:g}", False, search=search)
    yield each("search", "1e-300", None, search=1e-300)
    yield each("search", "0.9", None, search=0.9)
    for parameters in ((), ("x", "x"), ("z",)):
        yield each("parameters", str(parameters), False, parameters=parameters)
    for number in (1, 2):
        strips = card(elements_x=tuple(np.linspace(-1, 1, number)), element_width=0.0, element_height=0.0)
        yield each("elements M", str(number), None if number > 1 else False, card=strips)
    yield each("elements apart", "0 m", False, card=card(elements_x=(0.5, 0.5), element_width=0.0, element_height=0.0))
    yield each("offset", "0 m", True, by=(0.0, 1.0, 1.0))
    yield each("offset", "1e3 m", False, by=(1e3, 1.0, 1.0))
    for level in (0.0, 1e-320, 1e300, math.inf):
        yield each("variance of all", f"{level:g}", None, noise=_NOISE, variance=level)
    yield each("pixels N", "1", None, observer=observer(pixels=1, pixels_at="centres"))
    points = card(element_width=0.0, element_height=0.0)
    for name, at in (("offset", 0), ("distance", 1), ("width", 2)):
        for value in (0.0, -1.0, 1e-300, 1e300, math.inf, math.nan):
            given = [0.0, 1.0, 1.0]
            given[at] = value

            def check(g: tuple[float, ...] = tuple(given)) -> tuple[float, float]:
                found, (offset, distance, width) = moved(points, *g), g
                x = np.asarray(points.elements_x)
                # The centre of the elements goes by the offset, the rest is stretched about it.
                expected = x.mean() + offset + width * (x - x.mean())
                if not (distance > 0 and width > 0):
                    raise RuntimeError(f"{found} from a factor of {min(distance, width):g}")
                off = np.max(np.abs(np.asarray(found.elements_x) - expected)) + abs(found.y - points.y * distance)
                return float(off), 1e-12 * float(np.max(np.abs(expected)))

            yield Case("moved", name, f"{value:g}", check)


def alternation_cases() -> Iterator[Case]:
    """The thesis's alternation has no error bars: right is what lies in its box and explains no less than nothing does."""

    def each(quantity: str, value: str, good: bool | None, **changes: Any) -> Case:
        names = ("alpha", "tolerance", "proportion", "cap", "rng", "start", "support")
        options = {"cap": 4, **{k: changes.pop(k) for k in names if k in changes}}

        def check() -> tuple[float, float]:
            captures, _ = films(**changes)
            found = de_render_unstructured(captures, **options)
            for array in (found.source, found.brdf, found.objective, found.misfit):
                if not np.all(np.isfinite(array)):
                    return math.nan, 0.0
            outside = max(float(np.max(np.abs(a - np.clip(a, 0, 1)))) for a in (found.source, found.brdf))
            missed = captures.radiance - found.brdf @ found.source
            power = float(np.linalg.norm(captures.radiance))
            stated = abs(float(np.linalg.norm(missed)) / power - found.residual)
            return max(outside, stated / max(1.0, found.residual)), 1e-9

        wrapped = check if good is None else answered(check) if good else refused(check)
        return Case("de_render_unstructured", quantity, value, wrapped)

    for power in (-300, -150, -6, 6, 150, 300):
        yield each("intensity", f"1e{power:+d}", None, scale=10.0**power)
    yield each("intensity", "0", False, scale=0.0)
    for name, values in (
        ("alpha", (-1.0, math.nan, math.inf)),
        ("tolerance", (-1.0, math.nan, math.inf)),
        ("proportion", (0.0, -1.0, 1.5, math.nan)),
        ("cap", (0, -1)),
    ):
        for value in values:
            yield each(name, f"{value:g}", False, **{name: value})
    for name, extremes in (("alpha", (0.0, 1e-300, 1e300)), ("tolerance", (0.0, 1e300)), ("proportion", (1e-300, 1.0))):
        for value in extremes:
            yield each(name, f"{value:g}", None, **{name: value})
    for number in (1, 2):
        yield each("pixels N", str(number), None, observer=observer(pixels=number), proportion=1.0)
        strips = card(elements_x=tuple(np.linspace(-1, 1, number)), element_width=0.0, element_height=0.0)
        yield each("elements M", str(number), None, card=strips)
        yield each("realisations B", str(number), None, realisations=number)
    yield each("views A", "1", None, observer=observer(view_angles=(0.0,), pixels=100))


def cases() -> Iterator[Case]:
    yield from method_cases()
    yield from weight_cases()
    yield from option_cases()
    yield from general_cases()
    yield from calibration_cases()
    yield from alternation_cases()
