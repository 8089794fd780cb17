"""References that share no code with what they judge: a brute-force integral, and Algorithm 1 in extended precision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, GaussianTrain
from wallmirror.geometry import Card, Observer

Array = NDArray[np.float64]


def brute_force(
    observer: Observer, card: Card, brdf: BRDF, place: Sequence[Any], *, order: int = 24, up: int = 12
) -> float:
    """One entry (view, pixel, element) of F: eq. 1.14 with vectors in space, Gauss-Legendre over the pixel and the strip.

    Parameters
    ----------
    order, up:
        Nodes along x and along z of pixel and strip each.
    """
    view, pixel, element = (int(i) for i in place)
    half = math.tan(observer.fov / 2) / observer.pixels
    angle = observer.view_angles[view]
    axis = np.array([-math.sin(angle), math.cos(angle), 0.0])
    right = np.array([math.cos(angle), math.sin(angle), 0.0])
    along, along_weights = np.polynomial.legendre.leggauss(order)
    high, high_weights = np.polynomial.legendre.leggauss(up)
    t = (2 * pixel + 1 - observer.pixels) * half + half * along
    rays = axis + t[:, None, None] * right + half * high[:, None] * np.array([0.0, 0.0, 1.0])
    eye = np.array([*observer.position, 0.0])
    wall = eye - rays * (eye[1] / rays[..., 1:2])
    light = np.empty((order, up, 3))
    light[..., 0] = card.elements_x[element] + 0.5 * card.element_width * along[:, None]
    light[..., 1] = card.y
    light[..., 2] = 0.5 * card.element_height * high
    path = light - wall[:, :, None, None]
    squared = np.sum(path * path, axis=-1)
    cosines = path[..., 1] ** 2 / squared  # at the wall and, since the card is parallel to it, at the card
    theta_s = np.arctan2(path[..., 0], -path[..., 1])
    theta_o = np.arctan2(eye[0] - wall[..., 0], wall[..., 1] - eye[1])[..., None, None]
    values = brdf(theta_s, theta_o) * cosines / squared
    area = card.element_width * card.element_height / 16  # four rules that each sum to 2
    return area * float(np.einsum("tvxz,t,v,x,z->", values, along_weights, high_weights, along_weights, high_weights))


def points_in_extended_precision(observer: Observer, card: Card, brdf: GaussianTrain, pattern: Array) -> NDArray[Any]:
    """Algorithm 1 with cos theta_s for points and lobes of height 1, (A, N), in NumPy's long double throughout."""
    real = np.longdouble
    half = np.tan(real(observer.fov) / 2)
    t = np.linspace(-half, half, observer.pixels, dtype=real)
    view = np.array(observer.view_angles, dtype=real)[:, None]
    x_o, y_o = (real(v) for v in observer.position)
    wall_x = x_o + y_o * np.tan(view - np.arctan(t))
    theta_o = np.arctan2(x_o - wall_x, -y_o)[..., None]
    theta_s = np.arctan2(np.array(card.elements_x, dtype=real) - wall_x[..., None], real(-card.y))
    lobes = sum(
        (np.exp(-(((theta_s + theta_o - real(c)) / real(brdf.sigma)) ** 2) / 2) for c in brdf.centres),
        start=np.zeros(theta_s.shape, dtype=real),
    )
    return np.asarray((real(brdf.scale) * lobes * np.cos(theta_s)) @ np.asarray(pattern, dtype=real))
