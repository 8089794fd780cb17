"""The parts of rendering by convolution: splines of polynomials, angles by mpmath, adjoints of the half circle."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.convolution import (
    HalfCircle,
    best_angle_sum,
    convolution_errors,
    convolution_variable,
    convolve_centred,
    cosine_factor,
    mirror_directions,
    relative_error,
    resample,
)

from .convolutions import FLAT, POINTS, WIDE
from .harness import DIGITS, EPS, Case, must_refuse, off
from .scenes import lobes

Array = NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Every cell of the parts of rendering by convolution."""
    yield from sample_cases()
    yield from angle_cases()
    yield from half_circle_cases()
    yield from hypothesis_cases()


def sample_cases() -> Iterator[Case]:
    """Sums of products in rational arithmetic, and splines of polynomials, which they reproduce."""
    f, h = np.random.default_rng(0).standard_normal(9), np.random.default_rng(1).standard_normal(15)
    exact = [float(sum(Fraction(float(f[m])) * Fraction(float(h[7 + n - m])) for m in range(9) if 0 <= 7 + n - m < 15))
             for n in range(9)]  # fmt: skip
    for one, two in ((0, 0), (-1000, 0), (0, 1000), (1000, -1000), (-500, -500), (500, 500)):
        yield Case("convolve_centred", "signal x 2^k, kernel x 2^l", f"{one}, {two}", lambda p=one, q=two: (
            off(np.ldexp(convolve_centred(np.ldexp(f, p), np.ldexp(h, q)), -p - q), exact), 32 * EPS))  # fmt: skip

    def long(scale: float) -> tuple[float, float]:
        signal, kernel = np.zeros(5000), np.ones(3001)
        signal[2000] = scale
        found = convolve_centred(signal, kernel)
        wanted = np.zeros(5000)
        wanted[500:3501] = scale
        return off(found, wanted), 64 * EPS

    for scale in (1e-300, 1.0, 1e300):
        yield Case("convolve_centred", "long, intensity", f"{scale:g}", lambda s=scale: long(s))
    given: tuple[tuple[str, Any, Any], ...] = (
        ("none, [1]", [], [1.0]), ("[1], none", [1.0], []), ("[1], even", [1.0], [1.0, 1.0]), ("NaN", [math.nan], [1.0]),
        ("kernel NaN", [1.0], [math.nan]), ("inf", [math.inf], [1.0]), ("1e300, 1e300", [1e300], [1e300]),
    )  # fmt: skip
    for words, signal, kernel in given:
        yield Case("convolve_centred", "signal, kernel", words, must_refuse(
            lambda s=signal, k=kernel: convolve_centred(s, k)))  # fmt: skip
    yield Case("convolve_centred", "samples", "1", lambda: (off(convolve_centred([3.0], [2.0]), [6.0]), 0.0))
    for order in (0, 1, 3, 5):
        for level in (1e-310, 1e-300, 1.0, 1e300):

            def polynomial(k: int = order, z: float = level) -> tuple[float, float]:
                at = np.linspace(1.0, -1.0, 33)
                onto = np.linspace(-0.9, 0.9, 7) if k else at[[3, 20]]
                power = np.polynomial.Polynomial([0.5, 1.0, -0.25, 0.5, 0.1, 0.2][: k + 1])
                found = resample(z * power(at), at, onto, order=k)
                return off(found, z * power(onto)), 256 * EPS + (1e-12 if z < 1e-308 else 0.0)

            yield Case("resample", "order, intensity", f"{order}, {level:g}", polynomial)
    for pixels in (1, 2, 3):
        at = np.linspace(0.0, 1.0, pixels)
        yield Case(
            "resample",
            "pixels",
            str(pixels),
            lambda a=at: (off(resample(2 + 0 * a, a, a, order=5), 2 + 0 * a), 8 * EPS),
        )
    clean, angles = np.ones(5), np.linspace(0, 1, 5)
    asked: tuple[tuple[str, Any, Any, Any, int], ...] = (
        ("none", [], [], [], 3), ("NaN", clean * math.nan, angles, angles, 3), ("at NaN", clean, angles * math.nan, angles, 3),
        ("onto NaN", clean, angles, angles * math.nan, 3), ("equal angles", clean, 0 * angles, [0.0], 3),
        ("beyond", clean, angles, [1.1], 3), ("order 2", clean, angles, angles, 2), ("order -1", clean, angles, angles, -1),
        ("order 101", np.ones(300), np.linspace(0, 1, 300), [0.5], 101), ("back and forth", clean, [0, 1, 0.5, 2, 3], [1.0], 1),
    )  # fmt: skip
    for words, render, at, onto, order in asked:
        yield Case("resample", "render, angles", words, must_refuse(
            lambda r=render, a=at, o=onto, k=order: resample(r, a, o, order=k)))  # fmt: skip


def angle_cases() -> Iterator[Case]:
    """theta_o + theta_c and the mirror's directions by mpmath."""
    for metres in (1e-100, 1e-6, 1.0, 1e8, 1e100):

        def variable(m: float = metres) -> tuple[float, float]:
            eye = wm.Observer(position=(0.25 * m, -5 * m), fov=1.0, view_angles=(1.0, 0.0), pixels=5)
            strips = wm.Card(elements_x=(-m, 0.2 * m), y=-2 * m)
            x = wm.wall_points(eye)
            with mpmath.workdps(DIGITS):
                middle = (mpmath.mpf(-m) + mpmath.mpf(0.2 * m)) / 2
                theta_c = [mpmath.atan2(middle - mpmath.mpf(float(w)), 2 * m) for w in x.ravel()]
                w = [float(c + mpmath.atan2(mpmath.mpf(0.25 * m) - mpmath.mpf(float(p)), 5 * m))
                     for c, p in zip(theta_c, x.ravel(), strict=True)]  # fmt: skip
                image = (middle * 5 * m + mpmath.mpf(0.25 * m) * 2 * m) / (7 * mpmath.mpf(m))
                towards = mpmath.atan2(middle - image, 2 * m)
                places = [float(towards - mpmath.atan2(mpmath.mpf(p) - image, 2 * m)) for p in strips.elements_x]
                q = [float(mpmath.cos(c)) for c in theta_c]
            apart = (
                off(convolution_variable(eye, strips).ravel(), w),
                off(mirror_directions(eye, strips), places),
                off(cosine_factor(eye, strips).ravel(), q),
            )
            return max(apart), 16 * EPS

        yield Case("convolution_variable, mirror_directions, cosine_factor", "whole scene", f"x {metres:g}", variable)
    for bad in (math.nan, math.inf):
        yield Case("mirror_directions", "reference_x", f"{bad}", must_refuse(
            lambda v=bad: mirror_directions(FLAT, POINTS, reference_x=v)))  # fmt: skip
    for name, call in (
        ("convolution_variable", lambda: convolution_variable(FLAT, POINTS, variable="x")),  # type: ignore[arg-type]
        ("cosine_factor", lambda: cosine_factor(FLAT, POINTS, weights="x")),  # type: ignore[arg-type]
    ):
        yield Case(name, "choice", "x", must_refuse(call))


def half_circle_cases() -> Iterator[Case]:
    """A grid: what is spread sums to its strength, reading is the adjoint of spreading, and each at any angle."""
    rng = np.random.default_rng(4)
    for samples, order in ((2, 0), (2, 9), (1000, 3), (100_000, 5)):

        def adjoint(n: int = samples, p: int = order) -> tuple[float, float]:
            grid = HalfCircle(samples=n, order=p)
            angles = np.array([0.0, 1e-300, -1e-12, 0.7, -1.3, math.pi / 2, -math.pi / 2])
            strengths, map_ = rng.standard_normal(7), rng.standard_normal(2 * n)
            spread = grid.spread(angles, strengths)
            one, two = float(spread @ map_), float(strengths @ grid.read(map_, angles))
            scale = float(np.abs(strengths).sum() * np.abs(map_).max())
            return max(abs(one - two), abs(float(spread.sum() - strengths.sum()))) / scale, 16 * EPS

        yield Case("HalfCircle", "samples, order: adjoint", f"{samples}, {order}", adjoint)
    fields: tuple[dict[str, Any], ...] = (
        {"samples": 0}, {"samples": 1}, {"samples": 2.5}, {"samples": math.nan}, {"samples": 10**13},
        {"samples": 10, "order": 10},
        {"samples": 10, "order": -1}, {"samples": 10, "order": 1.5},
    )  # fmt: skip
    for given in fields:
        yield Case("HalfCircle", ", ".join(given), ", ".join(map(str, given.values())), must_refuse(
            lambda g=given: HalfCircle(**g)))  # fmt: skip
    grid = HalfCircle(samples=100)
    for bad in (math.nan, math.inf):
        yield Case("HalfCircle.weights", "angle", f"{bad}", must_refuse(lambda v=bad: grid.weights([v])))
        yield Case("HalfCircle.spread", "strength", f"{bad}", must_refuse(lambda v=bad: grid.spread([0.0], [v])))
        yield Case("HalfCircle.outgoing", "map", f"{bad}", must_refuse(
            lambda v=bad: grid.outgoing(np.full(200, v), WIDE)))  # fmt: skip
        yield Case(
            "HalfCircle.read", "coefficients", f"{bad}", must_refuse(lambda v=bad: grid.read(np.full(200, v), [0.0]))
        )
    for shape in ((199,), (3, 200)):
        yield Case("HalfCircle.read", "coefficients' shape", str(shape), must_refuse(
            lambda s=shape: grid.read(np.zeros(s), [0.0])))  # fmt: skip


def hypothesis_cases() -> Iterator[Case]:
    """Errors relative to a reference, and the nearest function of the angle sum."""
    one, two = np.array([1.0, 2.0, 2.0]), np.array([1.0, 2.0, 2.3])
    for power in (-1060, -900, 900, 1000):
        yield Case("relative_error", "both x 2^k", f"k = {power}", lambda p=power: (
            abs(relative_error(np.ldexp(two, p), np.ldexp(one, p)) - 0.1), 1e-15 if p > -1000 else 0.1))  # fmt: skip
    yield Case(
        "relative_error", "render, reference", "1e300, 1e-10", must_refuse(lambda: relative_error([1e300], [1e-10]))
    )
    given: tuple[tuple[str, Any, Any], ...] = (
        ("NaN", [math.nan], [1.0]), ("reference NaN", [1.0], [math.nan]), ("inf", [math.inf], [1.0]), ("dark", [1.0], [0.0]),
        ("of other shapes", [1.0, 1.0], [1.0]), ("none", [], []),
    )  # fmt: skip
    for words, render, reference in given:
        yield Case("relative_error", "render, reference", words, must_refuse(
            lambda a=render, b=reference: relative_error(a, b)))  # fmt: skip
    for power in (-900, 900):

        def errors(p: int = power) -> tuple[float, float]:
            plain = convolution_errors(FLAT, POINTS, WIDE, np.array([0.3, 1.0, 0.5]), samples=200)
            scaled = convolution_errors(FLAT, POINTS, WIDE, np.ldexp([0.3, 1.0, 0.5], p), samples=200)
            return max(abs(plain[name] - scaled[name]) for name in plain), 0.0

        yield Case("convolution_errors", "V x 2^k", f"k = {power}", errors)
    for scale in (1e-310, 1e-300, 1.0, 1e300):
        for factor in (False, True):

            def nearest(s: float = scale, f: bool = factor) -> tuple[float, float]:
                brdf = wm.GaussianTrain(centres=(0.1,), sigma=0.3, scale=s)
                found = best_angle_sum(brdf, samples=81, outgoing_factor=f)
                theta = np.linspace(-1.2, 1.2, 7)
                wanted = s * np.exp(-0.5 * ((theta - 0.1) / 0.3) ** 2)
                # Linear between nodes 2 deg apart: (h / sigma)^2 / 8.
                missed = off(found.of_angles(theta / 2, theta / 2), wanted)
                return max(missed, found.residual), (math.radians(2) / 0.3) ** 2 / 8 + 1e-12

            yield Case("best_angle_sum", "scale, outgoing factor", f"{scale:g}, {factor}", nearest)
    options: tuple[dict[str, Any], ...] = (
        {"limit": 0.0}, {"limit": math.pi / 2}, {"limit": math.nan}, {"samples": 1}, {"samples": 2.5}, {"samples": 10**9},
        {"weights": "x"},
    )  # fmt: skip
    for option in options:
        yield Case("best_angle_sum", *(str(part) for part in next(iter(option.items()))), must_refuse(
            lambda o=option: best_angle_sum(lobes(), **o)))  # fmt: skip
    yield Case("best_angle_sum", "scale", "0", must_refuse(
        lambda: best_angle_sum(wm.GaussianTrain(centres=(0.0,), sigma=0.3, scale=0.0))))  # fmt: skip
