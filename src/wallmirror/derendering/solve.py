"""Blind de-rendering of a capture set: which method, which knot spacing, and what the certificates say.

The closed form (`exact`) is exact without noise. With noise it is the start of the maximum likelihood fit (`noisy`), whose
error bars come from the Cramer-Rao bound (`bounds`). Every result carries its doubts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import cast

from wallmirror.captures import CaptureSet
from wallmirror.derendering.angle_sum_check import with_doubt
from wallmirror.derendering.calibration import Calibration
from wallmirror.derendering.conclusion import conclude
from wallmirror.derendering.facet_fit import WallModel
from wallmirror.derendering.gauge import Gauge, Scale
from wallmirror.derendering.one_bounce import check_one_bounce
from wallmirror.derendering.options import Method, require_options, require_tolerance, require_wall
from wallmirror.derendering.placed import widened
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.stages import Answer, Asked
from wallmirror.geometry import Card
from wallmirror.threads import one_blas_thread


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
    require_tolerance(tolerance)
    require_wall(wall, scale)
    require_options(method, few, support_deg, step_deg, counts_per_radiance, background, seed)
    gauge = Gauge(scale=scale, wall_albedo=wall_albedo, source_level=source_level)
    history: list[str] = []

    def tell(stage: str) -> None:
        """Keep a sentence on a stage for the solution, and pass it on."""
        history.append(stage)
        if progress is not None:
            progress(stage)

    asked = Asked(
        method=method,
        few=few,
        # A scale that an albedo settles is that of a function of the angle sum.
        wall="angle_sum" if wall == "auto" and scale == "albedo" else wall,
        nonnegative=nonnegative,
        support_deg=support_deg,
        step_deg=step_deg,
        counts_per_radiance=counts_per_radiance,
        background=background,
        wall_albedo=wall_albedo,
        tolerance=tolerance,
        seed=seed,
        tell=tell,
    )
    if calibration is not None:
        captures = replace(captures, card=calibration.card)
    with one_blas_thread():
        problem, space = asked.prepared(captures)
        answer = asked.answered(problem, space)
        problem, estimate, angle_sum = answer.problem, answer.estimate, answer.angle_sum
        if angle_sum is not None:
            estimate = with_doubt(estimate, angle_sum)
        if calibration is not None:
            tell(f"the same with the card one standard deviation aside, {len(calibration.aside)} times")
            estimate = widened(problem, estimate, _with_cards(captures, calibration.aside, asked, answer))
        one_bounce = check_one_bounce(problem, estimate, wall_albedo=wall_albedo)
        solution = conclude(
            problem,
            space,
            estimate,
            one_bounce,
            angle_sum,
            gauge=gauge,
            quiet=answer.quiet,
            seconds=lambda: time.perf_counter() - started,
        )
    return replace(solution, history=tuple(history))


def _with_cards(captures: CaptureSet, cards: Sequence[Card], asked: Asked, answer: Answer) -> list[Solution]:
    """The captures solved as an answer was, by its method, on its knots and its kind of wall, but with each of other cards."""
    return [
        solve(
            replace(captures, card=card),
            method=cast(Method, answer.estimate.method),
            wall="microfacet" if answer.problem.exponents else "angle_sum",
            nonnegative=asked.nonnegative,
            support_deg=asked.support_deg,
            step_deg=math.degrees(answer.estimate.grid.step),
            counts_per_radiance=asked.counts_per_radiance,
            background=asked.background,
            seed=asked.seed,
        )
        for card in cards
    ]
