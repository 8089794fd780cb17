"""Maximum likelihood with its knots chosen by the data: the method for captures with noise.

The closed form is the start, the Cramer-Rao bound the error bars; a score test chooses the knots (`knots`). What the fit cannot
vouch for it refuses: patterns that do not stand out of the noise that was found, and knots that nothing determines.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.borrowed import doubts_of_borrowing
from wallmirror.derendering.components import in_words
from wallmirror.derendering.estimate import Estimate, doubts_of_fit, scale_free_error
from wallmirror.derendering.knots import Refined, refine
from wallmirror.derendering.nested import NOISY_STEPS
from wallmirror.derendering.patterns import trusted_bound
from wallmirror.derendering.problem import Problem, reduced_misfit
from wallmirror.derendering.splines import transport_of
from wallmirror.derendering.subspace import SignalSpace

Array = NDArray[np.float64]

# A misfit that falls by this factor when the knots are halved has not come down to the noise.
_PLATEAU = 10.0
# The pattern may move by this many of its error bars when the knots are halved.
_STEADY = 3.0
# A move of the pattern that widens the error bars without a word.
_SLIGHT = 1e-3


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
    grid, fit = level.grid, level.fit
    transport = transport_of(level.designs, fit.coefficients)
    apart = level.groups.elements if len(level.groups) > 1 else ()
    stated = problem.noise_is_stated
    reduced = reduced_misfit(problem, transport, fit.source, level.parameters + fit.source.size)
    # Where the noise is stated, a misfit beyond it widens the bars; where it is not, the misfit is the noise.
    sigma = math.sqrt(max(1.0, reduced) if stated else reduced)
    bound, doubts = trusted_bound(
        problem, level, transport, fit.source, sigma=sigma, bound=level.bound, bound_at=level.bound_at
    )
    borrowed = doubts_of_borrowing(problem, level, sigma)
    predicted = sigma * bound.source_error
    shape_std = sigma * bound.shape_std
    warnings: list[str] = []
    if not stated and _still_falls(refined):
        # What is left is the spline's own error, which the bound knows nothing of.
        assert refined.before is not None
        moved = scale_free_error(refined.before.source, fit.source, apart)
        if moved > predicted:
            shape_std = shape_std * (moved / predicted)
            predicted = moved
            warnings.append(
                "the misfit still falls with finer knots than the captures allow, so it is no noise; the error bars are how "
                "far the pattern moved when the knots were last halved"
            )
    warnings += doubts_of_fit(converged=fit.converged, misfit=reduced if stated else None)
    if level.strained:
        # What the bounds hold back turns the pattern by as much as they move it.
        moved = scale_free_error(level.free.source, fit.source, apart)
        if moved > max(_STEADY * predicted, _SLIGHT):
            warnings.append(
                f"to keep BRDF and pattern >= 0 costs more misfit than noise explains and moves the pattern by "
                f"{100 * moved:.2g} %, so the knots are too coarse or the model (one bounce, angle-sum BRDF, geometry) does "
                "not hold"
            )
        if moved > predicted:
            shape_std, predicted = shape_std * (moved / predicted), moved
    if rival is not None:
        moved = scale_free_error(rival.source, level.free.source, apart)
        if moved > _STEADY * predicted:
            warnings.append(
                f"the pattern moves by {100 * moved:.2g} % when the BRDF's knots are halved, where its error bars allow "
                f"{100 * predicted:.2g} %: the captures hardly tell the BRDF's detail from the pattern"
            )
    if apart:
        warnings.append(in_words(apart))
    warnings += [*doubts, *borrowed]
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
        designs=level.designs,
        information=level.information,
        groups=apart,
    )


def _still_falls(refined: Refined) -> bool:
    """Whether the last halving of the knots took most of the misfit away and no finer knots show where it ends."""
    before, fit, rival = refined.before, refined.level.free, refined.rival
    if before is None or before.objective < _PLATEAU * fit.objective:
        return False
    return rival is None or rival.objective < fit.objective / 2
