"""The figures of a report, each drawn from the numbers of the run that it shows."""

from __future__ import annotations

import base64
import io
import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from wallmirror.comparison import Comparison
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.tables import SplineTable
from wallmirror.geometry import Card, Observer
from wallmirror.report.style import FAINT, INK, OURS, PALE, TRUTH, WARM, clean, new_figure
from wallmirror.scene import Room

Array = NDArray[np.float64]


def embed(figure: Figure) -> str:
    """The figure as the source of an <img>: SVG in base64, nothing to fetch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None}, dpi=150)
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def scene_plan(observer: Observer, card: Card, *, half_width: float, room: Room | None = None) -> Figure:
    """The scene from above, to scale: wall, card, observer and the field of view of every view."""
    x_o, y_o = observer.position
    half = observer.fov / 2
    shown = sorted({0, observer.views // 2, observer.views - 1})
    corners = [[x_o + y_o * math.tan(angle + side * half) for side in (1, -1)] for angle in observer.view_angles]
    reach = float(np.max(np.abs(corners)))
    depth = max(room.depth if room else 0.0, -y_o, -card.y)
    figure = new_figure(7.2, min(6.5, 1.1 + 6.0 * (1.2 * depth) / (2.4 * reach)))
    axes = figure.add_subplot()
    axes.add_patch(
        Polygon([(x_o, y_o), (np.min(corners), 0), (np.max(corners), 0)], color=OURS, alpha=0.10, linewidth=0)
    )
    for number in shown:
        ends = corners[number]
        axes.add_patch(Polygon([(x_o, y_o), (ends[0], 0), (ends[1], 0)], color=OURS, alpha=0.13, linewidth=0))
        axes.plot([ends[0], x_o, ends[1]], [0, y_o, 0], color=OURS, linewidth=0.6, alpha=0.6)
    span = max(reach, max(abs(x) for x in card.elements_x), room.half_width if room else 0.0)
    width = min(half_width, 1.12 * span)
    axes.add_patch(Rectangle((-width, 0), 2 * width, 0.025 * span, color=INK))
    if room is not None:
        outline = (
            [(-room.half_width, 0), (-room.half_width, -room.depth)],
            [
                (room.half_width, 0),
                (room.half_width, -room.depth),
            ],
        )
        for side in outline:
            axes.plot(*zip(*side, strict=True), color=INK, linewidth=2)
        axes.annotate(
            f"room, albedo {room.albedo:g}", (-room.half_width, -0.92 * room.depth), (6, 0),
            textcoords="offset points", fontsize=9, color=INK,
        )  # fmt: skip
    if card.board_width:
        half = card.board_width / 2
        axes.plot([card.middle - half, card.middle + half], [card.y] * 2, color=FAINT, linewidth=3)
    axes.scatter(card.elements_x, [card.y] * card.elements, color=WARM, s=28, zorder=3)
    axes.scatter([x_o], [y_o], color=OURS, s=60, marker="^", zorder=3)
    label: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9, "color": INK}
    axes.annotate("wall", (0, 0.025 * span), (0, 4), ha="center", **label)
    axes.annotate(f"hidden card, {card.elements} elements", (max(card.elements_x), card.y), (9, -3), ha="left", **label)
    axes.annotate(
        f"camera, {observer.views} view{'s' * (observer.views > 1)} of {math.degrees(observer.fov):.0f}°",
        (x_o, y_o),
        (10, -4),
        ha="left",
        **label,
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    lowest = -room.depth if room else min(y_o, card.y)
    axes.set_ylim(lowest - 0.08 * span, 0.13 * span)
    clean(axes)
    return figure


def photograph(image: Array, *, caption: str = "") -> Figure:
    """A 2-D render with the tone curve of a display (sRGB); the brightest half per cent is clipped."""
    height, width = image.shape[:2]
    figure = new_figure(7.2, 7.2 * height / width)
    _show(figure.add_subplot(), image, float(np.quantile(image, 0.995)), caption)
    return figure


def one_tone(images: tuple[Array, ...], captions: tuple[str, ...]) -> Figure:
    """Renders of one size side by side, in one tone scale set by the last, so that they can be compared by eye."""
    height, width = images[0].shape[:2]
    figure = new_figure(10.5, 10.5 / len(images) * height / width + 0.3)
    white = float(np.quantile(images[-1], 0.98))
    for axes, image, caption in zip(figure.subplots(1, len(images)), images, captions, strict=True):
        _show(axes, image, white, caption)
    return figure


def pictures(images: tuple[Array, ...], captions: tuple[str, ...]) -> Figure:
    """Renders side by side, grey (height, width) or in colour (height, width, 3), white at 1."""
    height, width = images[0].shape[:2]
    figure = new_figure(5.2 * len(images), 5.2 * height / width + 0.3)
    for axes, image, caption in zip(figure.subplots(1, len(images), squeeze=False)[0], images, captions, strict=True):
        _show(axes, image, 1.0, caption)
    return figure


def _show(axes: Axes, image: Array, white: float, caption: str) -> None:
    tone = np.clip(image / (white or 1.0), 0, 1)
    tone = np.where(tone <= 0.0031308, 12.92 * tone, 1.055 * np.power(tone, 1 / 2.4) - 0.055)
    axes.imshow(tone, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_axis_off()
    if caption:
        axes.set_title(caption, fontsize=10, color=INK)


def radiance_maps(reference: Array, mean: Array, comparison: Comparison, *, unit: str = "") -> Figure:
    """Analytic picture, path-traced picture and their difference in standard errors, views over pixels."""
    figure = new_figure(10.5, 3.1)
    panels = figure.subplots(1, 3, sharey=True)
    top = float(np.quantile(reference, 0.999)) or 1.0
    extent = (0.5, reference.shape[1] + 0.5, reference.shape[0] + 0.5, 0.5)
    for axes, picture, title in zip(panels[:2], (reference, mean), ("analytic", "Mitsuba 3"), strict=True):
        shown = axes.imshow(picture, aspect="auto", cmap="inferno", vmin=0, vmax=top, extent=extent,
                            interpolation="nearest")  # fmt: skip
        axes.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=panels[:2], label=f"radiance{unit}", pad=0.01)
    left_out = panels[2]
    left_out.set_facecolor(PALE)
    z = left_out.imshow(comparison.z, aspect="auto", cmap="RdBu_r", vmin=-4, vmax=4, extent=extent,
                        interpolation="nearest")  # fmt: skip
    left_out.set_title("difference (grey: left out)", fontsize=10)
    figure.colorbar(z, ax=left_out, label="standard errors", pad=0.02)
    panels[0].set_ylabel("view")
    panels[0].yaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in panels:
        axes.set_xlabel("pixel")
        axes.tick_params(labelsize=9)
    return figure


def score_histogram(comparison: Comparison) -> Figure:
    """Histogram of the z scores over the normal density that noise alone would give."""
    figure = new_figure(4.6, 2.9)
    axes = figure.add_subplot()
    z = comparison.z[np.isfinite(comparison.z)]
    edges = np.linspace(-5, 5, 51)
    axes.hist(np.clip(z, -5, 5), bins=edges.tolist(), density=True, color=OURS, alpha=0.6, label="pixels")
    x = np.linspace(-5, 5, 201)
    axes.plot(x, np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi), color=INK, label="noise alone")
    axes.set_xlabel("difference (standard errors)")
    axes.set_yticks([])
    axes.legend(frameon=False, fontsize=9)
    clean(axes)
    return figure


def recovered_source(source: Array, std: Array, truth: Array | None = None) -> Figure:
    """The pattern V (M, B) of each realisation with its error bars, beside the truth where it is known."""
    elements, realisations = source.shape
    shown = min(realisations, 8)
    columns = min(shown, 4)
    rows = math.ceil(shown / columns)
    figure = new_figure(10.5, 2.3 * rows + 0.3)
    panels = np.atleast_1d(figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False)).ravel()
    scale = 1.0
    if truth is not None:
        scale = float(np.sum(source * truth) / np.sum(source**2))
    top = scale * float(np.max(source)) if truth is None else float(np.max(truth))
    place = np.arange(1, elements + 1)
    for b, axes in enumerate(panels):
        if b >= shown:
            axes.set_axis_off()
            continue
        if truth is not None:
            axes.bar(place, truth[:, b] / top, width=0.72, color=PALE, label="true")
        axes.errorbar(
            place, scale * source[:, b] / top, yerr=2 * scale * std[:, b] / top,
            fmt="o", color=OURS, markersize=5, capsize=4, label="recovered (±2 σ)",
        )  # fmt: skip
        axes.set_title(f"pattern {b + 1}", fontsize=10)
        axes.set_xticks(place if elements <= 12 else place[:: elements // 8])
        clean(axes)
    panels[0].set_ylim(0, 1.18)
    panels[0].set_ylabel("radiance / brightest")
    panels[0].legend(frameon=False, fontsize=8, loc="upper right")
    figure.supxlabel("element of the card", fontsize=10)
    return figure


def source_deviations(solution: Solution, truth: Array) -> Figure:
    """Recovered minus true radiance of every element and realisation, in per cent of the brightest, with error bars."""
    scale = float(np.sum(solution.source * truth) / np.sum(solution.source**2))
    top = float(np.max(truth)) / 100
    deviation = (scale * solution.source - truth).T.ravel() / top
    bars = 2 * scale * solution.shape_std.T.ravel() / top
    figure = new_figure(10.5, 2.2)
    axes = figure.add_subplot()
    axes.axhline(0, color=INK, linewidth=0.8)
    place = np.arange(deviation.size)
    axes.errorbar(place, deviation, yerr=bars, fmt="o", color=OURS, markersize=4, capsize=3)
    elements = truth.shape[0]
    for b in range(1, truth.shape[1]):
        axes.axvline(b * elements - 0.5, color=PALE, linewidth=0.8)
    axes.set_xticks(
        (np.arange(truth.shape[1]) + 0.5) * elements - 0.5, [f"pattern {b + 1}" for b in range(truth.shape[1])]
    )
    axes.set_ylabel("off by (% of brightest)")
    clean(axes)
    return figure


def recovered_brdf(solution: Solution, truth: Array | None = None) -> Figure:
    """The BRDF over the angle sum with its 2-sigma band; `truth` is on the solution's own nodes."""
    figure = new_figure(10.5, 3.2)
    axes = figure.add_subplot()
    u = np.degrees(solution.angle_sum)
    seen = np.isfinite(solution.brdf_std) & (solution.brdf_std < 0.5)
    rho = np.where(seen, solution.brdf, np.nan)
    band = np.where(seen, 2 * solution.brdf_std, np.nan)
    axes.fill_between(u, rho - band, rho + band, color=OURS, alpha=0.25, linewidth=0, label="±2 σ")
    if truth is not None:
        power = float(np.sum(np.where(seen, truth, 0.0) ** 2))
        scale = float(np.nansum(rho * truth)) / power if power else 1.0
        axes.plot(u, scale * truth, color=TRUTH, linewidth=3.2, alpha=0.25, label="true")
    axes.plot(u, rho, color=OURS, linewidth=1.2, label="recovered")
    shown = u[seen] if np.count_nonzero(seen) > 1 else u
    axes.set_xlim(float(shown.min()), float(shown.max()))
    axes.set_ylim(-0.06, 1.12)
    axes.set_xlabel("angle sum θs + θo (degrees); 0 is the mirror direction")
    axes.set_ylabel("BRDF / peak")
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="upper right")
    clean(axes)
    return figure


def recovered_table(table: SplineTable) -> Figure:
    """The BRDF over both angles, blank where the captures do not decide it."""
    grid = table.grid
    nodes = [np.linspace(g.start, g.stop, n) for g, n in zip((grid.theta_s, grid.theta_o), table.determined.shape)]
    values = np.where(table.determined, table(nodes[0][:, None], nodes[1][None, :]), np.nan)
    figure = new_figure(7.2, 5.2)
    axes = figure.add_subplot()
    (bottom, top), (left, right) = (np.degrees(axis[[0, -1]]).tolist() for axis in nodes)
    image = axes.imshow(
        values, origin="lower", extent=(left, right, bottom, top), cmap="viridis", vmin=0.0, vmax=1.0, aspect="auto"
    )
    axes.plot([left, right], [-left, -right], color=INK, linewidth=0.8, linestyle=":", label="mirror direction")
    seen = np.argwhere(table.determined)
    if seen.size:
        for axis, limit in ((1, axes.set_xlim), (0, axes.set_ylim)):
            low, high = nodes[axis][seen[:, axis].min()], nodes[axis][seen[:, axis].max()]
            limit(float(np.degrees(low)), float(np.degrees(high)))
    axes.set_xlabel("outgoing angle θo (degrees)")
    axes.set_ylabel("incident angle θs (degrees)")
    axes.legend(fontsize=9, loc="upper right", framealpha=0.9)
    figure.colorbar(image, label="BRDF / peak")
    clean(axes)
    return figure


def error_bars(rows: list[tuple[str, float, float]]) -> Figure:
    """Measured error beside predicted error of the pattern for several solutions, on a log axis."""
    figure = new_figure(7.2, 0.55 * len(rows) + 1.4)
    axes = figure.add_subplot()
    place = np.arange(len(rows))[::-1]
    axes.barh(place + 0.18, [100 * r[1] for r in rows], height=0.34, color=OURS, label="measured")
    axes.barh(place - 0.18, [100 * r[2] for r in rows], height=0.34, color="#afb8c1", label="its own error bars say")
    axes.set_yticks(place, [r[0] for r in rows], fontsize=9)
    axes.set_xscale("log")
    values = [100 * v for r in rows for v in r[1:] if v > 0]
    axes.set_xlim(0.5 * min(values), 2 * max(values))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("error of the pattern (%)")
    figure.legend(frameon=False, fontsize=9, loc="outside upper right", ncols=2)
    clean(axes)
    return figure
