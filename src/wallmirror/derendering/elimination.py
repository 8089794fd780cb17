"""Eliminate the BRDF: for a given pattern the best r is linear, and what is left depends on the pattern alone.

Variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973) with the pattern V as the outer unknown. With
J_b = sum_i V_ib T_i, G = sum_b J_b^T J_b, F = [T_1 r .. T_M r], C_b = J_b^T F and E = D - F V, a step of
Levenberg and Marquardt solves

    (S + damping) dv = F^T E,      S = blockdiag(F^T F) - C^T G^-1 C,

r being the best one already, so that its own slope is zero. The null vector of S is V itself, the global scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import lapack

from wallmirror.derendering.convex import minimise_above
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

_RIDGE = 1e-13
_STEPS = 60
# Cells whose exposure lies this far below the best-seen cell's are left out.
_SEEN = 1e-10


@dataclass(frozen=True)
class System:
    """The problem on one grid, columns scaled to unit norm, data to unit norm, unseen coefficients left out.

    Parameters
    ----------
    data:
        D with weighted rows, shape (P, B), Frobenius norm 1.
    stacked:
        T_1 .. T_M below each other, (M P, K') over the K' seen coefficients.
    cells, scale, exposure:
        Which of the K coefficients those are, the norms their columns had, and these squared relative to the largest.
    pairs, where, values, counts:
        Entries of N_ij = T_i^T T_j (plus the transpose, where i < j), as places in the flat (K', K') matrix, with the
        number of entries of each pair.
    cross:
        T_i^T D, shape (M, K', B).
    observations:
        Number of data with weight > 0.
    """

    grid: SplineGrid
    data: Array
    stacked: sp.csr_array
    cells: NDArray[np.intp]
    scale: Array
    exposure: Array
    pairs: list[tuple[int, int]]
    where: NDArray[np.int32]
    values: Array
    counts: list[int]
    cross: Array
    observations: int

    @property
    def freedom(self) -> int:
        """Data less unknowns."""
        rows, realisations = self.data.shape
        return int(self.observations - self.cells.size - realisations * (self.stacked.shape[0] // rows))

    def transport(self, r: Array) -> Array:
        """F, (P, M)."""
        return np.asarray((self.stacked @ r).reshape(-1, self.data.shape[0]).T)

    def gram(self, v: Array) -> Array:
        """G, dense (K', K'), with the ridge that keeps cells without data where they are."""
        products = v @ v.T
        weights = self.values * np.repeat([products[i, j] for i, j in self.pairs], self.counts)
        size = self.cells.size
        gram = np.asarray(np.bincount(self.where, weights=weights, minlength=size * size), dtype=np.float64)
        gram = gram.reshape(size, size)
        gram[np.diag_indices(size)] += _RIDGE * np.trace(gram) / size + 1e-300
        return gram

    def back(self, v: Array, films: Array) -> Array:
        """J_b^T times films of shape (P, n) for one column v_b of the pattern; (K', n)."""
        return np.asarray(self.stacked.T @ (v[:, None, None] * films).reshape(-1, films.shape[1]))


@dataclass(frozen=True)
class Point:
    """A pattern with the BRDF that suits it best.

    Parameters
    ----------
    v, r:
        The pattern (M, B), of norm 1, and the scaled coefficients (K',).
    free:
        The coefficients that are not at their bound.
    gram, factor:
        G over those, and its lower Cholesky factor.
    transport, missed, objective:
        F (P, M), E = D - F V and its squared norm, the share of |D|^2 that is missed.
    """

    v: Array
    r: Array
    free: NDArray[np.intp]
    gram: Array
    factor: Array
    transport: Array
    missed: Array
    objective: float


def restricted(grid: SplineGrid, designs: list[sp.csr_array], support: float | None) -> list[sp.csr_array]:
    """T_1 .. T_M without the coefficients that act beyond |u| = support (radians) alone, whose columns become empty."""
    if support is None:
        return designs
    inside = _within(grid, support)
    return [_with_columns(t, inside) for t in designs]


def _within(grid: SplineGrid, support: float) -> NDArray[np.bool_]:
    """Which coefficients act somewhere in |u| < support, shape (K,)."""
    begin = grid.start + (np.arange(grid.size) - grid.degree) * grid.step
    return np.asarray((begin < support) & (begin + (grid.degree + 1) * grid.step > -support))


def _with_columns(design: sp.csr_array, keep: NDArray[np.bool_]) -> sp.csr_array:
    kept = design.copy()
    kept.data = np.where(keep[kept.indices], kept.data, 0.0)
    return kept


def build_system(problem: Problem, step_deg: float, *, degree: int, support: float | None) -> System:
    """The problem on the grid of one knot spacing in degrees.

    Raises
    ------
    UndeterminedError
        When the support leaves nothing that a pixel sees.
    """
    grid, designs = problem.designs(step_deg, degree=degree, tolerance=1e-9)
    designs = problem.weighted(restricted(grid, designs, support))
    energy = np.zeros(grid.size)
    for t in designs:
        energy += np.bincount(t.indices, weights=t.data**2, minlength=grid.size)
    exposure = energy / max(float(energy.max(initial=0.0)), 1e-300)
    cells = np.flatnonzero(exposure > _SEEN)
    if cells.size == 0:
        raise UndeterminedError("no pixel sees the wall under an angle where the BRDF may differ from zero")
    scale = np.sqrt(energy[cells])
    scaled = [sp.csr_array(t[:, cells] / scale) for t in designs]
    data = problem.weighted_data / np.linalg.norm(problem.weighted_data)
    pairs, where, values = [], [], []
    for i, left in enumerate(scaled):
        for j in range(i, len(scaled)):
            product = left.T @ scaled[j]
            entries = (product if i == j else product + product.T).tocoo()
            row, column = entries.coords
            pairs.append((i, j))
            where.append((row.astype(np.int32) * np.int32(cells.size) + column).astype(np.int32))
            values.append(entries.data)
    return System(
        grid=grid,
        data=data,
        stacked=sp.csr_array(sp.vstack(scaled)),
        cells=cells,
        scale=scale,
        exposure=exposure[cells],
        pairs=pairs,
        where=np.concatenate(where),
        values=np.concatenate(values),
        counts=[v.size for v in values],
        cross=np.stack([t.T @ data for t in scaled]),
        observations=int(np.count_nonzero(problem.row_weights > 0)) * data.shape[1],
    )


def climb(system: System, v: Array, r: Array | None, *, nonnegative: bool) -> Point:
    """Levenberg-Marquardt on V from a pattern (M, B); r, if given, tells which coefficients are likely above zero."""
    here = eliminated(system, v / np.linalg.norm(v), r, nonnegative=nonnegative)
    damping = 1e-2
    for _ in range(_STEPS):
        free = (here.v > 0) | (here.transport.T @ here.missed > 0) if nonnegative else np.ones_like(here.v, dtype=bool)
        normal, values = normal_of_pattern(system, here, free)
        slope = np.where(free, here.transport.T @ here.missed, 0.0).ravel(order="F")
        level = float(np.mean(values))
        at = here.v.ravel(order="F")
        if level <= 0:
            break
        while True:
            # V V^T keeps the step off the global scale, which the step after it takes out again.
            damped = normal + level * (damping * np.eye(at.size) + np.outer(at, at))
            step = minimise_above(-at, damped, slope) if nonnegative else np.linalg.solve(damped, slope)
            v = (at + step).reshape(here.v.shape, order="F")
            norm = float(np.linalg.norm(v))
            there = eliminated(system, v / norm, here.r, nonnegative=nonnegative) if norm > 0 else here
            if there.objective < here.objective or damping > 1e6 or np.linalg.norm(step) < 1e-15:
                break
            damping *= 8
        if there.objective >= here.objective:
            break
        gained = 1 - there.objective / here.objective
        here, damping = there, max(damping / 8, 1e-12)
        if gained < 1e-6 and damping < 1e-5:
            break
    return here


def eliminated(system: System, v: Array, likely: Array | None, *, nonnegative: bool) -> Point:
    """The best r for a pattern, with one step of refinement from the pixels' own residual."""
    gram = system.gram(v)
    right = np.einsum("ikb,ib->k", system.cross, v)
    free = np.arange(right.size)
    r = np.zeros(right.size)
    if nonnegative:
        # Pivoting starts from the coefficients that lie above their bound, so it is told which those probably are.
        guess = np.zeros(right.size) if likely is None else np.maximum(likely, 0.0)
        r = guess + minimise_above(-guess, gram, right - gram @ guess)
        free = np.flatnonzero(r > 0)
    if free.size == 0:
        unmoved = system.data.copy()
        return Point(v, r, free, gram[:0, :0], gram[:0, :0], system.transport(r), unmoved, float(np.sum(unmoved**2)))
    inner = gram[np.ix_(free, free)]
    factor = _factor(inner)
    if not nonnegative:
        r = sl.cho_solve((factor, True), right, check_finite=False)
    missed = system.data - system.transport(r) @ v
    r[free] += sl.cho_solve((factor, True), (system.stacked.T @ (v @ missed.T).ravel())[free], check_finite=False)
    if nonnegative:
        r = np.maximum(r, 0.0)
    transport = system.transport(r)
    missed = system.data - transport @ v
    return Point(v, r, free, inner, factor, transport, missed, float(np.sum(missed**2)))


def _factor(gram: Array) -> Array:
    """Lower Cholesky factor; a G that rounding has robbed of its smallest eigenvalues gets a larger ridge."""
    level = float(np.mean(np.diag(gram)))
    for ridge in (0.0, 1e-12, 1e-10, 1e-8):
        try:
            raised = gram + ridge * level * np.eye(gram.shape[0]) if ridge else gram
            return np.asarray(np.linalg.cholesky(raised), dtype=np.float64)
        except np.linalg.LinAlgError:
            continue
    raise UndeterminedError("the captures leave the BRDF undetermined; capture more light, views or patterns")


def normal_of_pattern(system: System, point: Point, free: NDArray[np.bool_]) -> tuple[Array, Array]:
    """S over vec V (capture by capture; rows of fixed entries empty), and its eigenvalues, ascending."""
    realisations = point.v.shape[1]
    inner = point.transport.T @ point.transport
    coupling = np.concatenate([system.back(v, point.transport)[point.free] for v in point.v.T], axis=1)
    normal = np.kron(np.eye(realisations), inner)
    if point.free.size:
        x = sl.cho_solve((point.factor, True), coupling, check_finite=False)
        # Stationary in x, so that the error of x counts only squared.
        normal -= coupling.T @ x + x.T @ (coupling - point.gram @ x)
    keep = free.ravel(order="F")
    normal = np.where(keep[:, None] & keep, 0.5 * (normal + normal.T), 0.0)
    return np.asarray(normal, dtype=np.float64), np.asarray(np.linalg.eigvalsh(normal), dtype=np.float64)


def reciprocal_condition(point: Point) -> float:
    """LAPACK's estimate for G over the free cells."""
    if point.free.size == 0:
        return 0.0
    value, _ = lapack.dpocon(point.factor, float(np.max(np.sum(np.abs(point.gram), axis=0))), uplo="L")
    return float(value)
