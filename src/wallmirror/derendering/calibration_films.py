"""The card's place as an unknown: the captures at one resolution, the card moved by g, and the closed form there.

The geometry g = (offset / distance, log distance, log width) is counted from the card as given, so that g = 0 is that card.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid, design_matrices, transport_of
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, banded_gram, closed_form, signal_space
from wallmirror.errors import InputError
from wallmirror.geometry import Card
from wallmirror.transport import Kernel, build_kernel

Array = NDArray[np.float64]

# Step of the central differences in g: their error, (step / lobe width)^2, only slows the convergence.
_DIFFERENCE = 1e-5


def moved(card: Card, offset: float, distance: float, width: float) -> Card:
    """The card shifted by `offset` metres, its distance and its width multiplied by positive factors.

    Raises
    ------
    InputError
        For a factor that is not positive, and where the card would lie beyond what lengths may be.
    """
    for name, factor in (("distance", distance), ("width", width)):
        if not factor > 0:
            raise InputError(f"is {factor:g}; give a factor above 0", field=name)
    x = np.asarray(card.elements_x)
    centre = float(x.mean())
    return dataclasses.replace(
        card,
        elements_x=tuple(map(float, centre + offset + width * (x - centre))),
        y=card.y * distance,
        element_width=card.element_width * width,
        board_width=card.board_width * width,
    )


def card_at(card: Card, g: Array) -> Card:
    """The card given, moved to the geometry g of shape (3,)."""
    return moved(card, card.distance * float(g[0]), math.exp(float(g[1])), math.exp(float(g[2])))


@dataclass(frozen=True)
class Films:
    """The captures at one resolution: which rows, how blurred, over which knots.

    Parameters
    ----------
    step, degree:
        Knot spacing in radians and degree of the splines.
    data, weight:
        The kept rows with their weights, of order one, shape (P', B), and these weights, shape (P', 1).
    pixels, views:
        Which pixels of which views those are.
    """

    problem: Problem
    step: float
    degree: int
    data: Array
    weight: Array
    pixels: slice
    views: NDArray[np.intp]

    @classmethod
    def at(cls, problem: Problem, blur_deg: float, step_deg: float, degree: int, rows: int | None) -> Films:
        """Blur along the pixels, leave out what the blur did not reach, and keep about as many rows as wanted (None: all)."""
        observer = problem.captures.observer
        films = problem.data.reshape(observer.views, observer.pixels, -1)
        weight = problem.row_weights.reshape(observer.views, observer.pixels, 1)
        pitch = math.degrees(observer.fov) / observer.pixels
        width = blur_deg / pitch
        cut = 0
        if width > 0.5:
            # Rows without weight (saturated) take no part in the blur.
            used = (weight > 0).astype(np.float64)
            share = gaussian_filter1d(used, width, axis=1, truncate=3.0)
            films = gaussian_filter1d(used * films, width, axis=1, truncate=3.0) / np.maximum(share, 0.5)
            weight = np.asarray(share > 0.5, dtype=np.float64)
            cut = min(int(2 * width), observer.pixels // 4)
        stride = max(1, int(step_deg / (4 * pitch))) if rows is not None else 1
        pixels = slice(cut, observer.pixels - cut, stride)
        per_view = len(range(*pixels.indices(observer.pixels)))
        kept = min(observer.views, max(3, rows // per_view)) if rows is not None else observer.views
        views = np.unique(np.linspace(0, observer.views - 1, kept).round().astype(np.intp))
        kept_weight: Array = weight[views, pixels].reshape(-1, 1)
        data = kept_weight * films[views, pixels].reshape(kept_weight.shape[0], -1)
        scale = max(float(np.abs(data).max(initial=0.0)), 1e-300)
        return cls(problem, math.radians(step_deg), degree, data / scale, kept_weight, pixels, views)

    @cached_property
    def space(self) -> SignalSpace:
        """The space of the patterns in these films."""
        return signal_space(self.data, self.problem.card.elements)

    def kernel(self, g: Array) -> Kernel:
        """The kernel of the kept rows with the card at g."""
        captures = self.problem.captures
        observer = dataclasses.replace(
            captures.observer, view_angles=tuple(captures.observer.view_angles[a] for a in self.views)
        )
        kernel = build_kernel(
            observer,
            card_at(captures.card, g),
            weights=captures.transport,
            resolution=2 * self.step,
            tolerance=1e-9 if self.degree > 3 else 1e-5,
        )
        s, o, weight = (
            np.broadcast_to(a, kernel.weight.shape)[:, self.pixels]
            for a in (kernel.theta_s, kernel.theta_o, kernel.weight)
        )
        return Kernel(s, o, weight)

    def grid(self, kernel: Kernel, margin: float) -> SplineGrid:
        """Knots over all angle sums and a margin in radians, as g changes a little without them."""
        u = kernel.angle_sum
        return SplineGrid.covering(float(u.min()) - margin, float(u.max()) + margin, step=self.step, degree=self.degree)

    def slopes(
        self, g: Array, free: tuple[int, ...], grid: SplineGrid, coefficients: Array, *, central: bool = True
    ) -> Array:
        """D_j = d(T r) / dg_j at fixed r by differences, unweighted, shape (J, P', M); one-sided ones are quicker."""

        def transport(at: Array) -> Array:
            kernel = self.kernel(at)
            values: Array = np.sum(kernel.weight * grid.evaluate(coefficients, kernel.angle_sum), axis=-1)
            return values.reshape(-1, values.shape[-1])

        step = _DIFFERENCE if central else _DIFFERENCE / 100
        here = transport(g) if not central else None
        slopes = []
        for j in free:
            aside = np.zeros(3)
            aside[j] = step
            ahead = transport(g + aside)
            slopes.append((ahead - here) / step if here is not None else (ahead - transport(g - aside)) / (2 * step))
        return np.stack(slopes)


@dataclass(frozen=True)
class Point:
    """The closed form at one geometry g, shape (3,), and how many steps led there."""

    g: Array
    films: Films
    grid: SplineGrid
    designs: list[sp.csr_array]
    closed: ClosedForm
    steps: int

    @classmethod
    def at(cls, films: Films, g: Array, steps: int = 0) -> Point:
        kernel = films.kernel(g)
        grid = films.grid(kernel, 100 * _DIFFERENCE)
        designs = design_matrices(kernel, grid)
        if np.any(films.weight != 1):
            designs = [sp.csr_array(t.multiply(films.weight)) for t in designs]
        return cls(g, films, grid, designs, closed_form(films.data, designs, films.space), steps)

    @property
    def mismatch(self) -> float:
        """1 - lambda_1."""
        return self.closed.mismatch

    @property
    def merit(self) -> float:
        """(1 - lambda_1) / (1 - lambda_2), to be made least.

        Where hardly any angle sum belongs to two elements, every BRDF explains its part of the captures, and the second
        best as well as the best: a small mismatch alone is no merit.
        """
        return self.closed.mismatch / max(self.closed.gap, self.closed.mismatch, 1e-300)

    def curvature(self, free: tuple[int, ...], *, central: bool = False) -> tuple[Array, Array, Array]:
        """Half the gradient (J,), half the Gauss-Newton Hessian (J, J) of the mismatch with r eliminated, and |D_j|^2."""
        u, r = self.films.space.basis, self.closed.coefficients
        slopes = self.films.weight * self.films.slopes(self.g, free, self.grid, r, central=central)
        beyond = slopes - u @ (u.T @ slopes)
        columns = transport_of(self.designs, r)  # sum of squares 1
        gradient = np.einsum("jpm,pm->j", slopes, columns - u @ (u.T @ columns) - self.mismatch * columns)
        cross = np.zeros((r.size, len(free)))
        along = np.zeros(r.size)
        for i, t in enumerate(self.designs):
            cross += t.T @ (beyond[:, :, i] - self.mismatch * slopes[:, :, i]).T
            along += t.T @ columns[:, i]
        cross -= np.outer(along, r @ cross)  # off r, which is the scale
        answer = self._pseudo_solve(cross)
        answer -= np.outer(r, along @ answer)
        hessian = np.einsum("jpm,kpm->jk", beyond, beyond) - cross.T @ answer
        return gradient, 0.5 * (hessian + hessian.T), np.einsum("jpm,jpm->j", slopes, slopes)

    def _pseudo_solve(self, right: Array) -> Array:
        """(A - H^T H)^+ right for a right-hand side orthogonal to r, by Woodbury's identity around the banded A."""
        band = banded_gram(self.designs)
        band[0] += 1e-13 * band[0].max()
        factor = (sl.cholesky_banded(band, lower=True, check_finite=False), True)
        stacked = np.concatenate([(t.T @ self.films.space.basis).T for t in self.designs])  # H
        spread = sl.cho_solve_banded(factor, stacked.T, check_finite=False)
        values, vectors = np.linalg.eigh(stacked @ spread)
        first = sl.cho_solve_banded(factor, right, check_finite=False)
        rest = vectors[:, :-1]  # the last vector is r's
        second = rest @ ((rest.T @ (stacked @ first)) / np.maximum(1 - values[:-1], 1e-15)[:, None])
        return np.asarray(first + spread @ second, dtype=np.float64)


@dataclass(frozen=True)
class Found:
    """A geometry, its covariance and how it was found.

    Parameters
    ----------
    g, covariance:
        Shapes (3,) and (J, J) over the J parameters that were sought.
    step_deg, steps:
        Knot spacing in degrees, and the steps taken on the raw films.
    excess:
        Misfit over what the noise alone would leave.
    """

    g: Array
    covariance: Array
    step_deg: float
    steps: int
    method: str
    excess: float = 1.0
