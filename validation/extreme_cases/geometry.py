"""Angles of the wall, the scene's fields, and the order of a quadrature, against mpmath at 50 digits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np

import wallmirror as wm
from wallmirror.geometry import incident_angles, outgoing_angles, pixel_tangents
from wallmirror.quadrature import quadrature_order

from .harness import DIGITS, EPS, Case, must_refuse, off, off_relative
from .scenes import card, observer


def cases() -> Iterator[Case]:
    """Single formulas; the tolerance is a few eps, as they have no cancellation left."""
    for distance in (1e-100, 1e-6, 1.0, 1e8, 1e100):

        def incident(z: float = distance) -> tuple[float, float]:
            x = np.array([0.0, 1e-300, 1e-6, 1.0, 1e8, 1e300])
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.atan2(mpmath.mpf(float(v)), mpmath.mpf(z))) for v in x]
            return float(np.max(np.abs(incident_angles(x, z, 0.0) - exact))), 2 * EPS

        def outgoing(z: float = distance) -> tuple[float, float]:
            x = np.array([0.0, 1e-300, 1e-6, 1.0, 1e8, 1e300])
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.atan2(-mpmath.mpf(float(v)), mpmath.mpf(z))) for v in x]
            return float(np.max(np.abs(outgoing_angles(observer(position=(0.0, -z)), x) - exact))), 2 * EPS

        yield Case("incident_angles", "distance", f"{distance:g} m", incident)
        yield Case("outgoing_angles", "distance", f"{distance:g} m", outgoing)
        for degrees in (0.0, 45.0, 59.0, 59.999, 59.999999):

            def seen(z: float = distance, d: float = degrees) -> tuple[float, float]:
                eye = observer(position=(0.0, -z), view_angles=(math.radians(d),))
                t = pixel_tangents(eye)
                with mpmath.workdps(DIGITS):
                    a = mpmath.tan(mpmath.mpf(eye.view_angles[0]))
                    exact = [-mpmath.mpf(z) * (a - mpmath.mpf(float(v))) / (1 + a * mpmath.mpf(float(v))) for v in t]
                    # A tangent near the horizon magnifies the rounding of its angle by 1 / cos, of one near 0 by 1 / sin.
                    last = float(max(abs(e) for e in exact)) / z
                    found = wm.wall_points(eye)[0]
                    return off(found, [float(e) for e in exact]), 4 * EPS * (1 + last)

            yield Case("wall_points", "view angle, distance", f"{degrees:.8g}°, {distance:g} m", seen)
    for field in (1e-6, 1e-3, 60.0, 179.0, 179.9999):

        def tangents(f: float = field) -> tuple[float, float]:
            eye = observer(fov=math.radians(f), view_angles=(0.0,), pixels=5)
            with mpmath.workdps(DIGITS):
                half = mpmath.tan(mpmath.mpf(eye.fov) / 2)
                exact = [half * (2 * (j + mpmath.mpf(1) / 2) / 5 - 1) for j in range(5)]
                # Rounding of the half angle over its distance from 90 deg.
                allowed = 8 * EPS * (1 + 1 / (math.pi / 2 - eye.fov / 2))
                return off_relative(pixel_tangents(eye)[[0, 1, 3, 4]], [exact[j] for j in (0, 1, 3, 4)]), allowed

        yield Case("pixel_tangents", "field of view", f"{field:g}°", tangents)
    for value in (math.nan, math.inf):
        yield Case(
            "wall_points", "tangent", f"{value}", must_refuse(lambda v=value: wm.wall_points(observer(), [0.0, v]))
        )
    yield from scan_cases()
    yield from field_cases()
    for width in (0.0, 1e-12, 1e-3, 1.0, 60.0, 400.0):

        def order(w: float = width) -> tuple[float, float]:
            n = quadrature_order(w, 1e-9)
            nodes, weights = np.polynomial.legendre.leggauss(n)
            missed = 0.0
            for centre in np.linspace(0.0, w / 2 + 3.0, 29):
                with mpmath.workdps(30):
                    low, high = (
                        mpmath.mpf(float(centre)) - mpmath.mpf(w) / 2,
                        mpmath.mpf(float(centre)) + mpmath.mpf(w) / 2,
                    )
                    exact = (
                        mpmath.sqrt(mpmath.pi / 2) * (mpmath.erf(high / mpmath.sqrt(2)) - mpmath.erf(low / mpmath.sqrt(2)))
                        / (high - low) if w > 0 else mpmath.exp(-mpmath.mpf(float(centre)) ** 2 / 2)
                    )  # fmt: skip
                found = float(np.exp(-0.5 * (centre + 0.5 * w * nodes) ** 2) @ (0.5 * weights))
                missed = max(missed, abs(found - float(exact)))
            # Lobes between those that it looked at may be missed by a little more.
            return missed, 2e-9

        yield Case("quadrature_order", "span in lobe widths", f"{width:g}", order)
    for width, tolerance in ((1e6, 1e-9), (1e300, 1e-9), (math.inf, 1e-9), (math.nan, 1e-9), (1.0, 0.0), (1.0, -1.0),
                             (1.0, math.nan)):  # fmt: skip
        yield Case("quadrature_order", "span, tolerance", f"{width:g}, {tolerance:g}", must_refuse(
            lambda w=width, t=tolerance: quadrature_order(w, t)))  # fmt: skip


def scan_cases() -> Iterator[Case]:
    """A scan is even and symmetric, and its outermost fields end where it does."""
    for views in (1, 2, 3, 20_000):
        for scan, field in ((math.pi / 2, math.pi / 3), (math.pi / 3, math.pi / 3), (1e-300, 1e-301), (3.1, 1e-9)):

            def even(n: int = views, s: float = scan, f: float = field) -> tuple[float, float]:
                angles = np.array(wm.scan_angles(n, scan=s, fov=f))
                exact = np.array([(s - f) / 2 * (1 - 2 * a / (n - 1)) for a in range(n)]) if n > 1 else np.zeros(1)
                return float(np.max(np.abs(angles - exact))) / s, 4 * EPS

            yield Case("scan_angles", "views, scan, field", f"{views}, {scan:g}, {field:g} rad", even)
    refusals: tuple[tuple[Any, float, float], ...] = (
        (0, 1.0, 0.5), (-1, 1.0, 0.5), (1.5, 1.0, 0.5), (10**15, 1.0, 0.5), (2, 0.5, 1.0), (2, math.nan, 0.5),
        (2, 1.0, math.nan), (2, math.inf, 1.0), (2, 1.0, -1.0), (2, 1.0, 0.0), (2, 4.0, 0.5),
    )  # fmt: skip
    for number, scan, field in refusals:
        yield Case("scan_angles", "views, scan, field", f"{number}, {scan:g}, {field:g}", must_refuse(
            lambda n=number, s=scan, f=field: wm.scan_angles(n, scan=s, fov=f)))  # fmt: skip


def field_cases() -> Iterator[Case]:
    """What a camera and a card cannot be."""
    cameras: tuple[dict[str, Any], ...] = (
        {"position": (math.nan, -5.0)}, {"position": (0.0, math.inf)}, {"position": (0.0, 0.0)}, {"position": (0.0, -1e-101)},
        {"position": (1e101, -5.0)}, {"fov": 0.0}, {"fov": math.nan}, {"fov": math.pi}, {"fov": -1.0}, {"fov": 5e-324},
        {"view_angles": ()}, {"view_angles": (math.nan,)}, {"view_angles": (math.pi / 3,)}, {"pixels": 0}, {"pixels": -1},
        {"pixels": 1.5}, {"pixels": math.nan}, {"pixels": math.inf}, {"pixels": 1, "pixels_at": "edges"},
        {"pixels_at": "middle"},
    )  # fmt: skip
    for changes in cameras:
        yield Case("Observer", *_told(changes), must_refuse(lambda c=changes: observer(**c)))
    cards: tuple[dict[str, Any], ...] = (
        {"elements_x": ()}, {"elements_x": (math.nan,)}, {"elements_x": (math.inf,)}, {"elements_x": (1e101,)}, {"y": 0.0},
        {"y": 1.0}, {"y": math.nan}, {"y": -1e-101}, {"y": -1e101}, {"element_width": math.nan}, {"element_width": -1.0},
        {"element_width": math.inf}, {"element_width": 0.0}, {"element_height": 0.0}, {"element_height": 1e101},
        {"albedo": 1.0}, {"albedo": -1e-9}, {"albedo": math.nan}, {"board_width": -1.0}, {"board_height": math.nan},
        {"elements_x": (0.0, 0.0)}, {"elements_x": (0.0, 0.019)},
    )  # fmt: skip
    for changes in cards:
        yield Case("Card", *_told(changes), must_refuse(lambda c=changes: card(**c)))
    for value in (0.0, -1.0, math.nan, math.inf, 1e101):
        for name in ("half_width", "half_height"):
            yield Case("Wall", name, f"{value:g}", must_refuse(
                lambda n=name, v=value: wm.Wall(brdf=wm.Diffuse(), **{n: v})))  # fmt: skip


def _told(changes: dict[str, Any]) -> tuple[str, str]:
    return ", ".join(changes), ", ".join(map(str, changes.values()))
