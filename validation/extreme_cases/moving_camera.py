"""The solver without Hypothesis 8, whose films come from several positions of the camera."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.brdf import BRDF
from wallmirror.derendering.general import solve_general

from .harness import Case, must_answer, must_refuse
from .inverse import NOISE

Array = NDArray[np.float64]


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


def table_cases() -> Iterator[Case]:
    """A recovered table where it was not asked for: at its knots' ends beyond them, and NaN only of NaN."""

    def called(angle: float) -> tuple[float, float]:
        sets, _ = positions(noise=NOISE)
        table = solve_general(sets).brdf
        ends = table.grid.theta_s
        inside = min(max(angle, ends.start), ends.stop)
        if table.seen(angle, 0.1) != (inside == angle and bool(table.seen(inside, 0.1))):
            raise RuntimeError(f"says that it saw {angle:g}")
        found = float(table(angle, 0.1))
        if math.isnan(angle):
            return (0.0 if math.isnan(found) else 1.0), 0.5
        return abs(found - float(table(inside, 0.1))), 0.0

    for angle in (0.0, 1e-320, math.pi / 2, 1e300, -1e300, math.inf, math.nan):
        yield Case("SplineTable", "angle", f"{angle:g} rad", must_answer(lambda a=angle: called(a)))


def cases() -> Iterator[Case]:
    yield from table_cases()

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

        wrapped = check if good is None else must_answer(check) if good else must_refuse(check)
        return Case("solve_general", quantity, value, wrapped)

    for power in (-300, 300):
        yield each("intensity", f"1e{power:+d}", True, scale=10.0**power)
        yield each("intensity, noisy", f"1e{power:+d}", True, scale=10.0**power, noise=NOISE)
    yield each("intensity", "denormal (1e-310)", None, scale=1e-310)
    yield each("intensity", "0", False, scale=0.0)
    yield each("positions", "0", False, spoil=lambda _: [])
    yield each("positions", "1", False, number=1)
    for number in (1, 2):
        yield each("pixels N", str(number), None, pixels=number)
    for number in (1, 3):
        yield each("elements M", str(number), None, elements=number, noise=NOISE)
    yield each("realisations B", "1", False, realisations=1)
    yield each("elements apart", "0 m", False, card=wm.Card(elements_x=(0.5, 0.5), y=-1.0))
    for metres in (1e-6, 1e8):
        yield each("card's distance", f"{metres:g} m", None, card=wm.Card(elements_x=(-1.0, 1.0), y=-metres))
    for step in (0.0, -1.0, math.nan, math.inf):
        yield each("step_deg", f"{step:g}", False, step_deg=step)
    yield each("step_deg", "45", None, step_deg=45.0)
    shape = (3, 40, 5)
    for level in (0.0, 1e-320, 1e300, math.inf):
        yield each("variance of all", f"{level:g}", None, noise=NOISE, variance=np.full(shape, level))

    def stated(c: wm.CaptureSet, *, pixel: int | None = None, film: int | None = None) -> wm.CaptureSet:
        variance = np.full(c.radiance.shape, (NOISE * float(c.radiance.max())) ** 2)
        if pixel is not None:
            variance[:, pixel] = np.inf
        if film is not None:
            variance[:, :, film] = np.inf
        return replace(c, variance=variance)

    def no_film(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [stated(c, film=1) for c in sets]

    def once_no_film(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [stated(sets[0], film=1), *(stated(c) for c in sets[1:])]

    yield each("weight 0", "one film from everywhere", None, noise=NOISE, spoil=no_film)
    yield each("weight 0", "one film from one position", None, noise=NOISE, spoil=once_no_film)
    yield each("weight 0", "a pixel of each film", True, noise=NOISE, spoil=lambda s: [stated(c, pixel=7) for c in s])

    def one_dark(sets: list[wm.CaptureSet]) -> list[wm.CaptureSet]:
        return [replace(sets[0], radiance=np.zeros(sets[0].radiance.shape)), *sets[1:]]

    yield each("one position dark", "0", None, spoil=one_dark)
    yield each("positions", "the same one twice", False, number=1, spoil=lambda sets: [sets[0], sets[0]])
