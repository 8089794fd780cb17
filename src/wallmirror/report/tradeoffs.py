"""Figures of work-precision runs: error over seconds with the front that nothing beats, and cost over size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from wallmirror.report.style import FAINT, INK, OURS, PALE, WARM, clean, new_figure
from wallmirror.tradeoff.growth import TRACER
from wallmirror.tradeoff.pareto import fit_line, pareto_front, short_seconds
from wallmirror.tradeoff.runs import Panel, Run, by_method
from wallmirror.tradeoff.split_runs import DRAWN, FORETOLD, RENDERED

#: Colours and marks of up to sixteen lines, told apart without colour as well.
_LOOKS = tuple(
    (colour, mark)
    for mark, colours in (
        ("o", (OURS, WARM, "#2e8b57", "#8250b4")),
        ("s", ("#0a8a9f", "#b5179e", "#7a6a00", "#5b6572")),
        ("^", ("#74a9e8", "#e5966f", "#8cc6a3", "#bda4d9")),
        ("D", ("#22272e", "#a40e26", "#116329", "#9a6700")),
    )
    for colour in colours
)
_LOWEST = 1e-16  # errors below float64's own are drawn there


def work_precision(runs: Sequence[Run], *, title: str, over_bound: bool = False) -> Figure:
    """Error over processor seconds, a line a method; grey: the front of all runs; crosses at the top: failures.

    Parameters
    ----------
    over_bound:
        Draw errors in units of each run's own Cramér-Rao bound.
    """
    if over_bound:
        runs = [replace(run, error=run.error / run.extra["bound"]) for run in runs]
    lines = by_method(runs)
    figure = new_figure(10.5, 4.2 if len(lines) < 7 else 5.8)
    axes = figure.add_subplot()
    front = pareto_front(runs)
    good = [max(run.error, _LOWEST) for run in runs if not run.failure]
    top = 4 * max(good, default=1.0)
    if front:
        x = [run.seconds for run in front]
        y = [max(run.error, _LOWEST) for run in front]
        axes.step(
            x, y, where="post", color=PALE, linewidth=7, zorder=1, solid_capstyle="round", label="no run beats this"
        )
    for (method, line), (colour, mark) in zip(lines.items(), _LOOKS * (1 + len(lines) // len(_LOOKS)), strict=False):
        stands = sorted((run for run in line if not run.failure), key=lambda r: r.seconds)
        x = [run.seconds for run in stands]
        y = [max(run.error, _LOWEST) for run in stands]
        # A cloud over two knobs is no line: only what the method itself does not beat is joined.
        own = pareto_front(line)
        joined = own if len(own) > 1 else ()
        axes.plot(
            [r.seconds for r in joined], [max(r.error, _LOWEST) for r in joined], color=colour, linewidth=1.2, zorder=2
        )
        label = method
        axes.scatter(x, y, s=26, marker=mark, color=colour, zorder=3, label=label, linewidths=0)
        fallen = [run for run in line if run.failure and math.isfinite(run.seconds)]
        axes.scatter([run.seconds for run in fallen], [top] * len(fallen), s=40, marker="x", color=colour, zorder=4)
    if over_bound:
        axes.axhline(1.0, color=INK, linewidth=0.9, linestyle=(0, (5, 3)), label="Cramér-Rao bound")
    _log_axes(axes)
    axes.set_xlabel("processor seconds")
    axes.set_ylabel("error / bound of its captures" if over_bound else "relative error")
    axes.set_title(title, fontsize=11, color=INK, loc="left")
    figure.legend(frameon=False, fontsize=8.5, loc="outside right upper")
    clean(axes)
    return figure


def panel_figures(panel: Panel) -> list[tuple[Figure, str]]:
    """A figure for each group of a panel, with its caption."""
    if panel.name == "scaling":
        return scaling_figures(panel)
    if panel.name == "budget":
        return [
            (budget_figure(panel), "Lines: foretold by the bound. Marks: measured, of the same colour as their line.")
        ]
    figures = []
    for group in panel.groups:
        runs = panel.of_group(group)
        failed = sum(1 for run in runs if run.failure)
        caption = f"{group[0].upper() + group[1:]}: {len(runs)} runs"
        caption += f", {failed} of which failed (crosses at the top)" if failed else ", none failed"
        caption += ". Each line joins the runs of a method that the method itself does not beat; dots are all its runs."
        figures.append((work_precision(runs, title=group, over_bound=group in panel.floors), caption))
    return figures


def budget_figure(panel: Panel) -> Figure:
    """Error over the number of realisations, a line a number of views, a field a budget; measured errors as marks."""
    groups = panel.groups
    columns = min(2, len(groups))
    rows = math.ceil(len(groups) / columns)
    figure = new_figure(10.5, 3.4 * rows + 0.5)
    fields = figure.subplots(rows, columns, squeeze=False).ravel()
    views = sorted({run.knobs["views"] for run in panel.runs})
    for axes, group in zip(fields, groups, strict=False):
        runs = panel.of_group(group)
        for a, (colour, _) in zip(views, _LOOKS, strict=False):
            mine = [run for run in runs if run.knobs["views"] == a and not run.failure]
            line = sorted((run for run in mine if run.method == FORETOLD), key=lambda r: r.knobs["realisations"])
            axes.plot(
                [run.knobs["realisations"] for run in line], [run.error for run in line], color=colour, linewidth=1.3,
                marker=".", markersize=4, label=f"{a} views" if axes is fields[0] else None,
            )  # fmt: skip
            for method, shape, size in ((DRAWN, "x", 26), (RENDERED, "D", 34)):
                dots = [run for run in mine if run.method == method]
                axes.scatter(
                    [run.knobs["realisations"] for run in dots], [run.error for run in dots], marker=shape, s=size,
                    color=colour, zorder=4, linewidths=1.1, facecolor=None if shape == "x" else "white", edgecolor=None
                    if shape == "x" else colour,
                )  # fmt: skip
        refused = [run for run in runs if run.failure]
        axes.scatter(
            [run.knobs["realisations"] for run in refused], [1.0] * len(refused), marker="X", s=44, color=INK, clip_on=False,
            transform=axes.get_xaxis_transform(), zorder=5,
        )  # fmt: skip
        _log_axes(axes, seconds=False)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 4)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{100 * v:g} %"))
        axes.set_xlabel("realisations B")
        axes.set_ylabel("error of the patterns")
        axes.set_title(group, fontsize=10.5, color=INK, loc="left")
        clean(axes)
    for axes in fields[len(groups) :]:
        axes.set_axis_off()
    fields[0].scatter([], [], marker="x", color=INK, s=26, label=DRAWN)
    fields[0].scatter([], [], marker="D", facecolor="white", edgecolor=INK, s=34, label=RENDERED)
    fields[0].scatter([], [], marker="X", color=INK, s=44, label="refused, or not affordable")
    figure.legend(frameon=False, fontsize=8.5, loc="outside right upper")
    return figure


def scaling_figures(panel: Panel) -> list[tuple[Figure, str]]:
    """Seconds and peak memory over the size of each kind of work, with the exponents fitted."""
    figures = []
    for group in panel.groups:
        runs = [run for run in panel.of_group(group) if not run.failure]
        figure = new_figure(10.5, 3.9)
        time_axes, memory_axes = figure.subplots(1, 2)
        for (method, line), (colour, mark) in zip(by_method(runs).items(), _LOOKS, strict=False):
            x = np.array([run.work for run in line])
            for axes, y in (
                (time_axes, np.array([run.seconds for run in line])),
                (memory_axes, np.array([run.extra["bytes"] / 1e9 for run in line])),
            ):
                tail = x >= np.sort(x)[-min(x.size, 4)]
                known = tail & (y > 0)
                label = method
                if np.count_nonzero(known) >= 3:
                    label += f": size^{fit_line(x[known], y[known]).slope:.2f}"
                axes.plot(x, y, color=colour, marker=mark, markersize=4.5, linewidth=1.2, label=label)
        for axes, name in ((time_axes, "processor seconds"), (memory_axes, "memory taken (GB)")):
            _log_axes(axes, seconds=name.startswith("processor"))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g} x"))
            axes.set_xlabel("pixels, in those of 64 x 64" if group == TRACER else "size, in that of the thesis")
            axes.set_ylabel(name)
            axes.legend(frameon=False, fontsize=8.5)
            clean(axes)
        figure.suptitle(group, fontsize=11, color=INK, x=0.01, ha="left")
        figures.append(
            (figure, f"{group}: one knob at a time, each run in a process of its own; slopes of the last four sizes.")
        )
    return figures


def _log_axes(axes: Axes, *, seconds: bool = True) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(True, which="major", color=PALE, linewidth=0.5)
    axes.tick_params(which="minor", length=2, color=FAINT)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    low, high = axes.get_xlim()
    if math.log10(high / low) < 9:
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 100 else (1,), numticks=12))
    if seconds:
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: short_seconds(v)))
