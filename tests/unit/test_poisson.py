"""The Poisson fit against scipy's log-likelihood, and its errors against the bound of counting."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.stats
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.derendering import poisson_information as module
from wallmirror.derendering.bounds import Bound, cramer_rao
from wallmirror.derendering.likelihood import maximise, moments
from wallmirror.derendering.poisson import PoissonFit, maximise_poisson, poisson_bound
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.transport import build_kernel

from .helpers import refused, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]

BACKGROUND = 1.0


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in `solve`: the matrices are small, and two threads that wait for each other are slower than one."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@dataclass(frozen=True)
class Truth:
    """T_1 .. T_M, r and V in counts of a spline that the model holds exactly."""

    grid: SplineGrid
    designs: list[sp.csr_array]
    r: Array
    v: Array

    def transport(self, r: Array) -> Array:
        return np.stack([t @ r for t in self.designs], axis=1)

    @property
    def mean(self) -> Array:
        return self.transport(self.r) @ self.v + BACKGROUND

    def counts(self, seed: int) -> Array:
        return np.random.default_rng(seed).poisson(self.mean).astype(np.float64)

    @property
    def gauge(self) -> Array:
        return self.grid.row(self.grid.peak(self.r, np.ones(self.grid.size)))

    @property
    def bound(self) -> Bound:
        return poisson_bound(self.designs, self.r, self.v, gauge=self.gauge, background=BACKGROUND)


@functools.cache
def truth(peak: float) -> Truth:
    """N 80, A 4, M 3, B 6; lobes over a low floor, so that the counts reach from a few to the peak."""
    kernel = build_kernel(thesis_observer(80, 4), thesis_card(3), weights="cosine")
    grid = grid_for(kernel, step=math.radians(8), degree=3)
    centres = np.degrees(grid.start + grid.step * (np.arange(grid.size) - 1))
    r = 0.03 + sum(np.exp(-0.5 * ((centres - c) / 9) ** 2) for c in (-35, -12, 20, 40))
    v = 0.1 + np.random.default_rng(11).random((3, 6))
    designs = design_matrices(kernel, grid)
    scale = peak / np.max(np.stack([t @ r for t in designs], axis=1) @ v)
    return Truth(grid, designs, np.asarray(r), v * scale)


def fitted(scene: Truth, counts: Array, **options: object) -> PoissonFit:
    fit = maximise_poisson(counts, scene.designs, scene.r, background=BACKGROUND, **options)  # type: ignore[arg-type]
    assert fit.converged
    return fit


def log_likelihood(scene: Truth, counts: Array, r: Array, v: Array) -> float:
    """scipy's, entry by entry."""
    return float(np.sum(scipy.stats.poisson.logpmf(counts, scene.transport(r) @ v + BACKGROUND)))


# -- the fixed point -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("peak", [20.0, 1e3])
def test_the_likelihood_of_scipy_has_no_slope_at_the_fit(peak: float) -> None:
    scene = truth(peak)
    counts = scene.counts(0)
    fit = fitted(scene, counts, tolerance=1e-10)
    rng = np.random.default_rng(1)

    # Central differences of the log-likelihood, along random directions of r and of V. At the fit they end at their own
    # error (rounding 1e-16 of some 1e4 nats over the step, and the third derivative times the step squared); a step away
    # the slope is the curvature times that step.
    def slope(r: Array, v: Array, dr: Array, dv: Array, h: float = 1e-4) -> float:
        ahead, behind = (log_likelihood(scene, counts, r + s * h * dr, v + s * h * dv) for s in (1, -1))
        return (ahead - behind) / (2 * h)

    for _ in range(6):
        # Relative steps: V is in counts, r of order one.
        dr = 0.1 * rng.standard_normal(scene.r.shape) * fit.coefficients
        dv = 0.1 * rng.standard_normal(scene.v.shape) * fit.source
        here = slope(fit.coefficients, fit.source, dr, dv)
        away = slope(fit.coefficients + 0.1 * dr, fit.source + 0.1 * dv, dr, dv)
        assert abs(here) < 1e-4 * abs(away)
    # And no other estimate at hand is more likely: not the truth, not least squares with equal weights.
    best = log_likelihood(scene, counts, fit.coefficients, fit.source)
    assert best > log_likelihood(scene, counts, scene.r, scene.v)
    equal = maximise(moments(counts - BACKGROUND, scene.designs), scene.r, nonnegative=False)
    if np.min(scene.transport(equal.coefficients) @ equal.source) > -BACKGROUND:
        assert best > log_likelihood(scene, counts, equal.coefficients, equal.source)


def test_the_reported_gain_is_that_of_scipy() -> None:
    scene = truth(100.0)
    counts = scene.counts(3)
    fit = fitted(scene, counts, source=scene.v)
    gain = log_likelihood(scene, counts, fit.coefficients, fit.source) - log_likelihood(scene, counts, scene.r, scene.v)
    # The sums run over 2e3 entries of some 1e2 nats each: rounding 1e-10.
    assert fit.gain == pytest.approx(gain, abs=1e-8)
    # Twice the gain over the truth is chi-squared with K + M B - 1 degrees of freedom (Wilks 1938).
    freedom = scene.grid.size + scene.v.size - 1
    assert 2 * fit.gain == pytest.approx(freedom, abs=5 * math.sqrt(2 * freedom))


def test_bounds_hold_and_the_slope_leads_out_of_them() -> None:
    scene = truth(20.0)
    v = scene.v.copy()
    v[0, :3] = 0.0
    dark = Truth(scene.grid, scene.designs, scene.r, v)
    counts = dark.counts(4)
    free = fitted(dark, counts)
    assert free.source.min() < 0  # the bounds have something to do
    fit = fitted(dark, counts, nonnegative=True, tolerance=1e-10)
    assert fit.coefficients.min() >= 0
    assert fit.source.min() >= 0
    assert np.count_nonzero(fit.source == 0) > 0
    # Kuhn and Tucker for scipy's likelihood: forward differences from the bound fall, inside there is no slope.
    here = log_likelihood(dark, counts, fit.coefficients, fit.source)
    for i, b in np.ndindex(3, 6):
        moved = fit.source.copy()
        moved[i, b] += 1e-3
        change = (log_likelihood(dark, counts, fit.coefficients, moved) - here) / 1e-3
        assert change < 0.1  # inside, only curvature times the step; the scores' own size is sqrt(H) ~ 3 a count
        if fit.source[i, b] > 0:
            assert abs(change) < 0.1


def test_without_a_background_the_free_fit_still_has_a_maximum() -> None:
    # Where nothing is counted the likelihood itself would push the mean to zero and on; its normal continuation does not.
    scene = truth(20.0)
    for seed in range(5):
        counts = np.random.default_rng(seed).poisson(scene.mean - BACKGROUND).astype(np.float64)
        fit = maximise_poisson(counts, scene.designs, scene.r)
        assert fit.converged
        assert up_to_scale(fit.source, scene.v) < 0.1


def test_saturated_entries_do_not_count() -> None:
    scene = truth(100.0)
    counts = scene.counts(5)
    mask: NDArray[np.bool_] = np.random.default_rng(6).random(counts.shape) > 0.02
    clean, fit = (fitted(scene, d, used=mask) for d in (counts, np.where(mask, counts, 1e6)))
    np.testing.assert_allclose(fit.source, clean.source, rtol=1e-12)
    assert up_to_scale(fit.source, scene.v) < 0.1
    # The twin: counted, they ruin it.
    spoilt = maximise_poisson(np.where(mask, counts, 1e3), scene.designs, scene.r, background=BACKGROUND)
    assert up_to_scale(spoilt.source, scene.v) > 0.2


# -- information and bound --------------------------------------------------------------------------------------


def test_the_bound_is_that_of_weighted_least_squares_with_the_variances_of_the_truth() -> None:
    scene = truth(50.0)
    bound = scene.bound
    # The same covariance by the other way: a weight for every entry, every realisation its own Gram matrices.
    reference = cramer_rao(moments(scene.mean, scene.designs, 1 / scene.mean), scene.r, scene.v, gauge=scene.gauge)
    np.testing.assert_allclose(bound.source_std, reference.source_std, rtol=1e-6)
    np.testing.assert_allclose(bound.shape_std, reference.shape_std, rtol=1e-6)
    assert bound.source_error == pytest.approx(reference.source_error, rel=1e-6)
    scale = np.max(np.abs(reference.coefficients))
    np.testing.assert_allclose(bound.coefficients, reference.coefficients, atol=1e-5 * scale)
    # And by definition: minus the expected second difference of scipy's log-likelihood along a direction, in which the
    # expectation over counts is that of a likelihood linear in them, so that the mean takes their place.
    rng = np.random.default_rng(7)
    dense = np.stack([t.toarray() for t in scene.designs])
    by_r = np.einsum("ipk,ib->pbk", dense, scene.v).reshape(-1, scene.grid.size)
    for _ in range(3):
        dr, dv = rng.standard_normal(scene.r.shape), rng.standard_normal(scene.v.shape) * scene.v
        change = (by_r @ dr).reshape(scene.mean.shape) + scene.transport(scene.r) @ dv
        curvature = np.sum(change**2 / scene.mean)
        h = 1e-4
        logarithm = [
            np.sum(scene.mean * np.log(m) - m) for m in (scene.mean + h * change, scene.mean, scene.mean - h * change)
        ]
        assert -(logarithm[0] - 2 * logarithm[1] + logarithm[2]) / h**2 == pytest.approx(curvature, rel=1e-3)


def test_wide_designs_are_summed_the_same_way(monkeypatch: pytest.MonkeyPatch) -> None:
    # Above a limit of memory the products of T's entries are not kept but formed anew.
    scene = truth(50.0)
    kept = scene.bound
    monkeypatch.setattr(module, "_MOST_PRODUCTS", 0)
    np.testing.assert_allclose(scene.bound.coefficients, kept.coefficients, rtol=1e-6, atol=1e-12)


# -- the errors -------------------------------------------------------------------------------------------------

SEEDS = 40


def transport_bound(scene: Truth) -> float:
    """Expected relative error of F after the best scale, from the covariance of r."""
    bound = scene.bound
    gram = sum((t.T @ t).toarray() for t in scene.designs)[np.ix_(bound.seen, bound.seen)]
    r = scene.r[bound.seen]
    power = r @ gram @ r
    along = r @ gram @ bound.coefficients @ gram @ r / power
    return math.sqrt((np.sum(gram * bound.coefficients) - along) / power)


@pytest.mark.parametrize("peak", [20.0, 100.0, 1e4])
def test_the_errors_attain_the_bound_of_counting(peak: float) -> None:
    scene = truth(peak)
    errors = []
    for seed in range(SEEDS):
        counts = scene.counts(100 + seed)
        fit = fitted(scene, counts)
        equal = maximise(moments(counts - BACKGROUND, scene.designs), scene.r, nonnegative=False)
        errors.append(
            (
                up_to_scale(fit.source, scene.v),
                up_to_scale(scene.transport(fit.coefficients), scene.transport(scene.r)),
                up_to_scale(equal.source, scene.v),
                up_to_scale(scene.transport(equal.coefficients), scene.transport(scene.r)),
                fit.chi_squared,
            )
        )
    v, f, equal_v, equal_f, chi = np.sqrt(np.mean(np.square(errors), axis=0))
    # The mean of SEEDS squared errors over its expectation: each is a weighted sum of squares of nearly normal variables
    # whose weights are the eigenvalues of the covariance; V has 17 dimensions, of which the worst-seen rule, say 5:
    # standard deviation sqrt(2 / (5 * 40)) = .1 of the square, .05 of the root. Four of them upwards, five downwards
    # (at a peak of 20 the bound is only asymptotic).
    assert 0.75 < v / scene.bound.source_error < 1.2
    assert 0.75 < f / transport_bound(scene) < 1.2
    # Pearson's statistic has mean 1 and standard deviation sqrt(2 / 2e3 / 40) plus what counts near 1 add.
    assert chi == pytest.approx(1, abs=0.02)
    # The planted fault: equal weights for all counts, which the same noise makes clearly worse.
    # (The comparison is of the same counts, so that most of the scatter is common to both.)
    assert equal_f > 1.1 * f
    assert equal_v > 1.03 * v


def test_impossible_input_is_named() -> None:
    scene = truth(20.0)
    counts = scene.counts(0)
    assert refused(lambda: maximise_poisson(counts - 5, scene.designs, scene.r)).field == "counts"
    assert refused(lambda: maximise_poisson(counts, scene.designs, scene.r, background=-1.0)).field == "background"
