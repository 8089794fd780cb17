"""The closed form with its knots refined by its own certificate: the method for captures without noise."""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.estimate import Estimate, scale_free_error
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form

Array = NDArray[np.float64]

#: Knot spacings in degrees, tried in turn while finer ones still pay.
EXACT_STEPS = (1.0, 0.25, 0.125, 0.0625, 0.03125)
_DEGREE = 7
# At this mismatch rounding is all that is left: finer knots could only add to it.
_EXACT = 3e-23
_ROUNDING = 1e-15
# Knots whose own bound is above this have no say in how far the pattern moves.
_WORTH_A_LOOK = 0.1


def solve_exactly(problem: Problem, space: SignalSpace, steps: tuple[float, ...] = EXACT_STEPS) -> Estimate:
    """Refine the knots while that halves the error bound and rounding is not reached, then try a spacing in between.

    The error that is stated is the largest of three: the bound on r that mismatch and gap give, what rounding becomes
    by the condition of F, and how far the pattern moves on the next-best knots. Where no other knots have an answer
    worth the name, the bound on r is multiplied by the condition instead.
    """

    def at(step: float) -> tuple[SplineGrid, ClosedForm, list[sp.csr_array]]:
        grid, designs = problem.designs(step, degree=_DEGREE, tolerance=1e-9)
        return grid, closed_form(problem.weighted_data, problem.weighted(designs), space), designs

    grid, closed, designs = at(steps[0])
    others: list[ClosedForm] = []
    for step in steps[1:]:
        if closed.mismatch < _EXACT:
            break
        finer = at(step)
        # Not the mismatch alone: a grid finer than the pixels fits anything, and its gap says so.
        if finer[1].error > closed.error / 2:
            others.append(finer[1])
            halfway = at(2 * step)
            if halfway[1].error < closed.error / 2:
                others.append(closed)
                grid, closed, designs = halfway
            break
        others.append(closed)
        grid, closed, designs = finer
    condition = float(np.linalg.cond(closed.transport))
    error = max(closed.error, _ROUNDING * condition)
    rivals = [other for other in others if other.error < _WORTH_A_LOOK]
    if rivals:
        error = max(error, scale_free_error(closed.source, min(rivals, key=lambda other: other.error).source))
    elif others:
        error *= condition  # the worst that an error of r does to V
    warnings: tuple[str, ...] = ()
    if closed.mismatch > 1e-8:
        warnings = (
            f"the closed form misses the data by {math.sqrt(closed.mismatch):.1e}: there is noise or the geometry is "
            "off, and maximum likelihood would do better",
        )
    weights = problem.row_weights
    transport = np.stack([t @ closed.coefficients for t in designs], axis=1)
    np.divide(closed.transport, weights, out=transport, where=weights > 0)
    peak_at = grid.peak(closed.coefficients, closed.exposure)
    peak = float(grid.evaluate(closed.coefficients, peak_at))
    spread = np.full(closed.source.shape, error * float(np.sqrt(np.mean(closed.source**2))))
    return Estimate(
        method="closed_form",
        grid=grid,
        closed=closed,
        coefficients=closed.coefficients,
        source=closed.source,
        transport=transport,
        peak_at=peak_at,
        source_std=spread,
        shape_std=spread,
        brdf_std=lambda u: np.full(u.shape, error * peak),
        predicted_error=error,
        chi_squared=math.nan,
        warnings=warnings,
    )
