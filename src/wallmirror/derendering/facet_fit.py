"""Which wall an answer rests on: a function of the angle sum, or facets fitted in its place.

Every method has its fit of r and V at given exponents of the factors (`facets`) and its check that says which exponents would
have been better (`angle_sum_check`, `angle_sum_quiet`). A wall of facets is the two in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from wallmirror.derendering.angle_sum_check import AngleSumCheck, in_words
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.facets import EVERY, FITTED, Factor
from wallmirror.derendering.problem import Problem
from wallmirror.errors import InputError, UndeterminedError

WallModel = Literal["auto", "angle_sum", "microfacet"]
#: Finds r and V at the exponents that a problem assumes.
Fit = Callable[[Problem], Estimate]
#: Holds an estimate against walls with further factors.
Check = Callable[[Problem, Estimate, tuple[Factor, ...]], AngleSumCheck]

# Rounds of fit and check after which the exponents are taken as they are, and the turn, in error bars, that ends them.
_ROUNDS = 4
_SETTLED = 0.1
# Share of a turn from which on a forecast, which holds within a factor of two, may be all of it.
_EXCUSED = 0.5


def settle_wall(
    problem: Problem,
    estimate: Estimate,
    fit: Fit,
    check: Check,
    *,
    wall: WallModel,
    bounded: bool = False,
    foretold: Callable[[Problem, Estimate], float] = lambda problem, estimate: 0.0,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Problem, Estimate, AngleSumCheck]:
    """Hold an angle-sum estimate against walls of facets, and put one in its place if asked to or, with "auto", if it must be.

    Parameters
    ----------
    bounded:
        Whether the estimate's error is a bound, as the closed form's is, and mostly a wide one: then facets that turn the
        pattern by less are worth a fit too.
    foretold:
        The turn of the pattern that is foretold from the geometry, by light beyond one bounce: facets would take it up, so
        that "auto" fits none where it may be what the check has found.

    Returns
    -------
    As `fit_facets`; the problem and estimate as they were where the angle sum stands.

    Raises
    ------
    UndeterminedError
        When a wall of facets is asked for and the captures do not determine it.
    """
    found = check(problem, estimate, FITTED)
    if wall == "microfacet":
        return fit_facets(problem, found, fit, check, tell)
    bars = min(estimate.predicted_error, found.open) if bounded else estimate.predicted_error
    if wall == "auto" and found.rejects(bars) and foretold(problem, estimate) < _EXCUSED * found.bias:
        try:
            return fit_facets(problem, found, fit, check, tell)
        except (
            UndeterminedError,
            InputError,
        ) as refusal:  # nothing determines them, or the memory does not hold their knots
            tell(f"no wall of facets: {refusal}")
    return problem, estimate, found


def fit_facets(
    problem: Problem, found: AngleSumCheck, fit: Fit, check: Check, tell: Callable[[str], None] = lambda _: None
) -> tuple[Problem, Estimate, AngleSumCheck]:
    """Fit a wall of facets: the exponents of `facets.FITTED` in turn with r and V, from what a check of the angle sum found.

    Returns
    -------
    The problem with the exponents, the estimate at them, and its check against all factors.
    """
    for _ in range(_ROUNDS):
        problem = replace(problem, exponents={k: found.exponents[k] for k in FITTED})
        tell(f"a wall of facets, {in_words(problem.exponents)}")
        estimate = fit(problem)
        found = check(problem, estimate, FITTED)
        if found.bias < _SETTLED * math.hypot(estimate.predicted_error, found.open):
            break
    return problem, estimate, check(problem, estimate, EVERY)
