"""What any BRDF on some knots could make of any pattern: the span of T_1 .. T_M, and the films' projection onto it.

All of F V lies in that span, whose dimension is at most M K; noise fills all P dimensions. The projection leaves the signal
and takes all but M K / P of the noise's power away, so that patterns stand out which drown in the films as they are.

A pixel looks at few columns, and pixels beside each other at nearly the same ones. So the Gram matrix is a band once its
columns are in a good order, and a Cholesky factorisation that pivots within a few hundred columns at a time never looks
beyond the band. It must pivot within as many as the band is wide: where it sees a few angles of very many elements only,
the columns that it keeps say those further ahead by extrapolation, which multiplies rounding from piece to piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from wallmirror.derendering.moments import Moments
from wallmirror.derendering.subspace import SignalSpace, noise_edge
from wallmirror.memory import require_memory, span_bytes

Array = NDArray[np.float64]

# Columns among which the factorisation pivots, at least.
_TOGETHER = 256
# A column of which less than this share of the largest one's square is left beside those before it spans nothing new.
_NEW = 1e-10
# The span's weakest directions are known to the root of that, no better.
_ROUNDING = 1e-7


@dataclass(frozen=True)
class Span:
    """What the projection onto the columns S = [T_1 .. T_M], n = M K of them, needs of them and of the films.

    Parameters
    ----------
    rows:
        P.
    gram, right:
        S^T S, sparse (n, n), and S^T D, shape (n, B), of rows weighted so that the noise of all is alike.
    energy:
        sum D^2.
    """

    rows: int
    gram: sp.csr_array
    right: Array
    energy: float

    @classmethod
    def of(cls, summed: Moments, rows: int) -> Span:
        """From the moments of P rows of films whose realisations share their weights; InputError where it is too large."""
        (pairs,) = summed.pairs
        require_memory(
            span_bytes(2 * pairs.above.nnz), f"the span of {summed.elements} elements on {summed.size} knots"
        )
        right = summed.cross.transpose(1, 2, 0).reshape(summed.elements * summed.size, -1)
        return cls(rows, pairs.whole(), right, float(np.sum(summed.energy)))

    def projected(self, elements: int, *, noise: float | None) -> Projected:
        """The films' projection.

        Parameters
        ----------
        elements:
            Patterns that are sought.
        noise:
            Standard deviation of the noise; None to estimate it from what the projection takes away.
        """
        basis = _Basis.of(self.gram)
        projected = basis.projected(self.right)
        left, singular, _ = np.linalg.svd(projected, full_matrices=False)
        dimensions = projected.shape[0]
        if noise is None:
            rest = max(0.0, self.energy - float(np.sum(projected * projected)))
            noise = math.sqrt(rest / max(1, (self.rows - dimensions) * self.right.shape[1]))
        floor = noise * noise_edge(dimensions, self.right.shape[1])
        rank = int(np.count_nonzero(singular[:elements] > max(_ROUNDING * singular[0], floor)))
        return Projected(basis, left[:, :elements], singular, rank, dimensions)


@dataclass(frozen=True)
class Projected:
    """The films' projection onto a span, in coordinates of its basis Q.

    Parameters
    ----------
    left:
        Q^T U, shape (dimensions, M).
    singular_values, rank, dimensions:
        As those of a `SignalSpace`.
    """

    basis: _Basis
    left: Array
    singular_values: Array
    rank: int
    dimensions: int

    def space(self, designs: list[sp.csr_array], row_weights: Array, prolongation: sp.csr_array) -> SignalSpace:
        """U itself, by a pass over the pixels.

        Parameters
        ----------
        designs, row_weights:
            T_1 .. T_M (P, K), and what their rows are weighted with, (P, 1).
        prolongation:
            R of shape (K, K') from the knots of the span to those of the designs.
        """
        parts = np.split(self.basis.combined(self.left), len(designs))
        films = sum(t @ (prolongation @ part) for t, part in zip(designs, parts, strict=True))
        return SignalSpace(row_weights * films, self.singular_values, self.rank, self.dimensions)


@dataclass(frozen=True)
class _Basis:
    """An orthonormal basis Q = S C of the span: C^-T is a lower triangle, kept piece by piece.

    Parameters
    ----------
    order:
        Of the columns of S.
    pieces:
        Of each few hundred columns in that order: the kept ones' places, their triangle L, and L^-1 times the part of the
        Gram matrix that is left between them and the columns ahead, from `stop` on.
    """

    order: NDArray[np.intp]
    pieces: list[tuple[NDArray[np.intp], Array, Array, int]]

    @classmethod
    def of(cls, gram: sp.csr_array, together: int | None = None) -> _Basis:
        """From S^T S, pivoting among so many columns; among as many as the band reaches, if left out."""
        order = np.asarray(reverse_cuthill_mckee(gram, symmetric_mode=True), dtype=np.intp)
        ordered = sp.csr_array(gram[order][:, order])
        row, column = ordered.tocoo().coords
        size, reach = order.size, int(np.max(row - column, initial=0))
        together = max(_TOGETHER, reach) if together is None else together
        require_memory(
            span_bytes(ordered.nnz, size, reach, together), f"the span of {size} columns in a band of {reach}"
        )
        least = _NEW * float(np.max(ordered.diagonal(), initial=0.0))
        pieces = []
        left = np.zeros((0, 0))  # what is left of the Gram matrix between the columns from `start` on, up to the reach
        for start in range(0, size, together):
            stop, end = min(start + together, size), min(start + together + reach, size)
            before, left = left, ordered[start:end, start:end].toarray()
            left[: len(before), : len(before)] = before
            here = stop - start
            factor, pivots, rank, _ = lapack.dpstrf(left[:here, :here], lower=True, tol=least)
            kept, triangle = pivots[:rank] - 1, factor[:rank, :rank]
            further = sl.solve_triangular(triangle, left[kept, here:], lower=True, check_finite=False)
            left = left[here:, here:] - further.T @ further
            pieces.append((start + kept, triangle, further, stop))
        return cls(order, pieces)

    def projected(self, right: Array) -> Array:
        """Q^T D from S^T D (n, B)."""
        right, found = right[self.order], []
        for kept, triangle, further, stop in self.pieces:
            found.append(sl.solve_triangular(triangle, right[kept], lower=True, check_finite=False))
            right[stop : stop + further.shape[1]] -= further.T @ found[-1]
        return np.concatenate(found)

    def combined(self, coordinates: Array) -> Array:
        """C x, shape (n, m): how S makes Q x of coordinates x (dimensions, m)."""
        found = np.zeros((self.order.size, coordinates.shape[1]))
        end = coordinates.shape[0]
        for kept, triangle, further, stop in reversed(self.pieces):
            missing = coordinates[end - kept.size : end] - further @ found[stop : stop + further.shape[1]]
            found[kept] = sl.solve_triangular(triangle, missing, lower=True, trans="T", check_finite=False)
            end -= kept.size
        combined = np.empty_like(found)
        combined[self.order] = found
        return combined
