"""Other ends of the search for few captures: wrong answers before walls of facets are doubted, replaced or refused."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.brdf import CookTorrance, Fresnel
from wallmirror.captures import CaptureSet
from wallmirror.derendering import scarce, stages
from wallmirror.derendering.few_captures import FewCaptures, few_captures
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.rivals import LEVEL, better_by_chance
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.solve import solve
from wallmirror.geometry import Card, Observer, scan_angles
from wallmirror.transport import radiance, transport_matrix

from .helpers import assert_undetermined, up_to_scale

Array = NDArray[np.float64]

# The module, whose function has its name.
searching = importlib.import_module("wallmirror.derendering.few_captures")

# Held to the angle sum, a pattern 85 % off explains the films of this wall of facets five times better than the true one.
SOURCE = np.array([[0.672, 0.074], [0.615, 0.227], [0.633, 0.984], [0.917, 0.719]])
WALL = CookTorrance(alpha=0.2, distribution="beckmann", fresnel=Fresnel(eta=1.5), facets="isotropic")
CARD = Card(elements_x=(-1.28, 2.05, 2.22, 3.06), y=-1.14)


def films(views: int, decibels: float, seed: int = 1) -> CaptureSet:
    observer = Observer(
        position=(-0.56, -5.0),
        fov=1.005,
        view_angles=scan_angles(views, scan=math.radians(78), fov=1.005),
        pixels=189,
        pixels_at="edges",
    )
    clean = radiance(transport_matrix(observer, CARD, WALL, weights="thesis", tolerance=1e-8), SOURCE)
    sigma = float(np.sqrt(np.mean(clean**2))) * 10 ** (-decibels / 20)
    noisy = clean + sigma * np.random.default_rng(seed).standard_normal(clean.shape)
    variance = np.full(noisy.shape, sigma**2)
    return CaptureSet(observer=observer, card=CARD, transport="thesis", radiance=noisy, variance=variance)


def off(found: Solution) -> float:
    """The error in error bars."""
    return up_to_scale(found.source, SOURCE) / found.predicted_error


def only_the_answer(plain: Any, answer: Any, *_: Any, **__: Any) -> Any:
    """The planted fault: no other end of the search is looked at."""
    return answer


@pytest.mark.parametrize("wall", ["angle_sum", "auto"])
def test_a_far_pattern_that_facets_would_make_as_good_is_told(wall: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # At 40 dB noise hides what either pattern misses; without facets the wrong one fits better.
    captures = films(4, 40)
    told = solve(captures, wall=wall, step_deg=2.0)
    assert off(told) > 50
    assert told.verdict == "doubtful"
    assert any("were the wall one of facets, a pattern that differs by" in warning for warning in told.warnings)
    monkeypatch.setattr(stages, "hold_against_rivals", only_the_answer)
    assert solve(captures, wall=wall, step_deg=2.0).verdict == "good"  # 50 error bars off


@pytest.mark.parametrize("seed", [1, 2])
def test_a_pattern_that_facets_make_better_takes_over(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    captures = films(6, 55, seed)
    found = solve(captures, step_deg=2.0)
    # Five bars, as everywhere: here they come to less than the pattern.
    assert off(found) < 5
    assert found.verdict == "good"
    assert found.angle_sum_check is not None
    assert found.angle_sum_check.assumed
    # Where the wall is held to the angle sum the same films are doubted.
    assert solve(captures, wall="angle_sum", step_deg=2.0).verdict == "doubtful"
    monkeypatch.setattr(stages, "hold_against_rivals", only_the_answer)
    assert off(solve(captures, step_deg=2.0)) > 50


def test_facets_fitted_next_to_a_pattern_that_does_not_suit_them_best_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    captures = films(6, 55)
    whole = stages.solve_scarce

    def elsewhere(problem: Any, **options: Any) -> Any:
        """The search on the fitted wall ends at another pattern: one bright element."""
        estimate, others = whole(problem, **options)
        one = np.zeros_like(SOURCE)
        one[0] = 1.0
        return (replace(estimate, source=one) if problem.exponents else estimate), others

    monkeypatch.setattr(stages, "solve_scarce", elsewhere)
    assert "a wall of facets was fitted next to a pattern" in assert_undetermined(lambda: solve(captures, step_deg=2.0))


def test_bars_that_the_misfit_does_not_bear_out_are_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = films(6, 55)
    flat = 0.4  # of the parabola's rise: bars as wide again by more than a root of two would do

    def found(*args: Any, **options: Any) -> FewCaptures:
        return replace(few_captures(*args, **options), rise=flat)

    honest = solve(captures, wall="angle_sum", step_deg=2.0)
    monkeypatch.setattr(scarce, "few_captures", found)
    doubted = solve(captures, wall="angle_sum", step_deg=2.0)
    word = "five error bars from the one found"
    assert [any(word in warning for warning in each.warnings) for each in (honest, doubted)] == [False, True]


def test_noise_lets_free_numbers_explain_no_more_than_the_threshold() -> None:
    # k free numbers take up a sum of k squared unit normals: mean k, and at the level of five deviations less than this.
    for numbers in (1, 20, 300):
        draws = np.random.default_rng(numbers).chisquare(numbers, 200_000)
        # 200,000 draws hold .1 beyond the level on the average, and at most one but once in 200 times (Poisson).
        assert np.count_nonzero(draws > better_by_chance(numbers)) <= 1
    # The level itself, where the sum has a closed form: two numbers, exp(-t / 2).
    assert better_by_chance(2) == pytest.approx(-2 * math.log(LEVEL), rel=1e-12)


def test_more_starts_are_tried_where_the_ends_disagree(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = prepare(films(6, 55), few_captures=True)
    assert few_captures(problem, steps=(2.0,)).starts == 48
    monkeypatch.setattr(searching, "disagree", lambda _: False)
    assert few_captures(problem, steps=(2.0,)).starts == 24
