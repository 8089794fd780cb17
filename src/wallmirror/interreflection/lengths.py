"""What card and room share: a checked pattern, and lengths in a unit that keeps their fourth powers within float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer

Array = NDArray[np.float64]


def checked_source(card: Card, source: ArrayLike) -> Array:
    """V as float64, (M, B), finite."""
    array = np.asarray(source, dtype=np.float64)
    if array.ndim != 2 or array.shape[0] != card.elements:
        raise InputError(
            f"has shape {array.shape}; give one row for each of the {card.elements} elements, (M, B)", field="source"
        )
    if not np.all(np.isfinite(array)):
        raise InputError("holds a value that is not finite", field="source")
    return array


def scaled(observer: Observer | None, card: Card, unit: float) -> tuple[Any, Card]:
    """Camera and card with lengths in another unit: radiances do not know it, and fourth powers stay in float64's range."""
    lengths = ("y", "element_width", "element_height", "board_width", "board_height")
    smaller = replace(
        card,
        elements_x=tuple(x / unit for x in card.elements_x),
        **{name: getattr(card, name) / unit for name in lengths},
    )
    if observer is not None:
        observer = replace(observer, position=(observer.position[0] / unit, observer.position[1] / unit))
    return observer, smaller
