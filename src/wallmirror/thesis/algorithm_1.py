"""Section 2.2.3: what the reference rendering algorithm makes of two source points (Figs. 2.10 and 2.12)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.convolution import mirror_points, mirror_render
from wallmirror.convolution.as_published import MIRROR_BOX, box_mirror_render
from wallmirror.geometry import wall_points
from wallmirror.report.style import CYCLE, FAINT, INK, OURS, WARM, clean, new_figure
from wallmirror.thesis import setting
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

_PIXELS = 500
_COUNTS = np.arange(100, 1001)  # pixels of a view, to see how often the box falls between two


def mirror_trap(seed: int) -> ThesisFigure:
    """Fig. 2.10: the mirror shows the projection of the source on the wall, if it is a delta and not a narrow box."""
    observer, card = setting.observer(_PIXELS), setting.card()
    x = wall_points(observer)[0]
    exact = mirror_render(observer, card, setting.SOURCE)[0]
    box = box_mirror_render(observer, card, setting.SOURCE)[0]
    shown = np.array([_elements_in_box(int(count)) for count in _COUNTS])

    figure = new_figure(10.5, 3.2)
    source_axes, brdf_axes, render_axes, trap_axes = figure.subplots(1, 4, width_ratios=(1, 0.8, 1.2, 1.2))
    _stems(source_axes, np.array(card.elements_x), setting.SOURCE, INK)
    source_axes.set_title("source", fontsize=10)
    source_axes.set_xlim(-7, 7)
    _stems(brdf_axes, np.zeros(1), np.ones(1), INK)
    brdf_axes.set_title("mirror: δ(θs + θo)", fontsize=10)
    brdf_axes.set_xlim(-45, 45)
    lit = exact > 0
    _stems(render_axes, x[lit], exact[lit], OURS)
    render_axes.set_title(f"render, {_PIXELS} wall points", fontsize=10)
    render_axes.set_xlim(-5, 5)
    for axes in (source_axes, brdf_axes, render_axes):
        axes.set_ylim(0, 1.12)
    source_axes.set_ylabel("radiance")
    share = [float(np.mean(shown == count)) for count in range(3)]
    trap_axes.bar(range(3), [100 * s for s in share], color=[WARM, WARM, OURS], width=0.6)
    trap_axes.set_xticks(range(3), ["none", "one", "both"])
    trap_axes.set_title("shown by a box 0.1° wide", fontsize=10)
    trap_axes.set_ylabel(f"% of N = {_COUNTS[0]} … {_COUNTS[-1]}")
    trap_axes.set_xlabel("elements")
    for axes, label in ((source_axes, "x (m)"), (brdf_axes, "θs + θo (°)"), (render_axes, "x (m)")):
        axes.set_xlabel(label)
    for axes in figure.axes:
        clean(axes)

    mirrored = mirror_points(observer, card, card.elements_x)
    off = float(np.max(np.abs(np.sort(x[lit]) - np.sort(mirrored)))) if lit.sum() == mirrored.size else math.inf
    pitch = float(x[1] - x[0])
    in_box = int(np.count_nonzero(box))
    return ThesisFigure(
        id="2.10",
        title="Algorithm 1 and a mirror",
        about=f"Two points of radiance 0.5 and 1, 10 m apart, and the observer, both 5 m from the wall, {_PIXELS} wall "
        "points. The mirror is a delta: each element lights the one pixel that its image falls into. The published code "
        "samples a box of the angle sum 0.1° wide instead; the last panel counts what such a box shows for every number "
        "of wall points.",
        figure=figure,
        columns={
            "x (m)": x,
            "mirror": exact,
            "box 0.1 deg": box,
            "wall points N": _COUNTS,
            "elements in the box": shown,
        },
        numbers={
            "elements in the mirror": float(lit.sum()),
            f"elements in the box at N = {_PIXELS}": float(in_box),
            "N of 100 to 1000 at which the box shows both (%)": 100 * share[2],
            "image off its exact place (m)": off,
            "pitch of the wall points (m)": pitch,
        },
        claims=(
            Claim(
                thesis="The render of a mirror is the projection of the source on the wall.",
                outcome="confirmed" if off <= pitch / 2 else "refuted",
                measured=f"Both images stand within {off:.2g} m of their exact places, with wall points {pitch:.2g} m apart.",
            ),
            Claim(
                thesis=f"The figure has {_PIXELS} wall points (and the code a mirror 0.1° wide).",
                outcome="confirmed" if in_box == card.elements else "corrected",
                measured=f"At {_PIXELS} wall points such a box shows {in_box} of {card.elements} elements: neighbouring "
                f"points are {math.degrees(_turn()):.2g}° of angle sum apart, more than the box is wide. A mirror has to "
                "be a delta, whose image falls into exactly one pixel.",
            ),
        ),
    )


def _elements_in_box(pixels: int) -> int:
    return int(
        np.count_nonzero(box_mirror_render(setting.observer(pixels), setting.card(), setting.SOURCE, width=MIRROR_BOX))
    )


def _turn() -> float:
    """By how much the angle sum turns from one wall point to the next at a mirror image, in radians."""
    observer, card = setting.observer(_PIXELS), setting.card()
    x = wall_points(observer)[0]
    at = mirror_points(observer, card, card.elements_x[1])
    theta = math.atan(float(at) / observer.distance)
    return float(x[1] - x[0]) * math.cos(theta) ** 2 * (1 / observer.distance + 1 / card.distance)


def lobes_render(seed: int) -> ThesisFigure:
    """Fig. 2.12: the test BRDF copies the source four times."""
    observer, card = setting.observer(_PIXELS), setting.card()
    x = wall_points(observer)[0]
    u = np.linspace(-45, 45, 901)
    figure = new_figure(10.5, 4.6)
    panels = figure.subplots(2, 2, width_ratios=(1, 2.4), sharex="col")
    columns: dict[str, Array] = {"x (m)": x}
    counts = {}
    for (brdf_axes, render_axes), name, colour in zip(panels, ("text", "code"), CYCLE, strict=False):
        brdf = setting.lobes(*setting.LOBES[name])
        render = _render(brdf)
        columns[f"radiance, lobes of the {name}"] = render
        counts[name] = setting.peaks(x, render).size
        brdf_axes.plot(u, brdf.of_sum(np.radians(u)), color=INK, linewidth=1)
        render_axes.plot(x, render, color=colour, linewidth=1.3)
        for element in mirror_points(observer, card, card.elements_x):
            render_axes.axvline(element, color=FAINT, linewidth=0.8, linestyle=":")
        inner, outer = sorted({abs(c) for c in setting.LOBES[name]})
        render_axes.set_title(f"render, lobes at ±{inner:g}° and ±{outer:g}° (the {name})", fontsize=10, loc="left")
        render_axes.set_ylim(0, 1.12 * render.max())
        render_axes.set_ylabel("radiance")
        brdf_axes.set_ylabel("ρ / peak")
        clean(brdf_axes)
        clean(render_axes)
    panels[0, 0].set_title("test BRDF", fontsize=10, loc="left")
    panels[1, 0].set_xlabel("θs + θo (°)")
    panels[1, 1].set_xlabel("x (m); dotted: where a mirror shows the elements")
    panels[1, 1].set_xlim(-5, 5)
    seen = (*card.elements_x, card.middle)
    shifts = np.array([[_offset(element, centre) for element in seen] for centre in setting.LOBES["text"]])
    spread = float(np.max(np.ptp(shifts[:, :-1], axis=1)))
    middle = float(np.max(np.ptp(shifts, axis=1)))
    return ThesisFigure(
        id="2.12",
        title="Algorithm 1 and the test BRDF",
        about="The same scene as Fig. 2.10 and a BRDF of four Gaussian lobes of the angle sum, 1° wide and of peak 1. The "
        "text has them at ±15° and ±30° and calls them normalised; the code of chapter 4 has ±15° and ±35° and divides "
        "them by their peak.",
        figure=figure,
        columns=columns,
        numbers={
            "copies, lobes of the text": float(counts["text"]),
            "copies, lobes of the code": float(counts["code"]),
            "a lobe's offset from the mirror image, between the two elements (m)": spread,
            "the same with an element halfway between (m)": middle,
        },
        claims=(
            Claim(
                thesis="The test BRDF copies and blurs the source four times.",
                outcome="confirmed" if set(counts.values()) == {4 * card.elements} else "corrected",
                measured=f"The render has {counts['text']} lobes (text) and {counts['code']} (code) within the view for "
                f"{card.elements} elements.",
            ),
            Claim(
                thesis="The BRDF is copied around the two deltas in a way reminiscent of convolution.",
                outcome="confirmed" if spread < 0.05 else "corrected",
                measured=f"Between these two elements, which are symmetric, a lobe's offset from the mirror image differs by "
                f"{spread:.2g} m. Along the wall that is no rule: for an element halfway between them it would by "
                f"{middle:.2f} m.",
            ),
        ),
    )


def _render(brdf: GaussianTrain) -> Array:
    matrix = transport_matrix(setting.observer(_PIXELS), setting.card(), brdf, weights="thesis")
    return np.asarray(radiance(matrix, setting.SOURCE)[0], dtype=np.float64)


def _offset(element: float, centre_deg: float) -> float:
    """From the mirror image of an element to where the angle sum is `centre_deg`, along the wall in metres.

    With both at distance d, tan(theta_s + theta_o) = u is a quadratic in x: (a + b) / (1 - a b) = tan u with
    a = -x / d and b = (element - x) / d.
    """
    d = setting.observer().distance
    t = math.tan(math.radians(centre_deg))
    # (element - 2 x) d = t (d^2 + x (element - x))
    roots = np.roots([t, -(2 * d + t * element), element * d - t * d * d])
    mirror = element / 2
    return float(min((r.real for r in np.atleast_1d(roots)), key=lambda r: abs(r - mirror))) - mirror


def _stems(axes: Axes, x: Array, heights: Array, colour: str) -> None:
    axes.vlines(x, 0, heights, color=colour, linewidth=1.2)
    axes.plot(x, heights, "o", color=colour, markersize=4)


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"2.10": mirror_trap, "2.12": lobes_render}
