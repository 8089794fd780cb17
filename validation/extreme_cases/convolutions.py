"""Rendering as a convolution against Algorithm 1 and against mpmath, in any unit of light."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.convolution import (
    angle_convolution,
    mirror_points,
    mirror_render,
    outgoing_light,
    projected_brdf,
    spherical_convolution,
    wall_convolution,
    wall_kernel,
)
from wallmirror.convolution.as_published import box_mirror_render, nearest_spherical, scattered_wall_convolution
from wallmirror.convolution.spherical import half_circle_directions

from .harness import DIGITS, EPS, Case, must_refuse, off
from .scenes import card, lobes, observer

Array = NDArray[np.float64]
FLAT = wm.Observer(position=(0.0, -5.0), fov=math.radians(60), view_angles=(0.0,), pixels=60, pixels_at="edges")
POINTS = card(element_width=0.0, element_height=0.0)
WIDE = lobes(10.0)
RENDERERS: dict[str, Any] = {
    "spherical_convolution": lambda v, rho=WIDE: spherical_convolution(FLAT, POINTS, rho, v, samples=200),
    "outgoing_light": lambda v, rho=WIDE: outgoing_light(FLAT, POINTS, rho, v, samples=200),
    "angle_convolution": lambda v, rho=WIDE: angle_convolution(FLAT, POINTS, rho, v, samples=200),
    "wall_convolution": lambda v, rho=WIDE: wall_convolution(FLAT, POINTS, rho, v),
    "mirror_render": lambda v, rho=None: mirror_render(FLAT, POINTS, v),
    "box_mirror_render": lambda v, rho=None: box_mirror_render(FLAT, POINTS, v, width=0.05),
    "nearest_spherical": lambda v, rho=WIDE: nearest_spherical(FLAT, POINTS, rho, v),
    "scattered_wall_convolution": lambda v, rho=WIDE: scattered_wall_convolution(FLAT, POINTS, rho, v),
}


def cases() -> Iterator[Case]:
    """Every cell of the convolutions."""
    yield from form_cases()
    yield from wall_cases()
    yield from scaling_cases()


def form_cases() -> Iterator[Case]:
    """The half circle against Algorithm 1: it needs Hypothesis 8 alone, so that only its sampling may be off."""
    forms = {"spherical_convolution": spherical_convolution, "angle_convolution": angle_convolution}

    def each(quantity: str, value: str, form: str, allowed: float, **changes: Any) -> Case:
        def check() -> tuple[float, float]:
            options = dict(changes)
            eye = options.pop("observer", observer(pixels_at="edges"))
            strips = options.pop("card", card(element_width=0.0, element_height=0.0))
            brdf = options.pop("brdf", lobes())
            source = np.random.default_rng(5).random(strips.elements)
            exact = wm.radiance(wm.transport_matrix(eye, strips, brdf, weights="thesis"), source)
            found = forms[form](eye, strips, brdf, source, order=5, **options)
            # Relative to the lobe's peak, 1: where only its far tail is seen, the tail is not resolved.
            return float(np.max(np.abs(found - exact)) / max(1.0, np.max(np.abs(exact)))), allowed

        return Case(form, quantity, value, check)

    points = {"element_width": 0.0, "element_height": 0.0}
    for metres in (1e-6, 1e-2, 1e2, 1e8):
        yield each("card's distance", f"{metres:g} m", "spherical_convolution", 1e-5, card=card(y=-metres, **points))
    yield each("card's distance", "1e8 m", "angle_convolution", 1e-5, card=card(y=-1e8, **points))
    for degrees in (1e-3, 0.05, 1.0, 90.0):
        yield each("lobe's width", f"{degrees:g}°", "spherical_convolution", 1e-3, brdf=lobes(degrees))
    for samples in (0, 1, 2, 100_000):
        yield each("directions K", str(samples), "spherical_convolution", 1e-5, samples=samples, brdf=lobes(30.0))
    yield each("elements M", "1", "spherical_convolution", 1e-5, card=card(elements_x=(0.3,), **points))
    yield each("view angle", "59.999°", "spherical_convolution", 1e-5, observer=observer(
        view_angles=(math.radians(59.999),), pixels_at="edges"))  # fmt: skip


def _train(u: mpmath.mpf, sigma_deg: float) -> mpmath.mpf:
    """The scene's train of lobes at an angle sum."""
    sigma = mpmath.mpf(lobes(sigma_deg).sigma)
    return mpmath.fsum(mpmath.exp(-(((u - mpmath.mpf(c)) / sigma) ** 2) / 2) for c in lobes().centres)


def wall_cases() -> Iterator[Case]:
    """rho at -atan((x - x_mirror) / y), which mpmath computes from the scene."""
    for metres in (1e-100, 1e-6, 1.0, 1e8, 1e100):
        for seen in ("observer", "both"):

            def copies(m: float = metres, via: str = seen) -> tuple[float, float]:
                eye = wm.Observer(position=(0.25 * m, -5 * m), fov=1.0, view_angles=(0.3, -0.3), pixels=5)
                strips = wm.Card(elements_x=(-m, 0.2 * m), y=-2 * m)
                found = wall_convolution(eye, strips, WIDE, [1.0, 2.0], projected_from=via)  # type: ignore[arg-type]
                with mpmath.workdps(DIGITS):
                    y_o, y_s = mpmath.mpf(5 * m), mpmath.mpf(2 * m)
                    y = y_o if via == "observer" else 1 / (1 / y_o + 1 / y_s)
                    exact = np.zeros(found.shape)
                    for (a, j), x in np.ndenumerate(wm.wall_points(eye)):
                        for place, v in zip(strips.elements_x, (1, 2), strict=True):
                            image = (place * y_o + mpmath.mpf(eye.position[0]) * y_s) / (y_o + y_s)
                            u = -mpmath.atan((mpmath.mpf(float(x)) - image) / y)
                            exact[a, j] += float(v * _train(u, 10.0))
                return off(found, exact), 64 * EPS / WIDE.sigma

            yield Case("wall_convolution", "whole scene, projected from", f"x {metres:g}, {seen}", copies)

        def image(m: float = metres) -> tuple[float, float]:
            eye = wm.Observer(position=(0.25 * m, -5 * m), fov=1.0, view_angles=(0.0,), pixels=5)
            found = mirror_points(eye, wm.Card(elements_x=(0.0,), y=-2 * m), [-m, 0.0, 3 * m])
            with mpmath.workdps(DIGITS):
                exact = [float((mpmath.mpf(x) * 5 * m + mpmath.mpf(0.25 * m) * 2 * m) / (7 * mpmath.mpf(m)))
                         for x in (-m, 0.0, 3 * m)]  # fmt: skip
            return off(found, exact), 4 * EPS

        yield Case("mirror_points", "whole scene", f"x {metres:g}", image)
        yield Case("wall_kernel", "observer's distance", f"{metres:g} m", lambda m=metres: (
            off(wall_kernel(observer(position=(0.0, -5 * m), view_angles=(0.0,), pixels=5), POINTS, WIDE),
                wall_kernel(observer(position=(0.0, -5.0), view_angles=(0.0,), pixels=5), POINTS, WIDE)),
            64 * EPS / WIDE.sigma))  # fmt: skip
    yield Case("wall_kernel", "view", "turned", must_refuse(
        lambda: wall_kernel(observer(view_angles=(0.1,)), POINTS, lobes())))  # fmt: skip
    for bad in (math.nan, math.inf):
        yield Case("projected_brdf", "offset", f"{bad}", must_refuse(
            lambda v=bad: projected_brdf(FLAT, POINTS, lobes(), [0.0, v])))  # fmt: skip
    yield Case("mirror_render", "light", "of three elements in view", lambda: (
        off(mirror_render(FLAT, POINTS, [1e300, 1e-300, 2.0]).sum(), 1e300), 4 * EPS))  # fmt: skip


def scaling_cases() -> Iterator[Case]:
    """Linear in V and in rho: exact under powers of two, and nothing that is not finite."""
    v = np.array([0.25, 1.0, 0.7])
    for name, call in RENDERERS.items():
        for power in (-900, 900):
            yield Case(name, "V x 2^k", f"k = {power}", lambda c=call, p=power: (
                float(np.max(np.abs(np.ldexp(c(np.ldexp(v, p)), -p) - c(v)))), 0.0))  # fmt: skip
            if "mirror" not in name and "scattered" not in name:
                train = wm.GaussianTrain(centres=lobes().centres, sigma=1.0)
                bright = wm.GaussianTrain(centres=lobes().centres, sigma=1.0, scale=math.ldexp(1.0, power))
                yield Case(name, "rho x 2^k", f"k = {power}", lambda c=call, p=power, one=train, two=bright: (
                    float(np.max(np.abs(np.ldexp(c(v, two), -p) - c(v, one)))), 0.0))  # fmt: skip
        for kind in (np.float32, np.float16):
            yield Case(name, "V's type", kind.__name__, lambda c=call, k=kind: (
                off(c(v.astype(k)), c(v.astype(k).astype(np.float64))), 0.0))  # fmt: skip
        for words, given in (
            ("NaN", [1.0, math.nan, 1.0]),
            ("inf", [1.0, math.inf, 1.0]),
            ("of two elements", [1.0, 1.0]),
        ):
            yield Case(name, "V", words, must_refuse(lambda c=call, g=given: c(np.array(g))))
        if "mirror" not in name and "scattered" not in name:
            huge = wm.GaussianTrain(centres=(0.0,), sigma=1.0, scale=1e300)
            yield Case(name, "V, rho", "1e300, 1e300", must_refuse(lambda c=call, h=huge: c(np.full(3, 1e300), h)))
    for name, call in list(RENDERERS.items())[:4]:
        yield Case(name, "BRDF", "of two angles", must_refuse(lambda c=call: c(v, wm.CookTorrance())))
        yield Case(name, "BRDF", "a mirror", must_refuse(lambda c=call: c(v, wm.Mirror())))

    def directions() -> tuple[float, float]:
        found = outgoing_light(FLAT, POINTS, WIDE, v, samples=400, weights="cosine")
        with mpmath.workdps(DIGITS):
            exact = np.zeros((5, 7))
            rows, columns = np.linspace(0, 59, 5).astype(int), np.linspace(0, 399, 7).astype(int)
            for r, j in enumerate(rows):
                x = mpmath.mpf(float(wm.wall_points(FLAT)[0, j]))
                for c, k in enumerate(columns):
                    theta = mpmath.mpf(float(half_circle_directions(400)[k]))
                    for place, strength in zip(POINTS.elements_x, v, strict=True):
                        sum_ = mpmath.atan2(place - x, 1) + theta
                        cosine = mpmath.cos(mpmath.atan2(place - x, 1))
                        exact[r, c] += float(float(strength) * cosine * _train(sum_, 10.0))
        # Cubic splines of a step of 0.45 deg under lobes of 10 deg: (h / sigma)^4 / 384 twice, and their derivatives.
        return off(found[0][np.ix_(rows, columns)], exact), 1e-6

    yield Case("outgoing_light", "directions", "from grazing to grazing", directions)
