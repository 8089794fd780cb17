"""The quadrature nodes across pixels and strips: how many a BRDF needs, where they lie, and the weight at each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from wallmirror.brdf import BRDF, AngleSumBRDF
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
from wallmirror.quadrature import MAX_ORDER, gauss_legendre, order_across_peak, quadrature_order
from wallmirror.transport.strips import mean_strip_factor

#: What stands in front of the BRDF; see the text of `wallmirror.transport`.
Weights = Literal["thesis", "cosine", "physical"]

_PARTS = 4  # of a pixel or strip, over which the speed of u is measured
_WEIGHT_SCALE = 0.35  # radians
_BLOCK = 1 << 14  # nodes: their dozen temporary arrays stay in a cache of 2 MB
_ROW = 256  # pixels of a block at least, since NumPy is slow over short rows


@dataclass(frozen=True)
class Nodes:
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
    def of(cls, observer: Observer, card: Card, weights: Weights) -> Nodes:
        require_weights(weights)
        points = weights != "physical"
        half_pixel = 0.0 if points else pixel_half_width(observer)
        return cls(observer, card, weights, half_pixel, 0.0 if points else card.element_width / 2)

    def orders(self, resolution: float, tolerance: float) -> tuple[int, int]:
        """The orders across pixel and strip that resolve lobes of this width in radians."""
        pixel_turn, strip_turn = _extent_in_angle(self.observer, self.card, self.half_pixel, self.half_strip)
        # The weight in front of the BRDF varies over angles as well, about as a lobe of this width does.
        for name, value in (("resolution", resolution), ("tolerance", tolerance)):
            if not value > 0:
                raise InputError(f"is {value:g}; give a number > 0", field=name)
        scale = 1 / math.hypot(1 / resolution, 1 / _WEIGHT_SCALE)
        pixel, strip = (
            max(quadrature_order(turn / scale, tolerance), order_across_peak(turn, tolerance))
            for turn in (pixel_turn, strip_turn)
        )
        return pixel, strip

    def checked(self, orders: tuple[int, int]) -> tuple[int, int]:
        """Orders that somebody asked for, 1 where there is nothing to integrate over."""
        if len(orders) != 2 or not all(isinstance(n, (int, np.integer)) and 1 <= n <= MAX_ORDER for n in orders):
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
                    theta_s, theta_o, weight = self._transported(*seen, sources[..., s], average[p, s])
                    rho = brdf.of_sum(theta_s + theta_o) if isinstance(brdf, AngleSumBRDF) else brdf(theta_s, theta_o)
                    rho *= weight
                    sums += rho
            transport[block] = np.moveaxis(sums, 0, -1)
        return transport

    def all_at_once(self, orders: tuple[int, int]) -> tuple[Array, Array, Array]:
        """theta_s, theta_o and the weight at all nodes of all pixels, each (A, N, M, Q)."""
        of_pixel, of_strip, average = self._rule(orders)
        # Axes: (A, N, M, pixel node, strip node).
        wall_x, theta_o, reach = (
            x[:, :, None, :, None] for x in self._seen(self.observer, pixel_tangents(self.observer)[:, None] + of_pixel)
        )
        source_x = np.asarray(self.card.elements_x)[:, None, None] + of_strip
        theta_s, theta_o, weight = self._transported(wall_x, theta_o, reach, source_x, average)
        shape = (*theta_s.shape[:3], -1)
        theta_o = np.broadcast_to(theta_o, theta_s.shape)
        return theta_s.reshape(shape), theta_o.reshape(shape), np.ascontiguousarray(weight).reshape(shape)

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
        self, wall_x: Array, theta_o: Array, reach: Array, source_x: Array, average: Array
    ) -> tuple[Array, Array, Array]:
        """theta_s, theta_o and the weight at the nodes, times that of the quadrature."""
        card = self.card
        if self.weights != "physical" or card.is_points:
            theta_s = incident_angles(source_x, card.distance, wall_x)
            match self.weights:
                case "thesis":
                    return theta_s, theta_o, np.broadcast_to(average, theta_s.shape)
                case "cosine":
                    return theta_s, theta_o, average * np.cos(theta_s)
                case _:
                    return theta_s, theta_o, average * (np.cos(theta_s) ** 4 / card.distance**2)
        slope = (source_x - wall_x) / card.distance
        reaches = reach if self.half_pixel > 0 else None
        weight = mean_strip_factor(card.distance, slope, card.element_height / 2, reaches)
        weight *= card.element_width * average
        return np.arctan(slope, out=slope), theta_o, weight


def require_weights(weights: str) -> None:
    """Raise InputError unless these are weights."""
    if weights not in get_args(Weights):
        raise InputError(f'is "{weights}"; choose one of {", ".join(get_args(Weights))}', field="transport")


def _extent_in_angle(observer: Observer, card: Card, half_pixel: float, half_strip: float) -> tuple[float, float]:
    """What one pixel and one strip would span in u, in radians, if u ran everywhere as fast as where it is fastest.

    A chord from end to end would miss how u bends: under a near card it runs fast in the middle of a wide pixel, and
    fastest right below the element, which chords of parts that are wide against the card's distance would miss as well.
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
        theta_o = outgoing_angles(part, across)
        u = theta_o + incident_angles(sources, card.distance, across)
        pixel = max(pixel, _PARTS * float(np.abs(np.diff(u, axis=2)).max()))
        turn = _PARTS * float(np.abs(np.diff(theta_o, axis=2)).max())
        left, centre, right = (across[:, :, k] for k in (0, _PARTS // 2, _PARTS))
        pixel = max(pixel, turn + float(_fastest(sources - left, sources - right, card.distance).max()))
        strip = max(
            strip, float(_fastest(sources + half_strip - centre, sources - half_strip - centre, card.distance).max())
        )
        ends = (incident_angles(sources + half_strip * node, card.distance, centre) for node in parts)
        strip = max(strip, _PARTS * max(float((right - left).max()) for left, right in itertools.pairwise(ends)))
    return pixel, strip


def _fastest(one: Array, two: Array, distance: float) -> Array:
    """What atan(x / z) would span between x = one and two if it rose everywhere as fast as where it is steepest."""
    nearest = np.where(one * two > 0, np.minimum(np.abs(one), np.abs(two)), 0.0) / distance
    fastest: Array = np.abs(one - two) / distance / (1 + nearest * nearest)
    return fastest


def _blocks(views: int, pixels: int, elements: int) -> Iterator[tuple[slice, slice, slice]]:
    """Parts of (A, N, M) of about `_BLOCK` entries each, whole rows of pixels where they fit."""
    some_elements = min(elements, max(1, _BLOCK // _ROW))
    rest = max(1, _BLOCK // some_elements)
    some_views, some_pixels = max(1, rest // pixels), min(rest, pixels)
    steps = ((views, some_views), (pixels, some_pixels), (elements, some_elements))
    for a, j, i in itertools.product(*(range(0, size, step) for size, step in steps)):
        yield slice(a, a + some_views), slice(j, j + some_pixels), slice(i, i + some_elements)
