"""A point of the likelihood, V eliminated: the misfit there, and the Fisher information.

With J_b = sum_i V_ib T_i, H_b = F^T W F and C_b = F^T W J_b the information of r is, with V eliminated (variable
projection; Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973),

    S = sum_b J_b^T W J_b - C_b^T H_b^-1 C_b,

whose null vector is r itself, the global scale. All of it follows from the `moments`, without a look at the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.convex import minimise_each
from wallmirror.derendering.moments import Moments
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

_LEAST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Point:
    """A BRDF and a pattern, and what the moments make of them.

    Parameters
    ----------
    r, v:
        r (K,) and the pattern, a row for each realisation, (B, M).
    normal, pair:
        H (G, M, M) and N_ij r (G, M, M, K) of each group of realisations that share weights.
    moment:
        F^T W d_b, shape (B, M).
    objective:
        sum w (D - F V)^2.
    """

    r: Array
    v: Array
    normal: Array
    moment: Array
    pair: Array
    objective: float


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


def information(data: Moments, coefficients: Array, source: Array, schur: Array | None = None) -> Information:
    """The Fisher information at r (K,) and V (M, B); S where a fit has made it already."""
    seen = data.seen
    point = point_at(data, coefficients, source.T)
    free = np.ones_like(point.v, dtype=bool)
    inverse = inverses(data, point, free)
    cells = np.flatnonzero(seen)
    coupled = inverse @ _coupling(data, point)[..., cells]
    schur = schur_complement(data, point, free, inverse, cells) if schur is None else schur
    return Information(schur, inverse, coupled, seen)


def point_at(data: Moments, r: Array, v: Array | None = None, *, nonnegative: bool = False) -> Point:
    """The point with r (K,), and with the pattern v (B, M) or, where none is given, the best one, V >= 0 if need be."""
    m = data.elements
    pair = np.stack([pairs.times(r) for pairs in data.pairs])
    normal = pair @ r
    moment = data.cross @ r
    if v is None:
        level = 1e-14 * np.trace(normal, axis1=1, axis2=2) + 1e-290  # an rho of 0 gives V = 0
        ridge = level[:, None, None] * np.eye(m)
        v = np.linalg.solve((normal + ridge)[data.group], moment[..., None])[..., 0]
        if nonnegative:
            below = np.flatnonzero(np.any(v < 0, axis=1))
            v[below] = minimise_each((normal + ridge)[data.group[below]], moment[below])
    quadratic = np.einsum("bi,bij,bj->b", v, normal[data.group], v)
    objective = float(np.sum(data.energy - 2 * np.sum(v * moment, axis=1) + quadratic))
    return Point(r, v, normal, moment, pair, objective)


def mixed(data: Moments, point: Point, other: Array) -> Array:
    """sum_b J_b^T W F u_b for a pattern u (B, M) beside v: by symmetry also sum_b C_b^T u_b; shape (K,)."""
    total = np.zeros(data.size)
    for g, pair in enumerate(point.pair):
        rows = data.group == g
        total += np.tensordot(point.v[rows].T @ other[rows], pair, axes=2)
    return total


def unseen_pattern() -> UndeterminedError:
    """The refusal of captures of which one leaves its pattern free, as no light of the card falls on a pixel that counts."""
    return UndeterminedError(
        "in one realisation the pixels that are not saturated see no light of the card, so that nothing determines its "
        "pattern; leave it out, or expose for less time and capture it again"
    )


def inverses(data: Moments, point: Point, free: NDArray[np.bool_]) -> Array:
    """H_b^-1 with the rows and columns of fixed source entries zero, shape (B, M, M); UndeterminedError where one is zero."""
    m = data.elements
    trace = np.trace(point.normal, axis1=1, axis2=2)
    if not np.all(trace > 0):
        raise unseen_pattern()
    ridge = 1e-14 * trace[:, None, None] * np.eye(m)
    inverse = np.linalg.inv(point.normal + ridge)[data.group]
    bound = np.flatnonzero(~np.all(free, axis=1))
    both = free[bound, :, None] & free[bound, None]
    own = trace[data.group[bound], None, None] * np.eye(m)
    kept = np.where(both, point.normal[data.group[bound]], own)
    kept = kept + 1e-14 * np.trace(kept, axis1=1, axis2=2)[:, None, None] * np.eye(m)
    inverse[bound] = np.where(both, np.linalg.inv(kept), 0.0)
    return np.asarray(inverse)


def schur_complement(
    data: Moments, point: Point, free: NDArray[np.bool_], inverse: Array, cells: NDArray[np.intp]
) -> Array:
    """S on the given cells, for H_b^-1 as `inverses` gives them."""
    m = data.elements
    # Cells that are neighbours, as the seen ones mostly are, need not be picked one by one.
    beside = cells.size > 0 and int(cells[-1] - cells[0]) == cells.size - 1
    kept = slice(int(cells[0]), int(cells[-1]) + 1) if beside else cells
    schur = data.gram_of_source(point.v)[kept][:, kept]
    whole = np.all(free, axis=1)
    for g, pair in enumerate(point.pair):
        alike = np.flatnonzero((data.group == g) & whole)
        # One H for all of these: sum_b C_b^T H^-1 C_b hangs on V V^T alone, so that M columns do for B.
        few = point.v[alike] if alike.size <= m else np.linalg.qr(point.v[alike], mode="r")
        coupling = (few @ pair.reshape(m, -1)).reshape(-1, m, data.size)[..., kept]
        values, vectors = np.linalg.eigh(point.normal[g])
        root = vectors / np.sqrt(np.maximum(values, max(1e-14 * float(np.sum(values)), _LEAST)))
        half = (root.T @ coupling).reshape(-1, cells.size)
        schur -= half.T @ half
    bound = np.flatnonzero(~whole)
    if bound.size:
        # Of H_b^-1 = R R^T with rows of 0 the product R^T C_b does, which costs half.
        values, vectors = np.linalg.eigh(inverse[bound])
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        half = (root.transpose(0, 2, 1) @ _coupling(data, point)[bound][..., kept]).reshape(-1, cells.size)
        schur -= half.T @ half
    return schur


@dataclass(frozen=True)
class Pull:
    """The gradient of the objective at a point, turned round: in r (K,) and in V (B, M), of the entries of V that may move."""

    r: Array
    v: Array
    free: NDArray[np.bool_]

    def without_v(self, data: Moments, point: Point, inverse: Array) -> Array:
        """That in r with V eliminated, shape (K,), for H_b^-1 as `inverses` gives them."""
        return np.asarray(self.r - mixed(data, point, np.einsum("bij,bj->bi", inverse, self.v)))


def pull_at(data: Moments, point: Point, *, nonnegative: bool) -> Pull:
    """The gradient turned round; with bounds the entries of V at 0 that it would lead below may not move."""
    v = point.moment - np.einsum("bij,bj->bi", point.normal[data.group], point.v)
    r = np.einsum("bi,bik->k", point.v, data.cross) - mixed(data, point, point.v)
    free = (point.v > 0) | (v > 0) if nonnegative else np.ones_like(point.v, dtype=bool)
    return Pull(r, np.where(free, v, 0.0), free)


def score_of(data: Moments, point: Point, cells: NDArray[np.intp]) -> tuple[Array, Array]:
    """S on the given cells, and the pull there, with V >= 0 eliminated: shapes (n, n) and (n,)."""
    pull = pull_at(data, point, nonnegative=True)
    inverse = inverses(data, point, pull.free)
    return schur_complement(data, point, pull.free, inverse, cells), pull.without_v(data, point, inverse)[cells]


def _coupling(data: Moments, point: Point) -> Array:
    """C_b[i] = sum_j v_j (T_j^T W T_i r), shape (B, M, K)."""
    b, m = point.v.shape
    total = np.empty((b, m, data.size))
    for g, pair in enumerate(point.pair):
        rows = np.flatnonzero(data.group == g)
        total[rows] = (point.v[rows] @ pair.reshape(m, -1)).reshape(rows.size, m, data.size)
    return total
