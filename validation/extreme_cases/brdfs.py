"""Reflectances against mpmath at 50 digits, at angles up to the horizon."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm

from .harness import DIGITS, EPS, Case, must_refuse, off, off_relative

#: Angles from grazing to grazing, the horizon as float64 and as float32 round it, and the float16 below it.
ANGLES = np.array([0.0, 1e-300, 1e-8, 0.3, -0.7, 1.2, 1.5707, -math.pi / 2, math.pi / 2])
PAIRS = tuple((float(s), float(o)) for s in ANGLES for o in ANGLES)


def cases() -> Iterator[Case]:
    """Every cell of the reflectances."""
    yield from lobe_cases()
    yield from fresnel_cases()
    yield from facet_cases()
    yield from sum_cases()
    yield from input_cases()


def lobe_cases() -> Iterator[Case]:
    """Lobes of the angle sum, off by a few eps of their peak: an exponent is known to eps of itself."""
    for sigma in (1e-320, 1e-12, 1e-3, 1.0, 90.0, 1e6):

        def lobe(s: float = sigma) -> tuple[float, float]:
            brdf = wm.GaussianTrain(centres=(0.0,), sigma=math.radians(s))
            u = np.radians(s) * np.array([0.0, 0.5, 1.0, 6.0, 30.0, 1e6])
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.exp(-((mpmath.mpf(float(v)) / mpmath.mpf(brdf.sigma)) ** 2) / 2)) for v in u]
            return float(np.max(np.abs(brdf.of_sum(u) - exact))), 8 * EPS

        yield Case("GaussianTrain", "lobe's width", f"{sigma:g}°", lobe)
    for scale in (0.0, 1e-310, 1e-300, 1e300, 1e308, math.inf, math.nan, -1.0):

        def scaled(s: float = scale) -> tuple[float, float]:
            brdf = wm.GaussianTrain(centres=(0.0, 0.0, 0.1), sigma=0.1, scale=s)
            u = np.array([0.0, 0.05, 0.2])
            with mpmath.workdps(DIGITS):
                exact = [s * sum(mpmath.exp(-((mpmath.mpf(float(v)) - mpmath.mpf(c)) ** 2) / mpmath.mpf(0.1) ** 2 / 2)
                                 for c in brdf.centres) for v in u]  # fmt: skip
                return off(brdf.of_sum(u), [float(e) for e in exact]), 8 * EPS + (1e-13 if 0 < s < 1e-308 else 0.0)

        yield Case("GaussianTrain", "scale", f"{scale:g}", scaled)
    for exponent in (0.0, 1e-320, 1e-12, 1.0, 64.0, 65.0, 1e3, 1e8, 1e9):
        yield Case("Phong", "exponent", f"{exponent:g}", lambda n=exponent: _phong(n))
        yield Case("Blinn", "exponent", f"{exponent:g}", lambda n=exponent: _blinn(n))
        yield Case("PhongIllumination", "exponent", f"{exponent:g}", lambda n=exponent: _phong_illumination(n))
    makers: tuple[tuple[str, Callable[[float], wm.BRDF]], ...] = (
        ("Phong", lambda r: wm.Phong(reflectance=r)),
        ("Blinn", lambda r: wm.Blinn(reflectance=r)),
        ("PhongIllumination", lambda r: wm.PhongIllumination(specular=r)),
        ("Diffuse", lambda r: wm.Diffuse(albedo=r)),
    )
    for name, make in makers:
        at_one = make(1.0)
        for share in (0.0, 1e-310, 1e-300, 1e-3, 1.0):
            # A share is a factor; what is denormal has 14 digits and fewer.
            yield Case(name, "reflectance", f"{share:g}", lambda m=make, r=share, one=at_one: (
                off(m(r)(0.2, -0.1), r * one(0.2, -0.1)), 4 * EPS + (1e-13 if 0 < r < 1e-308 else 0.0)))  # fmt: skip
        for share in (1.0 + 1e-9, 2.0, -1e-300, math.nan, math.inf):
            yield Case(name, "reflectance", f"{share:.12g}", must_refuse(lambda m=make, r=share: m(r)))
    for share in (-1e-300, 1.1, math.nan):
        yield Case("Mirror", "reflectance", f"{share:g}", must_refuse(lambda r=share: wm.Mirror(reflectance=r)))
    yield Case("Mirror", "values", "at an angle", must_refuse(lambda: wm.Mirror()(0.0, 0.0)))


def _phong(n: float) -> tuple[float, float]:
    brdf = wm.Phong(exponent=n, reflectance=1.0)
    u = np.array([0.0, 1e-4, 0.1, 1.5, 1.57079632, math.pi / 2])
    with mpmath.workdps(DIGITS):
        peak = 2 / mpmath.pi / mpmath.beta(mpmath.mpf(n) / 2 + 1, mpmath.mpf(1) / 2)
        exact = [float(peak * mpmath.cos(mpmath.mpf(float(v))) ** n) if v < math.pi / 2 else 0.0 for v in u]
    return float(np.max(np.abs(brdf.of_sum(u) - exact))) / float(peak), 48 * EPS


def _blinn(n: float) -> tuple[float, float]:
    brdf = wm.Blinn(exponent=n, reflectance=1.0)
    u = np.array([0.0, 1e-4, 0.1, 1.5, 3.1, math.pi])
    with mpmath.workdps(DIGITS):
        half, quarter = mpmath.mpf(1) / 2, mpmath.pi / 4

        def power(m: mpmath.mpf) -> mpmath.mpf:
            """int_0^(pi/4) cos^m = (x = sin^2) an incomplete beta function."""
            if m > 400:  # what lies beyond pi/4 is less than 2^-200
                return mpmath.beta(half, (m + 1) / 2) / 2
            return mpmath.betainc(half, (m + 1) / 2, 0, mpmath.sin(quarter) ** 2) / 2

        peak = 1 / (2 * mpmath.pi * (2 * power(mpmath.mpf(n) + 2) - power(mpmath.mpf(n))))
        exact = [float(peak * mpmath.cos(mpmath.mpf(float(v)) / 2) ** n) for v in u]
    return float(np.max(np.abs(brdf.of_sum(u) - exact))) / float(peak), 48 * EPS


def _phong_illumination(n: float) -> tuple[float, float]:
    brdf = wm.PhongIllumination(exponent=n, specular=1.0)
    with mpmath.workdps(DIGITS):
        exact = []
        for s, o in PAIRS:
            u = mpmath.mpf(s + o)
            front = abs(s + o) < math.pi / 2
            exact.append(mpmath.cos(u) ** n / mpmath.cos(mpmath.mpf(s)) if front else mpmath.mpf(0))
        found = [float(brdf(s, o)) for s, o in PAIRS]
        # Of each value itself, as it grows without bound; down to 1e-100, where a lobe's exponent has grown to 230.
        return off_relative(found, exact, floor=1e-100), 16 * EPS * (1 + min(n, 230.0))


def fresnel_cases() -> Iterator[Case]:
    """Fresnel's reflectance relative to itself, however small, and Schlick's."""
    cosines = np.array([0.0, 1e-300, 1e-8, 0.1, 0.5, 0.9, 1.0])
    for eta in (1e-3, 0.5, 1 - 1e-9, 1.0, math.nextafter(1, 2), 1 + 1e-9, 1.5, 1e3):
        for k in (0.0, 1e-300, 1e-6, 3.4, 1e3):

            def fresnel(n: float = eta, kappa: float = k) -> tuple[float, float]:
                found = wm.Fresnel(eta=n, k=kappa)(cosines)
                with mpmath.workdps(700 if 0 < kappa < 1e-100 else 40):
                    exact = [_fresnel(n, kappa, float(c)) for c in cosines]
                    return off_relative(found, exact), 64 * EPS

            yield Case("Fresnel", "eta, k", f"{eta:.10g}, {k:g}", fresnel)
    for name, eta, k in (("eta", 0.0, 0.0), ("eta", math.nan, 0.0), ("eta", math.inf, 0.0), ("k", 1.5, -1.0)):
        yield Case("Fresnel", name, f"{eta:g}, {k:g}", must_refuse(lambda n=eta, kappa=k: wm.Fresnel(eta=n, k=kappa)))
    for f0 in (0.0, 1e-300, 0.04, 1.0):

        def schlick(f: float = f0) -> tuple[float, float]:
            with mpmath.workdps(DIGITS):
                exact = [mpmath.mpf(f) + (1 - mpmath.mpf(f)) * (1 - mpmath.mpf(float(c))) ** 5 for c in cosines]
                return off_relative(wm.Schlick(f0=f)(cosines), exact), 16 * EPS

        yield Case("Schlick", "f0", f"{f0:g}", schlick)
    for f0 in (-1e-9, 1.1, math.nan):
        yield Case("Schlick", "f0", f"{f0:g}", must_refuse(lambda f=f0: wm.Schlick(f0=f)))


def _fresnel(eta: float, k: float, cosine: float) -> mpmath.mpf:
    n2 = mpmath.mpc(eta, k) ** 2
    c = mpmath.mpf(cosine)
    bent = mpmath.sqrt(n2 - (1 - c**2))
    if n2 == 1:  # no surface, which reflects nothing at any angle
        return mpmath.mpf(0)
    across = abs((c - bent) / (c + bent)) ** 2
    along = abs((n2 * c - bent) / (n2 * c + bent)) ** 2
    return (across + along) / 2


def facet_cases() -> Iterator[Case]:
    """Cook-Torrance from the textbook's quotients, which mpmath can form at grazing angles."""
    for distribution in ("ggx", "beckmann"):
        for facets in ("grooves", "isotropic"):
            for alpha in (1e-3, 0.03, 0.2, 1.0):

                def facet(d: str = distribution, f: str = facets, a: float = alpha) -> tuple[float, float]:
                    brdf = wm.CookTorrance(alpha=a, distribution=d, facets=f)  # type: ignore[arg-type]
                    with mpmath.workdps(DIGITS):
                        exact = [float(exact_cook_torrance(d, f, a, s, o)) for s, o in PAIRS]
                    found = [float(brdf(s, o)) for s, o in PAIRS]
                    # Relative to the value's lobe at that pair: its exponent, or the slope's square, over alpha.
                    return off(found, exact), 64 * EPS / a

                yield Case("CookTorrance", f"alpha, {distribution}, {facets}", f"{alpha:g}", facet)
    for alpha in (0.0, 1e-4, 1.1, math.nan, math.inf):
        yield Case("CookTorrance", "alpha", f"{alpha:g}", must_refuse(lambda a=alpha: wm.CookTorrance(alpha=a)))
    for eta in (1.0, 1 + 1e-9, 1e3):

        def indexed(n: float = eta) -> tuple[float, float]:
            brdf = wm.CookTorrance(alpha=0.2, fresnel=wm.Fresnel(eta=n))
            with mpmath.workdps(DIGITS):
                exact = [float(exact_cook_torrance("ggx", "grooves", 0.2, s, o, n)) for s, o in PAIRS]
            return off([float(brdf(s, o)) for s, o in PAIRS], exact), 512 * EPS

        yield Case("CookTorrance", "eta", f"{eta:.10g}", indexed)


def exact_cook_torrance(
    distribution: str, facets: str, alpha: float, s: float, o: float, eta: float = 1.5
) -> mpmath.mpf:
    """F D G1 G1 over the normalising cosines (Walter et al. 2007, eqs. 20, 25, 33 to 35), angles taken as exact."""
    mp = mpmath
    a, ts, to = mp.mpf(alpha), mp.mpf(s), mp.mpf(o)
    h, d = (ts + to) / 2, (ts - to) / 2
    cos_h, tan_h = mp.cos(h), mp.tan(h)
    fall = mp.exp(-((tan_h / a) ** 2)) if abs(tan_h / a) < 1e4 else mp.mpf(0)
    if distribution == "ggx":
        d2 = 1 / (mp.pi * a**2 * cos_h**4 * (1 + (tan_h / a) ** 2) ** 2)
        d1 = 1 / (2 * a * cos_h**3 * (1 + (tan_h / a) ** 2) ** mp.mpf("1.5"))
    else:
        d2, d1 = fall / (mp.pi * a**2 * cos_h**4), fall / (mp.sqrt(mp.pi) * a * cos_h**3)

    def masked(theta: mpmath.mpf) -> mpmath.mpf:
        slope = a * abs(mp.tan(theta))
        if slope == 0:
            return 1 / mp.cos(theta)
        if distribution == "ggx":
            lam = (mp.sqrt(1 + slope**2) - 1) / 2
        else:
            v = 1 / slope
            lam = mp.exp(-(v**2)) / (2 * v * mp.sqrt(mp.pi)) - mp.erfc(v) / 2 if v < 1e4 else mp.mpf(0)
        return 1 / ((1 + lam) * mp.cos(theta))

    fresnel = _fresnel(eta, 0.0, 0.0) if mp.cos(d) == 0 else _fresnel_mp(eta, mp.cos(d))
    shape = d1 * 2 / mp.pi * mp.cos(d) / 2 if facets == "grooves" else d2 / 4
    return fresnel * shape * masked(ts) * masked(to)


def _fresnel_mp(eta: float, cosine: mpmath.mpf) -> mpmath.mpf:
    n2 = mpmath.mpf(eta) ** 2
    if n2 == 1:
        return mpmath.mpf(0)
    bent = mpmath.sqrt(n2 - (1 - cosine**2))
    across = abs((cosine - bent) / (cosine + bent)) ** 2
    along = abs((n2 * cosine - bent) / (n2 * cosine + bent)) ** 2
    return (across + along) / 2


def sum_cases() -> Iterator[Case]:
    """Sums are what their parts say."""
    lobe, ground = wm.GaussianTrain(centres=(0.1,), sigma=0.2), wm.Diffuse(albedo=0.3)
    exact = 0.3 / math.pi + math.exp(-((0.3 - 0.1) ** 2) / 0.08)
    for number in (1, 2, 1000):
        parts: tuple[wm.AngleSumBRDF, ...] = (lobe, *(wm.Diffuse(albedo=0.3 / number) for _ in range(number)))
        yield Case("Sum", "parts", str(number + 1), lambda p=parts, n=number: (
            off(wm.Sum(parts=p)(0.2, 0.1), exact), (n + 8) * EPS))  # fmt: skip
        yield Case("GeneralSum", "parts", str(number + 1), lambda p=parts, n=number: (
            off(wm.GeneralSum(parts=p)(0.2, 0.1), exact), (n + 8) * EPS))  # fmt: skip
    for name, kind in (("Sum", wm.Sum), ("GeneralSum", wm.GeneralSum)):
        yield Case(name, "parts", "none", must_refuse(lambda k=kind: k(parts=())))
        yield Case(name, "parts", "a mirror", must_refuse(lambda k=kind: k(parts=(ground, wm.Mirror()))))


MODELS: tuple[tuple[str, wm.BRDF], ...] = (
    ("Diffuse", wm.Diffuse()),
    ("Phong", wm.Phong()),
    ("Blinn", wm.Blinn()),
    ("GaussianTrain", wm.GaussianTrain.of_the_code()),
    ("PhongIllumination", wm.PhongIllumination()),
    ("CookTorrance", wm.CookTorrance()),
    ("CookTorrance, beckmann", wm.CookTorrance(distribution="beckmann")),
    ("AngleSumTable", wm.AngleSumTable(start=-3.2, stop=3.2, values=np.linspace(1, 2, 65))),
    ("Table", wm.Table(values=np.arange(1.0, 26.0).reshape(5, 5))),
    ("Sum", wm.Sum(parts=(wm.Diffuse(), wm.Phong()))),
    ("GeneralSum", wm.GeneralSum(parts=(wm.Diffuse(), wm.CookTorrance()))),
)


def input_cases() -> Iterator[Case]:
    """Angles of every precision and form; a NaN among them may not become a number."""
    for name, brdf in MODELS:
        for kind in (np.float32, np.float16):

            def narrow(b: wm.BRDF = brdf, k: type = kind) -> tuple[float, float]:
                s, o = (np.array(values).astype(k) for values in ((0.0, 0.5, -1.2), (0.1, -0.4, 1.1)))
                found = b(s, o)
                if found.dtype != np.float64:
                    return math.nan, 0.0
                wide = [b(float(p), float(q)) for p, q in zip(s, o, strict=True)]
                return off(found, np.array(wide).ravel()), 4 * EPS

            yield Case(name, "angles' type", kind.__name__, narrow)
        yield Case(name, "angles' shape", "(2, 1) and (3,)", lambda b=brdf: (
            0.0 if b(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3) else 1.0, 0.5))  # fmt: skip
        yield Case(name, "angles' shape", "none of them", lambda b=brdf: (
            0.0 if b(np.zeros(0), np.zeros(0)).shape == (0,) else 1.0, 0.5))  # fmt: skip
        yield Case(name, "angle", "NaN", lambda b=brdf: (
            0.0 if _nan_kept(b) else 1.0, 0.5))  # fmt: skip


def _nan_kept(brdf: wm.BRDF) -> bool:
    """Whether a NaN among the angles stays one and leaves its neighbours alone."""
    clean: NDArray[np.float64] = brdf(np.array([0.1, 0.2]), np.array([0.0, -0.3]))
    for s, o in (((0.1, math.nan), (0.0, -0.3)), ((0.1, 0.2), (0.0, math.nan))):
        found = brdf(np.array(s), np.array(o))
        if found[0] != clean[0] or not math.isnan(found[1]):
            return False
    return True
