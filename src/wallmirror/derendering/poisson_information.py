"""Fisher information of counts, whose weights differ from entry to entry and from step to step.

The largest sum in it needs none of the B products of its own:

    sum_b J_b^T W_b J_b = sum_ij T_i^T diag(q_ij) T_j,          q_ij[p] = sum_b w_pb V_ib V_jb.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.information import unseen_pattern
from wallmirror.derendering.splines import transport_of

Array = NDArray[np.float64]

# Cells whose Fisher information lies this far below the best-seen cell's are left out.
_SEEN = 1e-10
# Products of T's entries that are worth keeping: 200 MB of them.
_MOST_PRODUCTS = 12_000_000


def seen_cells(designs: list[sp.csr_array]) -> NDArray[np.bool_]:
    """Which coefficients the captures see at all, shape (K,)."""
    energy = np.zeros(designs[0].shape[1])
    for t in designs:
        energy += np.bincount(t.indices, weights=t.data**2, minlength=energy.size)
    return np.asarray(energy > _SEEN * energy.max())


class Products:
    """sum_ij T_i^T diag(q_ij) T_j for any weights, from products of T's entries that are formed once where they fit."""

    def __init__(self, designs: list[sp.csr_array]) -> None:
        self.designs = designs
        self.pairs = [(i, j) for j in range(len(designs)) for i in range(j + 1)]
        rows, size = designs[0].shape
        widths = [int(np.diff(t.indptr).max(initial=1)) for t in designs]
        self.kept: list[tuple[NDArray[np.intp], Array]] | None = None
        if rows * sum(widths[i] * widths[j] for i, j in self.pairs) <= _MOST_PRODUCTS:
            padded = [_padded(t, w) for t, w in zip(designs, widths)]
            self.kept = [
                (
                    (padded[i][0][:, :, None] * size + padded[j][0][:, None, :]).reshape(rows, -1),
                    (padded[i][1][:, :, None] * padded[j][1][:, None, :]).reshape(rows, -1),
                )
                for i, j in self.pairs
            ]

    def summed(self, weights: Array, v: Array) -> Array:
        """sum_b J_b^T W_b J_b, dense (K, K), for weights (P, B) and a pattern (M, B)."""
        size = self.designs[0].shape[1]
        upper, diagonal = np.zeros(size * size), np.zeros(size * size)
        for n, (i, j) in enumerate(self.pairs):
            q = weights @ (v[i] * v[j])
            target = diagonal if i == j else upper
            if self.kept is not None:
                where, values = self.kept[n]
                target += np.bincount(where.ravel(), weights=(values * q[:, None]).ravel(), minlength=size * size)
            else:
                scaled = self.designs[j].copy()
                scaled.data = scaled.data * np.repeat(q, np.diff(scaled.indptr))
                target += sp.csr_array(self.designs[i].T @ scaled).toarray().ravel()
        upper = upper.reshape(size, size)
        return np.asarray(diagonal.reshape(size, size) + upper + upper.T)


def information_of_counts(
    products: Products,
    r: Array,
    v: Array,
    weights: Array,
    cells: NDArray[np.intp],
    free: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """S over the given cells, H_b^-1 (B, M, M) and H_b^-1 C_b (B, M, K'), rows of fixed source entries zero."""
    m, realisations = v.shape
    total = products.summed(weights, v)
    transport = transport_of(products.designs, r)
    normal = np.empty((realisations, m, m))
    coupling = np.zeros((realisations, m, r.size))
    for i in range(m):
        seen_from = weights * transport[:, i : i + 1]  # (P, B)
        normal[:, i] = seen_from.T @ transport
        for j, t in enumerate(products.designs):
            coupling[:, i] += (t.T @ (seen_from * v[j])).T
    both = free.T[:, :, None] & free.T[:, None, :]
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300
    normal = np.where(both, normal, np.eye(m) * trace)
    try:
        inverse = np.where(both, np.linalg.inv(normal + 1e-14 * trace * np.eye(m)), 0.0)
    except np.linalg.LinAlgError:
        raise unseen_pattern() from None
    coupling = coupling[:, :, cells]
    coupled = inverse @ coupling
    schur = total[np.ix_(cells, cells)]
    schur -= coupling.reshape(-1, cells.size).T @ coupled.reshape(-1, cells.size)
    return 0.5 * (schur + schur.T), inverse, coupled


def _padded(design: sp.csr_array, width: int) -> tuple[NDArray[np.intp], Array]:
    """Columns and values of each row, filled up with zeros in column 0; both (P, width)."""
    lengths = np.diff(design.indptr)
    inside = np.arange(width) < lengths[:, None]
    columns, values = np.zeros(inside.shape, dtype=np.intp), np.zeros(inside.shape)
    columns[inside], values[inside] = design.indices, design.data
    return columns, values
