"""The transport of light: strips in closed form and the matrix F against mpmath at 50 digits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import mpmath
import numpy as np

import wallmirror as wm
from wallmirror.geometry import pixel_half_width, pixel_tangents
from wallmirror.transport import strip_factor

from .harness import DIGITS, EPS, Case
from .scenes import card, lobes, observer


def cases() -> Iterator[Case]:
    """Every cell of the transport."""
    yield from strip_cases()
    yield from matrix_cases()


def exact_transport(
    eye: wm.Observer, strips: wm.Card, brdf: wm.GaussianTrain, weights: str, view: int, pixel: int, element: int
) -> mpmath.mpf:
    """One entry of F at DIGITS digits: composite Gauss-Legendre over pixel and strip, the heights in closed form."""
    mp = mpmath
    x_o, y_o = (mp.mpf(v) for v in eye.position)
    z = mp.mpf(strips.distance)
    angle = mp.mpf(eye.view_angles[view])
    half_pixel = mp.mpf(pixel_half_width(eye)) if weights == "physical" else mp.mpf(0)
    half_strip = mp.mpf(strips.element_width) / 2 if weights == "physical" else mp.mpf(0)
    centre_t, centre_x = mp.mpf(float(pixel_tangents(eye)[pixel])), mp.mpf(strips.elements_x[element])
    half_height = mp.mpf(strips.element_height) / 2
    sigma = mp.mpf(brdf.sigma)

    def value(t: mpmath.mpf, x_s: mpmath.mpf) -> mpmath.mpf:
        x_w = x_o + y_o * mp.tan(angle - mp.atan(t))
        theta_s, theta_o = mp.atan2(x_s - x_w, z), mp.atan2(x_o - x_w, -y_o)
        u = theta_s + theta_o
        rho = mp.fsum(mp.exp(-(((u - mp.mpf(c)) / sigma) ** 2) / 2) for c in brdf.centres)
        if weights == "thesis":
            return rho
        if weights == "cosine":
            return rho * mp.cos(theta_s)
        a = mp.hypot(z, x_s - x_w)
        if strips.is_points:
            return rho * z**2 / a**4
        reach = half_pixel * -y_o / (mp.cos(angle) + t * mp.sin(angle))

        def integral(h: mpmath.mpf) -> mpmath.mpf:
            return z**2 * h * mp.atan(h / a) / (2 * a**3)

        def first(h: mpmath.mpf) -> mpmath.mpf:
            return z**2 * (h / (2 * a**2 * (a**2 + h**2)) + mp.atan(h / a) / (2 * a**3))

        if reach == 0:
            factor = 2 * first(half_height)
        else:
            factor = (integral(half_height + reach) - integral(half_height - reach)) / reach
        return rho * factor * 2 * half_strip

    t_nodes = list(_nodes(half_pixel, centre_t, _turn(eye, strips, sigma)))
    x_nodes = list(_nodes(half_strip, centre_x, float(2 * half_strip / (z * sigma))))
    return mp.fsum(wt * wx * value(t, x) for t, wt in t_nodes for x, wx in x_nodes)


def _turn(eye: wm.Observer, strips: wm.Card, sigma: mpmath.mpf) -> float:
    """How many lobe widths a pixel spans in u, at most."""
    half = pixel_half_width(eye)
    return float(2 * half * (1 + eye.distance / strips.distance) / sigma)


def _nodes(half: mpmath.mpf, centre: mpmath.mpf, widths: float) -> Iterator[tuple[mpmath.mpf, mpmath.mpf]]:
    """Nodes and weights of an average over [centre - half, centre + half], in panels of at most one lobe width."""
    if half == 0:
        yield centre, mpmath.mpf(1)
        return
    panels = max(1, min(40, math.ceil(widths)))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for panel in range(panels):
        middle = centre + half * (2 * panel + 1 - panels) / panels
        for node, weight in zip(nodes, weights, strict=True):
            yield middle + half / panels * mpmath.mpf(float(node)), mpmath.mpf(float(weight)) / (2 * panels)


def transport_check(
    weights: str, eye: wm.Observer, strips: wm.Card, brdf: wm.GaussianTrain
) -> Callable[[], tuple[float, float]]:
    """Five entries of F against mpmath, relative to the largest entry; asked to 1e-9 by `tolerance`."""

    def check() -> tuple[float, float]:
        found = wm.transport_matrix(eye, strips, brdf, weights=weights, tolerance=1e-9)  # type: ignore[arg-type]
        if not np.all(np.isfinite(found)):
            return math.nan, 1e-9
        brightest = np.unravel_index(int(np.argmax(found)), found.shape)
        last = tuple(size - 1 for size in found.shape)
        places = {tuple(int(i) for i in brightest), (0, 0, 0), last, tuple(size // 2 for size in found.shape)}
        # The mean over heights is a difference of integrals, of which a low strip leaves few digits.
        lost = -math.log10(min(1.0, strips.element_height)) if strips.element_height else 0.0
        with mpmath.workdps(DIGITS + round(2 * lost)):
            off = [abs(mpmath.mpf(float(found[p])) - exact_transport(eye, strips, brdf, weights, *p)) for p in places]
        largest = float(found.max())
        # An angle is known to its rounding, which a narrow lobe magnifies: a few eps of pi over its width.
        rounding = 8 * np.finfo(float).eps * math.pi / brdf.sigma
        return (float(max(off)) / largest if largest > 0 else float(max(off))), 4e-9 + rounding

    return check


def matrix_cases() -> Iterator[Case]:
    def each(
        quantity: str, value: str, make: Callable[[], tuple[wm.Observer, wm.Card, wm.GaussianTrain]]
    ) -> Iterator[Case]:
        for weights in ("thesis", "cosine", "physical"):

            def check(weights: str = weights) -> tuple[float, float]:
                return transport_check(weights, *make())()

            yield Case(f"transport_matrix, {weights}", quantity, value, check)

    for degrees in (0.0, 45.0, 59.0, 59.9, 59.999, 60.0, 90.0):
        yield from each("view angle", f"{degrees:g}°", lambda d=degrees: (
            observer(view_angles=(math.radians(d),)), card(), lobes()))  # fmt: skip
    for degrees in (1e-6, 1e-3, 1.0, 120.0, 179.0, 179.999, 180.0):
        yield from each("field of view", f"{degrees:g}°", lambda d=degrees: (
            observer(fov=math.radians(d), view_angles=(0.0,)), card(), lobes()))  # fmt: skip
    for metres in (1e-300, 1e-6, 1e-3, 1e3, 1e8, 1e300, 0.0):
        yield from each("observer's distance", f"{metres:g} m", lambda m=metres: (
            observer(position=(0.0, -m)), card(), lobes()))  # fmt: skip
        yield from each("card's distance", f"{metres:g} m", lambda m=metres: (observer(), card(y=-m), lobes()))
        yield from each("whole scene", f"x {metres:g}", lambda m=metres: (
            observer(position=(0.0, -5 * m)),
            card(elements_x=(-m, 0.2 * m, 1.1 * m), y=-m, element_width=0.02 * m, element_height=0.03 * m),
            lobes()))  # fmt: skip
    for metres in (1e-300, 1e-9, 1e-3, 0.5, 1.0, 1e3):
        yield from each("strip's width", f"{metres:g} m", lambda m=metres: (
            observer(), card(elements_x=(0.0,), element_width=m), lobes()))  # fmt: skip
        yield from each(
            "strip's height", f"{metres:g} m", lambda m=metres: (observer(), card(element_height=m), lobes())
        )
    for degrees in (1e-6, 1e-3, 0.1, 1.0, 30.0, 90.0, 1e3):
        yield from each("lobe's width", f"{degrees:g}°", lambda d=degrees: (observer(), card(), lobes(d)))
    for number in (1, 2, 20_000):
        yield from each("pixels N", str(number), lambda n=number: (observer(pixels=n), card(), lobes(30.0)))
        yield from each("views A", str(number), lambda n=number: (
            observer(pixels=2, view_angles=tuple(np.linspace(0.5, -0.5, n))), card(), lobes(30.0)))  # fmt: skip
    for number in (1, 2, 5_000):
        yield from each("elements M", str(number), lambda n=number: (
            observer(pixels=8), card(elements_x=tuple(np.linspace(-50, 50, n)), element_width=0.01), lobes(30.0)))  # fmt: skip
    for apart in (0.0, 1e-300, 1e-12):
        yield from each("elements apart", f"{apart:g} m", lambda d=apart: (
            observer(), card(elements_x=(0.0, d, 1.0), element_width=0.0, element_height=0.0), lobes()))  # fmt: skip


def strip_cases() -> Iterator[Case]:
    """A strip's weight in closed form; a few eps, as no cancellation is left in it."""
    for distance in (1e-100, 1e-6, 1.0, 1e8, 1e100):
        for dx in (0.0, 1e-6, 1.0, 1e8):
            for height in (1e-300, 1e-9, 1.0, 1e9):

                def factor(z: float = distance, x: float = dx, h: float = height) -> tuple[float, float]:
                    found = float(strip_factor(z, x, -h, h))
                    with mpmath.workdps(DIGITS):
                        m, a = mpmath.mpf, mpmath.hypot(z, x)
                        exact = m(z) ** 2 * (m(h) / (a**2 * (a**2 + m(h) ** 2)) + mpmath.atan(m(h) / a) / a**3)
                        if exact < mpmath.mpf("1e-300") or exact > mpmath.mpf("1e300"):
                            return (0.0 if found < 1e-290 or found > 1e290 else 1.0), 0.5
                        return float(abs(m(found) - exact) / exact), 32 * EPS

                yield Case("strip_factor", "distance, offset, height", f"{distance:g}, {dx:g}, {height:g} m", factor)
