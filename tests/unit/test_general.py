"""De-rendering without Hypothesis 8: exact when the camera moves enough, silent when it does not."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.brdf import BRDF
from wallmirror.captures import CaptureSet
from wallmirror.derendering import general
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.general import GeneralSolution, SplineTable, TableGrid, solve_general
from wallmirror.derendering.general_stack import Stack
from wallmirror.derendering.likelihood import moments
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import SplineGrid
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Observer, scan_angles
from wallmirror.transport import Weights, build_kernel, transport_matrix

from .helpers import assert_undetermined, refused, thesis_card, up_to_scale

Array = NDArray[np.float64]

VIEW = math.radians(60)
NOISE = 0.01  # 40 dB


class Broadening(BRDF):
    """Lobes about the mirror direction whose width and height follow theta_s - theta_o: reciprocal, no angle-sum law."""

    def __call__(self, theta_s: Any, theta_o: Any) -> Array:
        u, d = np.asarray(theta_s) + np.asarray(theta_o), np.asarray(theta_s) - np.asarray(theta_o)
        width = math.radians(12) * (1 + 0.5 * np.sin(d) ** 2)
        lobes = np.exp(-0.5 * (u / width) ** 2) + 0.4 * np.exp(-0.5 * ((u - 0.6) / (1.3 * width)) ** 2)
        return np.asarray((lobes + 0.2) * (1 + 0.3 * np.cos(2 * d)))


class Combed(Broadening):
    """The same with a nap: brighter towards one side, so that the two directions must not be swapped."""

    def __call__(self, theta_s: Any, theta_o: Any) -> Array:
        return super().__call__(theta_s, theta_o) * (1 + 0.4 * np.sin(theta_s))


class RoughSpecular(BRDF):
    """Torrance and Sparrow's form in the plane: a Beckmann lobe in the half angle over cos theta_s + cos theta_o."""

    def __call__(self, theta_s: Any, theta_o: Any) -> Array:
        half = np.tan((np.asarray(theta_s) + np.asarray(theta_o)) / 2)
        return np.asarray(np.exp(-((half / 0.2) ** 2)) / (np.cos(theta_s) + np.cos(theta_o)) + 0.1)


def patterns(elements: int = 4, realisations: int = 12) -> Array:
    return np.random.default_rng(0).random((elements, realisations))


def observers(positions: int, pixels: int = 60) -> list[Observer]:
    """Cameras along a line of eight metres, at distances between 3 and 4.5 m that never repeat."""
    return [
        Observer(
            position=(float(x), -3 - 1.5 * (c * 0.618 % 1)),
            fov=VIEW,
            view_angles=scan_angles(3, scan=math.radians(90), fov=VIEW),
            pixels=pixels,
            pixels_at="edges",
        )
        for c, x in enumerate(np.linspace(-4, 4, positions) if positions > 1 else [0.0])
    ]


def captured(
    positions: int, brdf: BRDF, *, noise: float = 0.0, stated: bool = False, seed: int = 0, weights: Weights = "thesis"
) -> list[CaptureSet]:
    card, rng = thesis_card(), np.random.default_rng(seed)
    cameras = observers(positions)
    films = [transport_matrix(o, card, brdf, weights=weights) @ patterns() for o in cameras]
    sigma = noise * math.sqrt(np.mean([np.mean(f**2) for f in films]))
    return [
        CaptureSet(
            observer=o,
            card=card,
            transport=weights,
            radiance=f + sigma * rng.standard_normal(f.shape),
            variance=np.full(f.shape, sigma**2) if stated else None,
        )
        for o, f in zip(cameras, films, strict=True)
    ]


def own_table(captures: list[CaptureSet], step_deg: float, degree: int, *, reciprocal: bool = False) -> SplineTable:
    """A reflectance that is one of the solver's own splines, so that its model holds exactly."""
    grid, _ = Stack.of(captures, reciprocal).designs(step_deg, degree)
    middles = [g.start + (np.arange(g.size) + 0.5 * (1 - degree)) * g.step for g in (grid.theta_s, grid.theta_o)]
    cells = Broadening()(middles[0][:, None], middles[1])
    coefficients = np.zeros(grid.size)
    coefficients[grid.unknown.ravel()] = cells.ravel()
    return SplineTable(grid=grid, coefficients=coefficients, determined=np.ones((2, 2), dtype=bool))


def table_error(found: GeneralSolution, brdf: BRDF) -> float:
    """Largest error where the captures saw the table, against its largest value, after the global scale."""
    angles = np.radians(np.linspace(-65, 65, 53))
    s, o = np.meshgrid(angles, angles, indexing="ij")
    seen = found.seen(s, o)
    assert np.count_nonzero(seen) > 100
    estimate, truth = found.brdf(s[seen], o[seen]), brdf(s[seen], o[seen])
    scale = np.sum(estimate * truth) / np.sum(estimate**2)
    return float(np.max(np.abs(scale * estimate - truth)) / np.max(truth))


# -- exact without noise --------------------------------------------------------------------------------------


@pytest.mark.parametrize("brdf", [Broadening(), Combed()], ids=["reciprocal", "not reciprocal"])
def test_sixteen_positions_determine_any_smooth_table(brdf: BRDF) -> None:
    # No spline but a smooth function: knots are refined until rounding or the gap stops them. Asked: 1e-7; 1e-9 measured.
    found = solve_general(captured(16, brdf))
    assert up_to_scale(found.source, patterns()) < 1e-7
    assert found.method == "closed_form"
    # The bound sqrt(mismatch) / gap on V holds.
    assert up_to_scale(found.source, patterns()) < found.predicted_error < 1e-4
    # The table where the captures decide it: all but 1e-4 of its variance, which leaves 1e-2 of its size at worst and much
    # less where it continues smoothly.
    assert table_error(found, brdf) < 1e-2


def test_four_positions_suffice_with_reciprocity() -> None:
    captures = captured(4, Broadening())
    free, reciprocal = (solve_general(captures, reciprocal=r) for r in (False, True))
    # Asked: 1e-7; 7e-8 measured at 300 pixels a position. Here, with fewer pixels, a margin of five.
    assert up_to_scale(reciprocal.source, patterns()) < 5e-7
    # The twin: without reciprocity the crossings are too few, the gap is smaller and so is the certainty.
    assert reciprocal.gap > 3 * free.gap
    assert up_to_scale(reciprocal.source, patterns()) < 0.2 * up_to_scale(free.source, patterns())
    assert reciprocal.predicted_error < free.predicted_error
    # Imposed on a wall with a nap, reciprocity is wrong, and the certificate says so.
    combed = captured(4, Combed())
    assert general._exact(Stack.of(combed, True), (8.0,), lambda _: None).closed.mismatch > 1e-5
    assert general._exact(Stack.of(combed, False), (8.0,), lambda _: None).closed.mismatch < 1e-7


@pytest.mark.parametrize(("positions", "reciprocal"), [(16, False), (4, True)])
def test_a_table_of_splines_is_recovered_to_rounding(positions: int, reciprocal: bool) -> None:
    # The representation is exact here, so that what remains is rounding over the gap: 1e-15 / 1e-2 and cond F.
    truth = own_table(captured(positions, Broadening()), 8.0, 7, reciprocal=reciprocal)
    found = solve_general(captured(positions, truth), reciprocal=reciprocal, step_deg=8.0)
    assert up_to_scale(found.source, patterns()) < 1e-8
    assert found.mismatch < 1e-16


def test_rough_specular_reflection() -> None:
    brdf = RoughSpecular()
    captures = captured(8, brdf)
    found = solve_general(captures)
    assert up_to_scale(found.source, patterns()) < 1e-4
    # The twin: Hypothesis 8 does not hold for it, and one position read with it gives another pattern or a refusal.
    try:
        assumed = up_to_scale(solve(captures[3]).source, patterns())
    except UndeterminedError:
        return
    assert assumed > 100 * up_to_scale(found.source, patterns())


def test_the_proximal_steps_take_the_ridge_away() -> None:
    stack = Stack.of(captured(8, own_table(captured(8, Broadening()), 8.0, 7)), False)
    _, designs = stack.designs(8.0, 7)
    rough = stack.closed(designs)
    polished = general._polished(stack, designs, rough)
    assert polished.mismatch < 0.01 * rough.mismatch
    assert up_to_scale(polished.source, patterns()) < 0.3 * up_to_scale(rough.source, patterns())


# -- what cannot be told --------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_one_position_is_not_enough_however_often_the_camera_turns(noise: float) -> None:
    once = captured(1, Broadening(), noise=noise)
    message = assert_undetermined(lambda: solve_general(once + once))
    assert "move the camera" in message
    assert "Hypothesis 8" in message


def test_two_positions_are_told_to_be_too_few() -> None:
    message = assert_undetermined(lambda: solve_general(captured(2, Broadening(), noise=NOISE)))
    assert "2 positions" in message
    # The twin: eight are enough for the same noise.
    assert solve_general(captured(8, Broadening(), noise=NOISE)).predicted_error < 0.02


# -- noise ----------------------------------------------------------------------------------------------------


def test_noise_costs_no_more_than_the_bound() -> None:
    # 40 dB, six draws, the truth in the solver's space. The relative error's mean square has about 40 degrees of
    # freedom a draw, most of them shared through the table: 10 % scatter over the draws at most. The bound is that without
    # the ridge, which costs nothing where cells were seen. The twin, the closed form alone, is far above it.
    truth = own_table(captured(8, Broadening()), 10.0, 3)
    clean = captured(8, truth)
    stack = Stack.of(clean, False)
    _, designs = stack.designs(10.0, 3)
    gauge = stack.peak(truth.grid, truth.coefficients)
    films = np.concatenate([c.radiance.reshape(-1, 12) for c in clean])
    summed = moments(films, designs)
    bound = NOISE * math.sqrt(np.mean(films**2))
    bound *= cramer_rao(summed, truth.coefficients, patterns(), gauge=gauge).source_error
    errors, scores, closed = [], [], []
    for seed in range(6):
        captures = captured(8, truth, noise=NOISE, seed=seed)
        found = solve_general(captures, step_deg=10.0)
        errors.append(up_to_scale(found.source, patterns()))
        expected = patterns() * float(gauge @ truth.coefficients)
        scores.append((found.source - expected) / found.source_std)
        noisy = Stack.of(captures, False)
        closed.append(up_to_scale(noisy.closed(noisy.designs(10.0, 3)[1]).source, patterns()))
    rms = math.sqrt(np.mean(np.square(errors)))
    assert rms < 1.3 * bound
    assert found.predicted_error == pytest.approx(bound, rel=0.3)
    assert 0.6 < math.sqrt(np.mean(np.square(scores))) < 1.5
    assert math.sqrt(np.mean(np.square(closed))) > 1.5 * rms


def test_the_knots_follow_the_noise_and_stated_noise_is_checked() -> None:
    captures = captured(8, Broadening(), noise=NOISE, stated=True)
    found = solve_general(captures)
    assert found.method == "maximum_likelihood"
    assert 0.9 < found.chi_squared < 1.1
    assert up_to_scale(found.source, patterns()) < 3 * found.predicted_error
    assert table_error(found, Broadening()) < 0.2
    # Stated a tenth as large, the noise does not account for the misfit.
    small = [dataclasses.replace(c, variance=c.variance / 100) for c in captures if c.variance is not None]
    assert solve_general(small, step_deg=found.step_deg).chi_squared > 50


def test_saturated_pixels_take_no_part() -> None:
    captures = captured(16, Broadening(), noise=1e-3, stated=True)
    films, variance = captures[2].radiance.copy(), np.array(captures[2].variance)
    films[1, 30:40], variance[1, 30:40] = 9.0, math.inf
    hurt = [*captures[:2], dataclasses.replace(captures[2], radiance=films, variance=variance), *captures[3:]]
    whole, holed = (solve_general(c, step_deg=7.5) for c in (captures, hurt))
    assert up_to_scale(holed.source, patterns()) < 3 * whole.predicted_error


# -- the table ------------------------------------------------------------------------------------------------


def test_the_table_is_the_tensor_product_of_its_splines() -> None:
    rng = np.random.default_rng(1)
    across, along = (SplineGrid.covering(-1.0, stop, step=0.3, degree=3) for stop in (0.8, 1.2))
    grid = TableGrid(across, along)
    coefficients = rng.random(grid.size)
    table = SplineTable(grid=grid, coefficients=coefficients, determined=np.ones((2, 2), dtype=bool))
    s, o = rng.uniform(-1, 0.8, 50), rng.uniform(-1, 1.2, 50)
    cells = coefficients.reshape(across.size, along.size)
    expected = [across.row(float(a)) @ cells @ along.row(float(b)) for a, b in zip(s, o, strict=True)]
    np.testing.assert_allclose(table(s, o), expected, rtol=1e-13)


def test_a_reciprocal_table_is_symmetric_and_has_half_the_unknowns() -> None:
    line = SplineGrid.covering(-1.0, 1.0, step=0.25, degree=4)
    grid = TableGrid(line, line, reciprocal=True)
    assert grid.size == line.size * (line.size + 1) // 2
    rng = np.random.default_rng(2)
    table = SplineTable(grid=grid, coefficients=rng.random(grid.size), determined=np.ones((2, 2), dtype=bool))
    s, o = rng.uniform(-1, 1, (2, 40))
    np.testing.assert_allclose(table(s, o), table(o, s), rtol=1e-13)


def test_the_designs_are_the_transport_of_the_table() -> None:
    # Against the forward model, which knows nothing of splines: T_i r is the transport of the spline's reflectance.
    captures = captured(3, Broadening(), weights="cosine")
    table = own_table(captures, 10.0, 3)
    _, designs = Stack.of(captures, False).designs(10.0, 3)
    expected = np.concatenate(
        [build_kernel(c.observer, c.card, weights="cosine").apply(table).reshape(-1, 4) for c in captures]
    )
    np.testing.assert_allclose(np.stack([t @ table.coefficients for t in designs], axis=1), expected, rtol=1e-12)


def test_what_no_curve_passed_is_marked_unseen() -> None:
    found = solve_general(captured(8, Broadening()), step_deg=6.0)
    kernel = build_kernel(observers(8)[3], thesis_card(), weights="thesis")
    on_curve = found.seen(kernel.theta_s[:, ::7, 1, 0], kernel.theta_o[:, ::7, 0, 0])
    assert np.mean(on_curve) > 0.9
    assert not np.any(found.seen(np.radians([89.0, -89.0]), np.radians([89.0, -89.0])))


# -- input ----------------------------------------------------------------------------------------------------


def test_sets_that_do_not_belong_together_are_refused() -> None:
    one, two = captured(2, Broadening())
    assert refused(lambda: solve_general([])).field == "captures"
    other_card = dataclasses.replace(two, card=thesis_card(4, y=-1.1))
    assert refused(lambda: solve_general([one, other_card])).field == "captures"
    fewer = dataclasses.replace(two, radiance=two.radiance[:, :, :5])
    assert refused(lambda: solve_general([one, fewer])).field == "captures"
    assert refused(lambda: solve_general([one, dataclasses.replace(two, transport="cosine")])).field == "captures"
    assert refused(lambda: solve_general([one, two], step_deg=0.0)).field == "step_deg"
