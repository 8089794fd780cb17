"""`wallmirror advise`: what a scene needs to be predicted, filmed, validated and solved to a tolerance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF, Mirror
from wallmirror.derendering.foresight import foresee
from wallmirror.errors import InputError
from wallmirror.jobs.bouncing import RR_DEPTH, spread
from wallmirror.jobs.piloting import LeftOut, NoisePilot, Truncation, left_out, pilot_gain, pilot_noise
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.pathtracing.rendering import Renderer
from wallmirror.planning.forward import cheapest_quadrature, coarsest_knots, fewest_table_nodes
from wallmirror.planning.hypotheses import Hypothesis, one_bounce_hypothesis, simplifications, stand_in_error
from wallmirror.planning.plan import (
    AIM,
    CapturePlan,
    ForwardPlan,
    Plan,
    Route,
    SolvePlan,
    Term,
    ValidatePlan,
    checked_tolerance,
)
from wallmirror.planning.sampling import MOST_SPP, cheapest_sampling
from wallmirror.planning.sketch import Sketch, sketch
from wallmirror.scene import Scene

Array = NDArray[np.float64]

_POINTS = (
    "nothing can be rendered: a path never meets points; give the strips a width and a height and the pixels their "
    'footprints (pixels_at = "centres")'
)
# Shares of the tolerance that bounces left out and the BRDF's table may take of a film.
_DEPTH_SHARE = 0.5
_TABLE_SHARE = 0.2
# Deeper paths are ended by chance where the scene would not.
_DEEP_FROM = 8
_KNOTS_SHARE = 0.3
_FORESIGHT_SIZE = 20_000  # rows x elements that the bound of a pilot may have
_VALIDATE_AIM = 0.75
_VALIDATE_SPP = (64, 144, 256, 576, MOST_SPP)  # squares, as stratified samples need
_LEAST_VIEWS = 3


#: What a plan can be asked for.
Part = Literal["forward", "capture", "validate", "solve"]
ALL_PARTS: tuple[Part, ...] = ("forward", "capture", "validate", "solve")


def advise(
    scene: Scene,
    tolerance: float,
    *,
    parts: tuple[Part, ...] = ALL_PARTS,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Plan:
    """Measure what a scene needs to reach a tolerance, and plan the cheapest way there.

    Parameters
    ----------
    tolerance:
        Relative L2 error of the films over all views, pixels and patterns, from 1e-5 to 0.5.
    parts:
        What to plan. "forward" and "solve" ask about the films of "capture", and bring it along.
    seed:
        Root of the pilot renders' random numbers.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        For a tolerance out of range, or a scene too large to be measured in seconds or dark.
    """
    started = time.perf_counter()
    tell = progress or (lambda _: None)
    checked_tolerance(tolerance)
    # All errors are relative; in a power of two near the brightest strip nothing leaves the range of float64.
    scene = replace(scene, source=np.ldexp(scene.source, -math.frexp(float(scene.source.max(initial=0.0)))[1]))
    notes: list[str] = []
    filmed = filmable(scene)
    if not filmed:
        notes.append(_POINTS)
    forward = capture = validation = solution = None
    hypotheses: tuple[Hypothesis, ...] = ()
    if set(parts) != {"validate"}:
        tell("the analytic model against its simplifications")
        drawn = sketch(scene, tolerance=tolerance)
        found = LeftOut((Truncation(2, 0.0 if scene.is_one_bounce else math.nan, 0.0),))
        if filmed:
            tell("light of many bounces and noise, by small renders")
            found = left_out(scene, seed=seed)
            capture, noise = _capture(scene, drawn, found, tolerance, seed)
            if "solve" in parts:
                tell("what noise does to the recovered pattern")
                solution = _solution(scene, drawn, capture, noise, tolerance, notes)
        if "forward" in parts:
            forward = _forward(scene, drawn, found, capture, tolerance)
            hypotheses = (_one_bounce(scene, found), *simplifications(drawn))
    if filmed and "validate" in parts:
        tell("the smallest gain error that validation would see")
        validation = _validation(scene, tolerance, seed, notes)
    return Plan(
        scene=scene.name,
        tolerance=tolerance,
        forward=forward,
        capture=capture,
        validate=validation,
        solve=solution,
        hypotheses=hypotheses,
        notes=tuple(notes),
        seconds=time.perf_counter() - started,
    )


def _one_bounce(scene: Scene, found: LeftOut) -> Hypothesis:
    """Hypothesis 2 with what one bounce leaves out here."""
    error = found.depths[0].error
    if scene.is_one_bounce:
        return one_bounce_hypothesis(error, "nothing but the wall reflects")
    return one_bounce_hypothesis(error, "points cannot be rendered" if math.isnan(error) else "rendered")


def plan_capture(scene: Scene, tolerance: float, *, seed: int = 0) -> CapturePlan:
    """The plan for films of a scene to a tolerance.

    Raises
    ------
    InputError
        As `advise`, and where the scene cannot be rendered or no samples would reach the tolerance.
    """
    plan = advise(scene, tolerance, parts=("capture",), seed=seed)
    if plan.capture is None:
        raise InputError(plan.notes[0], field=scene.name)
    if plan.capture.error > tolerance:
        worst = max(plan.capture.terms, key=lambda term: term.error)
        raise InputError(
            f"is {tolerance:g}, which films of this scene cannot reach: {worst.name} alone is {worst.error:.1e}",
            field="--tolerance",
        )
    return plan.capture


def filmable(scene: Scene) -> bool:
    """Whether paths can meet the scene's strips and pixels."""
    return not scene.card.is_points and scene.observer.pixels_at == "centres"


def _forward(scene: Scene, drawn: Sketch, found: LeftOut, capture: CapturePlan | None, tolerance: float) -> ForwardPlan:
    """One bounce where it is enough, else with the card's glow, else the path tracer."""
    one, glow = found.depths[0], found.with_glow
    route: Route = "analytic"
    rest, seconds = one, 0.0
    if one.upper > _DEPTH_SHARE * tolerance:
        if glow is not None and glow.upper <= _DEPTH_SHARE * tolerance:
            route, rest, seconds = "analytic with glow", glow, found.glow_seconds
        elif capture is not None:
            route, rest = "path tracing", replace(one, upper=0.0)
    left = AIM * tolerance - min(rest.upper, _DEPTH_SHARE * tolerance)
    quadrature = cheapest_quadrature(drawn, tolerance=left, views=scene.observer.views)
    if route == "path tracing" and capture is not None:
        return ForwardPlan(route=route, quadrature=quadrature, terms=capture.terms, seconds=capture.seconds)
    # Where the pilot's own noise is all that is seen, the error may be anything up to its limit.
    terms = (
        Term(
            name="bounces left out",
            error=rest.error if rest.is_seen else rest.upper,
            kind="bias",
            limit=not rest.is_seen,
        ),
        Term(name="quadrature", error=quadrature.error, kind="bias"),
    )
    return ForwardPlan(route=route, quadrature=quadrature, terms=terms, seconds=quadrature.seconds + seconds)


def _capture(
    scene: Scene, drawn: Sketch, found: LeftOut, tolerance: float, seed: int
) -> tuple[CapturePlan, NoisePilot]:
    depth = next(t for t in found.depths if t.upper <= _DEPTH_SHARE * tolerance)
    rr_depth = scene.render.rr_depth if depth.depth < _DEEP_FROM else min(RR_DEPTH, scene.render.rr_depth)
    nodes, table = _table(scene, drawn, tolerance)
    noise = pilot_noise(scene, Renderer(scene), max_depth=depth.depth, rr_depth=rr_depth, seed=seed)
    bias = depth.error + table
    aim = math.sqrt((AIM * tolerance) ** 2 - min(bias, 0.7 * tolerance) ** 2)
    sampling = cheapest_sampling(noise.levels, noise=aim)
    terms = (
        Term(name="bounces left out", error=depth.error, kind="bias"),
        Term(name="BRDF table", error=table, kind="bias"),
        Term(name="noise", error=sampling.noise, kind="noise"),
    )
    films = scene.observer.views * scene.source.shape[1]
    plan = CapturePlan(
        tolerance=tolerance,
        sampling=sampling,
        max_depth=depth.depth,
        rr_depth=rr_depth,
        table_nodes=nodes,
        films=films,
        terms=terms,
    )
    return plan, noise


def _table(scene: Scene, drawn: Sketch, tolerance: float) -> tuple[int | None, float]:
    """Nodes of the BRDF's table, None where the renderer's own are enough, and the error that they make."""
    brdf = scene.wall.brdf
    if isinstance(brdf, Mirror):
        return None, 0.0
    error = stand_in_error(drawn, wall_as_rendered(scene))
    if error <= _TABLE_SHARE * tolerance or not isinstance(brdf, AngleSumBRDF):
        return None, error
    finer = fewest_table_nodes(drawn, tolerance=_TABLE_SHARE * tolerance)
    return (None, error) if finer is None else finer


def _validation(scene: Scene, tolerance: float, seed: int, notes: list[str]) -> ValidatePlan:
    levels = pilot_gain(scene, seed=seed)
    best = levels[-1]
    each = 0.0
    if len(levels) > 1:
        each = max(0.0, (best.seconds - levels[0].seconds) / (best.spp - levels[0].spp))
    each = each or best.seconds / best.spp
    start = max(0.0, best.seconds - each * best.spp)
    options = []
    for spp in _VALIDATE_SPP:
        # Between pilots and beyond them noise falls at least as fast as that of independent samples.
        known = next((level for level in reversed(levels) if level.spp <= spp), levels[0])
        one = known.detectable * math.sqrt(known.spp / spp)
        views = max(_LEAST_VIEWS, math.ceil((one / (_VALIDATE_AIM * tolerance)) ** 2))
        views = min(views, scene.observer.views)
        detectable = one / math.sqrt(views)
        options.append(ValidatePlan(views=views, spp=spp, detectable=detectable, seconds=views * (start + each * spp)))
    reaching = [o for o in options if o.detectable <= _VALIDATE_AIM * tolerance]
    if reaching:
        return min(reaching, key=lambda o: o.seconds)
    finest = min(options, key=lambda o: o.detectable)
    if finest.detectable > tolerance:
        notes.append(
            f"validate sees gain errors from {finest.detectable:.1e} at most, with all {finest.views} views and the most "
            "samples that the film adds exactly enough; it would have to fail"
        )
    return finest


def _solution(
    scene: Scene, drawn: Sketch, capture: CapturePlan, noise: NoisePilot, tolerance: float, notes: list[str]
) -> SolvePlan | None:
    brdf = scene.wall.brdf
    if not isinstance(brdf, AngleSumBRDF):
        notes.append("nothing to solve for: the wall's BRDF is no function of the angle sum that a solver could find")
        return None
    observer, card = scene.observer, scene.card
    rank = int(np.linalg.matrix_rank(scene.source))
    if rank < card.elements:
        notes.append(
            f"{rank} independent patterns cannot determine {card.elements} elements; give the scene at least as many"
        )
        return None
    knots = coarsest_knots(drawn, tolerance=_KNOTS_SHARE * tolerance)
    assert knots is not None
    fewer = max(1, _FORESIGHT_SIZE // (observer.pixels * card.elements))
    views, std = noise.film_std(capture.sampling)
    keep = spread(len(views), min(fewer, len(views)))
    std = std[list(keep)]
    forecast = foresee(
        replace(observer, view_angles=tuple(observer.view_angles[views[k]] for k in keep)),
        card,
        brdf,
        scene.source[:, list(noise.patterns)],
        noise=np.maximum(std, 1e-2 * float(std.max())),  # as the solver's weights, and more than what rounds to nothing
        step_deg=knots[0],
    )
    error = forecast.source_error * math.sqrt(len(keep) / observer.views)
    needed = capture.sampling.total * (error / (AIM * tolerance)) ** 2
    if not scene.is_one_bounce:
        notes.append(
            "the solver assumes one bounce; what light beyond it does to the pattern, no samples mend, and `wallmirror "
            "solve` foretells it"
        )
    return SolvePlan(
        source_error=error,
        samples_per_pixel=math.ceil(needed) if math.isfinite(needed) else 0,
        step_deg=knots[0],
        knots_error=knots[1],
        quadrature_tolerance=min(1e-3, 1e-2 * tolerance),
        patterns=(rank, card.elements),
    )
