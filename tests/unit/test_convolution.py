"""Each form of rendering by convolution against Algorithm 1, with faults planted that the checks must see."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import find_peaks

from wallmirror.brdf import BRDF, AngleSumBRDF, Diffuse, GaussianTrain, Mirror, Phong, Table
from wallmirror.convolution import (
    HalfCircle,
    angle_convolution,
    best_angle_sum,
    convolution_errors,
    convolution_variable,
    convolve_centred,
    cosine_factor,
    mirror_directions,
    mirror_points,
    mirror_render,
    outgoing_light,
    projected_brdf,
    relative_error,
    resample,
    spherical_convolution,
    wall_convolution,
    wall_kernel,
)
from wallmirror.convolution import angle as angle_module
from wallmirror.convolution import spherical as spherical_module
from wallmirror.convolution.as_published import (
    box_mirror_render,
    nearest_spherical,
    scattered_projection,
    scattered_wall_convolution,
)
from wallmirror.convolution.spherical import PointWeights, half_circle_directions
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Card, Observer, incident_angles, outgoing_angles, wall_points
from wallmirror.transport import radiance, transport_matrix

from .helpers import EPS, lobes, refused

Array = NDArray[np.float64]

SOURCE = np.array([0.5, 1.0])
TWO, FOUR = (-15.0, 15.0), (-30.0, -15.0, 15.0, 30.0)
LOPSIDED = lobes(-25.0, 10.0)  # not even, so that a flipped sign shows


def camera(pixels: int = 1000, x: float = 0.0) -> Observer:
    return Observer(position=(x, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=pixels, pixels_at="edges")


def card(distance: float, width: float = 10.0, middle: float = 0.0) -> Card:
    return Card(elements_x=(middle - width / 2, middle + width / 2), y=-distance)


def algorithm_1(observer: Observer, card: Card, brdf: AngleSumBRDF, weights: PointWeights = "thesis") -> Array:
    return radiance(transport_matrix(observer, card, brdf, weights=weights), SOURCE)


# ---------------------------------------------------------------------------------------------- on the half circle


@pytest.mark.parametrize("distance", [5, 50])
@pytest.mark.parametrize("brdf", [lobes(*TWO), lobes(*FOUR), lobes(), LOPSIDED, Phong(exponent=100)])
@pytest.mark.parametrize("weights", ["thesis", "cosine"])
def test_splines_reach_algorithm_1(distance: float, brdf: AngleSumBRDF, weights: PointWeights) -> None:
    """The issue's figure: 1e-4 at 1,000 directions. Cubic splines of lobes 5.6 steps wide leave about 1e-5."""
    exact = algorithm_1(camera(), card(distance), brdf, weights)
    ours = spherical_convolution(camera(), card(distance), brdf, SOURCE, samples=1000, order=3, weights=weights)
    assert relative_error(ours, exact) < 1e-4


def observed_order(order: int) -> float:
    exact = algorithm_1(camera(), card(5), LOPSIDED)
    errors = [
        relative_error(spherical_convolution(camera(), card(5), LOPSIDED, SOURCE, samples=k, order=order), exact)
        for k in (800, 1600)
    ]
    return math.log2(errors[0] / errors[1])


@pytest.mark.parametrize("order", [1, 3, 5])
def test_error_falls_with_the_order(order: int) -> None:
    """As h^(p + 1); at 4 to 9 steps per standard deviation the next term adds up to half a power."""
    assert order + 0.8 < observed_order(order) < order + 1.6


def test_the_prefilter_is_what_makes_the_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it the cubic B-spline blurs by its own variance, 2/3 h^2 for source and value: second order only."""
    monkeypatch.setattr(HalfCircle, "_beta_spectrum", lambda self: np.ones(self.samples + 1))
    assert 1.8 < observed_order(3) < 2.2


def test_a_flipped_angle_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = algorithm_1(camera(), card(5), LOPSIDED)
    monkeypatch.setattr(spherical_module, "incident_angles", lambda *a: -incident_angles(*a))
    assert relative_error(spherical_convolution(camera(), card(5), LOPSIDED, SOURCE), exact) > 0.5


def test_a_missing_cosine_is_seen() -> None:
    exact = algorithm_1(camera(), card(5), LOPSIDED, "cosine")
    assert relative_error(spherical_convolution(camera(), card(5), LOPSIDED, SOURCE), exact) > 0.1


def test_half_a_step_off_is_seen() -> None:
    """.09 deg of a lobe 1 deg wide: about .09 / sqrt(2) of a lobe's norm."""
    grid = HalfCircle(samples=1000, order=3)
    exact = LOPSIDED.of_sum(np.radians(-20.3) + np.radians(np.linspace(-40, 40, 400)))
    angles = np.radians(np.linspace(-40, 40, 400))
    seen = grid.outgoing(grid.spread(np.radians([-20.3]), [1.0]), LOPSIDED)
    assert relative_error(grid.read(seen, angles), exact) < 1e-4
    assert relative_error(grid.read(seen, angles + grid.step / 2), exact) > 0.05


def test_a_literal_algorithm_1() -> None:
    """The listing of section 2.2.2, its loops and its atan2, over an observer and a card off the centre."""
    observer, source_card = camera(23, x=0.7), card(4.0, width=3.0, middle=1.1)
    expected = []
    for w in wall_points(observer)[0]:
        normal = math.atan2(-1.0, 0.0)
        theta_o = -(normal - math.atan2(-5.0, 0.7 - w))
        total = 0.0
        for s, v in zip(source_card.elements_x, SOURCE, strict=True):
            theta_s = -(normal - math.atan2(-4.0, s - w))
            total += float(LOPSIDED.of_sum(theta_s + theta_o)) * v * math.cos(theta_s)
        expected.append(total)
    ours = spherical_convolution(observer, source_card, LOPSIDED, SOURCE, order=7, weights="cosine")
    np.testing.assert_allclose(ours[0], expected, rtol=0, atol=1e-8)  # order 7 at 5.6 steps a sigma: 1e-9


@pytest.mark.parametrize("order", [0, 1, 2, 3, 6])
def test_reading_one_value_is_reading_the_whole_convolution(order: int) -> None:
    """The FFT of 2,000 points rounds at some eps sqrt(log n) of a coefficient."""
    grid = HalfCircle(samples=1000, order=order)
    x = wall_points(camera(50))
    theta_s, theta_o = incident_angles(np.array([-5.0, 5.0]), 5.0, x[..., None]), outgoing_angles(camera(50), x)
    whole = grid.read(grid.outgoing(grid.spread(theta_s, SOURCE), LOPSIDED), theta_o)
    ours = spherical_convolution(camera(50), card(5), LOPSIDED, SOURCE, order=order)
    np.testing.assert_allclose(whole, ours, rtol=0, atol=200 * EPS)


def test_outgoing_light_is_the_sum_over_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    x = wall_points(camera(7))
    directions = half_circle_directions(1000)
    theta_s = incident_angles(np.array([-5.0, 5.0]), 5.0, x[..., None])
    expected = LOPSIDED.of_sum(theta_s[..., None, :] + directions[:, None]) @ SOURCE
    light = outgoing_light(camera(7), card(5), LOPSIDED, SOURCE, order=5)
    assert light.shape == (1, 7, 1000)
    np.testing.assert_allclose(light, expected, rtol=0, atol=1e-6)
    monkeypatch.setattr(spherical_module, "_CHUNK", 4000)  # two wall points at a time
    np.testing.assert_array_equal(outgoing_light(camera(7), card(5), LOPSIDED, SOURCE, order=5), light)


def test_turned_cameras_and_realisations() -> None:
    """No Hypothesis 6 here: (A, N, B) for any view; each realisation is its own render."""
    observer = dataclasses.replace(camera(60), fov=0.8, view_angles=(0.3, 0.0, -0.5))
    source = np.array([[0.5, 0.0, 2.0], [1.0, 1.0, 0.3]])
    exact = radiance(transport_matrix(observer, card(5), LOPSIDED, weights="cosine"), source)
    ours = spherical_convolution(observer, card(5), LOPSIDED, source, order=5, weights="cosine")
    assert ours.shape == (3, 60, 3)
    assert relative_error(ours, exact) < 1e-6
    far = card(5e4)
    exact = radiance(transport_matrix(observer, far, LOPSIDED, weights="cosine"), source)
    assert relative_error(angle_convolution(observer, far, LOPSIDED, source, weights="cosine"), exact) < 1e-6


# ------------------------------------------------------------------------------------------------ over an angle


def errors_over_angle(distances: Array, cards: Callable[[float], Card], **options: Any) -> Array:
    brdf = lobes(*FOUR)
    weights = options.get("weights", "thesis")
    return np.array(
        [
            relative_error(
                angle_convolution(camera(), cards(d), brdf, SOURCE, samples=2000, order=7, **options),
                algorithm_1(camera(), cards(d), brdf, weights),
            )
            for d in distances
        ]
    )


def slope(distances: Array, errors: Array) -> float:
    return float(np.polyfit(np.log(distances), np.log(errors), 1)[0])


DECADES = np.geomspace(1e3, 1e6, 4)


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
@pytest.mark.parametrize("variable", ["sum", "outgoing"])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_error_falls_as_one_over_distance(variable: str, turn: float, weights: str) -> None:
    """At a fixed angular width, 1 / d over three decades: the issue's figure, slope -1 +- .1."""
    errors = errors_over_angle(
        DECADES, lambda d: card(d, width=0.2 * d, middle=turn * d), variable=variable, weights=weights
    )
    assert abs(slope(DECADES, errors) + 1) < 0.1
    assert np.all(np.abs(np.diff(np.log10(errors)) + 1) < 0.1)  # in each decade


def test_at_a_fixed_width_it_falls_faster() -> None:
    """cos^2 theta_c - cos^2 theta_s is of first order in the width over d, of second order for a card straight ahead."""
    decades = np.geomspace(1e2, 1e4, 3)
    assert abs(slope(decades, errors_over_angle(decades, card)) + 3) < 0.1
    assert abs(slope(DECADES, errors_over_angle(DECADES, lambda d: card(d, middle=0.3 * d))) + 2) < 0.1


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_the_error_is_the_one_that_was_derived(turn: float) -> None:
    """delta_i turns by (x - x_r) (cos^2 theta_c - cos^2 theta_s,i) / y_s; times rho', that is the error to first order."""
    far, brdf, step = card(1e5, width=2e4, middle=turn * 1e5), lobes(*FOUR), 1e-5
    x = wall_points(camera())
    theta_s = incident_angles(np.array(far.elements_x), far.distance, x[..., None])
    theta_c = incident_angles(far.middle, far.distance, x)
    u = theta_s + outgoing_angles(camera(), x)[..., None]
    turned = (x - float(mirror_points(camera(), far, far.middle)))[..., None] / far.distance
    turned = turned * (np.cos(theta_c)[..., None] ** 2 - np.cos(theta_s) ** 2)
    rise = (brdf.of_sum(u + step) - brdf.of_sum(u - step)) / (2 * step)
    predicted = -(rise * turned) @ SOURCE
    error = angle_convolution(camera(), far, brdf, SOURCE, samples=2000, order=7) - algorithm_1(camera(), far, brdf)
    # The next order is (x - x_r) / y_s times as large, and rho'' enters with the turn over sigma: both below 1e-3.
    assert relative_error(error, predicted) < 2e-3
    assert relative_error(error, -predicted) > 1.9  # the sign matters


def test_q_alone_leaves_a_constant() -> None:
    """Both elements at tan a = .1 from the middle: cos theta_c / cos theta_s = 1 / cos a, at any distance."""
    far = np.array([1e4, 1e6])
    errors = errors_over_angle(far, lambda d: card(d, width=0.2 * d), weights="cosine", per_element=False)
    np.testing.assert_allclose(errors, math.sqrt(1.01) - 1, rtol=0.05)  # the rest of the error is 1e-4 at 1e4 m
    np.testing.assert_allclose(errors[1], math.sqrt(1.01) - 1, rtol=1e-3)


def test_faults_in_the_angle_convolution_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    far = card(1e5, width=2e4, middle=3e4)
    exact = algorithm_1(camera(), far, LOPSIDED, "cosine")

    def error() -> float:
        return relative_error(angle_convolution(camera(), far, LOPSIDED, SOURCE, weights="cosine"), exact)

    assert error() < 1e-3
    with monkeypatch.context() as planted:
        planted.setattr(angle_module, "mirror_directions", lambda *a, **k: -mirror_directions(*a, **k))
        assert error() > 0.5
    with monkeypatch.context() as planted:
        planted.setattr(angle_module, "cosine_factor", lambda *a, **k: np.ones_like(cosine_factor(*a, **k)))
        assert error() > 0.04  # cos 16.7 deg = .958
    with monkeypatch.context() as planted:
        half = math.pi / 2000
        planted.setattr(angle_module, "convolution_variable", lambda *a, **k: convolution_variable(*a, **k) + half)
        assert error() > 0.05


def test_the_mirror_shows_an_element_where_the_variable_says() -> None:
    """At the pixel that shows element i in a mirror, w = -delta_i (to first order in 1 / y_s) and u = 0."""
    far = card(1e6, width=2e5, middle=1e5)
    shown = np.argmax(mirror_render(camera(), far, np.eye(2))[0], axis=0)
    w = convolution_variable(camera(), far)[0]
    np.testing.assert_allclose(w[shown], mirror_directions(camera(), far), rtol=0, atol=1.1e-3)  # half a pixel, 1e-3


def test_resampling_onto_uniform_angles() -> None:
    at = convolution_variable(camera(400), card(50))[0]
    onto = np.linspace(at.min(), at.max(), 700)
    render = np.stack([np.sin(3 * at), at**3], axis=1)
    ours = resample(render, at, onto)
    np.testing.assert_allclose(ours[:, 1], onto**3, rtol=0, atol=1e-13)  # cubics come out exactly
    # A cubic spline's error is at most 5/384 h^4 f''''; h <= .006, f'''' <= 81.
    np.testing.assert_allclose(ours[:, 0], np.sin(3 * onto), rtol=0, atol=5 / 384 * 0.006**4 * 81)
    np.testing.assert_array_equal(resample([2.0], [0.1], [0.1]), [2.0])  # one sample
    np.testing.assert_allclose(resample([1.0, 2.0], [0.0, 1.0], [0.25]), [1.25])
    assert "outside" in refused(lambda: resample(at, at, onto * 1.1)).message
    assert "rise" in refused(lambda: resample([1.0, 2.0, 3.0], [0.0, 0.0, 1.0], [0.5])).message
    assert "odd" in refused(lambda: resample([1.0, 2.0, 3.0], [0.0, 0.5, 1.0], [0.5], order=2)).message
    assert refused(lambda: resample([1.0, math.nan], [0.0, 1.0], [0.5])).field == "render"
    assert refused(lambda: resample([1.0, 2.0, 3.0], [0.0, 1.0], [0.5])).field == "render"


# ----------------------------------------------------------------------------------------------- along the wall


def test_a_lobe_lands_where_tangents_add() -> None:
    """At x_m + y_o tan 30 deg instead of where the angle sum is -30 deg: .2 m off, more than its own width."""
    observer, lobe = camera(), lobes(-30)
    one = Card(elements_x=(5.0,), y=-50.0)
    x = wall_points(observer)[0]
    landed = x[np.argmax(wall_convolution(observer, one, lobe, [1.0]))]
    exact = x[np.argmax(radiance(transport_matrix(observer, one, lobe, weights="thesis"), [1.0]))]
    assert abs(landed - (5 / 11 + 5 * math.tan(math.radians(30)))) <= 0.005 + 1e-9  # half a pixel
    assert 0.19 < landed - exact < 0.21


def test_both_distances_are_right_to_first_order() -> None:
    """u = atan(x / y_o) + atan(x / y_s) = x (1 / y_o + 1 / y_s) + O(x^3): the lobe at .01 rad lands within 1e-4 of it."""
    observer = camera()
    one, x = Card(elements_x=(0.0,), y=-7.0), np.array([0.01 / (1 / 5 + 1 / 7)])
    narrow = GaussianTrain(centres=(-0.01,), sigma=0.001)
    assert float(projected_brdf(observer, one, narrow, x, projected_from="both")[0]) == pytest.approx(1, abs=1e-6)
    assert float(projected_brdf(observer, one, narrow, x)[0]) < 1e-3  # y_o alone puts it at .0058 rad


def test_arrays_convolve_to_the_exact_form() -> None:
    """A mirror image is up to half a pixel off its pixel, so the arrays' form is off by at most half a pixel's rise."""
    observer, source_card, brdf = camera(), card(50), lobes(*FOUR)
    arrays = convolve_centred(mirror_render(observer, source_card, SOURCE)[0], wall_kernel(observer, source_card, brdf))
    exact = wall_convolution(observer, source_card, brdf, SOURCE)[0]
    half_pixel_of_rise = np.linalg.norm(np.gradient(exact)) / 2
    assert np.linalg.norm(arrays - exact) < 1.05 * half_pixel_of_rise
    kernel = wall_kernel(observer, source_card, brdf)
    late = convolve_centred(mirror_render(observer, source_card, SOURCE)[0], np.append(kernel[1:], 0.0))
    assert np.linalg.norm(late - exact) > 1.05 * half_pixel_of_rise  # one sample late


def test_along_the_wall_it_does_not_converge() -> None:
    """At a fixed angular width the error stays; the half circle and the angle sum go on falling."""
    near, far = (convolution_errors(camera(), card(d, width=0.2 * d), lobes(*FOUR), SOURCE) for d in (1e4, 1e6))
    assert far["wall"] > 0.5
    assert far["wall"] == pytest.approx(near["wall"], rel=0.01)
    assert far["angle sum"] == pytest.approx(near["angle sum"] / 100, rel=0.1)
    assert far["spherical"] < 1e-6


@pytest.mark.parametrize("signal_size", [1, 2, 5, 64])
@pytest.mark.parametrize("kernel_size", [1, 3, 9, 301])
def test_centred_convolution_is_its_sum(signal_size: int, kernel_size: int) -> None:
    """Kernels shorter and longer than the signal; entries below 1 in the sums, so the FFT rounds at some eps n."""
    rng = np.random.default_rng(5)
    signal, kernel = rng.random((signal_size, 2)), rng.random(kernel_size)
    half = kernel_size // 2
    expected = [
        sum(signal[m] * kernel[half + n - m] for m in range(signal_size) if 0 <= half + n - m < kernel_size)
        for n in range(signal_size)
    ]
    np.testing.assert_allclose(convolve_centred(signal, kernel), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(convolve_centred(signal[:, 0], kernel), np.array(expected)[:, 0], rtol=0, atol=1e-13)


# --------------------------------------------------------------------------------------- the thesis's own figures


RECORDED = [
    (500, 5, TWO, 3.0e-4), (500, 5, FOUR, 5.0e-4),
    (1000, 5, TWO, 7.5e-5), (1000, 5, FOUR, 1.5e-4),
    (1000, 50, TWO, 1.2e-4), (1000, 50, FOUR, 2.4e-4),
]  # fmt: skip
Nearest = Callable[[int, Card, AngleSumBRDF], Array]


def off_the_record(render: Nearest) -> float:
    """Largest deviation of a nearest-direction render's mean squared errors from the published code's, relative."""
    off = []
    for pixels, distance, centres, recorded in RECORDED:
        brdf = lobes(*centres)
        exact = algorithm_1(camera(pixels), card(distance), brdf)
        mse = float(np.mean((render(pixels, card(distance), brdf) - exact) ** 2))
        off.append(abs(mse / recorded - 1))
    return max(off)


def test_nearest_directions() -> None:
    """Recorded to two digits, so 10 % for all six is the issue's figure and 5 % what rounding allows."""
    assert off_the_record(lambda n, c, brdf: nearest_spherical(camera(n), c, brdf, SOURCE)) < 0.05


def test_another_rounding_is_not_the_published_one() -> None:
    """Order 0 of our own grid takes nearest directions too, and differs."""
    assert (
        off_the_record(lambda n, c, brdf: spherical_convolution(camera(n), c, brdf, SOURCE, samples=n, order=0)) > 0.2
    )


@pytest.mark.parametrize(
    ("distance", "centres", "error", "correlation"),
    [(5, TWO, 1.65, None), (50, TWO, 0.874, 0.59), (50, FOUR, 1.06, 0.29)],
)
def test_scattered_wall_convolution(
    distance: float, centres: tuple[float, ...], error: float, correlation: float | None
) -> None:
    brdf = lobes(*centres)
    exact = algorithm_1(camera(), card(distance), brdf)[0]
    ours = scattered_wall_convolution(camera(), card(distance), brdf, SOURCE)
    assert relative_error(ours, exact) == pytest.approx(error, abs=0.006)  # as many digits as were recorded
    if correlation is not None:
        assert np.corrcoef(ours, exact)[0, 1] == pytest.approx(correlation, abs=0.006)


def test_holes_mirror_and_peaks() -> None:
    assert np.count_nonzero(~scattered_projection(camera(500), lobes(*FOUR))[1]) == 46
    x = wall_points(camera())[0]
    for render in (mirror_render, box_mirror_render):
        shown = render(camera(), card(50), SOURCE)[0]
        np.testing.assert_allclose(x[shown > 0], [-0.4555, 0.4555], rtol=0, atol=5e-5)
        np.testing.assert_array_equal(shown[shown > 0], SOURCE)
    exact = algorithm_1(camera(), card(50), lobes(*FOUR))[0]
    at = find_peaks(exact)[0]
    np.testing.assert_allclose(x[at], [-3.138, -2.017, -1.697, -0.746, 0.746, 1.697, 2.017, 3.138], rtol=0, atol=5e-4)
    # A peak lies up to half a pixel, .05 deg, off its sample, and its neighbour's tail adds .001.
    np.testing.assert_allclose(exact[at], [0.5, 1, 0.5, 1, 0.5, 1, 0.5, 1], rtol=0, atol=2e-3)


def test_the_box_falls_between_wall_points() -> None:
    """At N = 500 and y_s = -5 the box hits no wall point; the delta lights one pixel for each element."""
    assert np.count_nonzero(box_mirror_render(camera(500), card(5), SOURCE)) == 0
    assert np.count_nonzero(mirror_render(camera(500), card(5), SOURCE)) == 2
    assert np.count_nonzero(box_mirror_render(camera(1000), card(5), SOURCE)) == 2
    wide = box_mirror_render(camera(500), card(5), SOURCE, width=math.radians(0.4))  # wider than the .37 deg between
    assert np.count_nonzero(wide) == 2


# ------------------------------------------------------------------------------------------------- Hypothesis 8


def test_best_angle_sum_is_the_mean_along_the_lines() -> None:
    """Of 1 + cos(theta_s - theta_o) over |difference| <= c = 2 limit - |u| the mean is 1 + sin c / c."""

    class Difference(BRDF):
        def __call__(self, theta_s: Any, theta_o: Any) -> Array:
            return np.asarray(1 + np.cos(np.asarray(theta_s) - np.asarray(theta_o)))

    limit = math.radians(60)
    fit = best_angle_sum(Difference(), limit=limit, samples=801)
    u = np.linspace(-1.8, 1.8, 37)
    c = 2 * limit - np.abs(u)
    # The mean of n + 1 nodes instead of the integral: (1 + cos c) / n at most, n >= 100 here; the table adds 1e-5.
    np.testing.assert_allclose(fit.brdf.of_sum(u), 1 + np.sin(c) / c, rtol=0, atol=6e-3)
    assert fit.residual > 0.1


def test_best_angle_sum_tells_sums_from_products_and_differences() -> None:
    wide = lobes(-20, 10, sigma_deg=10)

    class Scaled(BRDF):
        def __call__(self, theta_s: Any, theta_o: Any) -> Array:
            return np.asarray(wide(theta_s, theta_o) / np.cos(theta_o))

    class Against(BRDF):  # the angle difference of the thesis's text, taken with our signs
        def __call__(self, theta_s: Any, theta_o: Any) -> Array:
            return wide.of_sum(np.asarray(theta_o) - np.asarray(theta_s))

    assert best_angle_sum(wide).residual < 1e-12
    assert best_angle_sum(Scaled()).residual > 0.1
    with_factor = best_angle_sum(Scaled(), outgoing_factor=True)
    assert with_factor.residual < 1e-4  # the alternation stands still at a relative 1e-6 of its last step
    ratio = with_factor.factor * np.cos(with_factor.theta_o)
    assert np.ptp(ratio[100:-100]) < 1e-3 * np.mean(ratio)
    np.testing.assert_allclose(
        with_factor.of_angles(0.1, 0.2), Scaled()(0.1, 0.2), rtol=2e-3  # the table and the factor are linear between nodes
    )  # fmt: skip
    assert best_angle_sum(Against()).residual > 0.5


# ---------------------------------------------------------------------------------------------------- bad input

FORMS: list[Callable[..., Array]] = [spherical_convolution, angle_convolution, wall_convolution]


@pytest.mark.parametrize("form", FORMS)
def test_inputs_are_checked(form: Callable[..., Array]) -> None:
    lobe, scene = lobes(10), (camera(20), card(50))
    assert refused(lambda: form(*scene, lobe, [1.0])).field == "source"
    assert refused(lambda: form(*scene, lobe, [1.0, math.nan])).field == "source"
    assert refused(lambda: form(*scene, lobe, [1.0, math.inf])).field == "source"
    assert refused(lambda: form(*scene, lobe, np.ones((2, 2, 2)))).field == "source"
    assert "mirror" in refused(lambda: form(*scene, Mirror(), SOURCE)).message
    assert "Hypothesis 8" in refused(lambda: form(*scene, Table(values=np.ones((3, 3))), SOURCE)).message
    assert refused(lambda: form(*scene, lobe, SOURCE, weights="physical")).field == "transport"


@pytest.mark.parametrize("form", FORMS)
def test_small_dark_and_single_precision_inputs(form: Callable[..., Array]) -> None:
    lobe = lobes(10)
    one_pixel = dataclasses.replace(camera(20), pixels=1, pixels_at="centres")
    assert form(one_pixel, card(50), lobe, SOURCE).shape == (1, 1)
    assert not np.any(form(camera(20), card(50), lobe, [0.0, 0.0]))
    single = form(camera(20), card(50), lobe, SOURCE.astype(np.float32))
    assert single.dtype == np.float64
    np.testing.assert_array_equal(single, form(camera(20), card(50), lobe, SOURCE))
    np.testing.assert_allclose(form(camera(20), card(50), Diffuse(albedo=0.5), SOURCE), 0.75 / math.pi, rtol=1e-12)


def test_a_grid_that_steps_over_the_brdf_is_refused() -> None:
    narrow = lobes(10, sigma_deg=0.1)
    error = refused(lambda: spherical_convolution(camera(20), card(50), narrow, SOURCE, samples=1000))
    assert error.field == "samples"
    assert "1800" in error.message
    assert refused(lambda: angle_convolution(camera(20), card(50), narrow, SOURCE)).field == "samples"
    assert refused(lambda: HalfCircle(samples=1)).field == "samples"
    assert refused(lambda: HalfCircle(samples=10, order=10)).field == "order"


def test_arrays_are_checked() -> None:
    assert refused(lambda: convolve_centred([1.0, 2.0], [1.0, 2.0])).field == "kernel"
    assert refused(lambda: convolve_centred([1.0, 2.0], [])).field == "kernel"
    assert refused(lambda: convolve_centred([], [1.0])).field == "signal"
    assert refused(lambda: convolve_centred([1.0, math.nan], [1.0])).field == "signal"
    assert refused(lambda: convolve_centred([1.0], [math.inf])).field == "kernel"
    single = convolve_centred(np.ones(3, np.float32), np.ones(3, np.float32))
    assert single.dtype == np.float64
    np.testing.assert_array_equal(convolve_centred([0.0, 0.0], [1.0, 2.0, 3.0]), [0.0, 0.0])
    with pytest.raises(UndeterminedError):
        relative_error([1.0], [0.0])


def test_settings_are_checked() -> None:
    scene = (camera(20), card(50), lobes(10), SOURCE)
    assert refused(lambda: angle_convolution(*scene, variable="incoming")).field == "variable"  # type: ignore[arg-type]
    assert refused(lambda: angle_convolution(*scene, reference_x=math.nan)).field == "reference_x"
    assert refused(lambda: wall_convolution(*scene, projected_from="card")).field == "projected_from"  # type: ignore[arg-type]
    turned = dataclasses.replace(camera(20), fov=0.5, view_angles=(0.2,))
    assert "Hypothesis 6" in refused(lambda: wall_kernel(turned, card(50), lobes(10))).message
    assert refused(lambda: outgoing_light(camera(3), card(50), lobes(10), np.ones((2, 2)))).field == "source"
    assert refused(lambda: best_angle_sum(Mirror())).field == "wall.brdf"
    assert refused(lambda: best_angle_sum(lobes(10), limit=2.0)).field == "limit"
    assert refused(lambda: best_angle_sum(lobes(10), samples=1)).field == "samples"
    with pytest.raises(UndeterminedError):
        best_angle_sum(Diffuse(albedo=0.0))
