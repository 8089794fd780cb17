"""Photon counts made an estimate: knots by the normal likelihood, the answer and its bars by that of Poisson."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.borrowed import doubts_of_borrowing
from wallmirror.derendering.bounds import Bound
from wallmirror.derendering.estimate import Estimate, doubts_of_fit
from wallmirror.derendering.knots import refine
from wallmirror.derendering.nested import NOISY_STEPS
from wallmirror.derendering.patterns import trusted_bound
from wallmirror.derendering.poisson import maximise_poisson, poisson_bound
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import transport_of
from wallmirror.derendering.subspace import SignalSpace
from wallmirror.errors import InputError

Array = NDArray[np.float64]

# Counts that scatter less than this share of what counting makes are none.
_TOO_QUIET = 0.8
# Counts of a pixel up to which float64 tells each from the next.
_MOST_COUNTS = 2.0**53


def prepare_counts(captures: CaptureSet, *, per_radiance: float, background: float) -> tuple[Problem, SignalSpace]:
    """Captures made ready with the variances that counting gives each pixel, its mean over the realisations taken as its rate.

    One variance for all realisations of a pixel keeps the normal fit, which is only the start, cheap. What saturates stays
    out.

    Raises
    ------
    InputError
        For more counts than float64 tells apart.
    UndeterminedError
        As `prepare`.
    """
    used = np.ones(captures.radiance.shape, dtype=bool) if captures.variance is None else np.isfinite(captures.variance)
    # In a power of two near the brightest pixel, so that no variance leaves the range of float64.
    brightest = float(np.abs(captures.radiance).max(initial=0.0, where=used))
    exponent = math.frexp(brightest)[1]
    films = np.ldexp(np.clip(captures.radiance, -brightest, brightest), -exponent)
    with np.errstate(over="ignore", divide="ignore"):
        each = np.ldexp(per_radiance, exponent)
        if not each <= _MOST_COUNTS:
            raise InputError(
                f"is {per_radiance:g}, which makes {brightest * each / 2.0**exponent:.2g} counts of the brightest pixel; "
                f"give one that makes {_MOST_COUNTS:.0e} at most",
                field="counts_per_radiance",
            )
        number = np.maximum(np.count_nonzero(used, axis=2, keepdims=True), 1)
        mean = np.maximum(np.sum(films, axis=2, keepdims=True, where=used) / number, 0.0)
        variance = np.minimum((mean * each + max(background, 1.0)) / each / each, np.finfo(np.float64).max)
    counted = replace(captures, radiance=films, variance=np.where(used, variance, np.inf), variance_is_floor=False)
    problem, space = prepare(counted, weak_patterns=True)
    return replace(problem, captures=captures, scale=math.ldexp(problem.scale, exponent)), space


def solve_counts(
    problem: Problem,
    space: SignalSpace,
    *,
    per_radiance: float,
    background: float,
    nonnegative: bool,
    steps: tuple[float, ...] = NOISY_STEPS,
    tell: Callable[[str], None] = lambda _: None,
) -> Estimate:
    """Fit the Poisson likelihood of counts on the knots that the normal likelihood of like variance prefers.

    Parameters
    ----------
    per_radiance:
        Counts that a radiance of 1 makes in a pixel.
    background:
        Mean counts of a pixel without the card, known.

    Raises
    ------
    UndeterminedError
        When the counts do not determine the pattern.
    """
    level = refine(problem, space, steps, nonnegative=nonnegative, tell=tell).level
    grid, designs = level.grid, level.designs
    unit = problem.scale * per_radiance  # counts per unit of the normalised data
    used = problem.inverse_variance > 0 if problem.inverse_variance is not None else np.ones_like(problem.noisy)
    counts = np.maximum(problem.data * unit + background, 0.0)
    fit = maximise_poisson(
        counts,
        designs,
        level.fit.coefficients,
        source=level.fit.source * unit,
        background=background,
        used=used,
        nonnegative=nonnegative,
    )
    tell(f"Fisher scoring: {fit.gain:.3g} nats above the normal fit after {fit.iterations} steps")
    peak_at = grid.peak(fit.coefficients, level.summed.exposure)

    def bound_at(pattern: Array) -> Bound:
        return poisson_bound(
            designs, fit.coefficients, pattern * unit, gauge=grid.row(peak_at), background=background, used=used
        )

    sigma = math.sqrt(max(1.0, fit.chi_squared))
    transport = transport_of(designs, fit.coefficients)
    source = fit.source / unit
    bound, doubts = trusted_bound(
        problem, level, transport, source, sigma=sigma, bound=bound_at(source), bound_at=bound_at
    )
    borrowed = doubts_of_borrowing(problem, level, sigma)
    warnings = [*doubts, *borrowed, *doubts_of_fit(converged=fit.converged, misfit=None)]
    if fit.chi_squared > 1.2:
        warnings.append(
            f"the counts scatter {fit.chi_squared:.2f} times as much as counting alone, so the model or the counts per "
            "radiance do not hold; the error bars were widened to match"
        )
    if fit.chi_squared < _TOO_QUIET:
        warnings.append(
            f"the counts scatter only {fit.chi_squared:.2g} times as much as counting makes them, so they are no counts or the "
            "counts per radiance are too few; the error bars are too wide"
        )
    return Estimate(
        method="poisson",
        grid=grid,
        closed=level.closed,
        coefficients=fit.coefficients,
        source=source,
        transport=transport,
        peak_at=peak_at,
        source_std=sigma * bound.source_std / unit,
        shape_std=sigma * bound.shape_std / unit,
        brdf_std=lambda u: sigma * bound.brdf_std(grid, u),
        predicted_error=sigma * bound.source_error,
        chi_squared=fit.chi_squared,
        warnings=tuple(warnings),
        designs=designs,
    )
