"""Which split is best, and whether the forecast holds, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from wallmirror.tradeoff.runs import Run, Statement
from wallmirror.tradeoff.split_runs import DRAWN, THESIS

#: Largest factor between foretold and measured error for the forecast to count as confirmed.
CONFIRMED = 1.5
_ENOUGH = 4  # draws of the noise for a verdict


def conclude(group: str, found: Sequence[Run], measured: Sequence[Run]) -> list[Statement]:
    """The best split and what others cost, and whether the forecast was confirmed."""
    good = sorted((run for run in found if not run.failure), key=lambda r: r.error)
    if not good:
        return [Statement(f"{group.capitalize()}: no split can be afforded.")]
    best, worst = good[0], good[-1]
    text = f"{group.capitalize()}: best is {_name(best)}, {100 * best.error:.2g} % off as foretold"
    thesis = next((run for run in good if (run.knobs["views"], run.knobs["realisations"]) == THESIS), None)
    if thesis is not None and thesis is not best:
        text += f"; the thesis's split, A {THESIS[0]} and B {THESIS[1]}, {thesis.error / best.error:.2f} times that"
    text += f"; worst is {_name(worst)}, {worst.error / best.error:.2g} times. "
    text += _along(good, "views", "realisations") + " " + _along(good, "realisations", "views")
    statements = [Statement(text)]
    solved = [run for run in measured if not run.failure]
    if solved:
        ratios = _ratios(solved)
        drawn = {
            name: [r for r in solved if r.method == DRAWN and _name(r) == name]
            for name, method in ratios
            if method == DRAWN
        }
        enough = min((len(rs) for rs in drawn.values()), default=0) >= _ENOUGH
        within = all(1 / CONFIRMED <= ratios[name, DRAWN] <= CONFIRMED for name in drawn)
        parts = [f"{name} {ratio:.2f} ({method})" for (name, method), ratio in ratios.items()]
        measured_best = min(drawn, key=lambda name: _rms([r.error for r in drawn[name]]), default="")
        foretold_best = min(drawn, key=lambda name: drawn[name][0].extra["foretold"], default="")
        ranked = (
            "the best of them is the one foretold"
            if measured_best == foretold_best
            else f"the best of them is {measured_best}"
        )
        asked = f"asked within {CONFIRMED:g}" if enough else f"fewer than {_ENOUGH} draws, so no verdict"
        statements.append(
            Statement(
                f"{group.capitalize()}, error measured over foretold: {'; '.join(parts)}; {ranked} ({asked}).",
                within if enough else None,
            )
        )
    refused = {_name(run): run for run in measured if run.failure}
    if refused:
        statements.append(
            Statement(
                f"{group.capitalize()}: the solver refuses {', '.join(refused)}, although the bound would allow it: "
                f"“{next(iter(refused.values())).failure}”. More realisations than elements are its safeguard."
            )
        )
    return statements


def _ratios(solved: Sequence[Run]) -> dict[tuple[str, str], float]:
    """Root mean square of measured over foretold error, by split and way of measuring."""
    groups: dict[tuple[str, str], list[float]] = {}
    for run in solved:
        groups.setdefault((_name(run), run.method), []).append(run.error / run.extra["foretold"])
    return {key: _rms(values) for key, values in groups.items()}


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def _along(good: Sequence[Run], knob: str, other: str) -> str:
    """How far the error moves along one knob at the best value of the other."""
    best = good[0]
    line = sorted((run for run in good if run.knobs[other] == best.knobs[other]), key=lambda r: r.knobs[knob])
    low, high = line[0], line[-1]
    spread = max(run.error for run in line) / best.error
    if spread < 1.1:
        return f"The number of {knob} hardly matters ({low.knobs[knob]} to {high.knobs[knob]}: {100 * (spread - 1):.0f} %)."
    return (
        f"From {low.knobs[knob]} to {high.knobs[knob]} {knob} the error goes from {low.error / best.error:.2f} to "
        f"{high.error / best.error:.2f} times the best."
    )


def _name(run: Run) -> str:
    return f"A {run.knobs['views']} B {run.knobs['realisations']}"
