"""What a reflective card sends back to the wall, and to its own image in a mirror.

Card and wall are parallel, so the angles depend on x alone and the integral over the wall's height closes. With
A, B the in-plane distances of two card points from a wall point, z the distance of the planes, d the card points'
difference in height, c = A + B (the wall taken as infinitely high):

    int z^2/(A^2 + h^2)^2 z^2/(B^2 + (h - d)^2)^2 dh = z^4 pi/(4 A^3 B^3) [ c/(c^2+d^2) + c (c^2-d^2)/(c^2+d^2)^2
                                                     + 2 A B (c^3 - 3 c d^2)/(c^2+d^2)^3 ].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.arithmetic import power_of_two
from wallmirror.brdf import AngleSumBRDF, Mirror
from wallmirror.geometry import Card, Observer
from wallmirror.interreflection.lengths import checked_source, scaled
from wallmirror.transport import build_kernel, strip_factor

Array = NDArray[np.float64]

# Nodes on the card: at least, per distance from the wall (over which the board's glow varies), and at most.
_COLUMNS = (24, 2, 64)
_ROWS = (8, 2, 24)
_WALL_NODES = 1500
_STRIP_NODES = 4


def from_card(observer: Observer, card: Card, brdf: AngleSumBRDF, source: Array) -> Array:
    """Radiance that the camera receives from light that the card has reflected at least once, (A, N, B).

    Parameters
    ----------
    card:
        With albedo and board; strips stand on the board.
    brdf:
        In 1/sr, its absolute scale counts here.
    source:
        V, shape (M, B).

    Raises
    ------
    InputError
        For a source of another shape or that is not finite.
    """
    source = checked_source(card, source)
    observer, card = scaled(observer, card, power_of_two(card.distance))
    nodes = _card_nodes(card)
    shape = (observer.views, observer.pixels, source.shape[1])
    if card.albedo == 0 or nodes is None:
        return np.zeros(shape)
    x, h, area = nodes.x, nodes.h, nodes.area
    strips = np.asarray(card.elements_x)
    strip_area = card.element_width * card.element_height
    # Irradiance at node q per radiance of source s, both through one reflection on the wall.
    among = _through_wall(x, h, x, h, card.distance, brdf) * area
    from_strips = _through_wall(x, h, strips, np.zeros(strips.size), card.distance, brdf) * strip_area
    back = card.albedo / math.pi
    reflected = np.linalg.solve(np.eye(x.size) - back * among, back * from_strips @ source)
    height = nodes.height
    board = Card(
        elements_x=tuple(nodes.columns), y=card.y, element_width=nodes.pitch * (1 - 1e-9), element_height=height
    )
    # A glowing board blurs whatever is finer than its columns.
    scale = max(brdf.angular_scale, math.atan(nodes.pitch / card.distance) / 4)
    kernel = build_kernel(observer, board, resolution=scale, tolerance=1e-2)
    a = card.distance / np.cos(kernel.theta_s)
    flat = kernel.weight * brdf.of_sum(kernel.angle_sum)
    flat /= strip_factor(card.distance, card.distance * np.tan(kernel.theta_s), -height / 2, height / 2)
    glow = reflected.reshape(nodes.columns.size, nodes.rows.size, -1)
    seen = np.zeros(shape)
    for row, (at, share) in enumerate(zip(nodes.rows, nodes.shares, strict=True)):
        # The board's glow fades with height, and so does what it sends to the wall's middle: each row by itself.
        factor = share * height * card.distance**2 / (a * a + at**2) ** 2
        seen += np.sum(flat * factor, axis=-1) @ glow[:, row]
    return seen


def glow_in_mirror(card: Card, mirror: Mirror, source: Array) -> Array:
    """Radiance that each strip of a reflective card sends beyond its own, lit by the card's image in a mirror, (M, B).

    The mirror shows the card to itself at twice its distance, z' = 2 z, so that with R its reflectance the Lambertian
    card's glow is L = (albedo / pi) R int (V + L) z'^2 / r^4 dA.

    Parameters
    ----------
    source:
        V, shape (M, B).

    Raises
    ------
    InputError
        For a source of another shape or that is not finite.
    """
    source = checked_source(card, source)
    _, card = scaled(None, card, power_of_two(card.distance))
    nodes = _card_nodes(card)
    if card.albedo == 0 or nodes is None:
        return np.zeros(source.shape)
    twice = 2 * card.distance

    def lit(x_q: Array, h_q: Array, x_s: Array, h_s: Array, area: Array) -> Array:
        r_squared = (x_q[:, None] - x_s) ** 2 + (h_q[:, None] - h_s) ** 2 + twice**2
        factor: Array = card.albedo / math.pi * mirror.reflectance * twice**2 / r_squared**2 * area
        return factor

    strips = np.asarray(card.elements_x)
    at, shares = np.polynomial.legendre.leggauss(_STRIP_NODES)
    across, up = (g.ravel() for g in np.meshgrid(at, at, indexing="ij"))
    strip_x = (strips[:, None] + across * card.element_width / 2).ravel()
    strip_h = np.tile(up * card.element_height / 2, strips.size)
    strip_area = np.tile(np.outer(shares, shares).ravel() / 4, strips.size) * card.element_width * card.element_height
    emitted = np.repeat(source, at.size**2, axis=0)
    x, h, area = nodes.x, nodes.h, nodes.area
    board = np.linalg.solve(np.eye(x.size) - lit(x, h, x, h, area), lit(x, h, strip_x, strip_h, strip_area) @ emitted)
    # The camera's row of pixels sees the strips at z = 0, over all of their width.
    seen_x = (strips[:, None] + at * card.element_width / 2).ravel()
    level = np.zeros(seen_x.size)
    glow = lit(seen_x, level, strip_x, strip_h, strip_area) @ emitted + lit(seen_x, level, x, h, area) @ board
    return np.asarray(np.tensordot(shares / 2, glow.reshape(strips.size, at.size, -1), axes=(0, 1)), dtype=np.float64)


@dataclass(frozen=True)
class _CardNodes:
    """Quadrature over the card's face: midpoints in columns of one pitch, Gauss-Legendre in rows (heights, shares)."""

    columns: Array
    pitch: float
    rows: Array
    shares: Array
    height: float

    @property
    def x(self) -> Array:
        return np.repeat(self.columns, self.rows.size)

    @property
    def h(self) -> Array:
        return np.tile(self.rows, self.columns.size)

    @property
    def area(self) -> Array:
        return self.pitch * self.height * np.tile(self.shares, self.columns.size)


def _card_nodes(card: Card) -> _CardNodes | None:
    """Nodes on the board, or on the strips' outline where there is none; None for a card without extent."""
    width = card.board_width or (max(card.elements_x) - min(card.elements_x) + card.element_width)
    height = card.board_height or card.element_height
    if card.is_points or width <= 0 or height <= 0:
        return None
    across, high = _nodes(_COLUMNS, width / card.distance), _nodes(_ROWS, height / card.distance)
    pitch = width / across
    nodes, shares = np.polynomial.legendre.leggauss(high)
    columns: Array = card.middle + (np.arange(across, dtype=np.float64) + 0.5) * pitch - width / 2
    return _CardNodes(columns, pitch, nodes * height / 2, shares / 2, height)


def _nodes(rule: tuple[int, int, int], distances: float) -> int:
    least, per_distance, most = rule
    return min(most, max(least, math.ceil(per_distance * distances)))


def _through_wall(x_q: Array, h_q: Array, x_s: Array, h_s: Array, z: float, brdf: AngleSumBRDF) -> Array:
    """int rho cos^2 cos^2 / (r^2 r^2) dA over the wall for each pair of card points, (Q, S), in 1/m^2."""
    edges = np.linspace(-math.pi / 2, math.pi / 2, _WALL_NODES + 1)
    phi = 0.5 * (edges[1:] + edges[:-1])
    step = z / np.cos(phi) ** 2 * (edges[1] - edges[0])
    # The wall has no end and the angles' sum no order: only distances count.
    apart, x_of = np.unique(np.abs(x_q[:, None] - x_s[None, :]).round(12), return_inverse=True)
    heights, d_of = np.unique(np.abs(h_q[:, None] - h_s[None, :]).round(12), return_inverse=True)
    left = -apart[:, None] / 2 - z * np.tan(phi)
    right = apart[:, None] / 2 - z * np.tan(phi)
    a, b = np.hypot(z, left), np.hypot(z, right)
    weight = brdf.of_sum(np.arctan(left / z) + np.arctan(right / z)) * step * z**4 * math.pi / (4 * a**3 * b**3)
    c = a + b
    table = np.empty((apart.size, heights.size))
    for k, d in enumerate(heights):
        s = c * c + d * d
        bracket = c / s + c * (c * c - d * d) / s**2 + 2 * a * b * (c**3 - 3 * c * d * d) / s**3
        table[:, k] = np.sum(weight * bracket, axis=-1)
    pairs = (x_q.size, x_s.size)
    return np.asarray(table[x_of.reshape(pairs), d_of.reshape(pairs)], dtype=np.float64)
