"""What holds at every size: exact scaling by powers of two, adjoints to a few eps, reciprocity, and shares between 0 and 1.

The table of extremes (test_extremes) asks single values; here Hypothesis looks between them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import wallmirror as wm
from wallmirror.arithmetic import power_of_two, rescaled
from wallmirror.convolution import (
    HalfCircle,
    angle_convolution,
    convolve_centred,
    spherical_convolution,
    wall_convolution,
)
from wallmirror.deconvolution import (
    Convolution,
    adjoint_mismatch,
    align,
    aligned_error,
    gcv_alpha,
    matrix_spectrum,
    richardson_lucy,
    tikhonov_fft,
    toeplitz_matrix,
)
from wallmirror.interreflection import from_card
from wallmirror.transport import strip_factor

from .helpers import EPS, refused, same_examples

few_examples = settings(same_examples, max_examples=25)
angles = st.floats(-math.pi / 2, math.pi / 2)
POWERS = st.integers(-900, 900)
#: Samples that are zero or far from the smallest float, so that a power of two loses nothing.
samples = st.lists(st.just(0.0) | st.floats(1e-3, 1e3), min_size=3, max_size=9)


# -- units --------------------------------------------------------------------------------------------------------


@same_examples
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_a_unit_is_a_power_of_two_in_which_the_largest_value_is_about_one(values):
    unit = power_of_two(values)
    assert math.frexp(unit)[0] == 0.5
    assert math.isfinite(1 / unit)
    largest = max(map(abs, values))
    assert largest == 0 or 2.0**-60 < largest / unit < 8  # a denormal one is further off
    # Back in its own unit the largest value is what it was.
    assert rescaled(largest / unit, unit, field="values") == largest


def test_what_leaves_float64_is_refused_and_what_only_passes_outside_is_not():
    assert rescaled([1.5], 2.0**900, 2.0**900, 2.0**-900, 2.0**-900, field="values")[0] == 1.5
    assert refused(lambda: rescaled([1.5], 2.0**900, 2.0**900, field="values")).field == "values"


# -- reflectance --------------------------------------------------------------------------------------------------


@same_examples
@given(eta=st.floats(1e-3, 1e3), k=st.just(0.0) | st.floats(1e-12, 1e3), cosine=st.floats(0, 1))
def test_a_fresnel_reflectance_is_a_share(eta, k, cosine):
    assert 0 <= float(wm.Fresnel(eta=eta, k=k)(cosine)) <= 1 + 8 * EPS


@same_examples
@given(step=st.floats(1e-15, 1e-3))
def test_a_fresnel_reflectance_vanishes_as_the_square_of_a_small_step_of_the_index(step):
    # ((n - 1) / (n + 1))^2 with n - 1 as float64 holds it.
    eta = 1 + step
    exact = ((eta - 1) / (eta + 1)) ** 2
    assert float(wm.Fresnel(eta=eta)(1.0)) == pytest.approx(exact, rel=16 * EPS)


@same_examples
@given(
    s=angles, o=angles, alpha=st.floats(1e-3, 1), distribution=st.sampled_from(["ggx", "beckmann"]),
    facets=st.sampled_from(["grooves", "isotropic"]),
)  # fmt: skip
def test_microfacets_are_reciprocal_and_not_negative_up_to_the_horizon(s, o, alpha, distribution, facets):
    brdf = wm.CookTorrance(alpha=alpha, distribution=distribution, facets=facets)
    one, other = float(brdf(s, o)), float(brdf(o, s))
    assert one >= 0
    assert math.isfinite(one)
    assert one == pytest.approx(other, rel=1e-13)


@same_examples
@given(u=st.floats(0, 3), exponent=st.floats(0, 1e8))
def test_a_lobe_of_phong_lies_between_nothing_and_its_peak(u, exponent):
    lobe = wm.Phong(exponent=exponent, reflectance=1.0, form="plain")
    value = float(lobe.of_sum(u))
    assert 0 <= value <= 1
    if 0 < u < math.pi / 2:  # cos u <= exp(-u^2 / 2), both of which lobes this narrow are
        assert value <= math.exp(-exponent * u * u / 2) * (1 + 1e-12) + 1e-300


@few_examples
@given(power=POWERS, values=samples, u=st.integers(-64, 64).map(lambda n: n / 64))
def test_tables_scale_exactly_by_powers_of_two(power, values, u):
    one, other = (wm.AngleSumTable(start=-1.0, stop=1.0, values=np.ldexp(values, p)) for p in (0, power))
    assert np.ldexp(other.of_sum(u), -power) == one.of_sum(u)


# -- transport and bounces ----------------------------------------------------------------------------------------


def _scene(factor: float, x: float, albedo: float = 0.0) -> tuple[wm.Observer, wm.Card]:
    eye = wm.Observer(position=(0.25 * factor, -2 * factor), fov=1.0, view_angles=(0.1,), pixels=5)
    strips = wm.Card(
        elements_x=(x * factor, (x + 1) * factor), y=-factor, element_width=factor / 16, element_height=factor / 8,
        albedo=albedo, board_width=2 * factor, board_height=factor,
    )  # fmt: skip
    return eye, strips


@few_examples
@given(power=st.integers(-300, 300), x=st.floats(-1, 1).map(lambda v: round(v * 64) / 64))
def test_a_scene_of_another_size_sends_the_same_light(power, x):
    brdf = wm.GaussianTrain(centres=(0.2,), sigma=0.4)
    plain, larger = (_scene(math.ldexp(1.0, p), x, albedo=0.5) for p in (0, power))
    assert np.array_equal(wm.transport_matrix(*larger, brdf), wm.transport_matrix(*plain, brdf))
    source = np.array([[1.0], [0.5]])
    assert np.array_equal(from_card(*larger, brdf, source), from_card(*plain, brdf, source))


@same_examples
@given(distance=st.floats(1e-3, 1e3), dx=st.floats(-1e3, 1e3), low=st.floats(-1e3, 1e3), height=st.floats(1e-9, 1e3))
def test_a_strip_is_the_sum_of_its_halves_and_the_mirror_image_of_itself(distance, dx, low, height):
    high = low + height
    middle = low + (high - low) / 2
    whole = float(strip_factor(distance, dx, low, high))
    parts = float(strip_factor(distance, dx, low, middle)) + float(strip_factor(distance, dx, middle, high))
    assert whole >= 0
    assert whole == pytest.approx(parts, rel=1e-12, abs=1e-300)
    assert whole == pytest.approx(float(strip_factor(distance, -dx, -high, -low)), rel=1e-13, abs=1e-300)


# -- convolution --------------------------------------------------------------------------------------------------


@few_examples
@given(power=POWERS, strengths=st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=2))
def test_renders_by_convolution_scale_exactly_by_powers_of_two(power, strengths):
    eye, strips = _scene(1.0, -0.5)
    lobe = wm.GaussianTrain(centres=(0.2,), sigma=0.4)
    for render in (spherical_convolution, angle_convolution, wall_convolution):
        one, other = (render(eye, strips, lobe, np.ldexp(strengths, p)) for p in (0, power))
        assert np.array_equal(np.ldexp(other, -power), one)


@same_examples
@given(angles=st.lists(angles, min_size=1, max_size=5), order=st.integers(0, 9), seed=st.integers(0, 9))
def test_reading_a_half_circle_is_the_adjoint_of_spreading_onto_it(angles, order, seed):
    rng, grid = np.random.default_rng(seed), HalfCircle(samples=40, order=order)
    strengths, coefficients = rng.standard_normal(len(angles)), rng.standard_normal(80)
    one = float(grid.spread(angles, strengths) @ coefficients)
    two = float(strengths @ grid.read(coefficients, angles))
    assert abs(one - two) <= 16 * EPS * float(np.abs(strengths).sum() * np.abs(coefficients).max())


@same_examples
@given(signal=samples, kernel=samples.filter(lambda k: len(k) % 2 == 1), one=st.integers(-400, 400), two=POWERS)
def test_a_centred_convolution_is_numpys_in_any_unit(signal, kernel, one, two):
    found = np.ldexp(
        np.ldexp(convolve_centred(np.ldexp(signal, one), np.ldexp(kernel, min(two, 500))), -one), -min(two, 500)
    )
    half, full = len(kernel) // 2, np.convolve(signal, kernel)
    scale = max(signal) * max(kernel)
    assert np.allclose(found, full[half : half + len(signal)], rtol=0, atol=64 * EPS * scale)


# -- deconvolution ------------------------------------------------------------------------------------------------


@same_examples
@given(
    signal=st.integers(1, 40), kernel=st.integers(1, 40), mode=st.sampled_from(["full", "same", "periodic"]), data=st.data(),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_operators_have_the_adjoint_that_they_say(signal, kernel, mode, data, seed):
    if mode == "periodic":
        kernel = min(kernel, signal)
    origin = data.draw(st.integers(0, kernel - 1))
    h = np.random.default_rng(seed).standard_normal(kernel)
    blur = Convolution(h, (signal,), mode=mode, origin=(origin,))
    matrix = toeplitz_matrix(h, signal, mode=mode, origin=origin)
    largest = float(np.abs(h).max())
    assert (
        adjoint_mismatch(blur) < 256 * EPS or np.abs(matrix).max() < 1e-3 * largest
    )  # a crop may leave next to nothing
    f, g = (np.random.default_rng(10 + seed).standard_normal(n) for n in (signal, matrix.shape[0]))
    allowed = 64 * EPS * largest * (signal + kernel)
    assert np.allclose(blur.apply(f), matrix @ f, rtol=0, atol=allowed)
    assert np.allclose(blur.adjoint(g), matrix.T @ g, rtol=0, atol=allowed)


KERNEL = np.array([0.25, 1.0, 0.5])


@few_examples
@given(data=samples.filter(any), power=POWERS)
def test_known_kernels_are_deconvolved_exactly_alike_in_any_unit_of_data(data, power):
    scaled = np.ldexp(data, power)
    assert np.array_equal(np.ldexp(tikhonov_fft(scaled, KERNEL, 0.1), -power), tikhonov_fft(data, KERNEL, 0.1))
    blur = Convolution(KERNEL, (len(data),), mode="same")
    one, other = (richardson_lucy(blur, g, iterations=7, acceleration="biggs-andrews") for g in (data, scaled))
    assert np.array_equal(np.ldexp(other.signal, -power), one.signal)
    assert np.array_equal(np.ldexp(other.misfit, -power), one.misfit)
    assert np.array_equal(other.change, one.change)


@few_examples
@given(data=samples.filter(any), power=POWERS)
def test_a_brighter_kernel_makes_a_darker_signal(data, power):
    one, other = (
        richardson_lucy(Convolution(np.ldexp(KERNEL, p), (len(data),), mode="same"), data, iterations=7)
        for p in (0, power)
    )
    # A result beyond float64 is refused; these are not.
    assert np.array_equal(np.ldexp(other.signal, power), one.signal)


@few_examples
@given(power=POWERS, seed=st.integers(0, 20))
def test_the_chosen_regularisation_knows_no_unit_of_data(power, seed):
    matrix = toeplitz_matrix([1.0, 2.0, 1.0], 40)
    data = matrix @ np.sin(np.arange(40) / 5) + 0.01 * np.random.default_rng(seed).standard_normal(42)
    try:
        plain = gcv_alpha(matrix_spectrum(matrix, data))
    except wm.UndeterminedError:
        with pytest.raises(wm.UndeterminedError):
            gcv_alpha(matrix_spectrum(matrix, np.ldexp(data, power)))
        return
    assert gcv_alpha(matrix_spectrum(matrix, np.ldexp(data, power))) == plain


@same_examples
@given(truth=samples.filter(any), one=st.integers(-450, 450), two=st.integers(-450, 450))
def test_errors_up_to_a_scale_know_no_unit(truth, one, two):
    estimate = np.array(truth) + np.linspace(0, 0.5, len(truth))
    found, plain = align(np.ldexp(estimate, one), np.ldexp(truth, two)), align(estimate, truth)
    assert (found.error, found.shift) == (plain.error, plain.shift)
    assert math.ldexp(found.scale, one - two) == plain.scale
    assert aligned_error(np.ldexp(estimate, one), np.ldexp(truth, two)) == aligned_error(estimate, truth)
