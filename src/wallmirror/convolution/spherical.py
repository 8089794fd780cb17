"""Rendering as a convolution on the half circle, one for each wall point (section 3.1.1, eq. 3.5).

Seen from a wall point w, the card is a map of incoming light over theta_s. The light that w sends into all theta_o is
the convolution of that map with rho; the camera sees one of these directions. This form needs Hypothesis 8 alone: the
cosine belongs to the map, so it needs no Hypothesis 7 and is Algorithm 1 up to the sampling of the half circle.
"""

from __future__ import annotations

import itertools
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two, rescaled
from wallmirror.brdf import AngleSumBRDF
from wallmirror.convolution.half_circle import HalfCircle
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, incident_angles, outgoing_angles, wall_points

Array = NDArray[np.float64]

#: What stands before rho in eq. 2.12: nothing (the thesis's code) or cos theta_s (its text). Elements are points.
PointWeights = Literal["thesis", "cosine"]

_CHUNK = 1 << 22  # values of incoming maps that are held at a time


def spherical_convolution(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    samples: int = 1000,
    order: int = 3,
    weights: PointWeights = "thesis",
) -> Array:
    """Render by one convolution for each wall point, of which the value towards the observer is read.

    Of each convolution only the (p + 1)^2 products that reach the value read are computed; `outgoing_light` computes
    the whole.

    Parameters
    ----------
    source:
        Radiance of the M elements, (M,) or (M, B) for B realisations.
    samples:
        K, directions on the half circle.
    order:
        Degree of the interpolating splines in both angles; 0 takes the nearest direction.
    weights:
        "thesis" or "cosine".

    Returns
    -------
    Array
        Radiance, (A, N) or (A, N, B).

    Raises
    ------
    InputError
        If the BRDF is no function of the angle sum or the grid steps over it, or the source is of another size or not
        finite.

    Examples
    --------
    >>> from wallmirror.scene import load_scene
    >>> from wallmirror.transport import radiance, transport_matrix
    >>> scene = load_scene("flat_wall_lobes")
    >>> v = np.linspace(0.5, 1, scene.card.elements)
    >>> exact = radiance(transport_matrix(scene.observer, scene.card, scene.wall.brdf, weights="cosine"), v)
    >>> ours = spherical_convolution(scene.observer, scene.card, scene.wall.brdf, v, order=5, weights="cosine")
    >>> bool(np.linalg.norm(ours - exact) < 1e-5 * np.linalg.norm(exact))
    True
    """
    source, unit = source_in_unit(card, source)
    theta_s, theta_o = scene_angles(observer, card)
    grid = HalfCircle(samples=samples, order=order)
    rho = grid.coefficients(brdf)
    nodes_s, values_s = grid.weights(theta_s)
    nodes_o, values_o = grid.weights(theta_o)
    transport = np.zeros(theta_s.shape)
    for s, o in itertools.product(range(order + 1), repeat=2):
        product = rho[(nodes_s[s] + nodes_o[o][..., None]) % rho.size]
        transport += values_s[s] * values_o[o][..., None] * product
    return rescaled(transport * cosines(theta_s, weights) @ source, unit, field="source")


def outgoing_light(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    samples: int = 1000,
    order: int = 3,
    weights: PointWeights = "thesis",
) -> Array:
    """The light that each wall point sends into K directions, (A, N, K): the whole of each convolution, by FFT.

    Parameters
    ----------
    source:
        Radiance of the M elements, (M,).
    samples, order, weights:
        As in `spherical_convolution`. Direction k is -pi/2 + (k + 1/2) pi / K.
    """
    source, unit = source_in_unit(card, source)
    if source.ndim != 1:
        raise InputError(f"has shape {source.shape}; give the radiance of one realisation, (M,)", field="source")
    theta_s, theta_o = scene_angles(observer, card)
    strengths = cosines(theta_s, weights) * source
    grid = HalfCircle(samples=samples, order=order)
    directions = half_circle_directions(samples)
    flat_s, flat_v = theta_s.reshape(-1, card.elements), strengths.reshape(-1, card.elements)
    light = np.empty((flat_s.shape[0], samples))
    rows = max(1, _CHUNK // (2 * samples))
    for start in range(0, flat_s.shape[0], rows):
        part = slice(start, start + rows)
        coefficients = grid.outgoing(grid.spread(flat_s[part], flat_v[part]), brdf)
        nodes, values = grid.weights(directions)
        light[part] = np.einsum("pk,rpk->rk", values, coefficients[:, nodes])
    return rescaled(light.reshape(*theta_o.shape, samples), unit, field="source")


def half_circle_directions(samples: int) -> Array:
    """Middles of K equal parts of the half circle, in radians."""
    return np.asarray((np.arange(samples) + 0.5) * (np.pi / samples) - np.pi / 2, dtype=np.float64)


def scene_angles(observer: Observer, card: Card) -> tuple[Array, Array]:
    """theta_s of every element (A, N, M) and theta_o (A, N) at the wall points that the observer sees, in radians."""
    x = wall_points(observer)
    return incident_angles(np.asarray(card.elements_x), card.distance, x[..., None]), outgoing_angles(observer, x)


def cosines(theta_s: Array, weights: PointWeights) -> Array:
    """What stands before rho: 1 or cos theta_s, same shape."""
    if weights not in get_args(PointWeights):
        raise InputError(f'is "{weights}"; choose one of {", ".join(get_args(PointWeights))}', field="transport")
    return np.cos(theta_s) if weights == "cosine" else np.ones_like(theta_s)


def checked_source(card: Card, source: ArrayLike) -> Array:
    """The source as float64, (M,) or (M, B), finite."""
    array = np.asarray(source, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[0] != card.elements:
        raise InputError(
            f"has shape {array.shape}; give the radiance of the card's {card.elements} elements, (M,) or (M, B)",
            field="source",
        )
    if not np.all(np.isfinite(array)):
        raise InputError("holds a value that is not finite", field="source")
    return array


def source_in_unit(card: Card, source: ArrayLike) -> tuple[Array, float]:
    """The source, checked, in units of a power of two near its largest value, and that unit: renders are linear in it."""
    array = checked_source(card, source)
    unit = power_of_two(array)
    return array / unit, unit
