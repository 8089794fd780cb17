"""The forecast of a scene's errors: against dense linear algebra, and against what the solver then reaches."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.brdf import Diffuse
from wallmirror.captures import CaptureSet
from wallmirror.derendering.foresight import Forecast, foresee
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import design_matrices, grid_for
from wallmirror.geometry import Card, Observer
from wallmirror.transport import build_kernel, radiance, transport_matrix

from .helpers import far_apart, lobes, refused, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]

STEP_DEG, SIGMA_DEG = 2.0, 8.0
# Splines of variance h^2 / 3 smooth the lobes whose values are their coefficients (Schoenberg), which widens them by h^2 /
# (6 sigma^2) of their width: so far a forecast may be off the scene's own bound, and twice that is asked.
SMOOTHING = 2 * STEP_DEG**2 / (6 * SIGMA_DEG**2)
BRDF = lobes(-30.0, 0.0, 25.0, sigma_deg=SIGMA_DEG)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in `solve`: the matrices are small, and two threads that wait for each other are slower than one."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@dataclass(frozen=True)
class Scene:
    observer: Observer
    card: Card
    source: Array
    transport: Array  # F, (A, N, M)
    sigma: float

    @property
    def films(self) -> Array:
        return radiance(self.transport, self.source)

    def foreseen(self, **options: object) -> Forecast:
        options = {"noise": self.sigma, "weights": "cosine", "step_deg": STEP_DEG, **options}
        return foresee(self.observer, self.card, BRDF, self.source, **options)  # type: ignore[arg-type]


@functools.cache
def scene() -> Scene:
    """N 100, A 5, M 3, B 6 and elements that overlap on the wall; noise one per cent of the brightest pixel."""
    observer, card = thesis_observer(100, 5), thesis_card(3, y=-2.0)
    source = 0.3 + np.random.default_rng(20).random((3, 6))
    transport = transport_matrix(observer, card, BRDF, weights="cosine")
    return Scene(observer, card, source, transport, 0.01 * float(radiance(transport, source).max()))


@functools.cache
def modes() -> tuple[Array, Array]:
    """Eigenvalues of the covariances of V / |V| and F / |F| after the best scale, from the dense Jacobian's pseudoinverse.

    The Fisher matrix of (r, V) has the scale for its null vector, which takes no part in what is left across V and F.
    """
    s = scene()
    step = math.radians(STEP_DEG)
    kernel = build_kernel(s.observer, s.card, weights="cosine", resolution=2 * step, tolerance=1e-8)
    grid = grid_for(kernel, step=step, degree=3)
    dense = np.stack([t.toarray() for t in design_matrices(kernel, grid)])
    (m, p, k), b = dense.shape, s.source.shape[1]
    # The nearest spline in the mean square, by dense least squares on the samples that the forecast uses.
    u = np.linspace(grid.start, grid.stop, 4 * grid.size)
    basis = np.stack([grid.evaluate(row, u) for row in np.eye(grid.size)], axis=1)
    r = np.linalg.lstsq(basis, BRDF.of_sum(u))[0]
    f = np.einsum("ipk,k->pi", dense, r)
    by_r = np.einsum("ipk,ib->pbk", dense, s.source, optimize=True).reshape(p * b, k)
    by_v = np.einsum("pi,bc->pbic", f, np.eye(b)).reshape(p * b, m * b)
    jacobian = np.concatenate([by_r, by_v], axis=1) / s.sigma
    scales = np.linalg.norm(jacobian, axis=0)
    scales[scales == 0] = 1.0
    covariance = np.linalg.pinv((jacobian / scales).T @ (jacobian / scales), rcond=1e-13, hermitian=True)
    covariance /= np.outer(scales, scales)

    def across(vector: Array, spread: Array) -> Array:
        direction = vector / np.linalg.norm(vector)
        keep = np.eye(vector.size) - np.outer(direction, direction)
        return np.maximum(np.linalg.eigvalsh(keep @ spread @ keep), 0.0) / float(vector @ vector)

    of_v = across(s.source.ravel(), covariance[k:, k:])
    # All of F is Q R r with Q orthonormal, so that R Cov(r) R^T has the eigenvalues of its covariance.
    triangle = np.linalg.qr(np.concatenate(dense), mode="r")
    of_f = across(triangle @ r, triangle @ covariance[:k, :k] @ triangle.T)
    return of_v, of_f


def test_the_forecast_is_the_bound_of_dense_linear_algebra() -> None:
    forecast = scene().foreseen()
    of_v, of_f = modes()
    # Rounding times the condition of the Fisher matrix's well-seen part; the ridge of 1e-12 is no larger.
    assert forecast.source_error == pytest.approx(math.sqrt(of_v.sum()), rel=1e-6)
    assert forecast.transport_error == pytest.approx(math.sqrt(of_f.sum()), rel=1e-6)
    assert forecast.step_deg == STEP_DEG
    together = np.linalg.norm(forecast.shape_std) / np.linalg.norm(scene().source)
    assert together == pytest.approx(forecast.source_error, rel=1e-9)  # the same trace, summed in another order


# -- against the solver ----------------------------------------------------------------------------------------

DRAWS = 80


@functools.cache
def reached() -> tuple[Array, Array]:
    """Errors of V and of F over noise draws."""
    s = scene()
    clean = s.films
    pairs = []
    for seed in range(DRAWS):
        noisy = clean + s.sigma * np.random.default_rng(seed).standard_normal(clean.shape)
        captures = CaptureSet(
            observer=s.observer,
            card=s.card,
            transport="cosine",
            radiance=noisy,
            variance=np.full(clean.shape, s.sigma**2),
        )
        found = solve(captures, method="maximum_likelihood", nonnegative=False, step_deg=STEP_DEG)
        pairs.append((up_to_scale(found.source, s.source), up_to_scale(found.transport, s.transport)))
    errors = np.array(pairs)
    return errors[:, 0], errors[:, 1]


def interval(spectrum: Array) -> float:
    """Four standard deviations of mean |error|^2 over its expectation: a sum of chi-squares weighted by the modes."""
    return 4 * math.sqrt(2 * float(np.sum(spectrum**2)) / DRAWS) / float(spectrum.sum())


def holds(errors: Array, expected: float, spectrum: Array) -> bool:
    ratio = float(np.mean(errors**2)) / expected**2
    return abs(ratio - 1) < interval(spectrum) + 2 * SMOOTHING


def test_the_solver_reaches_what_was_foreseen() -> None:
    forecast = scene().foreseen()
    of_source, of_transport = reached()
    of_v, of_f = modes()
    assert holds(of_source, forecast.source_error, of_v)
    assert holds(of_transport, forecast.transport_error, of_f)
    # The interval is worth something: errors a fifth larger or smaller would be seen.
    assert interval(of_v) < 0.4
    assert interval(of_f) < 0.4
    # The planted faults: half the noise, or the errors of somebody who knows the BRDF.
    half = scene().foreseen(noise=scene().sigma / 2)
    assert not holds(of_source, half.source_error, of_v)
    assert not holds(of_transport, half.transport_error, of_f)
    assert not holds(of_source, forecast.known_brdf_error, of_v)


# -- its parts -------------------------------------------------------------------------------------------------


def test_somebody_who_knows_the_brdf_is_left_with_plain_least_squares() -> None:
    s = scene()
    f = s.transport.reshape(-1, 3)
    variance = s.sigma**2 * s.source.shape[1] * float(np.trace(np.linalg.inv(f.T @ f)))
    # Knots four times as fine, which smooth a sixteenth as much.
    forecast = s.foreseen(step_deg=STEP_DEG / 4)
    expected = math.sqrt(variance) / np.linalg.norm(s.source)
    assert forecast.known_brdf_error == pytest.approx(expected, rel=SMOOTHING / 16)
    assert forecast.known_brdf_error < forecast.source_error
    # Noise that differs from pixel to pixel: weighted least squares.
    spread = s.sigma * (1 + np.random.default_rng(0).random((5, 100, 1)))
    whitened = f / spread.reshape(-1, 1)
    variance = s.source.shape[1] * float(np.trace(np.linalg.inv(whitened.T @ whitened)))
    uneven = s.foreseen(noise=spread, step_deg=STEP_DEG / 4)
    expected = math.sqrt(variance) / np.linalg.norm(s.source)
    assert uneven.known_brdf_error == pytest.approx(expected, rel=SMOOTHING / 16)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_errors_are_linear_in_the_noise(factor: float) -> None:
    one, other = scene().foreseen(), scene().foreseen(noise=factor * scene().sigma)
    # The same matrices but for rounding, which the condition of the Fisher matrix magnifies.
    for name in ("source_error", "transport_error", "known_brdf_error"):
        assert getattr(other, name) == pytest.approx(factor * getattr(one, name), rel=1e-6)
    np.testing.assert_allclose(other.shape_std, factor * one.shape_std, rtol=1e-6)


def test_noise_may_be_given_for_every_entry_or_once() -> None:
    s = scene()
    shape = s.films.shape
    number = s.foreseen().source_error
    for noise in (np.full(shape, s.sigma), np.full((shape[0], 1, 1), s.sigma), [s.sigma] * shape[2]):
        assert s.foreseen(noise=noise).source_error == pytest.approx(number, rel=1e-9)
    # The twin: one noisy realisation is not as good as the others.
    assert s.foreseen(noise=[s.sigma] * 5 + [10 * s.sigma]).source_error > 1.2 * number


def test_more_views_and_more_patterns_never_know_less() -> None:
    s = scene()
    number = s.foreseen().source_error
    views = dataclasses.replace(s, observer=thesis_observer(100, 10))
    assert views.foreseen().source_error < number
    assert views.foreseen().source_error == pytest.approx(number / math.sqrt(2), rel=0.2)


def test_the_knots_follow_the_brdf_unless_they_are_given() -> None:
    s = scene()
    assert s.foreseen(step_deg=None).step_deg == 4.0  # half of 8 deg
    sharp = foresee(thesis_observer(40, 1), s.card, lobes(sigma_deg=0.01), s.source, noise=s.sigma)
    assert sharp.step_deg == 0.05  # no finer than this, however sharp the lobes
    # A solver that must find finer features knows less of the BRDF, and of F with it.
    assert s.foreseen(step_deg=1.0).transport_error > s.foreseen(step_deg=4.0).transport_error


# -- where nothing decides -------------------------------------------------------------------------------------


def test_a_wall_that_sends_the_same_everywhere_promises_nothing() -> None:
    # Constant rho, G = 1: every pixel sees the plain sum of the pattern.
    s = scene()
    blind = foresee(s.observer, s.card, Diffuse(albedo=0.5), s.source, noise=1e-3, weights="thesis")
    assert blind.source_error == math.inf
    assert blind.transport_error == math.inf
    # The twin: with the cosine known, parallax tells the elements apart.
    seen = foresee(s.observer, s.card, Diffuse(albedo=0.5), s.source, noise=1e-3, weights="cosine")
    assert seen.source_error < 0.1


def test_elements_that_share_no_angle_promise_nothing() -> None:
    observer, card = far_apart()
    found = foresee(observer, card, lobes(sigma_deg=2.0), scene().source[:2], noise=1e-3, weights="thesis")
    assert found.source_error == math.inf
    assert found.transport_error == math.inf


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"noise": 0.0}, "noise"),
        ({"noise": -1.0}, "noise"),
        ({"noise": math.nan}, "noise"),
        ({"noise": math.inf}, "noise"),
        ({"noise": np.ones((4, 100, 6))}, "noise"),
        ({"noise": np.ones((5, 100))}, "noise"),
        ({"noise": np.ones((1, 5, 100, 6))}, "noise"),
        ({"step_deg": 0.0}, "step_deg"),
        ({"step_deg": 46.0}, "step_deg"),
        ({"step_deg": math.nan}, "step_deg"),
    ],
)
def test_noise_and_knots_out_of_range_are_refused_by_name(options: dict[str, object], field: str) -> None:
    assert refused(lambda: scene().foreseen(**options)).field == field


@pytest.mark.parametrize("source", [np.ones((2, 6)), np.ones((4, 6)), np.ones(3), np.ones((3, 6, 1))], ids=np.shape)
def test_a_pattern_of_another_shape_is_refused(source: Array) -> None:
    assert refused(lambda: dataclasses.replace(scene(), source=source).foreseen(noise=1.0)).field == "source"
