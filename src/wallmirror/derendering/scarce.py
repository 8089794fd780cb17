"""Fewer captures than elements, made an estimate: the search finds the pattern, the likelihood weighs what it knows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.elimination import restricted
from wallmirror.derendering.estimate import Estimate, doubts_of_fit
from wallmirror.derendering.few_captures import STEPS, few_captures
from wallmirror.derendering.likelihood import Fit, best_nonnegative, maximise, moments
from wallmirror.derendering.problem import Problem, reduced_misfit, smoothness
from wallmirror.derendering.splines import SplineGrid, transport_of
from wallmirror.derendering.subspace import ClosedForm

Array = NDArray[np.float64]

# A residual below this is a spline's own error or rounding, and no noise that a likelihood could weigh.
_NOISELESS = 1e-6
# Misfit that each coefficient beyond the support takes away, in units of the noise, from which on it is no chance.
_BEYOND = 5.0
# Correlation of neighbouring pixels beyond which a misfit is no noise, and beyond which it is no chance, in units of
# 1 / sqrt(pixels), by which that of independent ones scatters.
_SMOOTH, _CHANCE = 0.25, 5.0
# Share of the parabola's rise at five error bars below which a pattern there is as likely as bars a root of two wider would
# have it (Bates and Watts 1988, chapter 6, on bars that a profile does not bear out).
_BORNE_OUT = 0.5


def solve_scarce(
    problem: Problem,
    *,
    nonnegative: bool,
    support: float | None,
    step_deg: float | None,
    seed: int,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Estimate, list[Estimate]]:
    """Search from random patterns; where there is noise, climb to the likelihood's maximum from what was found.

    Parameters
    ----------
    support:
        rho(u) = 0 for |u| > support, in radians.

    Returns
    -------
    The estimate, and where there is noise the same with each of the other patterns that the search ended at, for `rivals`.

    Raises
    ------
    UndeterminedError
        When the captures and the priors named do not decide.
    """
    steps = (step_deg,) if step_deg else STEPS
    found = few_captures(problem, nonnegative=nonnegative, support=support, seed=seed, steps=steps)
    tell(f"{found.agreeing} of {found.starts} random starts end at one pattern, residual {found.residual:.1e}")
    grid = found.grid
    priors = [f"rho = 0 beyond {math.degrees(support):g} deg"] if support is not None else []
    priors += ["rho >= 0 and V >= 0"] if nonnegative else []
    if found.residual < _NOISELESS and not problem.noise_is_stated:
        spread = np.full(found.source.shape, found.error * math.sqrt(float(np.mean(found.source**2))))
        peak_at = grid.peak(found.coefficients, found.exposure)
        height = float(grid.evaluate(found.coefficients, peak_at))
        estimate = Estimate(
            method="few_captures",
            grid=grid,
            closed=found.closed,
            coefficients=found.coefficients,
            source=found.source,
            transport=found.transport,
            peak_at=peak_at,
            source_std=spread,
            shape_std=spread,
            brdf_std=lambda u: np.full(u.shape, found.error * height),
            predicted_error=found.error,
            chi_squared=math.nan,
            warnings=(),
            priors=tuple(priors),
            designs=found.designs,
        )
        return estimate, []
    start = (found.coefficients, found.source)
    estimate = _weighed(
        problem, grid, found.designs, start, found.closed, priors, nonnegative=nonnegative, support=support
    )
    if found.rise < _BORNE_OUT:
        doubt = (
            "a pattern five error bars from the one found explains the captures better than these bars, which are "
            "drawn at that one, would have it; capture more different patterns, more views or more light"
        )
        estimate = replace(estimate, warnings=(*estimate.warnings, doubt))
    return estimate, [replace(estimate, coefficients=r, source=v) for r, v in found.others]


def refit_scarce(problem: Problem, before: Estimate, *, nonnegative: bool, support: float | None) -> Estimate:
    """The maximum of the likelihood next to a pattern that was found for another wall: no search, and no other knots.

    Parameters
    ----------
    before:
        Of `solve_scarce`, for other exponents of the wall's factors (`facets`).
    """
    step = math.degrees(before.grid.step)
    grid, designs = problem.designs(step, degree=before.grid.degree, tolerance=1e-9)
    designs = restricted(grid, designs, support)
    start = (before.coefficients, before.source)
    return _weighed(
        problem, grid, designs, start, before.closed, before.priors, nonnegative=nonnegative, support=support
    )


def _weighed(
    problem: Problem,
    grid: SplineGrid,
    designs: list[sp.csr_array],
    start: tuple[Array, Array],
    closed: ClosedForm,
    priors: Sequence[str],
    *,
    nonnegative: bool,
    support: float | None,
) -> Estimate:
    """The maximum of the likelihood next to r and V, with its bound and its doubts."""
    summed = moments(problem.data, designs, problem.inverse_variance)
    fit = maximise(summed, best_nonnegative(summed, start[1]), start[0], nonnegative=nonnegative)
    transport = transport_of(designs, fit.coefficients)
    unknowns = int(np.count_nonzero(fit.coefficients)) + fit.source.size
    reduced = reduced_misfit(problem, transport, fit.source, unknowns)
    stated = problem.noise_is_stated
    sigma = math.sqrt(max(1.0, reduced) if stated else reduced)
    weights = problem.row_weights
    missed = float(np.linalg.norm(weights * (problem.data - transport @ fit.source)))
    missed /= float(np.linalg.norm(problem.weighted_data))
    peak_at = grid.peak(fit.coefficients, summed.exposure)
    bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=grid.row(peak_at))
    warnings = doubts_of_fit(converged=fit.converged, misfit=reduced if stated else None)
    chance = _CHANCE / math.sqrt(summed.observations)
    if not stated and smoothness(problem, transport, fit.source) > max(_SMOOTH, chance):
        warnings.append(
            "what the fit leaves of the captures is alike in neighbouring pixels, so it is no noise, and the error bars, which "
            "take it for noise, may be too small"
        )
    if support is not None and _reaches_beyond(problem, grid, fit):
        warnings.append(
            f"the captures are explained far better by a BRDF that reaches beyond {math.degrees(support):g} deg, so the "
            "support that was named does not hold; the error bars do not know that"
        )
    return Estimate(
        method="few_captures",
        grid=grid,
        closed=replace(closed, mismatch=missed**2),
        coefficients=fit.coefficients,
        source=fit.source,
        transport=transport,
        peak_at=peak_at,
        source_std=sigma * bound.source_std,
        shape_std=sigma * bound.shape_std,
        brdf_std=lambda u: sigma * bound.brdf_std(grid, u),
        predicted_error=sigma * bound.source_error,
        chi_squared=reduced if stated else math.nan,
        warnings=tuple(warnings),
        priors=tuple(priors),
        designs=designs,
    )


def _reaches_beyond(problem: Problem, grid: SplineGrid, fit: Fit) -> bool:
    """Whether the pattern that was found has a far smaller misfit once the BRDF may reach beyond its support."""
    _, designs = problem.designs(math.degrees(grid.step), degree=grid.degree, tolerance=1e-5)
    summed = moments(problem.data, designs, problem.inverse_variance)
    free = maximise(summed, best_nonnegative(summed, fit.source), nonnegative=False, max_iterations=3)
    added = max(1, int(np.count_nonzero(summed.seen)) - int(np.count_nonzero(fit.coefficients)))
    noise = free.objective / max(1, summed.observations - summed.size)
    return (fit.objective - free.objective) / added > _BEYOND * noise
