"""Groups of elements that share no coefficient of the BRDF, under noise: a scale each, with bars that know of it."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.brdf import Diffuse, GaussianTrain, Sum
from wallmirror.captures import CaptureSet
from wallmirror.derendering.angle_sum_check import LEVEL
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.facets import weighted
from wallmirror.derendering.groups import Groups, groups_of, one_group
from wallmirror.derendering.noisy import solve_noisy
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import design_matrices, grid_for
from wallmirror.geometry import Card
from wallmirror.transport import build_kernel, radiance, transport_matrix

from .helpers import EPS, assert_undetermined, thesis_observer

Array = NDArray[np.float64]

OBSERVER = thesis_observer(150, 8)
#: Three elements far to the left and two far to the right of the wall, 50 m away: no angle sum in common.
CARD = Card(elements_x=(-150.0, -120.0, -100.0, 110.0, 140.0), y=-50.0)
GROUPS = ((0, 1, 2), (3, 4))
LOBES = tuple(np.radians([-100, -80, -60, -45, -30, 30, 50, 65, 85, 100]))
WALL = Sum(parts=(GaussianTrain(centres=LOBES, sigma=math.radians(2.0)), Diffuse(albedo=0.05)))


@functools.cache
def transport() -> Array:
    return transport_matrix(OBSERVER, CARD, WALL, weights="thesis", tolerance=1e-9)


def films(seed: int, noise: float) -> tuple[CaptureSet, Array]:
    rng = np.random.default_rng(seed)
    source = rng.random((5, 10))
    clean = radiance(transport(), source)
    sigma = noise * float(np.sqrt(np.mean(clean**2)))
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    variance = np.full(clean.shape, sigma**2)
    return CaptureSet(observer=OBSERVER, card=CARD, transport="thesis", radiance=noisy, variance=variance), source


def test_groups_share_no_coefficient() -> None:
    kernel = build_kernel(OBSERVER, CARD, weights="thesis")
    groups = groups_of(design_matrices(kernel, grid_for(kernel, step=math.radians(1), degree=3)))
    assert groups.elements == GROUPS
    assert not np.any(groups.cells[0] & groups.cells[1])
    # The twins: a card between the two ties them, and so do knots too coarse to keep them apart.
    between = replace(CARD, elements_x=(*CARD.elements_x, 0.0))
    kernel = build_kernel(OBSERVER, between, weights="thesis")
    assert len(groups_of(design_matrices(kernel, grid_for(kernel, step=math.radians(1), degree=3)))) == 1
    kernel = build_kernel(OBSERVER, CARD, weights="thesis")
    assert len(groups_of(design_matrices(kernel, grid_for(kernel, step=math.radians(40), degree=3)))) == 1


def test_each_group_lies_within_its_bars_and_one_scale_for_both_does_not() -> None:
    squares, ratios = [], []
    for seed in range(24):
        captures, source = films(seed, 0.01)
        # The fit's own bars, before what facets could do widens them.
        problem, space = prepare(captures, weak_patterns=True)
        estimate = solve_noisy(problem, space, (1.0,), nonnegative=False)
        assert estimate.groups == GROUPS
        assert "2 scales open (elements 1, 2, 3; elements 4, 5 share no angle of the BRDF)" in estimate.warnings[-1]
        ratios.append(scale_free_error(estimate.source, source, GROUPS) / estimate.predicted_error)
        for group in GROUPS:
            found, true, bars = (x[list(group)] for x in (estimate.source, source, estimate.shape_std))
            scale = float(np.sum(found * true) / np.sum(found * found))
            squares.append(np.mean(((scale * found - true) / (scale * bars)) ** 2))
    # Squares of normal values, so 1 on average. What the BRDF and the patterns trade moves all of them together, in two or
    # three directions of each draw that matter: three standard errors are 3 sqrt(2 / 3 / 24) = 0.5.
    assert abs(np.mean(squares) - 1) < 0.5
    assert abs(np.mean(np.square(ratios)) - 1) < 0.5


def test_a_scale_of_any_group_is_freed_away_whole_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    groups = Groups(GROUPS, np.ones((2, 1), dtype=bool))
    source, change = rng.random((2, 5, 10))
    free = groups.freed(change, source)
    # Sums of thirty products of order one are off by less than a hundred roundings.
    np.testing.assert_allclose(np.sum(groups.patterns(source) * free.T, axis=(1, 2)), 0.0, rtol=0, atol=100 * EPS)
    scaled = change + np.repeat([0.3, -2.0], [3, 2])[:, None] * source
    np.testing.assert_allclose(groups.freed(scaled, source), free, rtol=0, atol=100 * EPS)
    # The twin: freed of one scale for both, a change of one of them is still there.
    both = one_group([sp.csr_array((1, 1))] * 5)
    assert np.linalg.norm(both.freed(scaled, source) - both.freed(change, source)) > 1
    # A dark group has no pattern to be freed of.
    source[3:] = 0.0
    np.testing.assert_array_equal(groups.freed(change, source)[3:], change[3:])


def test_one_scale_for_both_groups_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    captures, source = films(0, 0.01)
    solution = solve(captures, step_deg=1.0)
    # Each group in its own peak's scale: a single factor is not what is between the two and the truth.
    stretched = np.concatenate([source[:3], 3 * source[3:]])
    assert scale_free_error(solution.source, stretched, GROUPS) < 5 * solution.predicted_error
    assert scale_free_error(solution.source, stretched) > 20 * solution.predicted_error
    # The planted fault: told of a single scale, the bound finds that nothing holds the other, and there is no answer.
    whole = Groups((tuple(range(5)),), np.ones((1, 1), dtype=bool))
    monkeypatch.setattr("wallmirror.derendering.ladder.groups_of", lambda _: whole)
    assert_undetermined(lambda: solve(captures, step_deg=1.0))


def test_facets_turn_each_group_by_what_was_foretold(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = weighted(build_kernel(OBSERVER, CARD, weights="thesis", tolerance=1e-7), {"foreshortening": 0.1})
    rng = np.random.default_rng(
        2
    )  # how far the planted fault lets the scales drift hangs on the noise: by 2 % to five times
    source = rng.random((5, 10))
    clean = radiance(kernel.apply(WALL), source)
    sigma = 1e-3 * float(np.sqrt(np.mean(clean**2)))
    captures = CaptureSet(
        observer=OBSERVER,
        card=CARD,
        transport="thesis",
        radiance=clean + sigma * rng.standard_normal(clean.shape),
        variance=np.full(clean.shape, sigma**2),
    )
    solution = solve(captures, step_deg=1.0)
    check = solution.angle_sum_check
    assert check is not None
    assert "Hypothesis 8" in solution.warnings[0]
    off = scale_free_error(solution.source, source, GROUPS)
    # The turn is of first order in the exponent, so a tenth of the tenth is left; noise is a fiftieth of it.
    assert abs(check.bias / off - 1) < 0.1
    # An angle-sum wall is not accused, and its bars hold.
    quiet, source = films(1, 1e-3)
    honest = solve(quiet, step_deg=1.0)
    assert honest.angle_sum_check is not None
    assert honest.angle_sum_check.significance > LEVEL
    assert scale_free_error(honest.source, source, GROUPS) < 5 * honest.predicted_error
    # The planted fault: with one scale for both, the scales' drift counts as a turn.
    monkeypatch.setattr("wallmirror.derendering.angle_sum_check.groups_of", one_group)
    check = solve(captures, step_deg=1.0).angle_sum_check
    assert check is not None
    assert check.bias > 1.5 * off


def test_a_group_that_a_dark_gap_alone_sets_apart_is_not_named() -> None:
    # Angle sums overlap, but no light says how bright one side is against the other: told only where noise lets it be.
    card = Card(elements_x=(-25.0, 25.0), y=-50.0)
    kernel = build_kernel(OBSERVER, card, weights="thesis")
    assert len(groups_of(design_matrices(kernel, grid_for(kernel, step=math.radians(1), degree=3)))) == 1
