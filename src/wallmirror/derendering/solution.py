"""What a de-rendering returns: the estimates, and everything that says how far to trust them."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.angle_sum_check import AngleSumCheck
from wallmirror.derendering.one_bounce import OneBounceCheck

Array = NDArray[np.float64]

Verdict = Literal["good", "doubtful"]


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A recovered pattern and BRDF with their doubts.

    Parameters
    ----------
    status:
        A sentence that says how far to trust the result and what to do next.
    verdict:
        "good", or "doubtful" when a warning stands.
    warnings:
        One sentence for each reason to doubt.
    method:
        "closed_form", "maximum_likelihood", "few_captures" or "poisson".
    gauge:
        What settles the global scale, in words.
    priors:
        What the answer rests on beside the captures, in words; empty where the captures alone decide.
    source, source_std:
        V and its standard deviations, shape (M, B), in the gauge that was chosen: by default the one where the
        well-seen part of the BRDF peaks at 1. They leave out what is not known of a scale that was given.
    shape_std:
        Standard deviation of V after the best global scale, which nobody can know, shape (M, B).
    angle_sum, brdf, brdf_std:
        rho on uniform nodes of u = theta_s + theta_o (radians), shape (L,); the standard deviation is inf where
        no capture saw that angle.
    transport:
        F, shape (A, N, M), in the same gauge.
    rank:
        Rank of the data that stands out of noise and rounding, out of M.
    mismatch, mismatch_expected:
        1 - lambda_1 of the closed form, and what the noise alone would make of it (nan where it is unknown).
    gap:
        1 - lambda_2: 0 means that a second BRDF explains the data as well.
    condition:
        Condition number of F.
    components:
        Number of parts with a scale of their own; 1 is the unavoidable global scale.
    groups:
        Elements (counted from 0) of each such part. With several, V, F and rho of each are in the scale in which its own
        well-seen part of the BRDF peaks at 1, errors hold up to one scale each, and `scale_free_error` takes the groups.
    predicted_error:
        Expected relative error of V after the best global scale, from the Cramer-Rao bound (or the closed form's own) and
        from what a wall of facets could do to V that the captures do not rule out.
    residual:
        |D - F V| / |D|.
    chi_squared:
        Residual in units of the noise variance per degree of freedom (nan where no variance is known).
    step_deg:
        Knot spacing of the BRDF's spline in degrees.
    one_bounce:
        What light beyond one bounce would do to this solution; None where nothing but the wall reflects.
    angle_sum_check:
        What a wall that is no function of the angle sum would do to this solution, and the factors that `brdf` is to be
        multiplied with where a wall of facets was fitted; None for a closed form of groups with a scale each.
    seconds:
        Time the solver took.
    history:
        What the solver did and why, a sentence for each stage.
    """

    status: str
    verdict: Verdict
    warnings: tuple[str, ...]
    method: str
    gauge: str
    priors: tuple[str, ...]
    source: Array = field(repr=False)
    source_std: Array = field(repr=False)
    shape_std: Array = field(repr=False)
    angle_sum: Array = field(repr=False)
    brdf: Array = field(repr=False)
    brdf_std: Array = field(repr=False)
    transport: Array = field(repr=False)
    rank: int
    mismatch: float
    mismatch_expected: float
    gap: float
    condition: float
    components: int
    groups: tuple[tuple[int, ...], ...]
    predicted_error: float
    residual: float
    chi_squared: float
    step_deg: float
    one_bounce: OneBounceCheck | None
    angle_sum_check: AngleSumCheck | None
    seconds: float
    history: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Everything but the large arrays, ready for JSON (infinities and nan become null)."""
        scalars = {
            name: getattr(self, name)
            for name in [
                "status",
                "verdict",
                "method",
                "rank",
                "mismatch",
                "mismatch_expected",
                "gap",
                "condition",
                "components",
                "predicted_error",
                "residual",
                "chi_squared",
                "step_deg",
                "seconds",
            ]
        }
        return {
            **{k: _finite(v) for k, v in scalars.items()},
            "warnings": list(self.warnings),
            "history": list(self.history),
            "one_bounce": None if self.one_bounce is None else asdict(self.one_bounce),
            "angle_sum_check": None if self.angle_sum_check is None else asdict(self.angle_sum_check),
            "gauge": self.gauge,
            "priors": list(self.priors),
            "groups": [list(group) for group in self.groups],
            "source": _finite(self.source.tolist()),
            "source_std": _finite(self.source_std.tolist()),
            "shape_std": _finite(self.shape_std.tolist()),
        }

    def to_json(self) -> str:
        """`summary` as a JSON document."""
        return json.dumps(self.summary(), indent=2, allow_nan=False)


def _finite(value: Any) -> Any:
    """Replace what JSON has no word for."""
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
