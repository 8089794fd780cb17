"""Many small quadratic programs in boxes that share one Hessian, solved exactly and all at once.

    minimise  x_k^T H x_k / 2 - c_k^T x_k    subject to  0 <= x_k <= u_k,    k = 1 .. K

Both halves of the thesis's alternation (eqs. 4.16, 4.17) fall apart into such problems. They are solved by block
principal pivoting: guess which bounds hold, solve for the rest, exchange all that turn out wrong, and one at a time
where that does not get better, which ends after finitely many steps (Judice and Pires, Computers & Operations
Research 21(5), 1994; Kim and Park, SIAM J. Sci. Comput. 33(6), 2011, whose rule of exchange is used).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this ratio of eigenvalues the solution is not unique in float64, and the one next to the start is wanted.
_SINGULAR = 1e-9
_PROXIMAL_STEPS = 50
_EXACT = 1e-13
_PATIENCE = 3
_MAX_PIVOTS = 300


def solve_box_qps(hessian: Array, linear: Array, upper: Array, start: Array) -> Array:
    """The minimisers x_k, shape (K, M); where they are not unique, those that proximal steps from `start` reach.

    Parameters
    ----------
    hessian:
        H, shape (M, M), symmetric and positive semidefinite.
    linear, upper, start:
        c, u >= 0 and a first guess, shape (K, M). Entries with u = 0 are fixed at 0.

    Notes
    -----
    `optimality` certifies the result. A singular H is regularised by r |x - x_old|^2 / 2 with x_old the last result, which
    converges to a minimiser of the problem itself (Rockafellar, SIAM J. Control Optim. 14(5), 1976).
    """
    scale = float(np.max(np.diag(hessian), initial=0.0))
    x: Array = np.clip(start, 0.0, upper)
    if scale == 0:
        return np.where(linear > 0, upper, np.where(linear < 0, 0.0, x))
    # In units of H, so that the tolerances mean the same for any data.
    h, c = hessian / scale, linear / scale
    if np.linalg.eigvalsh(h)[0] > _SINGULAR:
        return _pivot(h, c, upper, x)
    near = h + _SINGULAR * np.eye(len(h))
    for _ in range(_PROXIMAL_STEPS):
        x = _pivot(near, c + _SINGULAR * x, upper, x)
        if optimality(h, c, upper, x) < _EXACT:
            break
    return x


def optimality(hessian: Array, linear: Array, upper: Array, x: Array) -> float:
    """Largest step that a projected gradient of length 1 / max H_ii still makes, in units of x; 0 at a minimiser."""
    scale = float(np.max(np.diag(hessian), initial=0.0)) or 1.0
    moved = np.clip(x - (x @ hessian - linear) / scale, 0.0, upper)
    return float(np.max(np.abs(moved - x), initial=0.0))


def _pivot(h: Array, c: Array, upper: Array, x: Array) -> Array:
    """Block principal pivoting for a positive definite H with diagonal of order 1."""
    x = x.copy()
    at_zero, at_top = x <= 0, (x >= upper) & (upper > 0)
    fewest = np.full(len(c), h.shape[0] + 1)
    patience = np.full(len(c), _PATIENCE)
    unsolved = np.arange(len(c))
    identity = np.eye(h.shape[0])
    for _ in range(_MAX_PIVOTS):
        low, high, top = at_zero[unsolved], at_top[unsolved], upper[unsolved]
        free = ~(low | high)
        held = np.where(high, top, 0.0)
        systems = np.where(free[:, :, None] & free[:, None, :], h, identity)
        trial = np.linalg.solve(systems, np.where(free, c[unsolved] - held @ h, held)[..., None])[..., 0]
        slope = trial @ h - c[unsolved]
        below, above = free & (trial < -_EXACT), free & (trial > top + _EXACT)
        wrong = below | above | (low & (top > 0) & (slope < -_EXACT)) | (high & (slope > _EXACT))
        count = np.count_nonzero(wrong, axis=1)
        x[unsolved] = np.clip(trial, 0.0, top)

        better = count < fewest[unsolved]
        fewest[unsolved] = np.where(better, count, fewest[unsolved])
        patience[unsolved] = np.where(better, _PATIENCE, patience[unsolved] - 1)
        single = patience[unsolved] < 0
        if np.any(single):
            last = h.shape[0] - 1 - np.argmax(wrong[:, ::-1], axis=1)
            wrong &= ~single[:, None] | (np.arange(h.shape[0]) == last[:, None])
        at_zero[unsolved] = np.where(wrong, below, low)
        at_top[unsolved] = np.where(wrong, above, high)
        unsolved = unsolved[count > 0]
        if unsolved.size == 0:
            break
    return x
