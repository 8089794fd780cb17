"""Richardson-Lucy steps against mpmath, and errors up to scale and shift."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import (
    Convolution,
    align,
    richardson_lucy,
    toeplitz_matrix,
)

from .harness import EPS, Case, must_refuse, off
from .operators import BAD, KERNEL, LEVELS, SIGNAL

Array = NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Every cell of Richardson-Lucy."""
    yield from richardson_lucy_cases()
    yield from align_cases()


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
