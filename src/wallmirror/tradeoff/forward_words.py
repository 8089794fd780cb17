"""How many times faster the analytic model is at equal error, in words and in a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from wallmirror.tradeoff.forward_analytic import ALGORITHM_1, BY_TOLERANCE, PHYSICAL, POINTS, SINGLE, TABLED
from wallmirror.tradeoff.forward_tracing import SAMPLERS
from wallmirror.tradeoff.pareto import Reach, falls, fit_line, reach_along_line, reach_by_run, short_seconds, tail_line
from wallmirror.tradeoff.runs import Run, Statement, by_method

TARGETS = (1e-2, 1e-3, 1e-4)
#: What was asked for at an error of 1e-3: how many times faster than the best sampler, and than independent samples.
ASKED_AT, ASKED_BEST, ASKED_INDEPENDENT = 1e-3, 100.0, 5000.0


def conclude(runs: Sequence[Run], *, floor: float) -> list[Statement]:
    """How many times faster the analytic model is at equal error, from the runs of one image.

    Parameters
    ----------
    floor:
        Error that the path tracer keeps however long it runs: nothing is extrapolated to or below it.
    """
    lines = by_method(runs)
    statements = []
    for target in TARGETS:
        ours = reach_by_run(lines.get(PHYSICAL, ()), target)
        if ours is None:
            statements.append(Statement(f"No run of the analytic model comes to {target:g}.", False))
            continue
        tracers = {m: reach_along_line(rs, target, floor=floor) for m, rs in lines.items() if _is_sampler(m)}
        reached = {m: r for m, r in tracers.items() if r is not None}
        if not reached:
            continue
        best = min(reached, key=lambda m: reached[m].seconds)
        independent = reached.get("Mitsuba, independent")
        ratio = reached[best].seconds / ours.seconds
        text = (
            f"At an error of {target:g} the analytic model takes {short_seconds(ours.seconds)}: "
            f"{_times(ratio)} faster than Mitsuba's best sampler here, {_name(best)}, {reached[best].words}"
        )
        met = ratio >= ASKED_BEST if target == ASKED_AT else None
        if independent is not None:
            slower = independent.seconds / ours.seconds
            text += f"; {_times(slower)} faster than independent samples, {independent.words}"
            if target == ASKED_AT:
                met = bool(met) and slower >= ASKED_INDEPENDENT
        if target == ASKED_AT:
            text += f" (asked: {ASKED_BEST:g} and {ASKED_INDEPENDENT:g} times)"
        statements.append(Statement(text + ".", met))
    return statements


def of_forms(runs: Sequence[Run]) -> list[Statement]:
    """What float32, tables, Algorithm 1 and the convolutions make of it."""
    lines = by_method(runs)
    best = {m: min(r.error for r in rs if not r.failure) for m, rs in lines.items() if any(not r.failure for r in rs)}
    statements = []
    single = reach_by_run(lines[SINGLE], ASKED_AT)
    double = reach_by_run(lines[PHYSICAL], ASKED_AT)
    if single is not None and double is not None:
        statements.append(
            Statement(
                f"float32 comes to {ASKED_AT:g} {double.seconds / single.seconds:.2g} times as fast as float64 and ends at "
                f"{best[SINGLE]:.0e}; float64 ends at {best[PHYSICAL]:.0e}."
            )
        )
    asked = reach_by_run(lines[BY_TOLERANCE], ASKED_AT)
    if asked is not None and double is not None:
        statements.append(
            Statement(
                "Asked for a tolerance instead of known orders, as a user would, the model takes "
                f"{short_seconds(asked.seconds)} to {ASKED_AT:g}, {asked.seconds / double.seconds:.2g} times as long: it looks "
                "for the orders, and proves them."
            )
        )
    tables = [run for run in lines[TABLED] if not run.failure]
    if len(tables) > 2:
        coarse = [run for run in tables if run.error > 3 * best[TABLED]]
        slope = (
            fit_line([r.knobs["table nodes"] for r in coarse], [r.error for r in coarse]).slope
            if len(coarse) > 2
            else math.nan
        )
        fall = f"its error falls as nodes^{slope:.1f} and ends at" if math.isfinite(slope) else "the best is"
        statements.append(Statement(f"A BRDF table instead of the formula: {fall} {best[TABLED]:.0e}."))
    statements.append(
        Statement(
            f"Algorithm 1 is {100 * best[ALGORITHM_1]:.2g} % off the physical model at best, with the scale given to it: more "
            "points do not help, since what it lacks is the second cosine and the squared distance."
        )
    )
    statements += [_of_convolutions([run for run in runs if run.group == group]) for group in POINTS]
    for method, line in lines.items():
        if _is_sampler(method) and len(line) > 4 and not falls(tail_line(line)):
            statements.append(
                Statement(
                    f"{_name(method)} does not converge here: the slope of its slower half is not told from 0, so nothing is "
                    "extrapolated along it."
                )
            )
    return statements


def _of_convolutions(runs: Sequence[Run]) -> Statement:
    """The convolutions beside Algorithm 1: which are right, and which are quicker."""
    lines = by_method(runs)
    ours = lines.pop("Algorithm 1, float64")[0]
    parts = []
    for method, line in lines.items():
        good = [run for run in line if not run.failure]
        if not good:
            parts.append(f"{method} is refused")
            continue
        best = min(good, key=lambda run: run.error)
        parts.append(f"{method}: {best.error:.1e} off at best, in {best.seconds / ours.seconds:.2g} times the seconds")
    return Statement(
        f"{runs[0].group.capitalize()}: Algorithm 1 itself takes {short_seconds(ours.seconds)} and is {ours.error:.0e} off; "
        + "; ".join(parts)
        + "."
    )


def slopes_of(runs: Sequence[Run]) -> dict[str, list[float]]:
    """Slope of log error over log samples and its standard error, for each line of the path tracer, over its slower half."""
    slopes = {}
    for method, line in by_method(runs).items():
        if method.startswith("Mitsuba") and len(line) > 2:
            fit = tail_line(line)
            slopes[method] = [fit.slope, fit.standard_error]
    return slopes


def table_of(runs: Sequence[Run], floor: float) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Processor seconds to each error, method by method, and the ratio to the analytic model."""
    lines = by_method(runs)
    ours = {t: reach_by_run(lines[PHYSICAL], t) for t in TARGETS}
    rows = []
    for method, line in lines.items():
        if len(line) < 3 or method == ALGORITHM_1:
            continue
        cells = []
        for target in TARGETS:
            reach: Reach | None = (
                reach_along_line(line, target, floor=floor)
                if method.startswith("Mitsuba")
                else reach_by_run(line, target)
            )
            own = ours[target]
            if reach is None or own is None:
                cells.append("not reached")
            else:
                mark = "*" if reach.how == "extrapolated" else ""
                cells.append(f"{short_seconds(reach.seconds)}{mark} ({reach.seconds / own.seconds:.3g} x)")
        rows.append((method, *cells))
    title = "Processor seconds to an error, and how many times those of the physical model in float64; * extrapolated"
    return title, ("method", *(f"{t:g}" for t in TARGETS)), tuple(rows)


def _is_sampler(method: str) -> bool:
    return method in {f"Mitsuba, {sampler}" for sampler, _ in SAMPLERS}


def _name(method: str) -> str:
    return method.removeprefix("Mitsuba, ")


def _times(ratio: float) -> str:
    return f"{float(f'{ratio:.2g}'):,.0f} times" if ratio >= 10 else f"{ratio:.2g} times"
