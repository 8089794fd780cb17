"""A plan in the words and tables that people read."""

from __future__ import annotations

import math

from wallmirror.planning.plan import CapturePlan, ForwardPlan, Plan, Route

_ROUTES: dict[Route, str] = {
    "analytic": "analytic, one bounce",
    "analytic with glow": "analytic, one bounce and the card's glow",
}


def plan_rows(plan: Plan) -> list[list[str]]:
    """What to do, with which settings, to which predicted error and in which predicted time: a row for each task."""
    forward, capture, validation, solution = plan.forward, plan.capture, plan.validate, plan.solve
    rows = []
    if forward is not None and forward.route != "path tracing":
        rows.append(
            [
                "predict the wall",
                f"{_ROUTES[forward.route]}; {_nodes(forward)}",
                _predicted(forward),
                _time(forward.seconds),
            ]
        )
    elif forward is not None:
        text = f"path tracing as for capture: one bounce leaves out {percent(plan.hypothesis('one bounce').error)}"
        rows.append(["predict the wall", text, percent(forward.error), _time(forward.seconds)])
    if capture is not None:
        rows.append(["capture", _settings(capture), percent(capture.error), _time(capture.seconds)])
    if validation is not None:
        text = f"{validation.views} views, 32 seeds x {validation.spp} samples; sees gain errors from"
        rows.append(["validate", text, percent(validation.detectable), _time(validation.seconds)])
    if solution is not None:
        text = f"those films, BRDF knots every {solution.step_deg:g} deg or finer; pattern off by noise"
        if solution.source_error > plan.tolerance:
            text = f"not with those films: {solution.samples_per_pixel} samples a pixel; pattern off by noise"
        rows.append(["solve", text, percent(solution.source_error), ""])
    return rows


def capture_line(plan: CapturePlan) -> str:
    """A plan's settings with its predicted error and time, in one line."""
    return f"{_settings(plan)}; predicted error {percent(plan.error)}, time {_time(plan.seconds)}"


def _settings(plan: CapturePlan) -> str:
    s = plan.sampling
    seeds = f"{s.seeds} seeds x {s.spp}" if s.seeds > 1 else f"{s.spp}"
    table = "" if plan.table_nodes is None else f", BRDF table of {plan.table_nodes} nodes"
    return f"depth {plan.max_depth}, {seeds} {s.sampler} samples a pixel{table}"


def _predicted(forward: ForwardPlan) -> str:
    return ("< " if forward.is_limit else "") + percent(forward.error)


def hypothesis_rows(plan: Plan) -> list[list[str]]:
    """Each hypothesis with its error in this scene's films, and whether it holds."""
    rows = []
    for h in plan.hypotheses:
        known = not math.isnan(h.error)
        answer = "-" if not known else "holds" if h.holds(plan.tolerance) else "fails"
        size = "unknown" if not known else "exact" if h.error == 0 else percent(h.error) + (" *" if h.scaled else "")
        rows.append([h.label, h.says, answer, size])
    return rows


def percent(error: float) -> str:
    """A relative error for people: in percent, or as a multiple where it is more than the whole."""
    if not math.isfinite(error):
        return "unknown" if math.isnan(error) else "unbounded"
    if error >= 1.995:
        return f"{error:.2g} times" if error < 100 else f"{error:.0f} times"
    return f"{100 * error:.0f} %" if error >= 0.0995 else f"{100 * error:.2g} %"


def _nodes(forward: ForwardPlan) -> str:
    q = forward.quadrature
    if q.strips == "exact":
        return "a mirror, exact"
    pixel = "pixels as points" if q.across_pixel == 1 else f"{q.across_pixel} nodes a pixel"
    if q.strips == "points":
        return f"strips as points, {pixel}"
    strip = "strips without width" if q.across_strip == 1 else f"{q.across_strip} nodes a strip"
    return f"{strip}, {pixel}"


def _time(seconds: float) -> str:
    if seconds < 1:
        return f"{1000 * max(seconds, 1e-3):.0f} ms"
    for unit, size in (("s", 1.0), ("min", 60.0), ("h", 3600.0)):
        if seconds < 120 * size:
            return f"{seconds / size:.2g} {unit}" if seconds / size < 10 else f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} days"
