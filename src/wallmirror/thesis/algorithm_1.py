"""Section 2.2.3: what the reference rendering algorithm makes of two source points (Figs. 2.10 and 2.12)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from wallmirror.brdf import GaussianTrain, Mirror
from wallmirror.geometry import Card, Observer, wall_points
from wallmirror.report.style import OURS, clean, new_figure
from wallmirror.thesis.figure import ThesisFigure
from wallmirror.transport import radiance, transport_matrix

_PIXELS = 500
_WIDTH = 10.0  # of the source in chapter 3, metres
_SOURCE = (0.5, 1.0)


def _setting(y_s: float = -5.0) -> tuple[Observer, Card]:
    observer = Observer(
        position=(0.0, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=_PIXELS, pixels_at="edges"
    )
    return observer, Card(elements_x=(-_WIDTH / 4, _WIDTH / 4), y=y_s)


def mirror_render(seed: int) -> ThesisFigure:
    """Fig. 2.10: the mirror shows the projection of the source on the wall."""
    observer, card = _setting()
    brdf = Mirror()
    render = radiance(transport_matrix(observer, card, brdf, weights="thesis"), np.array(_SOURCE)[:, None])[0, :, 0]
    x = wall_points(observer)[0]
    figure = new_figure(10.5, 2.8)
    source_axes, render_axes = figure.subplots(1, 2)
    source_axes.stem(card.elements_x, _SOURCE, basefmt=" ")
    render_axes.plot(x, render, color=OURS)
    for axes in (source_axes, render_axes):
        axes.set_xlabel("x (m)")
        clean(axes)
    return ThesisFigure(
        id="2.10",
        title="Algorithm 1 and a mirror",
        about="To be replaced by the section's own module.",
        figure=figure,
        columns={"x (m)": x, "radiance": render},
        numbers={"elements in the mirror": float(np.count_nonzero(render))},
    )


def lobes_render(seed: int) -> ThesisFigure:
    """Fig. 2.12: the test BRDF copies the source four times."""
    observer, card = _setting()
    x = wall_points(observer)[0]
    figure = new_figure(10.5, 2.8)
    axes = figure.subplots()
    columns = {"x (m)": x}
    for name, brdf in (("text", GaussianTrain.of_the_text()), ("code", GaussianTrain.of_the_code())):
        matrix = transport_matrix(observer, card, brdf, weights="thesis")
        columns[name] = radiance(matrix, np.array(_SOURCE)[:, None])[0, :, 0]
        axes.plot(x, columns[name], label=name)
    clean(axes)
    return ThesisFigure(
        id="2.12",
        title="Algorithm 1 and the test BRDF",
        about="To be replaced by the section's own module.",
        figure=figure,
        columns=columns,
        numbers={"largest radiance": float(columns["code"].max())},
    )


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"2.10": mirror_render, "2.12": lobes_render}
