"""Deconvolution with a known kernel: operators in rational arithmetic, Tikhonov and Richardson-Lucy steps in mpmath.

What is linear or scales is asked to do so exactly under powers of two.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import (
    Convolution,
    adjoint_mismatch,
    align,
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
from wallmirror.deconvolution.spectrum import Spectrum

from .harness import EPS, Case, must_refuse, off

Array = NDArray[np.float64]

KERNEL = np.array([0.25, 1.0, 0.5])
SIGNAL = np.array([0.0, 1.0, 0.3, 0.0, 2.0, 0.7])
MODES = ("full", "same", "periodic")
LEVELS = (1e-310, 1e-300, 1e-150, 1.0, 1e150, 1e300)
#: What no function of real samples takes.
BAD: tuple[tuple[str, Any], ...] = (
    ("NaN", [1.0, math.nan, 1.0]), ("inf", [1.0, math.inf, 1.0]), ("complex", [1.0, 1j, 1.0]), ("text", ["a", "b", "c"]),
    ("none", []), ("a number", 1.0), ("uneven rows", [[1.0], [1.0, 2.0]]),
)  # fmt: skip


def cases() -> Iterator[Case]:
    """Every cell of deconvolution with a known kernel."""
    yield from operator_cases()
    yield from tikhonov_cases()
    yield from choice_cases()
    yield from richardson_lucy_cases()
    yield from align_cases()


def convolved(signal: Array, kernel: Array, mode: str, origin: int) -> list[Fraction]:
    """The three definitions of `operators`, in rational arithmetic."""
    f, h = ([Fraction(float(v)) for v in values] for values in (signal, kernel))
    n, k = len(f), len(h)
    if mode == "periodic":
        return [sum((f[(i + origin - m) % n] * h[m] for m in range(k)), Fraction(0)) for i in range(n)]
    full = [sum((f[i - m] * h[m] for m in range(k) if 0 <= i - m < n), Fraction(0)) for i in range(n + k - 1)]
    return full if mode == "full" else full[origin : origin + n]


def operator_cases() -> Iterator[Case]:
    """A convolution, its adjoint and its matrix."""
    for mode, origin in itertools.product(MODES, (0, 1, 2)):
        for one, two in ((0, 0), (1000, -1000), (-1000, 1000), (400, 400), (-500, -500)):

            def applied(m: Any = mode, o: int = origin, p: int = one, q: int = two) -> tuple[float, float]:
                blur = Convolution(np.ldexp(KERNEL, p), (6,), mode=m, origin=(o,))
                exact = [float(v) for v in convolved(SIGNAL, KERNEL, m, o)]
                return off(np.ldexp(blur.apply(np.ldexp(SIGNAL, q)), -p - q), exact), 16 * EPS

            yield Case("Convolution.apply", f"{mode}, origin, h x 2^k, f x 2^l", f"{origin}, {one}, {two}", applied)

        def turned(m: Any = mode, o: int = origin) -> tuple[float, float]:
            blur = Convolution(KERNEL, (6,), mode=m, origin=(o,))
            matrix = toeplitz_matrix(KERNEL, 6, mode=m, origin=o)
            columns = np.stack([np.array([float(v) for v in convolved(e, KERNEL, m, o)]) for e in np.eye(6)], axis=1)
            g = np.arange(1.0, matrix.shape[0] + 1)
            return max(off(matrix, columns), off(blur.adjoint(g), columns.T @ g)), 16 * EPS

        yield Case("toeplitz_matrix, Convolution.adjoint", f"{mode}, origin", str(origin), turned)
    for mode in MODES:
        for shape, kernel in (((1,), (1,)), ((1000,), (7,)), ((7,), (7,)), ((12, 5), (3, 4)), ((2, 3, 4), (1, 3, 2))):

            def adjoint(m: Any = mode, n: tuple[int, ...] = shape, k: tuple[int, ...] = kernel) -> tuple[float, float]:
                h = np.random.default_rng(1).standard_normal(k)
                blur = Convolution(h, n, mode=m)
                other = blur.exchanged(np.random.default_rng(2).standard_normal(n))
                return max(adjoint_mismatch(blur), adjoint_mismatch(other)), 64 * EPS

            yield Case("adjoint_mismatch", f"{mode}, signal, kernel", f"{shape}, {kernel}", adjoint)
        for level in LEVELS:
            denormal = 1e-12 if level < 1e-308 else 0.0
            yield Case("adjoint_mismatch", f"{mode}, kernel", f"{level:g}", lambda m=mode, z=level, d=denormal: (
                adjoint_mismatch(Convolution(z * KERNEL, (50,), mode=m)), 64 * EPS + d))  # fmt: skip
        yield Case("adjoint_mismatch", f"{mode}, kernel", "0", lambda m=mode: (
            adjoint_mismatch(Convolution(0 * KERNEL, (50,), mode=m)), 0.0))  # fmt: skip

        def exchanged(m: Any = mode) -> tuple[float, float]:
            blur = Convolution(KERNEL, (6,), mode=m)
            return off(blur.exchanged(SIGNAL).apply(KERNEL), blur.apply(SIGNAL)), 16 * EPS

        yield Case("Convolution.exchanged", mode, "the same data", exchanged)
    blur = Convolution(KERNEL, (6,))
    for words, given in BAD:
        yield Case("Convolution", "kernel", words, must_refuse(lambda g=given: Convolution(g, (6,))))
        yield Case("Convolution.apply", "signal", words, must_refuse(lambda g=given: blur.apply(g)))
        yield Case("Convolution.adjoint", "data", words, must_refuse(lambda g=given: blur.adjoint(g)))
        yield Case("Convolution.exchanged", "signal", words, must_refuse(lambda g=given: blur.exchanged(g)))
        yield Case("toeplitz_matrix", "kernel", words, must_refuse(lambda g=given: toeplitz_matrix(g, 6)))
    yield Case("Convolution.apply", "h, f", "1e300, 1e300", must_refuse(
        lambda: Convolution(1e300 * KERNEL, (6,)).apply(1e300 * SIGNAL)))  # fmt: skip
    yield Case("Convolution.adjoint", "h, g", "1e300, 1e300", must_refuse(
        lambda: Convolution(1e300 * KERNEL, (6,)).adjoint(np.full(8, 1e300))))  # fmt: skip
    options: tuple[dict[str, Any], ...] = (
        {"signal_shape": (0,)}, {"signal_shape": (6, 6)}, {"signal_shape": (1.5,)}, {"signal_shape": (math.nan,)},
        {"signal_shape": (10**15,)}, {"mode": "x"}, {"origin": (3,)}, {"origin": (-1,)}, {"origin": (0, 0)},
        {"origin": (0.5,)}, {"mode": "periodic", "signal_shape": (2,)},
    )  # fmt: skip
    for option in options:
        yield Case("Convolution", ", ".join(option), ", ".join(map(str, option.values())), must_refuse(
            lambda o=option: Convolution(KERNEL, **{"signal_shape": (6,), **o})))  # fmt: skip
    for samples in (0, -1, 1.5, math.nan, 10**9):
        yield Case("toeplitz_matrix", "samples", f"{samples:g}", must_refuse(
            lambda n=samples: toeplitz_matrix(KERNEL, n)))  # fmt: skip
    for kind in (np.float32, np.float16, np.int8, np.bool_):
        yield Case("Convolution.apply", "types", kind.__name__, lambda k=kind: (
            off(Convolution(np.array([1, 0, 1], dtype=k), (3,)).apply(np.array([1, 1, 0], dtype=k)), [1, 1, 1, 1, 0]),
            16 * EPS))  # fmt: skip


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


def lucy(matrix: Array, data: Array, start: list[float], steps: int, background: float = 0.0) -> list[mpmath.mpf]:
    """Steps of f / (H^T 1) H^T (g / (H f + b))."""
    h = [[mpmath.mpf(v) for v in row] for row in matrix.tolist()]
    g, f = [mpmath.mpf(float(v)) for v in data], [mpmath.mpf(v) for v in start]
    rows, columns = range(len(h)), range(len(h[0]))
    for _ in range(steps):
        p = [mpmath.fsum(h[i][j] * f[j] for j in columns) + mpmath.mpf(background) for i in rows]
        reached = [mpmath.fsum(h[i][j] for i in rows) for j in columns]
        ratio = [g[i] / p[i] if p[i] else mpmath.mpf(0) for i in rows]
        f = [f[j] / reached[j] * mpmath.fsum(h[i][j] * ratio[i] for i in rows) for j in columns]
    return f


def richardson_lucy_cases() -> Iterator[Case]:
    """Six steps by mpmath; exact scaling of data and kernel; the dark, the single sample and the identity."""
    dense = toeplitz_matrix(KERNEL, 6)
    data = dense @ SIGNAL + 0.01
    constant = float(data.sum()) / float(dense.sum())
    for background in (0.0, 1e-300, 0.005, 1e3):

        def steps(b: float = background) -> tuple[float, float]:
            level = max(float(np.sum(data - b)), 0.0) / float(dense.sum()) if b else constant
            with mpmath.workdps(60):
                exact = [float(v) for v in lucy(dense, data, [level] * 6, 6, b)]
            return off(
                richardson_lucy(Convolution(KERNEL, (6,)), data, iterations=6, background=b).signal, exact
            ), 1e-13

        yield Case("richardson_lucy", "background", f"{background:g}", steps)
    for acceleration in ("none", "biggs-andrews"):
        for power in (-1000, -900, 900, 1010):

            def scaled(p: int = power, how: Any = acceleration) -> tuple[float, float]:
                blur = Convolution(KERNEL, (6,))
                one = richardson_lucy(blur, data, acceleration=how, iterations=9, background=0.25, noise=1e-9)
                other = richardson_lucy(
                    blur, np.ldexp(data, p), acceleration=how, iterations=9, background=math.ldexp(0.25, p),
                    noise=math.ldexp(1e-9, p))  # fmt: skip
                apart = off(np.ldexp(other.signal, -p), one.signal), off(np.ldexp(other.misfit, -p), one.misfit), off(
                    other.change, one.change)  # fmt: skip
                return max(apart), 0.0 if p > -970 else 0.1

            def of_kernel(p: int = power, how: Any = acceleration) -> tuple[float, float]:
                one = richardson_lucy(Convolution(KERNEL, (6,)), data, acceleration=how, iterations=9)
                other = richardson_lucy(Convolution(np.ldexp(KERNEL, p), (6,)), data, acceleration=how, iterations=9)
                return off(np.ldexp(other.signal, p), one.signal), 0.0 if p > -970 else 1e-9

            yield Case(f"richardson_lucy, {acceleration}", "g x 2^k", f"k = {power}", scaled)
            yield Case(f"richardson_lucy, {acceleration}", "h x 2^k", f"k = {power}", of_kernel)
    yield Case("richardson_lucy", "h, g", "1e-300, 1e300", must_refuse(
        lambda: richardson_lucy(Convolution(1e-300 * KERNEL, (6,)), 1e300 * data)))  # fmt: skip
    for level in LEVELS:
        denormal = 1e-12 if level < 1e-308 else 0.0
        yield Case("richardson_lucy", "one sample", f"{level:g}", lambda z=level, d=denormal: (
            off(richardson_lucy(Convolution([2.0], (1,)), [z]).signal, [z / 2]), 16 * EPS + d))  # fmt: skip
        yield Case("richardson_lucy", "kernel 1, data", f"{level:g}", lambda z=level, d=denormal: (
            off(richardson_lucy(Convolution([1.0], (6,)), z * SIGNAL).signal, z * SIGNAL), 64 * EPS + d))  # fmt: skip
        yield Case("richardson_lucy", "start", f"{level:g}", lambda z=level: (
            off(richardson_lucy(Convolution(KERNEL, (6,)), data, start=np.full(6, z), iterations=6).signal,
                richardson_lucy(Convolution(KERNEL, (6,)), data, iterations=6).signal),
            1e-12 if z > 1e-308 else 1e-9))  # fmt: skip
    for noise in ("unknown", "poisson"):
        yield Case("richardson_lucy", f"data, noise {noise}", "0", lambda n=noise: (
            float(np.max(np.abs(richardson_lucy(Convolution(KERNEL, (6,)), 0 * data, noise=n).signal))), 0.0))  # fmt: skip

    def counts() -> tuple[float, float]:
        found = richardson_lucy(Convolution(KERNEL, (6,)), data, noise="poisson", iterations=1)
        prediction = dense @ np.full(6, constant)
        exact = 2 * math.fsum(g * math.log(g / p) - g + p for g, p in zip(data, prediction, strict=True))
        # Eight counts of about one, whose deviance starts below eight: nothing is left to fit.
        return (0.0 if exact <= 8 and found.stopped_by == "discrepancy" and found.iterations == 0 else 1.0), 0.5

    yield Case("richardson_lucy", "noise", "poisson, fitted at the start", counts)
    for level in (1e-300, 1e300):

        def deviance(z: float = level) -> tuple[float, float]:
            # Counts so many are never fitted; counts so few are fitted by anything.
            found = richardson_lucy(Convolution(KERNEL, (6,)), z * data, noise="poisson", iterations=5)
            expected = ("iterations", 5) if z > 1 else ("discrepancy", 0)
            plain = richardson_lucy(Convolution(KERNEL, (6,)), data, iterations=5).signal
            if (found.stopped_by, found.iterations) != expected or not np.all(np.isfinite(found.misfit)):
                return 1.0, 0.5
            return (off(found.signal / z, plain) if z > 1 else 0.0), 1e-12

        yield Case("richardson_lucy", "noise poisson, counts", f"{level:g}", deviance)
    settings: tuple[dict[str, Any], ...] = (
        {"iterations": 0}, {"iterations": 1.5}, {"iterations": math.nan}, {"background": -1.0}, {"background": math.nan},
        {"background": math.inf}, {"noise": 0.0}, {"noise": -1.0}, {"noise": math.nan}, {"noise": math.inf}, {"noise": "x"},
        {"acceleration": "x"}, {"relative_change": math.nan}, {"relative_change": -1.0}, {"start": np.zeros(6)},
        {"start": -np.ones(6)}, {"start": np.full(6, math.nan)}, {"start": np.ones(5)},
    )  # fmt: skip
    for option in settings:
        yield Case("richardson_lucy", *(str(part) for part in next(iter(option.items()))), must_refuse(
            lambda o=option: richardson_lucy(Convolution(KERNEL, (6,)), data, **o)))  # fmt: skip
    for words, given in (*BAD, ("negative", [-1.0] * 8), ("of nine", np.ones(9))):
        yield Case("richardson_lucy", "data", words, must_refuse(
            lambda g=given: richardson_lucy(Convolution(KERNEL, (6,)), g)))  # fmt: skip
    for words, kernel in (("0", 0 * KERNEL), ("negative", -KERNEL), ("partly negative", KERNEL - 0.3)):
        yield Case("richardson_lucy", "kernel", words, must_refuse(
            lambda k=kernel: richardson_lucy(Convolution(k, (6,)), data)))  # fmt: skip
    for words, matrix in (("NaN", dense * math.nan), ("0", 0 * dense), ("negative", -dense)):
        yield Case("richardson_lucy", "matrix", words, must_refuse(lambda m=matrix: richardson_lucy(m, data)))
    for kind in (np.float32, np.float16):
        yield Case("richardson_lucy", "type", kind.__name__, lambda k=kind: (
            off(richardson_lucy(Convolution(KERNEL.astype(k), (6,)), data.astype(k)).signal,
                richardson_lucy(Convolution(KERNEL, (6,)), data.astype(k).astype(np.float64)).signal), 0.0))  # fmt: skip


def align_cases() -> Iterator[Case]:
    """A scaled and shifted copy has no error; one that misses a tenth of the truth has a tenth."""
    truth, moved = np.array([0.0, 3.0, 4.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 3.0, 4.0])
    for one, two in itertools.product((-1060, -900, 0, 900, 1000), repeat=2):
        if abs(one - two) > 1020:
            continue

        def copy(p: int = one, q: int = two) -> tuple[float, float]:
            found = align(np.ldexp(moved, p), np.ldexp(truth, q))
            if found.shift != (-2,):
                return 1.0, 0.5
            return max(found.error, abs(math.ldexp(found.scale, p - q) - 1)), 16 * EPS

        yield Case("align", "estimate x 2^k, truth x 2^l", f"{one}, {two}", copy)
    yield Case("align", "estimate", "half of the truth's light", lambda: (
        abs(align([0.0, 3.0, 0.0], [0.0, 3.0, 4.0]).error - 0.6), 16 * EPS))  # fmt: skip
    yield Case("align", "estimate", "0", lambda: (abs(align([0.0, 0.0], [1.0, 2.0]).error - 1), 0.0))
    yield Case("align", "truth", "0", must_refuse(lambda: align([1.0], [0.0])))
    yield Case("align", "scale", "beyond float64", must_refuse(lambda: align([1e-300], [1e300])))
    for words, given in BAD:
        yield Case("align", "estimate", words, must_refuse(lambda g=given: align(g, [1.0, 2.0])))
        yield Case("align", "truth", words, must_refuse(lambda g=given: align([1.0, 2.0], g)))
