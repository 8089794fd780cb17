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

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

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
from wallmirror.memory import kernel_bytes, require_memory, transport_bytes
from wallmirror.quadrature import MAX_ORDER, gauss_legendre, quadrature_order

#: What stands in front of the BRDF; see the module's text.
Weights = Literal["thesis", "cosine", "physical"]

_PARTS = 4  # of a pixel or strip, over which the speed of u is measured
_WEIGHT_SCALE = 0.35  # radians
_BLOCK = 1 << 14  # nodes: their dozen temporary arrays stay in a cache of 2 MB
_ROW = 256  # pixels of a block at least, since NumPy is slow over short rows


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
        If the strips or pixels are so wide against `resolution` that more than 256 nodes would be needed, or the kernel
        is larger than the memory.
    """
    nodes = _Nodes.of(observer, card, weights)
    orders = nodes.orders(resolution, tolerance) if orders is None else nodes.checked(orders)
    require_memory(
        kernel_bytes(observer.views, observer.pixels, card.elements, orders[0] * orders[1]),
        f"the kernel of {observer.views} views x {observer.pixels} pixels x {card.elements} elements x "
        f"{orders[0] * orders[1]} nodes",
    )
    return nodes.kernel(orders)


def quadrature_orders(
    observer: Observer, card: Card, *, resolution: float = math.pi / 4, tolerance: float = 1e-6
) -> tuple[int, int]:
    """Nodes across a pixel and across a strip that `build_kernel` takes for physical weights, with its parameters."""
    return _Nodes.of(observer, card, "physical").orders(resolution, tolerance)


def transport_matrix(
    observer: Observer,
    card: Card,
    brdf: BRDF,
    *,
    weights: Weights = "physical",
    tolerance: float = 1e-9,
    orders: tuple[int, int] | None = None,
) -> Array:
    """F of section 4.1.2 for a known BRDF, shape (A, N, M).

    Parameters
    ----------
    weights:
        "thesis", "cosine" or "physical".
    tolerance:
        Quadrature error wanted, relative to the largest entry: the orders grow until F moves by less.
    orders:
        Nodes across a pixel and across a strip, to evaluate F once with these whatever the error; see `build_kernel`.

    Raises
    ------
    InputError
        If more than 256 nodes would be needed, or F is larger than the memory.

    Examples
    --------
    >>> from wallmirror.scene import load_scene
    >>> scene = load_scene("flat_wall_diffuse")
    >>> transport_matrix(scene.observer, scene.card, scene.wall.brdf).shape
    (20, 500, 4)
    """
    require_memory(
        transport_bytes(observer.views, observer.pixels, card.elements),
        f"F of {observer.views} views x {observer.pixels} pixels x {card.elements} elements",
    )
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf, weights=weights)
    nodes = _Nodes.of(observer, card, weights)
    if orders is not None:
        return nodes.transport(nodes.checked(orders), brdf)
    orders = nodes.orders(brdf.angular_scale, tolerance)
    coarse = nodes.transport(orders, brdf)
    # The orders are those for Gaussian lobes; half as many again must agree on this BRDF and this geometry.
    while nodes.half_pixel > 0 or nodes.half_strip > 0:
        orders = _more(orders[0], nodes.half_pixel), _more(orders[1], nodes.half_strip)
        if max(orders) > MAX_ORDER:
            raise InputError(
                f"a strip or pixel needs more than {MAX_ORDER} quadrature nodes to reach {tolerance:g}; narrow the "
                "strips, use more pixels or accept a larger tolerance",
                field="card.element_width",
            )
        fine = nodes.transport(orders, brdf)
        largest = max(float(fine.max(initial=0.0)), -float(fine.min(initial=0.0)))
        np.subtract(coarse, fine, out=coarse)
        if np.max(np.abs(coarse, out=coarse), initial=0.0) <= tolerance * largest:
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


def _extent_in_angle(observer: Observer, card: Card, half_pixel: float, half_strip: float) -> tuple[float, float]:
    """What one pixel and one strip would span in u, in radians, if u ran everywhere as fast as where it is fastest.

    A chord from end to end would miss how u bends: under a near card it runs fast in the middle of a wide pixel.
    """
    if half_pixel == 0 and half_strip == 0:
        return 0.0, 0.0
    parts = np.linspace(-1.0, 1.0, _PARTS + 1)
    t = pixel_tangents(observer)
    strips = np.asarray(card.elements_x)
    pixel = strip = 0.0
    for views, pixels, elements in _blocks(observer.views, t.size, strips.size):
        part, sources = replace(observer, view_angles=observer.view_angles[views]), strips[elements]
        across = wall_points(part, t[pixels, None] + half_pixel * parts)[..., None]
        u = outgoing_angles(part, across) + incident_angles(sources, card.distance, across)
        pixel = max(pixel, _PARTS * float(np.abs(np.diff(u, axis=2)).max()))
        centre = across[:, :, _PARTS // 2]
        ends = (incident_angles(sources + half_strip * node, card.distance, centre) for node in parts)
        strip = max(strip, _PARTS * max(float((right - left).max()) for left, right in itertools.pairwise(ends)))
    return pixel, strip


def _blocks(views: int, pixels: int, elements: int) -> Iterator[tuple[slice, slice, slice]]:
    """Parts of (A, N, M) of about `_BLOCK` entries each, whole rows of pixels where they fit."""
    some_elements = min(elements, max(1, _BLOCK // _ROW))
    rest = max(1, _BLOCK // some_elements)
    some_views, some_pixels = max(1, rest // pixels), min(rest, pixels)
    steps = ((views, some_views), (pixels, some_pixels), (elements, some_elements))
    for a, j, i in itertools.product(*(range(0, size, step) for size, step in steps)):
        yield slice(a, a + some_views), slice(j, j + some_pixels), slice(i, i + some_elements)


@dataclass(frozen=True)
class _Nodes:
    """The quadrature nodes of a scene: q = (across the pixel, across the strip), the pixel's height in the weight.

    Parameters
    ----------
    half_pixel, half_strip:
        Half widths of pixel (in tangents) and strip (in metres); 0 where the weights take points.
    """

    observer: Observer
    card: Card
    weights: Weights
    half_pixel: float
    half_strip: float

    @classmethod
    def of(cls, observer: Observer, card: Card, weights: Weights) -> _Nodes:
        if weights not in get_args(Weights):
            raise InputError(f'is "{weights}"; choose one of {", ".join(get_args(Weights))}', field="transport")
        points = weights != "physical"
        half_pixel = 0.0 if points else pixel_half_width(observer)
        return cls(observer, card, weights, half_pixel, 0.0 if points else card.element_width / 2)

    def orders(self, resolution: float, tolerance: float) -> tuple[int, int]:
        """The orders across pixel and strip that resolve lobes of this width in radians."""
        pixel_turn, strip_turn = _extent_in_angle(self.observer, self.card, self.half_pixel, self.half_strip)
        # The weight in front of the BRDF varies over angles as well, about as a lobe of this width does.
        scale = 1 / math.hypot(1 / resolution, 1 / _WEIGHT_SCALE)
        return quadrature_order(pixel_turn / scale, tolerance), quadrature_order(strip_turn / scale, tolerance)

    def checked(self, orders: tuple[int, int]) -> tuple[int, int]:
        """Orders that somebody asked for, 1 where there is nothing to integrate over."""
        if not all(1 <= order <= MAX_ORDER for order in orders):
            raise InputError(f"are {orders}; give 1 to {MAX_ORDER} nodes across pixel and strip", field="orders")
        return orders[0] if self.half_pixel > 0 else 1, orders[1] if self.half_strip > 0 else 1

    def transport(self, orders: tuple[int, int], brdf: BRDF) -> Array:
        """F, node by node, over blocks of pixels and elements that stay in a processor's cache."""
        of_pixel, of_strip, average = self._rule(orders)
        t = pixel_tangents(self.observer)
        transport = np.empty((self.observer.views, t.size, self.card.elements))
        source_x = np.asarray(self.card.elements_x)[:, None, None, None] + of_strip  # axes: (M, A, N), node
        for block in _blocks(*transport.shape):
            observer = replace(self.observer, view_angles=self.observer.view_angles[block[0]])
            part, sources = t[block[1]], source_x[block[2]]
            sums = np.zeros((len(sources), observer.views, part.size))
            for p, across in enumerate(of_pixel):
                seen = self._seen(observer, part + across)
                for s in range(of_strip.size):
                    theta_s, theta_o, weight = self._transported(*seen, sources[..., s])
                    rho = brdf.of_sum(theta_s + theta_o) if isinstance(brdf, AngleSumBRDF) else brdf(theta_s, theta_o)
                    if weight is not None:
                        rho *= weight
                    rho *= average[p, s]
                    sums += rho
            transport[block] = np.moveaxis(sums, 0, -1)
        return transport

    def kernel(self, orders: tuple[int, int]) -> Kernel:
        """All nodes of all pixels at once, in the order of `Kernel`."""
        of_pixel, of_strip, average = self._rule(orders)
        # Axes: (A, N, M, pixel node, strip node).
        wall_x, theta_o, reach = (
            x[:, :, None, :, None] for x in self._seen(self.observer, pixel_tangents(self.observer)[:, None] + of_pixel)
        )
        source_x = np.asarray(self.card.elements_x)[:, None, None] + of_strip
        theta_s, theta_o, weight = self._transported(wall_x, theta_o, reach, source_x)
        weight = np.broadcast_to(average, theta_s.shape) if weight is None else np.multiply(weight, average, out=weight)
        shape = (*theta_s.shape[:3], -1)
        theta_o = np.broadcast_to(theta_o, theta_s.shape)
        return Kernel(theta_s.reshape(shape), theta_o.reshape(shape), np.ascontiguousarray(weight).reshape(shape))

    def _rule(self, orders: tuple[int, int]) -> tuple[Array, Array, Array]:
        """Offsets of the nodes across pixel (in tangents) and strip (in metres), and their weights, which sum to 1."""
        pixel_nodes, pixel_weights = gauss_legendre(orders[0])
        strip_nodes, strip_weights = gauss_legendre(orders[1])
        average = 0.5 * pixel_weights[:, None] * (0.5 * strip_weights)
        return self.half_pixel * pixel_nodes, self.half_strip * strip_nodes, average

    def _seen(self, observer: Observer, t: Array) -> tuple[Array, Array, Array]:
        """Wall point, theta_o, and how far up the wall a pixel reaches, at image positions t, each (A, *t.shape)."""
        wall_x = wall_points(observer, t)
        view = np.asarray(observer.view_angles).reshape((-1,) + (1,) * t.ndim)
        path = observer.distance / (np.cos(view) + t * np.sin(view))
        return wall_x, outgoing_angles(observer, wall_x), self.half_pixel * path

    def _transported(
        self, wall_x: Array, theta_o: Array, reach: Array, source_x: Array
    ) -> tuple[Array, Array, Array | None]:
        """theta_s, theta_o and the weight at the nodes; None for a weight of 1."""
        card = self.card
        if self.weights != "physical" or card.is_points:
            theta_s = incident_angles(source_x, card.distance, wall_x)
            match self.weights:
                case "thesis":
                    return theta_s, theta_o, None
                case "cosine":
                    return theta_s, theta_o, np.cos(theta_s)
                case _:
                    return theta_s, theta_o, np.cos(theta_s) ** 4 / card.distance**2
        slope = (source_x - wall_x) / card.distance
        weight = _mean_strip_factor(
            card.distance, slope, card.element_height / 2, reach if self.half_pixel > 0 else None
        )
        weight *= card.element_width
        return np.arctan(slope), theta_o, weight


def _mean_strip_factor(distance: float, slope: Array, half: float, reach: Array | None) -> Array:
    """Mean of `strip_factor` over wall points from -reach to reach below a strip from -half to half, in 1/m.

    With G(h) = z^2 h atan(h / a) / (2 a^3), whose derivative is the antiderivative of `strip_factor`, the mean is
    [G(half + reach) - G(half - reach)] / reach; sum and difference of the arctangents are taken as one each, since both
    may cancel.

    Parameters
    ----------
    slope:
        tan theta_s = dx / z, so that a^2 = z^2 (1 + slope^2).
    reach:
        None for points.
    """
    with np.errstate(over="ignore", divide="ignore"):  # beyond 1e154 z nothing arrives
        square = slope * slope
        square += 1.0
        inverse = np.sqrt(square)  # 1 / a
        inverse *= distance
        np.divide(1.0, inverse, out=inverse)
        if reach is None:
            h = half * inverse
            mean = 1 / (h + 1 / h)  # h / (1 + h^2), whose square may overflow
            mean += np.arctan(h, out=h)
            mean *= 2
        else:
            product, both = (half + reach) * inverse, (half - reach) * inverse
            product *= both
            mean = 1 + product
            np.arctan2(np.multiply(2 * reach, inverse, out=both), mean, out=mean)
            mean *= half / reach
            np.subtract(1, product, out=product)
            np.arctan2(np.multiply(2 * half, inverse, out=both), product, out=both)
            mean += both
    mean *= 0.5
    mean *= inverse
    mean /= square
    return mean
