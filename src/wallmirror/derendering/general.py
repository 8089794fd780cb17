"""Blind de-rendering without Hypothesis 8: the BRDF as a table in both angles, from a camera that moves.

With rho(theta_s, theta_o) = sum_kl r_kl phi_k(theta_s) phi_l(theta_o), a tensor product of uniform B-splines, the
transport of each element is still linear in r, so that the closed form (`subspace`), the likelihood (`likelihood`) and
its bound (`bounds`) hold as they stand, with more coefficients. What changes is what the captures determine. From one
position each wall point is seen under one theta_o and lit under M different theta_s, so that no value of the table
serves two elements, and any invertible mixture of the patterns has a table of its own (the ambiguity of non-negative
matrix factorisation). From several positions the curves (theta_s, theta_o) of different elements cross, and each
crossing ties two elements together. Reciprocity, rho(theta_s, theta_o) = rho(theta_o, theta_s) (Helmholtz), mirrors the
curves at the diagonal and doubles their crossings.

Cells of the table that no curve passes are held by a ridge: a Gaussian prior of the size of the seen cells, whose
weight follows from the noise (Tikhonov and Arsenin, Solutions of Ill-Posed Problems, 1977).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from wallmirror.brdf import BRDF
from wallmirror.captures import CaptureSet
from wallmirror.derendering.bounds import Bound, cramer_rao
from wallmirror.derendering.likelihood import Fit, Moments, maximise, moments
from wallmirror.derendering.problem import Problem, prepare
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form, signal_space
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.transport import Kernel, build_kernel

Array = NDArray[np.float64]

#: Knot spacings in degrees, tried in turn while finer ones still pay, and the splines' degrees.
_EXACT_STEPS = (12.0, 8.0, 6.0, 4.0, 3.0)
_NOISY_STEPS = (15.0, 10.0, 7.5, 5.0)
_EXACT_DEGREE = 7
_NOISY_DEGREE = 3
# Noise power beyond the M patterns, over the power of the faintest pattern, below which there is none but rounding; and
# the mismatch that says so where nothing lies beyond them.
_NOISELESS = 1e-20
_EXACT = 1e-12
# Ridge of the proximal steps over the best-seen cell's information, a few times the rounding of that, and their number.
_PROXIMAL = 1e-15
_PROXIMAL_STEPS = 4
# Cells with less than this share of the best-seen cell's information count as unseen.
_SEEN = 1e-3
# Shares of a value's variance before the captures that these must decide for it to count as determined, with noise and
# without, where the ridge is taken as a share of the best-seen cell's information; spacing of the nodes that tell.
_RESOLVED, _QUIET_RESOLVED = 0.9, 0.9999
_QUIET_RIDGE = 1e-9
_NODES_DEG = 2.0
_CHUNK = 500
# A predicted error of the pattern above this is no answer, nor a best BRDF that explains the captures less than so many
# times better than the second best.
_HOPELESS = 0.3
_APART = 3.0


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
        """Value, broadcast over two arrays of angles in radians."""
        s, o = np.broadcast_arrays(np.asarray(theta_s, dtype=np.float64), np.asarray(theta_o, dtype=np.float64))
        rows = self.grid.rows(s.reshape(-1, 1), o.reshape(-1, 1), np.ones((s.size, 1)))
        return np.asarray(rows @ self.coefficients, dtype=np.float64).reshape(s.shape)

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
    nearest = np.clip(np.rint(place * (nodes - 1)), 0, nodes - 1).astype(np.intp)
    return nearest, np.asarray((place >= 0) & (place <= 1))


@dataclass(frozen=True, kw_only=True)
class GeneralSolution:
    """Pattern and table that a moving camera's captures determine.

    Parameters
    ----------
    brdf:
        The table, a BRDF like any other, largest seen value 1.
    source:
        V, shape (M, B), in the units of the radiance in that gauge.
    source_std:
        Its standard deviation, shape (M, B).
    rank, mismatch, gap:
        Certificates of the closed form: rank of the data, 1 - lambda_1 and 1 - lambda_2.
    predicted_error:
        Expected relative error of V after the best global scale.
    chi_squared:
        Misfit over the stated noise, 1 when the model holds; NaN where no noise was stated or the closed form answered.
    step_deg:
        Knot spacing in degrees.
    method:
        "closed_form" or "maximum_likelihood".
    status:
        A sentence on what was found.
    """

    brdf: SplineTable
    source: Array = field(repr=False)
    source_std: Array = field(repr=False)
    rank: int
    mismatch: float
    gap: float
    predicted_error: float
    chi_squared: float
    step_deg: float
    method: str
    status: str

    def seen(self, theta_s: ArrayLike, theta_o: ArrayLike) -> NDArray[np.bool_]:
        """Where the captures determine the table; elsewhere its values come from the ridge."""
        return self.brdf.seen(theta_s, theta_o)


def solve_general(
    captures: Sequence[CaptureSet],
    *,
    reciprocal: bool = False,
    step_deg: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> GeneralSolution:
    """Recover pattern and BRDF table together from captures of one card taken from several positions.

    Parameters
    ----------
    captures:
        One capture set for each position of the observer; card, transport weights and the B patterns are the same in all.
    reciprocal:
        Impose rho(theta_s, theta_o) = rho(theta_o, theta_s).
    step_deg:
        Knot spacing along both angles in degrees; chosen by the data when left out.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        When the sets do not belong together, or for a spacing out of range.
    UndeterminedError
        When the positions are too few, and for all that `solve` refuses.
    """
    _check(captures, step_deg)
    tell = progress or (lambda _: None)
    with threadpool_limits(limits=1, user_api="blas"):
        stack = _Stack.of(captures, reciprocal)
        if not stack.problem.noise_is_stated:
            values = stack.space.singular_values / max(float(stack.space.singular_values[stack.elements - 1]), 1e-300)
            beyond = float(np.sum(values[stack.elements :] ** 2))
            if beyond < _NOISELESS:
                exact = _exact(stack, (step_deg,) if step_deg else _EXACT_STEPS, tell)
                if values.size > stack.elements or exact[2].mismatch < _EXACT:
                    return _exact_solution(stack, *exact)
        return _likeliest(stack, (step_deg,) if step_deg else _NOISY_STEPS, tell)


def _check(captures: Sequence[CaptureSet], step_deg: float | None) -> None:
    if step_deg is not None and not 0.1 <= step_deg <= 45:
        raise InputError(f"is {step_deg:g}; give a knot spacing from 0.1 to 45 degrees", field="step_deg")
    if not captures:
        raise InputError("names no capture set; give one for each position of the observer", field="captures")
    first = captures[0]
    for other in captures[1:]:
        if other.card != first.card or other.transport != first.transport or other.realisations != first.realisations:
            raise InputError(
                "the sets differ in card, transport or number of realisations; capture the same card showing the same "
                "patterns from each position",
                field="captures",
            )
    if len({c.observer.position for c in captures}) < 2:
        raise UndeterminedError(
            "from one position no value of the BRDF's table serves two elements, so that any mixture of the patterns "
            "explains the captures; move the camera (turning it is not enough), or assume Hypothesis 8 (`solve`)"
        )


@dataclass(frozen=True)
class _Stack:
    """The capture sets as one problem: rows of all positions under each other, and a last row of nothing."""

    problem: Problem
    space: SignalSpace
    captures: tuple[CaptureSet, ...]
    reciprocal: bool

    @classmethod
    def of(cls, captures: Sequence[CaptureSet], reciprocal: bool) -> _Stack:
        """Each set prepared by itself, then brought to one scale."""
        parts = [prepare(c)[0] for c in captures]
        scale = max(p.scale for p in parts)
        ratios = [p.scale / scale for p in parts]
        data = np.concatenate([p.data * ratio for p, ratio in zip(parts, ratios, strict=True)])
        stated = all(p.noise_is_stated for p in parts)
        inverse = None
        if any(p.inverse_variance is not None for p in parts):
            inverse = np.concatenate([_weights(p, ratio, stated) for p, ratio in zip(parts, ratios, strict=True)])
        noisy = np.concatenate([p.noisy for p in parts])
        problem = Problem(captures[0], data, inverse, noisy, stated, scale)
        return cls(problem, signal_space(problem.weighted_data, problem.card.elements), tuple(captures), reciprocal)

    def designs(self, step_deg: float, degree: int) -> tuple[TableGrid, list[sp.csr_array]]:
        """The table of one knot spacing and T_1 .. T_M over it."""
        step = math.radians(step_deg)
        kernels = [
            build_kernel(c.observer, c.card, weights=c.transport, resolution=2 * step, tolerance=1e-9)
            for c in self.captures
        ]
        ends = [[f(getattr(k, name)) for name in ("theta_s", "theta_o") for f in (np.min, np.max)] for k in kernels]
        low_s, high_s, low_o, high_o = (float(f(e)) for f, e in zip((min, max, min, max), zip(*ends), strict=True))
        if self.reciprocal:
            low_s, high_s = low_o, high_o = min(low_s, low_o), max(high_s, high_o)
        across = SplineGrid.covering(low_s, high_s, step=step, degree=degree)
        along = SplineGrid.covering(low_o, high_o, step=step, degree=degree)
        grid = TableGrid(across, along, self.reciprocal)
        return grid, [sp.csr_array(sp.vstack([_part(grid, k, i) for k in kernels])) for i in range(self.elements)]

    @property
    def elements(self) -> int:
        """M."""
        return self.problem.card.elements

    def closed(self, designs: list[sp.csr_array]) -> ClosedForm:
        """The closed form over the table.

        Its quick sum of the Gram matrix takes rows of equal length for runs of neighbouring columns, which those of a
        table are not; a last row without entries sends it the general way.
        """
        nothing = sp.csr_array((1, designs[0].shape[1]))
        padded = [sp.csr_array(sp.vstack([t, nothing])) for t in self.problem.weighted(designs)]
        space = replace(self.space, basis=_padded(self.space.basis))
        return closed_form(_padded(self.problem.weighted_data), padded, space)


def _weights(part: Problem, ratio: float, stated: bool) -> Array:
    weights = np.ones(part.data.shape) if part.inverse_variance is None else part.inverse_variance
    return np.asarray(weights / ratio**2 if stated else weights > 0, dtype=np.float64)


def _padded(rows: Array) -> Array:
    return np.concatenate([rows, np.zeros((1, rows.shape[1]))])


def _part(grid: TableGrid, kernel: Kernel, element: int) -> sp.csr_array:
    shape = kernel.weight.shape
    angles = (np.broadcast_to(a, shape)[:, :, element] for a in (kernel.theta_s, kernel.theta_o, kernel.weight))
    return grid.rows(*(a.reshape(-1, shape[3]) for a in angles))


def _exact(
    stack: _Stack, steps: tuple[float, ...], tell: Callable[[str], None]
) -> tuple[TableGrid, list[sp.csr_array], ClosedForm]:
    """Refine the knots while that halves the error bound."""
    best = None
    for step in steps:
        grid, designs = stack.designs(step, _EXACT_DEGREE)
        closed = _polished(stack, designs, stack.closed(designs))
        tell(f"knots every {step:g} deg: mismatch {closed.mismatch:.2g}, gap {closed.gap:.2g}")
        if best is not None and closed.error > best[2].error / 2:
            break
        best = grid, designs, closed
    assert best is not None
    return best


def _polished(stack: _Stack, designs: list[sp.csr_array], closed: ClosedForm) -> ClosedForm:
    """The closed form freed of the pull of its ridge, by proximal steps while they lower the mismatch.

    The ridge that the closed form needs pulls r towards 0 by 1e-13 over the curvature C = A - H^T H, which for a table
    seen from few positions is not much larger. r <- e (C + e)^-1 r only pulls towards the last r (Rockafellar, SIAM J.
    Control Optim. 14(5), 1976), and keeps what C leaves free.
    """
    u = stack.space.basis
    weighted = stack.problem.weighted(designs)
    curvature = sp.csr_array(sum(t.T @ t for t in weighted)).toarray()
    for t in weighted:
        projected = (t.T @ u).T
        curvature -= projected.T @ projected
    level = _PROXIMAL * float(np.sum(weighted[0].multiply(weighted[0]).sum(axis=0).max()))
    curvature[np.diag_indices_from(curvature)] += level
    try:
        factor = sl.cho_factor(curvature, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:  # rounding took more than the level gives: nothing to gain here
        return closed
    for _ in range(_PROXIMAL_STEPS):
        r = level * sl.cho_solve(factor, closed.coefficients, check_finite=False)
        columns = np.stack([t @ r for t in weighted], axis=1)
        norm = float(np.linalg.norm(columns))
        projected = u.T @ columns / norm
        mismatch = float(np.sum((columns / norm - u @ projected) ** 2))
        if not mismatch < 0.9 * closed.mismatch:
            break
        source = np.linalg.lstsq(projected, u.T @ stack.problem.weighted_data)[0]
        closed = replace(closed, coefficients=r / norm, transport=u @ projected, source=source, mismatch=mismatch)
    return closed


def _peak(stack: _Stack, grid: TableGrid, r: Array) -> Array:
    """The basis functions' values, shape (size,), where the captures saw the largest value of the table."""
    best, row = -math.inf, np.zeros(grid.size)
    for c in stack.captures:
        kernel = build_kernel(c.observer, c.card, weights="thesis")
        for i in range(stack.elements):
            rows = _part(grid, Kernel(kernel.theta_s, kernel.theta_o, np.ones(kernel.weight.shape)), i)
            values = rows @ r
            p = int(np.argmax(values))
            if values[p] > best:
                best, row = float(values[p]), rows[[p]].toarray()[0]
    return row


def _exact_solution(stack: _Stack, grid: TableGrid, designs: list[sp.csr_array], closed: ClosedForm) -> GeneralSolution:
    if closed.near_solutions > 1 or closed.error > _HOPELESS:
        raise UndeterminedError(_too_few(stack, f"gap {closed.gap:.1e}, mismatch {closed.mismatch:.1e}"))
    peak = float(_peak(stack, grid, closed.coefficients) @ closed.coefficients)
    source = closed.source * stack.problem.scale * peak
    return GeneralSolution(
        brdf=SplineTable(
            grid=grid,
            coefficients=closed.coefficients / peak,
            determined=_resolution(stack, grid, designs, closed.source, 0.0) > _QUIET_RESOLVED,
        ),
        source=source,
        source_std=np.full(source.shape, closed.error * float(np.sqrt(np.mean(source**2)))),
        rank=stack.space.rank,
        mismatch=closed.mismatch,
        gap=closed.gap,
        predicted_error=closed.error,
        chi_squared=math.nan,
        step_deg=math.degrees(grid.theta_s.step),
        method="closed_form",
        status=_status(stack, closed.error, "in closed form"),
    )


def _exposure(designs: list[sp.csr_array]) -> Array:
    total = np.sum([np.asarray(t.multiply(t).sum(axis=0)).ravel() for t in designs], axis=0)
    return np.asarray(total / max(float(total.max()), 1e-300), dtype=np.float64)


def _resolution(stack: _Stack, grid: TableGrid, designs: list[sp.csr_array], source: Array, ridge: float) -> Array:
    """1 - ridge phi (A + ridge)^-1 phi / |phi|^2 at the nodes, A the information on r when the patterns are known."""
    power = np.sum(source**2, axis=1)
    weighted = stack.problem.weighted(designs)
    information = sp.csr_array(sum(v * (t.T @ t) for v, t in zip(power, weighted, strict=True))).toarray()
    ridge = max(ridge, _QUIET_RIDGE * float(np.max(np.diag(information))))
    information[np.diag_indices_from(information)] += ridge
    factor = sl.cho_factor(information, lower=True, overwrite_a=True, check_finite=False)
    inverse = sl.cho_solve(factor, np.eye(information.shape[0]), overwrite_b=True, check_finite=False)
    nodes = []
    for line in (grid.theta_s, grid.theta_o):
        count = 1 + math.ceil((line.stop - line.start) / math.radians(_NODES_DEG))
        nodes.append(np.linspace(line.start, line.stop, count))
    s, o = (a.reshape(-1, 1) for a in np.meshgrid(*nodes, indexing="ij"))
    rows = grid.rows(s, o, np.ones(s.shape))
    left = np.concatenate(
        [np.asarray(part.multiply(part @ inverse).sum(axis=1)).ravel() for part in _slices(rows, _CHUNK)]
    )
    before = np.asarray(rows.multiply(rows).sum(axis=1)).ravel()
    return np.asarray(np.clip(1 - ridge * left / before, 0.0, 1.0).reshape(nodes[0].size, nodes[1].size))


def _slices(rows: sp.csr_array, size: int) -> list[sp.csr_array]:
    return [rows[start : start + size] for start in range(0, rows.shape[0], size)]


def _noise(stack: _Stack) -> float:
    """Noise variance in units of the weights, from what is stated or from the singular values beyond M."""
    problem = stack.problem
    rows, realisations = problem.data.shape
    if problem.noise_is_stated:
        return 1.0
    if realisations <= stack.elements:
        raise UndeterminedError(
            "as many realisations as elements leave no way to tell the noise; capture one more, or state the variance"
        )
    beyond = np.sum(stack.space.singular_values[stack.elements :] ** 2)
    return float(beyond) / float((rows - stack.elements) * (realisations - stack.elements))


def _likeliest(stack: _Stack, steps: tuple[float, ...], tell: Callable[[str], None]) -> GeneralSolution:
    """Halve the spacing while that explains more than as many coefficients would of noise (Akaike 1974)."""
    noise = _noise(stack)
    best: tuple[TableGrid, list[sp.csr_array], ClosedForm, Moments, Fit] | None = None
    least = math.inf
    for step in steps:
        grid, designs = stack.designs(step, _NOISY_DEGREE)
        closed = stack.closed(designs)
        summed = _with_ridge(stack, designs, closed, noise)
        fit = maximise(summed, closed.coefficients, nonnegative=False)
        seen = int(np.count_nonzero(_exposure(designs) > _SEEN))
        tell(f"knots every {step:g} deg: misfit {fit.objective:.6g} with {seen} cells seen")
        merit = fit.objective / noise + 2 * seen
        if best is not None and merit > least:
            break
        best, least = (grid, designs, closed, summed, fit), merit
    assert best is not None
    return _likeliest_solution(stack, noise, *best)


def _prior(designs: list[sp.csr_array], closed: ClosedForm, noise: float) -> float:
    """The ridge: noise over the mean square of the well-seen coefficients."""
    well = _exposure(designs) > 0.01
    return noise * int(np.count_nonzero(well)) / max(float(np.sum(closed.coefficients[well] ** 2)), 1e-300)


def _with_ridge(stack: _Stack, designs: list[sp.csr_array], closed: ClosedForm, noise: float) -> Moments:
    """The data and a prior r ~ N(0, size of the seen cells), written as rows of which nothing was seen.

    Each element has its own such rows, so that the prior weighs |r|^2 |V|^2, which no global scale changes.
    """
    problem = stack.problem
    size = designs[0].shape[1]
    strength = math.sqrt(_prior(designs, closed, noise) / max(float(np.sum(closed.source**2)), 1e-300))
    elements = len(designs)
    extended = []
    for i, t in enumerate(designs):
        prior = sp.csr_array(sp.kron(sp.csr_array(np.eye(elements)[:, [i]]), strength * sp.eye_array(size)))
        extended.append(sp.csr_array(sp.vstack([t, prior])))
    nothing = np.zeros((elements * size, problem.data.shape[1]))
    weights = problem.inverse_variance
    if weights is not None:
        weights = np.concatenate([weights, np.ones_like(nothing)])
    return moments(np.concatenate([problem.data, nothing]), extended, weights)


def _likeliest_solution(
    stack: _Stack,
    noise: float,
    grid: TableGrid,
    designs: list[sp.csr_array],
    closed: ClosedForm,
    summed: Moments,
    fit: Fit,
) -> GeneralSolution:
    problem = stack.problem
    transport = np.stack([t @ fit.coefficients for t in designs], axis=1)
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ fit.source) ** 2, 0.0)
    cells = int(np.count_nonzero(_exposure(designs) > _SEEN))
    reduced = float(np.sum(counted)) / max(1, int(np.count_nonzero(problem.noisy)) - cells - fit.source.size)
    sigma = math.sqrt(max(reduced, noise))
    gauge = _peak(stack, grid, fit.coefficients)
    peak = float(gauge @ fit.coefficients)
    bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=gauge)
    # The ridge holds the table; it must not be what holds the pattern.
    free = _without_ridge(stack, designs, fit, gauge)
    error = sigma * free.source_error
    if not error < _HOPELESS or closed.gap < _APART * closed.mismatch:
        why = f"gap {closed.gap:.1e}, mismatch {closed.mismatch:.1e}, pattern off by {100 * error:.2g} %"
        raise UndeterminedError(_too_few(stack, why))
    resolution = _resolution(stack, grid, designs, fit.source, _prior(designs, closed, noise))
    scale = problem.scale * peak
    return GeneralSolution(
        brdf=SplineTable(grid=grid, coefficients=fit.coefficients / peak, determined=resolution > _RESOLVED),
        source=fit.source * scale,
        source_std=sigma * bound.source_std * scale,
        rank=stack.space.rank,
        mismatch=closed.mismatch,
        gap=closed.gap,
        predicted_error=sigma * bound.source_error,
        chi_squared=reduced if problem.noise_is_stated else math.nan,
        step_deg=math.degrees(grid.theta_s.step),
        method="maximum_likelihood",
        status=_status(stack, sigma * bound.source_error, "by maximum likelihood"),
    )


def _without_ridge(stack: _Stack, designs: list[sp.csr_array], fit: Fit, gauge: Array) -> Bound:
    data = moments(stack.problem.data, designs, stack.problem.inverse_variance)
    return cramer_rao(data, fit.coefficients, fit.source, gauge=gauge)


def _places(stack: _Stack) -> int:
    return len({c.observer.position for c in stack.captures})


def _too_few(stack: _Stack, why: str) -> str:
    hint = "" if stack.reciprocal else ", impose reciprocity"
    return (
        f"{_places(stack)} positions leave several tables that explain the captures ({why}); capture from more "
        f"positions{hint}, or assume Hypothesis 8 (`solve`)"
    )


def _status(stack: _Stack, error: float, how: str) -> str:
    return (
        f"Recovered {stack.elements} elements from {_places(stack)} positions {how}, without Hypothesis 8; expect the "
        f"pattern to be {100 * error:.2g} % off, up to one global scale."
    )
