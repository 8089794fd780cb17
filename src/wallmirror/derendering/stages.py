"""The stages of a solve between its captures and its conclusion: ways to an estimate, and checks of the wall it rests on.

Few captures are searched, captures without noise have a closed form, and all others the maximum of a likelihood, of normal
noise or of counts. What was found is held against walls of facets (`facet_fit`), and what was searched for against the
other patterns that the search ended at (`rivals`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from wallmirror.captures import CaptureSet
from wallmirror.derendering.angle_sum_check import AngleSumCheck, check_angle_sum
from wallmirror.derendering.angle_sum_quiet import check_angle_sum_quietly
from wallmirror.derendering.conclusion import UNDETERMINED
from wallmirror.derendering.counting import prepare_counts, solve_counts
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.exact import solve_exactly
from wallmirror.derendering.facet_fit import Check, Fit, WallModel, settle_wall
from wallmirror.derendering.nested import NOISY_STEPS
from wallmirror.derendering.noisy import solve_noisy
from wallmirror.derendering.one_bounce import check_one_bounce
from wallmirror.derendering.options import Method
from wallmirror.derendering.pattern_space import NOISELESS, ROUNDING, expected_mismatch
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.rivals import hold_against_rivals
from wallmirror.derendering.scarce import refit_scarce, solve_scarce
from wallmirror.derendering.subspace import SignalSpace
from wallmirror.errors import UndeterminedError

# Without noise the closed form is taken up to this error: a misfit that is no noise would give a likelihood false bars.
_KNOWN = 0.1


@dataclass(frozen=True)
class Answer:
    """An estimate and what it rests on.

    Parameters
    ----------
    problem:
        With the exponents of the wall that was settled on.
    angle_sum:
        How the estimate stands against walls with further factors; None where that was not asked.
    quiet:
        Whether the captures show themselves that they have no noise.
    """

    problem: Problem
    estimate: Estimate
    angle_sum: AngleSumCheck | None = None
    quiet: bool = False


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What `solve` is asked for, and the stages that answer it.

    Parameters
    ----------
    few:
        Whether the method is that for few captures, asked for or by their number.
    wall:
        As for `solve`, but "angle_sum" where the scale leaves "auto" no other.
    method, nonnegative, support_deg, step_deg, background, wall_albedo, tolerance, seed:
        As for `solve`.
    counts_per_radiance:
        As for `solve`, given for the method "poisson" alone.
    tell:
        Called with a sentence at each stage.
    """

    method: Method
    few: bool
    wall: WallModel
    nonnegative: bool
    support_deg: float | None
    step_deg: float | None
    counts_per_radiance: float | None
    background: float
    wall_albedo: float | None
    tolerance: float | None
    seed: int
    tell: Callable[[str], None]

    def prepared(self, captures: CaptureSet) -> tuple[Problem, SignalSpace]:
        """The captures made ready, and the space of their patterns."""
        if self.counts_per_radiance is None:
            return prepare(captures, few_captures=self.few, weak_patterns=self.method != "closed_form")
        return prepare_counts(captures, per_radiance=self.counts_per_radiance, background=self.background)

    def answered(self, problem: Problem, space: SignalSpace) -> Answer:
        """The estimate that method and captures call for, held against the walls and the rivals that it may be mistaken for.

        Raises
        ------
        UndeterminedError
            When no method finds an estimate, or none of the wall that was asked for.
        """
        if self.few:
            return self._of_few_captures(problem)
        found = self._in_closed_form_or_likeliest(problem, space)
        estimate = found.estimate
        if self.wall == "microfacet" and estimate.groups:
            raise UndeterminedError(
                "a scale is open for each group of elements, and with it the exponents of a wall of facets; use views or a "
                "card whose reflections share more angles"
            )
        # A closed form has its wall settled by now, and bars that leave the pattern undetermined are refused in the end.
        if estimate.method == "closed_form" or not estimate.predicted_error <= UNDETERMINED:
            return found
        if estimate.groups:  # no facets are fitted to scales that are open
            return Answer(problem, estimate, check_angle_sum(problem, estimate), found.quiet)
        return Answer(*self._settled(problem, estimate, partial(self._fit, space=space), check_angle_sum), found.quiet)

    def _of_few_captures(self, problem: Problem) -> Answer:
        """A search that rests on priors, its wall settled next to the pattern that was found, and held against its rivals."""
        self.tell(
            f"{problem.captures.realisations} captures for {problem.card.elements} elements: search for few captures"
        )
        estimate, rivals = self._search(problem)
        if not estimate.predicted_error <= UNDETERMINED:
            return Answer(problem, estimate)
        refit = partial(refit_scarce, nonnegative=self.nonnegative, support=self._support)
        settled = self._settled(problem, estimate, partial(refit, before=estimate), check_angle_sum)
        held = hold_against_rivals(
            problem,
            settled,
            rivals,
            refit,
            check_angle_sum,
            lambda problem: self._search(problem)[0],
            wall=self.wall,
            excused=self._foretold(problem, settled[1]) if rivals else 0.0,
            tell=self.tell,
        )
        return Answer(*held)

    def _in_closed_form_or_likeliest(self, problem: Problem, space: SignalSpace) -> Answer:
        """The closed form where it was asked for or, without noise, has a narrow bound; else the likelihood's maximum."""
        may_be_exact = not problem.noise_is_stated and space.rank == problem.card.elements
        if self.method != "closed_form" and not (self.method == "auto" and may_be_exact):
            return self._likeliest(problem, space)
        exact = self._in_closed_form(problem, space)
        if self.method == "closed_form" or (exact.quiet and exact.estimate.predicted_error <= _KNOWN):
            return exact
        why = "its error bound is too large" if exact.quiet else "there is noise"
        self.tell(f"closed form misses the data by {exact.estimate.closed.mismatch:.1e}: {why}")
        return self._likeliest(problem, space, exact if exact.quiet else None)

    def _in_closed_form(self, problem: Problem, space: SignalSpace) -> Answer:
        """The closed form, its wall settled by its own mismatch where it is the answer or there is no noise."""
        self.tell(f"rank {space.rank} of {problem.card.elements}, no noise stated: closed form")
        fit = partial(solve_exactly, space=space, step_deg=self.step_deg)
        exact = fit(problem)
        # The singular values beyond M tell noise best: knots as fine as the pixels fit noise as well. Where there are none
        # beyond, a mismatch near rounding has to do.
        noise = expected_mismatch(problem, space, exact.closed)
        quiet = exact.closed.mismatch < NOISELESS if math.isnan(noise) else noise < ROUNDING
        if exact.closed.near_solutions == 1 and (quiet or self.method == "closed_form"):
            check = partial(check_angle_sum_quietly, space=space)
            return Answer(*self._settled(problem, exact, fit, check, bounded=True), quiet)
        return Answer(problem, exact, quiet=quiet)

    def _likeliest(self, problem: Problem, space: SignalSpace, exact: Answer | None = None) -> Answer:
        """The likelihood's maximum, or the closed form of captures without noise where it knows better what they leave open."""
        self.tell("maximum likelihood" if self.counts_per_radiance is None else "normal likelihood, then counts")
        try:
            estimate = self._fit(problem, space)
        except UndeterminedError:
            if exact is None:
                raise
            return exact  # with bars as wide as its bound, or refused for a better reason than the fit's
        if exact is not None and estimate.groups:
            return exact  # without noise it tells whether a scale each is all that is free
        return Answer(problem, estimate, quiet=exact is not None)

    def _fit(self, problem: Problem, space: SignalSpace) -> Estimate:
        """The maximum of the likelihood, of normal noise or of counts, at the exponents that the problem has."""
        steps = (self.step_deg,) if self.step_deg else NOISY_STEPS
        if self.counts_per_radiance is None:
            return solve_noisy(
                problem, space, steps, nonnegative=self.nonnegative, tolerance=self.tolerance, tell=self.tell
            )
        return solve_counts(
            problem,
            space,
            per_radiance=self.counts_per_radiance,
            background=self.background,
            nonnegative=self.nonnegative,
            steps=steps,
            tell=self.tell,
        )

    def _search(self, problem: Problem) -> tuple[Estimate, list[Estimate]]:
        """What a search for few captures finds at the exponents that the problem has, and its other ends."""
        return solve_scarce(
            problem,
            nonnegative=self.nonnegative,
            support=self._support,
            step_deg=self.step_deg,
            seed=self.seed,
            tell=self.tell,
        )

    def _settled(
        self, problem: Problem, estimate: Estimate, fit: Fit, check: Check, *, bounded: bool = False
    ) -> tuple[Problem, Estimate, AngleSumCheck]:
        """`settle_wall` for the wall that is asked for."""
        return settle_wall(
            problem, estimate, fit, check, wall=self.wall, bounded=bounded, foretold=self._foretold, tell=self.tell
        )

    def _foretold(self, problem: Problem, estimate: Estimate) -> float:
        """The turn of the pattern that light beyond one bounce is foretold to make."""
        further = check_one_bounce(problem, estimate, wall_albedo=self.wall_albedo)
        return 0.0 if further is None else further.bias

    @property
    def _support(self) -> float | None:
        return None if self.support_deg is None else math.radians(self.support_deg)
