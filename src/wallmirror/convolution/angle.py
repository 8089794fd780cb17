"""Rendering as one convolution over an angle, the one-dimensional form that converges with distance.

Algorithm 1 is L(x) = sum_i v_i rho(theta_o(x) + theta_s,i(x)). With theta_c(x) towards the middle of the card, write
theta_s,i(x) = theta_c(x) + delta_i(x) and take w(x) = theta_o(x) + theta_c(x) as the variable. Then

    L(w) = sum_i v_i rho(w + delta_i),

which is a convolution of rho with the mirror's render, deltas at w = -delta_i, as soon as the delta_i do not depend on
x. They do by d delta_i / dx = (cos^2 theta_c - cos^2 theta_s,i) / y_s, so with the card's angles kept the error falls
as 1 / y_s, and with its width kept as 1 / y_s^2 (1 / y_s^3 for a card that faces the reference point).

The plainer variable theta_o needs theta_s,i itself to be constant ("outgoing"). It is off by
(x - x_r) cos^2 theta_s,i / y_s, so also as 1 / y_s, but by far more: w turns the map of the light with the card.
No variable in metres along the wall does as much: the tangent of a sum is not the sum of the tangents.

Q(theta_o) of eq. 3.4 is cos theta_c(x). What of an element's cosine it does not hold is put on the element's radiance
(`per_element`), for cos theta_s,i / cos theta_c goes to a constant as well, but not to 1 unless the card is narrow.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_interp_spline

from wallmirror.arithmetic import rescaled
from wallmirror.brdf import AngleSumBRDF
from wallmirror.convolution.half_circle import HalfCircle
from wallmirror.convolution.spherical import PointWeights, cosines, source_in_unit
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, incident_angles, outgoing_angles, wall_points

Array = NDArray[np.float64]

#: The angle over which the render is convolved: theta_o + theta_c, or theta_o.
Variable = Literal["sum", "outgoing"]


def angle_convolution(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    variable: Variable = "sum",
    samples: int = 1000,
    order: int = 5,
    weights: PointWeights = "thesis",
    per_element: bool = True,
    reference_x: float | None = None,
) -> Array:
    """Render by one circular convolution for all views and pixels: L = Q (rho * L_mirror), uniform in an angle.

    Parameters
    ----------
    source:
        Radiance of the M elements, (M,) or (M, B).
    variable:
        "sum" or "outgoing"; see the module.
    samples, order:
        Directions on the half circle, and the degree of the splines between them.
    weights:
        "thesis" or "cosine".
    per_element:
        With "cosine", whether each element keeps its own cosine at the reference point; False is Hypothesis 7's bare Q.
    reference_x:
        The wall point x_r from which the card's angles are taken, in metres; where the mirror shows its middle if left
        out.

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
    >>> from wallmirror.brdf import GaussianTrain
    >>> from wallmirror.geometry import Observer, Card
    >>> from wallmirror.transport import radiance, transport_matrix
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=200)
    >>> card, v, rho = Card(elements_x=(-5.0, 5.0), y=-500), [0.5, 1.0], GaussianTrain.of_the_text()
    >>> exact = radiance(transport_matrix(observer, card, rho, weights="thesis"), v)
    >>> error = angle_convolution(observer, card, rho, v) - exact
    >>> bool(np.linalg.norm(error) < 1e-4 * np.linalg.norm(exact))
    True
    """
    source, unit = source_in_unit(card, source)
    grid = HalfCircle(samples=samples, order=order)
    x_r = _reference(observer, card, reference_x)
    mirrored = mirror_directions(observer, card, variable=variable, reference_x=x_r)
    columns = source.reshape(card.elements, -1).T
    if weights == "cosine" and per_element:
        at_reference = _incident(card, np.array(x_r))
        columns = columns * np.cos(at_reference) / np.cos(_towards_middle(card, np.array(x_r)))
    maps = grid.spread(np.broadcast_to(-mirrored, columns.shape), columns)
    coefficients = grid.outgoing(maps, brdf)
    angles = convolution_variable(observer, card, variable=variable)
    render = np.stack([grid.read(row, angles) for row in coefficients], axis=-1)
    render *= cosine_factor(observer, card, weights=weights)[..., None]
    return rescaled(render.reshape(*angles.shape, *source.shape[1:]), unit, field="source")


def convolution_variable(observer: Observer, card: Card, *, variable: Variable = "sum") -> Array:
    """theta_o + theta_c or theta_o of every pixel, (A, N), in radians; falls along x."""
    x = wall_points(observer)
    theta_o = outgoing_angles(observer, x)
    return theta_o + _towards_middle(card, x) if _checked(variable) == "sum" else theta_o


def mirror_directions(
    observer: Observer, card: Card, *, variable: Variable = "sum", reference_x: float | None = None
) -> Array:
    """Where over the variable a mirror in place of the wall shows each element in the far field, (M,), in radians."""
    x_r = np.array(_reference(observer, card, reference_x))
    theta_s = _incident(card, x_r)
    return _towards_middle(card, x_r) - theta_s if _checked(variable) == "sum" else -theta_s


def cosine_factor(observer: Observer, card: Card, *, weights: PointWeights = "cosine") -> Array:
    """Q(theta_o) of eq. 3.4 at every pixel, (A, N): cos theta_c, or 1 for "thesis" weights."""
    return cosines(_towards_middle(card, wall_points(observer)), weights)


def resample(render: ArrayLike, at: ArrayLike, onto: ArrayLike, *, order: int = 3) -> Array:
    """A render at the pixels' angles, put onto other angles by an interpolating spline.

    A render is uniform along the wall or the sensor, a convolution over an angle needs it uniform there.

    Parameters
    ----------
    render:
        Values, (N,) or (N, B).
    at:
        Angle of each pixel, (N,), rising or falling, in radians.
    onto:
        Angles wanted, (K,), within those of the pixels.
    order:
        Degree of the spline, 0 (the pixel below), 1, 3, 5, 7 or 9; lower where there are too few pixels for it.

    Returns
    -------
    Array
        (K,) or (K, B).

    Examples
    --------
    >>> at = np.arctan(np.linspace(1, -1, 101))
    >>> onto = np.linspace(-0.7, 0.7, 5)
    >>> bool(np.allclose(resample(np.cos(at), at, onto), np.cos(onto), rtol=0, atol=1e-7))
    True
    """
    render, at, onto = (np.asarray(a, dtype=np.float64) for a in (render, at, onto))
    if at.ndim != 1 or at.size < 1 or render.shape[:1] != at.shape:
        raise InputError(f"{render.shape[:1]} values stand at {at.shape} angles; give as many", field="render")
    for name, array in (("render", render), ("angles", at), ("angles wanted", onto)):
        if not np.all(np.isfinite(array)):
            raise InputError("holds a value that is not finite", field=name)
    if order not in (0, 1, 3, 5, 7, 9):
        raise InputError(f"is {order}; give 0 or an odd degree up to 9", field="order")
    if at.size > 1 and at[0] > at[-1]:
        render, at = render[::-1], at[::-1]
    if np.any(np.diff(at) <= 0):
        raise InputError("neither rise nor fall from pixel to pixel", field="angles")
    slack = 1e-12 * max(1.0, float(np.ptp(at)))
    if onto.size and (onto.min() < at[0] - slack or onto.max() > at[-1] + slack):
        raise InputError("lie outside those of the pixels, where nothing was seen", field="angles wanted")
    order = min(order, at.size - 1)
    order -= order > 1 and order % 2 == 0
    return np.asarray(make_interp_spline(at, render, k=order)(np.clip(onto, at[0], at[-1])), dtype=np.float64)


def _checked(variable: Variable) -> Variable:
    if variable not in get_args(Variable):
        raise InputError(f'is "{variable}"; choose one of {", ".join(get_args(Variable))}', field="variable")
    return variable


def _reference(observer: Observer, card: Card, reference_x: float | None) -> float:
    if reference_x is None:
        return float(mirror_points(observer, card, np.array(card.middle)))
    if not np.isfinite(reference_x):
        raise InputError(f"is {reference_x:g}; give a finite position", field="reference_x")
    return reference_x


def mirror_points(observer: Observer, card: Card, x: ArrayLike) -> Array:
    """Where along the wall a mirror shows the points x of the card's plane, same shape, in metres."""
    depth = observer.distance + card.distance
    return (np.asarray(x, dtype=np.float64) * observer.distance + observer.position[0] * card.distance) / depth


def _incident(card: Card, wall_x: Array) -> Array:
    return incident_angles(np.asarray(card.elements_x), card.distance, wall_x[..., None])


def _towards_middle(card: Card, wall_x: Array) -> Array:
    return incident_angles(card.middle, card.distance, wall_x)
