"""Positive definite systems, and the quadratic programmes that non-negativity makes of a Newton step."""

from __future__ import annotations

import numpy as np
import scipy.linalg as sl
from numpy.typing import NDArray

from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

_PIVOTS = 20


def minimise_above(floor: Array, quadratic: Array, linear: Array) -> Array:
    """Minimise 1/2 d Q d - q d over d >= floor by block principal pivoting (Judice and Pires 1994).

    Parameters
    ----------
    floor, linear:
        The least d, at most 0 and equal to it where a variable lies at its bound now, and q; both of shape (n,).
    quadratic:
        Q, symmetric positive definite up to rounding, shape (n, n).

    Returns
    -------
    d of shape (n,).

    Raises
    ------
    UndeterminedError
        As `solve_positive`.

    Notes
    -----
    All variables on the wrong side of their bound change sides at once, starting from those that lie at their bound
    now. Should that cycle, the best vector so far, moved into the bounds, is still a direction to search along.
    """
    offset = linear - quadratic @ floor  # in x = d - floor >= 0
    free = (floor < 0) | (linear > 0)
    best, fewest = np.zeros_like(floor), floor.size + 1
    slack = 1e-9 * float(np.max(np.abs(offset), initial=0.0))
    for _ in range(_PIVOTS):
        x = np.zeros_like(floor)
        inside = np.flatnonzero(free)
        if inside.size == floor.size:
            x = solve_positive(quadratic, offset)
        elif inside.size:
            # Whole rows first: to pick entry by entry takes as long as to factorise.
            x[inside] = solve_positive(quadratic[inside][:, inside], offset[inside])
        wrong = np.where(free, x < -1e-12 * np.max(np.abs(x)), quadratic @ x - offset < -slack)
        count = int(np.count_nonzero(wrong))
        if count < fewest:
            best, fewest = x, count
        if count == 0:
            break
        free = free ^ wrong
    return np.maximum(best, 0.0) + floor


def minimise_each(quadratic: Array, linear: Array) -> Array:
    """Minimise 1/2 x Q x - q x over x >= 0 for each of many small Q at once, by the same pivoting as `minimise_above`.

    Parameters
    ----------
    quadratic, linear:
        Each Q, symmetric positive definite, (n, m, m), and q, (n, m).

    Returns
    -------
    The x, shape (n, m).
    """
    free = linear > 0
    best, fewest = np.zeros_like(linear), np.full(len(linear), linear.shape[1] + 1)
    slack = 1e-9 * np.max(np.abs(linear), axis=1, keepdims=True, initial=0.0)
    own = np.eye(linear.shape[1]) * np.trace(quadratic, axis1=1, axis2=2)[:, None, None]
    for _ in range(_PIVOTS):
        inside = np.where(free[:, :, None] & free[:, None], quadratic, own)  # a bound variable by itself, of value 0
        x = np.linalg.solve(inside, np.where(free, linear, 0.0)[..., None])[..., 0]
        pull = linear - np.einsum("nij,nj->ni", quadratic, x)
        wrong = np.where(free, x < -1e-12 * np.max(np.abs(x), axis=1, keepdims=True, initial=0.0), pull > slack)
        count = np.count_nonzero(wrong, axis=1)
        better = count < fewest
        best[better], fewest[better] = x[better], count[better]
        if not np.any(count):
            break
        free = free ^ wrong
    return np.maximum(best, 0.0)


def solve_positive(matrix: Array, right: Array) -> Array:
    """Solve by Cholesky, several times faster than `scipy.linalg.solve`, which also estimates the condition.

    A matrix that rounding has robbed of its smallest eigenvalues gets a larger ridge.

    Parameters
    ----------
    matrix:
        Symmetric positive definite up to rounding, shape (n, n).
    right:
        Right-hand side, shape (n,) or (n, m).

    Raises
    ------
    UndeterminedError
        When no small ridge makes the matrix positive definite.
    """
    return np.asarray(sl.cho_solve((positive_factor(matrix), True), right, check_finite=False), dtype=np.float64)


def positive_factor(matrix: Array) -> Array:
    """The lower Cholesky factor that `solve_positive` solves with, what lies above its diagonal left as it may be.

    Raises
    ------
    UndeterminedError
        As `solve_positive`.
    """
    for ridge in (0.0, 1e-11, 1e-9, 1e-7):
        try:
            raised = matrix + ridge * np.mean(np.diag(matrix)) * np.eye(matrix.shape[0]) if ridge else matrix
            # LAPACK goes by columns, as the transpose of NumPy's matrices does.
            return np.asarray(sl.cho_factor(raised.T, lower=True, check_finite=False)[0], dtype=np.float64)
        except np.linalg.LinAlgError:
            continue
    raise UndeterminedError("the captures leave the pattern undetermined; capture more light, views or patterns")
