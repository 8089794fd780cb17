"""Where the card really stood: its offset, distance and width recovered from the captures together with pattern and BRDF.

A card that is not where the solver believes it leaves a mismatch 1 - lambda_1 in the closed form (`subspace`), so that
the geometry g = (offset, log distance, log width) which makes it least is the card's. With R_i = (I - U U^T) T_i(g) r
the residual of the closed form and D_j = d(T r)/dg_j, the Gauss-Newton step that keeps r at its optimum (variable
projection; Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973) solves

    [D^T P D - X^T (A - H^T H)^+ X] dg = -D^T (R - mismatch T r),      X_j = sum_i T_i^T (P - mismatch) D_ij,

with P = I - U U^T on each element's rows, and A, H as in `closed_form`. The valley of narrow lobes is as wide as the
lobes, so the search begins on films blurred along the pixels, over a lattice of geometries, and ends on the raw ones.

Under noise the maximum of the likelihood follows. F is linear in (r, D's coefficients dg) around the last geometry, so
that the same fit (`likelihood`) climbs in both when the D_j stand beside the T_i, and the same bound (`bounds`) gives
the error bars of the joint problem.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from threadpoolctl import threadpool_limits

from wallmirror.captures import CaptureSet
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.likelihood import Fit, maximise, moments
from wallmirror.derendering.problem import Problem, prepare
from wallmirror.derendering.splines import SplineGrid, design_matrices
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, banded_gram, closed_form, signal_space
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.geometry import Card
from wallmirror.transport import Kernel, build_kernel

Array = NDArray[np.float64]

Parameter = Literal["x", "y", "width"]

_NAMES: tuple[Parameter, ...] = get_args(Parameter)
_WORDS = {"x": "offset", "y": "distance", "width": "width"}
# Blur and knot spacing in degrees, rows wanted, points kept and steps taken of the stages that lead into the valley.
_SEARCH = ((2.0, 2.0, 500, 6, 3), (1.0, 1.0, 1000, 3, 5), (0.5, 0.5, 2000, 2, 6))
_EXACT_STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)
_EXACT_ROWS = 10_000
_NOISY_STEPS = (1.0, 0.5, 0.25)
# Spacing of the lattice in radians of theta_s: a blur of 2 deg makes valleys of about twice that.
_LATTICE = 0.2
_MAX_LATTICE = 12
# A mismatch that calls for another search, unless the noise makes it.
_UNEXPLAINED = 0.01
# As in `solve`: below this mismatch there is no noise, and at the second one rounding is all that is left.
_NOISELESS = 1e-15
_EXACT = 3e-23
# Step of the central differences in g: their error, (step / lobe width)^2, only slows the convergence.
_DIFFERENCE = 1e-5
# A standard deviation of this share of the distance (or of the width) means that the captures know nothing of it.
_UNTOLD = 0.3
_LOST = 1e-13
# The likelihood's steps in g: the longest one, how many, and the share of an error bar at which they end.
_LONGEST = 0.1
_MAX_STEPS = 8
_SETTLED = 0.01


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Where the card stood.

    Parameters
    ----------
    card:
        The card moved to where the captures put it; goes into a solve.
    values:
        Centre "x", "y" and "width" (from the first element's centre to the last's) of that card in metres, for the
        parameters that were sought.
    std:
        Their standard deviations in metres: the Cramer-Rao bound with pattern and BRDF unknown too, times the noise.
        Where there is no noise, the largest shift that the remaining mismatch allows.
    position_std:
        Standard deviations of each element's x and y in metres, shape (M, 2).
    mismatch_before, mismatch_after:
        1 - lambda_1 of the closed form with the card as given and as found.
    iterations:
        Gauss-Newton steps taken on the raw films.
    method:
        "closed_form" or "maximum_likelihood".
    status:
        A sentence on what was found and what to do next.
    """

    card: Card
    values: Mapping[str, float]
    std: Mapping[str, float]
    position_std: Array = field(repr=False)
    mismatch_before: float
    mismatch_after: float
    iterations: int
    method: str
    status: str


def calibrate(
    captures: CaptureSet,
    *,
    parameters: tuple[Parameter, ...] = _NAMES,
    search: float = 0.25,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Find the card's offset, distance and width from the captures alone.

    Parameters
    ----------
    captures:
        Radiance (A, N, B) with the observer's geometry and a rough card.
    parameters:
        What is not known: "x" moves the card along the wall, "y" changes its distance, "width" stretches the spread of
        its elements and their own width.
    search:
        How far off the rough card may be: offset and width relative to its width, distance relative to itself.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        For unknown parameters or a search range outside (0, 0.9].
    UndeterminedError
        When the captures do not tell a parameter, or determine nothing at all.
    """
    free = _checked(captures.card, parameters)
    if not 0 < search <= 0.9:
        raise InputError(f"is {search:g}; give a share > 0 and at most 0.9", field="search")
    tell = progress or (lambda _: None)
    with threadpool_limits(limits=1, user_api="blas"):
        problem, _ = prepare(captures)
        found, reach = _found(problem, free, search, tell)
        if problem.noise_is_stated or found.closed.mismatch > _NOISELESS:
            result = _likeliest(problem, free, found, reach, tell)
        else:
            result = _settled(found, free)
        return _concluded(problem, free, result)


def _checked(card: Card, parameters: tuple[Parameter, ...]) -> tuple[int, ...]:
    unknown = [name for name in parameters if name not in _NAMES]
    if unknown or not parameters or len(set(parameters)) < len(parameters):
        raise InputError(f"is {parameters!r}; name each of x, y, width at most once", field="parameters")
    if card.elements < 2:
        raise UndeterminedError(
            "one element looks the same from everywhere to someone who does not know the BRDF; calibrate with a card "
            "of two or more elements"
        )
    return tuple(_NAMES.index(name) for name in parameters)


def moved(card: Card, offset: float, distance: float, width: float) -> Card:
    """The card shifted by `offset` metres, its distance and its width multiplied by positive factors."""
    x = np.asarray(card.elements_x)
    centre = float(x.mean())
    return dataclasses.replace(
        card,
        elements_x=tuple(map(float, centre + offset + width * (x - centre))),
        y=card.y * distance,
        element_width=card.element_width * width,
        board_width=card.board_width * width,
    )


def _card_at(card: Card, g: Array) -> Card:
    return moved(card, card.distance * float(g[0]), math.exp(float(g[1])), math.exp(float(g[2])))


@dataclass(frozen=True)
class _Films:
    """The captures at one resolution: which rows, how blurred, over which knots."""

    problem: Problem
    step: float
    degree: int
    data: Array  # (P', B), weighted
    weight: Array  # (P', 1)
    pixels: slice
    views: NDArray[np.intp]

    @classmethod
    def at(cls, problem: Problem, blur_deg: float, step_deg: float, degree: int, rows: int | None) -> _Films:
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
            _card_at(captures.card, g),
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
class _Point:
    """The closed form at one geometry, and how many steps led there."""

    g: Array
    films: _Films
    grid: SplineGrid
    designs: list[sp.csr_array]
    closed: ClosedForm
    steps: int

    @classmethod
    def at(cls, films: _Films, g: Array, steps: int = 0) -> _Point:
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
        columns = np.stack([t @ r for t in self.designs], axis=1)  # sum of squares 1
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
class _Result:
    """A geometry, its covariance and how it was found."""

    g: Array
    covariance: Array  # (J, J)
    step_deg: float
    steps: int
    method: str
    excess: float = 1.0  # misfit over what the noise alone would leave


def _descended(point: _Point, free: tuple[int, ...], reach: Array, most: int) -> _Point:
    """Levenberg and Marquardt's descent within the reach, until a step gains less than a part in a thousand."""
    damping = 1e-3
    columns = list(free)
    for _ in range(most):
        gradient, hessian, _ = point.curvature(free)
        diagonal = np.maximum(np.abs(np.diag(hessian)), 1e-30)
        better = None
        while better is None and damping < 1e6:
            g = point.g.copy()
            g[columns] -= np.linalg.solve(hessian + damping * np.diag(diagonal), gradient)
            if np.all(np.abs(g) <= reach):
                trial = _Point.at(point.films, g, point.steps + 1)
                better = trial if trial.merit < point.merit else None
            damping *= 0.1 if better is not None else 10
        if better is None:
            break
        gain, point = better.merit / point.merit, better
        if gain > 0.999:
            break
    return point


def _found(problem: Problem, free: tuple[int, ...], search: float, tell: Callable[[str], None]) -> tuple[_Point, Array]:
    """The closed form's geometry and the reach, from a coarse search or, where that fails, from a finer one."""
    card = problem.card
    extent = float(np.ptp(card.elements_x)) / card.distance
    share = np.array([search * extent, search, search]) * np.isin(np.arange(3), free)
    reach = 1.25 * np.array([share[0], -math.log1p(-share[1]), -math.log1p(-share[2])])
    noise = _noise_mismatch(problem)
    pitch = math.degrees(problem.captures.observer.fov) / problem.captures.observer.pixels
    best = None
    for spacing, stages in ((_LATTICE, _SEARCH), (_LATTICE / 2, _SEARCH[1:])):
        starts = _lattice(share, extent, spacing)
        for blur, step, rows, kept, steps in stages:
            films = _Films.at(problem, blur, max(step, 2 * pitch), 3, rows)
            points = sorted((_Point.at(films, g) for g in starts), key=lambda point: point.merit)[:kept]
            points = [_descended(point, free, reach, steps) for point in points]
            starts = [point.g for point in points]
            tell(f"blur {blur:g} deg: mismatch {min(point.mismatch for point in points):.2g}")
        point = _exact(problem, free, reach, starts, tell)
        best = point if best is None or point.merit < best.merit else best
        inside = np.all(np.abs(best.g) <= 0.999 * reach)
        if inside and best.merit < 0.1 and best.mismatch < max(_UNEXPLAINED, 30 * noise):
            return best, reach
    raise UndeterminedError(
        f"no card within {100 * search:.0f} % of the one given explains the captures and alone does so (mismatch "
        f"{best.mismatch if best else 1.0:.2g} at best); give a better guess, search further, or doubt the other hypotheses"
    )


def _lattice(share: Array, extent: float, spacing: float) -> list[Array]:
    """Geometries over the search's reach, no further apart than the spacing in radians of theta_s."""
    axes = []
    # The distance moves theta_s by half as much as the outermost element's offset, at most.
    for j, turn in enumerate((share[0], share[1] / 4, share[2] * extent / 2)):
        steps = 0 if share[j] == 0 else min(_MAX_LATTICE, max(1, math.ceil(turn / spacing)))
        nodes = share[j] * np.linspace(-1, 1, 2 * steps + 1)
        axes.append(nodes if j == 0 else np.log1p(nodes))
    return [np.array(g) for g in itertools.product(*axes)]


def _exact(
    problem: Problem, free: tuple[int, ...], reach: Array, starts: list[Array], tell: Callable[[str], None]
) -> _Point:
    """The descent on the raw films, with knots halved while that lowers the mismatch."""
    best, steps = None, 0
    for step in _EXACT_STEPS:
        films = _Films.at(problem, 0.0, step, 7, min(_EXACT_ROWS, int(1500 / step)))
        points = [_descended(_Point.at(films, g, steps), free, reach, 20) for g in starts]
        point = min(points, key=lambda point: point.merit)
        tell(f"knots every {step:g} deg: mismatch {point.mismatch:.2g}")
        # Not the mismatch alone: knots closer than the pixels explain anything, and the gap says so.
        if best is not None and point.closed.error > best.closed.error / 2:
            break
        best, starts, steps = point, [point.g], point.steps
        if best.mismatch < _EXACT:
            break
    assert best is not None
    return best


def _noise_mismatch(problem: Problem) -> float:
    """1 - lambda_1 that noise makes, about: its power over that of the patterns, from the singular values beyond M."""
    realisations, elements = problem.data.shape[1], problem.card.elements
    values = np.asarray(np.linalg.svd(np.linalg.qr(problem.weighted_data)[1], compute_uv=False), dtype=np.float64)
    if realisations == elements:
        return 0.0
    noise = float(np.sum(values[elements:] ** 2)) / (realisations - elements)
    faintest = max(float(values[elements - 1]), 1e-150)
    return float(noise / (faintest * faintest))


def _settled(point: _Point, free: tuple[int, ...]) -> _Result:
    """Without noise: a residual of this norm shifts g by no more than that over the root of the curvature."""
    _, hessian, power = point.curvature(free, central=True)
    values, vectors = np.linalg.eigh(hessian)
    # A slope of which BRDF and pattern take up all but this share is lost in the rounding of the differences.
    told = values > _LOST * float(np.sum(power))
    variance = np.where(told, max(point.mismatch, _EXACT) / np.where(told, values, 1.0), 1e6)
    covariance = (vectors * variance) @ vectors.T
    return _Result(point.g, covariance, math.degrees(point.films.step), point.steps, "closed_form")


def _likeliest(
    problem: Problem, free: tuple[int, ...], start: _Point, reach: Array, tell: Callable[[str], None]
) -> _Result:
    """Gauss-Newton in geometry, BRDF and pattern together, from the closed form's geometry."""
    films, grid, r = _noisy_films(problem, start.g, tell)
    g, columns, size = start.g.copy(), list(free), r.size
    for iteration in range(1, _MAX_STEPS + 1):
        designs = design_matrices(films.kernel(g), grid)
        slopes = films.slopes(g, free, grid, r)
        # The slopes as large as the best-seen spline, so that the fit's ridges mean the same to both.
        seen = max(float(np.max(sum(t.multiply(t).sum(axis=0) for t in designs))), 1e-300)
        unit = np.sqrt(seen / np.maximum(np.sum(slopes**2, axis=(1, 2)), 1e-300))
        beside = unit[:, None, None] * slopes
        extended = [sp.csr_array(sp.hstack([t, beside[:, :, i].T])) for i, t in enumerate(designs)]
        summed = moments(problem.data, extended, problem.inverse_variance)
        fit = maximise(summed, np.append(r, np.zeros(len(free))), nonnegative=False)
        scale = float(fit.coefficients[:size] @ r) / float(r @ r)
        step = np.clip(unit * fit.coefficients[size:] / scale, -_LONGEST, _LONGEST)
        # The bound where the fit began: fit and start differ by noise.
        centre = np.append(fit.coefficients[:size] / scale, np.zeros(len(free)))
        gauge = np.append(grid.row(grid.peak(r, summed.exposure[:size])), np.zeros(len(free)))
        bound = cramer_rao(summed, centre, fit.source * scale, gauge=gauge)
        variance, excess = _noise(problem, extended, fit)
        covariance = variance * bound.coefficients[-len(free) :, -len(free) :] * np.outer(unit, unit)
        g[columns] += step
        r = fit.coefficients[:size] / scale
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        tell(
            f"step {iteration}: misfit {fit.objective:.6g}, geometry moves {np.max(np.abs(step) / std):.2g} error bars"
        )
        if np.all(np.abs(step) <= _SETTLED * std):
            return _Result(
                g, covariance, math.degrees(films.step), start.steps + iteration, "maximum_likelihood", excess
            )
        if np.any(np.abs(g) > reach):
            break
    raise UndeterminedError(
        "the likelihood has no maximum within the search's reach, so that noise hides where the card is; capture more "
        "light, views or patterns, or calibrate fewer parameters"
    )


def _noisy_films(problem: Problem, g: Array, tell: Callable[[str], None]) -> tuple[_Films, SplineGrid, Array]:
    """All rows, and knots halved while that explains more than as many coefficients would of noise (Akaike 1974)."""
    chosen, least = None, math.inf
    used = 0
    for step in _NOISY_STEPS:
        films = _Films.at(problem, 0.0, step, 3, None)
        kernel = films.kernel(g)
        # Room for the card to move in.
        grid = films.grid(kernel, 2 * films.step)
        designs = design_matrices(kernel, grid)
        closed = closed_form(problem.weighted_data, problem.weighted(designs), films.space)
        summed = moments(problem.data, designs, problem.inverse_variance)
        fit = maximise(summed, np.where(summed.seen, closed.coefficients, 0.0), nonnegative=False)
        coefficients = int(np.count_nonzero(summed.seen))
        noise = 1.0 if problem.noise_is_stated else fit.objective / max(1, summed.observations - coefficients)
        tell(f"knots every {step:g} deg: misfit {fit.objective:.6g}")
        if chosen is not None and fit.objective / noise + 2 * coefficients > least / noise + 2 * used:
            break
        chosen, least, used = (films, grid, fit.coefficients), fit.objective, coefficients
    assert chosen is not None
    return chosen


def _noise(problem: Problem, designs: list[sp.csr_array], fit: Fit) -> tuple[float, float]:
    """Noise variance in units of the weights, and the misfit over what any rank-M model would leave."""
    rows, realisations = problem.data.shape
    elements = len(designs)
    transport = np.stack([t @ fit.coefficients for t in designs], axis=1)
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ fit.source) ** 2, 0.0)
    parameters = int(np.count_nonzero(fit.coefficients)) + fit.source.size
    reduced = float(np.sum(counted)) / max(1, int(np.count_nonzero(problem.noisy)) - parameters)
    if problem.noise_is_stated:
        return max(1.0, reduced), reduced
    if realisations <= elements:
        return reduced, math.nan
    values = np.linalg.svd(problem.row_weights * problem.data, compute_uv=False)
    freedom = (rows - elements) * (realisations - elements)
    return reduced, reduced / max(float(np.sum(values[elements:] ** 2)) / freedom, 1e-300)


def _concluded(problem: Problem, free: tuple[int, ...], result: _Result) -> Calibration:
    """From logarithms to metres, and the verdict."""
    card = problem.card
    found = _card_at(card, result.g)
    spread = np.asarray(found.elements_x) - float(np.mean(found.elements_x))
    width = float(np.ptp(found.elements_x))
    std = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    untold = [_WORDS[_NAMES[j]] for j, s in zip(free, std) if not s < _UNTOLD]
    if untold:
        raise UndeterminedError(
            f"the captures do not tell the card's {' and '.join(untold)} from its pattern and the BRDF: every angle sum "
            "shifts by nearly as much whatever it is; measure it and leave it out of the parameters, or move the card "
            "nearer to the wall"
        )
    metres = {"x": card.distance, "y": found.distance, "width": width}
    everything = np.zeros((3, 3))
    everything[np.ix_(free, free)] = result.covariance
    along_x = np.stack([np.full(spread.size, card.distance), np.zeros(spread.size), spread], axis=1)
    x_variance = np.einsum("mj,jk,mk->m", along_x, everything, along_x)
    y_std = found.distance * math.sqrt(max(everything[1, 1], 0.0))
    values = {"x": float(np.mean(found.elements_x)), "y": found.y, "width": width}
    before, after = (_mismatch(problem, at, result.step_deg) for at in (card, found))
    return Calibration(
        card=found,
        values={_NAMES[j]: values[_NAMES[j]] for j in free},
        std={_NAMES[j]: metres[_NAMES[j]] * float(s) for j, s in zip(free, std)},
        position_std=np.stack([np.sqrt(np.maximum(x_variance, 0.0)), np.full(spread.size, y_std)], axis=1),
        mismatch_before=before,
        mismatch_after=after,
        iterations=result.steps,
        method=result.method,
        status=_status(result, before, after),
    )


def _mismatch(problem: Problem, card: Card, step_deg: float) -> float:
    """1 - lambda_1 of all rows with one card."""
    films = _Films.at(problem, 0.0, step_deg, 7, None)
    there = dataclasses.replace(problem, captures=dataclasses.replace(problem.captures, card=card))
    return _Point.at(dataclasses.replace(films, problem=there), np.zeros(3)).mismatch


def _status(result: _Result, before: float, after: float) -> str:
    found = f"Moved the card: the closed form's mismatch falls from {before:.1g} to {after:.1g}."
    if result.excess > 1.2:
        return (
            f"{found} But the misfit is {result.excess:.2g} times the noise: the card is no scaled copy of the one given, "
            "lay further off than the search reached, or another hypothesis fails; the error bars are too small."
        )
    return f"{found} Solve with the returned card."
