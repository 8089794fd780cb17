"""The data in coefficient space: what the likelihood needs of them, after one pass over the pixels.

With inverse variances w on the diagonal of W the misfit sum w (D - F V)^2 depends on the data only through

    N_ij = T_i^T W T_j,      X_ib = T_i^T W d_b,      sum_p w d^2,

so that an iteration of a fit does not touch the pixels.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.windows import Windows
from wallmirror.memory import pairs_bytes, require_memory

Array = NDArray[np.float64]

#: Cells whose Fisher information lies this far below the best-seen cell's are left out of the fit.
LEAST_SEEN = 1e-10


@dataclass(frozen=True)
class Pairs:
    """All N_ij of one choice of weights, laid out so that neither of their two uses loops over pairs.

    Parameters
    ----------
    above:
        N_ij for i <= j, (i, j) = (0, 0), (0, 1), ..., (0, M - 1), (1, 1), ..., along the diagonal of one csr matrix. N_ji
        is the transpose.
    elements:
        M.
    """

    above: sp.csr_array
    elements: int

    @classmethod
    def of(cls, designs: list[sp.csr_array], windows: Windows | None, weight: Array) -> Pairs:
        """From T_1 .. T_M, cut into windows where that can be, and w of shape (P,)."""
        above = _sparse_grams(designs, weight) if windows is None else windows.grams(weight)
        return cls(above, len(designs))

    def coarser(self, halved: sp.csr_array) -> Pairs:
        """R^T N_ij R for R of shape (K, K')."""
        every = sp.csr_array(sp.kron(sp.eye_array(self.above.shape[0] // self.size), halved, format="csr"))
        return Pairs(sp.csr_array(every.T.tocsr() @ (self.above @ every)), self.elements)

    def whole(self) -> sp.csr_array:
        """[T_1 .. T_M]^T W [T_1 .. T_M], sparse (M K, M K)."""
        i, j = self._of
        size, pair = self.size, np.repeat(np.arange(i.size), np.diff(self.above.indptr[:: self.size]))
        row, column = np.divmod(self._where, size)
        shares = np.where(i == j, 0.5, 1.0)[pair]  # of what its transpose brings again
        places = (row + i[pair] * size, column + j[pair] * size)
        half = sp.csr_array((shares * self.above.data, places), shape=(self.elements * size, self.elements * size))
        return sp.csr_array(half + half.T)

    @property
    def size(self) -> int:
        """K."""
        return int(self.above.shape[0]) // (self.elements * (self.elements + 1) // 2)

    @cached_property
    def _below(self) -> sp.csc_array:
        """The same matrix the other way round."""
        return self.above.T

    @cached_property
    def _of(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The i and the j of each pair."""
        return np.triu_indices(self.elements)

    @cached_property
    def _where(self) -> NDArray[np.int64]:
        """Place of each entry in a flat (K, K)."""
        size = self.size
        row = np.tile(np.arange(0, size * size, size), self.above.shape[0] // size)
        return np.asarray(np.repeat(row, np.diff(self.above.indptr)) + self.above.indices % size)

    @cached_property
    def _flat(self) -> sp.csc_array:
        """N_ij as columns of (K^2, M (M + 1) / 2), so that a product sums them up."""
        pointers, size = self.above.indptr[:: self.size], self.size
        return sp.csc_array((self.above.data, self._where, pointers), shape=(size * size, pointers.size - 1))

    @cached_property
    def band(self) -> Array:
        """Lower band of sum_i N_ii, shape (w, K): entry [d, k] is that of row k + d and column k."""
        size = self.size
        pointers = self.above.indptr.astype(np.intp)
        first = [i * self.elements - i * (i - 1) // 2 for i in range(self.elements)]  # (i, i) among the pairs
        inside = np.concatenate([np.arange(pointers[k * size], pointers[(k + 1) * size]) for k in first])
        row, column = np.divmod(self._where[inside], size)
        below = row >= column
        place = (row - column)[below] * size + column[below]
        width = int(np.max(row - column, initial=0)) + 1
        sums = np.bincount(place, weights=self.above.data[inside[below]], minlength=width * size)
        return np.asarray(sums.reshape(width, size), dtype=np.float64)

    @cached_property
    def exposures(self) -> Array:
        """Diagonals of the N_ii, shape (M, K)."""
        i, j = self._of
        return np.asarray(self.above.diagonal().reshape(i.size, -1)[i == j])

    def times(self, r: Array) -> Array:
        """N_ij r, shape (M, M, K)."""
        i, j = self._of
        every = np.tile(r, i.size)
        products = np.empty((self.elements, self.elements, r.size))
        products[i, j] = (self.above @ every).reshape(i.size, -1)
        products[j, i] = (self._below @ every).reshape(i.size, -1)
        return products

    def mixed(self, products: Array) -> Array:
        """sum_ij products_ij N_ij for symmetric products (M, M), dense (K, K)."""
        factors = (products - 0.5 * np.diag(np.diag(products)))[self._of]
        square = (self._flat @ factors).reshape(self.size, self.size)
        return np.asarray(square + square.T, dtype=np.float64)


@dataclass(frozen=True)
class Moments:
    """The data in coefficient space.

    Parameters
    ----------
    pairs:
        The N_ij of each group of realisations that share weights.
    group:
        Group of each realisation, shape (B,).
    cross:
        X, shape (B, M, K).
    energy:
        sum_p w d^2 of each realisation, shape (B,).
    observations:
        Number of data with weight > 0.
    apart:
        Which coefficients belong to each of several groups that have a scale each, shape (G, K); None for one scale.
    """

    pairs: list[Pairs]
    group: NDArray[np.intp]
    cross: Array
    energy: Array
    observations: int
    apart: NDArray[np.bool_] | None = None

    @property
    def elements(self) -> int:
        """M."""
        return int(self.cross.shape[1])

    @property
    def size(self) -> int:
        """K."""
        return int(self.cross.shape[2])

    @cached_property
    def exposure(self) -> Array:
        """How well each coefficient is seen, relative to the best-seen one, shape (K,)."""
        total = np.sum([pairs.band[0] for pairs in self.pairs], axis=0)
        return np.asarray(total / max(float(total.max(initial=0.0)), 1e-300))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which coefficients the captures see at all, shape (K,)."""
        return np.asarray(self.exposure > LEAST_SEEN)

    def coarser(self, halved: sp.csr_array) -> Moments:
        """Those on knots twice as far apart, whose r is `halved` r on these knots, (K, K'); see `SplineGrid.in_halved`."""
        cross = (self.cross.reshape(-1, self.size) @ halved).reshape(*self.cross.shape[:2], -1)
        return replace(self, pairs=[pairs.coarser(halved) for pairs in self.pairs], cross=cross, apart=None)

    def gram_of_source(self, v: Array) -> Array:
        """sum_b J_b^T W J_b, dense (K, K), for v of shape (B, M)."""
        patterns = (v[self.group == g] for g in range(len(self.pairs)))
        grams = (pairs.mixed(rows.T @ rows) for pairs, rows in zip(self.pairs, patterns, strict=True))
        return functools.reduce(np.add, grams)


def moments(data: Array, designs: list[sp.csr_array], inverse_variance: Array | None = None) -> Moments:
    """One pass over the data (P, B): the Gram matrices and cross products that the fit needs.

    Parameters
    ----------
    inverse_variance:
        w, shape (P, B); 0 leaves a pixel out. Left out altogether, all weights are 1.
    """
    realisations = data.shape[1]
    if inverse_variance is None:
        inverse_variance = np.ones((data.shape[0], 1))
    weights, group = _alike(inverse_variance)
    group = np.broadcast_to(group, (realisations,))
    full = np.broadcast_to(weights, data.shape) if weights.shape[1] == 1 else weights[:, group]
    weighted = full * data
    cross = np.stack([(t.T @ weighted).T for t in designs], axis=1)
    windows = Windows.of(designs)
    if windows is not None:
        require_memory(
            pairs_bytes(windows.most_entries, weights.shape[1]),
            f"a fit of {len(designs)} elements on {designs[0].shape[1]} knots",
        )
    return Moments(
        pairs=[Pairs.of(designs, windows, weights[:, g]) for g in range(weights.shape[1])],
        group=group,
        cross=cross,
        energy=np.sum(weighted * data, axis=0),
        observations=int(np.count_nonzero(full > 0)),
    )


def _alike(inverse_variance: Array) -> tuple[Array, NDArray[np.intp]]:
    """The different columns of the weights, and which of them each realisation has."""
    first = inverse_variance[:, :1]
    if np.array_equal(np.broadcast_to(first, inverse_variance.shape), inverse_variance):
        return first, np.zeros(1, dtype=np.intp)
    weights, group = np.unique(inverse_variance, axis=1, return_inverse=True)
    return weights, np.asarray(group).ravel().astype(np.intp)


def _sparse_grams(designs: list[sp.csr_array], weight: Array) -> sp.csr_array:
    """As `Windows.grams`, for matrices whose rows are no runs."""
    scaled = [
        sp.csr_array((t.data * np.repeat(weight, np.diff(t.indptr)), t.indices, t.indptr), t.shape) for t in designs
    ]
    grams = [t.T @ right for i, t in enumerate(designs) for right in scaled[i:]]
    return sp.csr_array(sp.block_diag(grams, format="csr"))
