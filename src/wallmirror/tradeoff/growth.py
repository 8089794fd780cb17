"""How seconds and memory grow with a size: the exponents, and the size at which the memory is full."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wallmirror.tradeoff.pareto import Line, fit_line, short_seconds
from wallmirror.tradeoff.runs import Run, Statement, by_method

#: Exponent that the physical model's cost was asked to have in N, M and the quadrature nodes, and how far off it may be.
ASKED_EXPONENT, ASKED_WITHIN = 1.0, 0.1
#: Gigabytes of the machine for which the largest sizes are foretold.
MACHINE_GB = 16.0

MODEL, SOLVER, TRACER = "physical model", "solve (maximum likelihood)", "Mitsuba picture"
_SMALL = 20e6  # bytes: below it a process's memory is its allocator's business more than ours
_TAIL = 4
_CLEAR = 0.8  # exponent below which memory is still what does not grow


@dataclass(frozen=True)
class Sweep:
    """One knob of one kind of work.

    Parameters
    ----------
    most:
        Largest value of the knob that has a meaning.
    fills_memory:
        Whether memory grows with the knob at all.
    """

    group: str
    method: str
    kind: str
    knob: str
    start: int
    most: int
    unit: str
    fills_memory: bool = True


@dataclass(frozen=True)
class Law:
    """How seconds and memory of one sweep grow, from its four largest sizes; None where too little was measured."""

    sweep: Sweep
    seconds: Line | None
    memory: Line | None
    largest: float

    @property
    def room(self) -> float | None:
        """Size, in that of the thesis, at which the memory of `MACHINE_GB` is full; None where it grows with no clear law."""
        return None if self.memory is None or self.memory.slope < _CLEAR else self.memory.where(MACHINE_GB * 1e9)


def laws_of(runs: Sequence[Run], sweeps: Sequence[Sweep]) -> list[Law]:
    """The law of each sweep that has runs."""
    laws = []
    for sweep in sweeps:
        mine = [run for run in runs if run.group == sweep.group and not run.failure]
        line = sorted(by_method(mine).get(sweep.method, ()), key=lambda r: r.work)[-_TAIL:]
        if not line:
            continue
        heavy = [run for run in line if run.extra["bytes"] > _SMALL]
        laws.append(
            Law(
                sweep,
                fit_line([r.work for r in line], [r.seconds for r in line]) if len(line) > 2 else None,
                fit_line([r.work for r in heavy], [r.extra["bytes"] for r in heavy]) if len(heavy) > 2 else None,
                line[-1].work,
            )
        )
    return laws


def conclude(laws: Sequence[Law]) -> list[Statement]:
    """Whether the model's cost is linear where that was asked for, and how everything else grows."""
    statements = []
    asked = [law for law in laws if law.sweep.group == MODEL and law.seconds is not None]
    if asked:
        parts, met = [], True
        for law in asked:
            assert law.seconds is not None
            parts.append(f"{law.sweep.method} {law.seconds.slope:.2f} ± {law.seconds.half_width():.2f}")
            met &= abs(law.seconds.slope - ASKED_EXPONENT) <= ASKED_WITHIN
        statements.append(
            Statement(
                f"The physical model's seconds grow with the exponents {', '.join(parts)} (asked: {ASKED_EXPONENT:g} ± "
                f"{ASKED_WITHIN:g}).",
                met,
            )
        )
    others = [law for law in laws if law.sweep.group != MODEL and law.seconds is not None]
    if others:
        parts = [f"{law.sweep.group}, {law.sweep.method}: {law.seconds.slope:.2f}" for law in others if law.seconds]
        statements.append(Statement(f"Seconds of the others grow with {'; '.join(parts)}."))
    rooms = [
        f"{law.room * law.sweep.start:,.2g} {law.sweep.unit} ({law.sweep.group})"
        for law in laws
        if law.room is not None
    ]
    if rooms:
        statements.append(
            Statement(
                f"By the laws fitted to memory, {MACHINE_GB:g} GB would hold, one knob at a time, others at the thesis's "
                f"size: {'; '.join(rooms)}."
            )
        )
    return statements


def table_of(laws: Sequence[Law]) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """The laws, for the page."""
    rows = []
    for law in laws:
        room = law.room
        rows.append(
            (
                law.sweep.group,
                law.sweep.method,
                f"{law.largest:g} x",
                _slope(law.seconds),
                short_seconds(law.seconds.at(law.largest)) if law.seconds else "-",
                _slope(law.memory) if law.memory else f"below {_SMALL / 1e6:g} MB",
                "-" if room is None else f"{room:,.2g} x",
            )
        )
    columns = ("work", "knob", "measured up to", "exponent of seconds", "there", "of memory", f"{MACHINE_GB:g} GB hold")
    return "Fitted laws; sizes in those of the thesis, exponents with their 95 % interval", columns, tuple(rows)


def _slope(line: Line | None) -> str:
    return "too few sizes" if line is None else f"{line.slope:.2f} ± {line.half_width():.2f}"
