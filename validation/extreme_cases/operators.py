"""Convolution as a linear operator, against the definition in rational arithmetic."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import (
    Convolution,
    adjoint_mismatch,
    toeplitz_matrix,
)

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
    """Every cell of the operators."""
    yield from operator_cases()


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
