"""View factors of a closed box about the wall: parallel and perpendicular faces against forms that are not ours.

A wall element inside a box sees nothing but its five other faces, so their view factors sum to 1. The far face is a card
(`transport_matrix`), the four faces at right angles to the wall are the room of `interreflection`. References are the
closed forms of Howell's catalogue of radiation configuration factors (section B, plane element to a parallel rectangle,
and to a rectangle in a plane at 90 deg; also Siegel and Howell, Thermal Radiation Heat Transfer, appendix) and, with no
formula in common, Lambert's sum over the edges of a polygon (Photometria, 1760).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.brdf import Diffuse
from wallmirror.geometry import Card, Observer, wall_points
from wallmirror.interreflection.room import _exchange, _Patches, _room_patches, _seen_over_wall
from wallmirror.scene import Room
from wallmirror.transport import transport_matrix

Array = NDArray[np.float64]

ROOM = Room(half_width=2.0, half_height=1.5, depth=3.0, albedo=0.5)
WALL_NORMAL = np.array([0.0, -1.0, 0.0])
#: Points of the wall, (x, z), one near a corner.
POINTS = [(0.0, 0.0), (0.7, -0.4), (-1.3, 0.0), (1.9, 1.4)]


def parallel_corner(a: float, b: float, c: float) -> float:
    """From an element to a parallel rectangle a x b at distance c, a corner of it on the element's normal."""
    x, y = a / c, b / c
    p, q = math.hypot(1, x), math.hypot(1, y)
    return (x / p * math.atan(y / p) + y / q * math.atan(x / q)) / (2 * math.pi)


def perpendicular_corner(a: float, b: float, c: float) -> float:
    """From an element to a rectangle a high (along its normal) and b long, at right angles and at distance c.

    The rectangle stands on the element's plane, one upright edge at the foot of the perpendicular.
    """
    if b == 0:
        return 0.0
    x, y = a / b, c / b
    s = math.hypot(x, y)
    return (math.atan(1 / y) - y / s * math.atan(1 / s)) / (2 * math.pi)


def far_face(x: float, z: float, room: Room = ROOM) -> float:
    """View factor of the face opposite the wall, the sum over the four quarters about the element's normal."""
    widths = (room.half_width - x, room.half_width + x)
    heights = (room.half_height - z, room.half_height + z)
    return sum(parallel_corner(w, h, room.depth) for w in widths for h in heights)


def upright_faces(x: float, z: float, room: Room = ROOM) -> dict[str, float]:
    """View factors of the four faces at right angles to the wall."""
    left, right = room.half_width + x, room.half_width - x
    below, above = room.half_height + z, room.half_height - z

    def face(distance: float, ends: tuple[float, float]) -> float:
        return sum(perpendicular_corner(room.depth, end, distance) for end in ends)

    return {
        "ceiling": face(above, (left, right)),
        "floor": face(below, (left, right)),
        "right": face(right, (below, above)),
        "left": face(left, (below, above)),
    }


def corners(face: str, room: Room = ROOM) -> Array:
    """The corners (4, 3) of a face of the box, in order about it."""
    w, h, d = room.half_width, room.half_height, -room.depth
    return np.array(
        {
            "ceiling": [(-w, 0, h), (w, 0, h), (w, d, h), (-w, d, h)],
            "floor": [(-w, 0, -h), (w, 0, -h), (w, d, -h), (-w, d, -h)],
            "right": [(w, 0, -h), (w, 0, h), (w, d, h), (w, d, -h)],
            "left": [(-w, 0, -h), (-w, 0, h), (-w, d, h), (-w, d, -h)],
            "far": [(-w, d, -h), (w, d, -h), (w, d, h), (-w, d, h)],
        }[face],
        dtype=float,
    )


def lambert(point: Array, normal: Array, polygon: Array) -> float:
    """Lambert's view factor of a polygon: half the sum over its edges of the angle seen times the tilt, over pi."""
    rays = polygon - point
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    total = 0.0
    for first, second in zip(rays, np.roll(rays, -1, axis=0)):
        across = np.cross(first, second)
        length = float(np.linalg.norm(across))
        total += math.atan2(length, float(first @ second)) * float(across @ normal) / length
    return abs(total) / (2 * math.pi)


def nodes_of(face: str, order: int = 60) -> tuple[Array, Array]:
    """Gauss-Legendre nodes of a face (order^2, 3) and the areas that they stand for."""
    nodes, shares = np.polynomial.legendre.leggauss(order)
    start, along, _, up = corners(face)
    along, up = along - start, up - start
    u, v = (g.ravel() for g in np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2, indexing="ij"))
    area = np.outer(shares, shares).ravel() / 4 * np.linalg.norm(np.cross(along, up))
    return start + u[:, None] * along + v[:, None] * up, area


def our_face(point: Array, face: str) -> tuple[Array, Array, Array]:
    """View factors of a face's nodes by `_exchange`, their distances from the wall point, and the wall's cosines."""
    place, area = nodes_of(face)
    inwards = {
        "ceiling": (0, 0, -1),
        "floor": (0, 0, 1),
        "right": (-1, 0, 0),
        "left": (1, 0, 0),
        "far": (0, 1, 0),
    }[face]
    patches = _Patches(place, np.tile(np.array(inwards, dtype=float), (area.size, 1)), area)
    weight = _exchange(patches, point[None], WALL_NORMAL)[:, 0] * area / math.pi
    length = np.linalg.norm(place - point, axis=1)
    return np.asarray(weight), length, (place - point) @ WALL_NORMAL / length


# -- the references among themselves --------------------------------------------------------------------------


def test_the_closed_forms_are_the_published_numbers() -> None:
    """Means over strip elements along one edge, with four digits, from the manual of the EES heat-transfer library."""
    nodes, shares = np.polynomial.legendre.leggauss(40)
    x = nodes + 1  # b = 2
    parallel = sum(s / 2 * (parallel_corner(3, t, 0.5) + parallel_corner(3, 2 - t, 0.5)) for t, s in zip(x, shares))
    upright = sum(
        s / 2 * (perpendicular_corner(1, t, 0.5) + perpendicular_corner(1, 2 - t, 0.5)) for t, s in zip(x, shares)
    )
    assert parallel == pytest.approx(0.3886, abs=5e-5)
    assert upright == pytest.approx(0.2153, abs=5e-5)


def test_the_closed_forms_are_the_definition_integrated() -> None:
    with mpmath.workdps(20):
        a, b, c = mpmath.mpf(3) / 2, mpmath.mpf(2) / 3, mpmath.mpf(4) / 5
        parallel = mpmath.quad(lambda u, v: c**2 / (c**2 + u**2 + v**2) ** 2, [0, a], [0, b]) / mpmath.pi
        # cos at the element: height over the ray; cos at the rectangle: c over the ray.
        upright = mpmath.quad(lambda h, v: h * c / (c**2 + h**2 + v**2) ** 2, [0, a], [0, b]) / mpmath.pi
    assert parallel_corner(1.5, 2 / 3, 0.8) == pytest.approx(float(parallel), rel=1e-13)
    assert perpendicular_corner(1.5, 2 / 3, 0.8) == pytest.approx(float(upright), rel=1e-13)


@pytest.mark.parametrize(("x", "z"), POINTS)
def test_the_closed_forms_fill_the_hemisphere_and_are_lamberts(x: float, z: float) -> None:
    found = upright_faces(x, z) | {"far": far_face(x, z)}
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-14)
    for face, value in found.items():
        # Up to the angles' rounding; a polygon that touches the element's plane needs no clipping.
        assert value == pytest.approx(lambert(np.array([x, 0.0, z]), WALL_NORMAL, corners(face)), abs=1e-14)


# -- our code against them ------------------------------------------------------------------------------------


@pytest.mark.parametrize("face", ["ceiling", "floor", "right", "left", "far"])
@pytest.mark.parametrize(("x", "z"), POINTS[:3])
def test_the_exchange_of_a_wall_point_with_a_face_is_its_view_factor(face: str, x: float, z: float) -> None:
    expected = far_face(x, z) if face == "far" else upright_faces(x, z)[face]
    weight, length, at_wall = our_face(np.array([x, 0.0, z]), face)
    # 60 nodes each way; the nearest face is a quarter of its half length away, where they reach 1e-12.
    assert weight.sum() == pytest.approx(expected, rel=1e-11)
    # The twins: 1/r for 1/r^2, and the wall's cosine left out.
    for wrong in (weight * length, weight / at_wall):
        assert abs(wrong.sum() / expected - 1) > 0.05


def test_the_exchange_is_blind_behind_a_surface() -> None:
    outwards = _Patches(np.array([[0.0, -1.0, 1.5]]), np.array([[0.0, 0.0, 1.0]]), np.array([1.0]))
    assert _exchange(outwards, np.zeros((1, 3)), WALL_NORMAL)[0, 0] == 0.0
    inwards = replace(outwards, normal=-outwards.normal)
    assert _exchange(inwards, np.zeros((1, 3)), -WALL_NORMAL)[0, 0] == 0.0
    assert _exchange(inwards, np.zeros((1, 3)), WALL_NORMAL)[0, 0] == pytest.approx(1.5 / 3.25**2, rel=1e-14)


# A camera whose tenth pixels, the ones that are computed, lie in the middle half of the wall.
CAMERA = Observer(position=(0.3, -2.0), fov=math.radians(40), view_angles=(0.15, -0.1), pixels=21, pixels_at="edges")


def room_seen(patches: _Patches, observer: Observer = CAMERA) -> Array:
    """Radiance of a white wall in a room whose four upright faces glow with 1, at the ends of each view, (A, 2)."""
    return _seen_over_wall(observer, patches, np.ones((patches.area.size, 1)), Diffuse(albedo=1.0))[:, [0, -1], 0]


def midpoint_excess(x: Array) -> Array:
    """What one point in the middle of each patch adds to the view factors of the four faces, to leading order.

    Euler and Maclaurin: a midpoint rule of step h is off by -h^2/24 times the difference of the integrand's slope at the
    two ends. The slope that counts is that across the edge where a face meets the wall, c / (pi (c^2 + v^2)^2) at
    distance c from the element; over a long edge it integrates to 1 / (2 c^2), so a face adds h^2 / (48 c^2).
    """
    step = ROOM.depth / 12
    squares = sum(1 / c**2 for c in (ROOM.half_width - x, ROOM.half_width + x, ROOM.half_height, ROOM.half_height))
    return np.asarray(step**2 / 48 * squares)


def test_the_room_sends_the_view_factors_of_its_faces() -> None:
    x = wall_points(CAMERA)[:, [0, -1]]
    expected = np.vectorize(lambda p: sum(upright_faces(float(p), 0.0).values()))(x)
    found = room_seen(_room_patches(ROOM))
    # Within 0.6 %, and the excess is that of points for patches; other edges and higher orders add a third at most.
    np.testing.assert_allclose(found - expected, midpoint_excess(x), rtol=0.35)
    assert np.max(found / expected - 1) < 6e-3
    # The twins, on the same patches: the wall's cosine left out, and 1/r for 1/r^2.
    patches = _room_patches(ROOM)
    for a, k in np.ndindex(x.shape):
        point = np.array([x[a, k], 0.0, 0.0])
        ray = patches.centre - point
        length = np.linalg.norm(ray, axis=1)
        weight = _exchange(patches, point[None], WALL_NORMAL)[:, 0] * patches.area / math.pi
        assert weight.sum() == pytest.approx(found[a, k], rel=1e-12)
        for wrong in (weight * length, weight * length / -ray[:, 1]):
            assert abs(wrong.sum() / expected[a, k] - 1) > 0.1


def test_finer_patches_converge_to_the_closed_form_with_order_two() -> None:
    """The patches as `_room_patches` cuts them, quartered twice: nothing else than the rule is wrong with them."""
    x = wall_points(CAMERA)[:, [0, -1]]
    expected = np.vectorize(lambda p: sum(upright_faces(float(p), 0.0).values()))(x)
    patches, errors = _room_patches(ROOM), []
    for _ in range(3):
        errors.append(float(np.max(np.abs(room_seen(patches) - expected))))
        patches = _quartered(patches)
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert orders == pytest.approx([2.0, 2.0], abs=0.15)


def _quartered(patches: _Patches) -> _Patches:
    """Each patch as four; all are rectangles of the grid, so their sides follow from the next patches' places."""
    places = []
    for normal in np.unique(patches.normal, axis=0):
        mine = np.all(patches.normal == normal, axis=1)
        centre = patches.centre[mine]
        half = np.array(
            [
                (steps[1] - steps[0]) / 4 if (steps := np.unique(column.round(9))).size > 1 else 0.0
                for column in centre.T
            ]
        )
        axes = np.flatnonzero(half)
        for signs in itertools.product((-1, 1), repeat=2):
            shift = np.zeros(3)
            shift[axes] = half[axes] * signs
            places.append((centre + shift, patches.normal[mine], patches.area[mine] / 4))
    return _Patches(*(np.concatenate(parts) for parts in zip(*places)))


def test_a_white_box_is_closed() -> None:
    """Two modules that share no kernel, card and room, together leave no gap and no overlap."""
    x = wall_points(CAMERA)[:, [0, -1]]
    width, height = 2 * ROOM.half_width, 2 * ROOM.half_height
    card = Card(elements_x=(0.0,), y=-ROOM.depth, element_width=width, element_height=height)
    far = transport_matrix(CAMERA, card, Diffuse(albedo=1.0), tolerance=1e-9)[:, [0, -1], 0]
    room = room_seen(_room_patches(ROOM))
    # The card is right to 1e-9; the room is too bright by what its patches cost.
    np.testing.assert_allclose(far + room - 1, midpoint_excess(x), rtol=0.35)
    assert np.max(far + room - 1) < 6e-3
    assert np.all((far > 0.2) & (room > 0.2))
    # The twins: a card whose kernel lacks a cosine or one power of the distance opens or overfills the box.
    for a, k in np.ndindex(x.shape):
        weight, length, at_wall = our_face(np.array([x[a, k], 0.0, 0.0]), "far")
        assert far[a, k] == pytest.approx(weight.sum(), abs=2e-9)
        for wrong in (weight / at_wall, weight * length):
            assert abs(wrong.sum() + room[a, k] - 1) > 4 * 6e-3
