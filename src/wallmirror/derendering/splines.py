"""The unknown BRDF as a uniform B-spline in the angle sum, and the transport as sparse matrices over it.

With rho(u) = sum_k r_k phi_k(u) the transport of each element is linear in r: F[:, i] = T_i r, where T_i
(P x K) sums the kernel's weight times phi_k over the quadrature nodes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.special import binom

from wallmirror.memory import design_bytes, require_memory
from wallmirror.transport import Kernel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SplineGrid:
    """K uniform B-splines of one degree that cover [start, start + intervals * step].

    Parameters
    ----------
    start, step:
        First knot interval's beginning and the intervals' length, in radians.
    intervals:
        Number of knot intervals covered.
    degree:
        Polynomial degree; K = intervals + degree.
    """

    start: float
    step: float
    intervals: int
    degree: int

    @classmethod
    def covering(cls, low: float, high: float, *, step: float, degree: int) -> SplineGrid:
        """The grid of the given step whose intervals contain [low, high], in radians."""
        intervals = max(1, math.ceil((high - low) / step * (1 + 1e-12) + 1e-9))
        return cls(start=0.5 * (low + high) - 0.5 * intervals * step, step=step, intervals=intervals, degree=degree)

    @property
    def size(self) -> int:
        """K, the number of coefficients."""
        return self.intervals + self.degree

    @property
    def stop(self) -> float:
        """End of the covered range in radians."""
        return self.start + self.intervals * self.step

    def basis(self, u: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        """First index and the degree + 1 non-zero values at each u; shapes u.shape and (degree + 1, *u.shape).

        The pieces of the cardinal B-spline as polynomials in the place within the interval, seen from its middle, where
        they lose no more than a rounding; angles outside the grid are clipped to its ends.
        """
        place = np.clip((np.asarray(u, dtype=np.float64) - self.start) / self.step, 0.0, self.intervals)
        first = np.minimum(place.astype(np.intp), self.intervals - 1)
        powers = np.empty((self.degree + 1, *place.shape))
        powers[0] = 1.0
        if self.degree > 0:
            np.subtract(place, first + 0.5, out=powers[1, ...])
        for k in range(2, self.degree + 1):
            np.multiply(powers[k - 1], powers[1], out=powers[k, ...])
        values = _pieces(self.degree) @ powers.reshape(self.degree + 1, -1)
        return first, values.reshape(powers.shape)

    def interpolate(self, function: Callable[[Array], Array]) -> Array:
        """Coefficients that reproduce a smooth function closely (Schoenberg: its values at the supports' middles)."""
        middles = self.start + (np.arange(self.size) + 0.5 * (1 - self.degree)) * self.step
        return function(np.asarray(middles, dtype=np.float64))

    def halved(self) -> SplineGrid:
        """The grid over the same range with a knot in the middle of every interval, among whose splines are all of this."""
        return replace(self, step=self.step / 2, intervals=2 * self.intervals)

    def in_halved(self) -> sp.csr_array:
        """R, sparse (K', K): coefficients r of this grid are R r on the `halved` one.

        The two-scale relation of uniform B-splines (de Boor, A Practical Guide to Splines, 1978): each is the sum of
        degree + 2 of half the width, with binomial coefficients over 2^degree.
        """
        k, j = np.arange(self.size)[:, None], np.arange(self.degree + 2)
        finer = 2 * k - self.degree + j
        weights = np.broadcast_to(binom(self.degree + 1, j) / 2.0**self.degree, finer.shape)
        size = self.halved().size
        inside = (finer >= 0) & (finer < size)  # the others vanish on the range
        coarse = np.broadcast_to(k, finer.shape)
        return sp.csr_array((weights[inside], (finer[inside], coarse[inside])), shape=(size, self.size))

    def overlaps(self) -> Array:
        """Inner products of a spline with those 0, 1, .., degree knots beside it, over its own square, shape (degree + 1,).

        They are the values of the spline of degree 2 degree + 1 at its knots.
        """
        order = 2 * self.degree + 1
        at_knots = SplineGrid(start=0.0, step=1.0, intervals=1, degree=order).basis(0.0)[1]
        return np.asarray(at_knots[self.degree : order] / at_knots[self.degree])

    def row(self, u: float) -> Array:
        """Values of all K basis functions at one angle sum, shape (K,)."""
        first, values = self.basis(np.array([u]))
        row = np.zeros(self.size)
        row[first[0] : first[0] + self.degree + 1] = values[:, 0]
        return row

    def peak(self, coefficients: ArrayLike, exposure: ArrayLike) -> float:
        """Angle sum in radians of the largest value where the data speak, searched from 8 samples a knot interval.

        Parameters
        ----------
        coefficients:
            r, shape (K,).
        exposure:
            How well each coefficient is seen, 1 for the best-seen, shape (K,); a value that hangs on a coefficient
            seen a thousand times less may be anything and is no peak.
        """
        u = np.linspace(self.start, self.stop, 8 * self.intervals + 1)
        first, values = self.basis(u)
        blind = np.asarray(exposure) < 1e-3
        trusted = ~np.any(blind[first + np.arange(self.degree + 1)[:, None]] & (values > 1e-3), axis=0)
        candidates = np.where(trusted, self.evaluate(coefficients, u), -np.inf)
        best = float(u[np.argmax(candidates)])
        around = (max(self.start, best - self.step / 8), min(self.stop, best + self.step / 8))
        refined = minimize_scalar(
            lambda x: -float(self.evaluate(coefficients, x)), bounds=around, method="bounded", options={"xatol": 1e-9}
        )
        return float(refined.x)

    def evaluate(self, coefficients: ArrayLike, u: ArrayLike) -> Array:
        """rho(u), same shape as u, zero outside the grid."""
        u = np.asarray(u, dtype=np.float64)
        first, values = self.basis(u)
        r = np.asarray(coefficients, dtype=np.float64)
        total = np.zeros(u.shape)
        for k in range(self.degree + 1):
            total += r[first + k] * values[k]
        return np.where((u >= self.start) & (u <= self.stop), total, 0.0)


@functools.cache
def _pieces(degree: int) -> Array:
    """Coefficients of 1, x, x^2, ... of the degree + 1 splines over an interval that x runs through from -1/2 to 1/2.

    The recursion of Cox and de Boor in fractions, so that what it cancels costs no digit.
    """
    pieces = [[Fraction(1)]]
    for k in range(1, degree + 1):
        before, pieces = [[], *pieces, []], []
        for r in range(k + 1):
            # With t = x + 1/2: [(t + k - r) b_(r-1) + (1 + r - t) b_r] / k.
            left, right = (piece + [Fraction(0)] * (k - len(piece)) for piece in before[r : r + 2])
            rise, fall = Fraction(2 * (k - r) + 1, 2), Fraction(2 * r + 1, 2)
            piece = [(rise * a + fall * b) / k for a, b in zip(left, right, strict=True)] + [Fraction(0)]
            for power, (a, b) in enumerate(zip(left, right, strict=True)):
                piece[power + 1] += (a - b) / k
            pieces.append(piece)
    return np.array(pieces, dtype=np.float64)


def grid_for(kernel: Kernel, *, step: float, degree: int) -> SplineGrid:
    """The grid that covers every angle sum of a kernel."""
    u = kernel.theta_s + kernel.theta_o
    return SplineGrid.covering(float(u.min()), float(u.max()), step=step, degree=degree)


def design_matrices(kernel: Kernel, grid: SplineGrid) -> list[sp.csr_array]:
    """T_1 .. T_M, each sparse (P, K) with P = A N, such that F[:, i] = T_i r; InputError if memory does not hold them."""
    views, pixels, elements, nodes = kernel.weight.shape
    require_memory(
        design_bytes(views, pixels, elements, nodes, degree=grid.degree, knots=grid.size),
        f"the solver's {grid.size} knots at {views} views x {pixels} pixels x {elements} elements x {nodes} nodes",
    )
    rows = views * pixels
    u, weight = kernel.angle_sum, kernel.weight
    matrices = []
    for i in range(elements):  # one at a time, since its nodes and what the recursion makes of them fit into a cache
        first, values = grid.basis(u[:, :, i].reshape(rows, nodes))
        values *= weight[:, :, i].reshape(rows, nodes)
        matrices.append(_banded_rows(first, values, grid.size))
    return matrices


def transport_of(designs: list[sp.csr_array], r: Array) -> Array:
    """F = [T_1 r .. T_M r], shape (P, M)."""
    return np.stack([t @ r for t in designs], axis=1)


def exposures(designs: list[sp.csr_array], weights: Array) -> Array:
    """sum_p w_p T_i[p, k]^2 of each element and coefficient, shape (M, K), for w of shape (P,)."""
    squares = (sp.csr_array((t.data * t.data, t.indices, t.indptr), t.shape) for t in designs)
    return np.stack([t.T @ weights for t in squares])


def _banded_rows(columns: NDArray[np.intp], weighted: Array, size: int) -> sp.csr_array:
    """Sum the nodes of each row into one contiguous run of columns; all rows get runs of the same length."""
    order, rows, nodes = weighted.shape
    begin = columns.min(axis=1)
    width = int((columns.max(axis=1) - begin).max()) + order
    width = min(width, size)
    begin = np.minimum(begin, size - width)
    if nodes == 1 and width == order:
        data = weighted[:, :, 0].T
    elif nodes == 1:
        data = np.zeros((rows, width))
        offset = columns[:, 0] - begin
        data[np.arange(rows)[:, None], offset[:, None] + np.arange(order)] = weighted[:, :, 0].T
    else:
        flat = np.zeros(rows * width)
        base = (np.arange(rows) * width - begin)[:, None] + columns
        for k in range(order):
            flat += np.bincount((base + k).ravel(), weights=weighted[k].ravel(), minlength=rows * width)
        data = flat.reshape(rows, width)
    narrow = np.int32 if rows * width < np.iinfo(np.int32).max else np.int64
    indices = begin.astype(narrow)[:, None] + np.arange(width, dtype=narrow)
    pointers = np.arange(rows + 1, dtype=narrow) * narrow(width)
    return sp.csr_array((data.ravel(), indices.ravel(), pointers), shape=(rows, size))
