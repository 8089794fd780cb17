"""The data in coefficient space: what the likelihood needs of them, after one pass over the pixels.

With inverse variances w on the diagonal of W the misfit sum w (D - F V)^2 depends on the data only through

    N_ij = T_i^T W T_j,      X_ib = T_i^T W d_b,      sum_p w d^2,

so that an iteration of a fit does not touch the pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Cells whose Fisher information lies this far below the best-seen cell's are left out of the fit.
LEAST_SEEN = 1e-10


@dataclass(frozen=True)
class Pairs:
    """All N_ij of one choice of weights, laid out so that neither of their two uses loops over pairs.

    Parameters
    ----------
    stacked:
        N_ij for every i and j one below the other, (i, j) = (0, 0), (0, 1), ..., csr (M M K, K).
    where, values, counts:
        Entries of N_ij for i <= j, (0, 0), (0, 1), (1, 1), (0, 2), ...: their place in a flat (K, K), their value (halved
        for i = j), and how many each pair has.
    diagonal:
        Diagonal of sum_i N_ii, shape (K,).
    """

    stacked: sp.csr_array
    where: NDArray[np.int64]
    values: Array
    counts: NDArray[np.intp]
    diagonal: Array

    def times(self, r: Array) -> Array:
        """N_ij r, shape (M, M, K)."""
        elements = math.isqrt(self.stacked.shape[0] // r.size)
        return np.asarray((self.stacked @ r).reshape(elements, elements, r.size))

    def coarsened(self, prolongation: sp.csr_array) -> Pairs:
        """R^T N_ij R: the same of coefficients that are R times coarser ones, R of shape (K, K')."""
        size, coarse = prolongation.shape
        elements = math.isqrt(self.stacked.shape[0] // size)
        columns = sp.csr_array(self.stacked @ prolongation)
        down = sp.csr_array(prolongation.T)
        blocks = {}
        for j in range(elements):
            for i in range(j + 1):
                k = (i * elements + j) * size
                blocks[i, j] = sp.csr_array(down @ columns[k : k + size])
        return _laid_out(blocks, elements, coarse)

    def mixed(self, products: Array) -> Array:
        """sum_ij products_ij N_ij for symmetric products (M, M), dense (K, K)."""
        size = self.stacked.shape[1]
        factors = np.concatenate([products[: j + 1, j] for j in range(products.shape[0])])
        half = np.bincount(self.where, weights=self.values * np.repeat(factors, self.counts), minlength=size * size)
        square = np.asarray(half, dtype=np.float64).reshape(size, size)
        return square + square.T


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
    """

    pairs: list[Pairs]
    group: NDArray[np.intp]
    cross: Array
    energy: Array
    observations: int

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
        total = np.sum([pairs.diagonal for pairs in self.pairs], axis=0)
        return np.asarray(total / max(float(total.max(initial=0.0)), 1e-300))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which coefficients the captures see at all, shape (K,)."""
        return np.asarray(self.exposure > LEAST_SEEN)

    def gram_of_source(self, v: Array) -> Array:
        """sum_b J_b^T W J_b, dense (K, K), for v of shape (B, M)."""
        total = np.zeros((self.size, self.size))
        for g, pairs in enumerate(self.pairs):
            rows = v[self.group == g]
            total += pairs.mixed(rows.T @ rows)
        return total

    def coarsened(self, prolongation: sp.csr_array) -> Moments:
        """The moments of coefficients r' with r = R r', for R of shape (K, K'): no pass over the data is needed."""
        realisations, elements, size = self.cross.shape
        cross = (self.cross.reshape(-1, size) @ prolongation).reshape(realisations, elements, -1)
        return replace(self, pairs=[pairs.coarsened(prolongation) for pairs in self.pairs], cross=cross)


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
    return Moments(
        pairs=[_pairs(designs, weights[:, g]) for g in range(weights.shape[1])],
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


def _pairs(designs: list[sp.csr_array], weight: Array) -> Pairs:
    elements, size = len(designs), designs[0].shape[1]
    transposed = [sp.csr_array(t.T) for t in designs]
    blocks: dict[tuple[int, int], sp.csr_array] = {}
    for j, right in enumerate(designs):
        scaled = sp.csr_array(
            (right.data * np.repeat(weight, np.diff(right.indptr)), right.indices, right.indptr), right.shape
        )
        for i in range(j + 1):
            blocks[i, j] = sp.csr_array(transposed[i] @ scaled)
    return _laid_out(blocks, elements, size)


def _laid_out(blocks: dict[tuple[int, int], sp.csr_array], elements: int, size: int) -> Pairs:
    """N_ij for i <= j in the layout that their uses want."""
    where, values, diagonal = [], [], np.zeros(size)
    for j in range(elements):
        for i in range(j + 1):
            gram = blocks[i, j]
            row = np.repeat(np.arange(size, dtype=np.int64), np.diff(gram.indptr))
            where.append(row * size + gram.indices)
            if i == j:
                diagonal += gram.diagonal()
                values.append(0.5 * gram.data)
            else:
                values.append(gram.data)
    every = [blocks[i, j] if i <= j else sp.csr_array(blocks[j, i].T) for i in range(elements) for j in range(elements)]
    return Pairs(
        stacked=sp.csr_array(sp.vstack(every, format="csr")),
        where=np.concatenate(where),
        values=np.concatenate(values),
        counts=np.array([v.size for v in values]),
        diagonal=diagonal,
    )
