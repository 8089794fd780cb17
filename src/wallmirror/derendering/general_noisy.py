"""The table and the pattern under noise: the likelihood over a table whose unseen cells a ridge holds.

The ridge is a Gaussian prior of the size of the seen cells, whose weight follows from the noise (Tikhonov and Arsenin,
Solutions of Ill-Posed Problems, 1977). It may hold cells of the table, but not the pattern: captures that leave this to
the ridge are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound, cramer_rao
from wallmirror.derendering.estimate import doubts_of_fit
from wallmirror.derendering.general_solution import HOPELESS, GeneralSolution, status, too_few
from wallmirror.derendering.general_stack import Stack, exposure, resolution
from wallmirror.derendering.likelihood import Fit, Moments, maximise, moments
from wallmirror.derendering.splines import transport_of
from wallmirror.derendering.subspace import ClosedForm
from wallmirror.derendering.tables import SplineTable, TableGrid
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

#: Knot spacings in degrees, tried in turn while finer ones still pay.
NOISY_STEPS = (15.0, 10.0, 7.5, 5.0)
_DEGREE = 3
# Cells with less than this share of the best-seen cell's information count as unseen.
_SEEN = 1e-3
# Share of a value's variance before the captures that these must decide for it to count as determined.
_RESOLVED = 0.9
# A best BRDF that explains the captures less than so many times better than the second best is no answer.
_APART = 3.0


def _noise(stack: Stack) -> float:
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


def likeliest(stack: Stack, steps: tuple[float, ...], tell: Callable[[str], None]) -> GeneralSolution:
    """Refine the knots while that explains more than as many coefficients would of noise (Akaike 1974).

    Raises
    ------
    UndeterminedError
        When nothing tells the noise, or the captures leave the pattern to noise or to the ridge.
    """
    noise = _noise(stack)
    best: tuple[TableGrid, list[sp.csr_array], ClosedForm, Moments, Fit] | None = None
    least = math.inf
    for step in steps:
        grid, designs = stack.designs(step, _DEGREE)
        closed = stack.closed(designs)
        summed = _with_ridge(stack, designs, closed, noise)
        fit = maximise(summed, closed.coefficients, nonnegative=False)
        seen = int(np.count_nonzero(exposure(designs) > _SEEN))
        tell(f"knots every {step:g} deg: misfit {fit.objective:.6g} with {seen} cells seen")
        merit = fit.objective / noise + 2 * seen
        if best is not None and merit > least:
            break
        best, least = (grid, designs, closed, summed, fit), merit
    assert best is not None
    return _likeliest_solution(stack, noise, *best)


def _prior(designs: list[sp.csr_array], closed: ClosedForm, noise: float) -> float:
    """The ridge: noise over the mean square of the well-seen coefficients."""
    well = exposure(designs) > 0.01
    return noise * int(np.count_nonzero(well)) / max(float(np.sum(closed.coefficients[well] ** 2)), 1e-300)


def _with_ridge(stack: Stack, designs: list[sp.csr_array], closed: ClosedForm, noise: float) -> Moments:
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
    stack: Stack,
    noise: float,
    grid: TableGrid,
    designs: list[sp.csr_array],
    closed: ClosedForm,
    summed: Moments,
    fit: Fit,
) -> GeneralSolution:
    problem = stack.problem
    transport = transport_of(designs, fit.coefficients)
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ fit.source) ** 2, 0.0)
    cells = int(np.count_nonzero(exposure(designs) > _SEEN))
    reduced = float(np.sum(counted)) / max(1, int(np.count_nonzero(problem.noisy)) - cells - fit.source.size)
    sigma = math.sqrt(max(reduced, noise))
    gauge = stack.peak(grid, fit.coefficients)
    peak = float(gauge @ fit.coefficients)
    bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=gauge)
    # The ridge holds the table; it must not be what holds the pattern.
    free = _without_ridge(stack, designs, fit, gauge)
    error = sigma * free.source_error
    if not error < HOPELESS or closed.gap < _APART * closed.mismatch:
        why = f"gap {closed.gap:.1e}, mismatch {closed.mismatch:.1e}, pattern off by {100 * error:.2g} %"
        raise UndeterminedError(too_few(stack, why))
    decided = resolution(stack, grid, designs, fit.source, _prior(designs, closed, noise))
    scale = problem.scale * peak
    warnings = doubts_of_fit(converged=fit.converged, misfit=reduced if problem.noise_is_stated else None)
    return GeneralSolution(
        brdf=SplineTable(grid=grid, coefficients=fit.coefficients / peak, determined=decided > _RESOLVED),
        source=fit.source * scale,
        source_std=sigma * bound.source_std * scale,
        rank=stack.space.rank,
        mismatch=closed.mismatch,
        gap=closed.gap,
        predicted_error=sigma * bound.source_error,
        chi_squared=reduced if problem.noise_is_stated else math.nan,
        step_deg=math.degrees(grid.theta_s.step),
        method="maximum_likelihood",
        warnings=tuple(warnings),
        status=status(stack, sigma * bound.source_error, "by maximum likelihood", warnings),
    )


def _without_ridge(stack: Stack, designs: list[sp.csr_array], fit: Fit, gauge: Array) -> Bound:
    data = moments(stack.problem.data, designs, stack.problem.inverse_variance)
    return cramer_rao(data, fit.coefficients, fit.source, gauge=gauge)
