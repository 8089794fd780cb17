"""Maximum likelihood by variable projection: the estimate that noise calls for, and its error bars.

The log-likelihood of D = F(r) V + noise is, up to a constant, -1/2 sum_pb w_pb (D - F V)^2 with w the inverse
variances. An iteration does not touch the pixels: what it needs of them are their moments N_ij = T_i^T W T_j and
X_ib = T_i^T W d_b (`moments`). With J_b = sum_i V_ib T_i, H_b = F^T W F, C_b = F^T W J_b the Gauss-Newton step
eliminates V (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973):

    S = sum_b J_b^T W J_b - C_b^T H_b^-1 C_b,
    S dr = sum_b J_b^T W e_b - C_b^T H_b^-1 F^T W e_b,      dv_b = H_b^-1 (F^T W e_b - C_b dr).

S is also the Fisher information of r with V eliminated; its null vector is r itself, the global scale.
Non-negativity turns each step into a convex quadratic programme, solved by block pivoting (`convex`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.convex import minimise_above, solve_positive
from wallmirror.derendering.moments import Moments, moments

__all__ = ["Fit", "Information", "Moments", "best_nonnegative", "information", "maximise", "moments"]

Array = NDArray[np.float64]

# Cells seen less than this relative to the best-seen one are weak: noise rules them in a start.
_WEAK = 1e-4
_RIDGE = 1e-12


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
    """

    coefficients: Array
    source: Array
    objective: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Information:
    """Fisher information at a point of the likelihood, in units of the weights.

    Parameters
    ----------
    schur:
        S over the K' seen coefficients, (K', K').
    inverse, coupled:
        H_b^-1 (B, M, M) and H_b^-1 C_b (B, M, K').
    seen:
        Which of the K coefficients those are, shape (K,).
    """

    schur: Array
    inverse: Array
    coupled: Array
    seen: NDArray[np.bool_]


@dataclass(frozen=True)
class _State:
    r: Array
    v: Array  # (B, M)
    normal: Array  # H, (G, M, M)
    pair: Array  # N_ij r, (G, M, M, K)
    objective: float


def maximise(
    data: Moments,
    *starts: Array,
    nonnegative: bool = True,
    tolerance: float = 1e-7,
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
    """
    seen = data.seen
    begins = (np.where(seen, _clipped(data, r) if nonnegative else r, 0.0) for r in starts)
    states = (_evaluate(data, r, None, nonnegative=nonnegative) for r in begins)
    state = min(states, key=lambda candidate: candidate.objective)
    rounding = 1e-14 * float(np.sum(data.energy))
    for iteration in range(1, max_iterations + 1):
        dr, slope = _step(data, state, seen, nonnegative=nonnegative)
        if slope <= tolerance * state.objective + rounding:
            return _fit(state, iteration, converged=True)
        length = 1.0
        while True:
            trial = _evaluate(data, state.r + length * dr, None, nonnegative=nonnegative)
            if trial.objective <= state.objective - 1e-4 * length * slope:
                break
            length /= 2
            if length < 1e-10:
                return _fit(state, iteration, converged=slope <= 1e-6 * state.objective + 1e3 * rounding)
        state = trial
    return _fit(state, max_iterations, converged=False)


def information(data: Moments, coefficients: Array, source: Array) -> Information:
    """The Fisher information at r (K,) and V (M, B)."""
    seen = data.seen
    state = _evaluate(data, coefficients, source.T, nonnegative=True)
    gram, inverse, coupled = _schur(data, state, np.ones_like(state.v, dtype=bool), np.flatnonzero(seen))
    return Information(gram, inverse, coupled, seen)


def best_nonnegative(data: Moments, source: Array) -> Array:
    """The r >= 0 of largest likelihood for a given pattern V >= 0 of shape (M, B): a convex problem, shape (K,)."""
    v = np.maximum(source.T if source.sum() > 0 else -source.T, 0.0)
    cells = np.flatnonzero(data.seen)
    gram = data.gram_of_source(v)[np.ix_(cells, cells)]
    gram[np.diag_indices_from(gram)] += _RIDGE * float(np.trace(gram)) / max(1, cells.size)
    r = np.zeros(data.size)
    r[cells] = minimise_above(np.zeros(cells.size), gram, np.einsum("bi,bik->k", v, data.cross)[cells])
    return r


def _clipped(data: Moments, r: Array) -> Array:
    """The nearest non-negative start; cells seen weakly, where noise is all, are capped by the well-seen ones."""
    weak = data.exposure < _WEAK
    return np.clip(r, 0.0, np.where(weak, np.max(r[~weak], initial=0.0), np.inf))


def _fit(state: _State, iterations: int, *, converged: bool) -> Fit:
    return Fit(state.r, state.v.T.copy(), state.objective, iterations, converged)


def _evaluate(data: Moments, r: Array, v: Array | None, *, nonnegative: bool) -> _State:
    m = data.elements
    pair = np.stack([pairs.times(r) for pairs in data.pairs])
    normal = pair @ r
    moment = data.cross @ r  # (B, M)
    if v is None:
        level = 1e-14 * np.trace(normal, axis1=1, axis2=2) + 1e-290  # an rho of 0 gives V = 0
        ridge = level[:, None, None] * np.eye(m)
        v = np.linalg.solve((normal + ridge)[data.group], moment[..., None])[..., 0]
        if nonnegative:
            for b in np.flatnonzero(np.any(v < 0, axis=1)):
                quadratic_b = normal[data.group[b]] + ridge[data.group[b]]
                v[b] = minimise_above(np.zeros(m), quadratic_b, moment[b])
    quadratic = np.einsum("bi,bij,bj->b", v, normal[data.group], v)
    objective = float(np.sum(data.energy - 2 * np.sum(v * moment, axis=1) + quadratic))
    return _State(r, v, normal, pair, objective)


def _step(data: Moments, state: _State, seen: NDArray[np.bool_], *, nonnegative: bool) -> tuple[Array, float]:
    """The Gauss-Newton step in r with V eliminated, and the decrease of the objective that it promises."""
    residual = data.cross - _modelled(data, state)  # T_i^T W e_b
    grad_r = np.einsum("bi,bik->k", state.v, residual)
    grad_v = residual @ state.r
    free_v = np.ones_like(state.v, dtype=bool)
    if nonnegative:
        free_v = (state.v > 0) | (grad_v > 0)
    cells = np.flatnonzero(seen)
    grad_v = np.where(free_v, grad_v, 0.0)
    schur, _, coupled = _schur(data, state, free_v, cells)
    right = grad_r[cells] - np.einsum("bmk,bm->k", coupled, grad_v)
    r = state.r[cells]
    level = np.trace(schur) / max(1, cells.size)
    step = np.zeros(cells.size)
    if level > 0:
        # The gauge r r^T keeps the step off the scale's null direction; the ridge is for barely seen cells.
        schur += level * np.outer(r, r) / max(float(r @ r), 1e-300)
        schur[np.diag_indices_from(schur)] += _RIDGE * level
        step = minimise_above(-r, schur, right) if nonnegative else solve_positive(schur, right)
    dr = np.zeros_like(state.r)
    dr[cells] = step
    return dr, float(grad_r @ dr)


def _modelled(data: Moments, state: _State) -> Array:
    """T_i^T W F v_b, shape (B, M, K)."""
    b, m = state.v.shape
    total = np.empty((b, m, data.size))
    for g, pair in enumerate(state.pair):
        rows = np.flatnonzero(data.group == g)
        # sum_j v_j (T_i^T W T_j r): one product of matrices a group.
        product = state.v[rows] @ pair.transpose(1, 0, 2).reshape(m, -1)
        total[rows] = product.reshape(rows.size, m, data.size)
    return total


def _schur(
    data: Moments, state: _State, free: NDArray[np.bool_], cells: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """S on the given cells, and H_b^-1, H_b^-1 C_b with the rows of fixed source entries zero."""
    m = data.elements
    total = data.gram_of_source(state.v)
    normal = state.normal[data.group].copy()
    both = free[:, :, None] & free[:, None, :]
    normal = np.where(both, normal, np.eye(m) * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300)
    ridge = 1e-14 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(m)
    inverse = np.where(both, np.linalg.inv(normal + ridge), 0.0)
    coupling = _coupling(data, state)[..., cells]
    coupled = inverse @ coupling
    schur = total if cells.size == data.size else total[np.ix_(cells, cells)]
    if len(data.pairs) == 1 and np.all(free) and state.v.shape[0] > m:
        # One H for all: sum_b C_b^T H^-1 C_b hangs on V V^T alone, so that M columns do for B.
        few = np.linalg.qr(state.v, mode="r") @ state.pair[0].reshape(m, -1)
        coupling = few.reshape(m, m, data.size)[..., cells]
        schur -= coupling.reshape(-1, cells.size).T @ (inverse[0] @ coupling).reshape(-1, cells.size)
    else:
        schur -= coupling.reshape(-1, cells.size).T @ coupled.reshape(-1, cells.size)
    return 0.5 * (schur + schur.T), inverse, coupled


def _coupling(data: Moments, state: _State) -> Array:
    """C_b[i] = sum_j v_j (T_j^T W T_i r), shape (B, M, K)."""
    b, m = state.v.shape
    total = np.empty((b, m, data.size))
    for g, pair in enumerate(state.pair):
        rows = np.flatnonzero(data.group == g)
        total[rows] = (state.v[rows] @ pair.reshape(m, -1)).reshape(rows.size, m, data.size)
    return total
