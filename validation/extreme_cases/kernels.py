"""Kernels, mirrors and the product F V: against mpmath, a ray count, and exact scaling by powers of two."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np

import wallmirror as wm
from wallmirror.geometry import pixel_half_width, pixel_tangents
from wallmirror.transport import strip_factor

from .brdfs import exact_cook_torrance
from .harness import DIGITS, EPS, Case, must_refuse, off
from .scenes import card, lobes, observer
from .transport import exact_transport


def cases() -> Iterator[Case]:
    """Every cell of kernels, mirrors and products."""
    yield from kernel_cases()
    yield from two_angle_cases()
    yield from option_cases()
    yield from mirror_cases()
    yield from product_cases()


def kernel_cases() -> Iterator[Case]:
    """A kernel applied to a lobe is F."""

    def each(quantity: str, value: str, eye: wm.Observer, strips: wm.Card, degrees: float = 30.0) -> Iterator[Case]:
        for weights in ("thesis", "cosine", "physical"):

            def check(w: str = weights) -> tuple[float, float]:
                brdf = lobes(degrees)
                kernel = wm.build_kernel(eye, strips, weights=w, resolution=brdf.angular_scale, tolerance=1e-9)  # type: ignore[arg-type]
                found = kernel.apply(brdf)
                brightest = np.unravel_index(int(np.argmax(found)), found.shape)
                places = {tuple(int(i) for i in brightest), tuple(size - 1 for size in found.shape)}
                lost = -math.log10(min(1.0, strips.element_height))  # digits, of a low strip's difference of integrals
                with mpmath.workdps(DIGITS + round(2 * lost)):
                    exact = {p: exact_transport(eye, strips, brdf, w, *p) for p in places}
                largest = float(found.max())
                missed = max(float(abs(mpmath.mpf(float(found[p])) - e)) for p, e in exact.items())
                if not np.all(np.isfinite(found)):
                    return math.nan, 0.0
                return (missed / largest if largest > 0 else missed), 1e-8 + 8 * EPS * math.pi / brdf.sigma

            yield Case(f"build_kernel, {weights}", quantity, value, check)

    for metres in (1e-6, 1e-2, 1e8):
        strips = card(y=-metres, element_width=1e-3 if metres < 1 else 0.02)  # narrow, for mpmath's sake
        yield from each("card's distance", f"{metres:g} m", observer(pixels=20), strips)
        yield from each("observer's distance", f"{metres:g} m", observer(pixels=20, position=(0.0, -metres)), card())
    for degrees in (0.0, 59.0, 59.999):
        eye = observer(pixels=20, view_angles=(math.radians(degrees),))
        yield from each("view angle", f"{degrees:g}°", eye, card())
    for degrees in (1e-3, 3.0, 90.0):
        yield from each("lobe's width", f"{degrees:g}°", observer(pixels=20), card(), degrees)
    for metres in (1e-300, 1e-3, 1e3):
        yield from each("strip's height", f"{metres:g} m", observer(pixels=20), card(element_height=metres))


def two_angle_cases() -> Iterator[Case]:
    """F of a BRDF of two angles, whose arguments and value mpmath computes from the scene."""
    for degrees in (0.0, 59.0, 59.999):
        for metres in (1e-6, 1.0, 1e8):

            def facets(d: float = degrees, m: float = metres) -> tuple[float, float]:
                eye = observer(view_angles=(math.radians(d),), pixels=6)
                strips = card(y=-m, element_width=0.0, element_height=0.0)
                found = wm.transport_matrix(eye, strips, wm.CookTorrance(alpha=0.3), weights="cosine")
                with mpmath.workdps(DIGITS):
                    a = mpmath.mpf(eye.view_angles[0])
                    exact = np.empty(found.shape)
                    for j, t in enumerate(pixel_tangents(eye)):
                        wall = -5 * mpmath.tan(a - mpmath.atan(mpmath.mpf(float(t))))
                        for i, x in enumerate(strips.elements_x):
                            s, o = mpmath.atan2(x - wall, mpmath.mpf(m)), mpmath.atan2(-wall, 5)
                            value = exact_cook_torrance("ggx", "grooves", 0.3, s, o) * mpmath.cos(s)
                            exact[0, j, i] = float(value)
                # A cosine near grazing is known to the rounding of its angle over itself, and an angle of a near card to the
                # rounding of places along the wall over its distance.
                rounding = 1 / math.cos(math.radians(d + 30)) ** 2 + float(np.abs(wm.wall_points(eye)).max()) / m
                return off(found, exact), 64 * EPS * (1 + rounding) / 0.3

            yield Case(
                "transport_matrix, two angles", "view angle, card's distance", f"{degrees:g}°, {metres:g} m", facets
            )
    for power in (-900, -300, 300, 990):

        def brdf_scaled(p: int = power) -> tuple[float, float]:
            base, large = (wm.GaussianTrain(centres=(0.2,), sigma=0.5, scale=s) for s in (1.0, math.ldexp(1.0, p)))
            one, other = (wm.transport_matrix(observer(), card(), b) for b in (base, large))
            return float(np.max(np.abs(np.ldexp(other, -p) - one))), 0.0

        def scene_scaled(p: int = power // 3) -> tuple[float, float]:
            f = math.ldexp(1.0, p)
            eye = observer(position=(0.25 * f, -5 * f))
            strips = card(elements_x=(-f, 0.25 * f, f), y=-f, element_width=f / 64, element_height=f / 32)
            one = wm.transport_matrix(observer(position=(0.25, -5.0)), card(
                elements_x=(-1.0, 0.25, 1.0), y=-1.0, element_width=1 / 64, element_height=1 / 32), lobes())  # fmt: skip
            return float(np.max(np.abs(wm.transport_matrix(eye, strips, lobes()) - one))), 0.0

        yield Case("transport_matrix", "rho x 2^k", f"k = {power}", brdf_scaled)
        yield Case("transport_matrix", "scene x 2^k", f"k = {power // 3}", scene_scaled)


def option_cases() -> Iterator[Case]:
    """Options that no quadrature can follow."""
    options: tuple[dict[str, Any], ...] = (
        {"weights": "none"}, {"tolerance": 0.0}, {"tolerance": -1.0}, {"tolerance": math.nan}, {"orders": (0, 1)},
        {"orders": (1, 257)}, {"orders": (1.5, 1)}, {"orders": (math.nan, 1)}, {"orders": (1,)},
    )  # fmt: skip
    for given in options:
        name, value = next(iter(given.items()))
        yield Case("transport_matrix", name, str(value), must_refuse(
            lambda g=given: wm.transport_matrix(observer(), card(), lobes(30.0), **g)))  # fmt: skip
        yield Case("build_kernel", name, str(value), must_refuse(
            lambda g=given: wm.build_kernel(observer(), card(), **g)))  # fmt: skip
    for value in (0.0, -1.0, math.nan, 1e-300):
        yield Case("build_kernel", "resolution", f"{value:g}", must_refuse(
            lambda v=value: wm.build_kernel(observer(), card(), resolution=v)))  # fmt: skip
    for value in (1.0, 1e9, math.inf):
        yield Case("build_kernel", "resolution", f"{value:g}", lambda v=value: (
            off(wm.build_kernel(observer(), card(), resolution=v, tolerance=1e-9).apply(lobes(60.0)),
                wm.transport_matrix(observer(), card(), lobes(60.0), tolerance=1e-12)), 1e-8))  # fmt: skip
    heights = ((0.0, 1.0, -math.inf, 1.0), (0.0, 1.0, 0.0, math.nan), (math.nan, 1.0, -1.0, 1.0), (0.0, 0.0, -1.0, 1.0))
    for dx, z, low, high in heights:
        yield Case("strip_factor", "offset, distance, ends", f"{dx:g}, {z:g}, {low:g} to {high:g}", must_refuse(
            lambda x=dx, d=z, a=low, b=high: strip_factor(d, x, a, b)))  # fmt: skip
    for half in (1e-12, 1e-6, 1e-3):
        for centre in (0.3, 10.0, 1e4):

            def off_centre(h: float = half, c: float = centre) -> tuple[float, float]:
                low, high = c - h, c + h
                found = float(strip_factor(1.0, 0.5, low, high))
                with mpmath.workdps(DIGITS):
                    a = mpmath.hypot(1, mpmath.mpf(0.5))

                    def whole(y: mpmath.mpf) -> mpmath.mpf:
                        return (y / (2 * a**2 * (a**2 + y**2)) + mpmath.atan(y / a) / (2 * a**3)) * 1

                    exact = whole(mpmath.mpf(high)) - whole(mpmath.mpf(low))
                    return float(abs(mpmath.mpf(found) / exact - 1)), 64 * EPS

            yield Case("strip_factor", "half height at a height", f"{half:g} at {centre:g} m", off_centre)


def counted_mirror(
    eye: wm.Observer, strips: wm.Card, view: int, pixel: int, element: int, rays: int = 400_000
) -> float:
    """The share of a pixel's rays that a mirror sends onto a strip: even columns of rays, the heights in closed form."""
    half = pixel_half_width(eye)
    t = float(pixel_tangents(eye)[pixel]) + half * (2 * (np.arange(rays) + 0.5) / rays - 1)
    a = eye.view_angles[view]
    depth = eye.distance + strips.distance
    # A ray's direction in the plane is the axis (-sin a, cos a) plus t to the right, (cos a, sin a).
    along, into = -math.sin(a) + t * math.cos(a), math.cos(a) + t * math.sin(a)
    x = eye.position[0] + depth * along / into
    seen = np.abs(x - strips.elements_x[element]) < strips.element_width / 2
    heights = half * depth / into  # where the pixel's upper edge meets the card
    return float(np.mean(seen * np.minimum(1.0, 0.5 * strips.element_height / heights)))


def mirror_cases() -> Iterator[Case]:
    """Shares of a pixel by counting rays."""

    def each(quantity: str, value: str, eye: wm.Observer, strips: wm.Card) -> Case:
        def check() -> tuple[float, float]:
            found = wm.mirror_matrix(eye, strips, wm.Mirror(reflectance=1.0))
            if not np.all(np.isfinite(found)) or found.min() < 0 or found.max() > 1 + 8 * EPS * eye.pixels:
                return math.nan, 0.0
            order = np.argsort(found, axis=None)
            places = [np.unravel_index(int(k), found.shape) for k in (order[-1], order[-2], order[len(order) // 2])]
            missed = max(abs(found[p] - counted_mirror(eye, strips, *map(int, p))) for p in places)
            return float(missed), 1e-5  # two edges between 400,000 rays

        return Case("mirror_matrix", quantity, value, check)

    for metres in (1e-6, 1e-2, 1.0, 1e3, 1e8):
        yield each("whole scene", f"x {metres:g}", observer(position=(0.0, -5 * metres)), card(
            elements_x=(-metres, 0.2 * metres, 1.1 * metres), y=-metres,
            element_width=0.02 * metres, element_height=0.03 * metres))  # fmt: skip
        yield each("card's distance", f"{metres:g} m", observer(), card(y=-metres))
    for degrees in (0.0, 45.0, 59.0, 59.999):
        yield each("view angle", f"{degrees:g}°", observer(view_angles=(math.radians(degrees),)), card())
    for metres in (1e-300, 1e-9, 0.5, 1e3):
        yield each("strip's width", f"{metres:g} m", observer(), card(elements_x=(0.0,), element_width=metres))
        yield each("strip's height", f"{metres:g} m", observer(), card(element_height=metres))
    for number in (1, 2, 20_000):
        yield each("pixels N", str(number), observer(pixels=number), card())
    for fov in (1e-6, 120.0, 179.9):
        yield each("field of view", f"{fov:g}°", observer(fov=math.radians(fov), view_angles=(0.0,)), card())
    for share in (0.0, 1e-310, 0.5):
        yield Case("mirror_matrix", "reflectance", f"{share:g}", lambda r=share: (
            off(wm.mirror_matrix(observer(), card(), wm.Mirror(reflectance=r)),
                r * wm.mirror_matrix(observer(), card(), wm.Mirror(reflectance=1.0))),
            4 * EPS + (1e-13 if r < 1e-300 else 0.0)))  # fmt: skip
    yield Case("mirror_matrix", "weights", "none", must_refuse(
        lambda: wm.mirror_matrix(observer(), card(), wm.Mirror(), weights="none")))  # type: ignore[arg-type]  # fmt: skip
    yield Case("mirror_matrix", "elements", "points", must_refuse(lambda: wm.mirror_matrix(
        observer(), card(element_width=0.0, element_height=0.0), wm.Mirror())))  # fmt: skip


def product_cases() -> Iterator[Case]:
    """F V in units of any size; what leaves the range of float64 or never was in it is refused."""
    f, v = np.random.default_rng(1).random((2, 5, 3)), np.random.default_rng(2).random((3, 4))
    with mpmath.workdps(DIGITS):
        exact = np.array([[[float(mpmath.fsum(mpmath.mpf(float(f[a, j, i])) * mpmath.mpf(float(v[i, b])) for i in range(3)))
                            for b in range(4)] for j in range(5)] for a in range(2)])  # fmt: skip
    for one, two in ((0, 0), (-900, 0), (0, 900), (900, -900), (-900, 900), (1000, -1070)):

        def scaled(p: int = one, q: int = two) -> tuple[float, float]:
            # Of a source at 2^-1070 some four bits are left.
            return off(
                np.ldexp(wm.radiance(np.ldexp(f, p), np.ldexp(v, q)), -p - q), exact
            ), 4 * EPS if q > -1000 else 0.1

        yield Case("radiance", "F x 2^k, V x 2^l", f"{one}, {two}", scaled)
    for kind in (np.float32, np.float16):
        yield Case("radiance", "type", kind.__name__, lambda k=kind: (
            off(wm.radiance(f.astype(k), v.astype(k)), f.astype(k).astype(np.float64) @ v.astype(k).astype(np.float64)),
            4 * EPS))  # fmt: skip
    bad = {"NaN": math.nan, "inf": math.inf, "1e300, F 1e300": 1e300}
    for name, value in bad.items():
        transport = np.full((1, 2, 3), 1e300) if "F" in name else f
        yield Case("radiance", "V", name, must_refuse(lambda t=transport, x=value: wm.radiance(t, np.full((3, 1), x))))
    yield Case("radiance", "F", "NaN", must_refuse(lambda: wm.radiance(np.full((1, 2, 3), math.nan), v)))
    shapes: tuple[tuple[int, ...], ...] = ((2, 4), (), (0, 4))
    for shape in shapes:
        yield Case("radiance", "V's shape", str(shape), must_refuse(lambda s=shape: wm.radiance(f, np.zeros(s))))
    yield Case("radiance", "V's shape", "(3, 0)", lambda: (
        0.0 if wm.radiance(f, np.zeros((3, 0))).shape == (2, 5, 0) else 1.0, 0.5))  # fmt: skip
    yield Case("brdf_matrices", "values", "1e-310 to 1e300", lambda: (
        off(np.hstack(wm.brdf_matrices(np.ldexp(f, 990))), np.ldexp(np.hstack([f[0], f[1]]), 990)), 0.0))  # fmt: skip
    for given in (np.zeros(3), np.zeros((2, 3)), np.full((1, 2, 2), math.nan)):
        yield Case("brdf_matrices", "F", f"{given.shape}, {given.flat[0]:g}", must_refuse(
            lambda g=given: wm.brdf_matrices(g)))  # fmt: skip
