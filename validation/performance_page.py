"""The page of the performance analysis, its numbers and verdicts drawn from the results; see performance_analysis.py."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from performance_figures import NAMES, Row, crossed_figure, example, sweep_figure
from performance_runs import EXACT, FEW, RECORDED, TEXT

#: A relative error of the pattern below which it counts as recovered.
RECOVERED = 1e-6
#: One below which an estimate looks close, as in figure 4.3.
_CLOSE = 0.2
HEADINGS = {
    "N": "Figure 4.5: number of wall points N",
    "A": "Figure 4.6: number of views A",
    "B": "Figure 4.7: number of patterns B",
    "A x B": "Figure 4.8: A crossed with B",
    "M": "Figure 4.9: number of source points M",
    "sigma": "Only in the thesis's code: width of the lobes in degrees",
    "fov": "Only in the thesis's code: view angle in degrees",
    "alpha": "Only in the thesis's code: alpha",
    "proportion": "Only in the thesis's code: share of B_diff that is kept",
}
Line = tuple[str, str, str, str]


def write(document: dict[str, Any], out: Path) -> Path:
    """Draw all figures and write the page; returns the page's path."""
    figures = out / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    known: dict[str, dict[str, Row]] = document["sweeps"]
    parts = _opening(document)
    if "M" in known and "4" in known["M"]:  # the default scene
        luckiest = known["M"]["4"][TEXT]["luckiest"]
        parts += _example(example(figures, luckiest), luckiest, known["M"]["4"])
    for sweep, heading in HEADINGS.items():
        if sweep not in known:
            continue
        values, picture = known[sweep], f"performance_{sweep.replace(' ', '')}.png"
        if sweep == "A x B":
            crossed_figure(values, figures / picture)
        else:
            sweep_figure(sweep, values, figures / picture)
        parts += [f"## {heading}", f"![{heading}](figures/{picture})"]
        if sweep in CLAIMS:
            parts.append(_judged(CLAIMS[sweep](values)))
        parts.append(_sizes(values) if sweep == "A x B" else _table(sweep, values))
    page = out / "PERFORMANCE_ANALYSIS.md"
    page.write_text("\n\n".join(parts) + "\n")
    return page


def _opening(document: dict[str, Any]) -> list[str]:
    cost, known = document["cost"], document["sweeps"]
    exact = [row[EXACT] for values in known.values() for row in values.values()]
    worst = max((row for row in exact if "source_error" in row), key=lambda row: row["source_error"]["max"])
    where = next(f"{s} = {v}" for s, values in known.items() for v, row in values.items() if row[EXACT] == worst)
    reasons = sorted({row["reason"] for row in exact if row["refused"]})
    lines = [
        f"| {NAMES[m]} | {c['cells']} | {document['repetitions'][m]} | {c['runs']} | "
        f"{c['processor_seconds'] / 60:.1f} min | {1e3 * c['median_seconds']:.0f} ms |"
        for m, c in cost.items()
        if c["runs"]
    ]
    calls = [
        f"- {NAMES[m]}: {c['runs']} runs in {c['wall_seconds'] / 60:.1f} min, workers {c['workers']}, "
        f"{c['processors']} processors, load {c['load'][0]:g} before and {c['load'][1]:g} after"
        for m, c in document["last_call"].items()
    ]
    return [
        "# The thesis's performance analysis, with the exact solver beside its algorithm",
        "    python validation/performance_analysis.py [--quick] [--only SWEEP] [--jobs N | --dask ADDRESS] [--page]",
        """\
Section 4.2.3 of the thesis asks how the errors of pattern and BRDF hang on the number of wall points N, of views A, of
patterns B and of source points M (figures 4.5 to 4.9). Its code also sweeps the width of the lobes, the view angle,
alpha, and the share of B_diff that is kept. Here every cell is run with the closed form of `wallmirror.solve`, and with
the thesis's Algorithm 3 ([done exactly](THESIS_ALGORITHM.md)): once with the settings of its table 4.3 (alpha 0.1,
tolerance 1e-2, whole rows of B_diff), once with those of its recorded run (alpha 10). There is no noise, as in the
thesis.""",
        f"""\
**In short.** The closed form recovers pattern and BRDF in every cell that has as many patterns as source points. Its
worst pattern in all runs is {worst["source_error"]["max"]:.0e} off (relative, at {where}). In the range of these sweeps it
has no threshold in N, A, B or M beyond B >= M.{_searched(known)} The thresholds that the thesis found are
those of its algorithm.""",
        "| method | cells | repetitions | runs | processor time | usual run |\n|---|---|---|---|---|---|\n"
        + "\n".join(lines),
        f"""\
The thesis needed "more than a week" for its analysis. {cost[EXACT]["runs"]} runs of the exact solver take
{cost[EXACT]["processor_seconds"] / 60:.1f} minutes of one processor's time. The last calls took:""",
        "\n".join(calls),
        """\
Mean square errors are the thesis's: over the entries of V and of B, in the unit in which lobes have height 1. The
pattern's is taken in the order of source points that suits it best, and also in the order in which the thesis's code
leaves it ("its order"). Relative errors are after the best global scale, which a blind solution never knows. Tables show
means of the thesis's algorithm, as the thesis has them, and median and worst run of the exact solver.""",
        f"""\
The verdicts follow from the numbers. *Confirmed*: the conclusion holds for the algorithm and for the problem.
*Corrected*: it holds for the algorithm, but the exact solver, on the same captures, does not show it. *Refuted*: it does
not hold for the algorithm either, in the settings of table 4.3. Means count as different from three standard errors on,
and a pattern as recovered below a relative error of {RECOVERED:.0e}.""",
        "Cells that the closed form **refuses** are crosses in the figures. Its reason:\n" + "; ".join(reasons) + "."
        if reasons
        else "No cell was refused.",
    ]


def _searched(known: dict[str, dict[str, Row]]) -> str:
    """What the search made of the cells with fewer patterns than source points, in a sentence."""
    # Sweeps share cells; each counts once.
    rows = {
        json.dumps(row[FEW]): row[FEW] for values in known.values() for row in values.values() if FEW in row
    }.values()
    found = [row for row in rows if "source_error" in row]
    if not found:
        return ""
    runs, refused = (sum(row[k] for row in rows) for k in ("runs", "refused"))
    medians = [row["source_error"]["median"] for row in found]
    return (
        f" Where B < M, the search for few captures,\nto which `solve` then turns, answers {runs - refused} of {runs} runs, "
        f"with median errors of {min(medians):.0e} to {max(medians):.0e} in the\ncells and "
        f"{max(row['source_error']['max'] for row in found):.0e} in the worst run."
    )


def _example(numbers: dict[str, dict[str, float]], repetition: int, usual: Row) -> list[str]:
    theirs, ours = numbers[TEXT], numbers[EXACT]

    def said(side: str) -> tuple[str, str]:
        its, mine = (f"{n[f'{side}_mse']:.1e}, relative {n[f'{side}_error']:.1e}" for n in (theirs, ours))
        return f"{its} (median of all runs {usual[TEXT][f'{side}_mse']['median']:.1e})", mine

    return [
        "## Figures 4.3 and 4.4: one estimate beside the truth",
        f"""\
The thesis shows "a successful algorithm iteration". This is repetition {repetition}, the one of
{usual[TEXT]["runs"]} at the defaults whose pattern the thesis's algorithm hits best.""",
        "![One pattern](figures/performance_source.png)",
        "![One BRDF](figures/performance_brdf.png)",
        _judged(
            [
                (
                    "4.3: the pattern comes close, extrema and relative intensities are recovered",
                    *said("source"),
                    verdict(
                        theirs["source_error"] < _CLOSE,
                        ours["source_error"] < _CLOSE,
                        "even the luckiest run is off",
                    ),
                ),
                (
                    "4.4: the BRDF's structure is kept, nuances are lost, since only a share of B_diff is estimated",
                    *said("brdf"),
                    verdict(
                        theirs["brdf_error"] > _CLOSE,
                        ours["brdf_error"] > _CLOSE,
                        "the algorithm loses them; a BRDF of the angle sum needs no such share",
                    ),
                ),
            ]
        ),
    ]


def _judged(lines: list[Line]) -> str:
    head = "| the thesis concludes | its algorithm | the exact solver | verdict |\n|---|---|---|---|\n"
    return head + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _table(sweep: str, values: dict[str, Row]) -> str:
    recorded = all(RECORDED in row for row in values.values())
    head = [sweep, "pattern", "its order", "BRDF", *(["pattern, alpha 10", "BRDF, alpha 10"] if recorded else [])]
    head += ["exact: pattern", "exact: BRDF"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for value, row in values.items():
        cells = [value, *(f"{row[TEXT][m]['mean']:.4f}" for m in ("source_mse", "source_mse_its_order", "brdf_mse"))]
        cells += [f"{row[RECORDED][m]['mean']:.4f}" for m in ("source_mse", "brdf_mse") if recorded]
        for measure in ("source_error", "brdf_error"):
            found = row[EXACT].get(measure)
            searched = row.get(FEW, {}).get(measure)
            its = f"refused; search {searched['median']:.0e} ({searched['max']:.0e})" if searched else "refused"
            cells.append(f"{found['median']:.0e} ({found['max']:.0e})" if found else its)
        lines.append("| " + " | ".join(cells) + " |")
    note = "\n\nMean square errors of the thesis's algorithm; relative errors of the exact solver, median (worst run)."
    if sweep in ("alpha", "proportion"):
        note += " The exact solver\nhas no such option: its line is that of the defaults and was not run again."
    return "\n".join(lines) + note


def _sizes(values: dict[str, Row]) -> str:
    found = solved(values)
    medians = [v[EXACT]["source_error"]["median"] for v in found.values()]
    return (
        f"Of {len(values)} cells the closed form refuses {len(values) - len(found)}. In the others its patterns' relative "
        f"errors have medians of\n{min(medians):.0e} to {max(medians):.0e}, and no run exceeds {worst(found):.0e}."
    )


def mean(row: Row, method: str, measure: str) -> tuple[float, float]:
    """Mean over repetitions and its standard error."""
    numbers = row[method][measure]
    return numbers["mean"], numbers["std"] / math.sqrt(row[method]["runs"] - row[method]["refused"])


def lower(one: Row, other: Row, measure: str, method: str = TEXT) -> bool:
    """Whether the mean of one cell is lower than that of another by three standard errors."""
    (mine, spread), (its, scatter) = mean(one, method, measure), mean(other, method, measure)
    return mine < its - 3 * math.hypot(spread, scatter)


def solved(values: dict[str, Row]) -> dict[str, Row]:
    """The places in which the exact solver gave results."""
    return {k: row for k, row in values.items() if "source_error" in row[EXACT]}


def worst(values: dict[str, Row]) -> float:
    """The exact solver's largest relative error of a pattern in any run."""
    return max(float(row[EXACT]["source_error"]["max"]) for row in solved(values).values())


def nearest(values: dict[str, Row], number: float) -> str:
    """The value of a sweep that lies nearest to a number."""
    return min(values, key=lambda v: abs(float(v) - number))


def verdict(algorithm: bool, problem: bool, why: str = "") -> str:
    """The word, and a reason where it is no confirmation."""
    word = "confirmed" if algorithm and problem else "corrected" if algorithm else "refuted"
    return f"{word}: {why}" if why and word != "confirmed" else word


def told(values: dict[str, Row], names: list[str], measure: str, method: str = TEXT) -> str:
    """Means along a sweep."""
    return ", ".join(f"{mean(values[k], method, measure)[0]:.3g}" for k in names)


def _points(values: dict[str, Row]) -> list[Line]:
    first, near, last = next(iter(values)), nearest(values, 500), list(values)[-1]
    names = [first, near, last]
    level = all(not lower(values[last], values[near], m) for m in ("source_mse", "brdf_mse"))
    falls = all(lower(values[near], values[first], m) for m in ("source_mse", "brdf_mse"))
    few = worst({k: row for k, row in values.items() if float(k) < 500})
    its = f"N = {', '.join(names)}: pattern {told(values, names, 'source_mse')}, BRDF {told(values, names, 'brdf_mse')}"
    return [
        (
            "errors fall as N grows, and N = 500 is enough",
            its,
            f"no pattern of any N < 500 is more than {few:.0e} off",
            verdict(
                falls and level, few > RECOVERED, "the chaining of views needs that many points, the problem does not"
            ),
        )
    ]


def _views(values: dict[str, Row]) -> list[Line]:
    first, near, last = next(iter(values)), nearest(values, 10), list(values)[-1]
    names = [first, near, last]
    off = worst(values)
    helps = lower(values[near], values[first], "source_mse")
    recorded = lower(values[near], values[first], "source_mse", RECORDED)
    hurts = any(lower(values[near], values[last], m) for m in ("source_mse", "brdf_mse"))
    mine = f"no pattern of any A is more than {off:.0e} off"
    places = f"A = {', '.join(names)}"
    return [
        (
            "more views help the pattern first of all, up to A = 10",
            f"{places}: pattern {told(values, names, 'source_mse')}; at alpha 10 "
            f"{told(values, names, 'source_mse', RECORDED)}",
            mine,
            verdict(
                helps,
                off > RECOVERED,
                f"two views are enough{'; at alpha 10 they do help its algorithm' if recorded else ''}",
            ),
        ),
        (
            "beyond A = 10 it gets worse",
            f"{places}: pattern {told(values, names, 'source_mse')}, BRDF {told(values, names, 'brdf_mse')}",
            mine,
            verdict(hurts, off > RECOVERED, "views further along the chain add its errors, not the problem's"),
        ),
    ]


def _patterns(values: dict[str, Row]) -> list[Line]:
    first, near, last = next(iter(values)), nearest(values, 25), list(values)[-1]
    names = [first, near, last]
    found = solved(values)
    fewest, off = next(iter(found)), worst(found)
    refused = ", ".join(k for k in values if k not in found)
    mine = f"refuses B = {refused}; from B = {fewest} on no pattern is more than {off:.0e} off"
    lines: list[Line] = []
    for conclusion, measure, name in (
        ("more patterns help the BRDF; B = 25 is enough", "brdf_mse", "BRDF"),
        ("they help the pattern too, with hiccups", "source_mse", "pattern"),
    ):
        helps = lower(values[near], values[first], measure) and not lower(values[last], values[near], measure)
        its = f"B = {', '.join(names)}: {name} {told(values, names, measure)}"
        lines.append(
            (conclusion, its, mine, verdict(helps, off > RECOVERED, "the closed form asks for B >= M, and no more"))
        )
    return lines


def _crossed(values: dict[str, Row]) -> list[Line]:
    views, patterns = (sorted({int(v.split(" x ")[k]) for v in values}) for k in (0, 1))
    measure = "brdf_mse"
    better = sum(lower(values[f"{a} x {patterns[-1]}"], values[f"{a} x {patterns[0]}"], measure) for a in views)
    worse = sum(lower(values[f"{views[0]} x {b}"], values[f"{views[-1]} x {b}"], measure) for b in patterns)
    spared = sum(lower(values[f"{views[-1]} x {b}"], values[f"{views[0]} x {b}"], measure) for b in patterns)
    found = solved(values)
    # A trend of the exact solver would be one that leaves the size of rounding.
    mine = f"no solved cell's pattern is more than {worst(found):.0e} off"
    return [
        (
            "raising B betters the BRDF",
            f"B = {patterns[-1]} is better than B = {patterns[0]} at {better} of {len(views)} A",
            mine,
            verdict(
                better > 0.8 * len(views), worst(found) > RECOVERED, "the closed form asks for B >= M, and no more"
            ),
        ),
        (
            "raising A worsens the BRDF",
            f"A = {views[-1]} is worse than A = {views[0]} at {worse} of {len(patterns)} B, and better at {spared}",
            mine,
            verdict(
                2 * worse >= len(patterns) and not spared, worst(found) > RECOVERED, "it is the chaining that errs"
            ),
        ),
    ]


def _elements(values: dict[str, Row]) -> list[Line]:
    names = [k for k in ("1", "4", "7", "9", "10") if k in values]
    first, last, before = names[0], names[-1], names[-2]
    grows = all(lower(values[first], values[last], m) for m in ("source_mse", "brdf_mse"))
    level = all(not lower(values[before], values[last], m) for m in ("source_mse", "brdf_mse"))
    off = worst(values)
    beyond = [k for k, row in values.items() if mean(row, TEXT, "source_mse")[0] > 1 / 12]
    its = f"M = {', '.join(names)}: pattern {told(values, names, 'source_mse')}, BRDF {told(values, names, 'brdf_mse')}"
    mine = f"no pattern of any M is more than {off:.0e} off"
    return [
        (
            "both errors grow with M",
            its + (f"; from M = {beyond[0]} on worse than the guess V = 0.5" if beyond else ""),
            mine,
            verdict(grows, off > RECOVERED, "more source points cost the problem nothing as long as B >= M"),
        ),
        (
            "from M = 10 on the error grows no more",
            its,
            mine,
            verdict(level, off > RECOVERED, "it levels off because guessing is no worse"),
        ),
    ]


CLAIMS = {"N": _points, "A": _views, "B": _patterns, "A x B": _crossed, "M": _elements}
