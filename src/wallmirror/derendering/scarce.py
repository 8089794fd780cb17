"""Fewer captures than elements, made an estimate: the search finds the pattern, the likelihood weighs what it knows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.few_captures import STEPS, few_captures
from wallmirror.derendering.likelihood import best_nonnegative, maximise, moments
from wallmirror.derendering.problem import Problem

# A residual below this is a spline's own error or rounding, and no noise that a likelihood could weigh.
_NOISELESS = 1e-6


def solve_scarce(
    problem: Problem,
    *,
    nonnegative: bool,
    support: float | None,
    step_deg: float | None,
    seed: int,
    tell: Callable[[str], None] = lambda _: None,
) -> Estimate:
    """Search from random patterns; where there is noise, climb to the likelihood's maximum from what was found.

    Parameters
    ----------
    support:
        rho(u) = 0 for |u| > support, in radians.

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
    warnings: tuple[str, ...] = ()
    if found.residual < _NOISELESS and not problem.noise_is_stated:
        spread = np.full(found.source.shape, found.error * math.sqrt(float(np.mean(found.source**2))))
        peak_at = grid.peak(found.coefficients, found.exposure)
        height = float(grid.evaluate(found.coefficients, peak_at))
        return Estimate(
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
            warnings=warnings,
            priors=tuple(priors),
        )
    designs = found.designs
    summed = moments(problem.data, designs, problem.inverse_variance)
    fit = maximise(summed, best_nonnegative(summed, found.source), nonnegative=nonnegative)
    transport = np.stack([t @ fit.coefficients for t in designs], axis=1)
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    missed = float(np.sum(np.where(problem.noisy, weights * (problem.data - transport @ fit.source) ** 2, 0.0)))
    unknowns = int(np.count_nonzero(fit.coefficients)) + fit.source.size
    reduced = missed / max(1, int(np.count_nonzero(problem.noisy)) - unknowns)
    stated = problem.noise_is_stated
    sigma = math.sqrt(max(1.0, reduced) if stated else reduced)
    peak_at = grid.peak(fit.coefficients, summed.exposure)
    bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=grid.row(peak_at))
    if not fit.converged:
        warnings = ("the fit stopped before it converged, so the error bars may be too small",)
    if stated and reduced > 1.2:
        warnings += (f"the misfit is {reduced:.2f} times the stated noise; the error bars were widened to match",)
    return Estimate(
        method="few_captures",
        grid=grid,
        closed=found.closed,
        coefficients=fit.coefficients,
        source=fit.source,
        transport=transport,
        peak_at=peak_at,
        source_std=sigma * bound.source_std,
        shape_std=sigma * bound.shape_std,
        brdf_std=lambda u: sigma * bound.brdf_std(grid, u),
        predicted_error=sigma * bound.source_error,
        chi_squared=reduced if stated else math.nan,
        warnings=warnings,
        priors=tuple(priors),
    )
