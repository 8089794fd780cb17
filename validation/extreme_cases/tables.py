"""Reflectance in tables, and what `audit` and `directional_albedo` measure, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import mpmath
import numpy as np

import wallmirror as wm

from .harness import DIGITS, EPS, Case, must_refuse, off


def cases() -> Iterator[Case]:
    """Every cell of tables and measurements."""
    yield from table_cases()
    yield from tabulate_cases()
    yield from albedo_cases()
    yield from audit_cases()


def table_cases() -> Iterator[Case]:
    """Linear interpolation in rational arithmetic: between two nodes it is (1 - t) a + t b."""
    for size in (1e-310, 1e-300, 1.0, 1e300, 1.7e308):
        denormal = 1e-13 if size < 1e-308 else 0.0  # what is left of a denormal's digits
        for start, stop in ((-math.pi, math.pi), (0.0, 1e-12), (0.1, 0.1 + 1e-9), (-400.0, 400.0)):

            def line(z: float = size, a: float = start, b: float = stop, d: float = denormal) -> tuple[float, float]:
                values = z * np.array([0.25, 1.0, 0.0])
                table = wm.AngleSumTable(start=a, stop=b, values=values)
                with mpmath.workdps(DIGITS):
                    left, right = mpmath.mpf(a), mpmath.mpf(b)
                    u = [float(left + (right - left) * t) for t in (0.0, 0.1, 0.5, 0.9, 1.0)]
                    exact = [float(_between([mpmath.mpf(float(v)) for v in values], 2 * (v - left) / (right - left)))
                             for v in u]  # fmt: skip
                # A node is known to eps of itself, which a narrow cell magnifies.
                allowed = 8 * EPS * (1 + max(abs(a), abs(b)) / (b - a)) + d
                return off(table.of_sum([*u, a - 1, b + 1]), [*exact, 0.0, 0.0]), allowed

            yield Case("AngleSumTable", "value, first and last node", f"{size:g}, {start:g}, {stop:g}", line)

        def plane(z: float = size, d: float = denormal) -> tuple[float, float]:
            values = z * np.array([[0.25, 1.0], [0.5, 0.0], [1.0, 1.0]])
            table = wm.Table(values=values)
            half = math.pi / 2
            s, o = [-half, 0.0, half, half / 2, -half / 2], [-half, 0.3, half, -half, half]
            with mpmath.workdps(DIGITS):
                rows = [[mpmath.mpf(float(v)) for v in row] for row in values]
                exact = []
                for a, b in zip(s, o, strict=True):
                    place = [_between(row, (mpmath.mpf(b) / (2 * half) + 0.5)) for row in rows]
                    exact.append(float(_between(place, 2 * (mpmath.mpf(a) / (2 * half) + 0.5))))
            return off(table(s, o), exact), 8 * EPS + d

        yield Case("Table", "value", f"{size:g}", plane)
    for name, make in (
        ("AngleSumTable", lambda v: wm.AngleSumTable(start=0.0, stop=1.0, values=v)),
        ("Table", lambda v: wm.Table(values=[v, v])),
    ):
        for given in ([1.0], [], [1.0, -1e-300], [1.0, math.nan], [1.0, math.inf]):
            yield Case(name, "values", str(given), must_refuse(lambda m=make, g=given: m(g)))
        for kind in (np.float32, np.float16):
            yield Case(name, "values' type", kind.__name__, lambda m=make, k=kind: (
                off(m(np.array([0.1, 0.7]).astype(k)).values.ravel()[:2], np.array([0.1, 0.7]).astype(k)), 0.0))  # fmt: skip
    ends = ((0.0, 5e-324), (1.0, 1.0), (1.0, 0.0), (1.0, math.nextafter(1, 2)), (-1e308, 1e308), (0.0, math.inf),
            (math.nan, 1.0))  # fmt: skip
    for start, stop in ends:
        yield Case("AngleSumTable", "first and last node", f"{start!r}, {stop!r}", must_refuse(
            lambda a=start, b=stop: wm.AngleSumTable(start=a, stop=b, values=[1.0, 2.0, 3.0])))  # fmt: skip


def _between(values: list[mpmath.mpf], place: mpmath.mpf) -> mpmath.mpf:
    """The broken line through values at 0, 1, ..."""
    i = min(max(int(mpmath.floor(place)), 0), len(values) - 2)
    part = place - i
    return values[i] * (1 - part) + values[i + 1] * part


def tabulate_cases() -> Iterator[Case]:
    """Tables of a lobe, whose interpolant is off by h^2 / 8 of its curvature."""
    for nodes in (2, 3, 7201, 1_000_001):

        def sampled(n: int = nodes) -> tuple[float, float]:
            table = wm.tabulate(wm.GaussianTrain(centres=(0.0,), sigma=0.5), n)
            u = np.linspace(-math.pi, math.pi, 97)
            step = 2 * math.pi / (n - 1)
            curvature = 1 / 0.5**2  # at the peak; the third derivative only lowers it beside the peak
            exact = np.exp(-0.5 * (u / 0.5) ** 2)
            return float(np.max(np.abs(table.of_sum(u) - exact))), min(1.0, step**2 / 8 * curvature + 2**-23)

        yield Case("tabulate", "nodes", str(nodes), sampled)
    for nodes in (-1, 0, 1, 10**15):
        yield Case("tabulate", "nodes", str(nodes), must_refuse(lambda n=nodes: wm.tabulate(wm.Diffuse(), n)))
    for scale in (1e-310, 1e-44, 1e-36, 1.0, 1e36, 1e300):

        def float32(s: float = scale) -> tuple[float, float]:
            found = wm.tabulate(wm.GaussianTrain(centres=(0.0,), sigma=0.5, scale=s), 9)
            exact = s * np.exp(-0.5 * (np.linspace(-math.pi, math.pi, 9) / 0.5) ** 2)
            return off(found.values, exact), 2.0**-24

        yield Case("tabulate", "scale", f"{scale:g}", float32)
    for name, call in (
        ("tabulate", lambda b: wm.tabulate(b)),
        ("tabulate_to", lambda b: wm.tabulate_to(b)),
    ):
        yield Case(name, "model", "a mirror", must_refuse(lambda c=call: c(wm.Mirror())))
    yield Case("tabulate", "model", "of two angles", must_refuse(lambda: wm.tabulate(wm.CookTorrance())))  # type: ignore[arg-type]
    for sigma in (1e-12, 1e-5, 1e-3, 0.5, 1e6):
        for scale in (1e-300, 1.0, 1e300):

            def to(w: float = sigma, s: float = scale) -> tuple[float, float]:
                brdf = wm.GaussianTrain(centres=(0.3,), sigma=w, scale=s)
                found = wm.tabulate_to(brdf, 1e-3)
                u = 0.3 + w * np.linspace(-5, 5, 41) if w < 0.5 else np.linspace(-3, 3, 41)
                exact = s * np.exp(-0.5 * ((u - 0.3) / w) ** 2)
                # What was found in the middles is what the tolerance is about; elsewhere it may be a little more.
                return off(found.table(u / 2, u / 2), exact), 1.5e-3

            yield Case("tabulate_to", "lobe's width, scale", f"{sigma:g} rad, {scale:g}", to)
    yield Case("tabulate_to", "scale", "0", lambda: (
        wm.tabulate_to(wm.GaussianTrain(centres=(0.0,), sigma=0.5, scale=0.0)).error, 0.0))  # fmt: skip
    for tolerance in (0.0, -1.0, 1e-12, 2.0, math.nan):
        yield Case("tabulate_to", "tolerance", f"{tolerance:g}", must_refuse(
            lambda t=tolerance: wm.tabulate_to(wm.Phong(), t)))  # fmt: skip


def albedo_cases() -> Iterator[Case]:
    """(pi/2) int rho(i + o) cos o do in closed form: a diffuse wall and Phong's lobe at normal incidence; others by mpmath."""
    for angle in (0.0, 1e-300, 0.5, math.radians(89.999), math.pi / 2, -math.pi / 2):
        yield Case("directional_albedo", "incidence on a diffuse wall", f"{math.degrees(angle):.6g}°", lambda a=angle: (
            off(wm.directional_albedo(wm.Diffuse(albedo=0.7), a), 0.7), 1e-12))  # fmt: skip
        for sigma in (1e-5, 1e-3, 0.3, 1e6):

            def lobe(a: float = angle, w: float = sigma) -> tuple[float, float]:
                found = wm.directional_albedo(wm.GaussianTrain(centres=(0.0,), sigma=w), a)
                with mpmath.workdps(30):
                    half = mpmath.pi / 2
                    # Over the lobe alone where it is narrow; what lies 12 widths off is below 1e-31.
                    low, high = max(-half, -mpmath.mpf(a) - 12 * w), min(half, -mpmath.mpf(a) + 12 * w)
                    points = [low + (high - low) * t / 8 for t in range(9)]
                    exact = half * mpmath.quad(
                        lambda o: mpmath.exp(-(((o + a) / w) ** 2) / 2) * mpmath.cos(o), points)  # fmt: skip
                # A panel as wide as the lobe has four nodes: 1e-6 of a lobe's integral.
                return abs(found - float(exact)) / min(1.0, 4 * w), 1e-6

            yield Case(
                "directional_albedo", "incidence, lobe's width", f"{math.degrees(angle):.6g}°, {sigma:g} rad", lobe
            )
    for exponent in (0.0, 1.0, 1e3, 1e8):
        for name, brdf in (("Phong", wm.Phong(exponent=exponent)), ("Blinn", wm.Blinn(exponent=exponent))):
            # Conserving: the share at normal incidence is the reflectance, 1/2. A lobe of exponent 0 is cut at 90 deg.
            yield Case("directional_albedo", f"{name}'s exponent", f"{exponent:g}", lambda b=brdf: (
                abs(wm.directional_albedo(b) - 0.5), 1e-6))  # fmt: skip
    for scale in (1e-310, 1e-300, 1e300):
        yield Case("directional_albedo", "scale", f"{scale:g}", lambda s=scale: (
            off(wm.directional_albedo(wm.GaussianTrain(centres=(0.0,), sigma=0.3, scale=s)),
                s * wm.directional_albedo(wm.GaussianTrain(centres=(0.0,), sigma=0.3))), 1e-12))  # fmt: skip
    for angle in (1.6, math.pi, math.nan, math.inf):
        yield Case("directional_albedo", "incidence", f"{angle:g}", must_refuse(
            lambda a=angle: wm.directional_albedo(wm.Diffuse(), a)))  # fmt: skip
        yield Case("directional_albedo", "incidence on a mirror", f"{angle:g}", must_refuse(
            lambda a=angle: wm.directional_albedo(wm.Mirror(), a)))  # fmt: skip
    yield Case("directional_albedo", "lobe's width", "1e-12 rad", must_refuse(
        lambda: wm.directional_albedo(wm.GaussianTrain(centres=(0.0,), sigma=1e-12))))  # fmt: skip


def audit_cases() -> Iterator[Case]:
    """What an audit must find: the sign, the reciprocity and the largest share of light, up to its tolerance."""

    def expect(make: Callable[[], wm.BRDF], energy: float | None, passed: bool) -> Callable[[], tuple[float, float]]:
        def check() -> tuple[float, float]:
            found = wm.audit(make())
            numbers = [f.value for f in (found.non_negativity, found.reciprocity, found.energy)]
            if not all(map(math.isfinite, numbers)):
                return math.nan, 0.0
            if found.passed != passed:
                return 1.0, 0.5
            return (abs(found.energy.value - energy) / max(1.0, energy) if energy is not None else 0.0), 1e-6

        return check

    for albedo in (0.0, 1e-300, 1.0):
        yield Case("audit", "albedo", f"{albedo:g}", expect(lambda a=albedo: wm.Diffuse(albedo=a), albedo, True))
        yield Case("audit", "mirror's share", f"{albedo:g}", expect(
            lambda a=albedo: wm.Mirror(reflectance=a), albedo, True))  # fmt: skip
    with mpmath.workdps(30):  # what a lobe of height 1 reflects at normal incidence, where it is most
        half = mpmath.pi / 2
        lobe = mpmath.quad(lambda o: mpmath.exp(-((o / mpmath.mpf(0.2)) ** 2) / 2) * mpmath.cos(o), [-half, 0, half])
        share = float(half * lobe)
    for scale in (1e-310, 1e-300, 1e-3, 1.0, 1e300):

        def lobe_of(s: float = scale) -> wm.BRDF:
            return wm.GaussianTrain(centres=(0.0,), sigma=0.2, scale=s)

        yield Case("audit", "scale", f"{scale:g}", expect(lobe_of, scale * share, scale * share <= 1))
    for exponent in (0.0, 1e3, 1e8):
        yield Case("audit", "Phong's exponent", f"{exponent:g}", expect(
            lambda n=exponent: wm.Phong(exponent=n, reflectance=1.0), 1.0, True))  # fmt: skip
    for alpha in (1e-3, 0.2, 1.0):
        yield Case("audit", "Cook and Torrance's alpha", f"{alpha:g}", expect(
            lambda a=alpha: wm.CookTorrance(alpha=a), None, True))  # fmt: skip
    yield Case(
        "audit", "table", "two nodes", expect(lambda: wm.Table(values=[[0.1, 0.1], [0.1, 0.1]]), 0.1 * math.pi, True)
    )
    yield Case(
        "audit", "table", "too bright", expect(lambda: wm.Table(values=[[1.0, 1.0], [1.0, 1.0]]), math.pi, False)
    )
    yield Case(
        "audit", "table", "not reciprocal", expect(lambda: wm.Table(values=[[0.1, 0.2], [0.1, 0.1]]), None, False)
    )
    yield Case("audit", "lobe's width", "1e-12 rad", must_refuse(
        lambda: wm.audit(wm.GaussianTrain(centres=(0.0,), sigma=1e-12))))  # fmt: skip
    for tolerance in (-1.0, 2.0, math.nan, math.inf):
        yield Case("audit", "tolerance", f"{tolerance:g}", must_refuse(
            lambda t=tolerance: wm.audit(wm.Diffuse(), tolerance=t)))  # fmt: skip
