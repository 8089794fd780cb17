"""Maximum likelihood with its knots chosen by the data: the method for captures with noise.

The closed form is the start, the Cramer-Rao bound the error bars (Akaike 1974 chooses the knots). What the fit cannot
vouch for it refuses: patterns that do not stand out of the noise that was found, and knots that nothing determines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound, cramer_rao
from wallmirror.derendering.estimate import Estimate, scale_free_error
from wallmirror.derendering.likelihood import Fit, Moments, best_nonnegative, maximise, moments
from wallmirror.derendering.problem import Problem, expected_mismatch, reduced_misfit, too_few_patterns
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form, noise_edge
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

#: Knot spacings in degrees, tried in turn while finer ones still pay.
NOISY_STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
_DEGREE = 3
# A misfit in units of the noise up to which finer knots are tried out before they are taken.
_NEARLY_THERE = 3.0
# A mismatch in units of what noise makes of it, beyond which knots are too coarse to be fitted; and the share of it below
# which the gap says that they are too fine.
_FAR_OFF = 2.0
_GAP = 1.0
# A misfit that falls by this factor when the knots are halved has not come down to the noise.
_PLATEAU = 10.0
# The pattern may move by this many of its error bars when the knots are halved.
_STEADY = 3.0
# Quadrature of the fit, of a lobe's peak; and the share of a tolerance below which a move of the pattern is none.
_FINEST_QUADRATURE = 1e-5
_SETTLED = 0.25


@dataclass(frozen=True)
class Level:
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

    @cached_property
    def peak_at(self) -> float:
        return self.grid.peak(self.fit.coefficients, self.summed.exposure)

    @cached_property
    def bound(self) -> Bound:
        gauge = self.grid.row(self.peak_at)
        return cramer_rao(self.summed, self.fit.coefficients, self.fit.source, gauge=gauge)


def solve_noisy(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...] = NOISY_STEPS,
    *,
    nonnegative: bool = True,
    tolerance: float | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Estimate:
    """The best fit over the knot spacings, with error bars from its bound and doubts from its misfit.

    Parameters
    ----------
    tolerance:
        Relative error of the pattern that is good enough: knots are halved no further once the noise is reached and the
        last halving moved the pattern by a quarter of it, and the quadrature is no finer than it needs.

    Raises
    ------
    UndeterminedError
        If fewer patterns than elements stand out of the noise, or no knots are coarse enough to be determined.
    """
    refined = refine(problem, space, steps, nonnegative=nonnegative, tolerance=tolerance, tell=tell)
    level, rival = refined.level, refined.rival
    grid, fit, bound = level.grid, level.fit, level.bound
    transport = np.stack([t @ fit.coefficients for t in level.designs], axis=1)
    stated = problem.noise_is_stated
    reduced = reduced_misfit(problem, transport, fit.source, level.parameters + fit.source.size)
    # Where the noise is stated, a misfit beyond it widens the bars; where it is not, the misfit is the noise.
    sigma = math.sqrt(max(1.0, reduced) if stated else reduced)
    require_patterns(problem, transport, fit.source, sigma)
    predicted = sigma * bound.source_error
    shape_std = sigma * bound.shape_std
    warnings = []
    if not stated and _still_falls(refined):
        # What is left is the spline's own error, which the bound knows nothing of.
        assert refined.before is not None
        moved = scale_free_error(refined.before.source, fit.source)
        if moved > predicted:
            shape_std = shape_std * (moved / predicted)
            predicted = moved
            warnings.append(
                "the misfit still falls with finer knots than the captures allow, so it is no noise; the error bars are how "
                "far the pattern moved when the knots were last halved"
            )
    if not fit.converged:
        warnings.append("the fit stopped before it converged, so the error bars may be too small")
    if stated and reduced > 1.2:
        warnings.append(
            f"the misfit is {reduced:.2f} times the stated noise, so the model (one bounce, angle-sum BRDF, geometry) or "
            "the stated variances do not hold; the error bars were widened to match"
        )
    if rival is not None:
        moved = scale_free_error(rival.source, fit.source)
        if moved > _STEADY * predicted:
            warnings.append(
                f"the pattern moves by {100 * moved:.2g} % when the BRDF's knots are halved, where its error bars allow "
                f"{100 * predicted:.2g} %: the captures hardly tell the BRDF's detail from the pattern"
            )
    return Estimate(
        method="maximum_likelihood",
        grid=grid,
        closed=level.closed,
        coefficients=fit.coefficients,
        source=fit.source,
        transport=transport,
        peak_at=level.peak_at,
        source_std=sigma * bound.source_std,
        shape_std=shape_std,
        brdf_std=lambda u: sigma * bound.brdf_std(grid, u),
        predicted_error=predicted,
        chi_squared=reduced if stated else math.nan,
        warnings=tuple(warnings),
    )


@dataclass(frozen=True)
class Refined:
    """The level that the data chose, and the fits on finer knots that did not pay and on the coarser before."""

    level: Level
    rival: Fit | None
    before: Fit | None


def refine(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...],
    *,
    nonnegative: bool,
    tolerance: float | None = None,
    tell: Callable[[str], None],
) -> Refined:
    """Halve the knot spacing while that pays, and go back where the bound says that nothing determines the finest."""
    begin = _first_worth_a_fit(problem, space, steps)
    while True:
        try:
            levels, rival = _halve(problem, space, steps[begin:], nonnegative, tolerance, tell)
        except UndeterminedError:
            if begin == 0 and space.rank < problem.card.elements:
                raise too_few_patterns(space.rank, problem.card.elements) from None
            if begin == 0:
                raise
            levels, rival = [], None
        # Knots so fine that some cells are determined by nothing: those before them explain nearly as much.
        while levels and not math.isfinite(levels[-1].bound.source_error):
            levels, rival = levels[:-1], None
        if levels or begin == 0:
            break
        begin, steps = begin - 1, steps[:begin]
    if not levels:
        raise UndeterminedError(
            "the captures leave the pattern undetermined on the coarsest knots already; capture more light, views or patterns"
        )
    return Refined(levels[-1], rival, levels[-2].fit if len(levels) > 1 else None)


def _still_falls(refined: Refined) -> bool:
    """Whether the last halving of the knots took most of the misfit away and no finer knots show where it ends."""
    before, fit, rival = refined.before, refined.level.fit, refined.rival
    if before is None or before.objective < _PLATEAU * fit.objective:
        return False
    return rival is None or rival.objective < fit.objective / 2


def _halve(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...],
    nonnegative: bool,
    tolerance: float | None,
    tell: Callable[[str], None],
) -> tuple[list[Level], Fit | None]:
    """The levels taken, and the fit on finer knots that were not."""
    levels: list[Level] = []
    rival: Fit | None = None
    idle = 0
    quadrature = _quadrature(problem, tolerance)
    for step in steps:
        best = levels[-1] if levels else None
        grid, designs = problem.designs(step, degree=_DEGREE, tolerance=quadrature)
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
        tell(f"knots every {step:g} deg: misfit {fit.objective:.6g}")
        if closed is None or (best is not None and not _pays(problem, best, fit, summed)):
            assert best is not None
            rival = rival or fit
            # One idle halving ends the search, unless the noise is known and not yet reached.
            idle += 1
            if idle == 2 or (_at_the_noise(best) if problem.noise_is_stated else step < steps[1]):
                break
            continue
        levels.append(Level(grid, designs, summed, closed, fit))
        rival, idle = None, 0
        if tolerance is not None and best is not None and problem.noise_is_stated and _at_the_noise(levels[-1]):
            moved = scale_free_error(best.fit.source, fit.source)
            if moved <= _SETTLED * tolerance:
                tell(f"the pattern moved by {moved:.1e} only: knots are fine enough for {tolerance:g}")
                break
    return levels, rival


def _quadrature(problem: Problem, tolerance: float | None) -> float:
    """Quadrature error, of a lobe's peak, that a tolerance of the pattern allows and the noise hides."""
    if tolerance is None or problem.inverse_variance is None or not problem.noise_is_stated:
        return _FINEST_QUADRATURE
    weights = problem.inverse_variance[problem.inverse_variance > 0]
    hidden = 0.1 / math.sqrt(float(np.median(weights)))
    return min(1e-3, max(_FINEST_QUADRATURE, min(1e-2 * tolerance, hidden)))


def _at_the_noise(level: Level) -> bool:
    """Whether the misfit is what the stated noise makes."""
    observations = level.summed.observations
    return level.fit.objective < observations + 4 * math.sqrt(2 * observations)


def _first_worth_a_fit(problem: Problem, space: SignalSpace, steps: tuple[float, ...]) -> int:
    """Index of the first knots whose closed form misses the data's space by about what noise makes it miss.

    Coarser ones are far from explaining the films, and a fit on them would only be a start for the next. Where none
    comes near, or the noise is not known, the search begins with the coarsest.
    """
    if space.rank < problem.card.elements:
        return 0
    for index, step in enumerate(steps):
        _, designs = problem.designs(step, degree=_DEGREE, tolerance=1e-4)
        closed = closed_form(problem.weighted_data, problem.weighted(designs), space)
        expected = expected_mismatch(problem, space, closed)
        if not closed.mismatch > _FAR_OFF * expected:
            return 0 if math.isnan(expected) else index
        if closed.gap < _GAP * closed.mismatch:
            break
    return 0


def _pays(problem: Problem, best: Level, fit: Fit, summed: Moments) -> bool:
    """Whether finer knots explain more than as many coefficients would of noise (Akaike 1974)."""
    variance = 1.0 if problem.noise_is_stated else fit.objective / max(1, summed.observations - summed.size)
    added = int(np.count_nonzero(fit.coefficients)) - best.parameters
    return best.fit.objective - fit.objective >= 2 * max(added, 1) * variance


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


def require_patterns(problem: Problem, transport: Array, source: Array, sigma: float) -> None:
    """Refuse a fit whose weakest pattern may be noise.

    Were there one pattern less, the fit would have shaped one from noise. The term f v^T that it adds to the films has
    an f that is a mixture of F's M columns, and F itself may only turn such that the patterns which are there stay:
    M more numbers, as many as the pattern that trades with the BRDF has. So noise lends the term no larger a singular
    value than that of a matrix of 2 M rows and B columns.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B) that were fitted.
    sigma:
        Standard deviation of the noise in units of the weights.
    """
    elements, realisations = source.shape
    triangle = np.linalg.qr(problem.row_weights * transport, mode="r")
    strength = np.linalg.svd(triangle @ source, compute_uv=False)
    edge = noise_edge(min(2 * elements, problem.data.shape[0]), realisations)
    found = int(np.count_nonzero(strength > sigma * edge))
    if found < elements:
        raise too_few_patterns(found, elements)
