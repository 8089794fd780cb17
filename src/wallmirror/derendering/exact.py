"""The closed form with its knots refined by its own certificate: the method for captures without noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.components import Separated, in_words, separate
from wallmirror.derendering.estimate import Estimate, scale_free_error
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid, transport_of
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

#: Knot spacings in degrees: the search begins with the first, goes through the others in turn while finer ones pay, and if
#: none does, through coarser ones.
EXACT_STEPS = (0.125, 0.0625, 0.03125)
COARSER_STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)
_DEGREE = 7
# At this mismatch rounding is all that is left: finer knots could only add to it.
_EXACT = 3e-23
_ROUNDING = 1e-15
# A gap that leaves no doubt: knots that reach rounding with it need no others beside them.
_CLEAR = 1e-3
# Numbers in r per equation up to which a mismatch of rounding's size says something.
_TOLD = 0.9
# Knots whose own bound is above this have no say in how far the pattern moves.
_WORTH_A_LOOK = 0.1


@dataclass(frozen=True)
class _Try:
    grid: SplineGrid
    closed: ClosedForm
    designs: list[sp.csr_array]
    rows: int

    @property
    def error(self) -> float:
        """The closed form's bound on r; none where the equations (I - U U^T) T_i r = 0 are hardly more than the numbers in r.

        Such knots fit any films to rounding, noise and all.
        """
        elements = len(self.designs)
        told = int(np.count_nonzero(self.closed.exposure > 0)) < _TOLD * elements * (self.rows - elements)
        return self.closed.error if told else math.inf


def solve_exactly(problem: Problem, space: SignalSpace, *, step_deg: float | None = None) -> Estimate:
    """Change the knots while that halves the error bound and rounding is not reached.

    The error that is stated is the largest of three: the bound on r that mismatch and gap give, what rounding becomes
    by the condition of F, and how far the pattern moves on the next-best knots. Where no other knots have an answer
    worth the name, the bound on r is multiplied by the condition instead. Where several BRDFs explain the captures because
    groups of elements share no angle, the answer is each group's up to a scale of its own (`separate`).

    Raises
    ------
    UndeterminedError
        When several BRDFs of a wall of facets explain the captures, whose exponents hang on the scales that are open.
    """
    best, others = _search(problem, space, step_deg)
    grid, closed, designs = best.grid, best.closed, best.designs
    if problem.exponents and closed.near_solutions > 1:
        raise UndeterminedError(f"{closed.near_solutions} BRDFs of a wall of facets explain the captures equally well")
    if closed.near_solutions > 1:
        separated = separate(problem.captures, problem.weighted_data, problem.weighted(designs), grid, closed)
        if separated is not None:
            return _in_groups(problem, best, separated)
    condition = float(np.linalg.cond(closed.transport))
    error = max(best.error, _ROUNDING * condition)
    rivals = [other for other in others if other.error < _WORTH_A_LOOK]
    if rivals:
        error = max(error, scale_free_error(closed.source, min(rivals, key=lambda other: other.error).closed.source))
    elif others:
        error *= condition  # the worst that an error of r does to V
    warnings: tuple[str, ...] = ()
    if closed.mismatch > 1e-8:
        warnings = (
            f"the closed form misses the data by {math.sqrt(closed.mismatch):.1e}: there is noise or the geometry is "
            "off, and maximum likelihood would do better",
        )
    weights = problem.row_weights
    transport = transport_of(designs, closed.coefficients)
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
        designs=designs,
    )


def _in_groups(problem: Problem, best: _Try, found: Separated) -> Estimate:
    """An answer up to one scale a group, whose error is that of the family: what lies beyond it is the gap."""
    grid, closed, designs = best.grid, best.closed, best.designs
    condition = float(np.linalg.cond(found.transport))
    error = max(math.sqrt(closed.mismatch) / max(closed.beyond, 1e-300) * condition, _ROUNDING * condition)
    transport = transport_of(designs, found.coefficients)
    spread = np.full(found.source.shape, error * float(np.sqrt(np.mean(found.source**2))))
    return Estimate(
        method="closed_form",
        grid=grid,
        closed=closed,
        coefficients=found.coefficients,
        source=found.source,
        transport=transport,
        peak_at=grid.peak(found.coefficients, closed.exposure),
        source_std=spread,
        shape_std=spread,
        brdf_std=lambda u: np.full(u.shape, error),
        predicted_error=error,
        chi_squared=math.nan,
        warnings=(in_words(found.groups),),
        groups=found.groups,
    )


def _search(problem: Problem, space: SignalSpace, step_deg: float | None) -> tuple[_Try, list[_Try]]:
    """The best knots, and the others that were tried."""

    def at(step: float) -> _Try:
        grid, designs = problem.designs(step, degree=_DEGREE, tolerance=1e-9)
        rows = int(np.count_nonzero(np.any(problem.fit_weights > 0, axis=1)))
        return _Try(grid, closed_form(problem.weighted_data, problem.weighted(designs), space), designs, rows)

    if step_deg is not None:
        return at(step_deg), []
    first = best = at(EXACT_STEPS[0])
    others: list[_Try] = []
    for steps in (EXACT_STEPS[1:], COARSER_STEPS):
        if best is not first:
            break  # finer knots paid, so coarser ones cannot
        for step in steps:
            if best.closed.mismatch < _EXACT and best.closed.gap > _CLEAR and best.error < math.inf:
                return best, others
            if best.closed.mismatch < _EXACT and steps is not COARSER_STEPS:
                break  # these fit whatever there is
            # Not the mismatch alone: a grid finer than the pixels fits anything, and its gap says so.
            other = at(step)
            if not other.error < best.error / 2:
                others.append(other)
                if steps is COARSER_STEPS and best.error > _WORTH_A_LOOK:
                    continue  # all knots so far are finer than the pixels
                break
            others.append(best)
            best = other
    return best, others
