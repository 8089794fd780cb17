"""The card's place under noise: the maximum of the likelihood of geometry, BRDF and pattern together, and its bound.

F is linear in (r, the coefficients dg of its slopes D_j) around the last geometry, so that the fit of pattern and BRDF
(`likelihood`) climbs in the geometry too when the D_j stand beside the T_i, and its bound (`bounds`) is the joint one.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.calibration_films import Films, Found, Point
from wallmirror.derendering.likelihood import Fit, maximise, moments
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid, design_matrices, transport_of
from wallmirror.derendering.subspace import closed_form
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

_KNOTS = (1.0, 0.5, 0.25)  # spacings in degrees
# The steps in g: the longest one, how many, and the share of an error bar at which they end.
_LONGEST = 0.1
_MAX_STEPS = 8
_SETTLED = 0.01


def likeliest(
    problem: Problem, free: tuple[int, ...], start: Point, reach: Array, tell: Callable[[str], None]
) -> Found:
    """Gauss-Newton in geometry, BRDF and pattern together, from the closed form's geometry.

    Parameters
    ----------
    free:
        Which of offset, distance and width are sought: any of 0, 1 and 2.
    reach:
        The largest |g| that counts as within the search, shape (3,).

    Raises
    ------
    UndeterminedError
        When the likelihood has no maximum within reach.
    """
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
            return Found(g, covariance, math.degrees(films.step), start.steps + iteration, "maximum_likelihood", excess)
        if np.any(np.abs(g) > reach):
            break
    raise UndeterminedError(
        "the likelihood has no maximum within the search's reach, so that noise hides where the card is; capture more "
        "light, views or patterns, or calibrate fewer parameters"
    )


def _noisy_films(problem: Problem, g: Array, tell: Callable[[str], None]) -> tuple[Films, SplineGrid, Array]:
    """All rows, and knots halved while that explains more than as many coefficients would of noise (Akaike 1974)."""
    chosen, least = None, math.inf
    used = 0
    for step in _KNOTS:
        films = Films.at(problem, 0.0, step, 3, None)
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
    transport = transport_of(designs, fit.coefficients)
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
