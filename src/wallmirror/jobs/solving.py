"""`wallmirror solve`: a capture set in, a solution with its report out."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet, Truth, read_captures, read_truth
from wallmirror.derendering.angle_sum_check import LEVEL, AngleSumCheck
from wallmirror.derendering.calibration import Calibration, calibrate
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import SolveOptions, solve
from wallmirror.files import write_together
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, page_html
from wallmirror.report.figures import recovered_brdf, recovered_source, scene_plan, source_deviations

Array = NDArray[np.float64]

# An error this many times the one asked for is none that more light would mend.
_HOPELESS = 1e6


@dataclass(frozen=True)
class Judgement:
    """Errors against a known truth, after the best global scale (or the best one of each group, where there are several).

    Parameters
    ----------
    source_error:
        Relative error of the pattern, to compare with the solution's predicted_error.
    brdf_error:
        Relative error of the BRDF over the angle sums known to 5 % of the peak; nan where the truth has no finite values,
        or the BRDF's parts have scales of their own.
    """

    source_error: float
    brdf_error: float


@dataclass(frozen=True)
class Solved:
    """A capture set with its solution and, where a truth is known, how far that is off."""

    captures: CaptureSet
    solution: Solution
    truth: Truth | None
    judgement: Judgement | None
    calibration: Calibration | None = None
    tolerance: float | None = None

    @property
    def shortfall(self) -> str:
        """Why the pattern is not known to the tolerance, with what would help; empty where it is, or none was asked for."""
        s, tolerance = self.solution, self.tolerance
        if tolerance is None:
            return ""
        if s.one_bounce is not None and s.one_bounce.bias > tolerance:
            return (
                f"light beyond one bounce is foretold to move the pattern by {100 * s.one_bounce.bias:.2g} %, more than the "
                f"{100 * tolerance:.3g} % asked for; no samples mend that, a darker card or room does"
            )
        if s.predicted_error > tolerance:
            ratio = s.predicted_error / tolerance
            more = f"about {ratio * ratio:.2g} times as many samples a pixel, or views, would do"
            return (
                f"the pattern is known to {100 * s.predicted_error:.2g} %, not to the {100 * tolerance:.3g} % asked for; "
                + (more if ratio < _HOPELESS else "no number of samples would do")
            )
        return ""

    def summary(self) -> dict[str, Any]:
        """The JSON document of the command."""
        document = self.solution.summary()
        if self.judgement is not None:
            document["truth"] = {
                "source_error": self.judgement.source_error,
                "brdf_error": None if math.isnan(self.judgement.brdf_error) else self.judgement.brdf_error,
            }
        if self.tolerance is not None:
            document["tolerance"] = {"asked": self.tolerance, "kept": not self.shortfall, "why": self.shortfall}
        if self.calibration is not None:
            document["calibration"] = {
                "status": self.calibration.status,
                "metres": dict(self.calibration.values),
                "metres_std": dict(self.calibration.std),
                "elements_x": list(self.calibration.card.elements_x),
                "y": self.calibration.card.y,
            }
        return document


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


def judge(solution: Solution, truth: Truth | None) -> Judgement | None:
    """Compare a solution with the truth of a rendered capture set; None where there is no truth, or a dark one."""
    if truth is None or truth.source.shape != solution.source.shape or not np.any(truth.source):
        return None
    rho = true_brdf(solution, truth)
    brdf_error = math.nan
    if rho is not None and solution.components == 1:
        seen = well_seen(solution)
        if np.any(rho[seen]):
            brdf_error = scale_free_error(solution.brdf[seen], rho[seen])
    return Judgement(scale_free_error(solution.source, truth.source, solution.groups), brdf_error)


def well_seen(solution: Solution) -> NDArray[np.bool_]:
    """Nodes of the BRDF that the captures determine to better than 5 % of its peak."""
    return np.asarray(solution.brdf_std < 0.05)


def true_brdf(solution: Solution, truth: Truth | None) -> Array | None:
    """The true BRDF on the solution's nodes; None for a mirror or where nothing is known."""
    if truth is None or truth.brdf.size < 2:
        return None
    order = np.argsort(truth.angle_sum)
    return np.interp(solution.angle_sum, truth.angle_sum[order], truth.brdf[order])


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


def write_results(out: Path, *, source: str, brdf: str, page: str, summary: dict[str, Any]) -> None:
    """Write the four files of a solution, all or none of them: source.csv, brdf.csv, report.html and solution.json."""
    write_together(
        out,
        {
            "source.csv": source,
            "brdf.csv": brdf,
            "report.html": page,
            # Last, so that its presence says that the rest is complete.
            "solution.json": json.dumps(summary, indent=2, allow_nan=False) + "\n",
        },
    )


def verdicts(solved: Solved) -> list[Verdict]:
    """The verdict sentences of a solution, the truth's first where it is known."""
    solution, judgement = solved.solution, solved.judgement
    lines = []
    if judgement is not None:
        ratio = judgement.source_error / solution.predicted_error
        lines.append(
            Verdict(
                ratio <= 2,
                f"The pattern is {100 * judgement.source_error:.2g} % off the true one; the solution's own error bars "
                f"said {100 * solution.predicted_error:.2g} %.",
            )
        )
    if solved.shortfall:
        lines.append(Verdict(False, solved.shortfall[0].upper() + solved.shortfall[1:] + "."))
    lines.extend(Verdict(False, warning[0].upper() + warning[1:] + ".") for warning in solution.warnings)
    if not solution.warnings:
        lines.append(Verdict(True, "No certificate objects: rank, mismatch, misfit and the one-bounce check agree."))
    return lines


def solution_sections(solved: Solved) -> list[Section]:
    """Pattern, BRDF and certificates of a solution as sections of a report."""
    solution, truth = solved.solution, solved.truth
    source_truth = truth.source if truth is not None and solved.judgement is not None else None
    beside = ", beside the true one (grey)" if source_truth is not None else ""
    return [
        Section(
            "The card's pattern",
            (
                "Each dot is one element of the card in one realisation of the pattern. Only ratios can be recovered: a "
                "brighter card before a darker wall sends back the same light.",
                FigureBlock(
                    recovered_source(solution.source, solution.shape_std, source_truth),
                    f"The recovered pattern with error bars{beside}.",
                ),
                *(
                    ()
                    if source_truth is None
                    else (
                        FigureBlock(
                            source_deviations(solution, source_truth),
                            "Recovered minus true, after the best scale, with two-sigma bars: most should touch the line.",
                        ),
                    )
                ),
            ),
        ),
        Section(
            "The wall's BRDF",
            (
                "How strongly the wall sends light that arrives at angle θs out at angle θo, as a function of their sum.",
                FigureBlock(
                    recovered_brdf(solution, true_brdf(solution, truth)),
                    f"The recovered BRDF with its two-sigma band{beside}.",
                ),
            ),
        ),
        Section("How far to trust it", (certificates(solved),)),
    ]


def certificates(solved: Solved) -> TableBlock:
    """The certificates of a solution with what each should be."""
    s = solved.solution
    elements = s.source.shape[0]
    rows = [
        ("method", s.method.replace("_", " "), f"knots every {s.step_deg:g}°, {s.seconds:.2f} s"),
        ("rank of the data", str(s.rank), f"{elements}, the number of elements"),
        ("mismatch of the closed form", f"{s.mismatch:.1e}", _expected(s.mismatch_expected)),
        ("gap to the second-best BRDF", f"{s.gap:.1e}", "far above the mismatch"),
        ("condition of the transport", f"{s.condition:.3g}", "how much noise is amplified at most"),
        ("misfit / stated noise", _number(s.chi_squared), "1 where model and noise are right"),
        ("residual of the fit", f"{100 * s.residual:.2g} %", "noise alone; it does not certify one bounce"),
        ("expected error of the pattern", f"{100 * s.predicted_error:.2g} %", "from the Cramér-Rao bound"),
        ("free scales", str(s.components), f"1, the global scale (here {s.gauge})"),
        *((("rests on", " and ".join(s.priors), "true of wall and card, or the answer is not"),) if s.priors else ()),
    ]
    if solved.calibration is not None:
        found = solved.calibration
        for name, value in found.values.items():
            rows.append(
                (
                    f"the card's {name}, found",
                    f"{value:.6g} m",
                    f"± {found.std[name]:.1e} m, which the error bars know of",
                )
            )
    if s.one_bounce is not None:
        check = s.one_bounce
        rows.append(
            (
                "light beyond one bounce",
                f"{100 * check.share:.2g} %",
                f"makes a bias of {100 * check.bias:.2g} % at a wall albedo of {check.wall_albedo:.2g}"
                + (" (assumed)" if check.assumed else ""),
            )
        )
    if s.angle_sum_check is not None:
        rows.append(_of_angle_sum(s.angle_sum_check))
    if solved.judgement is not None:
        rows.append(("true error of the pattern", f"{100 * solved.judgement.source_error:.2g} %", "against the truth"))
        if not math.isnan(solved.judgement.brdf_error):
            rows.append(("true error of the BRDF", f"{100 * solved.judgement.brdf_error:.2g} %", "against the truth"))
    return TableBlock(("certificate", "value", "should be"), tuple(rows))


def _of_angle_sum(check: AngleSumCheck) -> tuple[str, str, str]:
    wall = "Hypothesis 8 (angle sum)"
    if check.assumed:
        wall = "a wall of facets: " + ", ".join(f"{k} to the {v:.2f}" for k, v in check.assumed.items())
    return (
        f"the films against {wall}",
        f"p = {check.significance:.2g}",
        f"above {LEVEL:g}; a wall of more factors turns the pattern by {100 * check.bias:.2g} ± {100 * check.open:.2g} %",
    )


def _expected(value: float) -> str:
    return "as small as rounding allows" if math.isnan(value) else f"{value:.1e} from noise alone"


def _number(value: float) -> str:
    return "noise not stated" if math.isnan(value) else f"{value:.3f}"


def csv_text(header: list[str], rows: list[list[float]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def source_csv(source: Array, std: Array) -> str:
    """A pattern (M, B) with its standard deviations, a row for each entry."""
    elements, realisations = source.shape
    rows = [[i, b, source[i, b], std[i, b]] for b in range(realisations) for i in range(elements)]
    return csv_text(["element", "realisation", "radiance", "standard_deviation"], rows)


def _brdf_csv(solution: Solution) -> str:
    rows = np.stack([np.degrees(solution.angle_sum), solution.brdf, solution.brdf_std], axis=1)
    return csv_text(["angle_sum_deg", "brdf", "standard_deviation"], rows.tolist())
