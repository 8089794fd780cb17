"""The maximum likelihood fit and its error bars, against dense linear algebra and against repeated noise.

The truth is one of the solver's own splines, so that the model holds exactly and only the noise makes errors.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import nnls

from wallmirror.captures import CaptureSet
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.convex import minimise_each
from wallmirror.derendering.information import information
from wallmirror.derendering.likelihood import Fit, maximise, moments
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.geometry import Card, Observer
from wallmirror.transport import build_kernel, radiance, transport_matrix

from .helpers import EPS, assert_undetermined, lobes, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """A small problem with everything known: T_1 .. T_M, r, V, and the noise-free D = F(r) V."""

    grid: SplineGrid
    designs: tuple[sp.csr_array, ...]
    r: Array
    v: Array

    @property
    def dense(self) -> Array:
        """All T_i, shape (M, P, K)."""
        return np.stack([t.toarray() for t in self.designs])

    @property
    def data(self) -> Array:
        return self.model(self.r, self.v)

    def model(self, r: Array, v: Array) -> Array:
        return np.einsum("ipk,k,ib->pb", self.dense, r, v, optimize=True)

    def jacobian(self, r: Array, v: Array) -> Array:
        """d vec(D) / d (r, vec V), rows (p, b), shape (P B, K + M B)."""
        dense = self.dense
        (m, p, k), b = dense.shape, v.shape[1]
        by_r = np.einsum("ipk,ib->pbk", dense, v, optimize=True).reshape(p * b, k)
        f = np.einsum("ipk,k->pi", dense, r)
        by_v = np.einsum("pi,bc->pbic", f, np.eye(b)).reshape(p * b, m * b)
        return np.concatenate([by_r, by_v], axis=1)


@functools.cache
def small() -> Truth:
    """N 60, A 4, M 3, B 6: broad lobes over a floor, so that no coefficient is unseen or at its bound."""
    observer, card = thesis_observer(60, 4), thesis_card(3)
    kernel = build_kernel(observer, card, weights="cosine")
    grid = grid_for(kernel, step=math.radians(8), degree=3)
    centres = np.degrees(grid.start + grid.step * (np.arange(grid.size) - 1))
    r = 0.3 + sum(np.exp(-0.5 * ((centres - c) / 9) ** 2) for c in (-35, -12, 20, 40))
    v = 0.2 + np.random.default_rng(11).random((3, 6))
    return Truth(grid, tuple(design_matrices(kernel, grid)), np.asarray(r), v)


def uneven(shape: tuple[int, int], seed: int = 5) -> Array:
    """Inverse variances that differ from pixel to pixel by up to a hundred."""
    return 10.0 ** np.random.default_rng(seed).uniform(-2, 0, shape)


def fitted(truth: Truth, data: Array, weights: Array | None = None, **options: bool) -> Fit:
    fit = maximise(moments(data, list(truth.designs), weights), truth.r, **options)
    assert fit.converged
    return fit


def misfit(truth: Truth, data: Array, weights: Array, r: Array, v: Array) -> float:
    return float(np.sum(weights * (data - truth.model(r, v)) ** 2))


def test_many_small_programmes_at_once_are_those_one_by_one() -> None:
    rng = np.random.default_rng(0)
    factors, linear = rng.standard_normal((40, 8, 6)), rng.standard_normal((40, 6))
    quadratic = np.einsum("npi,npj->nij", factors, factors)
    found = minimise_each(quadratic, linear)
    # Against SciPy: the least squares |R x - R^-T q| over x >= 0 for Q = R^T R.
    for q, right, x in zip(quadratic, linear, found, strict=True):
        triangle = np.linalg.cholesky(q).T
        expected, _ = nnls(triangle, np.linalg.solve(triangle.T, right))
        np.testing.assert_allclose(x, expected, atol=1e4 * EPS * np.linalg.cond(q) * max(1.0, np.max(expected)))
    assert 0 < np.count_nonzero(found) < found.size
    # The planted fault: what is clipped is not what is best.
    clipped = np.maximum(np.linalg.solve(quadratic, linear[..., None])[..., 0], 0.0)
    assert np.max(np.abs(clipped - found)) > 0.01


# -- the fixed point ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
def test_the_fit_is_where_the_objective_has_no_slope(weighted: bool) -> None:
    truth = small()
    rng = np.random.default_rng(1)
    weights = uneven(truth.data.shape) if weighted else np.ones(truth.data.shape)
    data = truth.data + 0.01 * rng.standard_normal(truth.data.shape) / np.sqrt(weights)
    fit = fitted(truth, data, weights if weighted else None, nonnegative=False)
    objective = misfit(truth, data, weights, fit.coefficients, fit.source)
    assert fit.objective == pytest.approx(objective, rel=1e-9)

    # Central differences along random directions: of a quadratic they are exact but for rounding, 1e-15 of the objective
    # over the step; at the fit the slope is rounding, a step away from it curvature times the step.
    def slope(r: Array, v: Array, dr: Array, dv: Array, h: float = 1e-4) -> float:
        ahead = misfit(truth, data, weights, r + h * dr, v + h * dv)
        return (ahead - misfit(truth, data, weights, r - h * dr, v - h * dv)) / (2 * h)

    for _ in range(6):
        dr, dv = rng.standard_normal(truth.r.shape), rng.standard_normal(truth.v.shape)
        here = slope(fit.coefficients, fit.source, dr, dv)
        away = slope(fit.coefficients + 1e-2 * dr, fit.source + 1e-2 * dv, dr, dv)
        assert abs(here) < 1e-4 * abs(away)
    # In the metric of the information the remaining gradient is below the fit's own tolerance, 1e-9 of the objective.
    j = truth.jacobian(fit.coefficients, fit.source)
    e = (data - truth.model(fit.coefficients, fit.source)).ravel()
    gradient = j.T @ (weights.ravel() * e)
    promised = gradient @ np.linalg.pinv(j.T @ (weights.ravel()[:, None] * j), rcond=1e-10, hermitian=True) @ gradient
    assert promised <= 2e-9 * objective


def test_without_noise_the_fit_is_the_truth() -> None:
    truth = small()
    start = truth.r * (1 + 0.1 * np.random.default_rng(2).standard_normal(truth.r.shape))
    fit = maximise(moments(truth.data, list(truth.designs)), start)
    assert fit.converged
    # The objective is a difference of energies and ends at 1e-14 of them; V is right to the root of that, 1e-7, times some
    # ten for the information's uneven directions, r times some hundred for the coefficients that few pixels see.
    assert up_to_scale(fit.source, truth.v) < 1e-6
    assert up_to_scale(fit.coefficients, truth.r) < 1e-5


def test_the_fit_does_not_depend_on_the_scale_of_its_start() -> None:
    truth = small()
    data = truth.data + 0.01 * np.random.default_rng(3).standard_normal(truth.data.shape)
    summed = moments(data, list(truth.designs))
    first, second = maximise(summed, truth.r), maximise(summed, 1e3 * truth.r)
    assert second.objective == pytest.approx(first.objective, rel=1e-8)
    assert up_to_scale(second.source, first.source) < 1e-4
    np.testing.assert_allclose(second.source * 1e3, first.source, rtol=0.1)


def test_bounds_hold_where_they_bind_and_the_slope_leads_out_of_them() -> None:
    truth = small()
    r, v = truth.r.copy(), truth.v.copy()
    r[8:11] = 0.0
    v[0, :2] = v[1, 3] = 0.0
    rng = np.random.default_rng(4)
    clean = truth.model(r, v)
    data = clean + 0.05 * rng.standard_normal(clean.shape)
    free = fitted(truth, data, nonnegative=False)
    sign = np.sign(free.coefficients.sum())
    assert min((sign * free.coefficients).min(), (sign * free.source).min()) < -1e-3  # the bounds have something to do
    fit = fitted(truth, data, nonnegative=True)
    assert fit.coefficients.min() >= 0
    assert fit.source.min() >= 0
    assert np.count_nonzero(fit.coefficients == 0) + np.count_nonzero(fit.source == 0) > 0
    assert fit.objective >= free.objective * (1 - 1e-9)
    # Kuhn and Tucker: no descent but through a bound.
    j = truth.jacobian(fit.coefficients, fit.source)
    ascent = j.T @ (data - truth.model(fit.coefficients, fit.source)).ravel()
    parameters = np.concatenate([fit.coefficients, fit.source.ravel()])
    size = np.sqrt(np.sum(j * j, axis=0) * fit.objective)  # by Cauchy and Schwarz the largest that ascent can be
    assert np.all(np.abs(ascent[parameters > 0]) < 1e-4 * size[parameters > 0])
    assert np.all(ascent[parameters == 0] < 1e-4 * size[parameters == 0])


# -- information and bound ------------------------------------------------------------------------------------


def dense_information(truth: Truth, weights: Array) -> Array:
    j = truth.jacobian(truth.r, truth.v)
    return j.T @ (weights.ravel()[:, None] * j)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_schur_complement_is_the_information_without_v(weighted: bool) -> None:
    truth = small()
    weights = uneven(truth.data.shape) if weighted else np.ones(truth.data.shape)
    known = information(moments(truth.data, list(truth.designs), weights if weighted else None), truth.r, truth.v)
    schur, inverse, coupled = known.schur, known.inverse, known.coupled
    whole = dense_information(truth, weights)
    k = truth.r.size
    assert schur.shape == (k, k)
    expected = whole[:k, :k] - whole[:k, k:] @ np.linalg.solve(whole[k:, k:], whole[k:, :k])
    # Rounding times the condition of H_b, some 1e3 here.
    scale = np.max(np.abs(whole[:k, :k]))
    np.testing.assert_allclose(schur, expected, rtol=0, atol=1e-11 * scale)
    # H_b^-1 and H_b^-1 C_b are the blocks of the eliminated unknowns; ours are ordered (b, i), the dense ones (i, b).
    h = whole[k:, k:].reshape(3, 6, 3, 6)
    c = whole[k:, :k].reshape(3, 6, k)
    for b in range(6):
        np.testing.assert_allclose(inverse[b], np.linalg.inv(h[:, b, :, b]), rtol=1e-9, atol=1e-9 / scale)
        np.testing.assert_allclose(coupled[b], np.linalg.solve(h[:, b, :, b], c[:, b]), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("apart", "refused"), [(1e-6, True), (1e-2, False)])
def test_elements_that_the_films_hardly_tell_apart_are_refused(apart: float, refused: bool) -> None:
    truth = small()
    first, second, *rest = truth.designs
    designs = [first, first + apart * (second - first), *rest]
    films = np.stack([t @ truth.r for t in designs], axis=1) @ truth.v
    data = films + 1e-4 * np.random.default_rng(0).standard_normal(films.shape)

    def fit() -> Fit:
        return maximise(moments(data, [sp.csr_array(t) for t in designs]), truth.r, nonnegative=False)

    if refused:  # H has a condition of some 1e12
        assert "apart" in assert_undetermined(fit)
    else:
        assert fit().converged


@pytest.mark.parametrize("nonnegative", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_what_the_fit_keeps_of_the_information_is_that_of_its_maximum(weighted: bool, nonnegative: bool) -> None:
    # A climb that ended by the curvature of the point before would keep an S at another scale, off by tens of per cent.
    truth = small()
    weights = uneven(truth.data.shape) if weighted else np.ones(truth.data.shape)
    data = truth.data + 0.01 * np.random.default_rng(1).standard_normal(truth.data.shape) / np.sqrt(weights)
    summed = moments(data, list(truth.designs), weights if weighted else None)
    for start in (truth.r, 3 * truth.r * (1 + 0.2 * np.random.default_rng(3).random(truth.r.shape))):
        fit = maximise(summed, start, nonnegative=nonnegative)
        if nonnegative and fit.schur is None:
            continue  # the last step kept what it promised, so that no other S was made
        assert fit.schur is not None
        expected = information(summed, fit.coefficients, fit.source).schur
        np.testing.assert_allclose(fit.schur, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))


def test_the_null_vector_of_the_information_is_the_scale() -> None:
    truth = small()
    schur = information(moments(truth.data, list(truth.designs)), truth.r, truth.v).schur
    values, vectors = np.linalg.eigh(schur)
    assert abs(values[0]) < 1e-12 * values[-1]
    assert values[1] > 1e-7 * values[-1]  # and it is the only one
    assert up_to_scale(vectors[:, 0], truth.r) < 1e-6
    # The twin: at an r that is not the truth's scale, it is that r.
    bent = truth.r * np.linspace(0.5, 2, truth.r.size)
    schur = information(moments(truth.data, list(truth.designs)), bent, truth.v).schur
    assert np.max(np.abs(schur @ bent)) < 1e-11 * np.max(np.abs(schur)) * np.max(bent)
    assert np.max(np.abs(schur @ truth.r)) > 1e-4 * np.max(np.abs(schur))


def dense_covariance(truth: Truth, weights: Array, gauge: Array) -> Array:
    """Cov(r, vec V) of the best unbiased estimate that holds gauge r fixed, by a basis of what may move."""
    whole = dense_information(truth, weights)
    constraint = np.concatenate([gauge, np.zeros(whole.shape[0] - gauge.size)])
    _, _, right = np.linalg.svd(constraint[None])
    move = right[1:].T
    return move @ np.linalg.solve(move.T @ whole @ move, move.T)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_bound_is_the_inverse_of_the_dense_information(weighted: bool) -> None:
    truth = small()
    weights = uneven(truth.data.shape) if weighted else np.ones(truth.data.shape)
    gauge = truth.grid.row(truth.grid.peak(truth.r, np.ones(truth.grid.size)))
    bound = cramer_rao(
        moments(truth.data, list(truth.designs), weights if weighted else None), truth.r, truth.v, gauge=gauge
    )
    k = truth.r.size
    covariance = dense_covariance(truth, weights, gauge)
    np.testing.assert_allclose(bound.coefficients, covariance[:k, :k], rtol=0, atol=1e-4 * np.max(covariance[:k, :k]))
    expected = np.sqrt(np.diag(covariance)[k:]).reshape(truth.v.shape)
    np.testing.assert_allclose(bound.source_std, expected, rtol=1e-5)
    u = np.radians(np.linspace(-40, 40, 17))
    rows = np.stack([truth.grid.row(x) for x in u])
    expected = np.sqrt(np.einsum("uk,kl,ul->u", rows, covariance[:k, :k], rows))
    # Near the peak, where the gauge pins it, the error is a small difference: absolute there.
    np.testing.assert_allclose(bound.brdf_std(truth.grid, u), expected, rtol=1e-4, atol=1e-5 * expected.max())
    assert (
        bound.brdf_std(truth.grid, np.array([truth.grid.peak(truth.r, np.ones(truth.grid.size))]))[0]
        < 1e-3 * expected.max()
    )
    # The error of V after the best global scale: its covariance without the part along V.
    v = truth.v.ravel() / np.linalg.norm(truth.v)
    cov_v = covariance[k:, k:]
    across = math.sqrt(np.trace(cov_v) - v @ cov_v @ v) / np.linalg.norm(truth.v)
    assert bound.source_error == pytest.approx(across, rel=1e-5)


def test_angles_that_nobody_saw_have_infinite_error_bars() -> None:
    truth = small()
    # Leave out every pixel that sees the coefficients 5 to 12: no information on the spline between them.
    blind = np.ones(truth.data.shape)
    hides = np.any(np.abs(truth.dense[:, :, 5:13]) > 0, axis=(0, 2))
    blind[hides] = 0.0
    summed = moments(truth.data, list(truth.designs), blind)
    assert not summed.seen[5:13].any()
    bound = cramer_rao(
        summed, truth.r, truth.v, gauge=truth.grid.row(truth.grid.peak(truth.r, np.ones(truth.grid.size)))
    )
    inside = truth.grid.start + truth.grid.step * np.array([6.5, 8.0])
    assert np.all(np.isinf(bound.brdf_std(truth.grid, inside)))
    outside = [truth.grid.start - 0.01, truth.grid.stop + 0.01]
    assert np.all(np.isinf(bound.brdf_std(truth.grid, np.array(outside))))


# -- repeated noise -------------------------------------------------------------------------------------------

DRAWS = 60
SIGMA = 0.003


@dataclass(frozen=True)
class Trials:
    """Errors of V over noise draws, in the gauge of the bound, with the bound's full covariance of V."""

    errors: Array  # (draws, M B)
    covariance: Array  # (M B, M B)
    stated: Array  # the module's own standard deviations, (M B,)


def trials(weights: Array, used: Array | None, *, draws: int = DRAWS, seed: int = 100) -> Trials:
    """Fit noise of variance SIGMA^2 / weights, telling the fit the weights `used`."""
    truth = small()
    gauge = truth.grid.row(truth.grid.peak(truth.r, np.ones(truth.grid.size)))
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(draws):
        data = truth.data + SIGMA * rng.standard_normal(truth.data.shape) / np.sqrt(weights)
        fit = fitted(truth, data, used, nonnegative=False)
        scale = float(gauge @ fit.coefficients) / float(gauge @ truth.r)
        errors.append((fit.source * scale - truth.v).ravel())
    bound = cramer_rao(moments(truth.data, list(truth.designs), used), truth.r, truth.v, gauge=gauge)
    covariance = SIGMA**2 * dense_covariance(truth, weights, gauge)[truth.r.size :, truth.r.size :]
    return Trials(np.array(errors), covariance, SIGMA * bound.source_std.ravel())


@functools.cache
def even_trials() -> Trials:
    return trials(np.ones(small().data.shape), None)


@functools.cache
def uneven_trials() -> Trials:
    weights = uneven(small().data.shape)
    return trials(weights, weights)


@pytest.mark.parametrize("make", [even_trials, uneven_trials], ids=["even noise", "uneven noise"])
def test_errors_reach_the_bound_and_error_bars_are_what_they_say(make: functools.partial[Trials]) -> None:
    found = make()
    count, size = found.errors.shape
    # |error|^2 is a sum of chi-squares with the covariance's eigenvalues as weights: mean sum, variance 2 sum of squares.
    modes = np.linalg.eigvalsh(found.covariance)
    ratio = float(np.mean(np.sum(found.errors**2, axis=1)) / modes.sum())
    spread = math.sqrt(2 * np.sum(modes**2) / count) / modes.sum()
    assert abs(ratio - 1) < 4 * spread
    assert spread < 0.12  # a bar wrong by 20 % in length, 44 % in square, would be seen
    # z-scores: mean square 1, with the variance 2/(n m^2) sum of squared correlations.
    z = found.errors / found.stated
    sigma = np.sqrt(np.diag(found.covariance))
    correlation = found.covariance / np.outer(sigma, sigma)
    spread = math.sqrt(2 * np.sum(correlation**2) / count) / size
    assert abs(float(np.mean(z**2)) - 1) < 4 * spread
    # No bias: each mean error within its own error.
    assert np.max(np.abs(found.errors.mean(axis=0)) / sigma) < 4.5 / math.sqrt(count)
    # All of it at once: the Mahalanobis distance has m degrees of freedom a draw (the scale is not among the errors).
    distance = np.einsum("nk,kl,nl->n", found.errors, np.linalg.pinv(found.covariance, hermitian=True), found.errors)
    dof = np.linalg.matrix_rank(found.covariance, hermitian=True)
    assert abs(distance.sum() / (count * dof) - 1) < 4 * math.sqrt(2 / (count * dof))


def test_ignoring_the_weights_costs_and_its_error_bars_lie() -> None:
    weights = uneven(small().data.shape)
    right, ignorant = uneven_trials(), trials(weights, None)
    squares = [float(np.mean(np.sum(t.errors**2, axis=1))) for t in (right, ignorant)]
    # Weights spread evenly over two decades: the plain mean's variance over the weighted one's is E[1/w] E[w] = 4.6.
    assert squares[1] > 2 * squares[0]
    z = ignorant.errors / ignorant.stated
    assert float(np.mean(z**2)) > 5  # told that all noise is SIGMA, where its mean square is E[1/w] = 21 times as much


def test_pixels_without_weight_have_no_influence_whatever_they_hold() -> None:
    truth = small()
    rng = np.random.default_rng(6)
    data = truth.data + 0.01 * rng.standard_normal(truth.data.shape)
    weights = (rng.random(data.shape) > 0.2).astype(float)
    fits = []
    for value in (0.0, 1.0, -7.0, 1e30):
        spoilt = np.where(weights > 0, data, value)
        fits.append(fitted(truth, spoilt, weights))
    for other in fits[1:]:
        np.testing.assert_array_equal(other.source, fits[0].source)
        np.testing.assert_array_equal(other.coefficients, fits[0].coefficients)
    # They are the fit of the others alone, and not far from the truth.
    assert up_to_scale(fits[0].source, truth.v) < 0.05
    assert moments(data, list(truth.designs), weights).observations == np.count_nonzero(weights)
    # The twin: with a weight they spoil everything.
    spoilt = np.where(weights > 0, data, 30.0)
    loud = maximise(moments(spoilt, list(truth.designs)), truth.r)
    assert up_to_scale(loud.source, truth.v) > 0.3


def test_nonnegativity_never_costs_and_often_pays() -> None:
    # A dark wall between its lobes and a pattern with dark elements, where the bounds know something.
    truth = small()
    centres = np.degrees(truth.grid.start + truth.grid.step * (np.arange(truth.grid.size) - 1))
    r = sum(np.exp(-0.5 * ((centres - c) / 6) ** 2) for c in (-30.0, 20.0))
    v = np.where(np.random.default_rng(7).random((3, 6)) > 0.4, truth.v, 0.0)
    v[[0, 1, 2], [0, 1, 2]] = 1.0
    truth = dataclasses.replace(truth, r=np.asarray(r), v=v)
    rng = np.random.default_rng(8)
    errors = []
    for _ in range(25):
        data = truth.data + 0.03 * rng.standard_normal(truth.data.shape)
        pair = [fitted(truth, data, nonnegative=bounded) for bounded in (False, True)]
        assert pair[1].coefficients.min() >= 0
        assert pair[1].source.min() >= 0
        errors.append([up_to_scale(fit.source, v) for fit in pair])
    free, bounded = np.sqrt(np.mean(np.square(errors), axis=0))
    assert bounded <= 1.05 * free
    assert bounded < free  # here it pays


# -- through the front door -----------------------------------------------------------------------------------


@functools.cache
def scene() -> tuple[Observer, Card, Array, Array]:
    observer, card = thesis_observer(120, 6), thesis_card(3)
    source = 0.1 + np.random.default_rng(20).random((3, 8))
    clean = radiance(transport_matrix(observer, card, lobes(sigma_deg=6.0), weights="cosine"), source)
    return observer, card, source, clean


def captured(data: Array, variance: Array | None) -> CaptureSet:
    observer, card, _, _ = scene()
    return CaptureSet(observer=observer, card=card, transport="cosine", radiance=data, variance=variance)


@pytest.mark.parametrize("stated", [True, False])
def test_a_solution_predicts_its_own_error(stated: bool) -> None:
    _, _, source, clean = scene()
    sigma = 0.01 * float(clean.max())
    rng = np.random.default_rng(21)
    ratios, chi = [], []
    for _ in range(8):
        variance = np.full(clean.shape, sigma**2) if stated else None
        found = solve(captured(clean + sigma * rng.standard_normal(clean.shape), variance), step_deg=4.0)
        ratios.append(up_to_scale(found.source, source) / found.predicted_error)
        chi.append(found.chi_squared)
        assert found.verdict == "good"
    # 8 draws of 24 values, a scale less: the mean square of the ratio spreads by sqrt(2 / (8 * some 15)) = 0.13. Three of
    # that; non-negativity and the spline's own misfit (lobes of 6 deg on knots of 4) shift it by a few per cent.
    assert 0.55 < math.sqrt(np.mean(np.square(ratios))) < 1.25
    if stated:
        degrees = clean.size
        assert np.mean(chi) == pytest.approx(1.0, abs=4 * math.sqrt(2 / (8 * degrees)) + 0.01)


def test_stated_noise_that_is_too_small_is_told() -> None:
    _, _, _, clean = scene()
    sigma = 0.01 * float(clean.max())
    data = clean + sigma * np.random.default_rng(22).standard_normal(clean.shape)
    found = solve(captured(data, np.full(clean.shape, (sigma / 3) ** 2)), step_deg=4.0)
    assert found.chi_squared == pytest.approx(9.0, rel=0.1)
    assert found.verdict == "doubtful"
    assert any("times the stated noise" in warning for warning in found.warnings)
    honest = solve(captured(data, np.full(clean.shape, sigma**2)), step_deg=4.0)
    assert honest.verdict == "good"
    assert found.predicted_error == pytest.approx(honest.predicted_error, rel=0.02)  # widened to match


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_saturated_pixels_of_a_capture_set_have_no_influence(share: float) -> None:
    # At 30 % nearly every row of D has a saturated pixel in one of its eight realisations.
    _, _, source, clean = scene()
    sigma = 0.01 * float(clean.max())
    rng = np.random.default_rng(23)
    data = clean + sigma * rng.standard_normal(clean.shape)
    saturated = rng.random(clean.shape) < share
    variance = np.where(saturated, math.inf, sigma**2)
    found = [
        solve(captured(np.where(saturated, value, data), variance), step_deg=4.0)
        for value in (float(clean.max()), 0.0, 1e30)
    ]
    for other in found[1:]:
        # The start differs with what the closed form makes of the rows; the maximum is the same to the fit's tolerance,
        # 1e-9 of the objective, 3e-5 of an error bar.
        assert up_to_scale(other.source, found[0].source) < 1e-3 * found[0].predicted_error
        assert other.predicted_error == pytest.approx(found[0].predicted_error, rel=1e-3)
    assert up_to_scale(found[0].source, source) < 3 * found[0].predicted_error


def test_noise_that_varies_is_weighed_by_the_solver() -> None:
    # The rows' weights matter as much as the fit's: half of the views are ten times as noisy.
    _, _, source, clean = scene()
    sigma = np.full(clean.shape, 0.005 * float(clean.max()))
    sigma[::2] *= 10
    rng = np.random.default_rng(24)
    errors: list[tuple[float, float]] = []
    for _ in range(6):
        data = clean + sigma * rng.standard_normal(clean.shape)
        weighed, plain = solve(captured(data, sigma**2), step_deg=4.0), solve(captured(data, None), step_deg=4.0)
        errors.append((up_to_scale(weighed.source, source), up_to_scale(plain.source, source)))
        assert errors[-1][0] < 3 * weighed.predicted_error
    weighed_rms, plain_rms = np.sqrt(np.mean(np.square(errors), axis=0))
    # Inverse-variance weights against none: sqrt(E[1/w] E[w]) = sqrt(50.5 * 0.505) = 5; half of that for draws this few.
    assert plain_rms > 2.5 * weighed_rms


def test_results_are_the_same_twice() -> None:
    _, _, _, clean = scene()
    data = clean + 0.01 * np.random.default_rng(25).standard_normal(clean.shape)
    first, second = (solve(captured(data, None), step_deg=4.0) for _ in range(2))
    np.testing.assert_array_equal(first.source, second.source)
    np.testing.assert_array_equal(first.brdf_std, second.brdf_std)


def test_the_gauge_is_a_brdf_whose_largest_value_is_one() -> None:
    _, _, _, clean = scene()
    data = clean + 0.01 * np.random.default_rng(25).standard_normal(clean.shape)
    assert solve(captured(data, None), step_deg=4.0).brdf.max() == pytest.approx(1.0, rel=8 * EPS)


def test_error_bars_after_the_best_scale_add_up_to_the_predicted_error() -> None:
    _, _, _, clean = scene()
    sigma = 0.01 * float(clean.max())
    data = clean + sigma * np.random.default_rng(26).standard_normal(clean.shape)
    solution = solve(captured(data, np.full(clean.shape, sigma**2)), step_deg=4.0)
    together = np.linalg.norm(solution.shape_std) / np.linalg.norm(solution.source)
    assert together == pytest.approx(solution.predicted_error, rel=1e-9)  # the same trace, summed in another order
    # In the gauge of the BRDF's peak the scale's own error comes on top, along V.
    assert np.linalg.norm(solution.source_std) > np.linalg.norm(solution.shape_std)
