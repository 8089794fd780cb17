"""`wallmirror solve --general`: capture sets of one card from several positions in, pattern and BRDF table out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet, read_captures, read_truth
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.general import GeneralSolution, solve_general
from wallmirror.jobs.solution_files import csv_text, source_csv, write_results
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, page_html
from wallmirror.report.figures import recovered_source, recovered_table, scene_plan

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GeneralSolved:
    """Capture sets from several positions with their solution, and the true pattern where it is known.

    Parameters
    ----------
    source_error:
        Relative error of the pattern after the best global scale; None where there is no truth.
    """

    captures: tuple[CaptureSet, ...]
    solution: GeneralSolution
    truth: Array | None
    source_error: float | None

    def summary(self) -> dict[str, Any]:
        """The JSON document of the command."""
        s = self.solution
        return {
            "status": s.status,
            "verdict": s.verdict,
            "warnings": list(s.warnings),
            "method": s.method,
            "positions": [list(c.observer.position) for c in self.captures],
            "reciprocal": s.brdf.grid.reciprocal,
            "rank": s.rank,
            "mismatch": s.mismatch,
            "gap": s.gap,
            "predicted_error": s.predicted_error,
            "chi_squared": None if math.isnan(s.chi_squared) else s.chi_squared,
            "step_deg": s.step_deg,
            "determined": float(np.mean(s.brdf.determined)),
            "source": s.source.tolist(),
            "source_std": s.source_std.tolist(),
            **({} if self.source_error is None else {"truth": {"source_error": self.source_error}}),
        }


def solve_directories(
    directories: Sequence[Path],
    out: Path,
    *,
    reciprocal: bool = False,
    step_deg: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> GeneralSolved:
    """Read the sets of one card, recover pattern and table, and leave solution.json, source.csv, brdf.csv and report.html.

    Parameters
    ----------
    directories, out:
        A capture set for each position of the observer, and the folder to write to.
    reciprocal, step_deg, progress:
        As in `solve_general`.

    Raises
    ------
    InputError, UndeterminedError
        As `read_captures` and `solve_general`; nothing is written then.
    """
    captures = tuple(read_captures(directory) for directory in directories)
    solution = solve_general(captures, reciprocal=reciprocal, step_deg=step_deg, progress=progress)
    known = read_truth(directories[0])
    fits = known is not None and known.source.shape == solution.source.shape and bool(np.any(known.source))
    truth = known.source if known is not None and fits else None
    error = None if truth is None else scale_free_error(solution.source, truth)
    solved = GeneralSolved(captures, solution, truth, error)
    _write(out, solved)
    return solved


def _write(out: Path, solved: GeneralSolved) -> None:
    s = solved.solution
    page = page_html(
        title="A wall turned into a mirror, from several positions",
        lead=s.status,
        verdicts=_verdicts(solved),
        sections=[
            Section(
                "The scenes",
                tuple(
                    FigureBlock(
                        scene_plan(c.observer, c.card, half_width=1e9, room=c.room), f"Position {number} from above."
                    )
                    for number, c in enumerate(solved.captures[:4], 1)
                ),
            ),
            Section(
                "The card's pattern",
                (
                    FigureBlock(
                        recovered_source(s.source, s.source_std, solved.truth), "The recovered pattern with error bars."
                    ),
                ),
            ),
            Section(
                "The wall's BRDF",
                (
                    "How strongly the wall sends light that arrives at angle θs out at angle θo. Blank: the captures do not "
                    "decide it.",
                    FigureBlock(recovered_table(s.brdf), "The recovered table."),
                ),
            ),
            Section("How far to trust it", (_certificates(solved),)),
        ],
    )
    write_results(
        out,
        source=source_csv(s.source, s.source_std),
        brdf=_table_csv(s),
        page=page,
        summary=solved.summary(),
    )


def _verdicts(solved: GeneralSolved) -> list[Verdict]:
    s, error = solved.solution, solved.source_error
    if error is None:
        return [Verdict(not s.warnings, s.status if s.warnings else "The captures determine pattern and table.")]
    return [
        Verdict(
            error <= 2 * s.predicted_error,
            f"The pattern is {100 * error:.2g} % off the true one; the solution's own error bars said "
            f"{100 * s.predicted_error:.2g} %.",
        )
    ]


def _certificates(solved: GeneralSolved) -> TableBlock:
    s = solved.solution
    return TableBlock(
        ("certificate", "value", "should be"),
        (
            ("method", s.method.replace("_", " "), f"knots every {s.step_deg:g}° along both angles"),
            ("rank of the data", str(s.rank), f"{s.source.shape[0]}, the number of elements"),
            ("mismatch of the closed form", f"{s.mismatch:.1e}", "as small as noise or rounding allow"),
            ("gap to the second-best table", f"{s.gap:.1e}", "far above the mismatch"),
            ("expected error of the pattern", f"{100 * s.predicted_error:.2g} %", "from the Cramér-Rao bound"),
            (
                "share of the table determined",
                f"{100 * float(np.mean(s.brdf.determined)):.0f} %",
                "more with more positions",
            ),
        ),
    )


def _table_csv(solution: GeneralSolution) -> str:
    table = solution.brdf
    shape = table.determined.shape
    theta_s = np.linspace(table.grid.theta_s.start, table.grid.theta_s.stop, shape[0])
    theta_o = np.linspace(table.grid.theta_o.start, table.grid.theta_o.stop, shape[1])
    s, o = np.meshgrid(theta_s, theta_o, indexing="ij")
    rows = np.stack([np.degrees(s), np.degrees(o), table(s, o), table.determined], axis=-1).reshape(-1, 4)
    return csv_text(["theta_s_deg", "theta_o_deg", "brdf", "determined"], rows.tolist())
