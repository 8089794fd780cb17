"""A capture set of order one, with its weights, the transport's kernels, and what a fit leaves of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.facets import Factor, weighted
from wallmirror.derendering.nested import Nested
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.geometry import Card
from wallmirror.transport import Kernel, build_kernel, quadrature_orders

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """A capture set normalised to order one.

    Parameters
    ----------
    data:
        D / scale, shape (P, B).
    inverse_variance:
        Weights, shape (P, B), 0 for saturated pixels; None for equal weights.
    noisy:
        Pixels whose stated variance is their noise, (P, B): neither saturated nor raised to the floor.
    noise_is_stated:
        Whether the weights are inverse variances of all noise, and not only tell which pixels count.
    exponents:
        Of the factors that the wall has beside a function of the angle sum (`facets`).
    """

    captures: CaptureSet
    data: Array
    inverse_variance: Array | None
    noisy: NDArray[np.bool_]
    noise_is_stated: bool
    scale: float
    exponents: dict[Factor, float] = field(default_factory=dict)
    _kernels: dict[tuple[int, int], Kernel] = field(default_factory=dict, init=False, repr=False, compare=False)
    _nested: dict[tuple[tuple[float, ...], float], Nested] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def card(self) -> Card:
        """The card whose pattern is sought."""
        return self.captures.card

    @cached_property
    def row_weights(self) -> Array:
        """One over the root of each row's mean variance, shape (P, 1): makes the noise of the rows alike.

        A row in which one realisation is saturated would break the rank of the data, so it weighs nothing here, as
        long as half of the rows are left.
        """
        if self.inverse_variance is None:
            return np.ones((self.data.shape[0], 1))
        used = self.inverse_variance > 0
        variance = np.divide(1.0, self.inverse_variance, out=np.zeros_like(self.inverse_variance), where=used)
        count = np.sum(used, axis=1, keepdims=True)
        mean = np.sum(variance, axis=1, keepdims=True) / np.maximum(count, 1)
        whole = count == used.shape[1] if 2 * np.count_nonzero(count == used.shape[1]) >= count.size else count > 0
        weights: Array = np.divide(1.0, np.sqrt(mean), out=np.zeros_like(mean), where=whole & (mean > 0))
        return weights

    @cached_property
    def weighted_data(self) -> Array:
        """D with weighted rows, shape (P, B)."""
        return self.row_weights * self.data

    def weighted(self, designs: list[sp.csr_array]) -> list[sp.csr_array]:
        """T_1 .. T_M with weighted rows."""
        if self.inverse_variance is None:
            return designs
        weights = self.row_weights[:, 0]
        return [
            sp.csr_array((t.data * np.repeat(weights, np.diff(t.indptr)), t.indices, t.indptr), t.shape)
            for t in designs
        ]

    @cached_property
    def fit_weights(self) -> Array:
        """w of the misfit sum w (D - F V)^2: shape (P, B), or (P, 1) where all realisations share them."""
        if self.inverse_variance is None:
            return np.ones((self.data.shape[0], 1))
        first = self.inverse_variance[:, :1]
        return first if np.all(self.inverse_variance == first) else self.inverse_variance

    def kernel(self, step_deg: float, tolerance: float) -> Kernel:
        """The transport's kernel with a quadrature to match one knot spacing; the last one is kept for others like it."""
        observer, card, weights = self.captures.observer, self.captures.card, self.captures.transport
        orders = quadrature_orders(
            observer, card, weights=weights, resolution=2 * math.radians(step_deg), tolerance=tolerance
        )
        if orders not in self._kernels:
            self._kernels.clear()
            self._kernels[orders] = build_kernel(observer, card, weights=weights, orders=orders)
        return weighted(self._kernels[orders], self.exponents)

    def nested(self, steps: tuple[float, ...], quadrature: float, *, keep: bool = False) -> Nested:
        """Nested grids of these knot spacings in degrees; kept ones are handed over to whom asks for the same next."""
        found = self._nested.pop((steps, quadrature), None)
        if found is None:
            found = Nested.of(self.data, self.inverse_variance, self.kernel, steps, quadrature)
        if keep:
            self._nested[steps, quadrature] = found
        return found

    def designs(self, step_deg: float, *, degree: int, tolerance: float) -> tuple[SplineGrid, list[sp.csr_array]]:
        """The spline grid of one knot spacing and the transport over it, with quadrature to match."""
        kernel = self.kernel(step_deg, tolerance)
        grid = grid_for(kernel, step=math.radians(step_deg), degree=degree)
        return grid, design_matrices(kernel, grid)


def reduced_misfit(problem: Problem, transport: Array, source: Array, parameters: int) -> float:
    """Weighted squares of D - F V over the noisy pixels, per degree of freedom: 1 where model and stated noise are right.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B).
    parameters:
        Free numbers of the fit.
    """
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ source) ** 2, 0.0)
    return float(np.sum(counted)) / max(1, int(np.count_nonzero(problem.noisy)) - parameters)


def smoothness(problem: Problem, transport: Array, source: Array) -> float:
    """Correlation of neighbouring pixels in D - F V: near 0 where it is noise, near 1 where the model misses the films.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B).
    """
    missed = (problem.row_weights * (problem.data - transport @ source)).reshape(problem.captures.radiance.shape)
    return float(np.sum(missed[:, 1:] * missed[:, :-1]) / max(float(np.sum(missed**2)), 1e-300))
