"""Tikhonov regularisation and the choice of its parameter, against mpmath; what is linear scales exactly."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import (
    Convolution,
    convolution_spectrum,
    discrepancy_alpha,
    gcv,
    gcv_alpha,
    l_curve_alpha,
    l_curve_curvature,
    matrix_spectrum,
    tikhonov_dense,
    tikhonov_fft,
    tikhonov_lsmr,
    toeplitz_matrix,
)
from wallmirror.deconvolution.spectrum import Spectrum

from .harness import Case, must_refuse, off
from .operators import BAD, KERNEL, LEVELS, SIGNAL

Array = NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Every cell of Tikhonov's method."""
    yield from tikhonov_cases()
    yield from choice_cases()


def regularised(matrix: Array, data: Array, alpha: float) -> mpmath.matrix:
    """(H^T H + alpha)^-1 H^T g at 700 digits, which holds 1e300 beside 1e-300."""
    h, g = mpmath.matrix(matrix.tolist()), mpmath.matrix(data.tolist())
    normal = h.T * h
    for i in range(normal.rows):
        normal[i, i] += mpmath.mpf(alpha)
    return mpmath.lu_solve(normal, h.T * g)


def tikhonov_cases() -> Iterator[Case]:
    """Eq. 3.13 by three ways, from no to all regularisation, in any unit of data."""
    dense = toeplitz_matrix(KERNEL, 6)
    ring = toeplitz_matrix(KERNEL, 6, mode="periodic")
    clean = dense @ SIGNAL + 0.01 * np.arange(8)
    ways: dict[str, tuple[Callable[[Array, float], Array], Array, Array]] = {
        "tikhonov_dense": (lambda g, a: tikhonov_dense(dense, g, a), dense, clean),
        "tikhonov_lsmr": (lambda g, a: tikhonov_lsmr(Convolution(KERNEL, (6,)), g, a, tolerance=1e-14), dense, clean),
        "tikhonov_fft, periodic": (lambda g, a: tikhonov_fft(g, KERNEL, a, mode="periodic"), ring, clean[:6]),
    }
    for name, (solve, matrix, data) in ways.items():
        # sigma_min is near 0.3 and sigma_max near 1.7; lsmr stops by the residual of the normal equations.
        allowed = 1e-9 if "lsmr" in name else 1e-13
        for alpha in (5e-324, 1e-300, 1e-12, 1e-3, 1.0, 1e12, 1e300):

            def weighted(
                s: Any = solve, h: Array = matrix, g: Array = data, a: float = alpha, t: float = allowed
            ) -> tuple[float, float]:
                with mpmath.workdps(700):
                    exact = [float(v) for v in regularised(h, g, a)]
                return off(s(g, a), exact), t

            yield Case(name, "alpha", f"{alpha:g}", weighted)
        for power in (-1000, -900, 900, 1010):

            def scaled(s: Any = solve, g: Array = data, p: int = power, n: str = name) -> tuple[float, float]:
                # Below 2^-970 data lose digits.
                return off(np.ldexp(s(np.ldexp(g, p), 0.01), -p), s(g, 0.01)), 0.0 if p > -970 else 1e-2

            yield Case(name, "g x 2^k", f"k = {power}", scaled)
        yield Case(name, "data", "0", lambda s=solve, g=data: (float(np.max(np.abs(s(0 * g, 1.0)))), 0.0))
        for alpha in (0.0, -1.0, math.nan, math.inf):
            yield Case(name, "alpha", f"{alpha:g}", must_refuse(lambda s=solve, g=data, a=alpha: s(g, a)))
        for words, given in BAD:
            yield Case(name, "data", words, must_refuse(lambda s=solve, g=given: s(g, 1.0)))
        for kind in (np.float32, np.float16):
            yield Case(name, "type", kind.__name__, lambda s=solve, g=data, k=kind: (
                off(s(g.astype(k), 0.1), s(g.astype(k).astype(np.float64), 0.1)), 0.0))  # fmt: skip
    for power in (-600, -500, -300, 300, 500, 600):

        def both(p: int = power) -> tuple[float, float]:
            plain, alpha = tikhonov_dense(dense, clean, 0.25), math.ldexp(0.25, 2 * p) if abs(p) < 500 else 0.25
            if abs(p) < 500:
                return off(np.ldexp(tikhonov_dense(np.ldexp(dense, p), clean, alpha), p), plain), 1e-13
            with mpmath.workdps(700):
                exact = [float(v) for v in regularised(np.ldexp(dense, p), clean, 0.25)]
            return off(tikhonov_dense(np.ldexp(dense, p), clean, 0.25), exact), 1e-13

        def ringing(p: int = power) -> tuple[float, float]:
            if abs(p) < 500:
                plain = tikhonov_fft(clean, KERNEL, 0.25)
                return off(np.ldexp(tikhonov_fft(clean, np.ldexp(KERNEL, p), math.ldexp(0.25, 2 * p)), p), plain), 0.0
            with mpmath.workdps(700):
                exact = [float(v) for v in regularised(np.ldexp(ring, p), clean[:6], 0.25)]
            return off(tikhonov_fft(clean[:6], np.ldexp(KERNEL, p), 0.25, mode="periodic"), exact), 1e-13

        yield Case("tikhonov_dense", "H x 2^k", f"k = {power}", both)
        yield Case("tikhonov_fft", "h x 2^k", f"k = {power}", ringing)
    for name, call in (
        ("tikhonov_dense", lambda: tikhonov_dense(0 * dense, clean, 0.5)),
        ("tikhonov_fft", lambda: tikhonov_fft(clean, 0 * KERNEL, 0.5)),
        ("tikhonov_lsmr", lambda: tikhonov_lsmr(Convolution(0 * KERNEL, (6,)), clean, 0.5)),
    ):
        yield Case(name, "kernel", "0", lambda c=call: (float(np.max(np.abs(c()))), 0.0))
    one: dict[str, Callable[[], Array]] = {
        "tikhonov_dense": lambda: tikhonov_dense([[2.0]], [3.0], 2.0),
        "tikhonov_fft": lambda: tikhonov_fft([3.0], [2.0], 2.0),
        "tikhonov_lsmr": lambda: tikhonov_lsmr(Convolution([2.0], (1,)), [3.0], 2.0),
    }
    for name, alone in one.items():
        yield Case(name, "samples", "1", lambda c=alone: (off(c(), [1.0]), 1e-9))
    for tolerance in (0.0, -1.0, math.nan, math.inf):
        yield Case("tikhonov_lsmr", "tolerance", f"{tolerance:g}", must_refuse(
            lambda t=tolerance: tikhonov_lsmr(Convolution(KERNEL, (6,)), clean, 0.1, tolerance=t)))  # fmt: skip
    for limit in (0, -1, 1.5, math.nan):
        yield Case("tikhonov_lsmr", "max_iterations", f"{limit:g}", must_refuse(
            lambda n=limit: tikhonov_lsmr(Convolution(KERNEL, (6,)), clean, 0.1, max_iterations=n)))  # fmt: skip
    for words, given in BAD:
        yield Case("tikhonov_dense", "matrix", words, must_refuse(lambda g=given: tikhonov_dense([g], clean, 1.0)))
        yield Case("tikhonov_fft", "kernel", words, must_refuse(lambda g=given: tikhonov_fft(clean, g, 1.0)))
    yield Case("tikhonov_fft", "kernel", "longer than the data", must_refuse(lambda: tikhonov_fft([1.0], KERNEL, 1.0)))
    yield Case("tikhonov_fft", "mode", "same", must_refuse(lambda: tikhonov_fft(clean, KERNEL, 1.0, mode="same")))  # type: ignore[arg-type]
    yield Case("tikhonov_dense", "f", "1e400", must_refuse(lambda: tikhonov_dense([[1e-200]], [1e200], 1e-320)))
    yield Case("tikhonov_fft", "f", "1e400", must_refuse(lambda: tikhonov_fft([1e200], [1e-200], 1e-320)))


def spectra(power: int = 0, kernel_power: int = 0) -> dict[str, Spectrum]:
    """A noisy blur's decompositions, of the data times 2^power and the kernel times 2^kernel_power."""
    kernel = np.ldexp(np.exp(-0.5 * (np.arange(-6, 7) / 2.0) ** 2), kernel_power)
    noise = 0.01 * np.random.default_rng(0).standard_normal(52)
    plain = np.exp(-0.5 * (np.arange(-6, 7) / 2.0) ** 2)
    data = np.ldexp(toeplitz_matrix(plain, 40) @ np.sin(np.arange(40) / 5) + noise, power)
    return {
        "matrix_spectrum": matrix_spectrum(toeplitz_matrix(kernel, 40), data),
        "convolution_spectrum": convolution_spectrum(data, kernel),
    }


def choice_cases() -> Iterator[Case]:
    """Norms by mpmath, the parameter where it has a closed form, and how each scales."""
    dense = toeplitz_matrix(KERNEL, 6)
    clean = dense @ SIGNAL + 0.01 * np.arange(8)
    for alpha in (1e-300, 1e-6, 1.0, 1e6, 1e300):
        for level in LEVELS:

            def norms(a: float = alpha, z: float = level) -> tuple[float, float]:
                spectrum = matrix_spectrum(dense, z * clean)
                with mpmath.workdps(700):
                    data = z * clean
                    f = regularised(dense, data, a)
                    missed = mpmath.matrix(data.tolist()) - mpmath.matrix(dense.tolist()) * f
                    exact = float(mpmath.norm(missed)), float(mpmath.norm(f))
                found = spectrum.residual_norm(a), spectrum.signal_norm(a)
                denormal = 1e-12 if z < 1e-308 or (z * min(1, 1 / a) < 1e-290) else 0.0
                if exact[1] < 1e-300:
                    return (0.0 if found[1] < 1e-290 else 1.0) + off(found[0], exact[0]), 1e-12
                return max(off(found[0], exact[0]), off(found[1], exact[1])), 1e-12 + denormal

            yield Case("Spectrum norms", "alpha, data", f"{alpha:g}, {level:g}", norms)
    for name in ("matrix_spectrum", "convolution_spectrum"):
        for power in (-1000, -900, 900, 1000):

            def unchanged(n: str = name, p: int = power) -> tuple[float, float]:
                one, other = spectra()[n], spectra(p)[n]
                pairs = (
                    (gcv_alpha(one), gcv_alpha(other)),
                    (l_curve_alpha(one), l_curve_alpha(other)),
                    (l_curve_curvature(one, 0.01), l_curve_curvature(other, 0.01)),
                    (discrepancy_alpha(one, 0.07), discrepancy_alpha(other, math.ldexp(0.07, p))),
                )
                return max(abs(b / a - 1) for a, b in pairs), 0.0 if p > -970 else 0.1

            yield Case(f"gcv_alpha, l_curve_alpha, discrepancy_alpha, {name}", "g x 2^k", f"k = {power}", unchanged)
        for power in (-500, -300, 300, 500):

            def squared(n: str = name, p: int = power) -> tuple[float, float]:
                one, other = spectra()[n], spectra(0, p)[n]
                pairs = (
                    (gcv_alpha(one), gcv_alpha(other)),
                    (l_curve_alpha(one), l_curve_alpha(other)),
                    (discrepancy_alpha(one, 0.07), discrepancy_alpha(other, 0.07)),
                )
                # A minimum is flat: its place is known to the root of eps.
                return max(abs(math.ldexp(b, -2 * p) / a - 1) for a, b in pairs), 1e-4

            yield Case(f"gcv_alpha, l_curve_alpha, discrepancy_alpha, {name}", "h x 2^k", f"k = {power}", squared)
    for level in LEVELS:

        def single(z: float = level) -> tuple[float, float]:
            # One sample and H = 1: the residual is |g| alpha / (1 + alpha).
            spectrum = matrix_spectrum([[1.0]], [z])
            return abs(discrepancy_alpha(spectrum, z / 4) * 3 - 1), 1e-9 + (1e-12 if z < 1e-308 else 0.0)

        yield Case("discrepancy_alpha", "data", f"{level:g}", single)
    spectrum = matrix_spectrum(dense, clean)
    for noise in (0.0, 1e-300, 1e300, -1.0, math.nan, math.inf):
        yield Case(
            "discrepancy_alpha", "noise", f"{noise:g}", must_refuse(lambda v=noise: discrepancy_alpha(spectrum, v))
        )
    for factor in (0.0, -1.0, math.nan, math.inf):
        yield Case("discrepancy_alpha", "factor", f"{factor:g}", must_refuse(
            lambda v=factor: discrepancy_alpha(spectrum, 0.1, factor=v)))  # fmt: skip
    for low, high in ((0.0, 1.0), (math.nan, 1.0), (1.0, math.inf), (1.0, 0.5)):
        yield Case("discrepancy_alpha", "low, high", f"{low:g}, {high:g}", must_refuse(
            lambda a=low, b=high: discrepancy_alpha(lambda x: x / (1 + x), 0.5, low=a, high=b)))  # fmt: skip
    yield Case("discrepancy_alpha", "function", "NaN", must_refuse(
        lambda: discrepancy_alpha(lambda _: math.nan, 0.5, low=0.1, high=1.0)))  # fmt: skip
    dark = matrix_spectrum(dense, 0 * clean)
    blind = matrix_spectrum(0 * dense, clean)
    for name, choose in (("gcv_alpha", gcv_alpha), ("l_curve_alpha", l_curve_alpha)):
        yield Case(name, "data", "0", must_refuse(lambda c=choose: c(dark)))
        yield Case(name, "kernel", "0", must_refuse(lambda c=choose: c(blind)))
        yield Case(name, "samples", "1", must_refuse(lambda c=choose: c(matrix_spectrum([[1.0]], [1.0]))))
    for alpha in (0.0, -1.0, math.nan, math.inf):
        for name, call in (
            ("gcv", gcv),
            ("l_curve_curvature", l_curve_curvature),
            ("Spectrum.residual_norm", Spectrum.residual_norm),
            ("Spectrum.signal_norm", Spectrum.signal_norm),
            ("Spectrum.freedom", Spectrum.freedom),
        ):
            yield Case(name, "alpha", f"{alpha:g}", must_refuse(lambda c=call, a=alpha: c(spectrum, a)))
