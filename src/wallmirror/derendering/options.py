"""What `solve` may be told: the methods, its options, and which of them go together."""

from __future__ import annotations

import math
from typing import Literal, TypedDict, get_args

from wallmirror.derendering.facet_fit import WallModel
from wallmirror.derendering.gauge import Scale
from wallmirror.errors import InputError

Method = Literal["auto", "closed_form", "maximum_likelihood", "few_captures", "poisson"]


class SolveOptions(TypedDict, total=False):
    """The options of `solve`, for functions that hand them on."""

    method: Method
    wall: WallModel
    nonnegative: bool
    support_deg: float | None
    step_deg: float | None
    counts_per_radiance: float | None
    background: float
    scale: Scale
    wall_albedo: float | None
    source_level: float | None
    tolerance: float | None
    seed: int


def require_tolerance(tolerance: float | None) -> None:
    """Raise InputError unless this is a relative error, or none is asked for."""
    if tolerance is not None and not 0 < tolerance < 1:
        raise InputError(f"is {tolerance:g}; give a relative error between 0 and 1", field="tolerance")


def require_wall(wall: str, scale: str) -> None:
    """Raise InputError unless this is a model of the wall, and one whose scale is settled so."""
    if wall not in get_args(WallModel):
        raise InputError(f'is "{wall}"; choose one of {", ".join(get_args(WallModel))}', field="wall")
    if wall == "microfacet" and scale == "albedo":
        raise InputError("cannot be microfacet where an albedo settles the scale", field="wall")


def require_options(
    method: str,
    few: bool,
    support_deg: float | None,
    step_deg: float | None,
    counts_per_radiance: float | None,
    background: float,
    seed: int,
) -> None:
    """Raise InputError for an unknown method, and an option out of range or without a meaning for the method."""
    if method not in get_args(Method):
        raise InputError(f'is "{method}"; choose one of {", ".join(get_args(Method))}', field="method")
    if step_deg is not None and not 0.001 <= step_deg <= 45:
        raise InputError(f"is {step_deg:g}; give a knot spacing from 0.001 to 45 degrees", field="step_deg")
    if support_deg is not None and not few:
        raise InputError("is a prior for few captures, which these are not; leave it out", field="support_deg")
    if support_deg is not None and not 0 < support_deg <= 180:
        raise InputError(
            f"is {support_deg:g}; give the BRDF's largest angle sum, up to 180 degrees", field="support_deg"
        )
    if method == "poisson":
        if counts_per_radiance is None or not 0 < counts_per_radiance < math.inf:
            raise InputError(
                "the poisson method needs the counts that a radiance of 1 makes", field="counts_per_radiance"
            )
    elif counts_per_radiance is not None or background != 0:
        named = "background" if counts_per_radiance is None else "counts_per_radiance"
        raise InputError("has a meaning for the poisson method alone; leave it out", field=named)
    if not 0 <= background < math.inf:
        raise InputError(f"is {background:g}; give mean counts >= 0", field="background")
    if seed < 0:
        raise InputError(f"is {seed}; give an integer >= 0", field="seed")
