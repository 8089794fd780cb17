"""The solver's B-splines against SciPy's, and its sparse transport against the kernel that it stands for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from wallmirror.derendering.splines import SplineGrid, design_matrices, exposures, grid_for
from wallmirror.geometry import Card, Observer
from wallmirror.transport import Kernel, Weights, build_kernel

from .helpers import EPS, SplineBRDF, thesis_card, thesis_observer

Array = NDArray[np.float64]

DEGREES = (0, 1, 3, 7)


def scipy_spline(grid: SplineGrid, coefficients: Array) -> BSpline:
    knots = grid.start + grid.step * np.arange(-grid.degree, grid.intervals + grid.degree + 1)
    return BSpline(knots, coefficients, grid.degree)


def places(grid: SplineGrid) -> Array:
    """Random angle sums within the grid, and its knots but for degree 0, where a knot is a jump."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(grid.start, grid.stop, 300)
    knots = grid.start + grid.step * np.arange(grid.intervals + 1)
    return inside if grid.degree == 0 else np.concatenate([inside, np.clip(knots, grid.start, grid.stop)])


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("intervals", [1, 2, 11])
def test_basis_is_that_of_scipy(degree: int, intervals: int) -> None:
    grid = SplineGrid(start=-0.3, step=0.07, intervals=intervals, degree=degree)
    u = places(grid)
    first, values = grid.basis(u)
    assert first.shape == u.shape
    assert values.shape == (degree + 1, u.size)
    dense = np.zeros((u.size, grid.size))
    for k in range(degree + 1):
        dense[np.arange(u.size), first + k] += values[k]
    expected = np.stack([scipy_spline(grid, row)(u) for row in np.eye(grid.size)], axis=1)
    # A rounding of u, 0.5 EPS at most, is 0.5 EPS / 0.07 in t; a B-spline's slope is at most 1; the recursion adds some.
    np.testing.assert_allclose(dense, expected, rtol=0, atol=(8 + 2 * degree) * EPS / grid.step)


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_a_partition_of_unity_and_nowhere_negative(degree: int) -> None:
    grid = SplineGrid(start=0.2, step=0.01, intervals=40, degree=degree)
    first, values = grid.basis(np.linspace(grid.start, grid.stop, 1001))
    # All terms are >= 0, so that each step of the recursion keeps its relative roundings.
    np.testing.assert_allclose(values.sum(axis=0), 1.0, rtol=4 * (degree + 1) * EPS)
    assert np.all(values >= -EPS)  # rounding of t beyond 1 at the last knot
    assert first.min() >= 0
    assert first.max() + degree < grid.size


@pytest.mark.parametrize("degree", DEGREES)
def test_evaluate_and_row_are_the_spline(degree: int) -> None:
    rng = np.random.default_rng(degree)
    grid = SplineGrid(start=-1.0, step=0.2, intervals=9, degree=degree)
    r = rng.standard_normal(grid.size)
    u = places(grid)
    expected = scipy_spline(grid, r)(u)
    np.testing.assert_allclose(grid.evaluate(r, u), expected, rtol=0, atol=200 * EPS)
    np.testing.assert_allclose([grid.row(v) @ r for v in u[:20]], expected[:20], rtol=0, atol=200 * EPS)


def test_a_spline_of_another_degree_or_shift_is_another_function() -> None:
    # The twin of the comparisons with SciPy.
    grid = SplineGrid(start=-1.0, step=0.2, intervals=9, degree=3)
    r = np.random.default_rng(1).standard_normal(grid.size)
    u = places(grid)
    moved = SplineGrid(start=-1.0 + 0.02, step=0.2, intervals=9, degree=3)
    assert np.max(np.abs(grid.evaluate(r, u) - scipy_spline(moved, r)(u))) > 0.05


@pytest.mark.parametrize("degree", DEGREES)
def test_overlaps_are_inner_products(degree: int) -> None:
    grid = SplineGrid(start=-0.3, step=0.07, intervals=4 * degree + 2, degree=degree)
    # Gauss-Legendre with degree + 1 nodes an interval is exact for products of two splines.
    nodes, weights = np.polynomial.legendre.leggauss(degree + 1)
    u = grid.start + grid.step * (np.arange(grid.intervals)[:, None] + 0.5 * (1 + nodes)).ravel()
    first, values = grid.basis(u)
    rows = np.zeros((u.size, grid.size))
    rows[np.arange(u.size)[:, None], first[:, None] + np.arange(degree + 1)] = values.T
    gram = (rows.T * np.tile(weights, grid.intervals)) @ rows
    middle = grid.size // 2 - degree // 2 - 1  # all of it and its neighbours above lies within the grid
    beside = gram[middle, middle : middle + degree + 1] / gram[middle, middle]
    np.testing.assert_allclose(grid.overlaps(), beside, atol=100 * EPS, rtol=0)


def test_exposures_are_squares_summed_over_the_pixels() -> None:
    kernel = build_kernel(thesis_observer(40, 3), thesis_card(2), weights="cosine")
    designs = design_matrices(kernel, grid_for(kernel, step=math.radians(4), degree=3))
    weights = np.random.default_rng(0).random(120)
    dense = np.stack([t.toarray() for t in designs])
    np.testing.assert_allclose(exposures(designs, weights), np.einsum("p,ipk->ik", weights, dense**2), rtol=120 * EPS)


def test_outside_the_grid_the_reflectance_is_zero() -> None:
    grid = SplineGrid(start=-1.0, step=0.2, intervals=10, degree=3)
    values = grid.evaluate(np.ones(grid.size), [-1.1, -1.0, 0.0, 1.0, 1.0 + 1e-9, math.pi])
    np.testing.assert_allclose(values, [0, 1, 1, 1, 0, 0], rtol=4 * EPS)


def test_quadratics_are_reproduced_exactly() -> None:
    # Marsden's identity: with the coefficients t_{k+1} t_{k+2} (knots) a quadratic spline is u^2.
    grid = SplineGrid(start=-0.4, step=0.1, intervals=8, degree=2)
    knots = grid.start + grid.step * np.arange(-2, grid.intervals + 3)
    u = np.linspace(-0.4, 0.4, 57)
    np.testing.assert_allclose(grid.evaluate(knots[1:-2] * knots[2:-1], u), u**2, rtol=0, atol=32 * EPS)


@pytest.mark.parametrize(
    ("low", "high", "step"), [(0.0, 1.0, 0.1), (-0.3, 0.7, 0.3), (1.0, 1.0, 0.1), (0.0, 0.05, 1.0), (-3.0, 3.0, 1e-3)]
)
def test_a_grid_covers_its_range_with_whole_intervals(low: float, high: float, step: float) -> None:
    grid = SplineGrid.covering(low, high, step=step, degree=3)
    assert grid.start <= low
    assert grid.stop >= high
    assert grid.step == step
    assert grid.size == grid.intervals + 3
    assert grid.stop - grid.start < high - low + 2 * step  # and not with more than it needs


def test_the_peak_is_found_to_an_eighth_of_an_interval() -> None:
    grid = SplineGrid(start=-1.0, step=0.1, intervals=20, degree=3)
    r = np.exp(-0.5 * ((grid.start + grid.step * (np.arange(grid.size) - 1) - 0.234) / 0.2) ** 2)
    # Uniform cubic splines put coefficient k's bump at knot k - 1, and smooth a Gaussian without moving it.
    everywhere = np.ones(grid.size)
    assert grid.peak(r, everywhere) == pytest.approx(0.234, abs=0.1 / 8)


def test_what_hardly_anybody_saw_is_no_peak() -> None:
    grid = SplineGrid(start=-1.0, step=0.1, intervals=20, degree=3)
    r = np.exp(-0.5 * ((grid.start + grid.step * (np.arange(grid.size) - 1)) / 0.2) ** 2)
    r[-2] = 50.0  # what noise makes of a coefficient without data
    exposure = np.ones(grid.size)
    assert grid.peak(r, exposure) > 0.5
    exposure[-2] = 1e-6
    assert grid.peak(r, exposure) == pytest.approx(0.0, abs=0.1 / 8)


# -- the transport over the basis -----------------------------------------------------------------------------


def kernel_of(weights: Weights) -> Kernel:
    if weights == "physical":
        observer = Observer(position=(0.2, -3.0), fov=0.7, view_angles=(0.4, 0.0, -0.2), pixels=17)
        card = Card(elements_x=(-0.8, 0.1, 0.9), y=-0.6, element_width=0.2, element_height=0.3)
        return build_kernel(observer, card, weights=weights, resolution=math.radians(3), tolerance=1e-6)
    return build_kernel(thesis_observer(pixels=25, views=3), thesis_card(elements=3), weights=weights)


@pytest.mark.parametrize("weights", ["thesis", "cosine", "physical"])
@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("step_deg", [0.5, 4.0, 400.0])
def test_design_matrices_are_the_kernel_applied_to_the_spline(weights: Weights, degree: int, step_deg: float) -> None:
    kernel = kernel_of(weights)
    grid = grid_for(kernel, step=math.radians(step_deg), degree=degree)
    r = np.random.default_rng(7).standard_normal(grid.size)
    expected = kernel.apply(SplineBRDF(grid, r))
    designs = design_matrices(kernel, grid)
    assert len(designs) == 3
    views, pixels, _ = expected.shape
    for i, t in enumerate(designs):
        assert t.shape == (views * pixels, grid.size)
        # The same products added in another order: a few roundings of the sum of their sizes.
        size = np.abs(r).max() * kernel.weight[:, :, i].sum(axis=-1).ravel()
        assert np.all(np.abs(t @ r - expected[:, :, i].ravel()) <= 64 * EPS * size)


def test_design_matrices_belong_to_their_elements() -> None:
    # The twin: the elements' matrices exchanged are no rounding away.
    kernel = kernel_of("physical")
    grid = grid_for(kernel, step=math.radians(4), degree=3)
    r = np.random.default_rng(7).standard_normal(grid.size)
    expected = kernel.apply(SplineBRDF(grid, r))
    first, *_, last = design_matrices(kernel, grid)
    assert np.max(np.abs(first @ r - expected[:, :, 2].ravel())) > 0.1 * np.max(np.abs(expected))
    np.testing.assert_allclose(last @ r, expected[:, :, 2].ravel(), rtol=0, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.parametrize("weights", ["thesis", "physical"])
def test_adjoints_match(weights: Weights) -> None:
    # <T r, y> = <r, T^T y>, with the right-hand side gathered node by node from the kernel instead of from T.
    kernel = kernel_of(weights)
    grid = grid_for(kernel, step=math.radians(2), degree=3)
    rng = np.random.default_rng(8)
    r = rng.standard_normal(grid.size)
    for i, t in enumerate(design_matrices(kernel, grid)):
        y = rng.standard_normal(t.shape[0])
        u, g = kernel.angle_sum[:, :, i], kernel.weight[:, :, i]
        gathered = np.zeros(grid.size)
        for k in range(grid.size):
            phi = scipy_spline(grid, np.eye(grid.size)[k])(u)
            gathered[k] = np.sum(g * phi * y.reshape(*g.shape[:2], 1))
        # Dot products of P terms: sqrt(P) roundings of their sizes, doubled; u carries 8 EPS / step as above.
        size = float(np.abs(y) @ (abs(t) @ np.abs(r)))
        assert abs(float((t @ r) @ y) - float(r @ gathered)) <= 32 * EPS / grid.step * size
        np.testing.assert_allclose(
            t.T @ y, gathered, rtol=0, atol=32 * EPS / grid.step * float(np.max(abs(t).T @ abs(y)))
        )


def test_a_grid_covers_every_angle_of_its_kernel() -> None:
    for weights in ("thesis", "physical"):
        kernel = kernel_of(weights)  # type: ignore[arg-type]
        grid = grid_for(kernel, step=math.radians(1), degree=3)
        assert grid.start <= kernel.angle_sum.min()
        assert grid.stop >= kernel.angle_sum.max()
