"""Page and figure of `peers.py`, both from its results alone."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

#: What each method is called, how it is drawn, and what it is or is granted.
METHODS: dict[str, tuple[str, str, str]] = {
    "ours: closed form": ("tab:red", "*", '`solve(method="closed_form")`; finds its knots itself, no random start'),
    "ours: likelihood": (
        "darkred",
        "P",
        '`solve(method="maximum_likelihood")`, both non-negative; finds its knots, no random start, error bars included',
    ),
    "ours: knots given": ("salmon", "X", "the one of the two that `solve` chooses, told the knots that peers are told"),
    "L-BFGS": ("tab:blue", "", "L-BFGS (SciPy) over r and V together, analytic gradient, no bounds, knots given"),
    "L-BFGS, >= 0": ("navy", "", "the same with r >= 0 and V >= 0 (L-BFGS-B)"),
    "ALS": ("tab:green", "", "alternating least squares for r and V, knots given"),
    "ALS, >= 0": ("darkgreen", "", "the same, each half with its bounds, by our own solvers of those halves"),
    "NMF": (
        "tab:orange",
        "",
        "scikit-learn, D = F V with both >= 0, negative data set to 0; granted the best order and the best scale of each "
        "element for V and for F, which it cannot know",
    ),
    "thesis": (
        "tab:purple",
        "",
        "the thesis's Algorithm 3 over B_diff and V in [0, 1], alpha the best of its own grid; granted the best order",
    ),
    "Mitsuba, Adam": (
        "tab:brown",
        "",
        "wallmirror's plugin, prb and Adam over the BRDF's table and V; knows F by path tracing only",
    ),
}
#: Methods that do not know that F depends on one BRDF as D = [T_1 r .. T_M r] V says, and one that knows by rendering.
UNSTRUCTURED, RENDERING = ("NMF", "thesis"), ("Mitsuba, Adam",)
#: Without noise an error below this counts as arrived; with noise twice the lowest or the bound does.
ARRIVED = 1e-6
_CLOSE = 1.1


@dataclass(frozen=True)
class Summary:
    """The best starts of one method, medians over the truths, and what became of all of its runs."""

    method: str
    error: float
    transport: float
    over_bound: float
    seconds: float
    iterations: float
    arrived: int
    failed: int
    runs: int
    refusal: str


def end_error(run: dict[str, Any]) -> float:
    """Error of V at the end; inf for a run that gave none."""
    return float(run["trace"][-1][1]) if run["trace"] else math.inf


def settled(run: dict[str, Any]) -> float:
    """Seconds until the error of V first came within 10 % of what it ended with."""
    return next(float(t) for t, v, _ in run["trace"] if v <= _CLOSE * end_error(run))


def best(runs: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The start of lowest error; of those within 1 %, the quickest. None if all were refused."""
    runs = [run for run in runs if run["trace"]]
    lowest = min(map(end_error, runs), default=math.inf)
    return min((run for run in runs if end_error(run) <= 1.01 * lowest), key=settled, default=None)


def summarise(document: dict[str, Any], panel: str) -> list[Summary]:
    """One line for each method of a panel, in the order of METHODS."""
    runs = [run for run in document["runs"] if run["panel"] == panel]
    lines = document["lines"][panel]
    lowest = [min(end_error(run) for run in runs if run["seed"] == seed) for seed in range(len(lines))]
    goal = [2 * max(low, line["bound"]) if "bound" in line else ARRIVED for low, line in zip(lowest, lines)]
    found = []
    for method in METHODS:
        mine = [run for run in runs if run["method"] == method]
        if not mine:
            continue
        chosen = [
            run for seed in range(len(lines)) if (run := best([r for r in mine if r["seed"] == seed])) is not None
        ]
        ends = [end_error(run) for run in chosen]
        over = [end_error(run) / lines[run["seed"]].get("bound", math.nan) for run in chosen]

        def median(values: list[float]) -> float:
            return float(np.median(values)) if values else math.nan

        found.append(
            Summary(
                method=method,
                error=median(ends),
                transport=median([run["trace"][-1][2] for run in chosen]),
                over_bound=median(over),
                seconds=median([settled(run) for run in chosen]),
                iterations=median([run["iterations"] for run in chosen]),
                arrived=sum(end_error(run) <= goal[run["seed"]] for run in mine),
                failed=sum(has_failed(run, lines[run["seed"]]) for run in mine),
                runs=len(mine),
                refusal=next((run["ended"] for run in mine if not run["trace"]), ""),
            )
        )
    return found


def has_failed(run: dict[str, Any], lines: dict[str, float]) -> bool:
    """Refused, or no better than a pattern that is the same everywhere."""
    return end_error(run) >= lines["guess"]


def conclusion(document: dict[str, Any], panel: str) -> str:
    """What a panel says, in words."""
    found = {s.method: s for s in summarise(document, panel) if math.isfinite(s.error)}
    noisy = "bound" in document["lines"][panel][0]
    lowest = min(s.error for s in found.values())
    limit = 2 * lowest if noisy else ARRIVED
    there = sorted((s for s in found.values() if s.error <= limit), key=lambda s: s.seconds)
    rest = sorted((s for s in found.values() if s.error > limit), key=lambda s: s.error)
    winner = min(found.values(), key=lambda s: s.error)
    words = [f"{winner.method} comes closest, {winner.error:.2g} off"]
    if noisy:
        words[0] += f" ({winner.over_bound:.2f} times the bound)"
    words[0] += "."
    what = "within twice that error" if noisy else f"below {ARRIVED:g}"
    first = there[0]
    words.append(
        f"The first to come {what} is {first.method} ({first.seconds:.2g} s to settle); "
        f"with it {', '.join(f'{s.method} ({s.seconds:.2g} s, {s.error:.1e})' for s in there[1:]) or 'no other'}."
    )
    if rest:
        words.append(f"The others end at {', '.join(f'{s.error:.2g} ({s.method})' for s in rest)}.")
    if refused := [s for s in summarise(document, panel) if s.refusal]:
        reason = refused[0].refusal.removeprefix("refused: ").split(";")[0]
        words.append(f"Refused to answer: {', '.join(s.method for s in refused)} ({reason}).")
    random_starts = [s for s in there if not s.method.startswith("ours")]
    if random_starts:
        arrived, runs = sum(s.arrived for s in random_starts), sum(s.runs for s in random_starts)
        words.append(f"Of these peers' random starts {arrived} of {runs} arrived.")
    mine = found["ours: likelihood" if noisy else "ours: closed form"]  # what `solve` chooses
    rivals = [s for s in there if not s.method.startswith("ours")]
    if rivals:
        ratio = mine.seconds / rivals[0].seconds
        words.append(
            f"`solve`, which chooses {mine.method.removeprefix('ours: ')} here and finds its knots itself, takes {ratio:.2g} "
            f"times as long as the quickest of these peers, which was told them; told them too, it takes "
            f"{found['ours: knots given'].seconds / rivals[0].seconds:.2g} times as long."
        )
    return " ".join(words)


def overall(document: dict[str, Any]) -> str:
    """Which methods arrive in which panels, in words."""
    panels = list(document["lines"])
    took: dict[str, list[bool]] = {}
    starts: dict[str, list[int]] = {}
    for panel in panels:
        for s in summarise(document, panel):
            took.setdefault(s.method, []).append(s.arrived > 0)
            counts = starts.setdefault(s.method, [0, 0])
            starts[s.method] = [counts[0] + s.arrived, counts[1] + s.runs]

    def names(which: Callable[[list[bool]], bool]) -> str:
        chosen = [f"{name} ({starts[name][0]} of {starts[name][1]} runs)" for name, seen in took.items() if which(seen)]
        return ", ".join(chosen) or "none"

    words = [
        f"Arrived in every panel that they took part in: {names(all)}. In some: "
        f"{names(lambda seen: any(seen) and not all(seen))}. In none: {names(lambda seen: not any(seen))}."
    ]
    for name, seen in took.items():
        if not any(seen):
            cut = [run for run in document["runs"] if run["method"] == name and run["ended"] == "out of time"]
            if cut:
                fell = float(np.median([still_falling(run) for run in cut]))
                words.append(
                    f"{name} ran out of time in {len(cut)}, over the second half of which its error fell by a factor of "
                    f"{fell:.2g}."
                )
    if all(any(took[name]) for name in took if name not in (*UNSTRUCTURED, *RENDERING)) and not any(
        any(took.get(name, [])) for name in UNSTRUCTURED
    ):
        words.append(
            "What tells them apart is whether a method looks for r and V, D = [T_1 r .. T_M r] V, more than how it then "
            "solves that: those that look for F itself do not arrive."
        )
    return " ".join(words)


def ambiguity(document: dict[str, Any]) -> str:
    """What the factorisation leaves open, by its best fit of the films without noise."""
    fits = [run for run in document["runs"] if run["panel"] == "no noise" and run["residual"] is not None]
    if not fits:
        return ""
    closest = min(fits, key=lambda run: run["residual"])
    return (
        "Of NMF more remains ambiguous than the order and scales that it is granted: any invertible mixture of the "
        "elements that keeps both factors non-negative fits as well. Without noise its closest fit leaves "
        f"{closest['residual']:.1e} of |D| unexplained, and its V is {end_error(closest):.1e} off."
    )


def still_falling(run: dict[str, Any]) -> float:
    """Error of V at half of a run's time over that at its end."""
    times, errors = np.array(run["trace"])[:, :2].T
    return float(np.exp(np.interp(times[-1] / 2, times, np.log(errors))) / errors[-1])


def table(document: dict[str, Any], panel: str) -> str:
    """The summaries of a panel as a Markdown table."""
    reference = float(np.median(document["reference_seconds"]))
    header = ["method", "V off", "F off", "V / bound", "seconds", "/ reference", "iterations", "arrived", "failed"]
    rows = []
    for s in summarise(document, panel):
        if math.isnan(s.error):
            rows.append([s.method, *["-"] * 6, f"{s.arrived} of {s.runs}", f"{s.failed} of {s.runs}"])
            continue
        over = "-" if math.isnan(s.over_bound) else f"{s.over_bound:.2f}"
        rows.append(
            [
                s.method,
                f"{s.error:.1e}",
                f"{s.transport:.1e}",
                over,
                f"{s.seconds:.3g}",
                f"{s.seconds / reference:.3g}",
                f"{s.iterations:.0f}",
                f"{s.arrived} of {s.runs}",
                f"{s.failed} of {s.runs}",
            ]
        )
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def floors(document: dict[str, Any], panel: str) -> str:
    """Bound, oracle and guess of a panel, medians over the truths."""
    lines = document["lines"][panel]

    def median(name: str) -> float:
        return float(np.median([line[name] for line in lines]))

    words = f"Whoever knows the BRDF and solves V by least squares is {median('oracle'):.1e} off; a flat guess "
    words += f"{median('guess'):.2f}."
    if "bound" in lines[0]:
        words = f"Cramer-Rao bound: V {median('bound'):.2e}, F {median('bound_transport'):.1e}. {words}"
    return words


def page(document: dict[str, Any]) -> str:
    """PEERS.md."""
    settings, given = document["settings"], document["given"]
    panels = list(document["lines"])
    budgets = settings["budget"].values()
    loads = [load[0] for load in document["load"]]
    reference = [1e3 * seconds for seconds in document["reference_seconds"]]
    share = sum(run["processor_seconds"] for run in document["runs"]) / sum(run["seconds"] for run in document["runs"])
    parts = [
        "# The same problem solved in other ways",
        "    python benchmarks/peers.py",
        "![Error of the pattern over seconds](figures/peers.png)",
        filled(
            "Thick: the best start on the first truth; thin: all other runs; grey: what no record of the first truth beats "
            "in both error and time. A cross is a failure: refused, or no better than a flat guess. Errors are relative, "
            f"after the best global scale. Each table tells the best of {settings['starts']} starts ({settings['renders']} "
            f'of the renderer), medians over {settings["seeds"]} truths (one in the last panel). "Best" is by the true '
            "error, which a user would not know, and the time is that of the best start alone: both favour peers with "
            'random starts. "Seconds" run until the error first comes within 10 % of its end, preparation included. '
            f'"Arrived": below {ARRIVED:g} without noise, else within twice the lowest error on that truth or the bound. '
            "The bound holds for estimates without sign constraints: those with r >= 0 and V >= 0 may lie below it, and "
            "one draw of the noise scatters about it besides."
        ),
        "" if document["nmf"] else "scikit-learn was not installed, so NMF is missing here.",
    ]
    parts += ["## In short", filled(overall(document))]
    for panel in panels:
        title = f"## {panel[0].upper()}{panel[1:]}"
        parts += [title, filled(conclusion(document, panel)), table(document, panel), filled(floors(document, panel))]
    used = {run["method"] for run in document["runs"]}
    parts += [
        "## What each method is, and what it is granted",
        "\n".join(filled(f"- **{name}**: {text}.", "  ") for name, (_, _, text) in METHODS.items() if name in used),
        filled(
            "Noise is white, its standard deviation 40 or 20 dB below the rms radiance; no method is told how large it is. "
            f'"Knots given" means B-splines of degree {given["noisy_degree"]} every {given["noisy_knots_deg"]:g} deg with '
            f"noise, and of degree {given['noiseless_degree']} every {given['noiseless_knots_deg']:g} deg without "
            f"({given['alternation_knots_deg']:g} deg for ALS, whose steps would take too long else; its floor is then "
            "that of the splines): about the knots on which ours ends by itself. Structured peers work on the same sums "
            "over pixels as ours (T_i^T T_j and T_i^T D), which is most of their speed; L-BFGS goes on with the residual "
            f"itself where f falls below {given['residual_below']:g} |D|^2. Random starts are uniform in [0, 1], with the "
            f"scale that explains most of D. The thesis's algorithm has alpha {given['alpha']:g} (its analysis 0.1, its "
            "single run 10), no tolerance, and runs of 1 to 300 alternations, where the thesis stops after 30."
        ),
        filled(
            f"A run may take {min(budgets):g} s, {max(budgets):g} s without noise, and the first of each method "
            f"{settings['patience']:g} s."
        ),
        filled(ambiguity(document)),
        filled(
            f"The last panel has the physical weight, square strips of 2 cm and {given['render_pixels']} pixels a view, so "
            f"that a path tracer can play: a table of {given['render_nodes']} nodes over [-pi, pi], "
            f"{given['render_spp']} stratified samples per pixel, one film of all views for each strip, Adam with rate "
            f"{given['render_rate']:g} falling to 0 over its {settings['rendering']:g} s (rates from 0.03 to 0.3 and 4 to "
            "16 samples were tried beforehand). Its films are the analytic model's, not renders. "
            "It is small because a step costs so much: "
            "even so the seconds allow some tens of "
            "steps only. The thesis's algorithm and NMF are "
            "not in that panel: the one has no place for the physical weight, the other gains nothing from fewer pixels."
        ),
        filled(
            f"One thread each, on {document['cores']} cores shared with other work: load averages {min(loads):.1f} to "
            f"{max(loads):.1f} during the run, and {100 * share:.0f} % of the wall time on the processor. Seconds are "
            "therefore good to a factor of two or three, and are also given in units of a reference workload, the QR "
            f"factorisation of a 10,000 x 20 matrix ({min(reference):.1f} to {max(reference):.1f} ms in this run). "
            + ", ".join(f"{name} {version}" for name, version in document["versions"].items())
            + f". Made in {document['seconds'] / 60:.1f} min; all {len(document['runs'])} runs with their traces are in "
            "`results/peers.json` (`--page` rewrites page and figure from them)."
        ),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def filled(text: str, indent: str = "") -> str:
    """A paragraph in lines of 120 characters."""
    return textwrap.fill(text, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def figure(document: dict[str, Any]) -> bytes:
    """Error of V over seconds, one panel for each noise level, as a PNG file."""
    panels = list(document["lines"])
    chart = Figure(figsize=(12, 9.4), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(chart)
    handles: dict[str, Any] = {}
    for axis, panel in zip(chart.subplots(2, math.ceil(len(panels) / 2)).ravel(), panels):
        _draw(axis, document, panel, handles)
    ordered = [name for name in METHODS if name in handles]
    labels = [*ordered, *(name for name in handles if name not in METHODS)]
    chart.legend([handles[n] for n in labels], labels, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    canvas.draw()
    stream = io.BytesIO()
    chart.savefig(stream, format="png")
    return stream.getvalue()


def _draw(axis: Any, document: dict[str, Any], panel: str, handles: dict[str, Any]) -> None:
    runs = [run for run in document["runs"] if run["panel"] == panel]
    lines = document["lines"][panel]
    named: set[str] = set()
    for name, (colour, marker, _) in METHODS.items():
        mine = [run for run in runs if run["method"] == name]
        chosen = best([run for run in mine if run["seed"] == 0])
        for run in sorted(mine, key=lambda run: run is chosen):
            thick = run is chosen
            if run["trace"]:
                t, v = np.array(run["trace"])[:, :2].T
                style = {
                    "color": colour,
                    "linestyle": "" if marker else "-",
                    "linewidth": 2.4 if thick else 0.7,
                    "alpha": 1 if thick else 0.35,
                }
                (drawn,) = axis.loglog(t, v, marker=marker or None, markersize=13 if thick else 6, **style)
                if not marker:
                    axis.loglog(t[-1], v[-1], "o", color=colour, markersize=6 if thick else 3, alpha=style["alpha"])
                if thick:
                    drawn.set_markeredgecolor("white" if marker else colour)
                    handles[name] = drawn
            if has_failed(run, lines[run["seed"]]):
                x, y = run["trace"][-1][:2] if run["trace"] else (run["seconds"], lines[run["seed"]]["guess"])
                (handles["failed"],) = axis.loglog(
                    x, y, "x", color="black", markersize=8, markeredgewidth=1.8, linestyle=""
                )
                if name not in named:
                    place = (3, 8 + 11 * len(named))
                    axis.annotate(name, (x, y), xytext=place, textcoords="offset points", fontsize=8)
                named.add(name)
    axis.loglog(*_front([run for run in runs if run["seed"] == 0]), color="0.8", linewidth=7, zorder=0)
    # Room at the left for the names of the lines.
    left, right = axis.get_xlim()[0] / 3, axis.get_xlim()[1]
    words = {"bound": ("Cramer-Rao bound", "-."), "oracle": ("BRDF known", ":")}
    for key, (text, dashes) in words.items():
        if key in lines[0]:
            axis.axhline(lines[0][key], color="black", linestyle=dashes, linewidth=1.2)
            place = {"bound": "bottom", "oracle": "top"}[key]
            axis.text(left, lines[0][key], f" {text}", ha="left", va=place, fontsize=9, zorder=5)
    axis.set_xlim(left, right)
    lowest = min(lines[0]["oracle"], *(end_error(run) for run in runs if run["trace"]))
    axis.set_ylim(top=20 if len(named) else 1.5, bottom=(0.5 if "bound" in lines[0] else 0.02) * lowest)
    axis.set_title(panel, fontsize=11)
    axis.set_xlabel("seconds, one thread")
    axis.set_ylabel("relative error of V")
    axis.grid(alpha=0.25)
    reference = float(np.median(document["reference_seconds"]))
    upper = axis.secondary_xaxis("top", functions=(lambda s: s / reference, lambda q: q * reference))
    upper.set_xlabel("in units of the reference workload", fontsize=8)
    upper.tick_params(labelsize=8)


def _front(runs: list[dict[str, Any]]) -> tuple[list[float], list[float]]:
    """The records that no other beats in both time and error, as a staircase."""
    records = sorted((t, v) for run in runs for t, v, _ in run["trace"])
    x, y = [], []
    lowest = math.inf
    for t, v in records:
        if v < lowest:
            if y:
                x.append(t)
                y.append(lowest)
            x.append(t)
            y.append(v)
            lowest = v
    return x, y
