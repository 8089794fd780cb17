"""Blinn, Cook-Torrance and Phong's other forms against closed forms and quadrature; tabulation and its error; audits.

References: scipy's adaptive quadrature, mpmath, and identities that the models must satisfy. Each audit has its planted
fault: an albedo of 1.001, a negative value, a table that is not reciprocal, a wrong shadowing term.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate

from wallmirror.brdf import (
    BRDF,
    AngleSumBRDF,
    AngleSumTable,
    Blinn,
    CookTorrance,
    Diffuse,
    FacetDistribution,
    Fresnel,
    GaussianTrain,
    GeneralSum,
    Mirror,
    Phong,
    PhongIllumination,
    Schlick,
    Sum,
    Table,
    audit,
    directional_albedo,
    directional_albedos,
    tables,
    tabulate_to,
)

from .helpers import EPS, lobes, refused, same_examples

Array = NDArray[np.float64]
HALF = math.pi / 2
WHITE = Schlick(f0=1.0)
DISTRIBUTIONS: tuple[FacetDistribution, ...] = ("ggx", "beckmann")


def quad(function: Any, low: float = -HALF, high: float = HALF, near: float = 0.1, at: float = 0.0) -> float:
    """Adaptive quadrature, told of a feature of width `near` at `at`."""
    points = [p for p in (at - near, at - near / 5, at, at + near / 5, at + near) if low < p < high]
    return float(integrate.quad(function, low, high, points=points, epsabs=0, epsrel=1e-11, limit=400)[0])


# -- Phong and Blinn ------------------------------------------------------------------------------------------


def test_plain_phong_peaks_at_its_coefficient_whatever_that_reflects() -> None:
    for exponent in (0.0, 2.0, 50.0):
        plain = Phong(exponent=exponent, reflectance=0.9, form="plain")
        assert plain.of_sum(0.0) == 0.9
        share = HALF * quad(lambda u, p=plain: float(p.of_sum(u)) * math.cos(u))
        # The conserving form with that share is the same lobe, where there is one.
        if share <= 1:
            same = Phong(exponent=exponent, reflectance=share)
            np.testing.assert_allclose(same.of_sum([0.0, 0.4]), plain.of_sum([0.0, 0.4]), rtol=1e-10)
    # int cos^3 = 4/3: a plain lobe of exponent 2 and coefficient 1 sends back 2 pi / 3 of what it receives.
    white = Phong(exponent=2.0, reflectance=1.0, form="plain")
    assert directional_albedo(white) == pytest.approx(2 * math.pi / 3, rel=1e-9)


@pytest.mark.parametrize("exponent", [0.0, 3.0, 50.0, 1e4])
def test_reflectance_of_blinn_is_the_share_of_light_that_comes_back(exponent: float) -> None:
    brdf = Blinn(exponent=exponent, reflectance=0.7)
    share = HALF * quad(lambda u: float(brdf.of_sum(u)) * math.cos(u), near=brdf.angular_scale)
    assert share == pytest.approx(0.7, rel=1e-10)


def test_blinn_is_the_power_of_the_cosine_to_the_half_direction() -> None:
    """By vectors in the plane, which know nothing of angle sums."""
    rng = np.random.default_rng(4)
    s, o = rng.uniform(-1.5, 1.5, (2, 50))
    half = np.array([np.sin(s) + np.sin(o), np.cos(s) + np.cos(o)])
    cosine = half[1] / np.linalg.norm(half, axis=0)
    brdf = Blinn(exponent=37.0, reflectance=0.8, form="plain")
    # Half vectors of nearly opposite directions cancel: 1/|half| <= 1/(2 cos 1.5) = 7 times as many roundings.
    np.testing.assert_allclose(brdf(s, o), 0.8 * cosine**37, rtol=37 * 40 * EPS)


def test_blinn_resembles_phong_of_a_quarter_of_the_exponent() -> None:
    # cos(u/2)^4n and cos(u)^n: both exp(-n u^2 / 2) to n u^4 (1/12 - 1/48) = n u^4 / 16.
    u, n = 0.1, 100.0
    blinn = Blinn(exponent=4 * n, form="plain").of_sum(u)
    phong = Phong(exponent=n, form="plain").of_sum(u)
    assert blinn / phong - 1 == pytest.approx(n * u**4 / 16, rel=0.02)


@pytest.mark.parametrize("exponent", [10.0, 50.0, 1e4])
def test_the_stated_scale_of_blinn_is_that_of_its_gaussian(exponent: float) -> None:
    brdf = Blinn(exponent=exponent)
    ratio = float(brdf.of_sum(brdf.angular_scale) / brdf.of_sum(0.0))
    assert ratio == pytest.approx(math.exp(-0.5), rel=1 / (11 * exponent))


# -- Fresnel --------------------------------------------------------------------------------------------------


def test_fresnel_at_the_angles_that_have_names() -> None:
    glass = Fresnel(eta=1.5)
    assert glass(1.0) == pytest.approx(((1.5 - 1) / (1.5 + 1)) ** 2, rel=4 * EPS)
    assert glass(0.0) == 1.0
    # At Brewster's angle tan = eta the wave along the plane is not reflected, the other with ((eta^2-1)/(eta^2+1))^2.
    brewster = math.cos(math.atan(1.5))
    assert glass(brewster) == pytest.approx(0.5 * ((1.5**2 - 1) / (1.5**2 + 1)) ** 2, rel=1e-14)
    # From glass into air everything is reflected beyond the critical angle.
    np.testing.assert_allclose(Fresnel(eta=1 / 1.5)([0.1, 0.5, 0.74]), 1.0, rtol=1e-14)
    assert Fresnel(eta=1 / 1.5)(0.76) < 0.6
    metal = Fresnel(eta=0.2, k=3.9)
    assert metal(1.0) == pytest.approx(((0.2 - 1) ** 2 + 3.9**2) / ((0.2 + 1) ** 2 + 3.9**2), rel=1e-14)


@pytest.mark.parametrize("index", [1.5, 0.2 + 3.9j, 1.1 + 6.6j])
def test_fresnel_is_maxwells_boundary_condition(index: complex) -> None:
    """Continuity of the tangential fields at 30 digits, with the refracted angle from Snell's law in mpmath."""
    cosine = 0.3
    with mpmath.workdps(30):
        n, c = mpmath.mpc(index), mpmath.mpf(cosine)
        inside = mpmath.sqrt(1 - (1 - c**2) / n**2)
        across = abs((c - n * inside) / (c + n * inside)) ** 2
        along = abs((n * c - inside) / (n * c + inside)) ** 2
        expected = float((across + along) / 2)
    assert Fresnel(eta=index.real, k=index.imag)(cosine) == pytest.approx(expected, rel=1e-14)


def test_schlick_approximates_fresnel() -> None:
    cosines = np.linspace(0, 1, 50)
    # They meet at both ends; in between the fifth power is up to 0.036 too bright, at 85 deg.
    apart = Schlick(f0=0.04)(cosines) - Fresnel(eta=1.5)(cosines)
    assert 0.03 < np.max(np.abs(apart)) < 0.04
    assert math.degrees(math.acos(cosines[np.argmax(apart)])) == pytest.approx(85, abs=2)
    assert Schlick(f0=0.04)(1.0) == 0.04
    assert Schlick(f0=0.04)(0.0) == 1.0


# -- Cook-Torrance --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("alpha", [0.02, 0.3, 1.0])
def test_facets_cover_the_wall(distribution: FacetDistribution, alpha: float) -> None:
    """Projected onto the wall, facets have its area: int D cos d omega = 1 in space, int D1 cos dh = 1 in the plane."""
    grooves = CookTorrance(alpha=alpha, distribution=distribution)
    isotropic = replace(grooves, facets="isotropic")
    assert quad(lambda h: float(grooves.density(h)) * math.cos(h), near=alpha) == pytest.approx(1, rel=1e-10)
    space = quad(
        lambda h: 2 * math.pi * float(isotropic.density(h)) * math.cos(h) * math.sin(h), 0, HALF, near=alpha, at=0.0
    )
    assert space == pytest.approx(1, rel=1e-10)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("alpha", [0.05, 0.4])
def test_grooves_are_the_isotropic_facets_seen_along_the_grooves(distribution: FacetDistribution, alpha: float) -> None:
    """D1 is D with the slope along z integrated out: slopes p, q have the density D cos^4, cos^-2 = 1 + p^2 + q^2."""
    grooves = CookTorrance(alpha=alpha, distribution=distribution)
    isotropic = replace(grooves, facets="isotropic")
    for h in (0.0, 0.1, 0.7):
        p = math.tan(h)

        def slopes(angle: float, p: float = p) -> float:
            q = math.tan(angle)
            steep = math.hypot(p, q)
            return float(isotropic.density(math.atan(steep))) / (1 + steep**2) ** 2 * (1 + q**2)

        marginal = 2 * quad(slopes, 0, HALF, near=math.atan(max(alpha, p)))
        expected = marginal / math.cos(h) ** 3  # D1 cos dh = (marginal) dp
        assert grooves.density(h) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("theta", [0.0, 0.5, 1.3, 1.56])
def test_shadowing_leaves_the_projected_area_of_the_wall_visible(distribution: FacetDistribution, theta: float) -> None:
    """int D1 G1(theta) max(0, cos(h - theta)) dh = cos(theta): the identity that defines Smith's G1 (Heitz 2014, eq. 5)."""
    model = CookTorrance(alpha=0.3, distribution=distribution)

    def visible(shadowing: float) -> float:
        return shadowing * quad(
            lambda h: float(model.density(h)) * math.cos(h - theta), max(-HALF, theta - HALF), HALF, near=0.3
        )

    assert visible(float(model.masking(theta))) == pytest.approx(1, rel=1e-9)
    if theta > 1:
        # The twins: the other distribution's shadowing, roughness by another convention, and none.
        other = replace(model, distribution="ggx" if distribution == "beckmann" else "beckmann")
        rougher = replace(model, alpha=0.3 * math.sqrt(2))
        for wrong in (float(other.masking(theta)), float(rougher.masking(theta)), 1 / math.cos(theta)):
            assert abs(visible(wrong) - 1) > 1e-3


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_a_wall_of_white_grooves_loses_only_what_facets_block(distribution: FacetDistribution) -> None:
    smooth, rough = (CookTorrance(alpha=a, distribution=distribution, fresnel=WHITE) for a in (0.01, 0.5))
    incidence = np.radians([0.0, 40.0, 70.0, 85.0])
    # Nearly smooth, nearly everything comes back; rough, something is blocked, and never more than 1 returns.
    assert np.all(np.abs(directional_albedos(smooth, incidence) - 1) < 0.02)
    assert np.all(directional_albedos(rough, incidence) < 0.99)
    assert np.all(directional_albedos(rough, np.linspace(-1.57, 1.57, 41)) < 1)


def test_cook_torrance_is_finite_at_the_horizon_and_dark_below() -> None:
    for distribution in DISTRIBUTIONS:
        model = CookTorrance(alpha=0.1, distribution=distribution)
        edge = np.array([-HALF, 0.0, HALF])
        assert np.all(np.isfinite(model(edge[:, None], edge)))
        np.testing.assert_array_equal(model([1.6, -2.0, 0.0], [0.0, 0.0, 1.6]), 0.0)
        # G1 / cos is continuous there: 2 / alpha for GGX, 2 sqrt(pi) / alpha for Beckmann.
        limit = 2 / 0.1 if distribution == "ggx" else 2 * math.sqrt(math.pi) / 0.1
        assert model.masking(HALF) == pytest.approx(limit, rel=1e-12)
        assert model.masking(HALF - 1e-9) == pytest.approx(limit, rel=1e-7)


@same_examples
@given(
    st.floats(-HALF, HALF),
    st.floats(-HALF, HALF),
    st.floats(1e-3, 1),
    st.sampled_from(DISTRIBUTIONS),
    st.sampled_from(["grooves", "isotropic"]),
)
def test_cook_torrance_is_reciprocal_finite_and_not_negative(s: float, o: float, alpha: float, d: Any, f: Any) -> None:
    model = CookTorrance(alpha=alpha, distribution=d, facets=f)
    there, back = float(model(s, o)), float(model(o, s))
    assert math.isfinite(there)
    assert there >= 0
    assert there == pytest.approx(back, rel=8 * EPS, abs=0)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: CookTorrance(alpha=0.0), "wall.alpha"),
        (lambda: CookTorrance(alpha=1.5), "wall.alpha"),
        (lambda: CookTorrance(alpha=math.nan), "wall.alpha"),
        (lambda: CookTorrance(distribution="phong"), "wall.distribution"),  # type: ignore[arg-type]
        (lambda: CookTorrance(facets="flat"), "wall.facets"),  # type: ignore[arg-type]
        (lambda: Fresnel(eta=0.0), "wall.eta"),
        (lambda: Fresnel(eta=1.5, k=-1.0), "wall.k"),
        (lambda: Schlick(f0=1.1), "wall.f0"),
        (lambda: Blinn(exponent=-1.0), "wall.exponent"),
        (lambda: Blinn(reflectance=1.1), "wall.reflectance"),
        (lambda: Blinn(form="white"), "wall.form"),  # type: ignore[arg-type]
        (lambda: PhongIllumination(specular=2.0), "wall.specular"),
        (lambda: tabulate_to(Diffuse(), 0.0), "tolerance"),
        (lambda: audit(Diffuse(), tolerance=-1.0), "tolerance"),
    ],
)
def test_settings_out_of_range_are_refused(make: Any, field: str) -> None:
    assert refused(make).field == field


# -- tabulation -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_a_tabulated_model_is_right_to_the_tolerance_everywhere(tolerance: float) -> None:
    brdf = lobes(-35, 15, sigma_deg=2.0)
    found = tabulate_to(brdf, tolerance)
    u = np.random.default_rng(0).uniform(-math.pi, math.pi, 100_000)
    error = float(np.max(np.abs(found.table(u / 2, u / 2) - brdf.of_sum(u)))) / found.table.values.max()
    # The middles of cells, where it was measured, are within (step / sigma)^2 / 10 of the worst place; random places
    # come as close to it.
    assert error <= found.error * 1.05
    assert error > 0.9 * found.error
    assert tolerance / 20 < found.error <= tolerance
    # h^2 / 8 |f''|, with f'' = -1 / sigma^2 at a peak.
    step = 2 * math.pi / (found.table.values.size - 1)
    assert found.error == pytest.approx((step / math.radians(2)) ** 2 / 8, rel=0.2)


def test_a_tabulated_model_of_both_angles_names_where_it_is_worst() -> None:
    brdf = CookTorrance(alpha=0.3, fresnel=Fresnel(eta=0.2, k=3.9))
    found = tabulate_to(brdf, 1e-2)
    assert isinstance(found.table, Table)
    s, o = np.random.default_rng(0).uniform(-HALF, HALF, (2, 100_000))
    largest = found.table.values.max()
    error = np.abs(found.table(s, o) - brdf(s, o)) / largest
    assert error.max() <= 1.1 * found.error
    here = abs(float(found.table(*found.where) - brdf(*found.where))) / largest
    assert here == pytest.approx(found.error, rel=1e-6)
    # The twin: on half the nodes it is not right any more.
    half = Table(values=found.table.values[::2, ::2])
    assert np.max(np.abs(half(s, o) - brdf(s, o))) / largest > 2 * found.error


def test_a_narrow_lobe_does_not_slip_between_the_nodes() -> None:
    brdf = GaussianTrain(centres=(0.2345,), sigma=math.radians(0.02))
    found = tabulate_to(brdf, 1e-2)
    assert found.table.values.max() > 0.99
    assert refused(lambda: tabulate_to(GaussianTrain(centres=(0.2345,), sigma=1e-9))).field == "wall.brdf"


def test_a_model_that_no_table_can_hold_is_refused_with_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "MOST_ANGLE_NODES", 400)  # 2881 take seconds
    error = refused(lambda: tabulate_to(Table(values=np.eye(40)), 1e-6))
    assert error.field == "wall.brdf"
    assert "400" in error.message
    assert "is left" in error.message


def test_a_dark_wall_is_tabulated_without_a_quotient_of_zeros() -> None:
    assert tabulate_to(Diffuse(albedo=0.0)).error == 0.0


# -- audits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "brdf",
    [
        Diffuse(albedo=1.0),
        Mirror(),
        Phong(exponent=50, reflectance=1.0),
        Blinn(exponent=3, reflectance=1.0),
        GaussianTrain.of_the_text(),
        GaussianTrain.of_the_code(),
        CookTorrance(alpha=0.05, fresnel=WHITE),
        CookTorrance(alpha=1.0, distribution="beckmann", fresnel=WHITE),
        Sum(parts=(Phong(reflectance=0.5), Diffuse(albedo=0.5))),
    ],
    ids=lambda b: type(b).__name__,
)
def test_models_that_can_be_walls_pass_their_audit(brdf: BRDF) -> None:
    found = audit(brdf)
    assert found.passed
    assert found.violated == ()
    assert found.energy.value <= 1 + 1e-9


@dataclass(frozen=True)
class Scaled(AngleSumBRDF):
    """A planted fault: a diffuse wall of any albedo, or with a dent of any depth at one angle sum."""

    albedo: float = 0.5
    dent: float = 0.0
    at: float = 0.7

    def of_sum(self, u: Any) -> Array:
        u = np.asarray(u, dtype=np.float64)
        return self.albedo / math.pi - self.dent * np.exp(-0.5 * ((u - self.at) / 0.1) ** 2)

    @property
    def angular_scale(self) -> float:
        return 0.1


@pytest.mark.parametrize("albedo", [1.001, 1.00001])
def test_a_wall_that_reflects_a_little_too_much_is_caught(albedo: float) -> None:
    found = audit(Scaled(albedo=albedo))
    assert found.violated == ("energy conservation",)
    assert found.energy.value == pytest.approx(albedo, rel=1e-9)
    assert "NOT energy-conserving" in found.sentences()[2]
    assert audit(Scaled(albedo=1.0)).passed


def test_too_much_light_is_found_where_it_is_and_to_the_digit() -> None:
    # One lobe off the mirror direction, unit integral per radian: the albedo is pi/2 exp(-sigma^2/2) cos(centre -
    # theta_s), largest where the lobe leaves upright, in light from 33.3 deg.
    centre, sigma = math.radians(33.3), math.radians(1)
    found = audit(GaussianTrain(centres=(centre,), sigma=sigma, height="per_radian"))
    assert found.violated == ("energy conservation",)
    assert found.energy.value == pytest.approx(HALF * math.exp(-(sigma**2) / 2), rel=1e-7)
    assert found.energy.where[0] == pytest.approx(centre, abs=1e-3)


def test_a_negative_value_is_caught_with_its_direction() -> None:
    found = audit(Scaled(dent=0.16))
    assert found.violated == ("non-negativity",)
    assert sum(found.non_negativity.where) == pytest.approx(0.7, abs=0.02)
    assert found.non_negativity.value == pytest.approx(0.5 / math.pi - 0.16, abs=2e-4)
    assert audit(Scaled(dent=0.15)).passed


def test_a_table_that_is_not_reciprocal_is_caught_with_its_direction() -> None:
    theta = np.linspace(-HALF, HALF, 91)
    values = 0.1 + 0.05 * np.cos(theta[:, None] - theta)
    assert audit(Table(values=values)).passed
    values[20, 65] *= 1.01
    found = audit(Table(values=values))
    assert found.violated == ("reciprocity",)
    pair = sorted(np.degrees(found.reciprocity.where))
    assert pair == pytest.approx(sorted(np.degrees(theta[[20, 65]])), abs=0.3)
    # 1 % of the planted value over the largest value of all, on a grid four times as fine as the table.
    expected = 0.01 / 1.01 * values[20, 65] / values.max()
    assert found.reciprocity.value == pytest.approx(expected, rel=0.01)


def test_phongs_formula_of_1975_is_neither_reciprocal_nor_conserving() -> None:
    found = audit(PhongIllumination(exponent=50, specular=0.5))
    assert found.violated == ("reciprocity", "energy conservation")
    assert abs(abs(math.degrees(found.energy.where[0])) - 90) < 0.1
    # At grazing half of the lobe is left: pi/2 * 0.5 / cos * int_0^(pi/2) cos^50 sin = pi/4 / (51 cos).
    cosine = math.cos(found.energy.where[0])
    assert found.energy.value == pytest.approx(math.pi / 4 / 51 / cosine, rel=0.02)


def test_isotropic_facets_continued_along_z_do_not_conserve_energy_and_grooves_do() -> None:
    isotropic = CookTorrance(alpha=0.1, fresnel=WHITE, facets="isotropic")
    assert audit(isotropic).violated == ("energy conservation",)
    assert audit(replace(isotropic, facets="grooves")).passed


def test_rho_test_creates_light_if_normalised_per_radian() -> None:
    for train in (GaussianTrain.of_the_text(), replace(GaussianTrain.of_the_code(), height="per_degree")):
        assert audit(train).passed
        bright = audit(replace(train, height="per_radian"))
        assert bright.violated == ("energy conservation",)
        # 180 / pi times as much; four lobes, so up to 2 pi.
        assert bright.energy.value == pytest.approx(math.degrees(1) * audit(train).energy.value, rel=1e-9)
        assert 5 < bright.energy.value < 2 * math.pi


def test_an_audit_that_cannot_see_refuses() -> None:
    class Needle(BRDF):
        def __call__(self, theta_s: Any, theta_o: Any) -> Array:
            return np.zeros(np.broadcast_shapes(np.shape(theta_s), np.shape(theta_o)))

        @property
        def angular_scale(self) -> float:
            return 1e-6

    assert refused(lambda: audit(Needle())).field == "wall.brdf"
    narrow = GaussianTrain(centres=(0.0,), sigma=1e-9)
    assert refused(lambda: audit(narrow)).field == "wall.brdf"
    assert refused(lambda: directional_albedo(narrow)).field == "wall.brdf"
    assert "finite" in refused(lambda: audit(Scaled(albedo=math.inf))).message


def test_albedos_are_those_of_adaptive_quadrature() -> None:
    for brdf in (CookTorrance(alpha=0.1), GeneralSum(parts=(Blinn(), CookTorrance(distribution="beckmann")))):
        for incidence in (0.0, 0.8, -1.4):
            exact = HALF * quad(lambda o, b=brdf, i=incidence: float(b(i, o)) * math.cos(o), near=0.1, at=-incidence)
            assert directional_albedo(brdf, incidence) == pytest.approx(exact, rel=1e-6)


def test_a_table_cut_off_inside_its_window_is_integrated_too() -> None:
    table = AngleSumTable(start=-0.3, stop=0.5, values=np.full(81, 0.2))
    # 0.2 pi/2 (sin 0.5 + sin 0.3), but for the two cells at the cut, a hundredth of a radian each.
    exact = 0.2 * HALF * (math.sin(0.5) + math.sin(0.3))
    assert directional_albedo(table) == pytest.approx(exact, abs=0.2 * HALF * 0.01)
