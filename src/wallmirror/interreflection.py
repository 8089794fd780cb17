"""The light that Hypothesis 2 leaves out: what a reflective card or a room sends back to the wall.

One bounce is all there is only if nothing but the wall reflects. Here the next bounces are computed from the known
geometry, the albedos of card and room, and a BRDF of the angle sum, so that the bias of a one-bounce solution can be
predicted before anybody believes it; the residual of the fit cannot show it.

Card and wall are parallel, so the angles depend on x alone and the integral over the wall's height closes. With
A, B the in-plane distances of two card points from a wall point, z the distance of the planes, d the card points'
difference in height, c = A + B (the wall taken as infinitely high):

    int z^2/(A^2 + h^2)^2 z^2/(B^2 + (h - d)^2)^2 dh = z^4 pi/(4 A^3 B^3) [ c/(c^2+d^2) + c (c^2-d^2)/(c^2+d^2)^2
                                                     + 2 A B (c^3 - 3 c d^2)/(c^2+d^2)^3 ].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two
from wallmirror.brdf import AngleSumBRDF, Mirror
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, outgoing_angles, pixel_tangents, wall_points
from wallmirror.scene import Room
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
    source = _checked_source(card, source)
    observer, card = _scaled(observer, card, power_of_two(card.distance))
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
    source = _checked_source(card, source)
    _, card = _scaled(None, card, power_of_two(card.distance))
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


def _checked_source(card: Card, source: ArrayLike) -> Array:
    """V as float64, (M, B), finite."""
    array = np.asarray(source, dtype=np.float64)
    if array.ndim != 2 or array.shape[0] != card.elements:
        raise InputError(
            f"has shape {array.shape}; give one row for each of the {card.elements} elements, (M, B)", field="source"
        )
    if not np.all(np.isfinite(array)):
        raise InputError("holds a value that is not finite", field="source")
    return array


def _scaled(observer: Observer | None, card: Card, unit: float) -> tuple[Any, Card]:
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


@dataclass(frozen=True)
class _Patches:
    """Diffuse patches of the room: centres (Q, 3), inward normals (Q, 3), areas (Q,)."""

    centre: Array
    normal: Array
    area: Array


def from_room(observer: Observer, card: Card, room: Room, brdf: AngleSumBRDF, source: Array) -> Array:
    """Radiance that reaches the camera over the room's surfaces and then the wall, (A, N, B); an estimate.

    Strips light the patches directly and over the wall; patches light each other (radiosity), directly and over the
    wall, and then the wall. The card casts no shadow here.

    Raises
    ------
    InputError
        For a source of another shape or that is not finite.
    """
    source = _checked_source(card, source)
    if room.albedo == 0:
        return np.zeros((observer.views, observer.pixels, source.shape[1]))
    unit = power_of_two(room.depth)
    strip_area = 1.0 / unit / unit if card.is_points else card.element_width / unit * (card.element_height / unit)
    observer, card = _scaled(observer, card, unit)
    room = replace(
        room, half_width=room.half_width / unit, half_height=room.half_height / unit, depth=room.depth / unit
    )
    patches = _room_patches(room)
    strips = np.stack([np.asarray(card.elements_x), np.full(card.elements, card.y), np.zeros(card.elements)], axis=1)
    lit = _exchange(patches, strips, np.array([0.0, 1.0, 0.0])) * strip_area
    lit = lit + _strips_over_wall(patches, strips, strip_area, room, brdf)
    among = _exchange(patches, patches.centre, patches.normal) * patches.area
    np.fill_diagonal(among, 0.0)
    among += _patches_over_wall(patches, room, brdf)
    back = room.albedo / math.pi
    glow = np.linalg.solve(np.eye(patches.area.size) - back * among, back * lit @ source)
    return _seen_over_wall(observer, patches, np.asarray(glow, dtype=np.float64), brdf)


def _room_patches(room: Room) -> _Patches:
    across, deep, high = 20, 12, 10
    x = ((np.arange(across) + 0.5) / across * 2 - 1) * room.half_width
    y = -(np.arange(deep) + 0.5) / deep * room.depth
    z = ((np.arange(high) + 0.5) / high * 2 - 1) * room.half_height
    centres, normals, areas = [], [], []
    for sign in (-1.0, 1.0):
        gx, gy = (g.ravel() for g in np.meshgrid(x, y, indexing="ij"))
        centres.append(np.stack([gx, gy, np.full(gx.size, sign * room.half_height)], axis=1))
        normals.append(np.tile([0.0, 0.0, -sign], (gx.size, 1)))
        areas.append(np.full(gx.size, 2 * room.half_width / across * room.depth / deep))
        gz, gy = (g.ravel() for g in np.meshgrid(z, y, indexing="ij"))
        centres.append(np.stack([np.full(gz.size, sign * room.half_width), gy, gz], axis=1))
        normals.append(np.tile([-sign, 0.0, 0.0], (gz.size, 1)))
        areas.append(np.full(gz.size, 2 * room.half_height / high * room.depth / deep))
    return _Patches(np.concatenate(centres), np.concatenate(normals), np.concatenate(areas))


def _exchange(patches: _Patches, points: Array, normals: Array) -> Array:
    """cos cos / r^2 from each point (S, 3) with its normal to each patch, (Q, S), in 1/m^2."""
    ray = points[None, :, :] - patches.centre[:, None, :]
    square = np.maximum(np.sum(ray * ray, axis=-1), 1e-12)
    at_patch = np.maximum(np.einsum("qsk,qk->qs", ray, patches.normal), 0.0)
    at_point = np.maximum(-np.sum(ray * np.broadcast_to(normals, points.shape)[None], axis=-1), 0.0)
    return np.asarray(at_patch * at_point / square**2, dtype=np.float64)


def _wall_cells(room: Room) -> tuple[Array, Array, float]:
    """Columns (X,) and rows (Z,) of the cells into which the room's wall is cut, and the area of one."""
    across, high = 160, 16
    x = ((np.arange(across) + 0.5) / across * 2 - 1) * room.half_width
    z = ((np.arange(high) + 0.5) / high * 2 - 1) * room.half_height
    return x, z, 4 * room.half_width * room.half_height / (across * high)


def _strips_over_wall(patches: _Patches, strips: Array, strip_area: float, room: Room, brdf: AngleSumBRDF) -> Array:
    """Irradiance at each patch per radiance of each strip over one reflection on the wall, (Q, M)."""
    x, z, cell = _wall_cells(room)
    gx, gz = (g.ravel() for g in np.meshgrid(x, z, indexing="ij"))
    wall = np.stack([gx, np.zeros(gx.size), gz], axis=1)
    to_patch = _exchange(patches, wall, np.array([0.0, -1.0, 0.0])) * cell
    theta_q = np.arctan2(patches.centre[:, None, 0] - gx, -patches.centre[:, None, 1])
    total = np.empty((patches.area.size, strips.shape[0]))
    for i, (x_s, y_s, z_s) in enumerate(strips):
        square = (x_s - gx) ** 2 + y_s**2 + (z_s - gz) ** 2
        irradiance = y_s**2 / square**2 * strip_area
        rho = brdf.of_sum(np.arctan2(x_s - gx, -y_s) + theta_q)
        total[:, i] = np.sum(to_patch * rho * irradiance, axis=1)
    return total


def _patches_over_wall(patches: _Patches, room: Room, brdf: AngleSumBRDF) -> Array:
    """Irradiance at each patch per radiance of each other patch over one reflection on the wall, (Q, Q)."""
    columns, z, cell = _wall_cells(room)
    # Patches above each other share their angle in the plane.
    places, place_of = np.unique(patches.centre[:, :2], axis=0, return_inverse=True)
    place_of = place_of.ravel()
    total = np.zeros((patches.area.size, patches.area.size))
    for x in columns:
        wall = np.stack([np.full(z.size, x), np.zeros(z.size), z], axis=1)
        exchange = _exchange(patches, wall, np.array([0.0, -1.0, 0.0]))
        theta = np.arctan2(places[:, 0] - x, -places[:, 1])
        rho = brdf.of_sum(theta[:, None] + theta[None, :])
        total += (exchange @ exchange.T) * rho[place_of[:, None], place_of[None, :]]
    return np.asarray(total * cell * patches.area, dtype=np.float64)


def _seen_over_wall(observer: Observer, patches: _Patches, glow: Array, brdf: AngleSumBRDF) -> Array:
    """Radiance of the wall lit by glowing patches (Q, B), (A, N, B); smooth, so computed on every tenth pixel."""
    count = max(2, observer.pixels // 10)
    t = pixel_tangents(observer)
    coarse = np.linspace(t[0], t[-1], count)
    x = wall_points(replace(observer, pixels_at="centres"), coarse)
    theta_o = outgoing_angles(observer, x)
    seen = np.empty((observer.views, count, glow.shape[1]))
    centre = patches.centre
    for a in range(observer.views):
        dx = centre[:, 0] - x[a][:, None]
        square = dx**2 + centre[:, 1] ** 2 + centre[:, 2] ** 2
        wall_point = np.stack([x[a], np.zeros(count), np.zeros(count)], axis=1)
        facing = np.maximum(np.einsum("nqk,qk->nq", wall_point[:, None, :] - centre, patches.normal), 0.0)
        theta_s = np.arctan2(dx, -centre[:, 1])
        rho = brdf.of_sum(theta_s + theta_o[a][:, None])
        seen[a] = (rho * -centre[:, 1] * facing / square**2 * patches.area) @ glow
    result = np.empty((observer.views, observer.pixels, glow.shape[1]))
    for a in range(observer.views):
        for b in range(glow.shape[1]):
            result[a, :, b] = np.interp(t, coarse, seen[a, :, b])
    return result
