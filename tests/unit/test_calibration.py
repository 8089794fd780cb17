"""Self-calibration: the card's place from the captures alone, its error bars, and where the captures do not tell it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from wallmirror.brdf import AngleSumBRDF
from wallmirror.captures import CaptureSet
from wallmirror.derendering.calibration import Calibration, Parameter, calibrate, moved
from wallmirror.derendering.calibration_films import Films, Point
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.solve import solve
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Card, Observer
from wallmirror.transport import Weights, radiance, transport_matrix

from .helpers import assert_undetermined, lobes, refused, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]

NOISE = 0.01  # 40 dB


def patterns(elements: int = 4, realisations: int = 20, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((elements, realisations))


def captured(
    believed: Card,
    truth: Card,
    *,
    observer: Observer | None = None,
    brdf: AngleSumBRDF | None = None,
    weights: Weights = "thesis",
    noise: float = 0.0,
    stated: bool = False,
    seed: int = 0,
) -> CaptureSet:
    """Films of the true card, filed under the card that one believes in."""
    observer = observer or thesis_observer(120, 4)
    brdf = brdf or lobes(sigma_deg=3.0)
    source = patterns(truth.elements, 20 if observer.pixels == 500 else 8)
    films = radiance(transport_matrix(observer, truth, brdf, weights=weights, tolerance=1e-12), source)
    sigma = noise * float(np.sqrt(np.mean(films**2)))
    films = films + sigma * np.random.default_rng(seed).standard_normal(films.shape)
    variance = np.full(films.shape, sigma**2) if stated else None
    return CaptureSet(observer=observer, card=believed, transport=weights, radiance=films, variance=variance)


def astray(card: Card, x: float, y: float, width: float) -> Card:
    """A card believed to be off by shares of its width, its distance and its width."""
    return moved(card, x * float(np.ptp(card.elements_x)), 1 + y, 1 + width)


def misplaced(found: Calibration, truth: Card) -> float:
    """Largest error of an element's position against the card's distance."""
    across = np.max(np.abs(np.subtract(found.card.elements_x, truth.elements_x)))
    return float(max(across, abs(found.card.y - truth.y))) / truth.distance


# -- exact without noise --------------------------------------------------------------------------------------


def test_the_thesis_card_is_found_from_a_fifth_off_in_everything() -> None:
    # 20 % of the width aside, 20 % off in distance and width, all at once, at N 500, A 20, B 20. Asked: 1e-8; the residual
    # ends at 1e-12 of the films and the curvature magnifies it by 1 to 10: 1e-13 measured, 1e-10 leaves room.
    truth = thesis_card()
    believed = astray(truth, 0.2, 0.2, -0.2)
    captures = captured(believed, truth, observer=thesis_observer(), brdf=lobes())
    found = calibrate(captures)
    assert misplaced(found, truth) < 1e-10
    assert found.method == "closed_form"
    assert found.mismatch_before > 0.1
    assert found.mismatch_after < 1e-20
    # The error is within what the result says of itself.
    assert abs(found.values["y"] - truth.y) <= found.std["y"] < 1e-9
    # And the card goes into a solve; the twin, the card as given, is of no use there.
    solution = solve(dataclasses.replace(captures, card=found.card), method="closed_form", step_deg=0.125)
    assert up_to_scale(solution.source, patterns()) < 1e-11
    assert_undetermined(lambda: solve(captures, method="closed_form", step_deg=0.125))


def test_strips_keep_their_share_of_the_width() -> None:
    truth = thesis_card(3, width=0.05)
    observer = thesis_observer(100, 3, "centres")
    captures = captured(
        astray(truth, 0.03, -0.05, 0.04), truth, observer=observer, brdf=lobes(sigma_deg=6.0), weights="physical"
    )
    found = calibrate(captures, search=0.06)
    # The films and the fit use different quadratures, each right to 1e-9 of a lobe; the curvature magnifies it tenfold.
    assert misplaced(found, truth) < 1e-7
    assert found.card.element_width == pytest.approx(0.05, rel=1e-7)
    assert found.card.element_height == truth.element_height


@pytest.mark.parametrize("name", ["x", "y", "width"])
def test_one_parameter_alone_is_found_and_the_others_stay(name: Parameter) -> None:
    truth = thesis_card(3)
    off = {"x": (0.1, 0, 0), "y": (0, 0.1, 0), "width": (0, 0, 0.1)}[name]
    found = calibrate(captured(astray(truth, *off), truth), parameters=(name,))
    assert misplaced(found, truth) < 1e-10
    assert set(found.values) == set(found.std) == {name}


def test_a_parameter_that_is_off_and_not_sought_is_told() -> None:
    # The twin of the test above: distance alone cannot make up for an offset, and no card is made up.
    truth = thesis_card(3)
    message = assert_undetermined(lambda: calibrate(captured(astray(truth, 0.1, 0, 0), truth), parameters=("y",)))
    assert "explains the captures" in message


def test_a_card_beyond_the_search_is_not_found_by_accident() -> None:
    truth = thesis_card(3)
    assert_undetermined(lambda: calibrate(captured(astray(truth, 0.2, 0, 0), truth), search=0.05))


def test_the_gradient_is_that_of_the_mismatch() -> None:
    # Half the derivative of 1 - lambda_1, r moving along, against scipy's differences of the closed form itself. The knots
    # follow the range of the angle sums, which the gradient does not know: 1e-3 at knots a twelfth of the lobes wide.
    truth = thesis_card()
    problem, _ = prepare(captured(astray(truth, 0.005, 0.01, 0.01), truth))
    films = Films.at(problem, 0.0, 0.25, 7, None)
    g = np.zeros(3)
    gradient, hessian, _ = Point.at(films, g).curvature((0, 1, 2), central=True)
    numeric = approx_fprime(g, lambda at: Point.at(films, np.asarray(at)).mismatch, 1e-7)
    np.testing.assert_allclose(2 * gradient, numeric, rtol=5e-3, atol=1e-4 * np.max(np.abs(numeric)))
    # Half the Hessian is positive: without r's part (the twin) it would be larger by far in every direction.
    assert np.all(np.linalg.eigvalsh(hessian) > 0)


# -- noise ----------------------------------------------------------------------------------------------------


def test_noise_moves_the_card_by_as_much_as_the_error_bars_say() -> None:
    # 40 dB, 8 draws of three parameters: the mean of z^2 over 8 independent draws lies below 0.1 or above 3.2 by chance once
    # in a thousand (chi-squared with 8 degrees of freedom). Bars without pattern and BRDF are too small: the twin at the end.
    truth = thesis_card(3)
    z = []
    for seed in range(8):
        captures = captured(astray(truth, 0.01, 0.02, -0.01), truth, noise=NOISE, seed=seed)
        found = calibrate(captures, search=0.03)
        assert found.method == "maximum_likelihood"
        errors = found.values["x"], found.values["y"] - truth.y, found.values["width"] - 5.0
        z.append([e / found.std[name] for e, name in zip(errors, ("x", "y", "width"), strict=True)])
    mean_square = np.mean(np.square(z), axis=0)
    assert np.all(mean_square > 0.1)
    assert np.all(mean_square < 3.2)
    # The twin: bars for a wall and patterns that are known, sigma / |dF/dg V|, are an order of magnitude off.
    clean = captured(truth, truth).radiance
    sigma = NOISE * float(np.sqrt(np.mean(clean**2)))
    ahead, behind = (captured(moved(truth, 0.0, 1 + e, 1.0), moved(truth, 0.0, 1 + e, 1.0)) for e in (1e-5, -1e-5))
    known = sigma / float(np.linalg.norm(ahead.radiance - behind.radiance)) * 2e-5
    assert found.std["y"] > 3 * known


def test_forty_decibels_from_a_fifth_off() -> None:
    truth = thesis_card()
    captures = captured(
        astray(truth, -0.2, 0.2, 0.2), truth, observer=thesis_observer(200, 5), brdf=lobes(), noise=NOISE, stated=True
    )
    found = calibrate(captures)
    # Four standard deviations of its own; they are below 1e-3 at a thirtieth of the thesis's data.
    for name, value in (("x", 0.0), ("y", -1.0), ("width", 5.0)):
        assert abs(found.values[name] - value) < 4 * found.std[name]
        assert found.std[name] < 1e-3
    # The elements at the ends are known as well as offset and width together.
    expected = math.hypot(found.std["x"], found.std["width"] / 2)
    assert np.max(found.position_std[:, 0]) == pytest.approx(expected, rel=0.5)
    np.testing.assert_allclose(found.position_std[:, 1], found.std["y"], rtol=1e-12)
    assert "Solve with the returned card" in found.status


def test_bars_grow_with_the_noise_and_with_what_else_is_unknown() -> None:
    truth = thesis_card(3)
    quiet, loud = (calibrate(captured(truth, truth, noise=n), search=0.03) for n in (0.002, 0.02))
    assert loud.std["y"] / quiet.std["y"] == pytest.approx(10, rel=0.15)
    alone = calibrate(captured(truth, truth, noise=0.02), search=0.03, parameters=("y",))
    assert alone.std["y"] < loud.std["y"]


def test_a_card_that_is_no_scaled_copy_is_told() -> None:
    truth = thesis_card()
    bent = dataclasses.replace(truth, elements_x=(-2.5, -0.80, 0.8333, 2.5))
    try:
        status = calibrate(captured(truth, bent, noise=NOISE, stated=True), search=0.05).status
    except UndeterminedError as error:
        status = str(error)
    assert "times the noise" in status or "explains the captures" in status
    # The twin: with the right shape there is no such word.
    straight = calibrate(captured(truth, truth, noise=NOISE, stated=True), search=0.05)
    assert "times the noise" not in straight.status


def test_saturated_pixels_take_no_part() -> None:
    truth = thesis_card(3)
    captures = captured(astray(truth, 0.02, 0.0, 0.02), truth)
    films = captures.radiance.copy()
    variance = np.full(films.shape, 1e-12)
    variance[2, 40:50] = math.inf
    films[2, 40:50] = 7.0
    known = dataclasses.replace(captures, radiance=films, variance=variance, variance_is_floor=True)
    assert misplaced(calibrate(known, search=0.05), truth) < 1e-8
    # The twin: counted like the others, they leave nothing to be found.
    assert_undetermined(lambda: calibrate(dataclasses.replace(captures, radiance=films), search=0.05))


# -- what cannot be told --------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_a_far_card_is_left_untold(noise: float) -> None:
    # At 1000 m a card of 20 m moves all angle sums alike, by an offset that the BRDF takes up.
    truth = Card(elements_x=(-10.0, 0.0, 10.0), y=-1000.0)
    captures = captured(astray(truth, 0.05, 0.05, 0.05), truth, brdf=lobes(sigma_deg=0.5), noise=noise)
    assert_undetermined(lambda: calibrate(captures, search=0.1))


def test_one_element_has_no_place() -> None:
    card = thesis_card(1)
    assert "two or more elements" in assert_undetermined(lambda: calibrate(captured(card, card)))


def test_elements_that_share_no_angle_sum_explain_anything() -> None:
    # Two elements 250 m apart: each has its own range of the BRDF, whatever the geometry.
    truth = Card(elements_x=(-125.0, 125.0), y=-50.0)
    assert_undetermined(lambda: calibrate(captured(truth, truth, noise=NOISE), search=0.05))


# -- input ----------------------------------------------------------------------------------------------------


def test_moved_scales_about_the_centre() -> None:
    card = Card(elements_x=(1.0, 2.0, 4.0), y=-2.0, element_width=0.1, element_height=0.3, board_width=5.0)
    there = moved(card, 0.5, 1.5, 2.0)
    np.testing.assert_allclose(np.mean(there.elements_x), np.mean(card.elements_x) + 0.5)
    np.testing.assert_allclose(np.diff(there.elements_x), [2.0, 4.0])
    assert (there.y, there.element_width, there.element_height) == (-3.0, 0.2, 0.3)
    assert there.board_width == 10.0


def test_wrong_calls_are_refused() -> None:
    captures = captured(thesis_card(3), thesis_card(3))
    assert refused(lambda: calibrate(captures, parameters=("z",))).field == "parameters"  # type: ignore[arg-type]
    assert refused(lambda: calibrate(captures, parameters=())).field == "parameters"
    assert refused(lambda: calibrate(captures, parameters=("x", "x"))).field == "parameters"
    assert refused(lambda: calibrate(captures, search=0.0)).field == "search"
    assert refused(lambda: calibrate(captures, search=math.nan)).field == "search"
