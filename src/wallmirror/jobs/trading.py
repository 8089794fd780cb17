"""`wallmirror tradeoff`: work-precision runs, all kept, with what follows from them in words."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from wallmirror.console import Advance
from wallmirror.errors import InputError
from wallmirror.files import write_atomically
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.page import Block
from wallmirror.report.tradeoffs import panel_figures
from wallmirror.tradeoff.budget import budget
from wallmirror.tradeoff.clock import machine, reference_seconds
from wallmirror.tradeoff.forward import forward
from wallmirror.tradeoff.inverse import inverse
from wallmirror.tradeoff.runs import Panel, Statement, to_csv
from wallmirror.tradeoff.scaling import scaling

PANELS: dict[str, Callable[..., Panel]] = {"forward": forward, "inverse": inverse, "budget": budget, "scaling": scaling}
_LEAD = (
    "What a second of computing buys, for every way that this library has and for the path tracer it is judged by. All runs "
    "are kept and drawn, failures are crosses, and each conclusion is computed from the runs that stand above it."
)


@dataclass(frozen=True)
class Traded:
    """The panels that were measured, and under which circumstances.

    Parameters
    ----------
    reference_seconds:
        Processor seconds of the fixed workload before the first panel and after each.
    """

    panels: tuple[Panel, ...]
    seconds: float
    machine: str
    reference_seconds: tuple[float, ...]
    quick: bool

    @property
    def passed(self) -> bool:
        """Whether every figure that was asked for is reached."""
        return all(statement.met is not False for panel in self.panels for statement in panel.conclusions)

    def summary(self) -> dict[str, Any]:
        """Everything but the single runs, ready for JSON."""
        return {
            "passed": self.passed,
            "quick": self.quick,
            "machine": self.machine,
            "reference_seconds": list(self.reference_seconds),
            "seconds": self.seconds,
            "panels": [panel.summary() for panel in self.panels],
        }


def measure_tradeoffs(
    names: Sequence[str],
    out: Path,
    *,
    quick: bool = False,
    full: bool = False,
    seed: int = 0,
    progress: Advance | None = None,
) -> Traded:
    """Measure the named panels, or all; leaves one CSV a panel, results.json and tradeoff.html in a folder.

    Parameters
    ----------
    names:
        Of `PANELS`; empty for all.
    quick:
        Fewer settings and smaller scenes: less than a minute in all on two idle cores.
    full:
        The panel of sizes goes on until 16 GB are full, which takes half an hour.

    Raises
    ------
    InputError
        For an unknown panel, or `full` without the panel of sizes, before anything is measured.
    """
    chosen = tuple(dict.fromkeys(names)) or tuple(PANELS)
    if full and (quick or "scaling" not in chosen):
        raise InputError("has a meaning for the panel scaling alone, and without --quick; leave it out", field="full")
    for name in chosen:
        if name not in PANELS:
            raise InputError(f'is "{name}"; choose among {", ".join(PANELS)}', field="panel")
    started = time.perf_counter()
    panels = []
    where = machine()
    # One thread for the matrices of NumPy: two that share a machine with a path tracer measure each other.
    with threadpool_limits(limits=1):
        reference = [reference_seconds()]
        for number, name in enumerate(chosen):

            def advance(done: int, total: int, number: int = number) -> None:
                if progress is not None:
                    progress(round(100 * (number + done / total)), 100 * len(chosen))

            more = {"full": True} if full and name == "scaling" else {}
            panel = PANELS[name](quick=quick, seed=seed, progress=advance, **more)
            reference.append(reference_seconds())
            write_atomically(out / f"{name}.csv", to_csv(panel.runs))
            panels.append(panel)
    traded = Traded(tuple(panels), time.perf_counter() - started, where, tuple(reference), quick)
    write_atomically(out / "results.json", json.dumps(traded.summary(), indent=1, allow_nan=False) + "\n")
    write_report(traded, out / "tradeoff.html")
    return traded


def write_report(traded: Traded, path: Path) -> None:
    """The page: verdicts on top, then a section a panel with question, figures, tables, omissions and answer."""
    asked = [s for panel in traded.panels for s in panel.conclusions if s.met is not None]
    low, high = 1000 * min(traded.reference_seconds), 1000 * max(traded.reference_seconds)
    conditions = Verdict(
        None,
        f"Measured {'in a hurry (--quick) ' if traded.quick else ''}in {traded.seconds:.0f} s on {traded.machine}. A fixed "
        f"workload took {low:.1f} to {high:.1f} ms of processor time before, between and after the panels: timings "
        f"wobble by up to {100 * (high / low - 1):.0f} %, ratios of what was timed side by side by less.",
    )
    write_page(
        path,
        title="Speed for accuracy",
        lead=_LEAD,
        verdicts=[*(_verdict(s) for s in asked), conditions],
        sections=[Section(panel.title, _blocks(panel)) for panel in traded.panels],
    )


def _blocks(panel: Panel) -> tuple[Block, ...]:
    return (
        f"{panel.question} {panel.setting}",
        *(FigureBlock(figure, caption) for figure, caption in panel_figures(panel)),
        *(TableBlock(columns, rows, caption) for caption, columns, rows in panel.tables),
        *(_verdict(s) for s in panel.conclusions),
        *(f"Left out: {o.what} ({o.why})." for o in panel.omissions),
        f"All {len(panel.runs)} runs: {panel.name}.csv.",
    )


def _verdict(statement: Statement) -> Verdict:
    return Verdict(statement.met, statement.text)
