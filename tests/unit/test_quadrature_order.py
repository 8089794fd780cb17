"""How fast the quadrature of `build_kernel` converges, and whether it keeps the tolerance that it is asked for."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from wallmirror.brdf import Diffuse, GaussianTrain
from wallmirror.geometry import Card, Observer, pixel_half_width
from wallmirror.quadrature import gauss_legendre, order_across_peak
from wallmirror.transport import Kernel, build_kernel
from wallmirror.transport.nodes import Nodes

from .helpers import refused, same_examples

Array = NDArray[np.float64]

# One pixel straight ahead, so that x = D t on the wall.
AHEAD = Observer(position=(0.0, -5.0), fov=math.radians(40), view_angles=(0.0,), pixels=1)
WHITE = Diffuse(albedo=1.0)  # a BRDF of 1 / pi


def strip_error(order: int, width: float, distance: float) -> float:
    """Relative error of one strip seen by the wall point in front of its middle, the integral in closed form.

    Twice the corner of Howell's "plane element to plane parallel rectangle", either side, above and below.
    """
    height = 0.3
    card = Card(elements_x=(0.0,), y=-distance, element_width=width, element_height=height)
    # Along a pixel of no width only the strip is integrated.
    measured = Kernel(*Nodes(AHEAD, card, "physical", 0.0, width / 2).all_at_once((1, order))).apply(WHITE)[0, 0, 0]
    p, q = width / 2 / distance, height / 2 / distance
    exact = (2 / math.pi) * (
        p / math.hypot(1, p) * math.atan(q / math.hypot(1, p)) + q / math.hypot(1, q) * math.atan(p / math.hypot(1, q))
    )
    return abs(float(measured) / exact - 1)


def footprint_error(order: int, half: float, distance: float) -> float:
    """Relative error of the mean of cos^4 / z^2, a point above the middle of a pixel, over the pixel's width."""
    card = Card(elements_x=(0.0,), y=-distance)
    measured = Kernel(*Nodes(AHEAD, card, "physical", half, 0.0).all_at_once((order, 1))).apply(WHITE)[0, 0, 0]
    w = 5.0 * half / distance
    exact = (w / (1 + w * w) + math.atan(w)) / (2 * math.pi * w) / distance**2
    return abs(float(measured) / exact - 1)


#: (error of an order, half the interval over the distance): strips of 0.5 to 1.5, pixels of as much on the wall.
DIRECTIONS = {
    "strip, as wide as 1 distance": (lambda n: strip_error(n, 1.0, 1.0), 0.5),
    "strip, as wide as 2 distances": (lambda n: strip_error(n, 1.0, 0.5), 1.0),
    "strip, as wide as 3 distances": (lambda n: strip_error(n, 3.0, 1.0), 1.5),
    "footprint, as wide as 1 distance": (lambda n: footprint_error(n, 0.1, 1.0), 0.5),
    "footprint, as wide as 3 distances": (lambda n: footprint_error(n, 0.3, 1.0), 1.5),
}


def midpoint(order: int) -> tuple[Array, Array]:
    """The twin: as many nodes, evenly spaced."""
    return (2 * np.arange(order) + 1) / order - 1, np.full(order, 2 / order)


def fitted(orders: Array, errors: Array) -> Array:
    """Coefficients (of n, of log n) in log error = c + rate n + power log n, by least squares."""
    columns = np.stack([np.ones(orders.size), orders, np.log(orders)], axis=1)
    return np.asarray(np.linalg.lstsq(columns, np.log(errors))[0][1:])


@pytest.mark.parametrize("name", DIRECTIONS)
def test_the_error_falls_geometrically_at_the_rate_of_the_nearest_pole(name: str) -> None:
    """Gauss-Legendre errors fall like rho^(-2n), rho the sum of semi-axes of the largest ellipse without a singularity.

    The kernel's own singularities lie at dx = +-i z (Trefethen, SIAM Review 50, 2008, theorem 4.5); with the half
    interval as unit, rho = z + sqrt(1 + z^2). Singularities of algebraic kind add a power of n.
    """
    error, half = DIRECTIONS[name]
    rho = 1 / half + math.hypot(1, 1 / half)
    orders = np.arange(3, 31)
    errors = np.array([error(int(n)) for n in orders])
    settled = errors > 1e-13  # above the rounding of some sums
    assert settled.sum() >= 7
    rate, power = fitted(orders[settled].astype(float), errors[settled])
    # The next term of the expansion is of relative order 1/n: 3 % of the rate over these orders.
    assert rate == pytest.approx(-2 * math.log(rho), rel=0.03)
    assert abs(power) < 2


@pytest.mark.parametrize("name", DIRECTIONS)
def test_a_midpoint_rule_of_as_many_nodes_is_of_order_two(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted twin: put in place of the Gauss-Legendre rule, it is found out by the claim above."""
    error, half = DIRECTIONS[name]
    monkeypatch.setattr("wallmirror.transport.nodes.gauss_legendre", midpoint)
    orders = np.array([8, 16, 32, 64])
    errors = np.array([error(int(n)) for n in orders])
    # Halving the step divides the error by 4; the next term, h^4, is below 2 % of it from 8 nodes on.
    np.testing.assert_allclose(np.diff(np.log2(errors)), -2.0, atol=0.1)
    dense = np.arange(3, 31)
    rate, _ = fitted(dense.astype(float), np.array([error(int(n)) for n in dense]))
    rho = 1 / half + math.hypot(1, 1 / half)
    assert abs(rate) < 0.1 * 2 * math.log(rho)


# -- the tolerance --------------------------------------------------------------------------------------------


def reference(observer: Observer, card: Card, brdf: GaussianTrain, pixel: int, order: int) -> float:
    """F of one pixel and the only strip by a rule of our own: Gauss-Legendre in t and x, 16 nodes over the height."""
    half, view, z = pixel_half_width(observer), observer.view_angles[0], card.distance
    nodes, weights = np.polynomial.legendre.leggauss(order)
    few, few_weights = np.polynomial.legendre.leggauss(16)
    t = (2 * pixel + 1 - observer.pixels) * half + half * nodes
    path = -observer.position[1] / (math.cos(view) + t * math.sin(view))
    wall = observer.position[0] + path * (t * math.cos(view) - math.sin(view))
    dx = card.elements_x[0] + card.element_width / 2 * nodes - wall[:, None]
    u = np.arctan(dx / z) + np.arctan((observer.position[0] - wall) / observer.distance)[:, None]
    a = np.hypot(z, dx)[..., None]
    up = (half * path)[:, None, None] * few  # where within the pixel's height

    def antiderivative(h: Array) -> Array:  # of 1 / (a^2 + h^2)^2
        return h / (2 * a**2 * (a**2 + h**2)) + np.arctan(h / a) / (2 * a**3)

    tall = card.element_height / 2
    factor = z**2 * (antiderivative(tall - up) + antiderivative(tall + up)) @ few_weights / 2
    return float(np.einsum("i,j,ij->", weights, weights, brdf.of_sum(u) * factor)) / 4 * card.element_width


def scene_of(
    view: float, fov: float, pixels: int, distance: float, width: float, height: float, x: float
) -> tuple[Observer, Card]:
    """An observer with one view and a card of one strip, width and height in units of the card's distance."""
    observer = Observer(position=(0.3, -4.0), fov=math.radians(fov), view_angles=(view,), pixels=pixels)
    strip = {"element_width": width * distance, "element_height": height * distance}
    return observer, Card(elements_x=(x,), y=-distance, **strip)


@pytest.mark.parametrize(
    ("case", "lobe_deg", "offset"),
    [((0.3, 30.0, 8, 0.8, 0.3, 0.5, 0.2), 8.0, 0.1), ((-0.4, 20.0, 20, 1.5, 0.05, 1.0, -0.6), 3.0, -0.05)],
)
def test_the_reference_is_mpmaths(case: tuple[float, ...], lobe_deg: float, offset: float) -> None:
    observer, card = scene_of(*case)  # type: ignore[arg-type]
    pixel = observer.pixels // 3
    # The lobe lies where the pixel looks, up to an offset.
    centre = float(build_kernel(observer, card).angle_sum[0, pixel, 0].mean()) + offset
    brdf = GaussianTrain(centres=(centre,), sigma=math.radians(lobe_deg))
    half, view = pixel_half_width(observer), observer.view_angles[0]
    with mpmath.workdps(18):
        z, (x_o, y_o) = mpmath.mpf(card.distance), map(mpmath.mpf, observer.position)
        tall = mpmath.mpf(card.element_height) / 2

        def integrand(p: mpmath.mpf, s: mpmath.mpf) -> mpmath.mpf:
            t = (2 * pixel + 1 - observer.pixels + p) * half
            wall = x_o + y_o * mpmath.tan(view - mpmath.atan(t))  # eq. 4.3, not the rays of the other rule
            dx = card.elements_x[0] + s * card.element_width / 2 - wall
            u = mpmath.atan(dx / z) + mpmath.atan((x_o - wall) / -y_o)
            a = mpmath.sqrt(z**2 + dx**2)
            reach = half * -y_o / (mpmath.cos(view) + t * mpmath.sin(view))

            # The antiderivative of the antiderivative, so that the mean over the pixel's height is exact.
            def twice(h: mpmath.mpf) -> mpmath.mpf:
                return h * mpmath.atan(h / a) / (2 * a**3)

            mean = z**2 * (twice(tall + reach) - twice(tall - reach)) / reach
            return mean * mpmath.exp(-((u - centre) ** 2) / (2 * mpmath.radians(lobe_deg) ** 2))

        # The degree is fixed: 48 nodes, which for lobes of these widths leave less than is compared.
        exact = mpmath.quad(integrand, [-1, 1], [-1, 1], method="gauss-legendre", maxdegree=4)
        exact *= card.element_width / mpmath.mpf(4)
    assert reference(observer, card, brdf, pixel, 40) == pytest.approx(float(exact), rel=1e-12)
    assert exact > 1e-6


@settings(parent=same_examples, max_examples=60, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    view=st.floats(-0.15, 0.15),
    fov=st.floats(2.0, 15.0),
    pixels=st.integers(6, 60),
    distance=st.floats(0.8, 3.0),
    width=st.floats(math.log(3e-3), math.log(0.5)),
    height=st.floats(0.01, 1.0),
    x=st.floats(-0.5, 0.5),
    lobe=st.floats(math.log(0.5), math.log(10.0)),
    digits=st.floats(2.0, 8.0),
    at=st.tuples(st.integers(0, 59), st.floats(-2.0, 2.0)),
)
def test_the_tolerance_is_kept(
    view: float,
    fov: float,
    pixels: int,
    distance: float,
    width: float,
    height: float,
    x: float,
    lobe: float,
    digits: float,
    at: tuple[int, float],
) -> None:
    """For strips up to half as wide as they are far, lobes up to 10 deg, pixels within which u turns by some 10 deg,
    and incidence up to 50 deg. Beyond, the weight and the angles' own curvature, which the choice of orders leaves out,
    can cost more than was asked for.

    Each of the two directions may err by the tolerance, times what a lobe of height 1 everywhere would give.
    """
    observer, card = scene_of(view, fov, pixels, distance, math.exp(width), height, x)
    sigma, tolerance = math.radians(math.exp(lobe)), 10.0**-digits
    kernel = build_kernel(observer, card, resolution=sigma, tolerance=tolerance)
    pixel = at[0] % pixels
    u = kernel.angle_sum[0, pixel, 0]
    assume(float(np.abs(kernel.theta_s).max()) < math.radians(50))
    assume(2 * pixel_half_width(observer) * observer.distance / distance < math.radians(10))
    brdf = GaussianTrain(centres=(float(u.mean()) + at[1] * sigma,), sigma=sigma)
    exact, coarser = (reference(observer, card, brdf, pixel, order) for order in (64, 56))
    brightest = float(kernel.weight.sum(axis=-1).max())
    assert abs(exact - coarser) <= 0.01 * tolerance * brightest
    assert abs(float(kernel.apply(brdf)[0, pixel, 0]) - exact) <= 2 * tolerance * brightest


def test_a_tolerance_asked_of_a_midpoint_rule_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin: the same orders with evenly spaced nodes miss by orders of magnitude."""
    observer, card = scene_of(0.2, 30.0, 12, 0.8, 0.3, 0.4, 0.1)
    sigma = math.radians(4.0)
    kernel = build_kernel(observer, card, resolution=sigma, tolerance=1e-6)
    brdf = GaussianTrain(centres=(float(kernel.angle_sum[0, 5, 0].mean()),), sigma=sigma)
    exact = reference(observer, card, brdf, 5, 64)
    nodes = kernel.weight.shape[-1]
    brightest = float(kernel.weight.sum(axis=-1).max())
    assert abs(float(kernel.apply(brdf)[0, 5, 0]) - exact) <= 2e-6 * brightest
    monkeypatch.setattr("wallmirror.transport.nodes.gauss_legendre", midpoint)
    half = pixel_half_width(observer)
    # As many nodes along the strip as the kernel has in both directions together.
    even = Kernel(*Nodes(observer, card, "physical", half, card.element_width / 2).all_at_once((nodes, nodes)))
    assert abs(float(even.apply(brdf)[0, 5, 0]) - exact) > 2e-6 * brightest
    fewer = Kernel(*Nodes(observer, card, "physical", half, card.element_width / 2).all_at_once((4, nodes // 4)))
    assert abs(float(fewer.apply(brdf)[0, 5, 0]) - exact) > 10 * 2e-6 * brightest


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("width", [0.1, 1.0, 10.0, 25.0])
def test_the_order_across_a_peak_is_that_of_its_poles(tolerance: float, width: float) -> None:
    # 1 / (1 + x^2) and its square in closed form; the square's double pole costs a small factor, half the order a large one.
    order = order_across_peak(width, tolerance)

    def missed(nodes: int, power: int) -> float:
        x, weights = gauss_legendre(nodes)
        worst = 0.0
        for centre in np.linspace(0, width, 17):
            ends = centre + width / 2 * np.array([-1.0, 1.0])
            whole = np.arctan(ends) if power == 1 else 0.5 * (np.arctan(ends) + ends / (1 + ends**2))
            found = 0.5 * float(np.sum(weights / (1 + (centre + width / 2 * x) ** 2) ** power))
            worst = max(worst, abs(found - float(whole[1] - whole[0]) / width))
        return worst

    assert missed(order, 1) <= tolerance
    assert missed(order, 2) <= 3 * tolerance
    assert missed(order // 2, 1) > 10 * tolerance


def test_a_peak_that_no_order_resolves_is_refused() -> None:
    assert "as wide as the card is far" in str(refused(lambda: order_across_peak(1e3, 1e-9)))
