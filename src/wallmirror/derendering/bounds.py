"""The Cramer-Rao bound of blind de-rendering: error bars for the pattern and the BRDF.

The Fisher information of (r, V) has one null direction, the global scale (r, -V). A gauge that fixes a linear
functional c of r (here the BRDF's peak) removes it: with S the information of r after V is eliminated,

    Cov(r) = (S + k c c^T)^-1 - r r^T / (k (c r)^2),
    Cov(vec V) = blockdiag(H_b^-1) + [H_b^-1 C_b] Cov(r) [H_b^-1 C_b]^T.

`foresight.foresee` takes it at a scene that is yet to be filmed, the solvers at what they found.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import NDArray
from scipy.linalg import lapack

from wallmirror.derendering.groups import Groups
from wallmirror.derendering.information import Information, information
from wallmirror.derendering.moments import Moments
from wallmirror.derendering.splines import SplineGrid
from wallmirror.errors import InputError

Array = NDArray[np.float64]

# Share of a bound on V that a ten times larger ridge must leave.
_KEPT = 0.8
# Rows and columns of a block that stays in a processor's cache.
_BLOCK = 64
# The largest entry of a pattern must lie between these.
_LEAST, _MOST = 1e-50, 1e50


@dataclass(frozen=True)
class Bound:
    """Smallest covariance that an unbiased estimate can have, per unit noise variance in units of the weights.

    Parameters
    ----------
    coefficients:
        Cov(r) over the seen coefficients, shape (K', K').
    seen:
        Which of the K coefficients those are, shape (K,).
    source_std:
        Standard deviation of V, shape (M, B).
    shape_std:
        Standard deviation of V after the best global scale, which nobody can know, shape (M, B).
    source_error:
        Expected relative error of V in the Frobenius norm after the best global scale.
    """

    coefficients: Array
    seen: NDArray[np.bool_]
    source_std: Array
    shape_std: Array
    source_error: float

    def brdf_std(self, grid: SplineGrid, u: Array) -> Array:
        """Standard deviation of rho at angle sums u in radians, same shape; inf where nothing was seen."""
        position = np.where(self.seen, np.cumsum(self.seen) - 1, -1)
        first, values = grid.basis(u)
        columns = position[first + np.arange(grid.degree + 1)[:, None]]  # (degree + 1, L)
        missing = columns < 0
        blind = (u < grid.start) | (u > grid.stop) | np.any(missing & (values > 1e-3), axis=0)
        known = np.where(missing, 0.0, values)
        # Only the degree + 1 coefficients around an angle have a say there.
        variance = np.einsum("aL,bL,abL->L", known, known, self.coefficients[columns[:, None], columns])
        return np.where(blind, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def cramer_rao(data: Moments, coefficients: Array, source: Array, *, gauge: Array) -> Bound:
    """The bound at (r, V) in the gauge that holds c r fixed.

    Parameters
    ----------
    coefficients:
        r, shape (K,).
    source:
        V, shape (M, B).
    gauge:
        c, shape (K,): the values of the basis functions at the peak of rho.

    Raises
    ------
    InputError
        For a pattern whose powers leave the range of float64.
    """
    require_order_one(source)
    return bound_of(information(data, coefficients, source), coefficients=coefficients, source=source, gauge=gauge)


def require_order_one(source: Array) -> None:
    """Refuse a pattern whose squares, weighted, float64 cannot hold."""
    largest = float(np.max(np.abs(source), initial=0.0))
    if not _LEAST <= largest <= _MOST:
        raise InputError(f"is {largest:g} at most; bring it near one, and the noise along", field="source")


def bound_of(
    known: Information,
    *,
    coefficients: Array,
    source: Array,
    gauge: Array,
    groups: Groups | None = None,
) -> Bound:
    """The bound that a Fisher information gives, whatever the noise: normal (`cramer_rao`) or of counts (`poisson`).

    Parameters
    ----------
    known:
        The information at (r, V).
    coefficients, source, gauge:
        As for `cramer_rao`.
    groups:
        Of elements that have a scale each: then `gauge` has a row for each, (G, K).
    """
    schur, inverse, coupled, seen = known.schur, known.inverse, known.coupled, known.seen
    c, r = np.atleast_2d(gauge)[:, seen], coefficients[seen]
    # A null direction of S for each scale that is free: the group's part of r.
    null = r[None] if groups is None else groups.parts(coefficients)[:, seen]
    patterns = source.T[None] if groups is None else groups.patterns(source)
    # Where rounding is all there is, the trace may be negative.
    level = float(np.trace(schur)) / max(1, schur.shape[0])
    informed, level = level > 0, level if level > 0 else float(np.max(np.abs(schur), initial=0.0)) or 1.0
    strength = level / max(float(np.sum(c * c)), 1e-300) * len(c)
    pinned = schur + strength * c.T @ c
    # Barely seen cells: a ridge far below their neighbours' information keeps their (huge) variance finite.
    # And no ridge below the rounding of S, which subtracts C^T H^-1 C with the condition of H.
    lost = max(1e-12, 4 * np.finfo(np.float64).eps * float(np.max(np.linalg.cond(inverse))))
    ridge = lost * level
    along = np.sum(c * null, axis=1, keepdims=True)
    scale = np.divide(null, math.sqrt(strength) * along, out=np.zeros_like(null), where=along != 0)
    rows = coupled.reshape(-1, r.size)

    def factor(ridge: float) -> Array:
        raised = pinned.copy()
        raised[np.diag_indices_from(raised)] += ridge
        # What lies above the diagonal is left as it may be: to clear it takes longer than to factorise, and so does a copy in
        # LAPACK's order, which the transpose has already.
        return np.asarray(sl.cho_factor(raised.T, lower=True, overwrite_a=True, check_finite=False)[0])

    lower, sound = None, informed and lost <= 1e-3
    while lower is None:
        try:
            lower = factor(ridge)
        except np.linalg.LinAlgError:  # rounding took more than it should: what is left is no bound
            ridge, sound = 100 * max(ridge, 1e-290), False
    covariance = _inverse(lower) - scale.T @ scale
    spread = (rows @ covariance).reshape(coupled.shape)
    error = _scale_free_error(patterns, inverse, coupled, spread)
    # What the ridge alone holds, nothing holds: a bound on V that falls with it is none. It is convex in the ridge, so that
    # its slope tells how far it may fall at most.
    whole = spread.reshape(rows.shape) + (rows @ scale.T) @ scale  # [H^-1 C] of the pinned information's inverse
    whole *= math.sqrt(ridge)  # before the square, which may leave the range of float64
    most = 9 * float(np.sum(whole * whole)) / max(float(np.sum(source * source)), 1e-300)
    if sound and not error**2 - most >= (_KEPT * error) ** 2:
        solved = sl.cho_solve((factor(10 * ridge), True), rows.T, check_finite=False).T - (rows @ scale.T) @ scale
        sound = _scale_free_error(patterns, inverse, coupled, solved.reshape(coupled.shape)) >= _KEPT * error
    if not sound:
        error = float("inf")
    variance = np.einsum("bii->bi", inverse) + np.sum(spread * coupled, axis=-1)
    return Bound(
        coefficients=covariance,
        seen=seen,
        source_std=np.sqrt(np.maximum(variance, 0.0)).T,
        shape_std=_shape_std(patterns, inverse, coupled, spread, variance),
        source_error=error,
    )


def _inverse(lower: Array) -> Array:
    """The inverse of a matrix from its lower Cholesky factor, half the work of solving for the columns of 1."""
    half, failed = lapack.dpotri(lower, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the information is singular")
    size = half.shape[0]
    for begin in range(0, size, _BLOCK):  # a transpose of the whole would go through the memory line by line
        end = min(begin + _BLOCK, size)
        half[begin:end, end:] = half[end:, begin:end].T
        square = half[begin:end, begin:end]
        half[begin:end, begin:end] = np.tril(square) + np.tril(square, -1).T
    return np.asarray(half, dtype=np.float64)


def _shape_std(patterns: Array, inverse: Array, coupled: Array, spread: Array, variance: Array) -> Array:
    """Standard deviation of V freed of its part along each pattern v: Var(dv - v (v dv) / |v|^2), shape (M, B)."""
    free = variance
    for v in patterns:
        norm = max(float(np.sum(v * v)), 1e-300)
        pulled = np.einsum("bi,bik->k", v, spread)
        together = np.einsum("bij,bj->bi", inverse, v) + np.einsum("bik,k->bi", coupled, pulled)
        along = float(np.sum(v * together))
        free = free - 2 * v * together / norm + v * v * along / norm**2
    return np.asarray(np.sqrt(np.maximum(free, 0.0)).T, dtype=np.float64)


def _scale_free_error(patterns: Array, inverse: Array, coupled: Array, spread: Array) -> float:
    """sqrt(E |dV|^2) / |V| with dV freed of its part along each pattern (B, M) of its own scale, which that absorbs.

    `spread` is [H_b^-1 C_b] Cov(r), shape (B, M, K').
    """
    norms = np.sum(patterns**2, axis=(1, 2))
    if not np.sum(norms) > 0:
        return float("inf")
    total = float(np.einsum("bii->", inverse)) + float(np.sum(spread * coupled))
    for v, norm in zip(patterns, norms, strict=True):
        if norm > 0:
            # Along V: v^T Cov v / |V|^2.
            pulled = np.einsum("bi,bik->k", v, coupled)
            along = float(np.einsum("bi,bij,bj->", v, inverse, v)) + float(np.einsum("bi,bik,k->", v, spread, pulled))
            total -= along / float(norm)
    return float(np.sqrt(max(total, 0.0) / float(np.sum(norms))))
