"""One bounce of light from the card over the wall to the observer: Algorithm 1 and its physical form.

The radiance that view a, pixel j receives is linear in the pattern, L = F V (eq. 4.11), and F is linear in
the BRDF,

    F[a, j, i] = sum_q  G[a, j, i, q] rho(theta_s[a, j, i, q], theta_o[a, j, i, q]).

`Kernel` holds the right-hand side without rho; the solvers turn it into sparse matrices, `transport_matrix`
applies it to a known BRDF. The weight G is

- "thesis":   1, what the thesis's code computes (the cosine absorbed in rho', eq. 4.8);
- "cosine":   cos theta_s, what its Algorithm 1 says (eq. 2.12);
- "physical": the reflection equation (1.14) integrated over strip and pixel, cos theta_s cos theta_l / r^2 dA.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from wallmirror.brdf import BRDF, AngleSumBRDF, Mirror
from wallmirror.errors import InputError
from wallmirror.geometry import (
    Array,
    Card,
    Observer,
    incident_angles,
    outgoing_angles,
    pixel_half_width,
    pixel_tangents,
    wall_points,
)

#: What stands in front of the BRDF; see the module's text.
Weights = Literal["thesis", "cosine", "physical"]

_PARTS = 4  # of a pixel or strip, over which the speed of u is measured
_WEIGHT_SCALE = 0.35  # radians
_MAX_ORDER = 256


@dataclass(frozen=True)
class Kernel:
    """The transport from M elements to A x N pixels before the BRDF is known.

    Parameters
    ----------
    theta_s, theta_o:
        Angles at the Q quadrature nodes in radians, broadcastable to (A, N, M, Q).
    weight:
        G at the nodes, shape (A, N, M, Q); in steradians for "physical".
    """

    theta_s: Array
    theta_o: Array
    weight: Array

    @property
    def angle_sum(self) -> Array:
        """u = theta_s + theta_o, shape (A, N, M, Q), in radians."""
        return np.broadcast_to(self.theta_s + self.theta_o, self.weight.shape)

    def apply(self, brdf: BRDF) -> Array:
        """F for a BRDF with finite values, shape (A, N, M)."""
        rho = brdf.of_sum(self.angle_sum) if isinstance(brdf, AngleSumBRDF) else brdf(self.theta_s, self.theta_o)
        transport: Array = np.sum(self.weight * rho, axis=-1)
        return transport


def build_kernel(
    observer: Observer,
    card: Card,
    *,
    weights: Weights = "physical",
    resolution: float = math.pi / 4,
    tolerance: float = 1e-6,
    orders: tuple[int, int] | None = None,
) -> Kernel:
    """The kernel of one bounce, with quadrature orders that resolve a BRDF of the given angular scale.

    Parameters
    ----------
    weights:
        "thesis", "cosine" or "physical"; the first two take elements and pixels as points.
    resolution:
        Smallest angular scale of the BRDF (standard deviation of its narrowest lobe) in radians.
    tolerance:
        Largest error wanted, relative to a lobe's peak.
    orders:
        Gauss-Legendre nodes across a pixel and across a strip, where they are known; they follow from `resolution` and
        `tolerance` if left out. One node is the middle: a pixel or strip taken as a line.

    Raises
    ------
    InputError
        If the strips or pixels are so wide against `resolution` that more than 256 nodes would be needed.
    """
    if weights not in get_args(Weights):
        raise InputError(f'is "{weights}"; choose one of {", ".join(get_args(Weights))}', field="transport")
    half_pixel, half_strip, found = _orders(observer, card, weights, resolution, tolerance)
    return _kernel(observer, card, weights, half_pixel, half_strip, *(orders or found))


def quadrature_orders(
    observer: Observer, card: Card, *, resolution: float = math.pi / 4, tolerance: float = 1e-6
) -> tuple[int, int]:
    """Nodes across a pixel and across a strip that `build_kernel` takes for physical weights, with its parameters."""
    return _orders(observer, card, "physical", resolution, tolerance)[2]


def _orders(
    observer: Observer, card: Card, weights: Weights, resolution: float, tolerance: float
) -> tuple[float, float, tuple[int, int]]:
    """Half widths of pixel (in tangents) and strip (in metres), and the quadrature orders along both."""
    points = weights != "physical"
    half_pixel = 0.0 if points else pixel_half_width(observer)
    half_strip = 0.0 if points else card.element_width / 2
    pixel_turn, strip_turn = _extent_in_angle(observer, card, half_pixel, half_strip)
    # The weight in front of the BRDF varies over angles as well, about as a lobe of this width does.
    scale = 1 / math.hypot(1 / resolution, 1 / _WEIGHT_SCALE)
    orders = quadrature_order(pixel_turn / scale, tolerance), quadrature_order(strip_turn / scale, tolerance)
    return half_pixel, half_strip, orders


def transport_matrix(
    observer: Observer,
    card: Card,
    brdf: BRDF,
    *,
    weights: Weights = "physical",
    tolerance: float = 1e-9,
) -> Array:
    """F of section 4.1.2 for a known BRDF, shape (A, N, M).

    Parameters
    ----------
    weights:
        "thesis", "cosine" or "physical".
    tolerance:
        Quadrature error wanted, relative to the largest entry: the orders double until F moves by less.

    Examples
    --------
    >>> from wallmirror.scene import load_scene
    >>> scene = load_scene("flat_wall_diffuse")
    >>> transport_matrix(scene.observer, scene.card, scene.wall.brdf).shape
    (20, 500, 4)
    """
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf, weights=weights)
    half_pixel, half_strip, orders = _orders(observer, card, weights, brdf.angular_scale, tolerance)
    coarse = _kernel(observer, card, weights, half_pixel, half_strip, *orders).apply(brdf)
    # The orders are those for Gaussian lobes; half as many again must agree on this BRDF and this geometry.
    while half_pixel > 0 or half_strip > 0:
        orders = _more(orders[0], half_pixel), _more(orders[1], half_strip)
        if max(orders) > _MAX_ORDER:
            raise InputError(
                f"a strip or pixel needs more than {_MAX_ORDER} quadrature nodes to reach {tolerance:g}; narrow the "
                "strips, use more pixels or accept a larger tolerance",
                field="card.element_width",
            )
        fine = _kernel(observer, card, weights, half_pixel, half_strip, *orders).apply(brdf)
        if np.max(np.abs(fine - coarse), initial=0.0) <= tolerance * np.max(np.abs(fine), initial=0.0):
            return fine
        coarse = fine
    return coarse


def _more(order: int, half_width: float) -> int:
    return order + max(2, order // 2) if half_width > 0 else 1


def mirror_matrix(observer: Observer, card: Card, mirror: Mirror, *, weights: Weights = "physical") -> Array:
    """F of a mirror, shape (A, N, M): the share of each pixel in which the mirrored strip is seen, exactly.

    The observer sees the strip as if from its own image behind the wall. With "thesis" and "cosine" weights
    each element lights the one pixel that its image falls into, with 1 or cos theta_s: a delta has no width.
    """
    t = pixel_tangents(observer)
    x_o = observer.position[0]
    depth = observer.distance + card.distance
    view = np.asarray(observer.view_angles)[:, None, None]
    centres = np.asarray(card.elements_x)

    def image_tangent(x: Array) -> Array:
        # x = x_o + depth tan(atan t - view): where on the sensor the point x of the card appears.
        # What lies behind the image plane is infinitely far out on its side.
        tangent: Array = np.tan(np.clip(np.arctan((x - x_o) / depth) + view, -math.pi / 2, math.pi / 2))
        return tangent

    if weights != "physical" or card.is_points:
        if weights == "physical":
            raise InputError(
                "points in a mirror have no radiance; give the strips a width and a height",
                field="card.element_width",
            )
        pitch = t[1] - t[0] if t.size > 1 else 2 * math.tan(observer.fov / 2)
        # Round, so that an image on the edge of two pixels falls into one of them and into no more.
        hit = np.arange(t.size)[:, None] == np.floor((image_tangent(centres) - t[0]) / pitch + 0.5)
        theta_s = incident_angles(centres, card.distance, wall_points(observer)[..., None])
        factor = np.cos(theta_s) if weights == "cosine" else 1.0
        return np.where(hit, mirror.reflectance * factor, 0.0)

    half = pixel_half_width(observer)
    if half == 0:  # points
        ends = [image_tangent(centres + side * card.element_width / 2) for side in (-1, 1)]
        return np.where((t[:, None] > ends[0]) & (t[:, None] < ends[1]), mirror.reflectance, 0.0)
    low = np.maximum(t[:, None] - half, image_tangent(centres - card.element_width / 2))
    high = np.minimum(t[:, None] + half, image_tangent(centres + card.element_width / 2))
    high = np.maximum(low, high)
    # A pixel's rays reach heights up to `half * path` on the card, path = depth / (cos view + t sin view); those within
    # the strip see it. Their share is a line in t, cut off at 1: exact by the midpoint rule on each side of the bend.
    slope, rise = np.cos(view), np.sin(view)
    strip = card.element_height / (2 * half * depth)
    bend = np.divide(1 / strip - slope, rise, out=np.zeros_like(view), where=rise != 0)
    bend = np.clip(bend, low, high)
    seen = np.zeros(low.shape)
    for a, b in ((low, bend), (bend, high)):
        seen += (b - a) * np.minimum(1.0, strip * (slope + 0.5 * (a + b) * rise))
    matrix: Array = mirror.reflectance * seen / (2 * half)
    return matrix


def radiance(transport: ArrayLike, source: ArrayLike) -> Array:
    """Render L_r = F V: (A, N, M) and (M, B) to (A, N, B) (eqs. 4.10 to 4.12)."""
    return np.asarray(transport, dtype=np.float64) @ np.asarray(source, dtype=np.float64)


def brdf_matrices(transport: ArrayLike) -> tuple[Array, ...]:
    """The A matrices B_a of section 4.1.2, each (N, M); B is `np.hstack` of them."""
    return tuple(np.asarray(transport, dtype=np.float64))


def strip_factor(distance: float, dx: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Integral of cos theta_s cos theta_l / r^2 over the height of a strip parallel to the wall, in 1/m.

    Parameters
    ----------
    distance:
        z, distance between card and wall in metres.
    dx:
        Offset along x from wall point to strip, in metres.
    low, high:
        Ends of the strip above the wall point, in metres.

    Notes
    -----
    The integrand is z^2 / (a^2 + h^2)^2 with a^2 = z^2 + dx^2; its antiderivative is
    z^2 [h / (2 a^2 (a^2 + h^2)) + atan(h / a) / (2 a^3)].
    """
    a = np.hypot(distance, np.asarray(dx, dtype=np.float64))

    def antiderivative(h: ArrayLike) -> Array:
        # In units of a, so that neither tiny nor huge scenes leave the range of float64.
        h = np.asarray(h, dtype=np.float64) / a
        far = np.abs(h) > 1e8  # h / (1 + h^2) is 1 / h to rounding, and h^2 may overflow
        ratio = np.where(far, 1 / np.where(far, h, 1.0), h / (1 + np.where(far, 0.0, h) ** 2))
        whole: Array = 0.5 * (distance / a) ** 2 / a * (ratio + np.arctan(h))
        return whole

    return antiderivative(high) - antiderivative(low)


def quadrature_order(width: float, tolerance: float) -> int:
    """Smallest Gauss-Legendre order that averages exp(-u^2/2) over an interval of `width` to `tolerance`.

    Parameters
    ----------
    width:
        Length of the interval in standard deviations of the lobe; the worst offset of the lobe counts.
    """
    if width <= 0:
        return 1
    # Lobes every quarter of their width, so that none slips between the nodes unseen.
    offsets = np.linspace(0.0, width / 2 + 4.0, 33 + int(2 * width))
    reference = _lobe_average(width, offsets)
    for order in range(1 + int(width / 4), _MAX_ORDER + 1):  # nodes further apart than the lobe's width see nothing
        nodes, weights = _gauss_legendre(order)
        values = np.exp(-0.5 * (offsets[:, None] + 0.5 * width * nodes) ** 2) @ (0.5 * weights)
        if np.max(np.abs(values - reference)) <= tolerance:
            return order
    raise InputError(
        f"a strip or pixel spans {width:.3g} lobe widths of the BRDF, more than {_MAX_ORDER} quadrature nodes resolve "
        f"to {tolerance:g}; narrow the strips, use more pixels or accept a larger tolerance",
        field="card.element_width",
    )


@functools.cache
def _gauss_legendre(order: int) -> tuple[Array, Array]:
    """Nodes and weights on [-1, 1], kept: a search for the card asks for the same ones hundreds of times."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def _lobe_average(width: float, offsets: Array) -> Array:
    """Exact average of exp(-u^2/2) over [offset - width/2, offset + width/2]."""
    ends = (offsets[:, None] + 0.5 * width * np.array([1.0, -1.0])) / math.sqrt(2)
    if width < 1e-3:  # the difference of two erf would cancel
        return np.exp(-0.5 * offsets**2) * (1 + (offsets**2 - 1) * width**2 / 24)
    difference = erf(ends[:, 0]) - erf(ends[:, 1])
    return np.asarray(math.sqrt(math.pi / 2) * difference / width, dtype=np.float64)


def _extent_in_angle(observer: Observer, card: Card, half_pixel: float, half_strip: float) -> tuple[float, float]:
    """What one pixel and one strip would span in u, in radians, if u ran everywhere as fast as where it is fastest.

    A chord from end to end would miss how u bends: under a near card it runs fast in the middle of a wide pixel.
    """
    if half_pixel == 0 and half_strip == 0:
        return 0.0, 0.0
    parts = np.linspace(-1.0, 1.0, _PARTS + 1)
    across = wall_points(observer, pixel_tangents(observer)[:, None] + half_pixel * parts)[..., None]
    strips = np.asarray(card.elements_x)
    u = outgoing_angles(observer, across) + incident_angles(strips, card.distance, across)
    pixel = _PARTS * float(np.abs(np.diff(u, axis=2)).max())
    centre = wall_points(observer)[..., None]
    ends = [incident_angles(strips + half_strip * part, card.distance, centre) for part in parts]
    strip = _PARTS * max(float((right - left).max()) for left, right in itertools.pairwise(ends))
    return pixel, strip


def _kernel(
    observer: Observer,
    card: Card,
    weights: Weights,
    half_pixel: float,
    half_strip: float,
    along_pixel: int,
    along_strip: int,
) -> Kernel:
    """Nodes q = (across the pixel, across the strip); the height of the pixel is summed into the weight."""
    pixel_nodes, pixel_weights = _gauss_legendre(along_pixel)
    strip_nodes, strip_weights = _gauss_legendre(along_strip)
    t = pixel_tangents(observer)[:, None] + half_pixel * pixel_nodes
    # Axes: (A, N, M, pixel node, strip node).
    wall_x = wall_points(observer, t)[:, :, None, :, None]
    source_x = np.asarray(card.elements_x)[:, None, None] + half_strip * strip_nodes
    theta_s = incident_angles(source_x, card.distance, wall_x)
    theta_o = outgoing_angles(observer, wall_x)
    average = 0.5 * pixel_weights[:, None] * (0.5 * strip_weights)
    if weights == "thesis":
        weight = np.broadcast_to(average, theta_s.shape)
    elif weights == "cosine":
        weight = average * np.cos(theta_s)
    elif card.is_points:
        weight = average * np.cos(theta_s) ** 4 / card.distance**2
    else:
        view = np.asarray(observer.view_angles)[:, None, None]
        path = observer.distance / (np.cos(view) + t * np.sin(view))
        reach = (half_pixel * path)[:, :, None, :, None]  # how far up the wall the pixel sees
        weight = _mean_strip_factor(card.distance, source_x - wall_x, card.element_height / 2, reach)
        weight *= average * card.element_width
    shape = (*theta_s.shape[:3], -1)
    theta_o = np.broadcast_to(theta_o, theta_s.shape)
    return Kernel(theta_s.reshape(shape), theta_o.reshape(shape), np.ascontiguousarray(weight).reshape(shape))


def _mean_strip_factor(distance: float, dx: Array, half: float, reach: Array) -> Array:
    """Mean of `strip_factor` over wall points from -reach to reach below a strip from -half to half, in 1/m.

    With G(h) = z^2 h atan(h / a) / (2 a^3), whose derivative is the antiderivative of `strip_factor`, the mean is
    [G(half + reach) - G(half - reach)] / reach; sum and difference of the arctangents are taken as one each, since both
    may cancel.
    """
    a = np.hypot(distance, dx)
    upper, lower = (half + reach) / a, (half - reach) / a
    both = np.arctan2(2 * half / a, 1 - upper * lower)
    with np.errstate(invalid="ignore"):
        apart = np.arctan2(2 * reach / a, 1 + upper * lower) / np.where(reach > 0, reach, 1.0)
    apart = np.where(reach > 0, apart, 2 * a / (a * a + half * half))
    mean: Array = 0.5 * (distance / a) ** 2 / a * (half * apart + both)
    return mean
