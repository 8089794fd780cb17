"""Blind de-rendering of a capture set: which method, which knot spacing, and what the certificates say.

The closed form (`subspace`) is exact without noise. With noise it is the start of the maximum likelihood fit
(`likelihood`), whose error bars come from the Cramer-Rao bound (`bounds`). Every result carries its doubts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.captures import CaptureSet
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.likelihood import Fit, Moments, best_nonnegative, maximise, moments
from wallmirror.derendering.one_bounce import check_one_bounce
from wallmirror.derendering.problem import Problem, prepare
from wallmirror.derendering.solution import Solution, conclude
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

Method = Literal["auto", "closed_form", "maximum_likelihood"]

#: Knot spacings in degrees, tried in turn while finer ones still pay.
_EXACT_STEPS = (1.0, 0.25, 0.125, 0.0625, 0.03125)
_NOISY_STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
_EXACT_DEGREE = 7
_NOISY_DEGREE = 3
# Below this mismatch the data count as free of noise: float64 renders end near 1e-24, float32 files near 1e-13.
_NOISELESS = 1e-15
# A misfit in units of the noise up to which finer knots are tried out before they are taken.
_NEARLY_THERE = 3.0
# At this mismatch rounding is all that is left: finer knots could only add to it.
_EXACT = 3e-23


def solve(
    captures: CaptureSet,
    *,
    method: Method = "auto",
    nonnegative: bool = True,
    step_deg: float | None = None,
    wall_albedo: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Solution:
    """Recover the card's pattern and the wall's BRDF together from a capture set.

    Parameters
    ----------
    captures:
        Radiance (A, N, B) with geometry and, if known, variances.
    method:
        "closed_form" (exact without noise), "maximum_likelihood", or "auto": the closed form when its own
        certificate finds no noise, else maximum likelihood.
    nonnegative:
        Keep rho >= 0 and V >= 0 in the maximum likelihood fit.
    step_deg:
        Knot spacing of the BRDF in degrees; chosen by the data when left out.
    wall_albedo:
        The wall's directional albedo at normal incidence, if known: sets the scale of the check of Hypothesis 2, which
        runs where card or room reflect.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        For an unknown method or a spacing out of range.
    UndeterminedError
        When the data cannot determine the answer, with what would.
    """
    if method not in get_args(Method):
        raise InputError(f'is "{method}"; choose one of {", ".join(get_args(Method))}', field="method")
    if step_deg is not None and not 0.001 <= step_deg <= 45:
        raise InputError(f"is {step_deg:g}; give a knot spacing from 0.001 to 45 degrees", field="step_deg")
    if wall_albedo is not None and not 0 < wall_albedo <= 1:
        raise InputError(f"is {wall_albedo:g}; an albedo lies between 0 and 1", field="wall_albedo")
    started = time.perf_counter()
    tell = progress or (lambda _: None)
    # The matrices are small: two BLAS threads that wait for each other are up to a hundred times slower than one.
    with threadpool_limits(limits=1, user_api="blas"):
        problem, space = prepare(captures)
        estimate = None
        if method == "closed_form" or (method == "auto" and not problem.noise_is_stated):
            tell("closed form")
            exact = _closed_form(problem, space, (step_deg,) if step_deg else _EXACT_STEPS)
            if method == "closed_form" or exact.closed.mismatch < _NOISELESS:
                estimate = exact
        if estimate is None:
            tell("maximum likelihood")
            steps = (step_deg,) if step_deg else _NOISY_STEPS
            estimate = _maximum_likelihood(problem, space, steps, nonnegative, tell)
        check = check_one_bounce(problem, estimate, wall_albedo=wall_albedo)
        return conclude(problem, space, estimate, check, seconds=lambda: time.perf_counter() - started)


def _closed_form(problem: Problem, space: SignalSpace, steps: tuple[float, ...]) -> Estimate:
    """Refine the knots while that halves the error bound and rounding is not reached, then try a spacing in between."""

    def at(step: float) -> tuple[SplineGrid, ClosedForm, list[sp.csr_array]]:
        grid, designs = problem.designs(step, degree=_EXACT_DEGREE, tolerance=1e-9)
        return grid, closed_form(problem.weighted_data, problem.weighted(designs), space), designs

    grid, closed, designs = at(steps[0])
    for step in steps[1:]:
        if closed.mismatch < _EXACT:
            break
        finer = at(step)
        # Not the mismatch alone: a grid finer than the pixels fits anything, and its gap says so.
        if finer[1].error > closed.error / 2:
            halfway = at(2 * step)
            if halfway[1].error < closed.error / 2:
                grid, closed, designs = halfway
            break
        grid, closed, designs = finer
    warnings: tuple[str, ...] = ()
    if closed.mismatch > 1e-8:
        warnings = (
            f"the closed form misses the data by {math.sqrt(closed.mismatch):.1e}: there is noise or the geometry is "
            "off, and maximum likelihood would do better",
        )
    error = closed.error
    weights = problem.row_weights
    transport = np.stack([t @ closed.coefficients for t in designs], axis=1)
    peak_at = grid.peak(closed.coefficients, closed.exposure)
    peak = float(grid.evaluate(closed.coefficients, peak_at))
    np.divide(closed.transport, weights, out=transport, where=weights > 0)
    spread = np.full(closed.source.shape, error * float(np.sqrt(np.mean(closed.source**2))))
    return Estimate(
        method="closed_form",
        grid=grid,
        closed=closed,
        coefficients=closed.coefficients,
        source=closed.source,
        transport=transport,
        peak_at=peak_at,
        source_std=spread,
        shape_std=spread,
        brdf_std=lambda u: np.full(u.shape, error * peak),
        predicted_error=error,
        chi_squared=math.nan,
        warnings=warnings,
    )


def _fit(summed: Moments, starts: list[Array], nonnegative: bool) -> Fit:
    """The maximum of the likelihood; with bounds, the best of those reached from the free maximum and the starts.

    Clipping a start can throw it into the valley of another maximum, so the first start is the best rho >= 0 for the
    free maximum's pattern. The free maximum also tells whether the bounds are reached well: where the truth keeps
    them they cost about one unit of noise variance a coefficient, not more.
    """
    free = maximise(summed, *starts, nonnegative=False)
    if not nonnegative:
        return free
    noise = free.objective / max(1, summed.observations - summed.size)
    acceptable = free.objective + 3 * summed.size * noise
    bounded: list[Fit] = []
    for start in (best_nonnegative(summed, free.source), *starts):
        bounded.append(maximise(summed, start))
        if bounded[-1].objective <= acceptable:
            break
    return min(bounded, key=lambda fit: fit.objective)


@dataclass(frozen=True)
class _Level:
    """A knot spacing with the best fit on it."""

    grid: SplineGrid
    designs: list[sp.csr_array]
    summed: Moments
    closed: ClosedForm
    fit: Fit

    def rho(self, u: Array) -> Array:
        return self.grid.evaluate(self.fit.coefficients, u)

    @property
    def parameters(self) -> int:
        return int(np.count_nonzero(self.fit.coefficients))


def _pays(problem: Problem, best: _Level, fit: Fit, summed: Moments) -> bool:
    """Whether finer knots explain more than as many coefficients would of noise (Akaike 1974)."""
    variance = 1.0 if problem.noise_is_stated else fit.objective / max(1, summed.observations - summed.size)
    added = int(np.count_nonzero(fit.coefficients)) - best.parameters
    return best.fit.objective - fit.objective >= 2 * max(added, 1) * variance


def _refine(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...],
    nonnegative: bool,
    tell: Callable[[str], None],
) -> _Level:
    """Halve the knot spacing while that pays."""
    best: _Level | None = None
    idle = 0
    for step in steps:
        grid, designs = problem.designs(step, degree=_NOISY_DEGREE, tolerance=1e-5)
        summed = moments(problem.data, designs, problem.inverse_variance)
        try:
            fit = closed = None
            start = None if best is None else grid.interpolate(best.rho)
            if best is not None and start is not None and best.fit.objective < _NEARLY_THERE * summed.observations:
                # Two steps from the coarser fit tell whether the finer knots can pay at all, before anything dearer.
                fit = maximise(summed, start, nonnegative=nonnegative, max_iterations=2)
            if best is None or fit is None or _pays(problem, best, fit, summed):
                closed = closed_form(problem.weighted_data, problem.weighted(designs), space)
                starts = [closed.coefficients] if start is None else [closed.coefficients, start]
                fit = _fit(summed, starts, nonnegative)
        except UndeterminedError:
            if best is None:
                raise
            break  # so fine a grid has cells that nothing determines
        assert fit is not None
        tell(f"knots every {step:g} deg: misfit {fit.objective:.6g}")
        if closed is None or (best is not None and not _pays(problem, best, fit, summed)):
            assert best is not None
            # One idle halving ends the search, unless the noise is known and not yet reached.
            idle += 1
            observations = best.summed.observations
            reached = best.fit.objective < observations + 4 * math.sqrt(2 * observations)
            if idle == 2 or (reached if problem.noise_is_stated else step < steps[1]):
                break
            continue
        best, idle = _Level(grid, designs, summed, closed, fit), 0
    assert best is not None
    return best


def _maximum_likelihood(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...],
    nonnegative: bool,
    tell: Callable[[str], None],
) -> Estimate:
    """The best fit over the knot spacings, with error bars from its bound and doubts from its misfit."""
    level = _refine(problem, space, steps, nonnegative, tell)
    grid, summed, fit = level.grid, level.summed, level.fit
    transport = np.stack([t @ fit.coefficients for t in level.designs], axis=1)
    stated = problem.noise_is_stated
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ fit.source) ** 2, 0.0)
    freedom = max(1, int(np.count_nonzero(problem.noisy)) - level.parameters - fit.source.size)
    reduced = float(np.sum(counted)) / freedom
    # Where the noise is stated, a misfit beyond it widens the bars; where it is not, the misfit is the noise.
    sigma = math.sqrt(max(1.0, reduced) if stated else reduced)
    peak_at = grid.peak(fit.coefficients, summed.exposure)
    bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=grid.row(peak_at))
    warnings = []
    if not fit.converged:
        warnings.append("the fit stopped before it converged, so the error bars may be too small")
    if stated and reduced > 1.2:
        warnings.append(
            f"the misfit is {reduced:.2f} times the stated noise, so the model (one bounce, angle-sum BRDF, geometry) or "
            "the stated variances do not hold; the error bars were widened to match"
        )
    return Estimate(
        method="maximum_likelihood",
        grid=grid,
        closed=level.closed,
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
    )
