"""Every method of `solve` by name: intensities, precision, small and large sizes, distances, lobes.

The reference is the truth that made the films. A solution is right if its pattern lies within five of its own error bars
+ 1e-6, or if it says itself that it is doubtful.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wallmirror as wm

from .harness import Case, must_answer, must_refuse
from .scenes import card, films, lobes, observer

Array = NDArray[np.float64]
Check = Callable[[], tuple[float, float]]

NOISE = 1e-3
_PHOTONS = 1e4  # counts of the brightest pixel


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
    captures, source = films(noise=NOISE if method == "maximum_likelihood" else 0.0, **changes)
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


def cases() -> Iterator[Case]:
    for method in METHODS:
        entry = f"solve, {method}"
        for power in (-300, -150, 150, 300):
            yield Case(entry, "intensity", f"1e{power:+d}", must_answer(by_method(method, scale=10.0**power)))
        yield Case(entry, "intensity", "denormal (1e-310)", by_method(method, scale=1e-310))
        yield Case(entry, "intensity", "0", must_refuse(by_method(method, scale=0.0)))
        for name in ("float32", "float16"):
            yield Case(entry, "precision of the films", name, by_method(method, dtype=name))
        for number in (1, 2):
            yield Case(entry, "pixels N", str(number), by_method(
                method, observer=observer(pixels=number, pixels_at="centres")))  # fmt: skip
        yield Case(entry, "views A", "1", by_method(method, observer=observer(view_angles=(0.0,), pixels=200)))
        yield Case(entry, "pixels N, views A", "1, 1", must_refuse(by_method(
            method, observer=observer(view_angles=(0.0,), pixels=1))))  # fmt: skip
        for number in (1, 2, 10):
            strips = card(elements_x=tuple(np.linspace(-1, 1, number)), element_width=0.0, element_height=0.0)
            fewer = 1 + number // 3 if method == "few_captures" else number + 2
            yield Case(entry, "elements M", str(number), by_method(method, card=strips, realisations=fewer))
        for number in (1, 3, 100):
            yield Case(entry, "realisations B", str(number), by_method(method, realisations=number))
        for apart in (0.0, 1e-300, 1e-12):
            strips = card(elements_x=(-1.0, -1.0 + apart, 1.0), element_width=0.0, element_height=0.0)
            yield Case(entry, "elements apart", f"{apart:g} m", must_refuse(by_method(method, card=strips)))
        for metres in (1e-6, 1e-2, 1e2, 1e8):
            strips = card(y=-metres, element_width=0.0, element_height=0.0)
            yield Case(entry, "card's distance", f"{metres:g} m", by_method(method, card=strips))
            eye = observer(position=(0.0, -metres), pixels=200)
            yield Case(entry, "observer's distance", f"{metres:g} m", by_method(method, observer=eye))
        for degrees in (1e-3, 0.3, 90.0):
            yield Case(entry, "lobe's width", f"{degrees:g}°", by_method(method, brdf=lobes(degrees)))
