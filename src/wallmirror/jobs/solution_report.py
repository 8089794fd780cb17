"""A solution as a page: what it says first, pattern and BRDF with their error bars, and its certificates."""

from __future__ import annotations

import math

from wallmirror.derendering.angle_sum_check import LEVEL, AngleSumCheck
from wallmirror.jobs.solved import Solved, true_brdf
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict
from wallmirror.report.figures import recovered_brdf, recovered_source, source_deviations


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
