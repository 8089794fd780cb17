"""What a panel of work-precision runs consists of: every run, what was left out, and what follows, in words."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wallmirror.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Run:
    """One measurement: a method at one setting of its knob.

    Parameters
    ----------
    group:
        Runs of one group share a reference and a figure, such as "20 dB".
    method:
        What a line in the figure is called.
    knobs:
        The settings, by name.
    seconds:
        Processor time of all threads together, in seconds.
    wall_seconds:
        Time on the wall clock.
    error:
        Relative error against the group's reference; NaN for a failure, and where only the cost is asked for.
    work:
        How much of what costs time the run did (samples, say), where that is a number; the error's slope is told over it.
    failure:
        Why there is no answer, else empty. A failed run took its seconds all the same.
    extra:
        Further figures of the run.
    """

    group: str
    method: str
    knobs: Mapping[str, Any]
    seconds: float
    wall_seconds: float = math.nan
    error: float = math.nan
    work: float = math.nan
    failure: str = ""
    extra: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.failure and not math.isnan(self.error):
            raise InputError("is no error of a run that failed; leave it out", field="error")

    @property
    def setting(self) -> str:
        """The knobs in one line."""
        return ", ".join(f"{name} {_short(value)}" for name, value in self.knobs.items())


@dataclass(frozen=True)
class Omission:
    """Something that a reader would look for and does not find, with the reason."""

    what: str
    why: str


@dataclass(frozen=True)
class Statement:
    """A sentence computed from the runs: `met` says whether a figure that was asked for is reached, None if none was."""

    text: str
    met: bool | None = None


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One question with its runs and its answer.

    Parameters
    ----------
    floors:
        Error below which no method can come, by group, with the name of the bound.
    numbers:
        Whatever else was measured, ready for JSON.
    tables:
        Further tables: title, columns and rows of text.
    """

    name: str
    title: str
    question: str
    setting: str
    runs: tuple[Run, ...]
    conclusions: tuple[Statement, ...]
    omissions: tuple[Omission, ...] = ()
    floors: Mapping[str, float] = field(default_factory=dict)
    numbers: Mapping[str, Any] = field(default_factory=dict)
    tables: tuple[tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]], ...] = ()

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups in their order of appearance."""
        return tuple(dict.fromkeys(run.group for run in self.runs))

    def of_group(self, group: str) -> tuple[Run, ...]:
        """The runs of one group."""
        return tuple(run for run in self.runs if run.group == group)

    def summary(self) -> dict[str, Any]:
        """Everything but the single runs, ready for JSON."""
        return {
            "panel": self.name,
            "question": self.question,
            "setting": self.setting,
            "runs": len(self.runs),
            "failures": sum(1 for run in self.runs if run.failure),
            "conclusions": [{"text": s.text, "met": s.met} for s in self.conclusions],
            "omissions": [{"what": o.what, "why": o.why} for o in self.omissions],
            "floors": dict(self.floors),
            "numbers": dict(self.numbers),
        }


def to_csv(runs: Sequence[Run]) -> str:
    """All runs, one a line; knobs and further figures as JSON."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["group", "method", "knobs", "cpu_seconds", "wall_seconds", "error", "failure", "extra"])
    for run in runs:
        writer.writerow(
            [
                run.group,
                run.method,
                json.dumps(dict(run.knobs)),
                f"{run.seconds:.6g}",
                f"{run.wall_seconds:.6g}",
                f"{run.error:.6g}",
                run.failure,
                json.dumps({k: float(f"{v:.6g}") for k, v in run.extra.items()}),
            ]
        )
    return buffer.getvalue()


def by_method(runs: Sequence[Run]) -> dict[str, tuple[Run, ...]]:
    """Runs by their method, in order of appearance."""
    return {m: tuple(run for run in runs if run.method == m) for m in dict.fromkeys(run.method for run in runs)}


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
