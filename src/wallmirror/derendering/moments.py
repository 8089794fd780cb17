"""The data in coefficient space: what the likelihood needs of them, after one pass over the pixels.

With inverse variances w on the diagonal of W the misfit sum w (D - F V)^2 depends on the data only through

    N_ij = T_i^T W T_j,      X_ib = T_i^T W d_b,      sum_p w d^2,

so that an iteration of a fit does not touch the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Cells whose Fisher information lies this far below the best-seen cell's are left out of the fit.
_SEEN = 1e-10


@dataclass(frozen=True)
class Moments:
    """The data in coefficient space.

    Parameters
    ----------
    grams:
        N_ij for i <= j and each group of realisations that share weights, csr (K, K).
    group:
        Group of each realisation, shape (B,).
    cross:
        X, shape (B, M, K).
    energy:
        sum_p w d^2 of each realisation, shape (B,).
    observations:
        Number of data with weight > 0.
    """

    grams: list[dict[tuple[int, int], sp.csr_array]]
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
        total = np.zeros(self.size)
        for grams in self.grams:
            for i in range(self.elements):
                total += grams[i, i].diagonal()
        return total / max(float(total.max(initial=0.0)), 1e-300)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which coefficients the captures see at all, shape (K,)."""
        return np.asarray(self.exposure > _SEEN)

    def gram_of_source(self, v: Array) -> Array:
        """sum_b J_b^T W J_b, dense (K, K), for v of shape (B, M)."""
        total = np.zeros((self.size, self.size))
        for g, grams in enumerate(self.grams):
            rows = v[self.group == g]
            products = rows.T @ rows
            for (i, j), gram in grams.items():
                coo = gram.tocoo()
                row, column = coo.coords
                total[row, column] += products[i, j] * coo.data
                if i != j:
                    total[column, row] += products[i, j] * coo.data
        return total


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
    grams = [_grams(designs, weights[:, g]) for g in range(weights.shape[1])]
    return Moments(
        grams=grams,
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


def _grams(designs: list[sp.csr_array], weight: Array) -> dict[tuple[int, int], sp.csr_array]:
    grams = {}
    for j, right in enumerate(designs):
        scaled = right.copy()
        scaled.data = scaled.data * np.repeat(weight, np.diff(scaled.indptr))
        for i in range(j + 1):
            grams[i, j] = sp.csr_array(designs[i].T @ scaled)
    return grams
