"""The figures of sections 2.1, 2.2.3 and 3.1: their numbers from other places, and claims that follow the numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from wallmirror.thesis import ThesisFigure, make_figure, setting


@pytest.fixture(scope="module")
def figures() -> dict[str, ThesisFigure]:
    ids = ("2.1", "2.8", "2.9", "2.10", "2.12", "3.1", "3.2", "3.3", "3.1-far-field", "3.1-hypothesis-7")
    return {figure_id: make_figure(figure_id) for figure_id in ids}


def outcomes(figure: ThesisFigure) -> list[str]:
    return [claim.outcome for claim in figure.claims]


def test_geometry(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["2.1"].numbers
    # cos theta = 5 / |o - w| with o - w = (1.5, -5, -.8), and 3 / |s - w| with s - w = (3.9, -3, .4).
    assert numbers["theta_o (deg)"] == pytest.approx(math.degrees(math.acos(5 / math.hypot(1.5, 5, 0.8))))
    assert numbers["theta_s (deg)"] == pytest.approx(math.degrees(math.acos(3 / math.hypot(3.9, 3, 0.4))))
    assert numbers["w and s from eqs. 2.4 and 2.5, off by (m)"] < 1e-14
    assert outcomes(figures["2.1"]) == ["confirmed", "corrected"]
    for number in ("2.8", "2.9"):
        assert figures[number].numbers["theta_o at w (deg)"] == pytest.approx(math.degrees(math.atan(0.5)))
        assert figures[number].numbers["|theta_o| against eq. 2.3, off by (rad)"] < 1e-14


def test_algorithm_1(figures: dict[str, ThesisFigure]) -> None:
    mirror, lobes = figures["2.10"], figures["2.12"]
    assert mirror.numbers["elements in the mirror"] == 2
    assert mirror.numbers["elements in the box at N = 500"] == 0
    assert outcomes(mirror) == ["confirmed", "corrected"]
    assert lobes.numbers["copies, lobes of the text"] == lobes.numbers["copies, lobes of the code"] == 8
    # The lobe at u of an element in the middle is at 5 tan(u / 2); of one at 5 m it is where both angles make u.
    off = lobes.numbers["the same with an element halfway between (m)"]
    angle = math.radians(30)
    roots = np.roots([math.tan(angle), 10.0, -31.25 * math.tan(angle)])  # 2 y d = tan u (d^2 + e^2 / 4 - y^2)
    assert off == pytest.approx(float(min(abs(roots))) - 5 * math.tan(angle / 2), abs=1e-9)


def test_convolutions(figures: dict[str, ThesisFigure]) -> None:
    nearest, close, far = figures["3.1"].numbers, figures["3.2"].numbers, figures["3.3"].numbers
    assert nearest["nearest directions (thesis), mean squared error"] == pytest.approx(5.0e-4, rel=0.05)
    assert nearest["order 3 at 1,000 directions, relative error"] < 1e-4
    assert close["as published, relative error"] > 1
    assert far["as published, ±15°, relative error"] == pytest.approx(0.874, abs=0.006)
    assert far["as published, ±15° and ±30°, relative error"] == pytest.approx(1.06, abs=0.006)
    assert far["lobe at -30 deg of the right element lands off by (m)"] == pytest.approx(0.2, abs=0.01)
    assert [outcomes(figures[name]) for name in ("3.1", "3.2", "3.3")] == [
        ["confirmed", "corrected"],
        ["confirmed"],
        ["refuted"],
    ]


def test_far_field(figures: dict[str, ThesisFigure]) -> None:
    numbers = figures["3.1-far-field"].numbers
    assert abs(numbers["slope over the angle sum, fixed angular width, 1e3 to 1e6 m"] + 1) < 0.1
    assert abs(numbers["slope over the angle sum, fixed width"] + 3) < 0.1
    # cos theta_c / cos theta_s of elements at tan .1 from the middle
    assert numbers["error with the cosine as one Q at 1e6 m, fixed angular width"] == pytest.approx(
        math.sqrt(1.01) - 1, rel=1e-3
    )
    assert outcomes(figures["3.1-far-field"]) == ["confirmed", "corrected", "corrected"]
    assert figures["3.1-hypothesis-7"].numbers["along the wall, card 0.05 m wide"] > 1


def test_rough_metal() -> None:
    figure = make_figure("3.1-hypothesis-8")
    sharp, rough = (figure.numbers[f"q(θo) times one of the sum, roughness {alpha}"] for alpha in ("0.05", "1"))
    assert sharp < 1e-3 < 0.05 < rough  # masking and Fresnel only spoil wide lobes
    assert figure.numbers["ρ of the sum, roughness 0.05"] > 0.3
    assert outcomes(figure) == ["corrected"]


def test_peaks_are_refined() -> None:
    x = np.linspace(0, 1, 101)
    render = np.exp(-0.5 * ((x - 0.3037) / 0.05) ** 2) + 0.5 * np.exp(-0.5 * ((x - 0.8) / 0.05) ** 2)
    np.testing.assert_allclose(setting.peaks(x, render), [0.3037, 0.8], rtol=0, atol=2e-4)  # a fiftieth of a step
