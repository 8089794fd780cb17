"""Other patterns that a search ended at: might one of them be the truth, if the noise, or the wall, is taken for what it is?

Tests at a pattern know its neighbourhood alone, and a search ranks its ends by a model that may be wrong: before a wall of
facets a far pattern may explain the films better than the true one as long as both are held to the angle sum (Hypothesis 8).
So each end is climbed to the likelihood's maximum, with and without facets of its own (`facet_fit`), and the misfits

    Q = sum w (D - F V)^2

are compared. Where the true pattern is among the ends, another one whose fit has k free numbers can explain the films
better than it by no more than these take up of noise: chi-squared in k degrees of freedom, in units of the noise's
variance (Wilks, Ann. Math. Stat. 9(1), 1938). Ends within that of the best are as good as it; the noise is the best one's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from wallmirror.derendering.angle_sum_check import AngleSumCheck
from wallmirror.derendering.estimate import Estimate, scale_free_error
from wallmirror.derendering.facet_fit import Check, WallModel, fit_facets
from wallmirror.derendering.facets import FITTED
from wallmirror.derendering.problem import Problem, reduced_misfit
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

#: The likelihood's maximum next to an estimate, for a problem with any exponents.
Refit = Callable[[Problem, Estimate], Estimate]

#: Chance that noise lets a wrong pattern pass for the better one, as small as that of five standard deviations.
LEVEL = 6e-7
#: Error bars within which two patterns are one.
BARS = 5.0
#: Ends nearer than this are one, whatever the bars.
SAME = 1e-3


@dataclass(frozen=True)
class _Fitted:
    problem: Problem
    estimate: Estimate
    check: AngleSumCheck
    misfit: float

    @property
    def facets(self) -> bool:
        return bool(self.problem.exponents)

    @property
    def numbers(self) -> int:
        """Free numbers of the fit: what is above its bound of r, V without its scale, and the exponents."""
        estimate = self.estimate
        return int(np.count_nonzero(estimate.coefficients)) + estimate.source.size - 1 + len(self.problem.exponents)

    @property
    def variance(self) -> float:
        """Of the noise, in units of the stated one, or as the fit leaves it where none is stated."""
        estimate = self.estimate
        reduced = reduced_misfit(self.problem, estimate.transport, estimate.source, self.numbers)
        return max(1.0, reduced) if self.problem.noise_is_stated else reduced


def better_by_chance(numbers: int) -> float:
    """How much less than the true pattern's a fit's misfit may be, in variances of the noise, for its free numbers alone.

    Examples
    --------
    >>> 24.8 < better_by_chance(1) < 25.0
    True
    """
    return float(chi2.isf(LEVEL, numbers))


def hold_against_rivals(
    plain: Problem,
    answer: tuple[Problem, Estimate, AngleSumCheck],
    rivals: Sequence[Estimate],
    refit: Refit,
    check: Check,
    search: Callable[[Problem], Estimate],
    *,
    wall: WallModel,
    excused: float = 0.0,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Problem, Estimate, AngleSumCheck]:
    """The answer, or a rival that explains the films better than noise can make it; with a warning where one is as good.

    Parameters
    ----------
    plain:
        The problem without facets.
    answer:
        As `facet_fit.settle_wall` gives it.
    rivals:
        The other patterns, each the search's estimate with that one's r and V.
    search:
        The search for a problem with any exponents: a wall of facets that was fitted next to a pattern is searched once more.
    wall:
        What the wall may be: facets are an answer unless it is "angle_sum", and a reason to doubt even then.
    excused:
        Turn of the pattern that light beyond one bounce is foretold to make, which facets would take up: they may be no
        answer where the patterns differ by less than twice that.

    Raises
    ------
    UndeterminedError
        When a rival explains the films as well as the answer, on a wall of the same kind.
    """
    best = _best(plain, _fitted(*answer), rivals, refit, check, wall, excused, tell)
    if not best.facets:
        return best.problem, best.estimate, best.check
    tell("the search once more, on the wall of facets that was fitted")
    again = search(best.problem)
    differ = scale_free_error(again.source, best.estimate.source)
    if differ > max(SAME, BARS * best.estimate.predicted_error):
        raise UndeterminedError(
            f"a wall of facets was fitted next to a pattern that differs by {100 * differ:.2g} % from the one that suits "
            "such a wall best; capture more different patterns, more views or more light"
        )
    doubts = tuple(dict.fromkeys((*best.estimate.warnings, *again.warnings)))
    return best.problem, replace(best.estimate, warnings=doubts), best.check


def _best(
    plain: Problem,
    best: _Fitted,
    rivals: Sequence[Estimate],
    refit: Refit,
    check: Check,
    wall: WallModel,
    excused: float,
    tell: Callable[[str], None],
) -> _Fitted:
    """The answer, or the rival that is better; refused or with a warning where another one is as good."""
    apart = max(SAME, BARS * best.estimate.predicted_error)
    others = [r for r in rivals if scale_free_error(r.source, best.estimate.source) > apart]
    if not others:
        return best
    tell(f"{len(others)} other patterns that the search ended at, each at the likelihood's maximum")
    found = _fits(plain, others, refit, check, wall)
    if any(_as_good(f, best) for f in found) and not best.facets and wall == "auto":
        found += _fits(plain, [best.estimate], refit, check, "microfacet")
    allowed = [f for f in found if not f.facets or (wall != "angle_sum" and 2 * excused < _distance(f, best))]
    first = min(allowed, key=lambda f: f.misfit, default=best)
    if first.misfit < best.misfit - better_by_chance(first.numbers) * first.variance:
        tell(f"another pattern explains the films better{' with facets of its own' if first.facets else ''}")
        found.append(best)
        best = first
    near = [f for f in found if _distance(f, best) > max(SAME, BARS * best.estimate.predicted_error)]
    near = sorted((f for f in near if _as_good(f, best)), key=lambda f: f.misfit)
    if not near:
        return best
    alike = [f for f in near if f.facets == best.facets or wall == "microfacet"]
    if best.facets or alike:
        raise UndeterminedError(
            f"patterns that differ by {100 * _distance((alike or near)[0], best):.2g} % explain the captures about as well, "
            "and noise may decide between them; capture more different patterns, more views or more light"
        )
    doubt = (
        f"were the wall one of facets, a pattern that differs by {100 * _distance(near[0], best):.2g} % would explain the "
        "captures as well or better, of which the error bars do not know; capture more different patterns, more views or "
        "more light"
    )
    return replace(best, estimate=replace(best.estimate, warnings=(*best.estimate.warnings, doubt)))


def _fits(
    plain: Problem,
    starts: Sequence[Estimate],
    refit: Refit,
    check: Check,
    wall: WallModel,
) -> list[_Fitted]:
    """Each pattern at the likelihood's maximum, on a wall of the angle sum (unless that is ruled out) and on one of facets."""
    found = []
    for start in starts:
        try:
            estimate = refit(plain, start)
            here = _fitted(plain, estimate, check(plain, estimate, FITTED))
            if wall != "microfacet":
                found.append(here)
            found.append(_fitted(*fit_facets(plain, here.check, partial(_next_to, refit, estimate), check)))
        except (UndeterminedError, InputError):
            continue  # no maximum there that a bound could be found at, so that nothing speaks for it
    return found


def _next_to(refit: Refit, estimate: Estimate, problem: Problem) -> Estimate:
    return refit(problem, estimate)


def _fitted(problem: Problem, estimate: Estimate, check: AngleSumCheck) -> _Fitted:
    missed = problem.data - estimate.transport @ estimate.source
    return _Fitted(problem, estimate, check, float(np.sum(problem.fit_weights * missed**2)))


def _distance(one: _Fitted, other: _Fitted) -> float:
    return scale_free_error(one.estimate.source, other.estimate.source)


def _as_good(other: _Fitted, best: _Fitted) -> bool:
    """Whether `other` might be the truth and `best` better by chance."""
    return other.misfit <= best.misfit + better_by_chance(best.numbers) * best.variance
