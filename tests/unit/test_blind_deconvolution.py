"""Iterative blind deconvolution and alternating Richardson-Lucy: equations, ambiguities, when they succeed, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from wallmirror import InputError, UndeterminedError
from wallmirror.deconvolution import (
    Convolution,
    align,
    blind_richardson_lucy,
    corner_support,
    iterative_blind,
    toeplitz_matrix,
)

RNG = np.random.default_rng


def spikes(seed: int, n: int = 64, k: int = 12):
    """Five spikes, a kernel of two lobes, and their full convolution."""
    rng = RNG(seed)
    f = np.zeros(n)
    f[rng.choice(n, 5, replace=False)] = rng.uniform(0.3, 1, 5)
    h = np.exp(-0.5 * ((np.arange(k) - 3) / 1.2) ** 2) + 0.5 * np.exp(-0.5 * ((np.arange(k) - 8) / 1.0) ** 2)
    return f, h / h.sum(), np.convolve(f, h / h.sum())


def padded(mask, size):
    return np.pad(mask, (0, size - mask.size))


# -- the ambiguities ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-3, 2)])
def test_shift_and_scale_leave_no_error(shift):
    truth = np.zeros((9, 8))
    truth[3:6, 2:6] = RNG(0).random((3, 4))
    moved = 7.5 * np.roll(truth, shift, (0, 1))
    aligned = align(moved, truth)
    assert aligned.error < 1e-12
    assert aligned.shift == (-shift[0], -shift[1])
    assert aligned.scale == pytest.approx(1 / 7.5)


def test_error_is_the_least_over_all_shifts_and_scales():
    e, t = RNG(0).random(7), RNG(1).random(5)
    errors = []
    for d in range(-6, 5):
        moved = np.array([e[n - d] if 0 <= n - d < 7 else 0.0 for n in range(-6, 13)])
        whole = np.array([t[n] if 0 <= n < 5 else 0.0 for n in range(-6, 13)])
        scale = moved @ whole / (moved @ moved)
        errors.append(np.linalg.norm(whole - scale * moved) / np.linalg.norm(whole))
    assert align(e, t).error == pytest.approx(min(errors), rel=1e-12)


def test_wrong_estimates_are_told():
    assert align([0.0, 1.0, 0.0], [1.0, 0.0, 1.0]).error == pytest.approx(np.sqrt(0.5))
    assert align(np.zeros(3), [1.0, 0.0, 1.0]).error == 1
    assert align([-1.0], [1.0, 0.0]).error <= 1  # a negative scale is not among the ambiguities
    with pytest.raises(InputError, match="truth"):
        align([1.0], [0.0])
    with pytest.raises(InputError, match="estimate"):
        align(np.ones((2, 2)), np.ones(3))


# -- Ayers and Dainty --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(15,), (7, 6)])
def test_two_iterations_are_those_of_the_equations(shape):
    g, alpha = RNG(0).random(shape), 0.3
    where_f, where_h = (
        corner_support(shape, tuple(n - 2 for n in shape)),
        corner_support(shape, tuple(3 for _ in shape)),
    )
    f = g
    h = np.zeros(shape)
    h[tuple(2 for _ in shape)] = 1.0  # where a support of three samples has its middle, counted from 1 / 2 up
    start = h.copy()
    big_g, big_f, big_h = np.fft.fftn(g), np.fft.fftn(f), np.fft.fftn(h)
    tilde_f = big_f
    for _ in range(2):
        tilde_h = big_g * big_f.conj() / (np.abs(big_f) ** 2 + alpha / np.abs(big_h) ** 2)  # eq. 3.15
        h = np.where(where_h, np.abs(np.fft.ifftn(tilde_h).real), 0)
        big_h = np.fft.fftn(h)
        tilde_f = big_g * big_h.conj() / (np.abs(big_h) ** 2 + alpha / np.abs(tilde_f) ** 2)  # eq. 3.16
        f = np.where(where_f, np.abs(np.fft.ifftn(tilde_f).real), 0)
        big_f = np.fft.fftn(f)
    found = iterative_blind(
        g, signal_support=where_f, kernel_support=where_h, alpha=alpha, iterations=2, kernel_start=start
    )
    assert np.allclose(found.signal, f, rtol=0, atol=1e-12)
    assert np.allclose(found.kernel, h, rtol=0, atol=1e-12)
    residual = np.linalg.norm(g - np.fft.ifftn(big_f * big_h).real) / np.linalg.norm(g)
    assert found.residual[-1] == pytest.approx(residual, rel=1e-10)


def test_the_truth_is_left_alone_and_a_wrong_start_is_not():
    f, h, g = spikes(0)
    supports = {
        "signal_support": padded(f > 0, g.size), "kernel_support": corner_support(g.shape, h.shape),
        "alpha": 1e-12, "iterations": 20,
    }  # fmt: skip
    from_truth = iterative_blind(g, **supports, signal_start=padded(f, g.size), kernel_start=padded(h, g.size))
    # alpha = 1e-12 damps components of power 1e-5 by 1e-7; what 20 iterations make of it stays below 1e-4.
    assert align(from_truth.signal, f).error < 1e-4
    assert align(from_truth.kernel, h).error < 1e-4
    elsewhere = iterative_blind(g, **{**supports, "iterations": 1}, kernel_start=padded(h[::-1].copy(), g.size))
    assert align(elsewhere.kernel, h).error > 1e-2


@pytest.mark.parametrize("nonnegativity", ["absolute", "zero"])
def test_supports_and_signs_are_kept(nonnegativity):
    f, h, g = spikes(1)
    where_f, where_h = corner_support(g.shape, f.shape), corner_support(g.shape, h.shape)
    found = iterative_blind(
        g, signal_support=where_f, kernel_support=where_h, alpha=1e-2, iterations=5, nonnegativity=nonnegativity
    )
    assert found.signal.min() >= 0
    assert found.kernel.min() >= 0
    assert not found.signal[~where_f].any()
    assert not found.kernel[~where_h].any()


# -- Fish et al. -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inner", [1, 3])
def test_an_iteration_is_that_of_two_dense_systems(inner):
    f, h = RNG(0).random(8), RNG(1).random(4)
    g = RNG(2).random(11) + 0.1
    new_h, new_f = h / h.sum(), f * g.sum() / f.sum()
    matrix = toeplitz_matrix(new_f, 4)
    for _ in range(inner):
        new_h = new_h / matrix.sum(axis=0) * (matrix.T @ (g / (matrix @ new_h)))
    new_h = new_h / new_h.sum()
    matrix = toeplitz_matrix(new_h, 8)
    for _ in range(inner):
        new_f = new_f / matrix.sum(axis=0) * (matrix.T @ (g / (matrix @ new_f)))
    found = blind_richardson_lucy(g, signal_start=f, kernel_start=h, iterations=1, inner=inner)
    assert np.allclose(found.signal, new_f, rtol=1e-12, atol=0)
    assert np.allclose(found.kernel, new_h, rtol=1e-12, atol=0)


@pytest.mark.parametrize("mode", ["full", "same", "periodic"])
def test_deviance_falls_and_the_kernel_keeps_unit_sum(mode):
    f, h = RNG(0).random((12, 10)), RNG(1).random((3, 4))
    g = np.maximum(Convolution(h, f.shape, mode=mode).apply(f), 0)
    values = []
    for iterations in (1, 3, 10, 30):
        found = blind_richardson_lucy(
            g, signal_start=np.ones(f.shape), kernel_start=1 + RNG(2).random(h.shape), mode=mode, iterations=iterations
        )
        p = Convolution(found.kernel, f.shape, mode=mode).apply(found.signal)
        values.append(float(np.sum(g * np.log(g / p) - g + p)))
        assert found.kernel.sum() == pytest.approx(1)
    # Rescaling the kernel to unit sum rescales f in the next step; in "same" mode alone that may cost a little.
    assert np.all(np.diff(values) < 0)


# -- when they succeed -------------------------------------------------------------------------------------------------


def test_richardson_lucy_succeeds_where_every_place_is_known_and_not_where_none_is():
    f, h, g = spikes(0)

    def error(signal_start, kernel_samples):
        kernel_start = 1 + 0.01 * RNG(0).random(kernel_samples)
        found = blind_richardson_lucy(g, signal_start=signal_start, kernel_start=kernel_start, iterations=300)
        assert found.residual[-1] < 0.2
        return max(align(found.signal, f).error, align(found.kernel, h).error)

    assert error((f > 0).astype(float), h.size) < 0.05
    assert error(np.ones(38), 38) > 0.3


def test_a_good_fit_is_no_proof():
    _, h, g = spikes(0)
    found = blind_richardson_lucy(g, signal_start=g + 1e-9, kernel_start=np.array([1.0]), iterations=20)
    assert found.residual[-1] < 1e-6  # the data, and a kernel of one sample
    assert align(found.kernel, h).error > 0.3


# -- bad input ---------------------------------------------------------------------------------------------------------

ANY = np.ones(6, dtype=bool)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (
            lambda: iterative_blind([1.0, np.nan], signal_support=[True, True], kernel_support=[True, True], alpha=1),
            "data",
        ),
        (lambda: iterative_blind(np.ones(6), signal_support=ANY[:5], kernel_support=ANY, alpha=1), "signal_support"),
        (lambda: iterative_blind(np.ones(6), signal_support=ANY, kernel_support=~ANY, alpha=1), "kernel_support"),
        (lambda: iterative_blind(np.ones(6), signal_support=ANY, kernel_support=np.ones(6), alpha=1), "kernel_support"),
        (lambda: iterative_blind(np.ones(6), signal_support=ANY, kernel_support=ANY, alpha=0), "alpha"),
        (
            lambda: iterative_blind(np.ones(6), signal_support=ANY, kernel_support=ANY, alpha=1, iterations=0),
            "iterations",
        ),
        (
            lambda: iterative_blind(np.ones(6), signal_support=ANY, kernel_support=ANY, alpha=1, nonnegativity="no"),
            "nonnegativity",
        ),
        (
            lambda: iterative_blind(
                np.ones(6), signal_support=ANY, kernel_support=ANY, alpha=1, kernel_start=np.zeros(6)
            ),
            "kernel_start",
        ),
        (lambda: corner_support((4,), (5,)), "extent"),
        (lambda: blind_richardson_lucy([1.0, -1.0, 1.0], signal_start=np.ones(2), kernel_start=np.ones(2)), "data"),
        (lambda: blind_richardson_lucy(np.ones(3), signal_start=np.ones(2), kernel_start=np.ones(3)), "data"),
        (lambda: blind_richardson_lucy(np.ones(3), signal_start=np.zeros(2), kernel_start=np.ones(2)), "signal_start"),
        (lambda: blind_richardson_lucy(np.ones(3), signal_start=np.ones(2), kernel_start=np.zeros(2)), "kernel_start"),
        (lambda: blind_richardson_lucy(np.ones(3), signal_start=np.ones(2), kernel_start=[1.0, 0.0]), "kernel_start"),
        (
            lambda: blind_richardson_lucy(np.ones(3), signal_start=np.ones(2), kernel_start=np.ones((2, 2))),
            "kernel_start",
        ),
        (
            lambda: blind_richardson_lucy(
                np.ones(3), signal_start=np.ones(3), kernel_start=np.ones(4), mode="periodic"
            ),
            "kernel",
        ),
    ],
)
def test_bad_input_is_refused_by_field(call, field):
    with pytest.raises(InputError, match=field):
        call()


def test_data_of_zero_determine_nothing():
    with pytest.raises(UndeterminedError, match="zero everywhere"):
        iterative_blind(np.zeros(6), signal_support=ANY, kernel_support=ANY, alpha=1)
    with pytest.raises(UndeterminedError, match="zero everywhere"):
        blind_richardson_lucy(np.zeros(3), signal_start=np.ones(2), kernel_start=np.ones(2))


def test_float32_one_sample_and_kernels_longer_than_the_signal():
    g = np.array([1, 3, 3, 1], dtype=np.float32)
    start = {"signal_start": np.ones(2, np.float32), "kernel_start": np.array([1, 2, 1], np.float32)}
    found = blind_richardson_lucy(g, **start, iterations=200)  # kernel of three samples, signal of two
    assert found.signal.dtype == found.kernel.dtype == np.float64
    assert np.allclose(np.convolve(found.signal, found.kernel), g, atol=1e-3)
    one = blind_richardson_lucy([4.0], signal_start=[1.0], kernel_start=[2.0])
    assert np.allclose([one.signal[0], one.kernel[0]], [4, 1])
    both = np.ones(1, dtype=bool)
    filtered = iterative_blind([4.0], signal_support=both, kernel_support=both, alpha=1e-9)
    assert filtered.signal[0] * filtered.kernel[0] == pytest.approx(4)
    where = {"signal_support": corner_support((4,), (2,)), "kernel_support": corner_support((4,), (3,)), "alpha": 1e-3}
    assert np.array_equal(iterative_blind(g, **where).signal, iterative_blind(g.astype(float), **where).signal)
