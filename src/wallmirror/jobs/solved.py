"""A solution beside what is known of the truth, and whether it keeps what was asked of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet, Truth
from wallmirror.derendering.calibration import Calibration
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solution import Solution

Array = NDArray[np.float64]

# An error this many times the one asked for is none that more light would mend.
_HOPELESS = 1e6
# Share of the BRDF's peak to which a value counts as known.
_WELL = 0.05


@dataclass(frozen=True)
class Judgement:
    """Errors against a known truth, after the best global scale (or the best one of each group, where there are several).

    Parameters
    ----------
    source_error:
        Relative error of the pattern, to compare with the solution's predicted_error.
    brdf_error:
        Relative error of the BRDF over the angle sums known to 5 % of the peak; nan where the truth has no finite values,
        or the BRDF's parts have scales of their own.
    """

    source_error: float
    brdf_error: float


@dataclass(frozen=True)
class Solved:
    """A capture set with its solution and, where a truth is known, how far that is off."""

    captures: CaptureSet
    solution: Solution
    truth: Truth | None
    judgement: Judgement | None
    calibration: Calibration | None = None
    tolerance: float | None = None

    @property
    def shortfall(self) -> str:
        """Why the pattern is not known to the tolerance, with what would help; empty where it is, or none was asked for."""
        s, tolerance = self.solution, self.tolerance
        if tolerance is None:
            return ""
        if s.one_bounce is not None and s.one_bounce.bias > tolerance:
            return (
                f"light beyond one bounce is foretold to move the pattern by {100 * s.one_bounce.bias:.2g} %, more than the "
                f"{100 * tolerance:.3g} % asked for; no samples mend that, a darker card or room does"
            )
        if s.predicted_error > tolerance:
            ratio = s.predicted_error / tolerance
            more = f"about {ratio * ratio:.2g} times as many samples a pixel, or views, would do"
            return (
                f"the pattern is known to {100 * s.predicted_error:.2g} %, not to the {100 * tolerance:.3g} % asked for; "
                + (more if ratio < _HOPELESS else "no number of samples would do")
            )
        return ""

    def summary(self) -> dict[str, Any]:
        """The JSON document of the command."""
        document = self.solution.summary()
        if self.judgement is not None:
            document["truth"] = {
                "source_error": self.judgement.source_error,
                "brdf_error": None if math.isnan(self.judgement.brdf_error) else self.judgement.brdf_error,
            }
        if self.tolerance is not None:
            document["tolerance"] = {"asked": self.tolerance, "kept": not self.shortfall, "why": self.shortfall}
        if self.calibration is not None:
            document["calibration"] = {
                "status": self.calibration.status,
                "metres": dict(self.calibration.values),
                "metres_std": dict(self.calibration.std),
                "elements_x": list(self.calibration.card.elements_x),
                "y": self.calibration.card.y,
            }
        return document


def judge(solution: Solution, truth: Truth | None) -> Judgement | None:
    """Compare a solution with the truth of a rendered capture set; None where there is no truth, or a dark one."""
    if truth is None or truth.source.shape != solution.source.shape or not np.any(truth.source):
        return None
    rho = true_brdf(solution, truth)
    brdf_error = math.nan
    if rho is not None and solution.components == 1:
        seen = well_seen(solution)
        if np.any(rho[seen]):
            brdf_error = scale_free_error(solution.brdf[seen], rho[seen])
    return Judgement(scale_free_error(solution.source, truth.source, solution.groups), brdf_error)


def well_seen(solution: Solution) -> NDArray[np.bool_]:
    """Nodes of the BRDF that the captures determine to better than 5 % of its peak."""
    return np.asarray(solution.brdf_std < _WELL * np.max(solution.brdf))


def true_brdf(solution: Solution, truth: Truth | None) -> Array | None:
    """The true BRDF on the solution's nodes; None for a mirror or where nothing is known."""
    if truth is None or truth.brdf.size < 2:
        return None
    order = np.argsort(truth.angle_sum)
    return np.interp(solution.angle_sum, truth.angle_sum[order], truth.brdf[order])
