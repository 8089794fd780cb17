"""The solver: the pattern found against the truth that made the films.

A solution is right if its pattern lies within five of its own error bars + 1e-6, or if it says itself that it is doubtful.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import wallmirror as wm

from .harness import Case
from .scenes import card, films, lobes, observer


def solved(captures: wm.CaptureSet, source: np.ndarray, **options: Any) -> tuple[float, float]:
    """Error of the pattern and what it may be: five of its error bars + 1e-6, or all that a doubtful one admits."""
    found = wm.solve(captures, **options)
    for array in (found.source, found.brdf, found.transport, found.source_std):
        if np.any(np.isnan(array)):
            return math.nan, 0.0
    if found.verdict != "good":
        return 0.0, 1.0
    return wm.scale_free_error(found.source, source), 5 * found.predicted_error + 1e-6


def cases() -> Iterator[Case]:
    for power in (-300, -150, -10, 10, 150, 300):
        for noise in (0.0, 1e-3):

            def check(p: int = power, n: float = noise) -> tuple[float, float]:
                return solved(*films(scale=10.0**p, noise=n))

            yield Case("solve" + (", noisy" if noise else ""), "intensity", f"1e{power:+d}", check)
    yield Case("solve", "intensity", "denormal (1e-310)", lambda: solved(*films(scale=1e-310)))
    yield Case("solve", "intensity", "0", lambda: solved(*films(scale=0.0)))
    for name in ("float32", "float16"):
        yield Case("solve", "precision of the films", name, lambda d=name: solved(*films(dtype=d)))
    for number in (1, 2, 3, 200):
        yield Case("solve", "realisations B", str(number), lambda b=number: solved(*films(realisations=b)))
    for number in (1, 2, 6, 5000):
        yield Case("solve", "pixels N", str(number), lambda n=number: solved(
            *films(observer=observer(pixels=n, pixels_at="centres"))))  # fmt: skip
    for number in (1, 2, 12):
        yield Case("solve", "elements M", str(number), lambda m=number: solved(*films(
            card=card(elements_x=tuple(np.linspace(-1, 1, m)), element_width=0, element_height=0),
            realisations=m + 2)))  # fmt: skip
    for number in (1, 40):
        yield Case("solve", "views A", str(number), lambda a=number: solved(*films(
            observer=observer(view_angles=tuple(np.linspace(0.26, -0.26, a)) if a > 1 else (0.0,), pixels=200))))  # fmt: skip
    for apart in (0.0, 1e-12, 1e-3):
        yield Case("solve", "elements apart", f"{apart:g} m", lambda d=apart: solved(*films(
            card=card(elements_x=(-1.0, -1.0 + d, 1.0), element_width=0, element_height=0))))  # fmt: skip
    for metres in (1e-6, 1e-2, 1e2, 1e8):
        yield Case("solve", "card's distance", f"{metres:g} m", lambda m=metres: solved(*films(
            card=card(y=-m, element_width=0, element_height=0))))  # fmt: skip
        yield Case("solve", "observer's distance", f"{metres:g} m", lambda m=metres: solved(*films(
            observer=observer(position=(0.0, -m), pixels=200))))  # fmt: skip
    for degrees in (1e-3, 0.03, 0.3, 30.0, 90.0):
        yield Case("solve", "lobe's width", f"{degrees:g}°", lambda d=degrees: solved(*films(brdf=lobes(d))))
    for level in (0.0, 1e-320, 1e-300, 1e300, math.inf):

        def stated(v: float = level) -> tuple[float, float]:
            captures, source = films()
            return solved(replace(captures, variance=np.full(captures.radiance.shape, v)), source)

        yield Case("solve", "stated variance", f"{level:g}", stated)
    for level in (1.0, 1e3):
        yield Case("solve, noisy", "noise over signal", f"{level:g}", lambda n=level: solved(*films(noise=n)))

    def unseen(views: slice) -> tuple[float, float]:
        captures, source = films(noise=1e-3)
        variance = np.full(captures.radiance.shape, 1e-6 * float(captures.radiance.max()) ** 2)
        variance[views] = np.inf
        return solved(replace(captures, variance=variance), source)

    for name, views in (("of one view", slice(0, 1)), ("of all but one", slice(1, 3)), ("of all", slice(0, 3))):
        yield Case("solve, noisy", "weight 0", name, lambda v=views: unseen(v))
    for level in (0.0, 1e-300, 1e300, math.inf, math.nan, -1.0):

        def bound(v: float = level) -> tuple[float, float]:
            scene = card(element_width=0, element_height=0)
            found = wm.foresee(observer(), scene, lobes(), np.eye(3), noise=v, weights="cosine")
            return (math.nan if math.isnan(found.source_error) else 0.0), 1.0

        yield Case("foresee", "noise", f"{level:g}", bound)
