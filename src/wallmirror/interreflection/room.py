"""What the room about a wall sends to it: diffuse patches that light each other, directly and over the wall."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.arithmetic import power_of_two
from wallmirror.brdf import AngleSumBRDF
from wallmirror.geometry import Card, Observer, outgoing_angles, pixel_tangents, wall_points
from wallmirror.interreflection.lengths import checked_source, scaled
from wallmirror.scene import Room

Array = NDArray[np.float64]


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
    source = checked_source(card, source)
    if room.albedo == 0:
        return np.zeros((observer.views, observer.pixels, source.shape[1]))
    unit = power_of_two(room.depth)
    strip_area = 1.0 / unit / unit if card.is_points else card.element_width / unit * (card.element_height / unit)
    observer, card = scaled(observer, card, unit)
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
