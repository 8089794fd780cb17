"""`wallmirror solve`: a capture set in, a solution with its report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from wallmirror.captures import read_captures, read_truth
from wallmirror.derendering.calibration import calibrate
from wallmirror.derendering.options import SolveOptions
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import solve
from wallmirror.jobs.solution_files import csv_text, source_csv, write_results
from wallmirror.jobs.solution_report import solution_sections, verdicts
from wallmirror.jobs.solved import Solved, judge
from wallmirror.report import FigureBlock, Section, page_html
from wallmirror.report.figures import scene_plan


def solve_directory(
    directory: Path,
    out: Path,
    *,
    calibrated: bool = False,
    progress: Callable[[str], None] | None = None,
    **options: Unpack[SolveOptions],
) -> Solved:
    """Read a capture set, recover pattern and BRDF, and leave solution.json, source.csv, brdf.csv and report.html.

    Parameters
    ----------
    directory, out:
        The capture set, and the folder to write to; earlier results there are replaced together.
    calibrated:
        Find the card's offset, distance and width from the captures first (`calibrate`).
    progress, options:
        As in `solve`.

    Raises
    ------
    InputError, UndeterminedError
        As `read_captures`, `calibrate` and `solve`; nothing is written then.
    """
    captures = read_captures(directory)
    truth = read_truth(directory)
    calibration = None
    if calibrated:
        calibration = calibrate(captures, progress=progress)
        captures = replace(captures, card=calibration.card)
    solution = solve(captures, calibration=calibration, progress=progress, **options)
    solved = Solved(captures, solution, truth, judge(solution, truth), calibration, options.get("tolerance"))
    write_solution(out, solved)
    return solved


def write_solution(out: Path, solved: Solved) -> None:
    """Write a solution's files and its report page into a folder, all or none of them."""
    solution = solved.solution
    page = page_html(
        title="A wall turned into a mirror",
        lead=solution.status,
        verdicts=verdicts(solved),
        sections=[
            Section(
                "The scene",
                (
                    FigureBlock(
                        scene_plan(
                            solved.captures.observer, solved.captures.card, half_width=1e9, room=solved.captures.room
                        ),
                        "The scene from above, to scale. The camera sees the wall in the blue fields of view; the card "
                        "(orange) is out of its sight.",
                    ),
                ),
            ),
            *solution_sections(solved),
        ],
    )
    write_results(
        out,
        source=source_csv(solution.source, solution.source_std),
        brdf=_brdf_csv(solution),
        page=page,
        summary=solved.summary(),
    )


def _brdf_csv(solution: Solution) -> str:
    rows = np.stack([np.degrees(solution.angle_sum), solution.brdf, solution.brdf_std], axis=1)
    return csv_text(["angle_sum_deg", "brdf", "standard_deviation"], rows.tolist())
