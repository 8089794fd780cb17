"""Several channels of one source: against rational arithmetic and the truth, in any unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import (
    aligned_error,
    convolve_channels,
    focused_blind,
    identify_channels,
    least_squares_blind,
    rival_channels,
)
from wallmirror.deconvolution.interferometric_fit import fit_interferometric
from wallmirror.deconvolution.interferometry import cross_correlations, identity_error
from wallmirror.deconvolution.phase_retrieval import retrieve_channels

from .harness import EPS, Case, must_refuse, off
from .operators import BAD

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
    """Every cell of several channels."""
    yield from channel_cases()
    yield from correlation_cases()
    yield from multichannel_cases()


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
