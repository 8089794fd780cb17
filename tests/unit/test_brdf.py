"""Reflectance models against closed forms, SciPy's interpolators and the limits of float64."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate
from scipy.interpolate import RegularGridInterpolator

from wallmirror.brdf import (
    AngleSumTable,
    Diffuse,
    GaussianTrain,
    LobeHeight,
    Mirror,
    Phong,
    Sum,
    Table,
    tabulate,
)
from wallmirror.scene import load_scene, scene_names
from wallmirror.transport import build_kernel, transport_matrix

from .helpers import EPS, lobes, refused

Array = NDArray[np.float64]

FLOAT32_EPS = float(np.finfo(np.float32).eps)


def integral(of_sum: Callable[[float], float], stops_deg: list[float], span_deg: float = 90.0) -> float:
    """Integral over the angle sum in radians, split at the lobes so that none falls between the nodes."""
    ends = [-span_deg, *sorted(stops_deg), span_deg]
    pieces = [
        integrate.quad(of_sum, math.radians(a), math.radians(b), epsabs=0, epsrel=1e-12, limit=200)[0]
        for a, b in itertools.pairwise(ends)
    ]
    return float(sum(pieces))


# -- the thesis's test BRDF (eq. 2.15) ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("brdf", "centres", "peak"),
    [
        (GaussianTrain.of_the_text(), (-30, -15, 15, 30), 1 / math.sqrt(2 * math.pi)),
        (GaussianTrain.of_the_code(), (-35, -15, 15, 35), 1.0),
    ],
    ids=["text", "code"],
)
def test_lobes_stand_where_text_and_code_say_with_their_height(
    brdf: GaussianTrain, centres: tuple[int, ...], peak: float
) -> None:
    # Neighbours are 15 sigma away or more and add exp(-112) at most.
    np.testing.assert_allclose(brdf.of_sum(np.radians(centres)), peak, rtol=4 * EPS)
    # One sigma = 1 deg off the peak: exp(-1/2); half way between the lobes: nothing.
    np.testing.assert_allclose(brdf.of_sum(np.radians(np.array(centres) + 1)), peak * math.exp(-0.5), rtol=1e-12)
    assert brdf.of_sum(0.0) < 1e-40


def test_text_and_code_differ_where_the_thesis_contradicts_itself() -> None:
    text, code = GaussianTrain.of_the_text(), GaussianTrain.of_the_code()
    assert text.of_sum(math.radians(30)) > 0.39
    assert code.of_sum(math.radians(30)) < 1e-5  # exp(-25/2): its outer lobes stand at 35
    assert code.of_sum(math.radians(15)) / text.of_sum(math.radians(15)) == pytest.approx(math.sqrt(2 * math.pi))


def test_normalised_lobes_integrate_to_one_each_over_degrees_or_radians() -> None:
    centres = (-30.0, -15.0, 15.0, 30.0)
    text = GaussianTrain.of_the_text()
    per_radian = GaussianTrain(centres=text.centres, sigma=text.sigma, height="per_radian")
    # quad's stated 1e-12 for five pieces.
    in_degrees = math.degrees(integral(lambda u: float(text.of_sum(u)), list(centres)))
    in_radians = integral(lambda u: float(per_radian.of_sum(u)), list(centres))
    assert in_degrees == pytest.approx(4.0, rel=1e-11)
    assert in_radians == pytest.approx(4.0, rel=1e-11)
    # The twin: the unit matters by 180/pi, and "peak" is not normalised in either.
    assert integral(lambda u: float(text.of_sum(u)), list(centres)) == pytest.approx(4 * math.pi / 180, rel=1e-11)
    peak = GaussianTrain(centres=text.centres, sigma=text.sigma)
    in_degrees = math.degrees(integral(lambda u: float(peak.of_sum(u)), list(centres)))
    assert in_degrees == pytest.approx(4 * math.sqrt(2 * math.pi), rel=1e-11)


@pytest.mark.parametrize(
    ("sigma", "height", "peak"),
    [
        (1e-300, "peak", 1.0),
        (1e-310, "peak", 1.0),
        (5e-324, "peak", 1.0),
        (math.radians(1e-300), "per_degree", 1e300 / math.sqrt(2 * math.pi)),
        (1e-300, "per_radian", 1e300 / math.sqrt(2 * math.pi)),
    ],
)
def test_a_lobe_of_almost_no_width_is_its_peak_and_nothing_else(sigma: float, height: LobeHeight, peak: float) -> None:
    # normpdf(x) / normpdf(0), the thesis's way to a peak of 1, is 0/0 here. Off the peaks all is 0, without a warning.
    brdf = GaussianTrain(centres=(0.0, 0.5), sigma=sigma, height=height)
    values = brdf.of_sum([0.0, 0.5, 0.3, -1.0])
    np.testing.assert_allclose(values, [peak, peak, 0.0, 0.0], rtol=8 * EPS, atol=0)


@pytest.mark.parametrize("height", ["per_degree", "per_radian"])
def test_a_normalised_lobe_too_narrow_to_have_a_finite_height_is_refused(height: LobeHeight) -> None:
    assert refused(lambda: GaussianTrain(centres=(0.0,), sigma=1e-315, height=height)).field == "wall.sigma_deg"


def test_scale_multiplies_the_lobes() -> None:
    brdf = GaussianTrain(centres=(0.1,), sigma=0.02, scale=0.25)
    u = np.linspace(-0.1, 0.3, 7)
    np.testing.assert_allclose(brdf.of_sum(u), 0.25 * GaussianTrain(centres=(0.1,), sigma=0.02).of_sum(u), rtol=4 * EPS)


# -- other models ---------------------------------------------------------------------------------------------


def test_diffuse_is_albedo_over_pi_everywhere() -> None:
    values = Diffuse(albedo=0.6)(np.linspace(-1.5, 1.5, 5)[:, None], np.zeros(3))
    assert values.shape == (5, 3)
    np.testing.assert_array_equal(values, 0.6 / math.pi)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 7.5, 50.0, 1e6])
def test_phong_is_the_power_of_the_cosine_to_the_mirror_direction(exponent: float) -> None:
    brdf = Phong(exponent=exponent, reflectance=0.5)
    u = np.array([0.0, 0.3, -0.3, 1.2])
    # Twenty roundings of cos magnified by the exponent.
    expected = [math.cos(v) ** exponent for v in u]
    np.testing.assert_allclose(brdf.of_sum(u) / brdf.of_sum(0.0), expected, rtol=20 * EPS * (1 + exponent))
    # Behind the mirror direction's hemisphere there is nothing: an even power would come back without the cut.
    np.testing.assert_array_equal(brdf.of_sum([2.0, -2.0, math.pi]), 0.0)


def test_phong_peaks_for_the_mirror_and_not_for_equal_angles() -> None:
    brdf = Phong(exponent=50, reflectance=1)
    assert brdf(0.4, -0.4) == brdf.of_sum(0.0)
    assert brdf(0.4, 0.4) < 1e-3 * brdf(0.4, -0.4)


@pytest.mark.parametrize("exponent", [0.0, 3.0, 50.0, 2000.0])
def test_reflectance_of_phong_is_the_share_of_light_that_comes_back(exponent: float) -> None:
    brdf = Phong(exponent=exponent, reflectance=0.7)
    # At normal incidence, cylindrical: (pi/2) int rho(theta) cos(theta) dtheta.
    measured = math.pi / 2 * integral(lambda u: float(brdf.of_sum(u)) * math.cos(u), [-math.pi / 2, 0, math.pi / 2])
    assert measured == pytest.approx(0.7, rel=1e-10)


@pytest.mark.parametrize("exponent", [10.0, 50.0, 1e4])
def test_the_stated_scale_of_phong_is_that_of_its_gaussian(exponent: float) -> None:
    brdf = Phong(exponent=exponent)
    # cos(s)^n = exp(-n (s^2/2 + s^4/12 ...)): at one scale s = 1/sqrt(n) it is exp(-1/2) to 1/(12 n).
    ratio = float(brdf.of_sum(brdf.angular_scale) / brdf.of_sum(0.0))
    assert ratio == pytest.approx(math.exp(-0.5), rel=1 / (11 * exponent))


def test_a_sum_adds_its_parts_and_is_as_fine_as_the_finest() -> None:
    lobe, coat = lobes(sigma_deg=2.0), Diffuse(albedo=0.3)
    both = Sum(parts=(lobe, coat))
    u = np.linspace(-1, 1, 9)
    np.testing.assert_allclose(both.of_sum(u), lobe.of_sum(u) + coat.of_sum(u), rtol=2 * EPS)
    assert both.angular_scale == lobe.sigma


def test_angle_sum_models_do_not_care_which_angle_is_which() -> None:
    brdf, angles = lobes(), np.linspace(-1.4, 1.4, 11)
    values = brdf(angles[:, None], angles[None, :])
    np.testing.assert_array_equal(values, values.T)  # Helmholtz


def test_a_mirror_has_no_finite_values() -> None:
    assert "delta" in str(refused(lambda: Mirror()(0.0, 0.0)))


@pytest.mark.parametrize("name", [n for n in scene_names() if "mirror" not in n])
def test_walls_that_come_with_wallmirror_reflect_no_more_than_they_receive(name: str) -> None:
    # In space all models are constant along z: the out-of-plane integral of the cosine gives pi/2, so that the albedo is
    # pi/2 * integral rho cos(theta_o) d theta_o. (A diffuse wall shows it: pi/2 * albedo/pi * 2 = albedo.)
    brdf = load_scene(name).wall.brdf
    theta_o = np.linspace(-math.pi / 2, math.pi / 2, 7201)
    incident = np.radians(np.arange(-85.0, 86.0, 5.0))
    albedo = math.pi / 2 * np.trapezoid(brdf(incident[:, None], theta_o) * np.cos(theta_o), theta_o, axis=1)
    assert np.max(albedo) <= 1.0


def test_the_albedo_of_the_four_lobes_has_a_closed_form() -> None:
    # A Gaussian times a cosine: sigma sqrt(2 pi) exp(-sigma^2 / 2) cos(centre) at normal incidence.
    code = GaussianTrain.of_the_code()
    theta_o = np.linspace(-math.pi / 2, math.pi / 2, 7201)
    measured = math.pi / 2 * np.trapezoid(code(0.0, theta_o) * np.cos(theta_o), theta_o)
    share = code.sigma * math.sqrt(2 * math.pi) * math.exp(-(code.sigma**2) / 2)
    closed = math.pi / 2 * share * sum(math.cos(c) for c in code.centres)
    assert measured == pytest.approx(closed, rel=1e-12)  # the trapezoid rule is spectral for a Gaussian
    # Normalised per radian instead of per degree, the same four lobes would create light.
    text = GaussianTrain.of_the_text()
    bright = GaussianTrain(centres=text.centres, sigma=text.sigma, height="per_radian")
    albedo = [math.pi / 2 * np.trapezoid(b(0.0, theta_o) * np.cos(theta_o), theta_o) for b in (text, bright)]
    assert albedo[0] == pytest.approx(0.1004, abs=5e-5)
    assert albedo[1] == pytest.approx(5.754, abs=5e-4)


# -- tables ---------------------------------------------------------------------------------------------------


def test_a_table_of_the_angle_sum_interpolates_as_numpy_does() -> None:
    rng = np.random.default_rng(1)
    values = rng.random(17)
    table = AngleSumTable(start=-0.7, stop=1.1, values=values)
    u = rng.uniform(-0.69, 1.09, 200)
    slope = (u + 0.7) / 1.8 * 16
    cell = np.floor(slope).astype(int)
    by_hand = values[cell] + (slope - cell) * (values[cell + 1] - values[cell])
    # A rounding of u moves the value by the largest slope, 16/1.8 per radian.
    np.testing.assert_allclose(table.of_sum(u), by_hand, rtol=0, atol=20 * EPS)
    np.testing.assert_array_equal(table.of_sum([-0.7, 1.1]), values[[0, -1]])
    np.testing.assert_array_equal(table.of_sum([-0.701, 1.101]), 0.0)


def test_a_table_of_both_angles_interpolates_as_scipy_does() -> None:
    rng = np.random.default_rng(2)
    values = rng.random((9, 13))
    axes = tuple(np.linspace(-math.pi / 2, math.pi / 2, n) for n in values.shape)
    theta_s, theta_o = rng.uniform(-math.pi / 2, math.pi / 2, (2, 300))
    expected = RegularGridInterpolator(axes, values)(np.stack([theta_s, theta_o], axis=-1))
    measured = Table(values=values)(theta_s, theta_o)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=40 * EPS)
    # The twin: rows are theta_s; the transposed reading is another BRDF.
    assert np.max(np.abs(Table(values=values.T)(theta_s, theta_o) - expected)) > 0.1


def test_a_table_holds_its_nodes_to_the_ends_and_broadcasts() -> None:
    values = np.arange(6.0).reshape(2, 3)
    table = Table(values=values)
    angles = np.array([-math.pi / 2, math.pi / 2]), np.array([-math.pi / 2, 0.0, math.pi / 2])
    np.testing.assert_array_equal(table(angles[0][:, None], angles[1]), values)


def test_tables_keep_their_own_copy() -> None:
    values = np.ones(3)
    table = AngleSumTable(start=0.0, stop=1.0, values=values)
    values[:] = 7.0
    np.testing.assert_array_equal(table.of_sum([0.0, 0.5, 1.0]), 1.0)
    with pytest.raises(ValueError, match="read-only"):
        table.values[0] = 2.0


@pytest.mark.parametrize("nodes", [361, 1801, 7201])
def test_tabulation_errs_as_linear_interpolation_does(nodes: int) -> None:
    # Between nodes h apart, a straight line misses a curve by h^2/8 |f''| where it bends most, which for a lobe of height
    # 1 is 1/sigma^2 at its peak; and its mean square over the lobes is h^4/120 * integral f''^2, with 3 sqrt(pi) / (4
    # sigma^3) for one lobe. Higher orders: (h/sigma)^2, so that the coarsest table is left out of the equality.
    sigma, step = math.radians(1), 2 * math.pi / (nodes - 1)
    brdf = lobes(sigma_deg=1.0)
    u = np.linspace(-math.pi / 3, math.pi / 3, 200_001)
    error = tabulate(brdf, nodes).of_sum(u) - brdf.of_sum(u)
    largest = step**2 / (8 * sigma**2)
    rounding = FLOAT32_EPS / 2
    assert np.max(np.abs(error)) <= largest + rounding
    square = np.trapezoid(error**2, u)
    expected = 4 * step**4 / 120 * 3 * math.sqrt(math.pi) / (4 * sigma**3)
    if nodes > 361:
        assert square == pytest.approx(expected, rel=2 * (step / sigma) ** 2)


def test_tabulated_nodes_are_rounded_to_float32_and_no_more() -> None:
    brdf = lobes(sigma_deg=1.0)
    u = np.linspace(-math.pi, math.pi, 721)
    table = tabulate(brdf, 721)
    np.testing.assert_array_equal(table.values, table.values.astype(np.float32))
    np.testing.assert_allclose(table.values, brdf.of_sum(u), rtol=FLOAT32_EPS / 2, atol=1e-38)
    assert np.any(table.values != brdf.of_sum(u))


def test_interpolation_error_of_a_render_is_of_the_measured_size() -> None:
    # The prototype's renders of a sigma = 1 deg wall erred by 4.4e-3, 1.9e-4, 1.2e-5 with 361, 1801, 7201
    # nodes. Its scene is not recorded; ours (root mean square over the render's brightest pixel) is 1.4 times that with
    # all three, and falls as the step's square once the step is below sigma.
    scene = load_scene("flat_wall_lobes")
    observer = type(scene.observer)(**{**scene.observer.__dict__, "view_angles": (0.1,)})
    exact = transport_matrix(observer, scene.card, scene.wall.brdf)
    kernel = build_kernel(observer, scene.card, resolution=math.radians(1))
    rms = []
    for nodes, prototype in ((361, 4.4e-3), (1801, 1.9e-4), (7201, 1.2e-5)):
        error = kernel.apply(tabulate(scene.wall.brdf, nodes)) - exact
        rms.append(float(np.sqrt(np.mean(error**2)) / exact.max()))
        assert prototype / 2 < rms[-1] < prototype * 2
    assert rms[1] / rms[2] == pytest.approx(16, rel=0.1)


# -- refusals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Diffuse(albedo=1.01), "wall.albedo"),
        (lambda: Diffuse(albedo=-0.01), "wall.albedo"),
        (lambda: Diffuse(albedo=math.nan), "wall.albedo"),
        (lambda: Mirror(reflectance=1.5), "wall.reflectance"),
        (lambda: Mirror(reflectance=math.nan), "wall.reflectance"),
        (lambda: Phong(exponent=-1), "wall.exponent"),
        (lambda: Phong(exponent=math.inf), "wall.exponent"),
        (lambda: Phong(exponent=math.nan), "wall.exponent"),
        (lambda: Phong(exponent=1, reflectance=2), "wall.reflectance"),
        (lambda: GaussianTrain(centres=(), sigma=0.1), "wall.centres_deg"),
        (lambda: GaussianTrain(centres=(0.0, math.nan), sigma=0.1), "wall.centres_deg"),
        (lambda: GaussianTrain(centres=(4.0,), sigma=0.1), "wall.centres_deg"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=0.0), "wall.sigma_deg"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=-1.0), "wall.sigma_deg"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=math.inf), "wall.sigma_deg"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=math.nan), "wall.sigma_deg"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=0.1, scale=-1.0), "wall.scale"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=0.1, scale=math.inf), "wall.scale"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=0.1, scale=math.nan), "wall.scale"),
        (lambda: GaussianTrain(centres=(0.0,), sigma=0.1, height="area"), "wall.height"),  # type: ignore[arg-type]
        (lambda: AngleSumTable(start=1.0, stop=0.0, values=np.ones(3)), "wall.table"),
        (lambda: AngleSumTable(start=0.0, stop=math.nan, values=np.ones(3)), "wall.table"),
        (lambda: AngleSumTable(start=-math.inf, stop=0.0, values=np.ones(3)), "wall.table"),
        (lambda: AngleSumTable(start=0.0, stop=1.0, values=np.ones(1)), "wall.table"),
        (lambda: AngleSumTable(start=0.0, stop=1.0, values=np.ones((2, 2))), "wall.table"),
        (lambda: AngleSumTable(start=0.0, stop=1.0, values=np.array([0.0, math.nan])), "wall.table"),
        (lambda: AngleSumTable(start=0.0, stop=1.0, values=np.array([0.0, -1e-9])), "wall.table"),
        (lambda: Table(values=np.ones(4)), "wall.table"),
        (lambda: Table(values=np.ones((1, 4))), "wall.table"),
        (lambda: Table(values=np.full((2, 2), math.inf)), "wall.table"),
    ],
)
def test_bad_reflectances_are_refused(make: Callable[[], Any], field: str) -> None:
    assert refused(make).field == field
