"""Where do the public functions break: every quantity at its extremes against every entry point.

    python validation/extremes.py [--entry NAME] [--out FOLDER]

A cell is right (the error stays below a tolerance that the reference states), refused (one sentence that names the field),
or a fault: a wrong number, a NaN, a warning of NumPy's, or any other exception. References are computed with mpmath at 50
digits, or are the truth that made the films; a solution is right if its pattern lies within five of its own error bars +
1e-6, or if it says itself that it is doubtful. Leaves results/extremes.json and EXTREMES.md, and leaves with 1 on a fault.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mpmath
import numpy as np

import wallmirror as wm
from wallmirror.convolution import angle_convolution, spherical_convolution
from wallmirror.files import write_atomically
from wallmirror.geometry import incident_angles, pixel_half_width, pixel_tangents
from wallmirror.jobs.validating_one import validate_scene
from wallmirror.quadrature import quadrature_order
from wallmirror.transport import strip_factor

HERE = Path(__file__).parent
DIGITS = 50
REFUSALS = (wm.InputError, wm.UndeterminedError)


@dataclass(frozen=True)
class Cell:
    """One quantity at one value, seen by one entry point."""

    entry: str
    quantity: str
    value: str
    outcome: str  # "right", "refused" or "fault"
    error: float | None
    tolerance: float | None
    words: str


@dataclass(frozen=True)
class Case:
    """What a cell runs: `check` returns the error and its tolerance, or raises."""

    entry: str
    quantity: str
    value: str
    check: Callable[[], tuple[float, float]]


def run(case: Case) -> Cell:
    """Run a cell with NumPy's warnings as errors."""
    name = (case.entry, case.quantity, case.value)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            error, tolerance = case.check()
    except REFUSALS as refusal:
        return Cell(*name, "refused", None, None, str(refusal))
    except Exception as failure:  # noqa: BLE001 - that is what the table is about
        return Cell(*name, "fault", None, None, f"{type(failure).__name__}: {failure}")
    if not math.isfinite(error):
        return Cell(*name, "fault", None, tolerance, "the result is not a number")
    if not error <= tolerance:
        return Cell(*name, "fault", error, tolerance, f"off by {error:.1e}, allowed {tolerance:.1e}")
    return Cell(*name, "right", error, tolerance, "")


# -- scenes -----------------------------------------------------------------------------------------------------


def observer(**changes: Any) -> wm.Observer:
    given = {"position": (0.0, -5.0), "fov": math.radians(60), "view_angles": (0.26, 0.0, -0.26), "pixels": 60}
    return wm.Observer(**{**given, **changes})


def card(**changes: Any) -> wm.Card:
    given = {"elements_x": (-1.0, 0.2, 1.1), "y": -1.0, "element_width": 0.02, "element_height": 0.03}
    return wm.Card(**{**given, **changes})


def lobes(sigma_deg: float = 5.0) -> wm.GaussianTrain:
    return wm.GaussianTrain(centres=(math.radians(-15), math.radians(15)), sigma=math.radians(sigma_deg))


# -- references -------------------------------------------------------------------------------------------------


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


# -- forward ----------------------------------------------------------------------------------------------------


def forward_cases() -> Iterator[Case]:
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


def formula_cases() -> Iterator[Case]:
    """Single formulas against mpmath at 50 digits; the tolerance is a few eps, as they have no cancellation left."""
    eps = float(np.finfo(float).eps)
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
                        return float(abs(m(found) - exact) / exact), 32 * eps

                yield Case("strip_factor", "distance, offset, height", f"{distance:g}, {dx:g}, {height:g} m", factor)

        def angle(z: float = distance) -> tuple[float, float]:
            x = np.array([0.0, 1e-300, 1e-6, 1.0, 1e8, 1e300])
            found = incident_angles(x, z, 0.0)
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.atan2(mpmath.mpf(float(v)), mpmath.mpf(z))) for v in x]
            return float(np.max(np.abs(found - exact))), 2 * eps

        yield Case("incident_angles", "distance", f"{distance:g} m", angle)
    for sigma in (1e-320, 1e-12, 1e-3, 1.0, 90.0, 1e6):

        def lobe(s: float = sigma) -> tuple[float, float]:
            brdf = wm.GaussianTrain(centres=(0.0,), sigma=math.radians(s))
            u = np.radians(s) * np.array([0.0, 0.5, 1.0, 6.0, 30.0, 1e6])
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.exp(-((mpmath.mpf(float(v)) / mpmath.mpf(brdf.sigma)) ** 2) / 2)) for v in u]
            # The exponent is known to eps of itself.
            return float(np.max(np.abs(brdf.of_sum(u) - exact))), 8 * eps

        yield Case("GaussianTrain", "lobe's width", f"{sigma:g}°", lobe)
    for exponent in (0.0, 1e-12, 1.0, 1e3, 1e8, 1e9):

        def phong(n: float = exponent) -> tuple[float, float]:
            brdf = wm.Phong(exponent=n, reflectance=1.0)
            u = np.array([0.0, 1e-4, 0.1, 1.5, math.pi / 2])
            with mpmath.workdps(DIGITS):
                peak = 2 / mpmath.pi / mpmath.beta(mpmath.mpf(n) / 2 + 1, mpmath.mpf(1) / 2)
                exact = [float(peak * mpmath.cos(mpmath.mpf(float(v))) ** n) if v < math.pi / 2 else 0.0 for v in u]
            scale = float(peak)
            # log cos u is known to eps of itself times n; the peak to the rounding of log gamma, n log n.
            allowed = eps * (8 + 2 * n * math.log(max(n, 2.0)))
            return float(np.max(np.abs(brdf.of_sum(u) - exact))) / scale, allowed

        yield Case("Phong", "exponent", f"{exponent:g}", phong)
    for width in (0.0, 1e-12, 1.0, 60.0, 400.0, 1e6):
        yield Case("quadrature_order", "span in lobe widths", f"{width:g}", lambda w=width: (
            0.0 if 1 <= quadrature_order(w, 1e-9) <= 256 else 1.0, 0.5))  # fmt: skip


# -- inverse ----------------------------------------------------------------------------------------------------


def films(
    *, realisations: int = 6, scale: float = 1.0, noise: float = 0.0, **changes: Any
) -> tuple[wm.CaptureSet, np.ndarray]:
    eye = changes.pop("observer", None) or observer(pixels=200, pixels_at="edges")
    strips = changes.pop("card", None) or card(element_width=0.0, element_height=0.0)
    source = np.random.default_rng(3).random((strips.elements, realisations))
    brdf = changes.pop("brdf", None) or lobes()
    clean = wm.radiance(wm.transport_matrix(eye, strips, brdf, weights="cosine"), source)
    clean = clean + noise * float(clean.max()) * np.random.default_rng(4).standard_normal(clean.shape)
    dtype = changes.pop("dtype", None)
    stored = (clean * scale) if dtype is None else (clean * scale).astype(dtype).astype(np.float64)
    captures = wm.CaptureSet(observer=eye, card=strips, transport="cosine", radiance=stored)
    return (replace(captures, **changes) if changes else captures), source


def solved(captures: wm.CaptureSet, source: np.ndarray, **options: Any) -> tuple[float, float]:
    """Error of the pattern and what it may be: five of its error bars + 1e-6, or all that a doubtful one admits."""
    found = wm.solve(captures, **options)
    for array in (found.source, found.brdf, found.transport, found.source_std):
        if np.any(np.isnan(array)):
            return math.nan, 0.0
    if found.verdict != "good":
        return 0.0, 1.0
    return wm.scale_free_error(found.source, source), 5 * found.predicted_error + 1e-6


def inverse_cases() -> Iterator[Case]:
    for power in (-300, -150, -10, 10, 150, 300):
        for noise in (0.0, 1e-3):

            def check(p: int = power, n: float = noise) -> tuple[float, float]:
                return solved(*films(scale=10.0**p, noise=n))

            yield Case("solve" + (", noisy" if noise else ""), "intensity", f"1e{power:+d}", check)
    yield Case("solve", "intensity", "denormal (1e-310)", lambda: solved(*films(scale=1e-310)))
    yield Case("solve", "intensity", "0", lambda: solved(*films(scale=0.0)))
    for name in ("float32", "float16"):
        yield Case("solve", "precision of the films", name, lambda d=name: solved(*films(dtype=d)))
    for number in (1, 2, 3, 200):
        yield Case("solve", "realisations B", str(number), lambda b=number: solved(*films(realisations=b)))
    for number in (1, 2, 6, 5000):
        yield Case("solve", "pixels N", str(number), lambda n=number: solved(
            *films(observer=observer(pixels=n, pixels_at="centres"))))  # fmt: skip
    for number in (1, 2, 12):
        yield Case("solve", "elements M", str(number), lambda m=number: solved(*films(
            card=card(elements_x=tuple(np.linspace(-1, 1, m)), element_width=0, element_height=0),
            realisations=m + 2)))  # fmt: skip
    for number in (1, 40):
        yield Case("solve", "views A", str(number), lambda a=number: solved(*films(
            observer=observer(view_angles=tuple(np.linspace(0.26, -0.26, a)) if a > 1 else (0.0,), pixels=200))))  # fmt: skip
    for apart in (0.0, 1e-12, 1e-3):
        yield Case("solve", "elements apart", f"{apart:g} m", lambda d=apart: solved(*films(
            card=card(elements_x=(-1.0, -1.0 + d, 1.0), element_width=0, element_height=0))))  # fmt: skip
    for metres in (1e-6, 1e-2, 1e2, 1e8):
        yield Case("solve", "card's distance", f"{metres:g} m", lambda m=metres: solved(*films(
            card=card(y=-m, element_width=0, element_height=0))))  # fmt: skip
        yield Case("solve", "observer's distance", f"{metres:g} m", lambda m=metres: solved(*films(
            observer=observer(position=(0.0, -m), pixels=200))))  # fmt: skip
    for degrees in (1e-3, 0.03, 0.3, 30.0, 90.0):
        yield Case("solve", "lobe's width", f"{degrees:g}°", lambda d=degrees: solved(*films(brdf=lobes(d))))
    for level in (0.0, 1e-320, 1e-300, 1e300, math.inf):

        def stated(v: float = level) -> tuple[float, float]:
            captures, source = films()
            return solved(replace(captures, variance=np.full(captures.radiance.shape, v)), source)

        yield Case("solve", "stated variance", f"{level:g}", stated)
    for level in (1.0, 1e3):
        yield Case("solve, noisy", "noise over signal", f"{level:g}", lambda n=level: solved(*films(noise=n)))

    def unseen(views: slice) -> tuple[float, float]:
        captures, source = films(noise=1e-3)
        variance = np.full(captures.radiance.shape, 1e-6 * float(captures.radiance.max()) ** 2)
        variance[views] = np.inf
        return solved(replace(captures, variance=variance), source)

    for name, views in (("of one view", slice(0, 1)), ("of all but one", slice(1, 3)), ("of all", slice(0, 3))):
        yield Case("solve, noisy", "weight 0", name, lambda v=views: unseen(v))
    for level in (0.0, 1e-300, 1e300, math.inf, math.nan, -1.0):

        def bound(v: float = level) -> tuple[float, float]:
            scene = card(element_width=0, element_height=0)
            found = wm.foresee(observer(), scene, lobes(), np.eye(3), noise=v, weights="cosine")
            return (math.nan if math.isnan(found.source_error) else 0.0), 1.0

        yield Case("foresee", "noise", f"{level:g}", bound)


def invariance_cases() -> Iterator[Case]:
    """What must not change: exactness under powers of two, orders and the mirror image."""

    def base() -> tuple[wm.CaptureSet, wm.Solution, np.ndarray]:
        captures, source = films()
        return captures, wm.solve(captures), source

    def scaled() -> tuple[float, float]:
        captures, found, _ = base()
        other = wm.solve(replace(captures, radiance=np.ldexp(captures.radiance, 200)))
        return float(np.max(np.abs(np.ldexp(other.source, -200) - found.source))), 0.0

    yield Case("solve", "radiance x 2^200", "exact", scaled)

    def gauge() -> tuple[float, float]:
        captures, found, source = base()
        brdf = replace(lobes(), scale=7.0)
        other = wm.radiance(wm.transport_matrix(captures.observer, captures.card, brdf, weights="cosine"), source / 7.0)
        again = wm.solve(replace(captures, radiance=other))
        # Another rounding of the same films: eps, magnified by the condition of the problem.
        return wm.scale_free_error(again.source, found.source), 1e-9

    yield Case("solve", "(7 rho, V / 7)", "the same", gauge)

    def mirrored() -> tuple[float, float]:
        captures, found, _ = base()
        flipped = replace(
            captures,
            observer=replace(captures.observer, view_angles=tuple(-a for a in captures.observer.view_angles)),
            card=replace(captures.card, elements_x=tuple(-x for x in captures.card.elements_x)),
            radiance=captures.radiance[:, ::-1],
        )
        other = wm.solve(flipped)
        return wm.scale_free_error(other.source, found.source), 1e-9

    yield Case("solve", "mirror image", "the same", mirrored)

    def shuffled(kind: str) -> tuple[float, float]:
        captures, found, _ = base()
        order = np.array([2, 0, 1])
        if kind == "views":
            angles = tuple(captures.observer.view_angles[i] for i in order)
            other = wm.solve(
                replace(
                    captures, observer=replace(captures.observer, view_angles=angles), radiance=captures.radiance[order]
                )
            )
            return wm.scale_free_error(other.source, found.source), 1e-9
        places = tuple(captures.card.elements_x[i] for i in order)
        other = wm.solve(replace(captures, card=replace(captures.card, elements_x=places)))
        return wm.scale_free_error(other.source, found.source[order]), 1e-9

    for kind in ("views", "elements"):
        yield Case("solve", f"order of {kind}", "the same", lambda k=kind: shuffled(k))


# -- convolutions -----------------------------------------------------------------------------------------------


def convolution_cases() -> Iterator[Case]:
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


# -- renders ----------------------------------------------------------------------------------------------------


def render_cases() -> Iterator[Case]:
    """Mitsuba against the model: right if no test rejects it and the gain is off by less than would have been seen."""

    def each(quantity: str, value: str, **changes: Any) -> Case:
        def check() -> tuple[float, float]:
            options = dict(changes)
            brdf = options.pop("brdf", lobes(15.0))
            level = options.pop("level", 1.0)
            eye = options.pop("observer", observer(pixels=24))
            strips = options.pop("card", card())
            wide = 4 * float(np.abs(wm.wall_points(eye)).max())
            scene = wm.Scene(
                name="extreme",
                title="",
                about="",
                observer=eye,
                card=strips,
                wall=wm.Wall(brdf=brdf, half_width=wide, half_height=wide),
                source=np.full((strips.elements, 1), level),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("default")  # those of the path tracer are not ours
                found = validate_scene(scene, views=3, spp=256)
            gain = found.comparison.gain
            if found.comparison.kept == 0:
                raise wm.UndeterminedError("every pixel shows a strip or an edge, so that nothing could be compared")
            # What the run could have seen is its tolerance; a run that would see nothing is no check.
            if not found.passed:
                raise RuntimeError(f"rejected: gain {gain.estimate:+.1e}, largest z {found.comparison.largest_z:.1f}")
            return (abs(gain.estimate) if gain.detectable < 0.5 else math.inf), max(gain.detectable, 1e-5)

        return Case("validate_scene", quantity, value, check)

    for factor in (1e-6, 1e-3, 1e3, 1e8):
        yield each("whole scene", f"x {factor:g}", observer=observer(position=(0.0, -5 * factor), pixels=24), card=card(
            elements_x=(-factor, 0.2 * factor, 1.1 * factor), y=-factor,
            element_width=0.02 * factor, element_height=0.03 * factor))  # fmt: skip
    for metres in (1e-6, 1e-4, 1e-2, 1e2, 1e4):
        yield each("card's distance", f"{metres:g} m", card=card(y=-metres))
    for level in (1e-300, 1e-36, 1e-30, 1e30, 1e37, 1e300):
        yield each("radiance", f"{level:g}", level=level)
    for degrees in (1e-3, 0.1, 1.0, 90.0):
        yield each("lobe's width", f"{degrees:g}°", brdf=lobes(degrees))
    for degrees in (45.0, 59.0, 59.9):
        yield each("view angle", f"{degrees:g}°", observer=observer(view_angles=(math.radians(degrees),), pixels=24))
    for number in (1, 2):
        yield each("pixels N", str(number), observer=observer(pixels=number))


# -- the table --------------------------------------------------------------------------------------------------


def all_cases() -> list[Case]:
    """Every cell, in the order of the page."""
    return [
        *formula_cases(),
        *forward_cases(),
        *convolution_cases(),
        *inverse_cases(),
        *invariance_cases(),
        *render_cases(),
    ]


def page(cells: list[Cell]) -> str:
    """The table by entry point and quantity."""
    marks = {"right": "✓", "refused": "refused", "fault": "**FAULT**"}
    lines = []
    entries = dict.fromkeys(cell.entry for cell in cells)
    for entry in entries:
        lines += [
            f"## `{entry}`",
            "",
            "| quantity | value | outcome | error (allowed), or the refusal |",
            "|---|---|---|---|",
        ]
        for c in (c for c in cells if c.entry == entry):
            told = c.words if c.error is None else f"{c.error:.1e} ({c.tolerance:.1e})"
            lines.append(f"| {c.quantity} | {c.value} | {marks[c.outcome]} | {told.replace('|', '/')} |")
        lines.append("")
    counted = {outcome: sum(c.outcome == outcome for c in cells) for outcome in marks}
    head = (
        f"# Extremes\n\n{len(cells)} cells: {counted['right']} right, {counted['refused']} refused with a sentence, "
        f"{counted['fault']} faults. Made by `python validation/extremes.py`; what each outcome means stands there.\n\n"
    )
    return head + "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entry", help="only entry points whose name begins so")
    parser.add_argument("--out", type=Path, default=HERE, help="folder for results/extremes.json and EXTREMES.md")
    arguments = parser.parse_args()
    started = time.perf_counter()
    cells = []
    for case in all_cases():
        if arguments.entry and not case.entry.startswith(arguments.entry):
            continue
        cells.append(run(case))
        if cells[-1].outcome == "fault":
            print(f"FAULT {case.entry}: {case.quantity} {case.value}: {cells[-1].words}", flush=True)
    faults = sum(cell.outcome == "fault" for cell in cells)
    print(f"{len(cells)} cells, {faults} faults, {time.perf_counter() - started:.0f} s")
    if not arguments.entry:
        document = json.dumps([asdict(cell) for cell in cells], indent=1, allow_nan=False) + "\n"
        write_atomically(arguments.out / "results" / "extremes.json", document)
        write_atomically(arguments.out / "EXTREMES.md", page(cells))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
