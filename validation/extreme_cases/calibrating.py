"""Where the card stood, by `calibrate`: within five error bars of where it did; and `moved` by its definition."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from wallmirror.derendering.calibration import calibrate, moved

from .harness import Case, must_answer, must_refuse
from .inverse import NOISE
from .scenes import card, films, observer


def cases() -> Iterator[Case]:
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

        wrapped = check if good is None else must_answer(check) if good else must_refuse(check)
        return Case("calibrate", quantity, value, wrapped)

    for power in (-300, 300):
        for noise in (0.0, NOISE):
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
        yield each("variance of all", f"{level:g}", None, noise=NOISE, variance=level)
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
