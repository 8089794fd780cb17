"""Blind deconvolution of one convolution and of scenes: against mpmath and the truth, in any unit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.convolution import HalfCircle, spherical_convolution
from wallmirror.deconvolution import (
    blind_richardson_lucy,
    corner_support,
    iterative_blind,
)
from wallmirror.deconvolution.blind_spherical import solve_spherical, spherical_designs
from wallmirror.deconvolution.far_field import solve_far_field

from .channels import POWERS
from .harness import Case, must_refuse, off
from .operators import BAD
from .richardson_lucy import lucy
from .scenes import lobes

Array = NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Every cell of one convolution and of scenes."""
    yield from single_cases()
    yield from scene_cases()


def single_cases() -> Iterator[Case]:
    """One convolution: Fish's alternation by mpmath, Davey's by its scaling."""
    f, h = np.array([0.1, 1.0, 0.2, 0.4]), np.array([0.5, 0.3, 0.2])
    g = np.convolve(f, h)
    starts = {"signal_start": np.ones(4), "kernel_start": np.array([0.5, 0.25, 0.25])}
    for background in (0.0, 1e-300, 0.01):

        def fish(b: float = background) -> tuple[float, float]:
            found = blind_richardson_lucy(g, **starts, iterations=3, inner=2, background=b)
            with mpmath.workdps(50):
                kernel = [mpmath.mpf(float(v)) for v in starts["kernel_start"]]
                light = mpmath.fsum(mpmath.mpf(float(v)) for v in g)
                signal = [light / 4] * 4
                for _ in range(3):
                    kernel = lucy(_matrix(signal, 3), g, kernel, 2, b)
                    kernel = [v / mpmath.fsum(kernel) for v in kernel]
                    signal = lucy(_matrix(kernel, 4), g, signal, 2, b)
            return max(
                off(found.signal, [float(v) for v in signal]), off(found.kernel, [float(v) for v in kernel])
            ), 1e-13

        yield Case("blind_richardson_lucy", "background", f"{background:g}", fish)
    for power in POWERS:

        def scaled(p: int = power) -> tuple[float, float]:
            one = blind_richardson_lucy(g, **starts, iterations=5)
            other = blind_richardson_lucy(
                np.ldexp(g, p), signal_start=np.full(4, math.ldexp(1.0, -p)), kernel_start=np.ldexp(starts["kernel_start"], p),
                iterations=5)  # fmt: skip
            apart = (
                off(np.ldexp(other.signal, -p), one.signal),
                off(other.kernel, one.kernel),
                off(other.residual, one.residual),
            )
            return max(apart), 0.0 if p > -970 else 0.1

        def davey(p: int = power) -> tuple[float, float]:
            # In units of the data alpha has their square; beyond float64 it is nothing, or all.
            options = {"signal_support": corner_support((6,), (4,)), "kernel_support": corner_support((6,), (3,))}
            one = iterative_blind(g, **options, alpha=1e-3, iterations=9)
            alpha = math.ldexp(1e-3, 2 * p) if abs(p) < 500 else 1e-3
            other = iterative_blind(np.ldexp(g, p), **options, alpha=alpha, iterations=9)
            if abs(p) >= 500:  # as small an alpha as the unit leaves, 1e-3 / 2^2p: an inverse filter
                small = iterative_blind(g, **options, alpha=max(math.ldexp(1e-3, -2 * p), 5e-324), iterations=9)
                return off(np.ldexp(other.signal, -p), small.signal), 1e-6
            return max(off(np.ldexp(other.signal, -p), one.signal), off(other.kernel, one.kernel)), 0.0

        yield Case("blind_richardson_lucy", "g x 2^k, starts in any unit", f"k = {power}", scaled)
        yield Case("iterative_blind", "g x 2^k", f"k = {power}", davey)
    for power in (-400, 400):
        yield Case("iterative_blind", "g x 2^k, alpha x 2^2k", f"k = {power}", lambda p=power: davey(p))
    for mode in ("full", "same", "periodic"):

        def alone(m: Any = mode) -> tuple[float, float]:
            return off(
                blind_richardson_lucy([6.0], signal_start=[1.0], kernel_start=[2.0], mode=m).signal, [6.0]
            ), 1e-13

        yield Case("blind_richardson_lucy", "one sample", mode, alone)
    supports = {"signal_support": corner_support((6,), (4,)), "kernel_support": corner_support((6,), (3,))}
    for words, given in (*BAD, ("all dark", np.zeros(6))):
        yield Case(
            "blind_richardson_lucy", "data", words, must_refuse(lambda d=given: blind_richardson_lucy(d, **starts))
        )
        yield Case(
            "iterative_blind", "data", words, must_refuse(lambda d=given: iterative_blind(d, **supports, alpha=1e-3))
        )
    for name in ("signal_start", "kernel_start"):
        for words, given in (*BAD, ("all dark", np.zeros(3)), ("negative", -np.ones(3))):
            yield Case("blind_richardson_lucy", name, words, must_refuse(
                lambda n=name, d=given: blind_richardson_lucy(g, **{**starts, n: d})))  # fmt: skip
    yield Case("blind_richardson_lucy", "data", "negative", must_refuse(lambda: blind_richardson_lucy(-g, **starts)))
    yield Case("blind_richardson_lucy", "kernel_start", "a delta", must_refuse(
        lambda: blind_richardson_lucy(g, signal_start=np.ones(4), kernel_start=[0.0, 1.0, 0.0])))  # fmt: skip
    options: tuple[dict[str, Any], ...] = (
        {"iterations": 0}, {"iterations": 1.5}, {"iterations": math.nan}, {"inner": 0}, {"background": -1.0},
        {"background": math.nan}, {"background": math.inf}, {"mode": "x"},
    )  # fmt: skip
    for option in options:
        yield Case("blind_richardson_lucy", *(str(part) for part in next(iter(option.items()))), must_refuse(
            lambda o=option: blind_richardson_lucy(g, **{**starts, **o})))  # fmt: skip
    options = (
        {"alpha": 0.0}, {"alpha": -1.0}, {"alpha": math.nan}, {"alpha": math.inf}, {"iterations": 0}, {"iterations": 1.5},
        {"nonnegativity": "x"}, {"signal_support": np.zeros(6, dtype=bool)}, {"signal_support": np.ones(6)},
        {"kernel_support": np.ones(5, dtype=bool)}, {"signal_start": np.zeros(6)}, {"signal_start": np.full(6, math.nan)},
        {"kernel_start": np.zeros(6)}, {"kernel_start": np.full(5, 1.0)}, {"alpha": 1e300},
    )  # fmt: skip
    for option in options:
        yield Case("iterative_blind", *(str(part) for part in next(iter(option.items()))), must_refuse(
            lambda o=option: iterative_blind(g, **{**supports, "alpha": 1e-3, **o})))  # fmt: skip
    for shape, extent in (((6,), (0,)), ((6,), (7,)), ((6,), (1, 1)), ((6,), (1.5,))):
        yield Case("corner_support", "shape, extent", f"{shape}, {extent}", must_refuse(
            lambda n=shape, k=extent: corner_support(n, k)))  # fmt: skip


def _matrix(factor: list[mpmath.mpf], other: int) -> Any:
    """The full convolution with a factor as a matrix, which `lucy` reads row by row; exact, of mpf."""
    rows = [[mpmath.mpf(0)] * other for _ in range(len(factor) + other - 1)]
    for j in range(other):
        for i, value in enumerate(factor):
            rows[i + j][j] = value
    return type("Rows", (), {"tolist": lambda _: rows})()


def far_captures(power: int = 0, weights: str = "thesis") -> tuple[wm.CaptureSet, Array]:
    """Films of a card of three elements ten kilometres away."""
    eye = wm.Observer(position=(0.0, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=600, pixels_at="edges")
    places = tuple(float(x) for x in 1e4 * np.tan(np.radians([-4.0, 0.0, 4.0])))
    strips = wm.Card(elements_x=places, y=-1e4)
    v = np.random.default_rng(0).random((3, 4))
    films = wm.radiance(wm.transport_matrix(eye, strips, lobes(3.0), weights=weights), v)  # type: ignore[arg-type]
    return wm.CaptureSet(observer=eye, card=strips, radiance=np.ldexp(films, power), transport=weights), v  # type: ignore[arg-type]


def near_captures(power: int = 0) -> tuple[wm.CaptureSet, Array]:
    """Films of a card of three elements one metre from the wall."""
    eye = wm.Observer(position=(0.0, -5.0), fov=math.radians(90), view_angles=(0.0,), pixels=300)
    strips = wm.Card(elements_x=(-3.0, 1.0, 2.0), y=-4.0)
    v = np.random.default_rng(0).random((3, 5))
    films = wm.radiance(wm.transport_matrix(eye, strips, lobes(2.0), weights="thesis"), v)
    return wm.CaptureSet(observer=eye, card=strips, radiance=np.ldexp(films, power), transport="thesis"), v


def scene_cases() -> Iterator[Case]:
    """The thesis's open doors: pattern and BRDF, whose product has the films' unit."""
    for weights in ("thesis", "cosine"):

        def far(w: str = weights) -> tuple[float, float]:
            captures, v = far_captures(weights=w)
            found = solve_far_field(captures)
            middle = slice(found.angles.size // 4, -(found.angles.size // 4))
            rho = lobes(3.0).of_sum(found.angles[middle])
            scale = float(np.linalg.norm(v))  # the pattern's norm is 1
            if w == "cosine":
                return wm.scale_free_error(found.source, v), 1e-3
            return max(wm.scale_free_error(found.source, v), off(found.brdf[middle], scale * rho)), 2e-2

        yield Case("solve_far_field", "weights", weights, far)
    for power in (-900, 900):

        def scaled(p: int = power) -> tuple[float, float]:
            one, other = solve_far_field(far_captures()[0]), solve_far_field(far_captures(p)[0])
            return max(off(other.source, one.source), off(np.ldexp(other.brdf, -p), one.brdf)), 0.0

        def spherical(p: int = power) -> tuple[float, float]:
            one, other = (solve_spherical(near_captures(q)[0], samples=300, order=5) for q in (0, p))
            product = off(
                np.ldexp(np.multiply.outer(other.source, other.brdf), -p), np.multiply.outer(one.source, one.brdf)
            )
            return max(product, wm.scale_free_error(other.source, near_captures()[1])), 1e-4

        yield Case("solve_far_field", "films x 2^k", f"k = {power}", scaled)
        yield Case("solve_spherical", "films x 2^k", f"k = {power}", spherical)
    captures, _ = far_captures()
    for words, changed in (
        ("dark", replace(captures, radiance=0 * captures.radiance)),
        ("one element", replace(captures, card=wm.Card(elements_x=(0.0,), y=-1e4))),
        ("coincident elements", replace(captures, card=wm.Card(elements_x=(0.0, 0.0, 0.0), y=-1e4))),
        ("one realisation", replace(captures, radiance=captures.radiance[:, :, :1])),
    ):
        yield Case("solve_far_field", "captures", words, must_refuse(lambda c=changed: solve_far_field(c)))
    near, _ = near_captures()
    for words, changed in (
        ("dark", replace(near, radiance=0 * near.radiance)),
        ("one realisation", replace(near, radiance=near.radiance[:, :, :1])),
    ):
        yield Case("solve_spherical", "captures", words, must_refuse(lambda c=changed: solve_spherical(c, samples=300)))
    for samples, order in ((1, 3), (2, 3), (300, 10), (300, -1), (300.5, 3)):
        yield Case("solve_spherical", "samples, order", f"{samples}, {order}", must_refuse(
            lambda n=samples, k=order: solve_spherical(near, samples=n, order=k)))  # fmt: skip

    def design(order: int) -> tuple[float, float]:
        grid = HalfCircle(samples=300, order=order)
        columns = spherical_designs(near.observer, near.card, grid)
        c = np.roll(grid.coefficients(lobes(10.0)), 300)
        render = spherical_convolution(near.observer, near.card, lobes(10.0), [1.0, 0.5, 2.0], samples=300, order=order)
        adjoint = [abs(float((t @ c) @ t.sum(axis=1)) - float(c @ (t.T @ t.sum(axis=1)))) for t in columns]
        return max(
            off(sum(v * (t @ c) for v, t in zip((1.0, 0.5, 2.0), columns, strict=True)), render.ravel()), *adjoint
        ), 1e-12

    for order in (0, 1, 5, 9):
        yield Case("spherical_designs", "order", str(order), lambda k=order: design(k))
