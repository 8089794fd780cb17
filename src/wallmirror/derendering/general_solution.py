"""What the general solver answers, and the sentences that go with an answer and with a refusal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.derendering.general_stack import Stack
from wallmirror.derendering.solution import Verdict
from wallmirror.derendering.tables import SplineTable

Array = NDArray[np.float64]

#: A predicted error of the pattern above this is no answer.
HOPELESS = 0.3


@dataclass(frozen=True, kw_only=True)
class GeneralSolution:
    """Pattern and table that a moving camera's captures determine.

    Parameters
    ----------
    brdf:
        The table, a BRDF like any other, largest seen value 1.
    source:
        V, shape (M, B), in the units of the radiance in that gauge.
    source_std:
        Its standard deviation, shape (M, B).
    rank, mismatch, gap:
        Certificates of the closed form: rank of the data, 1 - lambda_1 and 1 - lambda_2.
    predicted_error:
        Expected relative error of V after the best global scale.
    chi_squared:
        Misfit over the stated noise, 1 when the model holds; NaN where no noise was stated or the closed form answered.
    step_deg:
        Knot spacing in degrees.
    method:
        "closed_form" or "maximum_likelihood".
    warnings:
        One sentence for each reason to doubt.
    status:
        A sentence on what was found.
    """

    brdf: SplineTable
    source: Array = field(repr=False)
    source_std: Array = field(repr=False)
    rank: int
    mismatch: float
    gap: float
    predicted_error: float
    chi_squared: float
    step_deg: float
    method: str
    warnings: tuple[str, ...]
    status: str

    @property
    def verdict(self) -> Verdict:
        """ "good", or "doubtful" when a warning stands."""
        return "doubtful" if self.warnings else "good"

    def seen(self, theta_s: ArrayLike, theta_o: ArrayLike) -> NDArray[np.bool_]:
        """Where the captures determine the table; elsewhere its values come from the ridge."""
        return self.brdf.seen(theta_s, theta_o)


def too_few(stack: Stack, why: str) -> str:
    """The refusal of captures from which more than one table follows."""
    hint = "" if stack.reciprocal else ", impose reciprocity"
    return (
        f"{stack.places} positions leave several tables that explain the captures ({why}); capture from more "
        f"positions{hint}, or assume Hypothesis 8 (`solve`)"
    )


def status(stack: Stack, error: float, how: str, warnings: Sequence[str] = ()) -> str:
    """The sentence that goes with an answer, and the first reason to doubt it."""
    found = (
        f"Recovered {stack.elements} elements from {stack.places} positions {how}, without Hypothesis 8; expect the "
        f"pattern to be {100 * error:.2g} % off, up to one global scale."
    )
    return f"{found} But {warnings[0]}." if warnings else found
