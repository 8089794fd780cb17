"""The options of `solve` at their ends."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import wallmirror as wm

from .harness import Case, must_answer, must_refuse
from .inverse import judged, made_for


def cases() -> Iterator[Case]:
    def each(method: str, name: str, value: float, good: bool | None, **more: Any) -> Case:
        def check() -> tuple[float, float]:
            captures, source, options = made_for(method)
            return judged(wm.solve(captures, **{**options, **more, name: value}), source)

        wrapped = check if good is None else must_answer(check) if good else must_refuse(check)
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
