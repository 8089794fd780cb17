"""How every figure of the project looks: one size of letters, few colours, no frame."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK = "#22272e"
FAINT = "#8b949e"
PALE = "#d0d7de"
TRUTH = INK
OURS = "#1664c0"
WARM = "#c8501e"
#: Colours of several curves, in this order.
CYCLE = (OURS, WARM, "#2e8b57", "#8250b4")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size in inches, that lays out its axes itself."""
    return Figure(figsize=(width, height), layout="constrained")


def clean(axes: Axes) -> None:
    """Take away the frame above and to the right, and tone the rest down."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9)
