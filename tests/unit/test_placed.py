"""Error bars of a pattern whose card was found from the captures too: its place's part of them.

Held against the joint Cramer-Rao bound of pattern, BRDF and place, which knows nothing of cards moved aside: the slopes of
the films in the place stand beside the splines in one Fisher information.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.bounds import Bound, cramer_rao
from wallmirror.derendering.calibration import Calibration, calibrate, moved
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.moments import moments
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import SplineGrid, design_matrices
from wallmirror.geometry import Card
from wallmirror.transport import radiance, transport_matrix

from .helpers import lobes, thesis_card, thesis_observer

Array = NDArray[np.float64]

STEP_DEG = 4.0


@functools.cache
def films(views: int) -> tuple[Array, Array]:
    source = 0.1 + np.random.default_rng(4).random((3, 8))
    wall = lobes(-35, -10, 15, 40, sigma_deg=6.0)
    return source, radiance(
        transport_matrix(thesis_observer(120, views), thesis_card(3), wall, weights="cosine"), source
    )


def filmed(seed: int, card: Card, *, noise: float = 3e-4, views: int = 6) -> CaptureSet:
    clean = films(views)[1]
    sigma = noise * float(clean.max())
    return CaptureSet(
        observer=thesis_observer(120, views),
        card=card,
        transport="cosine",
        radiance=clean + sigma * np.random.default_rng((2, seed)).standard_normal(clean.shape),
        variance=np.full(clean.shape, sigma**2),
    )


def at(problem: Problem, g: Array, grid: SplineGrid | None = None) -> tuple[SplineGrid, list[sp.csr_array]]:
    """Splines and designs with the card's distance and width times exp(g)."""
    card = moved(problem.card, 0.0, math.exp(g[0]), math.exp(g[1]))
    there = dataclasses.replace(problem, captures=dataclasses.replace(problem.captures, card=card))
    kernel = there.kernel(STEP_DEG, 1e-5)
    u = kernel.angle_sum
    grid = grid or SplineGrid.covering(float(u.min()), float(u.max()), step=math.radians(STEP_DEG), degree=7)
    return grid, design_matrices(kernel, grid)


@functools.cache
def joint() -> tuple[Calibration, CaptureSet, Bound, SplineGrid]:
    """A card with the joint bound's covariance of distance and width, and that bound, on which knots."""
    captures = filmed(0, thesis_card(3), views=1)
    problem, _ = prepare(captures)
    grid, designs = at(problem, np.zeros(2))
    start = solve(captures, step_deg=STEP_DEG, nonnegative=False)
    r = np.linalg.lstsq(  # the spline of the solution, from its values
        np.stack([grid.row(float(u)) for u in start.angle_sum[::4]]), start.brdf[::4]
    )[0]
    h = 1e-5
    slopes = []
    for j in range(2):
        ahead, behind = (at(problem, sign * h * np.eye(2)[j], grid)[1] for sign in (1, -1))
        slopes.append([(a @ r - b @ r) / (2 * h) for a, b in zip(ahead, behind, strict=True)])
    unit = [float(np.max(np.abs(slope))) for slope in slopes]
    beside = [
        sp.csr_array(sp.hstack([t, *(sp.csr_array(slope[i][:, None] / w) for slope, w in zip(slopes, unit))]))
        for i, t in enumerate(designs)
    ]
    summed = moments(problem.data, beside, problem.inverse_variance)
    gauge = np.append(grid.row(grid.peak(r, summed.exposure[: grid.size])), np.zeros(2))
    bound = cramer_rao(summed, np.append(r, np.zeros(2)), start.source / problem.scale, gauge=gauge)
    covariance = bound.coefficients[-2:, -2:] / np.outer(unit, unit)
    root = np.linalg.cholesky(covariance)
    card = captures.card
    calibration = Calibration(
        card=card,
        values={},
        std={},
        aside=tuple(moved(card, 0.0, math.exp(g[0]), math.exp(g[1])) for g in root.T),
        position_std=np.zeros((3, 2)),
        mismatch_before=0.0,
        mismatch_after=0.0,
        iterations=0,
        method="maximum_likelihood",
        status="",
    )
    return calibration, captures, bound, grid


def of_brdf(bound: Bound, grid: SplineGrid, u: Array) -> Array:
    """The joint bound's bars of rho, without the place's own rows."""
    kept = int(np.count_nonzero(bound.seen[: grid.size]))
    alone = dataclasses.replace(bound, coefficients=bound.coefficients[:kept, :kept], seen=bound.seen[: grid.size])
    return alone.brdf_std(grid, u)


def test_the_bars_are_those_of_the_joint_bound() -> None:
    found, captures, bound, grid = joint()
    options = {"step_deg": STEP_DEG, "nonnegative": False}
    wide = solve(captures, calibration=found, **options)  # type: ignore[arg-type]
    narrow = solve(captures, **options)  # type: ignore[arg-type]
    # Bars of the solve come times the noise that it found, here by up to 5 %; a shift of one bar stands for a slope.
    noise = math.sqrt(max(1.0, wide.chi_squared))
    assert wide.predicted_error == pytest.approx(noise * bound.source_error, rel=0.05)
    u = np.radians(np.linspace(-60, 60, 121))  # where the lobes are
    joint_std = noise * of_brdf(bound, grid, u)
    told = joint_std > 0.2 * np.max(joint_std)  # not at the peak itself, where the gauge fixes rho
    measured = np.interp(u, wide.angle_sum, wide.brdf_std)
    np.testing.assert_allclose(measured[told], joint_std[told], rtol=0.05)
    # The twin: bars that hold the place fixed are smaller on the lobes' flanks, which turn with the card.
    fixed = np.interp(u, narrow.angle_sum, narrow.brdf_std)
    assert np.min(fixed[told] / joint_std[told]) < 0.7


def test_the_pattern_and_its_gauge_know_of_the_place_too() -> None:
    found, captures, _, _ = joint()
    wide = solve(captures, calibration=found, step_deg=STEP_DEG)
    narrow = solve(captures, step_deg=STEP_DEG)
    np.testing.assert_allclose(wide.source, narrow.source, rtol=1e-9)
    assert np.all(wide.source_std >= narrow.source_std)
    assert np.all(wide.brdf_std >= narrow.brdf_std)
    assert np.array_equal(np.isinf(wide.brdf_std), np.isinf(narrow.brdf_std))
    expected = float(np.sqrt(np.sum(wide.shape_std**2) / np.sum(wide.source**2)))
    assert wide.predicted_error == pytest.approx(expected, rel=1e-6)
    assert f"{100 * wide.predicted_error:.2g} % off" in wide.status
    assert any("one standard deviation aside, 2 times" in stage for stage in wide.history)


def test_a_calibration_hands_its_covariance_on() -> None:
    captures = filmed(1, moved(thesis_card(3), 0.02, 1.02, 0.99))
    found = calibrate(captures, search=0.1)
    assert len(found.aside) == 3
    y = np.array([card.y for card in found.aside]) - found.card.y
    width = np.array([np.ptp(card.elements_x) for card in found.aside]) - np.ptp(found.card.elements_x)
    # Axes of the covariance: the squares of what each moves add up to the variances, to second order in their size.
    assert np.sum(y**2) == pytest.approx(found.std["y"] ** 2, rel=0.01)
    assert np.sum(width**2) == pytest.approx(found.std["width"] ** 2, rel=0.01)
    solved = solve(captures, calibration=found)
    assert scale_free_error(solved.source, films(6)[0]) < 4 * solved.predicted_error
    np.testing.assert_array_equal(solved.source, solve(dataclasses.replace(captures, card=found.card)).source)
