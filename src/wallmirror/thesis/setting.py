"""The settings of the experiments in sections 2.2.3, 3.1 and 3.2.2."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.geometry import Card, Observer

Array = NDArray[np.float64]

#: Radiance of the two elements, from left to right; the text says "random", the published code takes these.
SOURCE = np.array([0.5, 1.0])
WIDTH = 10.0  # between the two elements, in metres

#: Lobe centres in degrees: the text's (eq. 2.15), those of the published code of chapter 3, and of chapter 4.
LOBES = {"text": (-30.0, -15.0, 15.0, 30.0), "chapter 3": (-15.0, 15.0), "code": (-35.0, -15.0, 15.0, 35.0)}


def observer(pixels: int = 500) -> Observer:
    """The camera of chapters 2 and 3: at (0, -5), looking straight at the wall with a field of 90 deg."""
    return Observer(position=(0.0, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=pixels, pixels_at="edges")


def card(distance: float = 5.0, *, width: float = WIDTH) -> Card:
    """The source: two points `width` apart, centred before the observer."""
    return Card(elements_x=(-width / 2, width / 2), y=-distance)


def lobes(*centres_deg: float, sigma_deg: float = 1.0) -> GaussianTrain:
    """Lobes of peak 1 and 1 deg wide, as all the published code has them."""
    return GaussianTrain(centres=tuple(map(math.radians, centres_deg)), sigma=math.radians(sigma_deg))


def peaks(x: Array, render: Array, *, least: float = 0.05) -> Array:
    """Where a render has local maxima above `least` of its largest, refined by a parabola, from left to right."""
    inner = (render[1:-1] > render[:-2]) & (render[1:-1] >= render[2:]) & (render[1:-1] > least * render.max())
    at = np.flatnonzero(inner) + 1
    before, here, after = render[at - 1], render[at], render[at + 1]
    shift = 0.5 * (before - after) / (before - 2 * here + after)
    places: Array = x[at] + shift * (x[1] - x[0])
    return places
