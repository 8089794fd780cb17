"""Radiosity and the light of further bounces, against closed forms and geometric sums."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.interreflection import from_card, from_room, glow_in_mirror
from wallmirror.radiosity import Box, neumann_series, transport_operator

from .harness import DIGITS, EPS, Case, must_refuse, off
from .scenes import observer

Array = NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Every cell of further bounces."""
    yield from factor_cases()
    yield from series_cases()
    yield from card_cases()
    yield from room_cases()


def opposite(x: float, y: float) -> mpmath.mpf:
    """Form factor of equal opposite rectangles, sides x and y over their distance (Howell, C-11)."""
    x, y = mpmath.mpf(x), mpmath.mpf(y)
    a, b = mpmath.sqrt(1 + x * x), mpmath.sqrt(1 + y * y)
    return (2 / (mpmath.pi * x * y)) * (
        mpmath.log(mpmath.sqrt((a * b) ** 2 / (1 + x * x + y * y)))
        + x * b * mpmath.atan(x / b) + y * a * mpmath.atan(y / a) - x * mpmath.atan(x) - y * mpmath.atan(y)
    )  # fmt: skip


def factor_cases() -> Iterator[Case]:
    """The first face's opposite in a box of six patches, and what all rows sum to; eps times the squared slenderness."""
    for size in ((1.0, 1.0, 1.0), (1.0, 3.0, 2.0), (100.0, 1.0, 1.0), (1.0, 1.0, 100.0), (1e-6, 1e-6, 1e-6), (1e6, 1e6, 1e6),
                 (1e-6, 5e-5, 1e-5)):  # fmt: skip
        for cells in (1, 6):

            def factors(s: tuple[float, float, float] = size, n: int = cells) -> tuple[float, float]:
                found = Box(size=s, cells=n).form_factors()
                if not np.all(np.isfinite(found)) or found.min() < 0:
                    return math.nan, 0.0
                # All of face x1 as one patch sees it of x0: mean over rows, sum over columns.
                between = float(found[: n * n, n * n : 2 * n * n].sum(axis=1).mean())
                with mpmath.workdps(DIGITS):
                    exact = float(opposite(s[1] / s[0], s[2] / s[0]))
                rows = float(np.abs(found.sum(axis=1) - 1).max())
                return max(rows, abs(between - exact)), 64 * EPS * (n * max(s) / min(s)) ** 2

            yield Case("Box.form_factors", "size, cells", f"{size}, {cells}", factors)

    def scaled() -> tuple[float, float]:
        one, other = (Box(size=(2.0 * f, 3.0 * f, 1.0 * f), cells=3).form_factors() for f in (1.0, 2.0**-18))
        # log(2^-36) is no whole number, so that the sums round differently.
        return float(np.abs(one - other).max()), 64 * EPS * 9**2

    yield Case("Box.form_factors", "size x 2^-18", "the same", scaled)
    sizes: tuple[tuple[float, float, float], ...] = (
        (1.0, 1.0, 1e4), (1e-6, 1.0, 1e6), (0.0, 1.0, 1.0), (math.nan, 1.0, 1.0), (1e-7, 1e-7, 1e-7), (1.0, 1.0, math.inf),
        (-1.0, 1.0, 1.0),
    )  # fmt: skip
    for bad in sizes:
        yield Case("Box", "size", str(bad), must_refuse(lambda s=bad: Box(size=s).form_factors()))
    options: tuple[dict[str, Any], ...] = (
        {"cells": 0}, {"cells": 1.5}, {"cells": 10**9}, {"open_faces": ("x0", "x1", "y0", "y1", "z0", "z1")},
        {"open_faces": ("w",)}, {"size": (1.0, 1.0)},
    )  # fmt: skip
    for given in options:
        yield Case("Box", *(str(part) for part in next(iter(given.items()))), must_refuse(
            lambda g=given: Box(**{"size": (1.0, 1.0, 1.0), **g})))  # fmt: skip


def series_cases() -> Iterator[Case]:
    """A furnace, whose every patch shines with the geometric sum of the albedo."""
    factors = Box(size=(1.0, 2.0, 1.0), cells=2).form_factors()
    for albedo in (0.0, 1e-300, 0.5, 1 - 1e-6, 1 - 1e-12):
        for emitted in (1e-310, 1e-300, 1.0, 1e290):

            def furnace(a: float = albedo, e: float = emitted) -> tuple[float, float]:
                series = neumann_series(transport_operator(factors, a), np.full(24, e), 8)
                with mpmath.workdps(DIGITS):
                    sums = [mpmath.fsum(mpmath.mpf(a) ** n for n in range(k + 1)) for k in range(9)]
                    exact = [float(mpmath.mpf(e) * s) for s in sums], float(mpmath.mpf(e) / (1 - mpmath.mpf(a)))
                given = (*np.ravel(series.errors), series.ratio, series.spectral_radius, series.largest_factor)
                if not all(map(math.isfinite, given)):
                    return math.nan, 0.0
                apart = max(off(series.partial_sums[:, 0], exact[0]), off(series.exact, np.full(24, exact[1])))
                return apart, 1e-14 / (1 - a) + (1e-12 if e < 1e-308 else 0.0)

            yield Case("neumann_series", "albedo, emitted", f"{albedo!r}, {emitted:g}", furnace)
    yield Case("neumann_series", "emitted", "0", lambda: (
        float(np.max(neumann_series(transport_operator(factors, 0.5), np.zeros(24), 8).errors)), 0.0))  # fmt: skip

    def growing(a: float) -> tuple[float, float]:
        series = neumann_series(transport_operator(factors, a), np.ones(24), 8)
        exact = [(a ** (k + 1) - 1) / (a - 1) for k in range(9)]
        # Walls that add light: the sums grow, and the spectral radius says that they have no limit.
        return max(off(series.partial_sums[:, 0], exact), abs(series.spectral_radius / a - 1)), 1e-13

    for albedo in (1.1, 1e10):
        yield Case("neumann_series", "albedo", f"{albedo:g}", lambda a=albedo: growing(a))
    for albedo in (1.0, 1e300):
        yield Case("neumann_series", "albedo", f"{albedo:g}", must_refuse(
            lambda a=albedo: neumann_series(transport_operator(factors, a), np.ones(24), 8)))  # fmt: skip
    for value in (math.nan, math.inf, 1.7e308):
        yield Case("neumann_series", "emitted", f"{value:g}", must_refuse(
            lambda v=value: neumann_series(transport_operator(factors, 0.9), np.full(24, v), 8)))  # fmt: skip
    for terms in (-1, 1.5, 10**12):
        yield Case("neumann_series", "terms", f"{terms:g}", must_refuse(
            lambda k=terms: neumann_series(transport_operator(factors, 0.5), np.ones(24), k)))  # fmt: skip
    for shape in ((24,), (0, 0), (24, 23)):
        yield Case("neumann_series", "operator's shape", str(shape), must_refuse(
            lambda s=shape: neumann_series(np.zeros(s), np.zeros(s[-1]), 2)))  # fmt: skip
    for bad in (-1e-300, math.nan, math.inf):
        yield Case(
            "transport_operator", "albedo", f"{bad:g}", must_refuse(lambda a=bad: transport_operator(factors, a))
        )
        yield Case("transport_operator", "form factors", f"{bad:g}", must_refuse(
            lambda a=bad: transport_operator(np.full((2, 2), a), 0.5)))  # fmt: skip
    yield Case("transport_operator", "albedo's shape", "(7,)", must_refuse(
        lambda: transport_operator(factors, np.full(7, 0.5))))  # fmt: skip


def small_card(metres: float, albedo: float) -> wm.Card:
    """One strip a thousandth as wide and high as it is far from the wall, without a board."""
    return wm.Card(
        elements_x=(0.0,), y=-metres, element_width=1e-3 * metres, element_height=1e-3 * metres, albedo=albedo
    )


def card_cases() -> Iterator[Case]:
    """A card so small that it is one patch: k of its light comes back over a diffuse wall and shines again, k / (1 - k).

    By int rho (z^2 / r^4)^2 dA = rho pi / (3 z^2) over the wall, k = albedo A rho / (3 z^2); in a mirror at distance 2 z
    k = albedo R A / (4 pi z^2). Both to (width / distance)^2 = 1e-6.
    """
    rho = 0.5 / math.pi
    for metres in (1e-100, 1e-6, 1.0, 1e8, 1e60):
        for albedo in (0.0, 1e-300, 0.5, 1 - 1e-12):

            def over_wall(z: float = metres, a: float = albedo) -> tuple[float, float]:
                eye, card = observer(position=(0.0, -5 * z), pixels=6), small_card(z, a)
                found = from_card(eye, card, wm.Diffuse(albedo=0.5), np.array([[2.0, 1e-300, 1e300]]))
                once = wm.radiance(wm.transport_matrix(eye, card, wm.Diffuse(albedo=0.5)), [[2.0, 1e-300, 1e300]])
                k = a * 1e-6 * rho / 3
                # What the card sends back is integrated over pixels to 1e-2; so flat a BRDF gets to 1e-3.
                return max(off(found[..., b], once[..., b] * k / (1 - k)) for b in range(3)), 1e-3

            def in_mirror(z: float = metres, a: float = albedo) -> tuple[float, float]:
                found = glow_in_mirror(small_card(z, a), wm.Mirror(reflectance=0.9), np.array([[2.0, 1e-300, 1e300]]))
                k = a * 0.9 * 1e-6 / (4 * math.pi)
                return max(off(found[0, b], v * k / (1 - k)) for b, v in enumerate((2.0, 1e-300, 1e300))), 1e-5

            yield Case("from_card", "scene's size, albedo", f"{metres:g} m, {albedo!r}", over_wall)
            yield Case("glow_in_mirror", "scene's size, albedo", f"{metres:g} m, {albedo!r}", in_mirror)

    def boarded(factor: float) -> wm.Card:
        return wm.Card(
            elements_x=tuple(factor * x for x in (-0.5, 0.125, 0.5)), y=-factor, element_width=factor / 64,
            element_height=factor / 32, albedo=0.8, board_width=2 * factor, board_height=factor,
        )  # fmt: skip

    source = np.array([[1.0], [0.25], [2.0]])
    for power in (-300, -20, 27, 300):

        def scaled(p: int = power) -> tuple[float, float]:
            one, other = (
                from_card(observer(position=(0.0, -5 * f), pixels=6), boarded(f), wm.Diffuse(albedo=0.5), source)
                for f in (1.0, math.ldexp(1.0, p)))  # fmt: skip
            return off(other, one), 1e-13

        def mirrored(p: int = power) -> tuple[float, float]:
            one, other = (glow_in_mirror(boarded(f), wm.Mirror(), source) for f in (1.0, math.ldexp(1.0, p)))
            return off(other, one), 1e-13

        yield Case("from_card", "scene x 2^k", f"k = {power}", scaled)
        yield Case("glow_in_mirror", "scene x 2^k", f"k = {power}", mirrored)

        def brighter(p: int = power) -> tuple[float, float]:
            eye = observer(pixels=6)
            one, other = (
                from_card(eye, boarded(1.0), wm.Diffuse(albedo=0.5), np.ldexp(source, q)) for q in (0, p)
            )  # fmt: skip
            return float(np.max(np.abs(np.ldexp(other, -p) - one))), 0.0

        yield Case("from_card", "V x 2^k", f"k = {power}", brighter)
    lit: dict[str, Callable[[Any], Array]] = {
        "from_card": lambda v: from_card(observer(pixels=6), boarded(1.0), wm.Diffuse(), v),
        "glow_in_mirror": lambda v: glow_in_mirror(boarded(1.0), wm.Mirror(), v),
        "from_room": lambda v: from_room(
            observer(pixels=6), boarded(1.0), wm.Room(half_width=6.0, half_height=3.0, depth=8.0, albedo=0.5), wm.Diffuse(), v),
    }  # fmt: skip
    for name, call in lit.items():
        for words, given in (("NaN", np.full((3, 1), math.nan)), ("inf", np.full((3, 1), math.inf)),
                             ("of two elements", np.ones((2, 1))), ("of one axis", np.ones(3))):  # fmt: skip
            yield Case(name, "source", words, must_refuse(lambda c=call, g=given: c(g)))
    for degrees in (1e-3, 0.1, 90.0):

        def narrow(d: float = degrees) -> tuple[float, float]:
            brdf = wm.GaussianTrain(centres=(0.0,), sigma=math.radians(d))
            found = from_card(observer(pixels=6), small_card(1.0, 0.5), brdf, np.ones((1, 1)))
            # Of light that meets the wall at theta the lobe sends exp(-(2 theta)^2 / 2 sigma^2) back: over the wall
            # int exp(-2 (atan(x / z) / sigma)^2) z^4 dx dh / r^8, with int dh / (a^2 + h^2)^4 = 5 pi / (16 a^7).
            with mpmath.workdps(30):
                s = mpmath.mpf(brdf.sigma)
                reach = min(mpmath.pi / 2, 20 * s)
                places = [-reach, -reach / 8, 0, reach / 8, reach]
                lobe = mpmath.quad(lambda t: mpmath.exp(-2 * (t / s) ** 2) * mpmath.cos(t) ** 5, places)
                share = 5 * mpmath.pi / 16 * lobe
            k = 0.5 / math.pi * 1e-6 * float(share)
            once = wm.transport_matrix(observer(pixels=6), small_card(1.0, 0.5), brdf)
            # The lobe's own light falls off within the strip, which was taken as one patch; its board glows all over.
            return off(found, once * k / (1 - k)), 1e-2

        yield Case("from_card", "lobe's width", f"{degrees:g}°", narrow)


def room_cases() -> Iterator[Case]:
    """An estimate; exact are its scaling by powers of two, of the scene and of the source, and the dark room."""

    def seen(factor: float, level: float, albedo: float = 0.5) -> Array:
        room = wm.Room(half_width=6 * factor, half_height=3 * factor, depth=8 * factor, albedo=albedo)
        strips = wm.Card(elements_x=(-factor, factor), y=-factor, element_width=factor / 64, element_height=factor / 32)
        eye = observer(position=(0.0, -5 * factor), pixels=20, view_angles=(0.0,))
        return from_room(eye, strips, room, wm.Diffuse(albedo=0.5), np.array([[level], [2 * level]]))

    for power in (-60, -20, 27, 60):
        yield Case("from_room", "scene x 2^k", f"k = {power}", lambda p=power: (
            off(seen(math.ldexp(1.0, p), 1.0), seen(1.0, 1.0)), 1e-13))  # fmt: skip
    for power in (-900, 900):
        yield Case("from_room", "V x 2^k", f"k = {power}", lambda p=power: (
            off(np.ldexp(seen(1.0, math.ldexp(1.0, p)), -p), seen(1.0, 1.0)), 0.0))  # fmt: skip
    yield Case("from_room", "albedo", "0", lambda: (float(np.max(np.abs(seen(1.0, 1.0, 0.0)))), 0.0))
    yield Case("from_room", "albedo", "1e-300", lambda: (
        off(seen(1.0, 1e10, 1e-300), 1e-290 * seen(1.0, 1.0, 1e-9) * 1e9), 1e-8))  # fmt: skip
    bad: tuple[dict[str, float], ...] = (
        {"half_width": math.nan}, {"half_width": 0.0}, {"half_height": -1.0}, {"depth": math.inf}, {"albedo": 1.0},
        {"albedo": -1e-9}, {"albedo": math.nan}, {"depth": 1e101}, {"half_width": 1e-101},
    )  # fmt: skip
    for given in bad:
        yield Case("Room", *(str(part) for part in next(iter(given.items()))), must_refuse(
            lambda g=given: wm.Room(**{"half_width": 6.0, "half_height": 3.0, "depth": 8.0, "albedo": 0.5, **g})))  # fmt: skip
