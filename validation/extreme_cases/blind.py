"""Blind deconvolution: against the truth that made the data, against mpmath, and in any unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.convolution import HalfCircle, spherical_convolution
from wallmirror.deconvolution import (
    aligned_error,
    blind_richardson_lucy,
    convolve_channels,
    corner_support,
    focused_blind,
    identify_channels,
    iterative_blind,
    least_squares_blind,
    rival_channels,
)
from wallmirror.deconvolution.blind_spherical import solve_spherical, spherical_designs
from wallmirror.deconvolution.far_field import solve_far_field
from wallmirror.deconvolution.interferometric_fit import fit_interferometric
from wallmirror.deconvolution.interferometry import cross_correlations, identity_error
from wallmirror.deconvolution.phase_retrieval import retrieve_channels

from .deconvolution import BAD, lucy
from .harness import EPS, Case, must_refuse, off
from .scenes import lobes

Array = NDArray[np.float64]

_RNG = np.random.default_rng(0)
SOURCE, CHANNELS = _RNG.standard_normal(60), _RNG.standard_normal((4, 4)) * [2.0, 1.0, 0.5, 0.25]
OUTPUTS = np.array([np.convolve(SOURCE, h) for h in CHANNELS])
POWERS = (-1000, -900, 900, 1000)
#: What no function of several channels takes.
BAD_CHANNELS: tuple[tuple[str, Any], ...] = (
    ("NaN", np.full((4, 63), math.nan)), ("inf", np.full((4, 63), math.inf)), ("complex", 1j * OUTPUTS),
    ("of one axis", SOURCE),
    ("none", np.zeros((4, 0))), ("uneven rows", [[1.0], [1.0, 2.0]]),
)  # fmt: skip


def cases() -> Iterator[Case]:
    """Every cell of blind deconvolution."""
    yield from single_cases()
    yield from channel_cases()
    yield from correlation_cases()
    yield from multichannel_cases()
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


def channel_cases() -> Iterator[Case]:
    """Outputs in rational arithmetic, and errors up to a scale."""
    exact = [[float(sum((Fraction(float(SOURCE[n - t])) * Fraction(float(h[t])) for t in range(4) if 0 <= n - t < 60),
                        Fraction(0))) for n in range(63)] for h in CHANNELS]  # fmt: skip
    for one, two in ((0, 0), (1000, -1000), (-1000, 1000), (400, 400), (-500, -500)):
        yield Case("convolve_channels", "f x 2^k, h x 2^l", f"{one}, {two}", lambda p=one, q=two: (
            off(np.ldexp(convolve_channels(np.ldexp(SOURCE, p), np.ldexp(CHANNELS, q)), -p - q), exact), 16 * EPS))  # fmt: skip

    def long() -> tuple[float, float]:
        f = np.zeros(5000)
        f[17] = 1e300
        h = np.ones((2, 2000))
        wanted = np.zeros((2, 6999))
        wanted[:, 17:2017] = 1e300
        return off(convolve_channels(f, h), wanted), 64 * EPS

    yield Case("convolve_channels", "long, intensity", "1e300", long)
    yield Case("convolve_channels", "f, h", "1e300, 1e300", must_refuse(lambda: convolve_channels([1e300], [[1e300]])))
    for words, given in BAD:
        yield Case("convolve_channels", "source", words, must_refuse(lambda g=given: convolve_channels(g, CHANNELS)))
    for words, given in BAD_CHANNELS:
        yield Case("convolve_channels", "channels", words, must_refuse(lambda g=given: convolve_channels(SOURCE, g)))
    truth = np.array([0.0, 3.0, 4.0, 0.0])
    for one in (-1000, -900, 0, 900, 1000):
        for two in (-1000, -900, 0, 900, 1000):

            def aligned(p: int = one, q: int = two) -> tuple[float, float]:
                copied = aligned_error(np.ldexp([0.0, 0.0, 3.0, 4.0], p), np.ldexp(truth, q), shifts=1)
                half = aligned_error(np.ldexp([0.0, 3.0, 0.0, 0.0], p), np.ldexp(truth, q))
                return max(copied, abs(half - 0.8)), 8 * EPS

            yield Case("aligned_error", "estimate x 2^k, truth x 2^l", f"{one}, {two}", aligned)
    yield Case("aligned_error", "estimate", "0", lambda: (abs(aligned_error([0.0, 0.0], [1.0, 2.0]) - 1), 0.0))
    asked: tuple[tuple[str, Any, Any, Any], ...] = (
        ("truth 0", [1.0], [0.0], 0), ("NaN", [math.nan], [1.0], 0), ("truth NaN", [1.0], [math.nan], 0),
        ("inf", [math.inf], [1.0], 0), ("other shapes", [1.0, 2.0], [1.0], 0), ("shifts -1", [1.0], [1.0], -1),
        ("shifts 1.5", [1.0], [1.0], 1.5), ("none", [], [], 0), ("shifts 5", [1.0, 2.0], [1.0, 2.0], 5),
    )  # fmt: skip
    for words, estimate, true, shifts in asked:
        yield Case("aligned_error", "estimate, truth", words, must_refuse(
            lambda e=estimate, t=true, s=shifts: aligned_error(e, t, shifts=s)))  # fmt: skip


def correlation_cases() -> Iterator[Case]:
    """h_ij = sum h_i(s + t) h_j(s) in rational arithmetic; the identity; and channels back from their correlations."""
    h = np.array([[1.0, 0.2, 0.0], [0.0, 0.7, -0.4], [0.1, 0.0, 0.8]])
    exact = np.array([[float(sum((Fraction(float(h[i, s + t])) * Fraction(float(h[j, s])) for s in range(3) if 0 <= s + t < 3),
                                 Fraction(0))) for t in range(-2, 3)] for i in range(3) for j in range(i, 3)])  # fmt: skip
    for power in (-530, -400, 0, 400, 510):

        def correlated(p: int = power) -> tuple[float, float]:
            # Of 2^-1060 some ten bits are left.
            return off(np.ldexp(cross_correlations(np.ldexp(h, p)), -2 * p), exact), 16 * EPS if p > -480 else 1e-3

        def retrieved(p: int = power) -> tuple[float, float]:
            found = retrieve_channels(np.ldexp(exact, 2 * p), 3)
            plain = retrieve_channels(exact, 3)
            if p > -480:
                return max(off(np.ldexp(found.channels, -p), plain.channels), abs(found.misfit - plain.misfit)), 0.0
            return aligned_error(found.channels, h), 0.1

        yield Case("cross_correlations", "h x 2^k", f"k = {power}", correlated)
        yield Case("retrieve_channels", "h_ij x 2^2k", f"k = {power}", retrieved)
    yield Case("retrieve_channels", "channels", "from their correlations", lambda: (
        aligned_error(retrieve_channels(exact, 3).channels, h), 1e-8))  # fmt: skip
    yield Case("retrieve_channels", "taps", "1", lambda: (
        off(np.abs(retrieve_channels([[4.0], [6.0], [9.0]], 2).channels), [[2.0], [3.0]]), 1e-8))  # fmt: skip
    yield Case("cross_correlations", "h", "1e200", must_refuse(lambda: cross_correlations(1e200 * h)))
    for one, two, three in ((0, 0, 0), (900, 0, 900), (-900, -900, 0), (0, 900, -900), (600, 300, 300)):

        def identity(p: int = one, q: int = two, r: int = three) -> tuple[float, float]:
            given = np.ldexp(OUTPUTS, p), np.ldexp(SOURCE, q), np.ldexp(CHANNELS, r)
            free = identity_error(*given, free_scale=True)
            return max(free, identity_error(*given) if p == q + r else 0.0), 1e-13

        yield Case("identity_error", "g x 2^k, f x 2^l, h x 2^m", f"{one}, {two}, {three}", identity)
    yield Case("identity_error", "g", "0", must_refuse(lambda: identity_error(0 * OUTPUTS, SOURCE, CHANNELS)))
    for words, given in BAD_CHANNELS:
        yield Case("cross_correlations", "signals", words, must_refuse(lambda g=given: cross_correlations(g)))
        yield Case("identity_error", "outputs", words, must_refuse(lambda g=given: identity_error(g, SOURCE, CHANNELS)))
        yield Case("retrieve_channels", "correlations", words, must_refuse(lambda g=given: retrieve_channels(g, 3)))
    options: tuple[tuple[str, dict[str, Any]], ...] = (
        ("nearest 3", {"nearest": 3}), ("nearest 0.5", {"nearest": 0.5}), ("weights NaN", {"weights": (math.nan, 0.0)}),
        ("weights -1", {"weights": (-1.0,)}), ("weights inf", {"weights": (math.inf, 0.0)}), ("steps -1", {"steps": -1}),
        ("steps 1.5", {"steps": 1.5}), ("no weights", {"weights": ()}),
    )  # fmt: skip
    for words, option in options:
        yield Case("retrieve_channels", "option", words, must_refuse(lambda o=option: retrieve_channels(exact, 3, **o)))
    for number in (0, -1, 2, 2.5):
        yield Case(
            "retrieve_channels", "channels", f"{number:g}", must_refuse(lambda n=number: retrieve_channels(exact, n))
        )
    yield Case("retrieve_channels", "correlations", "0", must_refuse(lambda: retrieve_channels(0 * exact, 3)))
    yield Case(
        "retrieve_channels", "correlations", "negative at lag 0", must_refuse(lambda: retrieve_channels(-exact, 3))
    )


def multichannel_cases() -> Iterator[Case]:
    """Four channels of four taps from their outputs, at any intensity."""
    near = CHANNELS + 0.01 * np.random.default_rng(3).standard_normal(CHANNELS.shape)

    def least_squares(g: Any, taps: Any = 4, **options: Any) -> Any:
        return least_squares_blind(g, taps, **{"start": near, **options})

    methods: dict[str, tuple[Callable[..., Any], float]] = {
        "identify_channels, cross_relation": (lambda g, taps=4, **o: identify_channels(g, taps, **o), 1e-11),
        "identify_channels, subspace": (
            lambda g, taps=4, **o: identify_channels(g, taps, method="subspace", **o),
            1e-9,
        ),
        "least_squares_blind": (least_squares, 1e-9),
        "focused_blind": (lambda g, taps=4, **o: focused_blind(g, taps, **o), 1e-5),
    }
    for name, (find, allowed) in methods.items():

        def recovered(c: Any = find, p: int = 0, t: float = allowed) -> tuple[float, float]:
            found = c(np.ldexp(OUTPUTS, p))
            # `identify_channels` gives a record's ends as well, which are weakly known; its middle is the source.
            source = found.source if hasattr(found, "source") else found.sources[0][3:63]
            # The product of the scales of source and channels is that of the outputs.
            fitted = np.array([np.convolve(source, h) for h in found.channels])
            apart = (
                aligned_error(found.channels, CHANNELS),
                aligned_error(source, SOURCE),
                off(np.ldexp(fitted, -p), OUTPUTS),
            )
            return max(apart), 10 * t

        yield Case(name, "channels, source", "recovered", recovered)
        for power in (-900, 900, 1000):

            def scaled(c: Any = find, p: int = power) -> tuple[float, float]:
                one, other = c(OUTPUTS), c(np.ldexp(OUTPUTS, p))
                names = ("source",) if hasattr(one, "source") else ("sources",)
                apart = [off(np.ldexp(getattr(other, n), -p), getattr(one, n)) for n in names]
                return max(*apart, off(other.channels, one.channels), abs(other.misfit - one.misfit)), 0.0

            yield Case(name, "g x 2^k", f"k = {power}", scaled)
        for kind in (np.float32,):
            yield Case(name, "type", kind.__name__, lambda c=find, k=kind: (
                off(c(OUTPUTS.astype(k)).channels, c(OUTPUTS.astype(k).astype(np.float64)).channels), 0.0))  # fmt: skip
        for words, given in BAD_CHANNELS:
            yield Case(name, "outputs", words, must_refuse(lambda c=find, g=given: c(g)))
        dull = np.outer([1.0, 2.0, 3.0, 4.0], OUTPUTS[0])
        none: tuple[tuple[str, Array], ...] = (("dark", 0 * OUTPUTS), ("one", OUTPUTS[:1]), ("multiples of one", dull))
        short = (("too short", OUTPUTS[:, :5]),) if "identify" in name else ()
        for words, given in (*none, *short):
            yield Case(name, "outputs", words, must_refuse(lambda c=find, g=given: c(g)))
        for taps in (0, -1, 1.5, math.nan, True, 64, 10**12):
            yield Case(name, "taps", f"{taps}", must_refuse(lambda c=find, n=taps: c(OUTPUTS, n)))
    bent: tuple[tuple[str, dict[str, Any]], ...] = (
        ("start NaN", {"start": near * math.nan}), ("start 0", {"start": 0 * near}),
        ("start of (4, 3)", {"start": near[:, :3]}),
        ("steps -1", {"steps": -1}), ("steps 1.5", {"steps": 1.5}),
    )  # fmt: skip
    for words, option in bent:
        yield Case("least_squares_blind", "option", words, must_refuse(lambda o=option: least_squares(OUTPUTS, **o)))
    for power in POWERS:
        yield Case("least_squares_blind", "start x 2^k", f"k = {power}", lambda p=power: (
            off(least_squares(OUTPUTS, start=np.ldexp(near, p)).channels, least_squares(OUTPUTS).channels),
            0.0 if p > -970 else 1e-9))  # fmt: skip
        yield Case("rival_channels", "g x 2^k", f"k = {power}", lambda p=power: (
            float(abs(rival_channels(np.ldexp(OUTPUTS, p), 5) - 2)), 0.0))  # fmt: skip
    bent = (
        ("white_weights NaN", {"white_weights": (math.nan, 0.0)}), ("white_weights rise", {"white_weights": (0.0, 1.0)}),
        ("white_weights -1", {"white_weights": (math.inf, -1.0)}), ("no white_weights", {"white_weights": ()}),
        ("front_weights NaN", {"front_weights": (math.nan,)}), ("nearest 9", {"nearest": 9}), ("steps 0", {"steps": 0}),
        ("steps 1.5", {"steps": 1.5}),
    )  # fmt: skip
    for words, option in bent:
        yield Case("focused_blind", "option", words, must_refuse(lambda o=option: focused_blind(OUTPUTS, 4, **o)))
    for target in (-1.0, math.nan):
        yield Case("fit_interferometric", "target", f"{target:g}", must_refuse(
            lambda t=target: fit_interferometric(OUTPUTS, 4, target=t)))  # fmt: skip
    for power in (-450, 450):

        def fitted(p: int = power) -> tuple[float, float]:
            one, other = fit_interferometric(OUTPUTS, 4), fit_interferometric(np.ldexp(OUTPUTS, p), 4)
            return max(off(np.ldexp(other.correlations, -2 * p), one.correlations),
                       off(other.autocorrelation, one.autocorrelation)), 0.0  # fmt: skip

        yield Case("fit_interferometric", "g x 2^k", f"k = {power}", fitted)
    yield Case(
        "fit_interferometric", "g x 2^k", "k = 900", must_refuse(lambda: fit_interferometric(np.ldexp(OUTPUTS, 900), 4))
    )
    for window in (0, 1, 64, 1.5):
        yield Case("identify_channels, subspace", "window", f"{window}", must_refuse(
            lambda w=window: identify_channels(OUTPUTS, 4, method="subspace", window=w)))  # fmt: skip
    yield Case("identify_channels", "method", "x", must_refuse(lambda: identify_channels(OUTPUTS, 4, method="x")))  # type: ignore[arg-type]

    def single_tap(c: Callable[..., Any]) -> tuple[float, float]:
        h = np.array([[1.0], [2.0], [-0.5]])
        g = np.array([np.convolve(SOURCE, row) for row in h]) + 1e-3 * np.random.default_rng(1).standard_normal((3, 60))
        return aligned_error(c(g, 1).channels, h), 1e-2

    for name in ("identify_channels, cross_relation", "focused_blind"):
        yield Case(name, "taps", "1", lambda c=methods[name][0]: single_tap(c))


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
