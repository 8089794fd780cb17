"""Maximum likelihood by variable projection: the estimate that noise calls for, and its error bars.

The log-likelihood of D = F(r) V + noise is, up to a constant, -1/2 sum_pb w_pb (D - F V)^2 with w the inverse
variances. An iteration does not touch the pixels: what it needs of them are their moments N_ij = T_i^T W T_j and
X_ib = T_i^T W d_b (`moments`). With J_b = sum_i V_ib T_i, H_b = F^T W F, C_b = F^T W J_b the Gauss-Newton step
eliminates V (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973):

    S = sum_b J_b^T W J_b - C_b^T H_b^-1 C_b,
    S dr = sum_b J_b^T W e_b - C_b^T H_b^-1 F^T W e_b,      dv_b = H_b^-1 (F^T W e_b - C_b dr).

S is also the Fisher information of r with V eliminated (`information`); its null vector is r itself, the global scale.
Non-negativity turns each step into a convex quadratic programme, solved by block pivoting (`convex`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.convex import minimise_above, positive_factor
from wallmirror.derendering.information import Point, Pull, inverses, point_at, pull_at, schur_complement
from wallmirror.derendering.moments import Moments, moments
from wallmirror.errors import UndeterminedError

__all__ = ["ROUGH", "Fit", "Moments", "best_nonnegative", "bounded", "finished", "maximise", "moments"]

Array = NDArray[np.float64]

# Cells seen less than this relative to the best-seen one are weak: noise rules them in a start.
_WEAK = 1e-4
_RIDGE = 1e-12
# Share of the misfit by which a full step may still lower it, and where bounds make the last steps slow.
_TOLERANCE, _BOUNDED = 1e-7, 5e-7
#: The same between knots, where a fit need not be finer.
ROUGH = 1e-5
# What a full step may still gain of a datum's noise, however many data there are: it turns the pattern by no more than a third
# of an error bar, if all of it lies in one direction.
_GAIN = 0.1
# What holds coefficients back, of the information that would leave one as uncertain as the largest one is large: noise throws
# those that the captures hardly see about, and with them all others off the maximum.
_DAMPING = 0.1
# S is made anew where a step with that of the point before promises more than this share of what the last one did, or so
# little, as a share of what ends the climb, that the climb seems to be over.
_QUICK = 0.1
_SURE = 0.01
# How far a step within bounds may come from what it promised, as a share, for its S to say that the climb is over if it seems
# to be: without bounds an S made anew may show what coefficients that the captures hardly see would gain.
_KEPT = 0.05
# Condition of H beyond which S, that C^T H^-1 C is taken from, keeps too few of its digits for a step without bounds.
_LOST = 1e10


@dataclass(frozen=True)
class Fit:
    """A maximum of the likelihood.

    Parameters
    ----------
    coefficients:
        r, shape (K,).
    source:
        V, shape (M, B).
    objective:
        sum w (D - F V)^2 at the maximum.
    iterations:
        Newton steps taken.
    converged:
        Whether the last step was below the tolerance.
    schur:
        S at the maximum, over the seen coefficients, where it is at hand.
    """

    coefficients: Array
    source: Array
    objective: float
    iterations: int
    converged: bool
    schur: Array | None = None


@dataclass(frozen=True)
class _Curvature:
    """What a Gauss-Newton step takes from the point where it starts, or from one nearby.

    Parameters
    ----------
    free:
        Entries of V that may move, (B, M).
    inverse:
        H_b^-1, (B, M, M).
    schur:
        S over the seen coefficients.
    pinned:
        S with the gauge; None where nothing depends on r.
    factor:
        The Cholesky factor of that, as `positive_factor` makes it, where r has no bounds; damped where coefficients are held.
    """

    free: NDArray[np.bool_]
    inverse: Array
    schur: Array
    pinned: Array | None = None
    factor: Array | None = None


def maximise(
    data: Moments,
    *starts: Array,
    nonnegative: bool = True,
    tolerance: float = _TOLERANCE,
    held: bool = False,
    schur: Array | None = None,
    max_iterations: int = 60,
) -> Fit:
    """Climb to the maximum of the likelihood from the best of some starts (the closed form's r, a coarser fit).

    Parameters
    ----------
    starts:
        Each a start of r, shape (K,).
    nonnegative:
        Keep r >= 0 and V >= 0.
    tolerance:
        Stop when a full step promises to change the objective by less than this share.
    held:
        Hold coefficients that the captures hardly see near their start, without bounds: what they leave to gain is noise.
    schur:
        S at a single start, where it is known.

    Raises
    ------
    UndeterminedError
        When the information is singular to rounding: nothing determines r, or V for an r that the climb comes through.
    """
    seen = data.seen
    begins = (np.where(seen, _clipped(data, r) if nonnegative else r, 0.0) for r in starts)
    states = (point_at(data, r, nonnegative=nonnegative) for r in begins)
    state = min(states, key=lambda candidate: candidate.objective)
    rounding = 1e-14 * float(np.sum(data.energy))
    curvature: _Curvature | None = None
    slope, kept = 0.0, False
    for iteration in range(1, max_iterations + 1):
        enough = tolerance * state.objective + rounding
        pull = pull_at(data, state, nonnegative=nonnegative)
        # Near the maximum the curvature hardly changes: that of the point before does.
        before, quick = slope, False
        if curvature is not None and np.array_equal(pull.free, curvature.free):
            dr, slope = _step(data, state, pull, curvature)
            if kept and slope <= _SURE * tolerance * state.objective:
                return _fit(state, iteration, converged=True)
            quick = _SURE * enough < slope <= _QUICK * before
        if not quick:
            known = schur if iteration == 1 else None
            curvature = _curvature(data, state, pull.free, known, nonnegative=nonnegative, held=held)
            dr, slope = _step(data, state, pull, curvature)
            if slope <= enough:
                return _fit(state, iteration, converged=True, curvature=curvature)
        length = 1.0
        while True:
            trial = point_at(data, state.r + length * dr, nonnegative=nonnegative)
            if trial.objective <= state.objective - 1e-4 * length * slope:
                break
            length /= 2
            if length < 1e-10:
                return _fit(state, iteration, converged=slope <= 1e-6 * state.objective + 1e3 * rounding)
        gained = state.objective - trial.objective
        kept = nonnegative and length == 1 and abs(gained - slope) <= _KEPT * slope
        state = trial
    return _fit(state, max_iterations, converged=False)


def finished(data: Moments, fit: Fit) -> Fit:
    """The maximum without bounds as far as the captures see it, from a fit that came near it."""
    tolerance = min(ROUGH, _GAIN / max(1, data.observations))
    return maximise(data, fit.coefficients, nonnegative=False, tolerance=tolerance, held=True, schur=fit.schur)


def bounded(data: Moments, start: Array) -> Fit:
    """The maximum within the bounds, as near as error bars call for."""
    return maximise(data, start, tolerance=min(_BOUNDED, _GAIN / max(1, data.observations)))


def best_nonnegative(data: Moments, source: Array, halved: sp.csr_array | None = None) -> Array:
    """The r >= 0 of largest likelihood for a given pattern V >= 0 of shape (M, B): a convex problem, shape (K,).

    On knots twice as far apart, if their `SplineGrid.in_halved` is given.
    """
    v = np.maximum(source.T if source.sum() > 0 else -source.T, 0.0)
    gram, pull, seen = data.gram_of_source(v), np.einsum("bi,bik->k", v, data.cross), data.seen
    if halved is not None:
        gram, pull, seen = halved.T @ gram @ halved, halved.T @ pull, halved.T @ seen > 0
    cells = np.flatnonzero(seen)
    gram = gram[cells][:, cells]
    gram[np.diag_indices_from(gram)] += _RIDGE * float(np.trace(gram)) / max(1, cells.size)
    r = np.zeros(seen.size)
    r[cells] = minimise_above(np.zeros(cells.size), gram, pull[cells])
    return r


def _clipped(data: Moments, r: Array) -> Array:
    """The nearest non-negative start; cells seen weakly, where noise is all, are capped by the well-seen ones."""
    weak = data.exposure < _WEAK
    return np.clip(r, 0.0, np.where(weak, np.max(r[~weak], initial=0.0), np.inf))


def _fit(
    state: Point,
    iterations: int,
    *,
    converged: bool,
    curvature: _Curvature | None = None,
) -> Fit:
    # With entries of V at their bounds the curvature counts these as known, which the information does not.
    schur = curvature.schur if curvature is not None and np.all(curvature.free) else None
    return Fit(state.r, state.v.T.copy(), state.objective, iterations, converged, schur)


def _step(data: Moments, state: Point, pull: Pull, curvature: _Curvature) -> tuple[Array, float]:
    """The Gauss-Newton step in r with V eliminated, and the decrease of the objective that it promises."""
    cells = np.flatnonzero(data.seen)
    right = pull.without_v(data, state, curvature.inverse)[cells]
    dr = np.zeros_like(state.r)
    if curvature.factor is not None:
        dr[cells] = sl.cho_solve((curvature.factor, True), right, check_finite=False)
    elif curvature.pinned is not None:
        dr[cells] = minimise_above(-state.r[cells], curvature.pinned, right)
    return dr, float(pull.r @ dr)


def _curvature(
    data: Moments, state: Point, free: NDArray[np.bool_], schur: Array | None, *, nonnegative: bool, held: bool
) -> _Curvature:
    if not nonnegative and np.max(np.linalg.cond(state.normal)) > _LOST:
        raise UndeterminedError(
            "the captures do not tell the card's elements apart; capture more light, views or patterns"
        )
    cells = np.flatnonzero(data.seen)
    inverse = inverses(data, state, free)
    schur = schur_complement(data, state, free, inverse, cells) if schur is None else schur
    r = state.r[cells]
    level = np.trace(schur) / max(1, cells.size)
    if not level > 0:
        return _Curvature(free, inverse, schur)
    # The gauge r r^T keeps the step off the null direction of each scale; the ridge is for barely seen cells.
    null = r[None] if data.apart is None else np.where(data.apart[:, cells], r, 0.0)
    null = null / np.maximum(np.linalg.norm(null, axis=1, keepdims=True), 1e-150)
    pinned = schur + level * null.T @ null
    pinned[np.diag_indices_from(pinned)] += _RIDGE * level
    if nonnegative:
        return _Curvature(free, inverse, schur, pinned)
    largest = float(np.max(np.abs(state.r), where=data.exposure >= _WEAK, initial=0.0))
    if held and largest > 0:
        noise = max(0.0, state.objective) / max(1, data.observations)
        pinned[np.diag_indices_from(pinned)] += _DAMPING * noise / largest**2
    return _Curvature(free, inverse, schur, pinned, positive_factor(pinned))
