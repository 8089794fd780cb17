"""Where a camera looks and at which angles: the thesis's conventions, shown by constructions of our own."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wallmirror.geometry import (
    Card,
    Observer,
    incident_angles,
    outgoing_angles,
    pixel_half_width,
    pixel_tangents,
    scan_angles,
    wall_points,
)

from .helpers import EPS, refused, same_examples, thesis_observer

OBSERVER = {"position": (0.0, -5.0), "fov": math.radians(60), "view_angles": (0.0,), "pixels": 4}
CARD = {"elements_x": (-1.0, 0.0, 1.0), "y": -1.0}


def observer(**changes: Any) -> Observer:
    return Observer(**{**OBSERVER, **changes})


def card(**changes: Any) -> Card:
    return Card(**{**CARD, **changes})


# -- where a view looks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle_deg", "x"), [(45.0, -5.0), (-45.0, 5.0), (0.0, 0.0)])
def test_a_positive_angle_looks_towards_negative_x(angle_deg: float, x: float) -> None:
    view = observer(view_angles=(math.radians(angle_deg),), fov=math.radians(10))
    # tan(pi/4) is right to one rounding, times 5 m.
    assert wall_points(view, 0.0).item() == pytest.approx(x, abs=5 * 2 * EPS)


def test_first_and_last_view_of_the_thesis_scan_cover_the_stated_walls() -> None:
    x = wall_points(thesis_observer())
    # tan 15 deg = 2 - sqrt(3): the ends are -5 and 5 tan 15 deg = 1.3397 m. Some roundings of tan, atan at 5 m.
    inner = 5 * (2 - math.sqrt(3))
    np.testing.assert_allclose([x[0, 0], x[0, -1]], [-5.0, inner], rtol=0, atol=5 * 8 * EPS)
    np.testing.assert_allclose([x[-1, 0], x[-1, -1]], [-inner, 5.0], rtol=0, atol=5 * 8 * EPS)
    assert round(inner, 4) == 1.3397


def test_x_grows_along_every_view_and_from_view_to_view() -> None:
    x = wall_points(thesis_observer())
    assert x.shape == (20, 500)
    assert np.all(np.diff(x, axis=1) > 0)
    assert np.all(np.diff(x, axis=0) > 0)


@same_examples
@given(
    angle=st.floats(-0.9, 0.9),
    tangent=st.floats(-0.55, 0.55),
    place=st.tuples(st.floats(-10, 10), st.floats(-10, -0.1)),
)
def test_wall_point_is_where_a_ray_of_a_turned_pinhole_meets_the_wall(
    angle: float, tangent: float, place: tuple[float, float]
) -> None:
    # The camera turns: its axis and its image plane's direction are (0, 1) and (1, 0) rotated by the view's angle.
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    ray = turn @ [tangent, 1.0]
    hit = np.array(place) + ray * (-place[1] / ray[1])
    x = wall_points(observer(position=place, view_angles=(angle,)), tangent).item()
    # Roundings of an angle are magnified by 1/cos^2 of the ray's angle, at most 1/cos(0.9 + atan 0.55)^2 < 50.
    assert x == pytest.approx(hit[0], abs=50 * 4 * EPS * (1 + np.abs(place).max()))


def test_a_turn_the_other_way_would_be_seen() -> None:
    x = wall_points(observer(view_angles=(0.3,)), 0.2).item()
    wrong = 0.0 + -5.0 * math.tan(0.3 + math.atan(0.2))
    assert abs(x - wrong) > 1.0


def test_scan_falls_from_one_edge_to_the_other() -> None:
    angles = np.degrees(scan_angles(20, scan=math.radians(90), fov=math.radians(60)))
    np.testing.assert_allclose(angles, 15 - 30 * np.arange(20) / 19, rtol=0, atol=15 * 8 * EPS)


def test_a_single_view_looks_straight_at_the_wall() -> None:
    # Not at MATLAB's linspace(a, b, 1) = b, which made the thesis's A = 1 the last window.
    assert scan_angles(1, scan=math.radians(90), fov=math.radians(60)) == (0.0,)


def test_a_scan_no_wider_than_the_field_never_turns() -> None:
    assert scan_angles(3, scan=1.0, fov=1.0) == (0.0, 0.0, 0.0)


# -- pixels ---------------------------------------------------------------------------------------------------


def test_edges_run_from_edge_to_edge_as_points() -> None:
    view = observer(pixels=5, pixels_at="edges")
    half = math.tan(math.radians(30))
    np.testing.assert_allclose(pixel_tangents(view), half * np.array([-1, -0.5, 0, 0.5, 1]), rtol=4 * EPS)
    assert pixel_half_width(view) == 0.0


def test_centres_have_footprints_that_tile_the_field() -> None:
    view = observer(pixels=7)
    t, half = pixel_tangents(view), pixel_half_width(view)
    edge = math.tan(math.radians(30))
    assert t[0] - half == pytest.approx(-edge, rel=8 * EPS)
    assert t[-1] + half == pytest.approx(edge, rel=8 * EPS)
    np.testing.assert_allclose(t[1:] - half, t[:-1] + half, rtol=0, atol=8 * EPS)


def test_centres_and_edges_differ_by_half_a_pixel_at_the_ends() -> None:
    # The twin of the two tests above: taking one placement for the other moves the first sample by half a pixel.
    centres, edges = pixel_tangents(observer(pixels=7)), pixel_tangents(observer(pixels=7, pixels_at="edges"))
    assert centres[0] - edges[0] == pytest.approx(pixel_half_width(observer(pixels=7)), rel=16 * EPS)
    assert centres[3] == edges[3] == 0.0


def test_one_pixel_looks_along_the_axis() -> None:
    np.testing.assert_array_equal(pixel_tangents(observer(pixels=1)), [0.0])


def test_wall_points_take_tangents_of_any_shape() -> None:
    view = observer(view_angles=(0.1, -0.1))
    t = np.array([[-0.2, 0.0, 0.2], [0.1, 0.3, 0.4]])
    x = wall_points(view, t)
    assert x.shape == (2, 2, 3)
    np.testing.assert_array_equal(x[1, 0], wall_points(view, t[0])[1])


# -- angles ---------------------------------------------------------------------------------------------------


@same_examples
@given(
    source=st.tuples(st.floats(-10, 10), st.floats(-20, -0.01)),
    eye=st.tuples(st.floats(-10, 10), st.floats(-20, -0.01)),
)
def test_specular_reflection_is_where_the_angles_sum_to_zero(
    source: tuple[float, float], eye: tuple[float, float]
) -> None:
    # The mirror image of the source lies behind the wall, at -y; the straight line from it to the eye crosses y = 0 at
    # the mirror point, whatever the signs of our angles may be.
    share = -source[1] / (-source[1] - eye[1])
    x = source[0] + share * (eye[0] - source[0])
    view = observer(position=eye)
    theta_s, theta_o = incident_angles(source[0], -source[1], x), outgoing_angles(view, x)
    # x carries a rounding of its size, 10 EPS, and an angle turns by at most 1 / 0.01 per metre.
    assert float(theta_s + theta_o) == pytest.approx(0.0, abs=100 * 40 * EPS)


def test_away_from_the_mirror_point_the_angle_sum_is_not_zero() -> None:
    # Eye and source one metre apart at distance 1: the mirror point is x = 0.5. The twin: off it, and with the
    # difference of the angles that Hypothesis 8 writes, the sum that should vanish does not.
    view = observer(position=(1.0, -1.0))
    both = lambda x: (float(incident_angles(0.0, 1.0, x)), float(outgoing_angles(view, x)))  # noqa: E731
    theta_s, theta_o = both(0.5)
    assert theta_s + theta_o == 0.0
    assert abs(theta_s - theta_o) == pytest.approx(2 * math.atan(0.5), rel=4 * EPS)
    assert abs(sum(both(0.51))) > 0.01


def test_angles_are_signed_towards_growing_x() -> None:
    assert incident_angles(1.0, 1.0, 0.0) == pytest.approx(math.pi / 4, rel=2 * EPS)
    assert incident_angles(-1.0, 1.0, 0.0) == pytest.approx(-math.pi / 4, rel=2 * EPS)
    assert outgoing_angles(observer(position=(5.0, -5.0)), 0.0) == pytest.approx(math.pi / 4, rel=2 * EPS)


def test_the_angle_to_the_observer_is_the_angle_of_the_view() -> None:
    # The ray that leaves the camera at +30 deg comes back to it at +30 deg from the wall's normal.
    view = observer(view_angles=(math.radians(30),), fov=math.radians(20))
    theta_o = outgoing_angles(view, wall_points(view, 0.0))
    np.testing.assert_allclose(np.degrees(theta_o), 30.0, rtol=8 * EPS)


@pytest.mark.parametrize("distance", [5e-324, 1e-300, 1e300])
def test_extreme_distances_give_finite_angles(distance: float) -> None:
    theta = incident_angles(np.array([-1.0, 0.0, 1.0]), distance, 0.0)
    assert np.all(np.isfinite(theta))
    assert np.all(np.abs(theta) <= math.pi / 2)
    assert theta[1] == 0.0


# -- refusals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "field", "words"),
    [
        ({"position": (0.0, 0.0)}, "observer.position", "on or behind the wall"),
        ({"position": (0.0, 5.0)}, "observer.position", "on or behind the wall (y = 5)"),
        ({"position": (math.nan, -5.0)}, "observer.position", "finite"),
        ({"position": (0.0, -math.inf)}, "observer.position", "finite"),
        ({"fov": 0.0}, "observer.fov_deg", "not between 0 and 180"),
        ({"fov": -1.0}, "observer.fov_deg", "not between 0 and 180"),
        ({"fov": math.pi}, "observer.fov_deg", "180 deg is not between 0 and 180"),
        ({"fov": math.nan}, "observer.fov_deg", "not between 0 and 180"),
        ({"pixels": 0}, "observer.pixels", "at least one pixel"),
        ({"pixels": -3}, "observer.pixels", "at least one pixel"),
        ({"pixels": 1, "pixels_at": "edges"}, "observer.pixels", "at least two pixels"),
        ({"pixels_at": "corners"}, "observer.pixels_at", '"centres" or "edges"'),
        ({"view_angles": ()}, "observer.view_angles_deg", "names no view"),
        ({"view_angles": (0.0, math.nan)}, "observer.view_angles_deg", "finite"),
        ({"view_angles": (0.0, math.radians(60))}, "observer.view_angles_deg", "horizon"),
        ({"view_angles": (math.radians(-61),)}, "observer.view_angles_deg", "view at -61 deg"),
    ],
)
def test_observer_refuses(changes: dict[str, Any], field: str, words: str) -> None:
    error = refused(lambda: observer(**changes))
    assert error.field == field
    assert words in error.message


@pytest.mark.parametrize(
    ("changes", "field", "words"),
    [
        ({"elements_x": ()}, "card.elements_x", "names no element"),
        ({"elements_x": (0.0, math.inf)}, "card.elements_x", "finite"),
        ({"y": 0.0}, "card.y", "on or behind the wall"),
        ({"y": 2.0}, "card.y", "y = 2"),
        ({"y": math.nan}, "card.y", "finite"),
        ({"element_width": -0.1}, "card.element_width", "length >= 0"),
        ({"element_height": math.nan}, "card.element_height", "length >= 0"),
        ({"board_width": math.inf}, "card.board_width", "length >= 0"),
        ({"board_height": -1.0}, "card.board_height", "length >= 0"),
        ({"element_width": 0.1}, "card.element_height", "both a width and a height"),
        ({"element_height": 0.1}, "card.element_width", "both a width and a height"),
        ({"albedo": 1.0}, "card.albedo", "[0, 1)"),
        ({"albedo": -0.1}, "card.albedo", "[0, 1)"),
        ({"albedo": math.nan}, "card.albedo", "[0, 1)"),
        ({"element_width": 1.01, "element_height": 1.0}, "card.elements_x", "overlap"),
        ({"elements_x": (0.0, 1.0, 0.05), "element_width": 0.1, "element_height": 1.0}, "card.elements_x", "overlap"),
    ],
)
def test_card_refuses(changes: dict[str, Any], field: str, words: str) -> None:
    error = refused(lambda: card(**changes))
    assert error.field == field
    assert words in error.message


@pytest.mark.parametrize(
    ("views", "scan", "field"), [(0, 2.0, "observer.views"), (-1, 2.0, "observer.views"), (3, 0.5, "observer.scan_deg")]
)
def test_scan_refuses(views: int, scan: float, field: str) -> None:
    assert refused(lambda: scan_angles(views, scan=scan, fov=1.0)).field == field


def test_what_lies_just_within_the_limits_is_accepted() -> None:
    # The twins of the refusals: the same fields, a hair's breadth inside.
    assert observer(view_angles=(math.radians(59.9),)).views == 1
    assert observer(fov=math.radians(179.9)).fov < math.pi
    assert observer(pixels=2, pixels_at="edges").pixels == 2
    assert card(albedo=0.999).albedo == 0.999
    assert card(element_width=1.0, element_height=1.0).elements == 3  # touching, not overlapping
    touching = tuple(np.linspace(-2.5, 2.5, 251))
    assert card(elements_x=touching, element_width=0.02, element_height=0.02).elements == 251
    assert math.isfinite(wall_points(observer(view_angles=(math.radians(59.9),))).sum())


def test_places_cannot_be_moved_behind_the_checks() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        observer().position = (0.0, 1.0)  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        card().y = 1.0  # type: ignore[misc]


def test_distances_are_positive_metres() -> None:
    assert observer().distance == 5.0
    assert card(y=-0.25).distance == 0.25
    assert card().is_points
    assert not card(element_width=0.1, element_height=0.1).is_points
