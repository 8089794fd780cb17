"""Where noise ends in a spectrum, and the projection that takes most of the noise away before anybody looks."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.stats
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.derendering.moments import Moments, moments
from wallmirror.derendering.span import Projected, Span
from wallmirror.derendering.splines import design_matrices, grid_for
from wallmirror.derendering.subspace import noise_edge, signal_space
from wallmirror.transport import build_kernel

from .helpers import lobes, space_within, thesis_card, thesis_observer

Array = NDArray[np.float64]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in `solve`: the matrices are small, and two threads that wait for each other are slower than one."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


# -- the edge --------------------------------------------------------------------------------------------------

SHAPES = [(4, 4), (12, 20), (40, 5), (300, 10), (1000, 20), (10_000, 20), (3000, 1)]


@functools.cache
def largest(rows: int, columns: int, draws: int) -> Array:
    """Largest singular values of normal matrices, by Bartlett's theorem from their triangular factors alone.

    R of X = Q R has chi-distributed numbers of falling degree on its diagonal and normal ones above (Bartlett 1933).
    """
    rows, columns = max(rows, columns), min(rows, columns)
    rng = np.random.default_rng([rows, columns])
    found = []
    for _ in range(draws // 1000):
        triangle = np.triu(rng.standard_normal((1000, columns, columns)), 1)
        diagonal = np.arange(columns)
        triangle[:, diagonal, diagonal] = np.sqrt(rng.chisquare(rows - diagonal, (1000, columns)))
        found.append(np.sqrt(np.linalg.eigvalsh(np.swapaxes(triangle, 1, 2) @ triangle)[:, -1]))
    return np.concatenate(found)


def test_the_simulation_is_that_of_whole_matrices() -> None:
    rng = np.random.default_rng(1)
    whole = np.linalg.svd(rng.standard_normal((2000, 60, 8)), compute_uv=False)[:, 0]
    # Kolmogorov and Smirnov at one in a thousand.
    assert scipy.stats.ks_2samp(whole, largest(60, 8, 4000)).pvalue > 1e-3
    # The planted fault: one degree of freedom in a row more is seen.
    assert scipy.stats.ks_2samp(whole, largest(66, 8, 4000)).pvalue < 1e-3


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_noise_passes_its_edge_once_in_ten_thousand(shape: tuple[int, int]) -> None:
    draws = 10_000
    values = largest(*shape, draws)
    beyond = int(np.count_nonzero(values > noise_edge(*shape)))
    # The law is a limit and small matrices may be off by some factor, but not by ten: so few would be beyond by luck, once
    # in a thousand, if the chance were one in a thousand.
    assert beyond <= scipy.stats.binom.ppf(1e-3, draws, 1e-3)
    # The planted fault: the edge of Marchenko and Pastur alone, which has no room for the scatter, is passed often.
    assert np.mean(values > np.sqrt(shape[0]) + np.sqrt(shape[1])) > 0.01


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if max(shape) >= 300], ids=str)
def test_the_edge_of_large_matrices_wastes_little(shape: tuple[int, int]) -> None:
    # The scatter is a few per cent of the edge here; 4.4 of its units and the 99 % quantile at 2.0 lie within 5 %.
    quantile = float(np.quantile(largest(*shape, 10_000), 0.99))
    assert 0.95 * noise_edge(*shape) < quantile < noise_edge(*shape)


def test_the_edge_is_symmetric_and_grows_with_both_sides() -> None:
    assert noise_edge(30, 7) == pytest.approx(noise_edge(7, 30), rel=1e-15)
    assert noise_edge(30, 7) < noise_edge(31, 7) < noise_edge(31, 8)


# -- the projection --------------------------------------------------------------------------------------------

ELEMENTS, REALISATIONS = 4, 10


@functools.cache
def scene() -> tuple[list[sp.csr_array], Array]:
    """T_1 .. T_M on knots of 4 deg and films F V of a BRDF that is one of their splines, of root mean square 1."""
    kernel = build_kernel(thesis_observer(200, 8), thesis_card(ELEMENTS), weights="cosine")
    grid = grid_for(kernel, step=np.radians(4), degree=3)
    designs = design_matrices(kernel, grid)
    r = grid.interpolate(lobes(sigma_deg=6.0).of_sum)
    films = np.stack([t @ r for t in designs], axis=1) @ np.random.default_rng(0).random((ELEMENTS, REALISATIONS))
    return designs, films / np.sqrt(np.mean(films**2))


def noisy(sigma: float, seed: int) -> Array:
    films = scene()[1]
    return films + sigma * np.random.default_rng(seed).standard_normal(films.shape)


def angle(basis: Array) -> float:
    """Root mean square sine of the principal angles to the space of the films without noise."""
    left = np.linalg.svd(scene()[1], full_matrices=False)[0][:, :ELEMENTS]
    return float(np.sqrt(np.mean(np.sin(sl.subspace_angles(left, basis)) ** 2)))


def test_the_projection_finds_the_space_of_faint_patterns_better() -> None:
    designs, films = scene()
    # Faint, but with every angle still small: sine ~ sigma sqrt(dimensions) / singular value, so that the projection
    # gains the root of what it leaves of the dimensions.
    pairs = []
    for seed in range(10):
        data = noisy(0.2, seed)
        within = space_within(data, designs, ELEMENTS, noise=0.2)
        np.testing.assert_allclose(within.basis.T @ within.basis, np.eye(ELEMENTS), rtol=0, atol=1e-6)
        pairs.append([angle(signal_space(data, ELEMENTS).basis), angle(within.basis)])
    plain, projected = np.sqrt(np.mean(np.square(pairs), axis=0))
    # A QR that takes the longest column first tells as well which of them add less than 1e-5 of the first.
    lengths = np.abs(np.diag(sl.qr(sp.hstack(designs).toarray(), mode="r", pivoting=True)[0]))
    dimensions = np.count_nonzero(lengths > 1e-5 * lengths[0])
    share = within.dimensions / films.shape[0]
    assert within.dimensions == dimensions
    assert share < 0.25
    assert projected < 0.7 * plain
    assert projected / plain == pytest.approx(np.sqrt(share), rel=0.35)


def test_the_projection_leaves_the_films_themselves_alone() -> None:
    designs, films = scene()
    within = space_within(films, designs, ELEMENTS, noise=None)
    assert within.rank == ELEMENTS
    # Directions of the span are kept down to 1e-10 of its strongest (squared): they are known to 2e-16 / 1e-10.
    assert angle(within.basis) < 1e-5
    exact = np.linalg.svd(films, compute_uv=False)[:ELEMENTS]
    np.testing.assert_allclose(within.singular_values[:ELEMENTS], exact, rtol=1e-6)
    # The planted fault: designs of another card take part of the films away.
    kernel = build_kernel(thesis_observer(200, 8), thesis_card(ELEMENTS, y=-1.3), weights="cosine")
    grid = grid_for(kernel, step=np.radians(4), degree=3)
    other = space_within(films, design_matrices(kernel, grid), ELEMENTS, noise=None)
    assert angle(other.basis) > 1e-4


def test_coarser_knots_follow_from_finer_ones() -> None:
    kernel = build_kernel(thesis_observer(200, 8), thesis_card(ELEMENTS), weights="cosine")
    coarse = grid_for(kernel, step=np.radians(4), degree=3)
    data, halved = noisy(0.2, 0), coarse.in_halved()
    direct = space_within(data, design_matrices(kernel, coarse), ELEMENTS, noise=0.2)
    fine = moments(data, design_matrices(kernel, coarse.halved()))

    def projected(summed: Moments) -> Projected:
        return Span.of(summed, data.shape[0]).projected(ELEMENTS, noise=0.2)

    every = np.ones((data.shape[0], 1))
    inherited = projected(fine.coarser(halved)).space(design_matrices(kernel, coarse.halved()), every, halved)
    assert (inherited.rank, inherited.dimensions) == (direct.rank, direct.dimensions)
    # Both know the span's weakest directions to 2e-16 / 1e-10.
    np.testing.assert_allclose(inherited.singular_values, direct.singular_values, rtol=1e-5)
    assert np.max(sl.subspace_angles(inherited.basis, direct.basis)) < 1e-4
    assert projected(fine).dimensions > direct.dimensions
    # The planted fault: coefficients of coarser knots that are put one knot aside.
    shifted = projected(fine.coarser(sp.csr_array(np.roll(halved.toarray(), 1, axis=0))))
    assert np.max(np.abs(shifted.singular_values / direct.singular_values - 1)) > 1e-3


def test_a_span_of_more_columns_than_are_pivoted_together_keeps_the_films() -> None:
    kernel = build_kernel(thesis_observer(200, 8), thesis_card(ELEMENTS), weights="cosine")
    designs = design_matrices(kernel, grid_for(kernel, step=np.radians(1), degree=3))
    assert sum(t.shape[1] for t in designs) > 2 * 256
    data = noisy(0.2, 0)
    within = space_within(data, designs, ELEMENTS, noise=0.2)
    # Any basis of the columns down to 1e-5 of the longest holds what the strongest directions have of the films.
    left, strength, _ = np.linalg.svd(sp.hstack(designs).toarray(), full_matrices=False)
    strong, all_of_it = left[:, strength > 1e-3 * strength[0]], left[:, strength > 1e-9 * strength[0]]
    least, most = (np.linalg.svd(q.T @ data, compute_uv=False) for q in (strong, all_of_it))
    assert np.all(least <= within.singular_values * (1 + 1e-6))
    assert np.all(within.singular_values <= most * (1 + 1e-6))
    assert strong.shape[1] <= within.dimensions <= all_of_it.shape[1]
    np.testing.assert_allclose(within.basis.T @ within.basis, np.eye(ELEMENTS), rtol=0, atol=1e-6)


def orthonormal(strengths: tuple[float, ...], sigma: float, seed: int) -> tuple[Array, list[sp.csr_array]]:
    """A span of forty orthonormal columns, with patterns of the given strengths in it and noise around them."""
    rng = np.random.default_rng(seed)
    rows, inside = 4000, 40
    span = np.linalg.qr(rng.standard_normal((rows, inside)))[0]
    left = span @ np.linalg.qr(rng.standard_normal((inside, len(strengths))))[0]
    right = np.linalg.qr(rng.standard_normal((REALISATIONS, len(strengths))))[0]
    data = (left * strengths) @ right.T * sigma + sigma * rng.standard_normal((rows, REALISATIONS))
    return data, [sp.csr_array(part) for part in np.split(span, 2, axis=1)]


@pytest.mark.parametrize("sigma", [1e-3, 1.0, 50.0])
def test_noise_that_nobody_stated_is_estimated_from_what_the_projection_takes_away(sigma: float) -> None:
    whole = noise_edge(4000, REALISATIONS)
    for seed in range(10):
        # One pattern far above the noise, and a faint one. A strength s^2 = 106 becomes (s^2 + 40) (s^2 + 10) / s^2 = 12.6^2
        # among the noise of the projection, whose edge is 10.3 (Benaych-Georges and Nadakuditi 2012), and nothing at all
        # among that of 4000 rows, for s^4 < 4000 * 10.
        data, designs = orthonormal((10 * whole, 10.3), sigma, seed)
        known, unknown = (space_within(data, designs, 2, noise=noise) for noise in (sigma, None))
        assert known.dimensions == unknown.dimensions == 40
        assert known.rank == unknown.rank == 2
        assert signal_space(data, 2, noise_floor=sigma * whole).rank == 1
        # The planted fault: noise that is believed to be twice as large hides the faint pattern.
        assert space_within(data, designs, 2, noise=2 * sigma).rank == 1
        # And a pattern that is not there is not found.
        data, designs = orthonormal((10 * whole, 0.0), sigma, seed)
        assert space_within(data, designs, 2, noise=None).rank == 1
