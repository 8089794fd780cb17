"""The thesis's alternation, which has no error bars: right is what lies in its box, with the residual that it states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from wallmirror.derendering.unstructured import de_render_unstructured

from .harness import Case, must_answer, must_refuse
from .scenes import card, films, observer


def cases() -> Iterator[Case]:
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

        wrapped = check if good is None else must_answer(check) if good else must_refuse(check)
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
