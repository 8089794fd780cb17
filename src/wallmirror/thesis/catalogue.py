"""Which module makes which figure, in the order of the thesis."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from wallmirror.errors import InputError
from wallmirror.thesis.figure import ThesisFigure

# Modules of this package by section. Each has FIGURES: dict[str, Callable[[int], ThesisFigure]], from a figure's id to
# the function that makes it from a seed.
_MODULES = (
    "radiometry",
    "reflectance",
    "geometry_diagrams",
    "algorithm_1",
    "pictures",
    "rendering_as_convolution",
    "far_field",
    "picture_deconvolution",
    "wall_deconvolution",
    "blind_deconvolution",
    "blind_success",
    "focused_blind",
    "interferometric_identity",
    "focused_blind_limits",
    "cross_relation",
    "blind_spherical",
)


def figure_ids() -> tuple[str, ...]:
    """Ids of all figures, in the order of the thesis."""
    return tuple(sorted(_makers(), key=_place))


def make_figure(figure_id: str, *, seed: int = 0) -> ThesisFigure:
    """Compute and draw one figure.

    Parameters
    ----------
    figure_id:
        Such as "3.9"; `figure_ids` names all.
    seed:
        Root of its random numbers, where it has any.

    Raises
    ------
    InputError
        For an unknown id.

    Examples
    --------
    >>> make_figure("2.10").numbers["elements in the mirror"]
    2.0
    """
    require_figure(figure_id)
    return _makers()[figure_id](seed)


def require_figure(figure_id: str) -> None:
    """Raise InputError unless there is a figure of that id."""
    if figure_id not in _makers():
        raise InputError(f'there is no figure "{figure_id}"; choose from {", ".join(figure_ids())}', field="figures")


def _makers() -> dict[str, Callable[[int], ThesisFigure]]:
    makers: dict[str, Callable[[int], ThesisFigure]] = {}
    for name in _MODULES:
        makers |= importlib.import_module(f"wallmirror.thesis.{name}").FIGURES
    return makers


def _place(figure_id: str) -> tuple[int, int, str]:
    """Chapter, number, and what follows a hyphen: a section's own figures come after those of the thesis."""
    number, _, word = figure_id.partition("-")
    chapter, _, place = number.partition(".")
    return int(chapter), int(place) + (1000 if word else 0), word
