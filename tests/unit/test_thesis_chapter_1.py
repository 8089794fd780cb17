"""The figures of chapter 1: their numbers against closed forms, and claims that would come out otherwise on other numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from wallmirror.brdf import audit
from wallmirror.radiosity import Box, neumann_series, transport_operator
from wallmirror.thesis import ThesisFigure, make_figure
from wallmirror.thesis.radiometry import _series_claims
from wallmirror.thesis.reflectance import _examples, _test_brdf_claims, audited

IDS = ("1.1", "1.2", "1.2-audits", "1.3", "1.4", "1.4-neumann")


@pytest.fixture(scope="module")
def figures() -> dict[str, ThesisFigure]:
    return {i: make_figure(i) for i in IDS}


def outcomes(figure: ThesisFigure) -> list[str]:
    return [claim.outcome for claim in figure.claims]


def test_each_figure_carries_its_id_claims_and_a_picture(figures: dict[str, ThesisFigure]) -> None:
    for number, figure in figures.items():
        assert figure.id == number
        assert figure.claims
        assert figure.to_png().startswith(b"\x89PNG")


def test_half_of_the_directions_come_back_without_their_quadrant(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["1.1"].numbers
    # Those with x > 0: a binomial share of 100,000 scatters by 0.0016.
    assert numbers["directions that come back with phi = arctan(y/x)"] == pytest.approx(0.5, abs=0.008)
    assert numbers["with the quadrant of (x, y)"] == 1.0
    # The midpoint rule of sin over [0, pi] is 1 + (pi/n)^2 / 24 times 2.
    assert numbers["sum over 1024 x 1024 steps / 4 pi - 1"] == pytest.approx((math.pi / 1024) ** 2 / 24, rel=1e-4)
    assert outcomes(figures["1.1"]) == ["confirmed", "corrected"]


def test_a_tilted_element_keeps_twice_its_solid_angle(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["1.2"].numbers
    assert numbers["error left, tilted without it"] == pytest.approx(1 / math.cos(math.radians(60)) - 1, rel=1e-5)
    for name in ("order of the error on the sphere", "order, flat and facing", "order, tilted with the cosine"):
        assert numbers[name] == pytest.approx(2, abs=0.02)
    assert outcomes(figures["1.2"]) == ["confirmed", "corrected"]


def test_the_measured_quotient_is_the_brdf_both_ways(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["1.3"].numbers
    # A light of a thousandth of its distance: the second order leaves some 1e-6.
    assert numbers["dL/dE with the smallest light (1/sr)"] == pytest.approx(
        numbers["rho of the model (1/sr)"], rel=1e-6
    )
    assert numbers["order in which the light's size matters"] == pytest.approx(2, abs=0.05)
    assert outcomes(figures["1.3"]) == ["confirmed", "confirmed"]


def test_energy_of_the_test_brdf_is_a_matter_of_its_unit(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["1.2-audits"].numbers
    # pi/2 exp(-sigma^2/2) (2 cos 15 + 2 cos 30 deg) per radian, and a degree of that per degree.
    s = math.radians(1)
    radian = math.pi * math.exp(-(s**2) / 2) * (math.cos(math.radians(15)) + math.cos(math.radians(30)))
    assert numbers["per radian"] == pytest.approx(radian, rel=1e-6)
    assert numbers["largest share, test BRDF per degree"] == pytest.approx(s * radian, rel=1e-6)
    assert outcomes(figures["1.2-audits"]) == ["confirmed", "corrected"]


def test_claims_on_the_test_brdf_follow_the_audits() -> None:
    found = {name: a for name, (_, a) in audited().items()}
    good = found["Mirror"]
    trains = [name for name in found if name.startswith("Test BRDF")]
    assert [c.outcome for c in _test_brdf_claims({**found, **dict.fromkeys(trains, good)})] == ["confirmed"] * 2
    bad = replace(good, reciprocity=replace(good.reciprocity, passed=False), energy=replace(good.energy, passed=False))
    assert [c.outcome for c in _test_brdf_claims({**found, **dict.fromkeys(trains, bad)})] == ["refuted"] * 2
    assert _examples({"a": good}).outcome == "confirmed"
    assert _examples({"a": good, "b": good, "c": bad}).outcome == "corrected"
    assert _examples({"a": good, "b": bad}).outcome == "refuted"


def test_the_table_shows_what_an_audit_says() -> None:
    for name, (model, found) in audited().items():
        assert audit(model) == found, name


def test_series_claims_follow_the_rooms() -> None:
    box = Box(size=(1.0, 2.0, 1.0), cells=2)
    factors = box.form_factors()
    rooms = {a: neumann_series(transport_operator(factors, a), box.on("z1"), 60) for a in (0.3, 0.9)}
    assert [c.outcome for c in _series_claims(rooms, 1.0, 0.9)] == ["confirmed", "corrected"]
    assert _series_claims(rooms, 0.97, 0.9)[1].outcome == "confirmed"
    grows = neumann_series(transport_operator(factors, 1.2), box.on("z1"), 60)
    assert _series_claims({1.2: grows}, 1.0, 0.9)[0].outcome == "refuted"
    # A radius that is not the ratio, as a wrong eigenvalue would be.
    wrong = replace(rooms[0.3], spectral_radius=0.35, largest_factor=0.35)
    assert _series_claims({0.3: wrong}, 1.0, 0.9)[0].outcome == "refuted"


def test_the_ratio_of_the_room_is_its_albedo(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["1.4-neumann"].numbers
    assert numbers["ratio at albedo 0.8"] == pytest.approx(0.8, rel=1e-3)
    assert numbers["spectral radius of a white closed room"] == pytest.approx(1.0, abs=1e-12)
    assert numbers["of a white room with one wall missing"] < 0.95
    assert numbers["rows of F sum to 1 within"] < 1e-12
    assert outcomes(figures["1.4-neumann"]) == ["confirmed", "corrected"]
    assert outcomes(figures["1.4"]) == ["corrected"]
