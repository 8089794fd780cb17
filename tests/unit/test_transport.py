"""One bounce of light against view factors, quadrature by other hands, and rays followed one by one."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate

from wallmirror.brdf import BRDF, Diffuse, GaussianTrain, Mirror, Sum, Table
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer, outgoing_angles, pixel_half_width, pixel_tangents, wall_points
from wallmirror.quadrature import quadrature_order
from wallmirror.transport import (
    Weights,
    brdf_matrices,
    build_kernel,
    mirror_matrix,
    radiance,
    strip_factor,
    transport_matrix,
)

from .helpers import EPS, lobes, refused, thesis_card, thesis_observer

Array = NDArray[np.float64]


def rectangle_view_factor(x: tuple[Array, Array], z: tuple[float, float], distance: float) -> Array:
    """From a plane element to a parallel rectangle [x0, x1] x [z0, z1] seen from the foot of the element's normal.

    The four corners of Howell's catalogue of radiation configuration factors, "plane element to plane parallel
    rectangle; normal to element passes through corner of rectangle".
    """

    def corner(a: Array, b: float) -> Array:
        p, q = np.asarray(a) / distance, b / distance
        first = p / np.hypot(1, p) * np.arctan(q / np.hypot(1, p))
        second = q / np.hypot(1, q) * np.arctan(p / np.hypot(1, q))
        return (first + second) / (2 * math.pi)

    return corner(x[1], z[1]) - corner(x[0], z[1]) - corner(x[1], z[0]) + corner(x[0], z[0])


def reflected(observer: Observer, card: Card, brdf: BRDF, place: tuple[int, int, int], order: int = 32) -> float:
    """One entry of F by Gauss-Legendre in all four dimensions, from eq. 1.14 written with vectors in space."""
    view, pixel, element = place
    half = math.tan(observer.fov / 2) / observer.pixels
    angle = observer.view_angles[view]
    axis, right, up = (
        np.array(v)
        for v in ([-math.sin(angle), math.cos(angle), 0], [math.cos(angle), math.sin(angle), 0], [0.0, 0.0, 1.0])
    )
    nodes, weights = np.polynomial.legendre.leggauss(order)
    few, few_weights = np.polynomial.legendre.leggauss(12)
    t = (2 * pixel + 1 - observer.pixels) * half + half * nodes
    rays = axis + t[:, None, None] * right + half * few[:, None] * up
    eye = np.array([*observer.position, 0.0])
    wall = eye + rays * (-eye[1] / rays[..., 1:2])
    light = np.empty((order, 12, 3))
    light[..., 0] = card.elements_x[element] + card.element_width / 2 * nodes[:, None]
    light[..., 1] = card.y
    light[..., 2] = card.element_height / 2 * few
    normal = np.array([0.0, -1.0, 0.0])
    to_eye = eye - wall
    theta_o = np.arctan2(to_eye[..., 0], -to_eye[..., 1])[..., None, None]
    path = light - wall[:, :, None, None]
    length = np.linalg.norm(path, axis=-1)
    cosine = (path @ normal) / length  # at the wall; the card is parallel to it and looks back, so also at the card
    theta_s = np.arctan2(path[..., 0], -path[..., 1])
    values = brdf(theta_s, theta_o) * cosine * cosine / length**2
    area = card.element_width * card.element_height / 16  # four weights that each sum to 2
    return float(np.einsum("tvxz,t,v,x,z->", values, weights, few_weights, weights, few_weights)) * area


# -- the height of a strip, in closed form --------------------------------------------------------------------

ENDS = [(-1.0, 1.0), (-0.01, 0.01), (0.0, 1.0), (-0.3, 2.0), (0.5, 0.52), (-1e6, 1e6), (-1e-9, 1e-9)]


@pytest.mark.parametrize("distance", [1e-6, 1e-3, 1.0, 1e8])
@pytest.mark.parametrize("dx", [0.0, 0.7, -30.0])
def test_strip_factor_is_the_integral_of_both_cosines_over_the_squared_distance(distance: float, dx: float) -> None:
    with mpmath.workdps(30):
        z, a = mpmath.mpf(distance), mpmath.hypot(distance, dx)
        for low, high in ENDS:
            # Over the unit interval, because mpmath stops at an absolute error.
            span = mpmath.mpf(high) - low
            places = [(s * a - low) / span for s in (-100, -1, 0, 1, 100)]
            stops = [0, *(p for p in places if 0 < p < 1), 1]
            mean = mpmath.quad(lambda p, q=(low / a, span / a): (1 + (q[0] + p * q[1]) ** 2) ** -2, stops)
            exact = float(mean * span * z * z / a**4)
            # The difference of two values of an antiderivative, each below z^2/a^4 min(h, pi/4 a): some roundings of that.
            largest = float(z * z / a**4 * min(max(abs(low), abs(high)), mpmath.pi / 4 * a))
            assert float(strip_factor(distance, dx, low, high)) == pytest.approx(exact, rel=0, abs=16 * EPS * largest)


def test_strip_factor_does_not_confuse_the_cosines() -> None:
    # The twin: one cosine, or none, over the squared distance is another number.
    measured = float(strip_factor(1.0, 0.7, -0.3, 2.0))
    for power in (0, 1):
        with_less = integrate.quad(lambda h, p=power: (1.49 + h * h) ** -(1 + p / 2), -0.3, 2.0)[0]
        assert abs(with_less / measured - 1) > 0.2


def test_strip_factor_adds_up_and_is_even() -> None:
    dx = np.array([0.0, 0.4, -3.0])
    whole = strip_factor(0.5, dx, -1.0, 2.0)
    np.testing.assert_allclose(strip_factor(0.5, dx, -1.0, 0.3) + strip_factor(0.5, dx, 0.3, 2.0), whole, rtol=8 * EPS)
    np.testing.assert_allclose(strip_factor(0.5, -dx, -2.0, 1.0), whole, rtol=8 * EPS)


# -- the physical transport of a diffuse wall: view factors ---------------------------------------------------


@pytest.mark.parametrize(
    ("y", "width", "height"),
    [(-1.0, 0.02, 0.02), (-1.0, 2.0, 0.3), (-0.1, 1.0, 1.0), (-30.0, 4.0, 8.0), (-1e-3, 1e-3, 1e-3)],
)
def test_a_diffuse_wall_shows_the_view_factor_of_the_strips(y: float, width: float, height: float) -> None:
    # A Lambertian wall of albedo a that sees a uniform emitter of radiance 1 has radiance a times the view factor.
    observer = thesis_observer(pixels=30, views=3)  # points, so that nothing but the strip is integrated
    card = Card(elements_x=(-2.5, 1.7), y=y, element_width=width, element_height=height)
    measured = transport_matrix(observer, card, Diffuse(albedo=0.6))
    dx = np.asarray(card.elements_x) - wall_points(observer)[..., None]
    expected = 0.6 * rectangle_view_factor((dx - width / 2, dx + width / 2), (-height / 2, height / 2), -y)
    # The default tolerance, relative to the largest entry; the four corners cancel to the strip's share of a sphere.
    corners = 8 * EPS * 4 / float(np.max(expected))
    assert np.max(np.abs(measured - expected)) <= (1e-9 + corners) * np.max(expected)


def test_the_view_factor_would_show_a_missing_cosine() -> None:
    observer = thesis_observer(pixels=30, views=3)
    dx = 0.3 - wall_points(observer)
    expected = rectangle_view_factor((dx - 0.01, dx + 0.01), (-0.01, 0.01), 1.0)
    for power in (2, 3):  # cos^4 / z^2 is right for a small card; these leave a cosine or the inverse square out
        wrong = 0.02**2 * np.cos(np.arctan(dx)) ** power / math.pi
        assert np.max(np.abs(wrong - expected)) > 0.05 * np.max(expected)


@pytest.mark.parametrize(("y", "width"), [(-0.1, 5.0), (-0.01, 1.0), (-1e-3, 0.1)])
def test_strips_far_wider_than_their_distance_are_within_the_tolerance_or_refused(y: float, width: float) -> None:
    observer = thesis_observer(pixels=40, views=1)
    card = Card(elements_x=(0.3,), y=y, element_width=width, element_height=1.0)
    try:
        measured = transport_matrix(observer, card, Diffuse(albedo=1.0), tolerance=1e-9)[..., 0]
    except InputError:
        return
    dx = 0.3 - wall_points(observer)
    expected = rectangle_view_factor((dx - width / 2, dx + width / 2), (-0.5, 0.5), -y)
    assert np.max(np.abs(measured - expected)) <= 1.1e-9 * np.max(expected)


@pytest.mark.parametrize(("pixels", "y"), [(10, -1.0), (40, -0.1), (10, -0.1)])
def test_the_tolerance_holds_for_pixels_that_see_far_up_the_wall(pixels: int, y: float) -> None:
    # One pixel is 0.58 (N = 10) or 0.14 m (N = 40) high on the wall, the card 1 or 0.1 m away: the strip's factor bends
    # within the pixel. The view factor again, averaged over the pixel by a fine rule of our own.
    observer = thesis_observer(pixels=pixels, views=1, pixels_at="centres")
    card = Card(elements_x=(0.3,), y=y, element_width=0.02, element_height=0.02)
    measured = transport_matrix(observer, card, Diffuse(albedo=1.0), tolerance=1e-9)[0, :, 0]
    nodes, weights = np.polynomial.legendre.leggauss(60)
    half = pixel_half_width(observer)
    dx = 0.3 - wall_points(observer, pixel_tangents(observer)[:, None] + half * nodes)[0]  # (pixels, nodes)
    expected = np.zeros(pixels)
    for node, weight in zip(nodes, weights):
        z = 5.0 * half * node  # the view looks straight ahead
        factor = rectangle_view_factor((dx - 0.01, dx + 0.01), (-0.01 - z, 0.01 - z), -y)
        expected += weight / 4 * (factor @ weights)
    # The small rectangle is the difference of four corners: their roundings against the largest factor.
    corners = 32 * EPS / float(np.max(expected))
    assert np.max(np.abs(measured - expected)) <= (1e-9 + corners) * np.max(expected)


# -- the limit of tall strips: the thesis's two dimensions ----------------------------------------------------


def test_tall_strips_make_the_two_dimensional_formula() -> None:
    # integral of z^2 / (a^2 + h^2)^2 over all heights = pi/2 z^2 / a^3, which is pi/2 cos(theta) d theta / dx.
    z, dx = 0.8, np.array([0.0, 0.5, -2.0])
    a = np.hypot(z, dx)
    limit = math.pi / 2 * z**2 / a**3
    for half in (10.0, 100.0, 1000.0):
        # What is missing: 4 / (3 pi) (a / h)^3, and the next order is 6/5 (a/h)^2 of it.
        missing = 1 - strip_factor(z, dx, -half, half) / limit
        expected = 4 / (3 * math.pi) * (a / half) ** 3
        np.testing.assert_allclose(missing, expected, rtol=1.3 * float(np.max(a / half)) ** 2, atol=4 * EPS)


@pytest.mark.parametrize(
    ("brdf", "splits"), [(Diffuse(albedo=0.5), ()), (lobes(-20.0, 10.0, sigma_deg=3.0), (-20.0, 10.0))]
)
def test_the_whole_transport_tends_to_half_pi_times_the_integral_of_brdf_and_cosine(
    brdf: BRDF, splits: tuple[float, ...]
) -> None:
    observer = thesis_observer(pixels=9, views=3)
    card = Card(elements_x=(-0.4, 1.0), y=-0.7, element_width=0.5, element_height=2e4)
    measured = transport_matrix(observer, card, brdf)
    x = wall_points(observer)
    expected = np.empty_like(measured)
    for a, j, i in np.ndindex(measured.shape):
        theta_o = float(outgoing_angles(observer, x[a, j]))
        low, high = (math.atan((card.elements_x[i] + s * 0.25 - x[a, j]) / 0.7) for s in (-1, 1))
        peaks = [p for p in (math.radians(s) - theta_o for s in splits) if low < p < high]
        value, _ = integrate.quad(
            lambda t, theta_o=theta_o: float(brdf(t, theta_o)) * math.cos(t),
            low,
            high,
            points=peaks or None,
            epsabs=1e-13,
            epsrel=1e-11,
        )
        expected[a, j, i] = math.pi / 2 * value
    # Strips of half-height 10 km fall short by 4 / (3 pi) (6 m / 10 km)^3 < 1e-10; the quadrature by 1e-9.
    assert np.max(np.abs(measured - expected)) <= 1.2e-9 * np.max(expected)
    # The twin: strips no taller than they are far are no two-dimensional scene.
    low_card = dataclasses.replace(card, element_height=1.0)
    assert np.max(np.abs(transport_matrix(observer, low_card, brdf) - expected)) > 0.1 * np.max(expected)


# -- quadrature over strip and footprint ----------------------------------------------------------------------


def narrow_scene() -> tuple[Observer, Card, GaussianTrain]:
    """Pixels of 1 deg, seen 5 deg wide from the card, against lobes of 1 deg: every pixel must be integrated."""
    observer = Observer(position=(0.2, -5.0), fov=math.radians(12), view_angles=(0.1, -0.15), pixels=12)
    card = Card(elements_x=(-0.5, 0.3), y=-1.0, element_width=0.05, element_height=0.03)
    return observer, card, lobes(-12.0, 3.0, 20.0, sigma_deg=1.0)


@pytest.fixture(scope="module")
def narrow_reference() -> Array:
    observer, card, brdf = narrow_scene()
    entries = list(np.ndindex(2, 12, 2))
    exact = np.array([reflected(observer, card, brdf, place) for place in entries])
    coarser = np.array([reflected(observer, card, brdf, place, order=28) for place in entries[::5]])
    # The reference itself is settled far below the tightest tolerance asked for.
    assert np.max(np.abs(coarser - exact[::5])) < 1e-11 * np.max(exact)
    return exact.reshape(2, 12, 2)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-6, 1e-9])
def test_transport_is_within_the_requested_tolerance(tolerance: float, narrow_reference: Array) -> None:
    observer, card, brdf = narrow_scene()
    measured = transport_matrix(observer, card, brdf, tolerance=tolerance)
    assert np.max(np.abs(measured - narrow_reference)) <= tolerance * np.max(narrow_reference)


def test_a_kernel_is_within_the_tolerance_for_a_lobe_of_its_resolution(narrow_reference: Array) -> None:
    observer, card, brdf = narrow_scene()
    brightest = float(np.max(build_kernel(observer, card).weight.sum(axis=-1)))  # a lobe of height 1 everywhere
    for tolerance in (1e-3, 1e-6):
        kernel = build_kernel(observer, card, resolution=math.radians(1), tolerance=tolerance)
        # Two directions, each to the tolerance, times three lobes.
        assert np.max(np.abs(kernel.apply(brdf) - narrow_reference)) <= 6 * tolerance * brightest
    # The twin: a kernel made for broad lobes misses narrow ones by a tenth of the brightest and more.
    blunt = build_kernel(observer, card, resolution=math.radians(45), tolerance=1e-3)
    assert np.max(np.abs(blunt.apply(brdf) - narrow_reference)) > 0.1 * np.max(narrow_reference)


@pytest.mark.parametrize(("sigma_deg", "prototype"), [(1.0, 1.2e-3), (0.1, 1.7e-2)])
def test_pixel_centres_instead_of_footprints_cost_what_was_measured(sigma_deg: float, prototype: float) -> None:
    # Root mean square over a view, relative to its brightest pixel. The prototype's own scene is not recorded; a factor
    # of two covers any place of the lobes in the view.
    observer = dataclasses.replace(thesis_observer(pixels_at="centres"), view_angles=(0.1,))
    card = thesis_card(width=0.02)
    brdf = lobes(sigma_deg=sigma_deg)
    footprint = transport_matrix(observer, card, brdf, tolerance=1e-6)
    # Points at the same places: a field that ends at the outermost centres, sampled from edge to edge.
    narrowed = 2 * math.atan(math.tan(observer.fov / 2) * (1 - 1 / observer.pixels))
    points = dataclasses.replace(observer, fov=narrowed, pixels_at="edges")
    np.testing.assert_allclose(wall_points(points), wall_points(observer), rtol=0, atol=1e-14)
    centre = transport_matrix(points, card, brdf, tolerance=1e-6)
    cost = float(np.sqrt(np.mean((centre - footprint) ** 2)) / np.max(footprint))
    assert prototype / 2 < cost < prototype * 2


@pytest.mark.parametrize("width", [0.0, 1e-4, 0.5, 3.0, 20.0, 90.0])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_the_order_is_the_smallest_that_reaches_the_tolerance(width: float, tolerance: float) -> None:
    order = quadrature_order(width, tolerance)
    assert worst_average(width, order) <= tolerance * (1 + 1e-6) + 4 * EPS
    if order > 1:
        assert worst_average(width, order - 1) > tolerance * (1 - 1e-2)


@pytest.mark.parametrize("width", [200.0, 500.0, 1000.0])
@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_lobes_do_not_slip_between_the_nodes_of_a_loose_tolerance(width: float, tolerance: float) -> None:
    try:
        order = quadrature_order(width, tolerance)
    except InputError:  # "... nodes resolve": more than it may use, said so
        return
    # A hundredth for lobes between the places that the rule itself looks at.
    assert worst_average(width, order) <= 1.01 * tolerance


def worst_average(width: float, order: int) -> float:
    """Largest error of a rule that averages exp(-u^2/2) over an interval, over 4000 places of the interval."""
    offsets = np.linspace(0.0, width / 2 + 5, 4000)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    values = np.exp(-0.5 * (offsets[:, None] + width / 2 * nodes) ** 2) @ weights / 2
    many, many_weights = np.polynomial.legendre.leggauss(max(20, 3 * int(width)) if width < 300 else 1)
    if width < 300:
        exact = np.exp(-0.5 * (offsets[:, None] + width / 2 * many) ** 2) @ many_weights / 2
    else:  # the whole lobe lies inside or outside, but for the ends: 2.5 / width at most
        exact = np.where(offsets < width / 2 - 5, math.sqrt(2 * math.pi) / width, values)
    return float(np.max(np.abs(values - exact)))


def test_a_strip_too_wide_for_its_lobes_is_refused() -> None:
    observer = thesis_observer(pixels=10, views=1)
    card = Card(elements_x=(0.0,), y=-0.05, element_width=1.0, element_height=1.0)
    error = refused(lambda: transport_matrix(observer, card, lobes(sigma_deg=0.05)))
    assert error.field == "card.element_width"
    assert "narrow the strips" in error.message


def test_unknown_weights_are_refused() -> None:
    observer, card = thesis_observer(pixels=10, views=1), thesis_card()
    error = refused(lambda: build_kernel(observer, card, weights="lambert"))  # type: ignore[arg-type]
    assert error.field == "transport"
    assert "physical" in error.message


# -- the thesis's own weights: Algorithm 1 --------------------------------------------------------------------


def algorithm_1(observer: Observer, card: Card, rho: Callable[[float], float], *, cosine: bool) -> Array:
    """Direct transcription: for every view, wall point and source point, angles by tangents, then rho."""
    f = np.zeros((observer.views, observer.pixels, card.elements))
    x_o, y_o = observer.position
    half = math.tan(observer.fov / 2)
    for a in range(observer.views):
        for j in range(observer.pixels):
            offset = math.atan(half * (2 * j / (observer.pixels - 1) - 1))
            x = x_o + y_o * math.tan(observer.view_angles[a] - offset)
            theta_o = math.atan((x_o - x) / -y_o)
            for i in range(card.elements):
                theta_s = math.atan((card.elements_x[i] - x) / -card.y)
                f[a, j, i] = rho(theta_s + theta_o) * (math.cos(theta_s) if cosine else 1.0)
    return f


def four_lobes(u: float) -> float:
    return sum(math.exp(-0.5 * ((math.degrees(u) - c) / 3.0) ** 2) for c in (-35, -15, 15, 35))


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
def test_points_follow_algorithm_1(weights: Weights) -> None:
    observer, card = thesis_observer(pixels=40, views=4), thesis_card(elements=3)
    measured = transport_matrix(observer, card, lobes(sigma_deg=3.0), weights=weights)
    expected = algorithm_1(observer, card, four_lobes, cosine=weights == "cosine")
    # A few roundings of an angle, 4 EPS, move a lobe of 3 deg by 4 EPS / 0.05 / sqrt(e).
    np.testing.assert_allclose(measured, expected, rtol=0, atol=100 * EPS)
    assert np.max(expected) > 0.9
    # The twin: the two weights are not alike.
    other = algorithm_1(observer, card, four_lobes, cosine=weights == "thesis")
    assert np.max(np.abs(measured - other)) > 0.1


def test_the_angles_are_summed_and_not_subtracted() -> None:
    # Hypothesis 8 is written with a difference in the thesis; its code, and specular reflection, want the sum.
    observer, card = thesis_observer(pixels=40, views=4), thesis_card(elements=3)
    angles = (-15.0, 15.0)  # even: what the sign of one angle alone could not tell
    measured = transport_matrix(observer, card, lobes(*angles, sigma_deg=3.0), weights="thesis")
    mirrored = transport_matrix(observer, card, lobes(0.0, sigma_deg=1.0), weights="thesis")
    j = np.argmax(mirrored[1], axis=0)  # where each element is seen in a mirror
    depth = 5.0 + 1.0
    image = card.elements_x + (0.0 - np.asarray(card.elements_x)) / depth * 1.0
    np.testing.assert_allclose(wall_points(observer)[1][j], image, atol=0.12)  # within a pixel of 0.24 m at most
    assert measured.max() > 0.9


def test_points_of_the_physical_model_are_infinitesimal_strips() -> None:
    observer = thesis_observer(pixels=20, views=2)
    side = 1e-4
    points = transport_matrix(observer, thesis_card(), Diffuse(albedo=1.0), weights="physical")
    strips = transport_matrix(observer, thesis_card(width=side), Diffuse(albedo=1.0), weights="physical")
    # Points have unit area; the strip's curvature costs (side / distance)^2.
    np.testing.assert_allclose(strips / side**2, points, rtol=3 * side**2 + 1e-9)


def test_each_model_has_its_own_reading_of_a_table_that_is_no_angle_sum() -> None:
    rng = np.random.default_rng(3)
    table = Table(values=rng.random((6, 7)))
    observer, card = thesis_observer(pixels=11, views=2), thesis_card(elements=2)
    measured = transport_matrix(observer, card, table, weights="thesis")
    x = wall_points(observer)[..., None]
    expected = table(np.arctan(np.asarray(card.elements_x) - x), np.arctan(-x / 5.0))
    np.testing.assert_allclose(measured, expected, rtol=0, atol=100 * EPS)


# -- structure ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", ["thesis", "cosine", "physical"])
def test_transport_is_linear_in_the_brdf(weights: Weights) -> None:
    observer, card = thesis_observer(pixels=15, views=2, pixels_at="centres"), thesis_card(width=0.1)
    first, second = lobes(sigma_deg=4.0), Diffuse(albedo=0.3)
    kernel = build_kernel(observer, card, weights=weights, resolution=math.radians(4))
    together = kernel.apply(Sum(parts=(first, second)))
    np.testing.assert_allclose(together, kernel.apply(first) + kernel.apply(second), rtol=8 * EPS)


def test_the_weights_of_a_kernel_are_the_transport_of_a_constant() -> None:
    observer, card = thesis_observer(pixels=15, views=2, pixels_at="centres"), thesis_card(width=0.1)
    # The weight itself, cos^4 = exp(-2 theta^2 ...) across a pixel, is a lobe of 0.5 rad.
    kernel = build_kernel(observer, card, resolution=0.5)
    diffuse = transport_matrix(observer, card, Diffuse(albedo=1.0))
    # The kernel's default tolerance, for each of its two directions.
    np.testing.assert_allclose(kernel.weight.sum(axis=-1) / math.pi, diffuse, rtol=0, atol=2e-6 * np.max(diffuse))
    assert kernel.angle_sum.shape == kernel.weight.shape


def test_radiance_is_the_sum_over_elements_of_eq_4_10() -> None:
    rng = np.random.default_rng(4)
    f, v = rng.random((2, 5, 3)), rng.random((3, 4))
    expected = np.zeros((2, 5, 4))
    for a, j, b in np.ndindex(expected.shape):
        expected[a, j, b] = sum(f[a, j, i] * v[i, b] for i in range(3))
    np.testing.assert_allclose(radiance(f, v), expected, rtol=4 * EPS)
    # Superposition: the picture of two patterns is the sum of their pictures.
    both = radiance(f, v[:, :1] + 2 * v[:, 1:2])
    np.testing.assert_allclose(both, radiance(f, v[:, :1]) + 2 * radiance(f, v[:, 1:2]), rtol=8 * EPS)


def test_brdf_matrices_have_the_shapes_of_section_4_1_2() -> None:
    observer, card = thesis_observer(pixels=30, views=5), thesis_card(elements=3)
    transport = transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis")
    matrices = brdf_matrices(transport)
    assert len(matrices) == 5
    assert {b.shape for b in matrices} == {(30, 3)}
    assert np.hstack(matrices).shape == (30, 15)
    # L_{r,a} = B_a V (eq. 4.11).
    v = np.random.default_rng(5).random((3, 2))
    for a, matrix in enumerate(matrices):
        np.testing.assert_array_equal(radiance(transport, v)[a], matrix @ v)


def test_wall_points_that_two_views_share_have_the_same_rows() -> None:
    # Section 4.2.1: overlapping views see the same wall points under the same angles, which is what ties them together.
    half = math.radians(30)
    observer = Observer(
        position=(0.0, -5.0), fov=2 * half, view_angles=(half / 2, half / 2), pixels=21, pixels_at="edges"
    )
    transport = transport_matrix(observer, thesis_card(), lobes(sigma_deg=3.0), weights="thesis")
    np.testing.assert_array_equal(transport[0], transport[1])
    # Where views only overlap, rows are alike wherever the wall points are: here 2 views of 3 share the point x = 0.
    turned = dataclasses.replace(observer, view_angles=(0.1, 0.0, -0.1))
    x = wall_points(turned)
    for first, second in itertools.combinations(range(3), 2):
        j, k = np.unravel_index(np.argmin(np.abs(x[first][:, None] - x[second])), (21, 21))
        rows = transport_matrix(turned, thesis_card(), lobes(sigma_deg=3.0), weights="thesis")
        apart = abs(x[first][j] - x[second][k])
        # theta_s turns by at most 1/(card distance) and theta_o by 1/5 per metre, a lobe by 0.61/sigma.
        bound = 1.2 * apart * 0.61 / math.radians(3) + 1e-12
        assert np.max(np.abs(rows[first, j] - rows[second, k])) <= bound


# -- mirrors --------------------------------------------------------------------------------------------------


def traced(observer: Observer, card: Card, rays: int) -> Array:
    """Share of each pixel's rays that meet each strip, following rays^2 rays a pixel in space."""
    share = np.zeros((observer.views, observer.pixels, card.elements))
    inside = (2 * (np.arange(rays) + 0.5) / rays - 1) * math.tan(observer.fov / 2) / observer.pixels
    for a, angle in enumerate(observer.view_angles):
        for j, centre in enumerate(
            (2 * np.arange(observer.pixels) + 1 - observer.pixels) * inside[-1] / (1 - 1 / rays)
        ):
            t, v = np.meshgrid(centre + inside, inside, indexing="ij")
            direction = np.stack(
                [t * math.cos(angle) - math.sin(angle), math.cos(angle) + t * math.sin(angle), v], axis=-1
            )
            eye = np.array([*observer.position, 0.0])
            at_wall = eye - direction * (eye[1] / direction[..., 1:2])
            back = direction * [1.0, -1.0, 1.0]  # mirrored at the wall
            at_card = at_wall + back * (card.y / back[..., 1:2])
            for i, x in enumerate(card.elements_x):
                hit = (np.abs(at_card[..., 0] - x) < card.element_width / 2) & (
                    np.abs(at_card[..., 2]) < card.element_height / 2
                )
                share[a, j, i] = hit.mean()
    return share


MIRROR_SCENES = {
    "pixels smaller than strips": (24, 0.5, 0.5),
    "pixels higher than strips": (24, 0.5, 0.1),
    "pixels larger than strips": (8, 0.1, 0.3),
}


@pytest.mark.parametrize("name", MIRROR_SCENES)
def test_a_mirror_shows_each_strip_where_rays_find_it(name: str) -> None:
    pixels, width, height = MIRROR_SCENES[name]
    observer = Observer(position=(0.3, -2.0), fov=math.radians(60), view_angles=(0.3, -0.2), pixels=pixels)
    card = Card(elements_x=(-1.0, 0.4), y=-1.0, element_width=width, element_height=height)
    rays = 120
    measured = mirror_matrix(observer, card, Mirror(reflectance=0.7))
    expected = 0.7 * traced(observer, card, rays)
    # A pixel's grid of rays misjudges each of the two upright and two level edges by less than one line of rays.
    assert np.max(np.abs(measured - expected)) <= 0.7 * 4 * 0.5 / rays
    assert np.all(np.count_nonzero(expected, axis=1).sum(axis=0) >= 1)
    # The twin: a mirror image one pixel further on is another picture.
    assert np.max(np.abs(np.roll(measured, 1, axis=1) - expected)) > 0.1


def test_a_mirror_loses_no_light_and_moves_none() -> None:
    # Behind the wall stands the strip's image, at depth 2 + 1 from the eye: its width and middle on the sensor.
    observer = Observer(position=(0.3, -2.0), fov=math.radians(60), view_angles=(0.2,), pixels=37)
    card = Card(elements_x=(-0.6, 0.4), y=-1.0, element_width=0.3, element_height=10.0)
    measured = transport_matrix(observer, card, Mirror(reflectance=1.0))[0]
    pixel = 2 * pixel_half_width(observer)
    for i, x in enumerate(card.elements_x):
        ends = [math.tan(math.atan((x + s * 0.15 - 0.3) / 3.0) + 0.2) for s in (-1, 1)]
        # Sums of 37 shares of order 1.
        assert np.sum(measured[:, i]) * pixel == pytest.approx(ends[1] - ends[0], rel=37 * 8 * EPS)
        inside = (pixel_tangents(observer) - pixel / 2 > ends[0]) & (pixel_tangents(observer) + pixel / 2 < ends[1])
        np.testing.assert_allclose(measured[inside, i], 1.0, rtol=8 * EPS)
        outside = (pixel_tangents(observer) + pixel / 2 < ends[0]) | (pixel_tangents(observer) - pixel / 2 > ends[1])
        np.testing.assert_array_equal(measured[outside, i], 0.0)


def test_a_mirror_is_exact_where_a_strip_leaves_the_pixel_at_the_top() -> None:
    # Oblique and coarse: within one pixel the strip begins to fill the pixel's height. The share is an integral of min(1,
    # a line in t), and quad is told where it bends.
    observer = Observer(position=(0.0, -2.0), fov=math.radians(60), view_angles=(0.5,), pixels=3)
    card = Card(elements_x=(-2.5,), y=-1.0, element_width=6.0, element_height=1.25)
    measured = mirror_matrix(observer, card, Mirror())[0, :, 0]
    half = pixel_half_width(observer)
    for j, t in enumerate(pixel_tangents(observer)):

        def seen(s: float) -> float:
            return min(1.0, 0.625 * (math.cos(0.5) + s * math.sin(0.5)) / (half * 3.0))

        bend = (half * 3.0 / 0.625 - math.cos(0.5)) / math.sin(0.5)
        stops = [bend] if t - half < bend < t + half else None
        expected = integrate.quad(seen, t - half, t + half, points=stops, epsabs=1e-13)[0] / (2 * half)
        assert measured[j] == pytest.approx(expected, abs=1e-12)


def test_points_of_the_wall_see_a_strip_in_a_mirror_or_not() -> None:
    observer = Observer(position=(0.3, -2.0), fov=math.radians(60), view_angles=(0.2,), pixels=50, pixels_at="edges")
    card = Card(elements_x=(-0.6, 0.4), y=-1.0, element_width=0.3, element_height=0.1)
    measured = transport_matrix(observer, card, Mirror(reflectance=0.8))
    # The ray to the wall point x goes on, mirrored, and meets the card half as far again.
    on_card = 0.3 + 1.5 * (wall_points(observer)[..., None] - 0.3)
    expected = np.where(np.abs(on_card - np.asarray(card.elements_x)) < 0.15, 0.8, 0.0)
    np.testing.assert_array_equal(measured, expected)
    assert np.count_nonzero(expected) > 5


def test_a_mirror_shows_a_strip_that_reaches_behind_the_camera() -> None:
    # A view turned by 0.5 rad has its image plane parallel to rays at 1.07 rad; the wide strip's far end lies beyond.
    observer = Observer(position=(0.0, -2.0), fov=math.radians(60), view_angles=(0.5,), pixels=5)
    for x in (-1.5, 1.5):
        card = Card(elements_x=(x,), y=-1.0, element_width=40.0, element_height=40.0)
        np.testing.assert_allclose(mirror_matrix(observer, card, Mirror())[0, :, 0], 1.0, rtol=8 * EPS)


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
def test_a_mirror_of_points_lights_one_pixel_for_each(weights: Weights) -> None:
    observer = dataclasses.replace(thesis_observer(pixels=101, views=1), pixels_at="edges")
    card = thesis_card(elements=3)
    measured = transport_matrix(observer, card, Mirror(), weights=weights)[0]
    for i, x_s in enumerate(card.elements_x):
        mirror_point = x_s - x_s / 6.0  # on the line from the image (x_s, 1) to the eye (0, -5)
        j = int(np.argmin(np.abs(wall_points(observer)[0] - mirror_point)))
        expected = np.zeros(101)
        theta_s = math.atan(x_s - wall_points(observer)[0, j])
        expected[j] = math.cos(theta_s) if weights == "cosine" else 1.0
        np.testing.assert_allclose(measured[:, i], expected, rtol=8 * EPS)


@pytest.mark.parametrize("pixels", [4, 10, 500])
def test_an_image_between_two_pixels_lights_only_one(pixels: int) -> None:
    # Straight ahead, an even number of pixels has an edge in the middle, where the image of x = 0 falls.
    observer = Observer(position=(0.0, -5.0), fov=math.radians(60), view_angles=(0.0,), pixels=pixels)
    card = Card(elements_x=(0.0,), y=-1.0)
    assert np.sum(mirror_matrix(observer, card, Mirror(), weights="thesis")) == 1.0


def test_points_in_a_physical_mirror_are_refused() -> None:
    error = refused(lambda: transport_matrix(thesis_observer(pixels=10, views=1), thesis_card(), Mirror()))
    assert error.field == "card.element_width"
    assert "width and a height" in error.message


# -- evaluation in blocks -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", ["thesis", "cosine", "physical"])
def test_blocks_and_the_whole_kernel_give_the_same_transport(weights: Weights, monkeypatch: pytest.MonkeyPatch) -> None:
    observer, card = thesis_observer(37, 3, "centres"), thesis_card(elements=5, width=0.02)
    brdf = Table(values=np.random.default_rng(0).random((9, 7)))
    for model in (lobes(sigma_deg=3.0), brdf):
        whole = build_kernel(observer, card, weights=weights, orders=(2, 3)).apply(model)
        for block, row in ((1, 1), (100, 30), (10**6, 256)):  # the second cuts pixels and elements
            monkeypatch.setattr("wallmirror.transport.nodes._BLOCK", block)
            monkeypatch.setattr("wallmirror.transport.nodes._ROW", row)
            parts = transport_matrix(observer, card, model, weights=weights, orders=(2, 3))
            # Six products, added in another order.
            np.testing.assert_allclose(parts, whole, rtol=0, atol=8 * EPS * np.abs(whole).max())


def test_orders_that_are_given_are_those_used() -> None:
    observer, card = thesis_observer(20, 2, "centres"), thesis_card(width=0.02)
    assert build_kernel(observer, card, orders=(3, 5)).weight.shape[-1] == 15
    # Points have nothing to integrate over.
    assert build_kernel(observer, card, weights="cosine", orders=(3, 5)).weight.shape[-1] == 1
    coarse, fine = (transport_matrix(observer, card, lobes(), orders=(1, s)) for s in (1, 8))
    assert np.abs(coarse - fine).max() > 1e-2 * fine.max()  # the twin: they matter
    for orders in ((0, 1), (1, 257)):
        assert refused(lambda orders=orders: transport_matrix(observer, card, lobes(), orders=orders)).field == "orders"
