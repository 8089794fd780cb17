"""The figures of the performance analysis, drawn from its results; see performance_analysis.py."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from performance_runs import EXACT, FEW, OPTIONS, RECORDED, TEXT, best_order, errors, sweeps
from thesis_algorithm import Scene

from wallmirror import CaptureSet, radiance, solve, wall_points
from wallmirror.derendering.unstructured import de_render_unstructured

INK, FAINT = "#22272e", "#8b949e"
COLOURS = {EXACT: "#1664c0", TEXT: "#c8501e", RECORDED: "#8250b4", FEW: "#2e8b57"}
NAMES = {
    EXACT: "exact solver",
    TEXT: "thesis's algorithm, alpha 0.1",
    RECORDED: "the same, alpha 10",
    FEW: "search for few captures",
}
AXES = {
    "N": ("number of wall points N", "log"),
    "A": ("number of views A", "linear"),
    "B": ("number of patterns B", "linear"),
    "M": ("number of source points M", "linear"),
    "sigma": ("width of the lobes, deg", "linear"),
    "fov": ("view angle, deg", "linear"),
    "alpha": ("alpha (the exact solver has none)", "log"),
    "proportion": ("share of B_diff kept (the exact solver has none)", "linear"),
}
SIDES = {"source": "pattern", "brdf": "BRDF"}
GUESS = {"source": "V = 0.5 everywhere", "brdf": "BRDF = 0"}
#: Mean square errors that the exact solver's panels show at least.
EXACT_RANGE = (1e-27, 1e-15)
Row = dict[str, Any]


def example(figures: Path, repetition: int) -> dict[str, dict[str, float]]:
    """One estimate of each method beside the truth (figures 4.3 and 4.4); returns their errors."""
    scene = Scene()
    observer, card, model = scene.observer(), scene.card(), scene.model()
    rng = np.random.default_rng(repetition)
    truth = rng.random((scene.M, scene.B))
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=radiance(model, truth))
    exact = solve(captures)
    theirs = de_render_unstructured(captures, rng=rng, **OPTIONS[TEXT])
    best = best_order(theirs.source, truth)
    found = {TEXT: (theirs.source[best], theirs.brdf[..., best]), EXACT: (exact.source, exact.transport)}
    numbers = {m: errors(*pair, tuple(range(scene.M)), truth, model) for m, pair in found.items()}

    chart, axes = plt.subplots(3, 1, figsize=(7.5, 5.2), sharex=True, layout="constrained")
    shown = {"truth": truth, **{NAMES[m]: pair[0] for m, pair in found.items()}}
    for axis, (name, source), error in zip(axes, shown.items(), ("", *(n["source_error"] for n in numbers.values()))):
        image = axis.imshow(source, vmin=0, vmax=1, cmap="viridis", aspect="auto")
        axis.set_title(f"{name}{f', relative error {error:.2g}' if error else ''}", fontsize=10, loc="left")
        axis.set_yticks(range(scene.M), [f"{x:+.2f} m" for x in card.elements_x])
    axes[-1].set_xticks(range(0, scene.B, 2), range(1, scene.B + 1, 2))
    axes[-1].set_xlabel("pattern b")
    chart.colorbar(image, ax=axes, label="V")
    save(chart, figures / "performance_source.png")

    chart, axes = plt.subplots(scene.M, 1, figsize=(7.5, 6.4), sharex=True, sharey=True, layout="constrained")
    x = wall_points(observer).ravel()
    along = np.argsort(x, kind="stable")
    for i, axis in enumerate(axes):
        columns = {"truth": model, **{NAMES[m]: pair[1] for m, pair in found.items()}}
        styles = {
            "truth": (INK, "-", 3.5, 0.35),
            NAMES[TEXT]: (COLOURS[TEXT], "-", 1.0, 1.0),
            NAMES[EXACT]: (COLOURS[EXACT], "--", 1.3, 1.0),
        }
        for name, matrix in columns.items():
            colour, line, width, alpha = styles[name]
            axis.plot(
                x[along], matrix[..., i].ravel()[along], line, color=colour, linewidth=width, alpha=alpha, label=name
            )
        axis.set_title(f"source point at {card.elements_x[i]:+.2f} m", fontsize=9, loc="left")
        clean(axis)
    axes[0].legend(fontsize=8, ncols=3, loc="lower right", bbox_to_anchor=(1, 1.0), frameon=False)
    axes[-1].set_xlabel("wall point x, m (all views)")
    chart.supylabel("column of B", fontsize=10)
    save(chart, figures / "performance_brdf.png")
    return numbers


def sweep_figure(sweep: str, values: dict[str, Row], path: Path) -> None:
    """Both mean square errors over one axis: the thesis's algorithm above, the exact solver far below."""
    x = np.array([float(v) for v in values])
    places = sweeps()[sweep]
    chart, axes = plt.subplots(2, 2, figsize=(9.5, 5.6), sharex=True, height_ratios=(1.5, 1), layout="constrained")
    for column, (side, title) in enumerate(SIDES.items()):
        above, below = axes[:, column]
        for method in (TEXT, RECORDED):
            if all(method in row for row in values.values()):
                name = NAMES[method] if sweep != "alpha" else "thesis's algorithm"
                curve(above, x, [row[method] for row in values.values()], f"{side}_mse", COLOURS[method], name)
        if side == "source":
            rows = [row[TEXT] for row in values.values()]
            middle = [r["source_mse_its_order"]["median"] for r in rows]
            label = "in its code's order" if sweep == "alpha" else "alpha 0.1, in its code's order"
            above.plot(x, middle, ":", color=COLOURS[TEXT], linewidth=1.3, label=label)
        guess = [1 / 12 if side == "source" else np.mean(places[v][0].model() ** 2) for v in values]
        above.plot(x, guess, "--", color=FAINT, linewidth=1, label=f"guess: {GUESS[side]}")
        ours = [row[EXACT] for row in values.values()]
        curve(below, x, ours, f"{side}_mse", COLOURS[EXACT], NAMES[EXACT])
        worst = [row.get(f"{side}_mse", {}).get("max", np.nan) for row in ours]
        below.plot(x, worst, ":", color=COLOURS[EXACT], linewidth=1.3, label="its worst run")
        refused = [place for place, row in zip(x, ours) if row["refused"]]
        if refused:
            height = below.get_xaxis_transform()
            cross: dict[str, Any] = {
                "color": INK,
                "markersize": 8,
                "markeredgewidth": 2,
                "label": "closed form refuses",
            }
            below.plot(refused, [0.88] * len(refused), "x", transform=height, **cross)
        searched = [
            (place, row[FEW][f"{side}_mse"])
            for place, row in zip(x, values.values())
            if f"{side}_mse" in row.get(FEW, {})
        ]
        for k, (place, found) in enumerate(searched):
            bars = [[found["median"] - found["q1"]], [found["q3"] - found["median"]]]
            below.errorbar(
                place,
                found["median"],
                yerr=bars,
                fmt="D",
                color=COLOURS[FEW],
                markersize=5,
                label=None if k else NAMES[FEW],
            )
        above.set_title(title, fontsize=11)
        below.set_xlabel(AXES[sweep][0])
        for axis in (above, below):
            axis.set_yscale("log")
            axis.set_xscale(AXES[sweep][1])
            axis.grid(alpha=0.25)
            clean(axis)
            axis.legend(fontsize=7.5, framealpha=0.85)
        # One scale for all sweeps, so that rounding's wiggles look like what they are.
        low, high = below.get_ylim()
        below.set_ylim(min(low, EXACT_RANGE[0]), max(high, EXACT_RANGE[1]))
    axes[0, 0].set_ylabel("mean square error")
    axes[1, 0].set_ylabel("mean square error")
    chart.suptitle("Median and quartiles over the repetitions; mind the gap between the scales", fontsize=10, color=INK)
    save(chart, path)


def curve(axis: Any, x: Any, rows: list[Row], measure: str, colour: str, name: str) -> None:
    """Median and quartiles where the method gave a result."""
    solved = np.array([measure in r for r in rows])
    middle, low, high = (np.array([r[measure][k] for r in rows if measure in r]) for k in ("median", "q1", "q3"))
    axis.plot(x[solved], middle, "o-", color=colour, markersize=4, linewidth=1.5, label=name)
    axis.fill_between(x[solved], low, high, color=colour, alpha=0.2, linewidth=0)


def crossed_figure(values: dict[str, Row], path: Path) -> None:
    """Mean square errors over A and B, both methods; a cross where the solver refuses."""
    views, patterns = (sorted({int(v.split(" x ")[k]) for v in values}) for k in (0, 1))
    chart, axes = plt.subplots(2, 2, figsize=(9.5, 8), layout="constrained")
    for line, method in zip(axes, (TEXT, EXACT)):
        for axis, (side, name) in zip(line, SIDES.items()):
            table = np.full((len(patterns), len(views)), np.nan)
            for k, b in enumerate(patterns):
                for j, a in enumerate(views):
                    row = values[f"{a} x {b}"]
                    found = row[method].get(f"{side}_mse")
                    if found is None:
                        axis.plot(j, k, "x", color=INK, markersize=9, markeredgewidth=2)
                        found = row.get(FEW, {}).get(f"{side}_mse", {"median": math.nan})
                    table[k, j] = math.log10(found["median"])
            limits = dict(zip(("vmin", "vmax"), np.log10(EXACT_RANGE))) if method == EXACT else {}
            image = axis.imshow(table, origin="lower", cmap="viridis", aspect="auto", **limits)
            axis.set_xticks(range(len(views)), views)
            axis.set_yticks(range(len(patterns)), patterns)
            axis.set(xlabel="number of views A", ylabel="number of patterns B")
            axis.set_title(f"{name}, {NAMES[method]}", fontsize=10)
            chart.colorbar(image, ax=axis, label="log10 of the median mean square error")
    chart.suptitle("Crosses: the closed form refuses B < M; the colour there is the search's", fontsize=10)
    save(chart, path)


def clean(axis: Any) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8.5)


def save(chart: Any, path: Path) -> None:
    chart.savefig(path, dpi=100)
    plt.close(chart)
