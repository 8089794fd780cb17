"""Blind de-rendering without Hypothesis 8: the BRDF as a table in both angles, from a camera that moves.

With rho(theta_s, theta_o) = sum_kl r_kl phi_k(theta_s) phi_l(theta_o), a tensor product of uniform B-splines, the
transport of each element is still linear in r, so that the closed form (`subspace`), the likelihood (`likelihood`) and
its bound (`bounds`) hold as they stand, with more coefficients. What changes is what the captures determine. From one
position each wall point is seen under one theta_o and lit under M different theta_s, so that no value of the table
serves two elements, and any invertible mixture of the patterns has a table of its own (the ambiguity of non-negative
matrix factorisation). From several positions the curves (theta_s, theta_o) of different elements cross, and each
crossing ties two elements together. Reciprocity, rho(theta_s, theta_o) = rho(theta_o, theta_s) (Helmholtz), mirrors the
curves at the diagonal and doubles their crossings.

Cells of the table that no curve passes are held by a ridge: a Gaussian prior of the size of the seen cells, whose
weight follows from the noise (Tikhonov and Arsenin, Solutions of Ill-Posed Problems, 1977).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.general_noisy import NOISY_STEPS, likeliest
from wallmirror.derendering.general_solution import HOPELESS, GeneralSolution, status, too_few
from wallmirror.derendering.general_stack import Stack, resolution
from wallmirror.derendering.splines import transport_of
from wallmirror.derendering.subspace import ClosedForm
from wallmirror.derendering.tables import SplineTable, TableGrid
from wallmirror.errors import InputError, UndeterminedError

__all__ = ["GeneralSolution", "SplineTable", "TableGrid", "solve_general"]

Array = NDArray[np.float64]

# Knot spacings in degrees, tried in turn while finer ones still pay, and the splines' degree.
_STEPS = (12.0, 8.0, 6.0, 4.0, 3.0)
_DEGREE = 7
# Noise power beyond the M patterns, over the power of the faintest pattern, below which there is none but rounding; and
# the mismatch that says so where nothing lies beyond them.
_NOISELESS = 1e-20
_EXACT = 1e-12
# Ridge of the proximal steps over the best-seen cell's information, a few times the rounding of that, and their number.
_PROXIMAL = 1e-15
_PROXIMAL_STEPS = 4
# Share of a value's variance before the captures that these must decide for it to count as determined.
_RESOLVED = 0.9999


def solve_general(
    captures: Sequence[CaptureSet],
    *,
    reciprocal: bool = False,
    step_deg: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> GeneralSolution:
    """Recover pattern and BRDF table together from captures of one card taken from several positions.

    Parameters
    ----------
    captures:
        One capture set for each position of the observer; card, transport weights and the B patterns are the same in all.
    reciprocal:
        Impose rho(theta_s, theta_o) = rho(theta_o, theta_s).
    step_deg:
        Knot spacing along both angles in degrees; chosen by the data when left out.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        When the sets do not belong together, or for a spacing out of range.
    UndeterminedError
        When the positions are too few, and for all that `solve` refuses.
    """
    _check(captures, step_deg)
    tell = progress or (lambda _: None)
    with threadpool_limits(limits=1, user_api="blas"):
        stack = Stack.of(captures, reciprocal)
        if not stack.problem.noise_is_stated:
            values = stack.space.singular_values / max(float(stack.space.singular_values[stack.elements - 1]), 1e-300)
            beyond = float(np.sum(values[stack.elements :] ** 2))
            if beyond < _NOISELESS:
                exact = _exact(stack, (step_deg,) if step_deg else _STEPS, tell)
                if values.size > stack.elements or exact.closed.mismatch < _EXACT:
                    return _exact_solution(stack, exact)
        return likeliest(stack, (step_deg,) if step_deg else NOISY_STEPS, tell)


def _check(captures: Sequence[CaptureSet], step_deg: float | None) -> None:
    if step_deg is not None and not 0.1 <= step_deg <= 45:
        raise InputError(f"is {step_deg:g}; give a knot spacing from 0.1 to 45 degrees", field="step_deg")
    if not captures:
        raise InputError("names no capture set; give one for each position of the observer", field="captures")
    first = captures[0]
    for other in captures[1:]:
        if other.card != first.card or other.transport != first.transport or other.realisations != first.realisations:
            raise InputError(
                "the sets differ in card, transport or number of realisations; capture the same card showing the same "
                "patterns from each position",
                field="captures",
            )
    if len({c.observer.position for c in captures}) < 2:
        raise UndeterminedError(
            "from one position no value of the BRDF's table serves two elements, so that any mixture of the patterns "
            "explains the captures; move the camera (turning it is not enough), or assume Hypothesis 8 (`solve`)"
        )


@dataclass(frozen=True)
class _Exact:
    """The closed form on the knots that were chosen, and the error that it may have."""

    grid: TableGrid
    designs: list[sp.csr_array]
    closed: ClosedForm
    error: float


def _exact(stack: Stack, steps: tuple[float, ...], tell: Callable[[str], None]) -> _Exact:
    """Refine the knots while that halves the error bound.

    Where the films have hardly more pixels than the table has cells, any knots fit them to rounding, and the bound knows of
    rounding alone: the error is no less than how far the pattern moves on the next-best knots.
    """
    best: _Exact | None = None
    others: list[ClosedForm] = []
    for step in steps:
        grid, designs = stack.designs(step, _DEGREE)
        closed = _polished(stack, designs, stack.closed(designs))
        tell(f"knots every {step:g} deg: mismatch {closed.mismatch:.2g}, gap {closed.gap:.2g}")
        if best is not None and closed.error > best.error / 2:
            others.append(closed)
            break
        if best is not None:
            others.append(best.closed)
        best = _Exact(grid, designs, closed, closed.error)
    assert best is not None
    if not others:
        return best
    moved = scale_free_error(best.closed.source, min(others, key=lambda other: other.error).source)
    return replace(best, error=max(best.error, moved))


def _polished(stack: Stack, designs: list[sp.csr_array], closed: ClosedForm) -> ClosedForm:
    """The closed form freed of the pull of its ridge, by proximal steps while they lower the mismatch.

    The ridge that the closed form needs pulls r towards 0 by 1e-13 over the curvature C = A - H^T H, which for a table
    seen from few positions is not much larger. r <- e (C + e)^-1 r only pulls towards the last r (Rockafellar, SIAM J.
    Control Optim. 14(5), 1976), and keeps what C leaves free.
    """
    u = stack.space.basis
    weighted = stack.problem.weighted(designs)
    curvature = sp.csr_array(sum(t.T @ t for t in weighted)).toarray()
    for t in weighted:
        projected = (t.T @ u).T
        curvature -= projected.T @ projected
    level = _PROXIMAL * float(np.sum(weighted[0].multiply(weighted[0]).sum(axis=0).max()))
    curvature[np.diag_indices_from(curvature)] += level
    try:
        factor = sl.cho_factor(curvature, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:  # rounding took more than the level gives: nothing to gain here
        return closed
    for _ in range(_PROXIMAL_STEPS):
        r = level * sl.cho_solve(factor, closed.coefficients, check_finite=False)
        columns = transport_of(weighted, r)
        norm = float(np.linalg.norm(columns))
        projected = u.T @ columns / norm
        mismatch = float(np.sum((columns / norm - u @ projected) ** 2))
        if not mismatch < 0.9 * closed.mismatch:
            break
        source = np.asarray(np.linalg.lstsq(projected, u.T @ stack.problem.weighted_data)[0], dtype=np.float64)
        closed = replace(closed, coefficients=r / norm, transport=u @ projected, source=source, mismatch=mismatch)
    return closed


def _exact_solution(stack: Stack, exact: _Exact) -> GeneralSolution:
    grid, designs, closed, error = exact.grid, exact.designs, exact.closed, exact.error
    if closed.near_solutions > 1 or error > HOPELESS:
        raise UndeterminedError(too_few(stack, f"gap {closed.gap:.1e}, mismatch {closed.mismatch:.1e}"))
    peak = float(stack.peak(grid, closed.coefficients) @ closed.coefficients)
    scale = stack.problem.scale * peak
    return GeneralSolution(
        brdf=SplineTable(
            grid=grid,
            coefficients=closed.coefficients / peak,
            determined=resolution(stack, grid, designs, closed.source, 0.0) > _RESOLVED,
        ),
        source=closed.source * scale,
        source_std=np.full(closed.source.shape, error * float(np.sqrt(np.mean(closed.source**2))) * scale),
        rank=stack.space.rank,
        mismatch=closed.mismatch,
        gap=closed.gap,
        predicted_error=error,
        chi_squared=math.nan,
        step_deg=math.degrees(grid.theta_s.step),
        method="closed_form",
        warnings=(),
        status=status(stack, error, "in closed form"),
    )
