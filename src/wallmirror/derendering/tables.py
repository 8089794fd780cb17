"""A BRDF of both angles as a table of tensor-product B-splines: its knots, its rows in a design matrix, its values."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from wallmirror.brdf import BRDF
from wallmirror.derendering.splines import SplineGrid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TableGrid:
    """Tensor-product splines over both angles.

    Parameters
    ----------
    theta_s, theta_o:
        The knots along each angle; the same ones for a reciprocal table.
    reciprocal:
        Whether r_kl = r_lk, so that only the pairs k <= l are unknowns.
    """

    theta_s: SplineGrid
    theta_o: SplineGrid
    reciprocal: bool = False

    @property
    def size(self) -> int:
        """Number of unknown coefficients."""
        n = self.theta_s.size
        return n * (n + 1) // 2 if self.reciprocal else n * self.theta_o.size

    @cached_property
    def unknown(self) -> NDArray[np.intp]:
        """Which unknown each cell (k, l) of the table takes its coefficient from, shape (K_s, K_o)."""
        shape = self.theta_s.size, self.theta_o.size
        if not self.reciprocal:
            return np.arange(shape[0] * shape[1]).reshape(shape)
        unknown = np.zeros(shape, dtype=np.intp)
        rows, columns = np.triu_indices(shape[0])
        unknown[rows, columns] = unknown[columns, rows] = np.arange(rows.size)
        return unknown

    def rows(self, theta_s: Array, theta_o: Array, weight: Array) -> sp.csr_array:
        """sum over the last axis of weight phi_k phi_l, as a sparse matrix (rows, size); inputs (rows, nodes)."""
        count, nodes = weight.shape
        first_s, values_s = self.theta_s.basis(theta_s)
        first_o, values_o = self.theta_o.basis(theta_o)
        k = first_s + np.arange(self.theta_s.degree + 1)[:, None, None]
        l = first_o + np.arange(self.theta_o.degree + 1)[:, None, None]  # noqa: E741
        columns = self.unknown[k[:, None], l[None]]
        data = weight * values_s[:, None] * values_o[None]
        row = np.broadcast_to(np.arange(count)[:, None], (count, nodes))
        index = np.broadcast_to(row, data.shape)
        return sp.csr_array(sp.coo_array((data.ravel(), (index.ravel(), columns.ravel())), shape=(count, self.size)))


@dataclass(frozen=True, kw_only=True)
class SplineTable(BRDF):
    """A recovered BRDF of both angles.

    Parameters
    ----------
    grid:
        Its knots.
    coefficients:
        r, shape (grid.size,), in the gauge where the largest value that the captures saw is 1.
    determined:
        Whether the captures, and not the ridge, decide the value, at uniform nodes from end to end of both knot ranges,
        shape (n_s, n_o).
    """

    grid: TableGrid
    coefficients: Array = field(repr=False)
    determined: NDArray[np.bool_] = field(repr=False)

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value, broadcast over two arrays of angles in radians; beyond the knots that at their end, NaN where one is NaN."""
        s, o = np.broadcast_arrays(np.asarray(theta_s, dtype=np.float64), np.asarray(theta_o, dtype=np.float64))
        known = ~(np.isnan(s) | np.isnan(o))
        s, o = (np.where(known, angles, 0.0).reshape(-1, 1) for angles in (s, o))
        values = self.grid.rows(s, o, np.ones(s.shape)) @ self.coefficients
        return np.where(known, np.asarray(values, dtype=np.float64).reshape(known.shape), np.nan)

    def seen(self, theta_s: ArrayLike, theta_o: ArrayLike) -> NDArray[np.bool_]:
        """Whether the captures, and not the ridge, decide the value there (at the nearest node)."""
        near_s, inside_s = _node(self.grid.theta_s, theta_s, self.determined.shape[0])
        near_o, inside_o = _node(self.grid.theta_o, theta_o, self.determined.shape[1])
        return np.asarray(inside_s & inside_o & self.determined[near_s, near_o])

    @property
    def angular_scale(self) -> float:
        """Spacing of the finer knots in radians."""
        return min(self.grid.theta_s.step, self.grid.theta_o.step)


def _node(grid: SplineGrid, angle: ArrayLike, nodes: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The nearest of the uniform nodes over a knot range, and whether the angle lies in that range."""
    place = (np.asarray(angle, dtype=np.float64) - grid.start) / (grid.stop - grid.start)
    nearest = np.clip(np.rint(np.where(np.isnan(place), 0.0, place) * (nodes - 1)), 0, nodes - 1).astype(np.intp)
    return nearest, np.asarray((place >= 0) & (place <= 1))
