"""Tikhonov and Richardson-Lucy: operators, closed forms, scikit-image on the same input, parameter choice, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage, signal
from scipy.sparse.linalg import LinearOperator, aslinearoperator
from skimage.restoration import richardson_lucy as skimage_richardson_lucy
from skimage.restoration import wiener

from wallmirror import InputError, UndeterminedError
from wallmirror.deconvolution import (
    Convolution,
    adjoint_mismatch,
    convolution_spectrum,
    discrepancy_alpha,
    gcv,
    gcv_alpha,
    l_curve_alpha,
    l_curve_curvature,
    matrix_spectrum,
    richardson_lucy,
    tikhonov_dense,
    tikhonov_fft,
    tikhonov_lsmr,
    toeplitz_matrix,
)

from .helpers import EPS, same_examples

RNG = np.random.default_rng
MODES = ("full", "same", "periodic")
#: Inner products of up to some hundred products of order one, through FFTs: 1e-13 is some hundred roundings.
ROUNDING = 1e-13

BLUR = np.exp(-0.5 * (np.arange(-9, 10) / 2.5) ** 2)
BLUR /= BLUR.sum()
LOPSIDED = np.array([0.1, 0.5, 0.2, 0.15, 0.05])


def blurred(noise: float, n: int = 120, seed: int = 0):
    """A smooth signal, its matrix, and noisy data."""
    f = np.exp(-0.5 * ((np.arange(n) - 40) / 6) ** 2) + 0.5 * np.exp(-0.5 * ((np.arange(n) - 80) / 10) ** 2)
    matrix = toeplitz_matrix(BLUR, n)
    added = noise * RNG(seed).standard_normal(matrix.shape[0])
    return f, matrix, matrix @ f + added, added


# -- operators ---------------------------------------------------------------------------------------------------------


@same_examples
@given(n=st.integers(1, 40), k=st.integers(1, 40), seed=st.integers(0, 99), mode=st.sampled_from(MODES))
def test_adjoint_and_dense_matrix_in_one_dimension(n, k, seed, mode):
    if mode == "periodic":
        k = min(k, n)
    h = RNG(seed).standard_normal(k)
    f = RNG(seed + 1).standard_normal(n)
    operator, matrix = Convolution(h, (n,), mode=mode), toeplitz_matrix(h, n, mode=mode)
    assert adjoint_mismatch(operator, seed=seed) < ROUNDING
    scale = np.abs(h).sum() * np.abs(f).sum()
    assert np.abs(operator.matvec(f) - matrix @ f).max() <= ROUNDING * scale
    assert np.abs(operator.exchanged(f).matvec(h) - matrix @ f).max() <= ROUNDING * scale
    assert adjoint_mismatch(operator.exchanged(f), seed=seed) < ROUNDING


@pytest.mark.parametrize("mode", MODES)
def test_adjoint_in_two_dimensions(mode):
    operator = Convolution(RNG(0).random((3, 6)), (8, 7), mode=mode)
    assert adjoint_mismatch(operator) < ROUNDING
    assert adjoint_mismatch(operator.exchanged(RNG(1).random((8, 7)))) < ROUNDING


def test_the_test_of_adjoints_notices_convolution_in_place_of_correlation():
    right = Convolution(LOPSIDED, (30,), mode="periodic")
    wrong = LinearOperator(right.shape, matvec=right.matvec, rmatvec=right.matvec, dtype=float)
    assert adjoint_mismatch(wrong) > 1e-3


def test_convolution_is_that_of_numpy_and_ndimage():
    f, h = RNG(0).random((9, 11)), RNG(1).random((3, 5))
    assert np.allclose(Convolution(h, f.shape).apply(f), signal.convolve2d(f, h), rtol=0, atol=ROUNDING)
    same = Convolution(h, f.shape, mode="same").apply(f)
    assert np.allclose(same, signal.convolve2d(f, h, mode="same"), rtol=0, atol=ROUNDING)  # odd kernels: one middle
    periodic = Convolution(h, f.shape, mode="periodic").apply(f)
    assert np.allclose(periodic, ndimage.convolve(f, h, mode="wrap"), rtol=0, atol=ROUNDING)


def test_origin_of_an_even_kernel_is_named():
    f, h = np.arange(1.0, 6), np.array([1.0, 10.0])
    assert np.allclose(Convolution(h, (5,), mode="same").apply(f), np.convolve(f, h)[1:])
    assert np.allclose(Convolution(h, (5,), mode="same", origin=(0,)).apply(f), np.convolve(f, h)[:-1])


# -- Tikhonov ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("alpha", [1e-3, 1.0])
def test_dense_and_lsmr_solve_the_normal_equations(mode, alpha):
    h, n = LOPSIDED, 40
    matrix = toeplitz_matrix(h, n, mode=mode)
    g = RNG(3).standard_normal(matrix.shape[0])
    wanted = np.linalg.solve(matrix.T @ matrix + alpha * np.eye(n), matrix.T @ g)  # eq. 3.13 as it stands
    assert np.allclose(tikhonov_dense(matrix, g, alpha), wanted, rtol=0, atol=1e-11)  # condition 1e3
    found = tikhonov_lsmr(Convolution(h, (n,), mode=mode), g, alpha, tolerance=1e-13)
    assert np.allclose(found, wanted, rtol=0, atol=1e-9)
    if mode == "periodic":
        assert np.allclose(tikhonov_fft(g, h, alpha, mode=mode), wanted, rtol=0, atol=1e-11)


def test_uncropped_fft_is_the_periodic_estimate_on_all_samples_of_the_data_cut():
    h, n, alpha = LOPSIDED, 40, 0.1
    g = RNG(3).standard_normal(n + h.size - 1)
    matrix = toeplitz_matrix(h, g.size, mode="periodic", origin=0)
    wanted = np.linalg.solve(matrix.T @ matrix + alpha * np.eye(g.size), matrix.T @ g)[:n]
    assert np.allclose(tikhonov_fft(g, h, alpha), wanted, rtol=0, atol=1e-12)
    # It is not the estimate that is zero beyond n.
    assert np.abs(tikhonov_dense(toeplitz_matrix(h, n), g, alpha) - wanted).max() > 1e-3


def test_images_by_fft_and_lsmr():
    h = np.outer(LOPSIDED, LOPSIDED[::-1])
    operator = Convolution(h, (12, 9), mode="periodic")
    g = RNG(0).random((12, 9))
    found = tikhonov_lsmr(operator, g, 0.01, tolerance=1e-13)
    assert found.shape == (12, 9)
    assert np.allclose(found, tikhonov_fft(g, h, 0.01, mode="periodic"), rtol=0, atol=1e-10)


def test_the_transposed_matrix_undoes_a_correlation():
    f = np.zeros(60)
    f[[20, 35]] = 1.0, 0.5
    matrix = toeplitz_matrix(LOPSIDED, 60, mode="same")

    def error(h_and_transpose, data):
        estimate = tikhonov_dense(h_and_transpose, data, 1e-8)
        return np.linalg.norm(estimate - f) / np.linalg.norm(f)

    assert error(matrix, matrix @ f) < 1e-4
    assert error(matrix.T, matrix.T @ f) < 1e-4  # what it does undo
    assert error(matrix.T, matrix @ f) > 0.5  # the thesis's H^T on a convolution with a lopsided kernel
    even = toeplitz_matrix(BLUR, 60, mode="same")
    assert np.allclose(even, even.T)  # why it went unnoticed: for an even kernel both are one


@pytest.mark.parametrize("shape", [(64, 64), (65, 48)])
def test_periodic_tikhonov_is_the_wiener_filter_of_scikit_image(shape):
    image, kernel = RNG(0).random(shape), np.outer(LOPSIDED, BLUR)
    theirs = wiener(image, kernel, 0.01, reg=np.ones((1, 1)), clip=False)
    # Two filters of condition 1 / 0.01 through FFTs: 1e-11 is 100 x some hundred roundings; asked is 1e-6.
    assert np.abs(tikhonov_fft(image, kernel, 0.01, mode="periodic") - theirs).max() < 1e-11
    # The planted twin: their default penalty is the Laplacian, another problem.
    assert (
        np.abs(tikhonov_fft(image, kernel, 0.01, mode="periodic") - wiener(image, kernel, 0.01, clip=False)).max()
        > 1e-2
    )


# -- choosing alpha ----------------------------------------------------------------------------------------------------


def test_norms_of_the_spectrum_are_those_of_the_estimate():
    f, matrix, g, _ = blurred(0.01)
    kernel_2d = np.outer(LOPSIDED, LOPSIDED)
    image = RNG(0).random((13, 10))
    for spectrum, data, apply in (
        (matrix_spectrum(matrix, g), g, lambda x: matrix @ x),
        (
            convolution_spectrum(image, kernel_2d, mode="periodic"),
            image,
            Convolution(kernel_2d, image.shape, mode="periodic").apply,
        ),
    ):
        estimate = spectrum.solve(0.03)
        assert spectrum.residual_norm(0.03) == pytest.approx(np.linalg.norm(data - apply(estimate)), rel=1e-9)
        assert spectrum.signal_norm(0.03) == pytest.approx(np.linalg.norm(estimate), rel=1e-9)
    influence = matrix @ np.linalg.solve(matrix.T @ matrix + 0.03 * np.eye(f.size), matrix.T)
    assert matrix_spectrum(matrix, g).freedom(0.03) == pytest.approx(g.size - np.trace(influence), rel=1e-9)
    periodic = toeplitz_matrix(LOPSIDED, 31, mode="periodic")
    influence = periodic @ np.linalg.solve(periodic.T @ periodic + 0.03 * np.eye(31), periodic.T)
    freedom = convolution_spectrum(np.ones(31), LOPSIDED, mode="periodic").freedom(0.03)
    assert freedom == pytest.approx(31 - np.trace(influence), rel=1e-9)


def test_discrepancy_leaves_the_noise():
    _, matrix, g, added = blurred(0.01)
    spectrum = matrix_spectrum(matrix, g)
    alpha = discrepancy_alpha(spectrum, float(np.linalg.norm(added)))
    assert np.linalg.norm(g - matrix @ tikhonov_dense(matrix, g, alpha)) == pytest.approx(
        np.linalg.norm(added), rel=1e-8
    )

    def residual(alpha):
        return float(np.linalg.norm(g - matrix @ tikhonov_lsmr(matrix, g, alpha)))

    by_lsmr = discrepancy_alpha(residual, float(np.linalg.norm(added)), low=1e-4, high=10.0)
    assert by_lsmr == pytest.approx(alpha, rel=1e-5)
    with pytest.raises(UndeterminedError, match="check the noise"):
        discrepancy_alpha(spectrum, 10 * float(np.linalg.norm(g)))


def test_gcv_is_the_error_of_leaving_each_datum_out_for_a_rotation_of_the_data():
    # Golub, Heath and Wahba's definition: for a circulant influence matrix GCV is ordinary cross-validation.
    n, alpha = 24, 0.05
    matrix = toeplitz_matrix(LOPSIDED, n, mode="periodic")
    g = RNG(1).standard_normal(n)
    left_out = 0.0
    for j in range(n):
        kept = np.arange(n) != j
        estimate = np.linalg.solve(matrix[kept].T @ matrix[kept] + alpha * np.eye(n), matrix[kept].T @ g[kept])
        left_out += (g[j] - matrix[j] @ estimate) ** 2
    assert gcv(convolution_spectrum(g, LOPSIDED, mode="periodic"), alpha) == pytest.approx(left_out / n, rel=1e-9)


def test_l_curve_curvature_is_that_of_the_curve():
    _, matrix, g, _ = blurred(0.01)
    spectrum = matrix_spectrum(matrix, g)
    t = math.log(1e-3)
    step = 1e-3
    u, v = np.array([
        (math.log(spectrum.residual_norm(math.exp(s))), math.log(spectrum.signal_norm(math.exp(s))))
        for s in (t - step, t, t + step)
    ]).T  # fmt: skip
    first = [(x[2] - x[0]) / (2 * step) for x in (u, v)]
    second = [(x[2] - 2 * x[1] + x[0]) / step**2 for x in (u, v)]
    numeric = (first[0] * second[1] - first[1] * second[0]) / math.hypot(*first) ** 3
    assert l_curve_curvature(spectrum, math.exp(t)) == pytest.approx(numeric, rel=1e-4)  # O(step^2) of the differences


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("seed", range(4))
def test_chosen_alphas_are_nearly_as_good_as_the_best(noise, seed):
    f = np.zeros(120)
    f[20:40], f[60:64], f[90:100] = 1.0, 2.0, 0.5
    _, matrix, _, added = blurred(noise, seed=seed)
    g = matrix @ f + added
    spectrum = matrix_spectrum(matrix, g)
    trials = [spectrum.solve(a) for a in np.logspace(-10, 3, 131)]

    def loss(alpha, operator):
        """How much worse than the best of all trials, for the signal or for what it predicts."""
        best = min(np.linalg.norm(operator @ (trial - f)) for trial in trials)
        return np.linalg.norm(operator @ (spectrum.solve(alpha) - f)) / best

    # GCV's theorem is about prediction: its inefficiency goes to 1 with the number of data. Over 20 seeds: at most 1.10 for
    # it, 1.11 for the discrepancy, 1.27 for the L-curve. Four decades off, the planted twins, it is 12 and more.
    assert loss(gcv_alpha(spectrum), matrix) < 1.2
    assert loss(gcv_alpha(spectrum) * 1e4, matrix) > 10
    assert loss(discrepancy_alpha(spectrum, float(np.linalg.norm(added))), np.eye(120)) < 1.2
    assert loss(l_curve_alpha(spectrum), np.eye(120)) < 1.4
    assert loss(l_curve_alpha(spectrum) / 1e4, np.eye(120)) > 5


def test_rules_that_find_nothing_say_so():
    _, matrix, _, _ = blurred(0.0)
    spectrum = matrix_spectrum(np.eye(20), RNG(0).standard_normal(20))  # every alpha is as good for white data
    with pytest.raises(UndeterminedError, match="trial"):
        gcv_alpha(spectrum)
    with pytest.raises(UndeterminedError, match="trial"):
        l_curve_alpha(spectrum)
    with pytest.raises(UndeterminedError, match="trial"):
        gcv_alpha(matrix_spectrum(matrix, np.zeros(matrix.shape[0])))


# -- Richardson-Lucy ---------------------------------------------------------------------------------------------------


def deviance(data, prediction):
    lit = data > 0
    return 2 * float(np.sum(data[lit] * np.log(data[lit] / prediction[lit])) - data.sum() + prediction.sum())


def margin_image(kernel, size=48, seed=0):
    """Noisy blocks that end a kernel's width from the border."""
    f = np.zeros((size, size))
    f[12:-12, 12:-12] = np.kron(RNG(seed).random((6, 6)), np.ones((4, 4)))
    return np.maximum(Convolution(kernel, f.shape, mode="same").apply(f), 0) * (1 + 0.01 * RNG(1).random((size, size)))


def test_one_step_is_that_of_the_equation():
    matrix, f = RNG(0).random((7, 5)), RNG(1).random(5)
    g = RNG(2).random(7)
    wanted = f / matrix.sum(axis=0) * (matrix.T @ (g / (matrix @ f + 0.1)))
    found = richardson_lucy(matrix, g, iterations=1, start=f, background=0.1)
    assert np.allclose(found.signal, wanted, rtol=1e-14, atol=0)


def test_deviance_never_rises_and_light_is_kept():
    f = RNG(0).random(50)
    operator = Convolution(LOPSIDED, (50,))
    g = RNG(1).poisson(100 * np.maximum(operator.apply(f), 0)).astype(float)
    values, sums = [], []
    for iterations in (1, 2, 4, 8, 16, 32, 64):
        estimate = richardson_lucy(operator, g, iterations=iterations).signal
        values.append(deviance(g, operator.apply(estimate)))
        sums.append((toeplitz_matrix(LOPSIDED, 50) @ estimate).sum())
    assert np.all(np.diff(values) < 0)
    assert np.allclose(sums, g.sum(), rtol=1e-12)  # sum of H f is the sum of g after every step without background


def test_richardson_lucy_is_that_of_scikit_image_where_no_light_crosses_the_border():
    kernel = np.outer(BLUR, BLUR)[5:-5, 5:-5]
    kernel /= kernel.sum()
    image = margin_image(kernel)
    theirs = skimage_richardson_lucy(image, kernel, 40, clip=False)
    ours = richardson_lucy(
        Convolution(kernel, image.shape, mode="same"),
        image,
        iterations=40,
        start=np.full(image.shape, 0.5),
        background=1e-12,
    )
    # Asked is 1e-6; the same operations in another order differ by rounding, which 40 steps carry along.
    assert np.abs(ours.signal - theirs).max() < 1e-9
    # The planted twin: a kernel turned round is not noticed by an even one, so turn a lopsided one.
    lopsided = np.outer(LOPSIDED, LOPSIDED)
    theirs = skimage_richardson_lucy(image, lopsided, 40, clip=False)
    turned = richardson_lucy(
        Convolution(lopsided[::-1, ::-1], image.shape, mode="same"), image, iterations=40, background=1e-12
    )
    assert np.abs(turned.signal - theirs).max() > 1e-2


def test_the_border_of_a_cropped_picture_needs_the_normalisation():
    kernel = np.outer(BLUR, BLUR)
    flat = np.ones((40, 40))
    operator = Convolution(kernel, flat.shape, mode="same")
    image = operator.apply(flat)  # a uniform field filmed up to its edge: darker there
    ours = richardson_lucy(operator, image, iterations=50, start=np.full(flat.shape, 0.5)).signal
    theirs = skimage_richardson_lucy(image, kernel, 50, clip=False)  # no division by H^T 1
    assert np.abs(ours - 1).max() < 1e-6
    assert np.abs(theirs - 1).max() > 0.1


def test_acceleration_reaches_the_same_end_in_fewer_iterations():
    f = np.zeros(80)
    f[[20, 26, 50]] = 1, 0.6, 0.3
    operator = Convolution(BLUR, (80,))
    g = np.maximum(operator.apply(f), 0)

    def misfit(iterations, acceleration):
        return richardson_lucy(operator, g, iterations=iterations, acceleration=acceleration).misfit[-1]

    assert misfit(60, "biggs-andrews") < misfit(300, "none")
    accelerated = richardson_lucy(operator, g, iterations=60, acceleration="biggs-andrews").signal
    assert accelerated.min() >= 0
    # Two components, the exact maximum known: both must end there.
    matrix = np.array([[0.7, 0.2], [0.3, 0.8]])
    ends = [
        richardson_lucy(matrix, [1.0, 2.0], iterations=400, acceleration=a).signal for a in ("none", "biggs-andrews")
    ]
    assert np.allclose(ends, np.linalg.solve(matrix, [1.0, 2.0]), rtol=0, atol=1e-8)


def test_stops_at_the_noise_before_it_fits_it():
    f = np.zeros(200)
    f[50:70], f[120:124] = 200, 900
    operator = Convolution(BLUR, (200,))
    g = RNG(0).poisson(np.maximum(operator.apply(f), 0) + 5.0).astype(float)
    stopped = richardson_lucy(operator, g, iterations=5000, background=5.0, noise="poisson")
    assert stopped.stopped_by == "discrepancy"
    assert "noise" in stopped.status
    assert deviance(g, operator.apply(stopped.signal) + 5.0) <= g.size
    earlier = richardson_lucy(operator, g, iterations=stopped.iterations - 1, background=5.0)
    assert deviance(g, operator.apply(earlier.signal) + 5.0) > g.size
    late = richardson_lucy(operator, g, iterations=5000, background=5.0)
    assert late.stopped_by == "iterations"
    assert np.linalg.norm(late.signal - f) > np.linalg.norm(stopped.signal - f)  # what the rule is for
    gaussian = richardson_lucy(operator, g, iterations=5000, background=5.0, noise=float(np.linalg.norm(np.sqrt(g))))
    assert gaussian.stopped_by == "discrepancy"


def test_stops_where_nothing_changes():
    found = richardson_lucy(np.eye(3), [1.0, 2.0, 3.0], iterations=50)
    assert found.stopped_by == "relative change"
    assert found.iterations == 2
    assert np.array_equal(found.signal, [1.0, 2.0, 3.0])


def test_nothing_is_clipped():
    operator = Convolution(BLUR, (30,))
    bright = np.maximum(operator.apply(np.full(30, 1e6)), 0)
    assert richardson_lucy(operator, bright).signal.max() > 9e5
    assert np.abs(tikhonov_fft(bright, BLUR, 1e-3)).max() > 9e5


# -- bad input and corner cases ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1j])
def test_values_that_are_no_real_numbers_are_refused(bad):
    g = np.ones(8, dtype=complex if isinstance(bad, complex) else float)
    g[3] = bad
    for call in (
        lambda: tikhonov_fft(g, [1.0, 2.0], 1.0),
        lambda: tikhonov_dense(np.eye(8), g, 1.0),
        lambda: tikhonov_lsmr(np.eye(8), g, 1.0),
        lambda: richardson_lucy(np.eye(8), g),
    ):
        with pytest.raises(InputError, match="data"):
            call()
    with pytest.raises(InputError, match="kernel"):
        Convolution(g, (20,))


def test_negative_data_are_refused_by_richardson_lucy_and_no_other():
    g = np.array([1.0, -0.5, 1.0])
    with pytest.raises(InputError, match=r"data: holds -0\.5; Richardson-Lucy takes values >= 0"):
        richardson_lucy(np.eye(3), g)
    assert np.allclose(tikhonov_dense(np.eye(3), g, 1.0), g / 2)
    with pytest.raises(InputError, match="operator"):
        richardson_lucy(Convolution([1.0, -1.0], (3,)), np.ones(4))
    with pytest.raises(InputError, match="operator"):
        richardson_lucy(np.array([[1.0, -1.0], [1.0, 3.0]]), np.ones(2))
    with pytest.raises(InputError, match="background"):
        richardson_lucy(np.eye(3), np.ones(3), background=-1.0)


def test_kernels_longer_than_the_signal():
    f, h = np.array([1.0, 2.0]), np.array([0.5, 1.0, 0.25, 0.1, 0.05])
    g = np.convolve(f, h)
    assert np.allclose(tikhonov_fft(g, h, 1e-14), f, atol=1e-9)
    assert np.allclose(tikhonov_lsmr(Convolution(h, (2,)), g, 1e-16), f, atol=1e-7)
    assert np.allclose(richardson_lucy(Convolution(h, (2,)), g, iterations=2000).signal, f, atol=1e-6)
    same = Convolution(h, (2,), mode="same")
    assert np.allclose(same.apply(f), np.convolve(f, h)[2:4])
    for call in (
        lambda: Convolution(h, (2,), mode="periodic"),
        lambda: toeplitz_matrix(h, 2, mode="periodic"),
        lambda: tikhonov_fft(f, h, 1.0),
        lambda: tikhonov_fft(f, h, 1.0, mode="periodic"),
    ):
        with pytest.raises(InputError, match="longer than"):
            call()


def test_zeros():
    zero = np.zeros(6)
    assert np.array_equal(tikhonov_fft(zero, [1.0, 2.0], 1.0), np.zeros(5))
    assert np.array_equal(tikhonov_lsmr(np.eye(6), zero, 1.0), zero)
    assert np.array_equal(richardson_lucy(np.eye(6), zero).signal, zero)
    assert np.array_equal(tikhonov_fft(np.ones(6), [0.0, 0.0], 1.0), np.zeros(5))
    with pytest.raises(InputError, match="no light"):
        richardson_lucy(Convolution([0.0, 0.0], (5,)), np.ones(6))
    with pytest.raises(InputError, match="zero everywhere"):
        gcv_alpha(convolution_spectrum(np.ones(6), [0.0, 0.0]))
    with pytest.raises(InputError, match="zeros stay zero"):
        richardson_lucy(np.eye(2), [1.0, 1.0], start=[1.0, 0.0])
    # A sample of f that no datum sees keeps its start; data of zero force theirs to zero.
    unseen = richardson_lucy(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [2.0, 0.0], start=[1.0, 1.0, 7.0])
    assert np.allclose(unseen.signal, [2.0, 0.0, 7.0])


@pytest.mark.parametrize("mode", MODES)
def test_one_sample(mode):
    operator = Convolution([2.0], (1,), mode=mode)
    assert np.allclose(operator.apply([3.0]), [6.0])
    assert np.allclose(richardson_lucy(operator, [6.0], iterations=3).signal, [3.0])
    assert np.allclose(tikhonov_lsmr(operator, [6.0], 1.0), [12 / 5])
    if mode != "same":
        assert np.allclose(tikhonov_fft([6.0], [2.0], 1.0, mode=mode), [12 / 5])
    assert np.allclose(tikhonov_dense(toeplitz_matrix([2.0], 1, mode=mode), [6.0], 1.0), [12 / 5])


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint8, np.int64, bool])
def test_every_real_type_is_computed_in_float64(dtype):
    g = np.array([0, 1, 1, 0, 1, 0, 1]).astype(dtype)
    h = np.array([1, 0, 1]).astype(dtype)
    exact, kernel = g.astype(float), h.astype(float)
    for call in (
        lambda g, h: tikhonov_fft(g, h, 0.1),
        lambda g, h: tikhonov_lsmr(Convolution(h, (5,)), g, 0.1),
        lambda g, h: tikhonov_dense(toeplitz_matrix(h, 5), g, 0.1),
        lambda g, h: richardson_lucy(Convolution(h, (5,)), g, iterations=5).signal,
    ):
        found = call(g, h)
        assert found.dtype == np.float64
        assert np.array_equal(found, call(exact, kernel))


def test_huge_and_tiny_units_scale_the_answer():
    f, _, g, _ = blurred(0.001)
    g = np.maximum(g, 0)
    operator = Convolution(BLUR, (f.size,))
    plain = tikhonov_fft(g, BLUR, 1e-3), richardson_lucy(operator, g, iterations=20).signal
    for unit in (1e-100, 1e100):
        assert np.allclose(tikhonov_fft(unit * g, BLUR, 1e-3) / unit, plain[0], rtol=0, atol=1e-10)
        assert np.allclose(
            richardson_lucy(operator, unit * g, iterations=20).signal / unit, plain[1], rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: tikhonov_dense(np.eye(2), np.ones(2), 0.0), "alpha"),
        (lambda: tikhonov_fft(np.ones(4), np.ones(2), -1.0), "alpha"),
        (lambda: tikhonov_lsmr(np.eye(2), np.ones(2), math.nan), "alpha"),
        (lambda: tikhonov_dense(np.eye(2), np.ones(3), 1.0), "data"),
        (lambda: tikhonov_lsmr(np.eye(2), np.ones(3), 1.0), "data"),
        (lambda: tikhonov_fft(np.ones((4, 4)), np.ones(2), 1.0), "kernel"),
        (lambda: tikhonov_fft(np.ones(4), np.ones(2), 1.0, mode="same"), "mode"),
        (lambda: tikhonov_fft([], np.ones(2), 1.0), "data"),
        (lambda: Convolution(np.ones(2), (3,), mode="valid"), "mode"),
        (lambda: Convolution(np.ones(2), (3, 3)), "signal_shape"),
        (lambda: Convolution(np.ones(2), (0,)), "signal_shape"),
        (lambda: Convolution(np.ones(2), (3,), origin=(2,)), "origin"),
        (lambda: Convolution(np.ones(2), (3,)).apply(np.ones(4)), "signal"),
        (lambda: richardson_lucy(np.eye(2), np.ones(3)), "data"),
        (lambda: richardson_lucy(np.eye(2), np.ones(2), start=np.ones(3)), "start"),
        (lambda: richardson_lucy(np.eye(2), np.ones(2), iterations=0), "iterations"),
        (lambda: richardson_lucy(np.eye(2), np.ones(2), acceleration="fast"), "acceleration"),
        (lambda: richardson_lucy(np.eye(2), np.ones(2), noise="white"), "noise"),
        (lambda: richardson_lucy(np.eye(2), np.ones(2), noise=0.0), "noise"),
        (lambda: discrepancy_alpha(lambda alpha: alpha, 1.0), "residual_norm"),
    ],
)
def test_other_bad_input_is_refused_by_field(call, field):
    with pytest.raises(InputError, match=field):
        call()


def test_lsmr_that_has_not_converged_is_an_error():
    _, matrix, g, _ = blurred(0.01)
    with pytest.raises(UndeterminedError, match="2 iterations"):
        tikhonov_lsmr(aslinearoperator(matrix), g, 1e-9, max_iterations=2)


def test_rounding_of_an_fft_is_no_negative_data():
    g = np.array([1.0, -EPS, 0.5])
    assert np.array_equal(richardson_lucy(np.eye(3), g, iterations=2).signal, [1.0, 0.0, 0.5])
