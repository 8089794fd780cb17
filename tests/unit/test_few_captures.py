"""Fewer captures than elements: exact answers without noise, the bound with it, and refusals where the data do not decide."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.brdf import AngleSumBRDF, Diffuse
from wallmirror.captures import CaptureSet
from wallmirror.derendering import few_captures as module
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.elimination import build_system, climb, normal_of_pattern, restricted
from wallmirror.derendering.few_captures import FewCaptures, few_captures
from wallmirror.derendering.likelihood import best_nonnegative, maximise, moments
from wallmirror.derendering.problem import Problem
from wallmirror.transport import radiance, transport_matrix

from .helpers import assert_undetermined, far_apart, lobes, refused, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in `solve`: the matrices are small, and two threads that wait for each other are slower than one."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


# Lobes of 4 degrees end (exp(-z^2/2) < 1e-13) 31 degrees from their centres, which keeps rho = 0 beyond 66 degrees exact.
SUPPORT = math.radians(66)
STEPS = (2.0, 1.0, 0.5)


@functools.cache
def transport(brdf: AngleSumBRDF, elements: int) -> Array:
    observer = thesis_observer(160, 3)
    return transport_matrix(observer, thesis_card(elements), brdf, weights="thesis", tolerance=1e-13)


def four_lobes() -> AngleSumBRDF:
    return lobes(-35.0, -15.0, 15.0, 35.0, sigma_deg=4)


def problem_of(source: Array, brdf: AngleSumBRDF | None = None, *, noise: float = 0.0, seed: int = 0) -> Problem:
    """A capture set with any number of captures, noise in units of the root mean square of the radiance."""
    films = radiance(transport(brdf or four_lobes(), source.shape[0]), source)
    sigma = noise * float(np.sqrt(np.mean(films**2)))
    films = films + sigma * np.random.default_rng(1000 + seed).standard_normal(films.shape)
    captures = CaptureSet(
        observer=thesis_observer(160, 3), card=thesis_card(source.shape[0]), transport="thesis", radiance=films
    )
    scale = float(np.abs(films).max())
    data = films.reshape(-1, source.shape[1]) / scale
    weights = np.full(data.shape, (scale / sigma) ** 2) if noise else None
    return Problem(captures, data, weights, np.ones(data.shape, dtype=bool), bool(noise), scale)


def pattern(elements: int, captures: int, seed: int) -> Array:
    return np.random.default_rng(seed).random((elements, captures))


def found(problem: Problem, *, support: float | None = None, nonnegative: bool = True, seed: int = 0) -> FewCaptures:
    return few_captures(problem, steps=STEPS, starts=6, support=support, nonnegative=nonnegative, seed=seed)


# -- without noise ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_one_capture_with_support_is_exact_from_every_seed(seed: int) -> None:
    source = pattern(4, 1, seed)
    result = found(problem_of(source), support=SUPPORT, seed=seed)
    # The spline of degree 7 with knots an eighth of the lobe's width apart is off by some 1e-10, V by less.
    assert up_to_scale(result.source, source) < 1e-10
    assert up_to_scale(result.source, source) < result.error < 1e-8
    assert result.agreeing >= 3


@pytest.mark.parametrize(("captures", "seed"), [(2, 0), (2, 1), (2, 2), (3, 0)])
def test_fewer_captures_than_elements_are_exact_without_a_support(captures: int, seed: int) -> None:
    source = pattern(4, captures, seed)
    result = found(problem_of(source), seed=seed)
    assert up_to_scale(result.source, source) < 1e-8
    assert up_to_scale(result.transport, transport(four_lobes(), 4).reshape(result.transport.shape)) < 1e-6


def test_bounds_are_not_needed_where_two_captures_are_enough() -> None:
    source = pattern(3, 2, 3) - 0.3  # some entries negative
    result = found(problem_of(source), nonnegative=False, support=SUPPORT)
    assert up_to_scale(result.source, source) < 1e-8


def test_many_captures_of_few_different_patterns_are_solved_too() -> None:
    source = pattern(4, 2, 5) @ pattern(2, 5, 6)
    source[:, 3] = 0.0  # and one capture is dark
    result = found(problem_of(source), support=SUPPORT)
    assert np.linalg.matrix_rank(source) == 2
    assert up_to_scale(result.source, source) < 1e-8
    # A dark film makes a source of rounding only: |F^+| times the rounding of the other films.
    assert np.max(np.abs(result.source[:, 3])) < 1e-12 * np.max(result.source)


def test_dark_elements_are_found_at_zero() -> None:
    source = np.array([[0.0], [0.7], [0.0], [0.4]])
    result = found(problem_of(source), support=SUPPORT)
    assert up_to_scale(result.source, source) < 1e-8
    assert result.source.min() >= 0


# -- the step --------------------------------------------------------------------------------------------------


def dense(problem: Problem, step: float) -> tuple[list[Array], Array]:
    """T_1 .. T_M inside the support and D, as matrices, for numpy's own least squares."""
    grid, designs = problem.designs(step, degree=7, tolerance=1e-9)
    inside = [t.toarray() for t in restricted(grid, designs, SUPPORT)]
    used = np.any([np.any(t != 0, axis=0) for t in inside], axis=0)
    return [t[:, used] for t in inside], problem.data / np.linalg.norm(problem.data)


def test_the_normal_matrix_is_that_of_the_projected_jacobian() -> None:
    source = pattern(3, 2, 7)
    problem = problem_of(source)
    matrices, data = dense(problem, 2.0)
    system = build_system(problem, 2.0, degree=7, support=SUPPORT)
    # Far from the solution on purpose: one step of the climb is enough to hold a point, the residual plays no part.
    point = climb(system, pattern(3, 2, 8), None, nonnegative=False)
    v = point.v
    assert np.linalg.norm(v) == pytest.approx(1, abs=1e-14)
    by_r = np.concatenate([sum(v[i, b] * t for i, t in enumerate(matrices)) for b in range(2)])
    r, *_ = np.linalg.lstsq(by_r, data.T.ravel(), rcond=None)
    f = np.stack([t @ r for t in matrices], axis=1)
    np.testing.assert_allclose(point.transport, f, atol=1e-9 * np.max(np.abs(f)))
    assert point.objective == pytest.approx(np.sum((data - f @ v) ** 2), rel=1e-6)
    by_v = np.kron(np.eye(2), f)
    free_of_r = by_v - by_r @ np.linalg.lstsq(by_r, by_v, rcond=None)[0]
    normal, values = normal_of_pattern(system, point, np.ones_like(v, dtype=bool))
    # Rounding times the condition of G, some 1e5.
    np.testing.assert_allclose(normal, free_of_r.T @ free_of_r, atol=1e-10 * np.max(np.abs(normal)))
    # The null vector is the pattern itself; the twin, any other direction, is not null.
    at = v.ravel(order="F")
    assert np.linalg.norm(normal @ at) < 1e-10 * values[-1]
    assert np.linalg.norm(normal @ np.roll(at, 1)) > 1e-3 * values[-1]


# -- with noise ------------------------------------------------------------------------------------------------


def test_maximum_likelihood_from_the_search_attains_the_bound() -> None:
    squared, seeds = 0.0, 12
    source = pattern(4, 1, 9)
    for seed in range(seeds):
        problem = problem_of(source, noise=0.1, seed=seed)
        result = found(problem, support=SUPPORT, seed=seed)
        grid, designs = problem.designs(2.0, degree=3, tolerance=1e-5)
        summed = moments(problem.data, restricted(grid, designs, SUPPORT), problem.inverse_variance)
        fit = maximise(summed, best_nonnegative(summed, result.source), nonnegative=False)
        assert fit.converged
        peak = grid.row(grid.peak(fit.coefficients, summed.exposure))
        bound = cramer_rao(summed, fit.coefficients, fit.source, gauge=peak)
        squared += (up_to_scale(fit.source, source) / bound.source_error) ** 2
    # At best each term is a mean of 3 squared normal variables or fewer: chi-squared, mean 1, variance <= 2 (when one
    # direction rules), so that the mean over 12 has a standard deviation of at most .41; four of them.
    assert squared / seeds < 1 + 4 * 0.41
    assert squared / seeds > 0.05


# -- refusals --------------------------------------------------------------------------------------------------


def test_a_diffuse_wall_under_the_thesis_weights_is_refused() -> None:
    # rho constant and G = 1: every element lights the wall alike, only the sum of V shows.
    source = pattern(4, 2, 10)
    text = assert_undetermined(lambda: found(problem_of(source, Diffuse(albedo=0.5))))
    assert "support" in text
    assert "capture more" in text


def test_one_capture_without_any_prior_is_refused() -> None:
    text = assert_undetermined(lambda: found(problem_of(pattern(4, 1, 11)), nonnegative=False))
    assert "non-negative" in text
    assert "support" in text
    # The twin: the support decides, and no bounds are needed then.
    assert (
        up_to_scale(found(problem_of(pattern(4, 1, 11)), nonnegative=False, support=SUPPORT).source, pattern(4, 1, 11))
        < 1e-8
    )


def judged(source: Array, seed: int, noise: float) -> tuple[int, int]:
    """Answers refused and answers wrong for one noisy capture without a support."""
    try:
        result = found(problem_of(source, lobes(sigma_deg=8), noise=noise, seed=seed), seed=seed)
    except module.UndeterminedError:
        return 1, 0
    return 0, int(up_to_scale(result.source, source) > 0.3)


def test_patterns_that_fit_as_well_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    # One capture of broad lobes with noise: rho >= 0 alone lets other patterns reach the noise as well.
    sources = [pattern(4, 1, seed) for seed in range(4)]
    tries = [(0, 0.1), (1, 0.1), (2, 0.1), (3, 0.1), (0, 0.01), (1, 0.01)]
    honest = np.sum([judged(sources[seed], seed, noise) for seed, noise in tries], axis=0)
    assert honest[1] == 0
    assert honest[0] > 0
    # The planted fault: without the comparison of the starts the search answers, and answers wrong.
    monkeypatch.setattr(module, "_as_good", lambda *_: False)
    rash = np.sum([judged(source, seed, 0.1) for seed, source in enumerate(sources)], axis=0)
    assert rash[1] > 0


def test_parts_with_a_scale_of_their_own_are_refused() -> None:
    observer, card = far_apart()
    films = radiance(transport_matrix(observer, card, four_lobes(), weights="thesis"), np.array([[1.0], [0.5]]))
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=films)
    data = films.reshape(-1, 1) / films.max()
    problem = Problem(captures, data, None, np.ones(data.shape, dtype=bool), False, float(films.max()))
    assert_undetermined(lambda: found(problem))


def test_fewer_pixels_than_unknowns_are_refused() -> None:
    observer = thesis_observer(40, 1)
    films = radiance(transport_matrix(observer, thesis_card(4), four_lobes(), weights="thesis"), pattern(4, 1, 0))
    captures = CaptureSet(observer=observer, card=thesis_card(4), transport="thesis", radiance=films)
    data = films.reshape(-1, 1) / films.max()
    problem = Problem(captures, data, None, np.ones(data.shape, dtype=bool), False, float(films.max()))
    assert "unknowns" in assert_undetermined(lambda: found(problem))


def test_options_out_of_range_are_named() -> None:
    problem = problem_of(pattern(4, 1, 0))
    assert refused(lambda: few_captures(problem, support=-0.1)).field == "support"
    assert refused(lambda: few_captures(problem, support=float("nan"))).field == "support"
    assert refused(lambda: few_captures(problem, starts=0)).field == "starts"
