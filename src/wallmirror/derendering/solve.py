"""Blind de-rendering of a capture set: which method, which knot spacing, and what the certificates say.

The closed form (`exact`) is exact without noise. With noise it is the start of the maximum likelihood fit (`noisy`), whose
error bars come from the Cramer-Rao bound (`bounds`). Every result carries its doubts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

from threadpoolctl import threadpool_limits

from wallmirror.captures import CaptureSet
from wallmirror.derendering.angle_sum_check import check_angle_sum, with_doubt
from wallmirror.derendering.angle_sum_quiet import check_angle_sum_quietly
from wallmirror.derendering.calibration import Calibration
from wallmirror.derendering.conclusion import UNDETERMINED, conclude
from wallmirror.derendering.counting import prepare_counts, solve_counts
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.exact import solve_exactly
from wallmirror.derendering.facet_fit import WallModel, settle_wall
from wallmirror.derendering.gauge import Gauge, Scale
from wallmirror.derendering.nested import NOISY_STEPS
from wallmirror.derendering.noisy import solve_noisy
from wallmirror.derendering.one_bounce import check_one_bounce
from wallmirror.derendering.options import Method, require_options, require_wall
from wallmirror.derendering.placed import widened
from wallmirror.derendering.problem import ROUNDING, Problem, expected_mismatch, prepare
from wallmirror.derendering.rivals import hold_against_rivals
from wallmirror.derendering.scarce import refit_scarce, solve_scarce
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.subspace import SignalSpace
from wallmirror.errors import InputError, UndeterminedError

# Below this mismatch the data count as free of noise: float64 renders end near 1e-24, float32 files near 1e-13.
_NOISELESS = 1e-15
# Without noise the closed form is taken up to this error: a misfit that is no noise would give a likelihood false bars.
_KNOWN = 0.1


def solve(
    captures: CaptureSet,
    *,
    method: Method = "auto",
    wall: WallModel = "auto",
    nonnegative: bool = True,
    support_deg: float | None = None,
    step_deg: float | None = None,
    counts_per_radiance: float | None = None,
    background: float = 0.0,
    scale: Scale = "peak",
    wall_albedo: float | None = None,
    source_level: float | None = None,
    tolerance: float | None = None,
    seed: int = 0,
    calibration: Calibration | None = None,
    progress: Callable[[str], None] | None = None,
) -> Solution:
    """Recover the card's pattern and the wall's BRDF together from a capture set.

    Parameters
    ----------
    captures:
        Radiance (A, N, B) with geometry and, if known, variances.
    method:
        "closed_form" (exact without noise), "maximum_likelihood" (normal noise), "few_captures" (fewer captures than
        elements, by a search that rests on the priors named), "poisson" (photon counts); or "auto": few captures where
        B < M, else the closed form when its own certificate finds no noise, else maximum likelihood.
    wall:
        "angle_sum" (Hypothesis 8: rho depends on the angle sum), "microfacet" (such a function times two factors of both
        angles whose exponents are fitted, see `facets`), or "auto": facets where the films reject the angle sum, no light
        beyond one bounce is foretold to look like that, and no albedo settles the scale. Where they do not reject it, the
        answer is that of "angle_sum".
    nonnegative:
        Keep rho >= 0 and V >= 0, except in the closed form.
    support_deg:
        A prior for few captures: rho = 0 where |u| is larger than this many degrees.
    step_deg:
        Knot spacing of the BRDF in degrees; chosen by the data when left out.
    counts_per_radiance, background:
        For "poisson": counts that a radiance of 1 makes, and mean counts of a pixel that the card does not light.
    scale:
        What settles the one scale that nobody can see: "peak" (max rho = 1), "albedo" (the wall's directional albedo is
        `wall_albedo`) or "level" (the pattern's mean is `source_level`).
    wall_albedo:
        The wall's directional albedo at normal incidence, if known: sets the scale of the check of Hypothesis 2, which
        runs where card or room reflect.
    tolerance:
        Relative error of the pattern that is good enough, for maximum likelihood: it sets the quadrature and ends the
        search for finer knots. Whether the answer keeps it, `predicted_error` tells.
    seed:
        Of the random starts of the search for few captures.
    calibration:
        Where `calibrate` found the card: it replaces the card of the captures, and its uncertainty widens the error bars.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        For an unknown method, or an option that is out of range or has no meaning for the method.
    UndeterminedError
        When the data cannot determine the answer, with what would.

    Examples
    --------
    >>> import wallmirror as wm
    >>> scene = wm.load_scene("flat_wall_lobes")
    >>> films = wm.radiance(wm.transport_matrix(scene.observer, scene.card, scene.wall.brdf), scene.source)
    >>> captures = wm.CaptureSet(observer=scene.observer, card=scene.card, radiance=films)
    >>> solution = solve(captures)
    >>> wm.scale_free_error(solution.source, scene.source) < 1e-6
    True
    """
    started = time.perf_counter()
    few = method == "few_captures" or (method == "auto" and captures.realisations < captures.card.elements)
    if tolerance is not None and not 0 < tolerance < 1:
        raise InputError(f"is {tolerance:g}; give a relative error between 0 and 1", field="tolerance")
    require_wall(wall, scale)
    require_options(method, few, support_deg, step_deg, counts_per_radiance, background, seed)
    gauge = Gauge(scale=scale, wall_albedo=wall_albedo, source_level=source_level)
    steps = (step_deg,) if step_deg else None
    history: list[str] = []
    filmed = captures
    if calibration is not None:
        captures = replace(captures, card=calibration.card)

    def tell(stage: str) -> None:
        history.append(stage)
        if progress is not None:
            progress(stage)

    # The matrices are small: two BLAS threads that wait for each other are up to a hundred times slower than one.
    with threadpool_limits(limits=1, user_api="blas"):
        if method == "poisson":
            assert counts_per_radiance is not None
            problem, space = prepare_counts(captures, per_radiance=counts_per_radiance, background=background)
        else:
            problem, space = prepare(captures, few_captures=few, weak_patterns=method != "closed_form")

        def fit(problem: Problem) -> Estimate:
            if method != "poisson":
                return solve_noisy(
                    problem, space, steps or NOISY_STEPS, nonnegative=nonnegative, tolerance=tolerance, tell=tell
                )
            assert counts_per_radiance is not None
            return solve_counts(
                problem,
                space,
                per_radiance=counts_per_radiance,
                background=background,
                nonnegative=nonnegative,
                steps=steps or NOISY_STEPS,
                tell=tell,
            )

        closed = partial(solve_exactly, space=space, step_deg=step_deg)
        quietly = partial(check_angle_sum_quietly, space=space)

        def foretold(problem: Problem, estimate: Estimate) -> float:
            further = check_one_bounce(problem, estimate, wall_albedo=wall_albedo)
            return 0.0 if further is None else further.bias

        # A scale that an albedo settles is that of a function of the angle sum.
        model: WallModel = "angle_sum" if wall == "auto" and scale == "albedo" else wall
        settle = partial(settle_wall, wall=model, foretold=foretold, tell=tell)
        estimate = exact = angle_sum = None
        quiet = False
        if few:
            tell(f"{captures.realisations} captures for {captures.card.elements} elements: search for few captures")
            support = None if support_deg is None else math.radians(support_deg)
            search = partial(
                solve_scarce, nonnegative=nonnegative, support=support, step_deg=step_deg, seed=seed, tell=tell
            )
            estimate, rivals = search(problem)
            refit_next_to = partial(refit_scarce, nonnegative=nonnegative, support=support)
            refit = partial(refit_next_to, before=estimate)
        elif method == "closed_form" or (method == "auto" and _may_be_exact(problem, space)):
            tell(f"rank {space.rank} of {captures.card.elements}, no noise stated: closed form")
            exact = closed(problem)
            # The singular values beyond M tell noise best: knots as fine as the pixels fit noise as well. Where there are
            # none beyond, a mismatch near rounding has to do.
            noise = expected_mismatch(problem, space, exact.closed)
            quiet = exact.closed.mismatch < _NOISELESS if math.isnan(noise) else noise < ROUNDING
            held = problem
            if exact.closed.near_solutions == 1 and (quiet or method == "closed_form"):
                held, exact, angle_sum = settle(problem, exact, closed, quietly, bounded=True)
            if method == "closed_form" or (quiet and exact.predicted_error <= _KNOWN):
                problem, estimate = held, exact
            else:
                why = "its error bound is too large" if quiet else "there is noise"
                tell(f"closed form misses the data by {exact.closed.mismatch:.1e}: {why}")
        if estimate is None:
            tell("normal likelihood, then counts" if method == "poisson" else "maximum likelihood")
            try:
                estimate = fit(problem)
            except UndeterminedError:
                if not quiet or exact is None:
                    raise
                problem, estimate = held, exact  # refused below, and the closed form knows the better reason
            if quiet and exact is not None and estimate.groups:
                problem, estimate = held, exact  # without noise it tells whether a scale each is all that is free
        if wall == "microfacet" and estimate.groups:
            raise UndeterminedError(
                "a scale is open for each group of elements, and with it the exponents of a wall of facets; use views or a "
                "card whose reflections share more angles"
            )
        if estimate.method != "closed_form" and estimate.predicted_error <= UNDETERMINED:
            if estimate.groups:  # no facets are fitted to scales that are open
                angle_sum = check_angle_sum(problem, estimate)
            else:
                plain = problem
                problem, estimate, angle_sum = settle(problem, estimate, refit if few else fit, check_angle_sum)
                if few:
                    problem, estimate, angle_sum = hold_against_rivals(
                        plain,
                        (problem, estimate, angle_sum),
                        rivals,
                        refit_next_to,
                        check_angle_sum,
                        lambda problem: search(problem)[0],
                        wall=model,
                        excused=foretold(plain, estimate) if rivals else 0.0,
                        tell=tell,
                    )
        if angle_sum is not None:
            estimate = with_doubt(estimate, angle_sum)
        if calibration is not None:
            tell(f"the same with the card one standard deviation aside, {len(calibration.aside)} times")
            aside = [
                solve(
                    replace(filmed, card=card),
                    method=cast(Method, estimate.method),
                    wall="microfacet" if problem.exponents else "angle_sum",
                    nonnegative=nonnegative,
                    support_deg=support_deg,
                    step_deg=math.degrees(estimate.grid.step),
                    counts_per_radiance=counts_per_radiance,
                    background=background,
                    seed=seed,
                )
                for card in calibration.aside
            ]
            estimate = widened(problem, estimate, aside)
        check = check_one_bounce(problem, estimate, wall_albedo=wall_albedo)
        solution = conclude(
            problem,
            space,
            estimate,
            check,
            angle_sum,
            gauge=gauge,
            quiet=quiet,
            seconds=lambda: time.perf_counter() - started,
        )
        return replace(solution, history=tuple(history))


def _may_be_exact(problem: Problem, space: SignalSpace) -> bool:
    return not problem.noise_is_stated and space.rank == problem.card.elements
