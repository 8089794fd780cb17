"""`compare` and its statistics: scales, scatter, counts and shapes at their ends.

References: the known bias and scatter that made the renders; Student's t at 30 digits by mpmath; exactness under powers of
two; and that a template test's amplitude is the least-squares one, in closed form for a single pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.comparison import cross_weights, detectable_gain

from .harness import DIGITS, EPS, Case, must_answer, must_refuse

Array = NDArray[np.float64]


def pictures(
    *,
    seeds: int = 16,
    views: int = 2,
    pixels: int = 40,
    level: float = 1.0,
    noise: float = 1e-3,
    gain: float = 0.0,
    draw: int = 0,
) -> tuple[Array, Array]:
    """Renders of known gain error and scatter, and their reference."""
    reference = level * (1.0 + 0.5 * np.sin(np.linspace(0, 6, views * pixels))).reshape(views, pixels)
    rng = np.random.default_rng((11, draw))
    return reference * (1 + gain + noise * rng.standard_normal((seeds, views, pixels))), reference


def student_p(t: float, freedom: int) -> mpmath.mpf:
    """Two-sided p-value of Student's t at DIGITS digits."""
    with mpmath.workdps(DIGITS):
        x = mpmath.mpf(freedom) / (freedom + mpmath.mpf(t) ** 2)
        return mpmath.betainc(mpmath.mpf(freedom) / 2, mpmath.mpf(1) / 2, 0, x, regularized=True)


def numbers(found: wm.Comparison) -> list[float]:
    """All that a verdict rests on; of a comparison of nothing the errors are infinite."""
    gain = found.gain
    return [
        gain.estimate,
        gain.p_value,
        found.z_mean,
        found.z_std,
        found.largest_z,
        found.largest_p,
        found.uniformity_p,
        found.relative_rms,
    ]


def gained(found: wm.Comparison, gain: float) -> tuple[float, float]:
    """The gain within five of its standard errors and what float32 may do, if nothing is NaN."""
    if not np.all(np.isfinite(numbers(found))) or np.any(np.isinf(found.z)):
        return math.nan, 0.0
    if math.isinf(found.gain.standard_error):  # nothing has a weight: what it says it would see is nothing
        return (0.0 if math.isinf(found.gain.detectable) else 1.0), 0.5
    return abs(found.gain.estimate - gain), 5 * found.gain.standard_error + 2e-7


def scale_cases() -> Iterator[Case]:
    for power in (-300, -150, 150, 300):
        for gain in (0.0, 1e-2):

            def scaled(p: int = power, g: float = gain) -> tuple[float, float]:
                found = wm.compare(*pictures(level=10.0**p, gain=g))
                if found.passed != (g == 0):
                    raise RuntimeError(f"passed: {found.passed} at a gain error of {g:g}")
                return gained(found, g)

            yield Case("compare", f"radiance, gain error {gain:g}", f"1e{power:+d}", must_answer(scaled))
    for power in (-1000, 900):

        def exact(p: int = power) -> tuple[float, float]:
            seeds, reference = pictures(gain=1e-3)
            plain, found = wm.compare(seeds, reference), wm.compare(np.ldexp(seeds, p), np.ldexp(reference, p))
            same = numbers(plain) == numbers(found) and np.array_equal(plain.z, found.z, equal_nan=True)
            return 0.0 if same else 1.0, 0.0

        yield Case("compare", f"radiance x 2^{power}", "exact", must_answer(exact))
    yield Case("compare", "radiance", "denormal (1e-310)", lambda: gained(wm.compare(*pictures(level=1e-310)), 0.0))

    def dark() -> tuple[float, float]:
        found = wm.compare(np.zeros((16, 2, 40)), np.zeros((2, 40)))
        return (1.0 if found.passed else 0.0), 0.5

    yield Case("compare", "radiance", "0", dark)

    def from_dark(value: float) -> tuple[float, float]:
        # Light where none is expected cannot pass, however faint or bright.
        found = wm.compare(np.full((16, 2, 40), value), np.zeros((2, 40)))
        return (1.0 if found.passed else 0.0), 0.5

    for value in (1e-300, 1.0, 1e300):
        yield Case("compare", "radiance where none is expected", f"{value:g}", lambda v=value: from_dark(v))
    for value in (math.nan, math.inf, -math.inf):
        for which in ("seeds", "reference"):

            def spoilt(v: float = value, w: str = which) -> wm.Comparison:
                seeds, reference = pictures()
                (seeds if w == "seeds" else reference)[..., 3] = v
                return wm.compare(seeds, reference)

            yield Case("compare", f"a pixel of the {which}", f"{value:g}", must_refuse(spoilt))
    for value in (1e300, -1e300, 1e-300, 0.0):

        def outlier(v: float = value) -> tuple[float, float]:
            seeds, reference = pictures()
            seeds[:, 0, 3] = v
            found = wm.compare(seeds, reference)
            return (1.0 if found.passed or not np.all(np.isfinite(numbers(found))) else 0.0), 0.5

        yield Case("compare", "a pixel of all renders", f"{value:g}", outlier)


def scatter_cases() -> Iterator[Case]:
    for noise in (0.0, 1e-300, 1e-16, 1e-8, 1e-5, 1.0, 1e3):

        def scattered(n: float = noise) -> tuple[float, float]:
            found = wm.compare(*pictures(noise=n))
            if not found.passed:
                raise RuntimeError("rejects the model that made the renders")
            return gained(found, 0.0)

        yield Case("compare", "scatter over radiance", f"{noise:g}", must_answer(scattered))

        def biased(n: float = noise) -> tuple[float, float]:
            found = wm.compare(*pictures(noise=n, gain=0.5))
            # Ten pixels' worth of seeds see half the light too much up to a scatter of a few times the light.
            if found.passed and n <= 1:
                raise RuntimeError("passes a gain error of 0.5")
            return gained(found, 0.5)

        yield Case("compare", "scatter over radiance, gain error 0.5", f"{noise:g}", must_answer(biased))
    for count in (0, 1, 2, 7):
        yield Case("compare", "seeds", str(count), must_refuse(lambda c=count: wm.compare(*pictures(seeds=c))))
    for count in (8, 5000):
        yield Case(
            "compare", "seeds", str(count), must_answer(lambda c=count: gained(wm.compare(*pictures(seeds=c)), 0.0))
        )
    for views, pixels in ((1, 1), (1, 2), (1, 9), (1, 10), (1, 100_000), (200, 1)):
        yield Case("compare", "views x pixels", f"{views} x {pixels}", must_answer(
            lambda a=views, n=pixels: gained(wm.compare(*pictures(views=a, pixels=n, seeds=8)), 0.0)))  # fmt: skip
    for shape in ((0, 5), (3, 0)):
        yield Case("compare", "views x pixels", "{} x {}".format(*shape), lambda s=shape: (
            (1.0 if wm.compare(np.zeros((8, *s)), np.zeros(s)).passed else 0.0), 0.5))  # fmt: skip

    def quiet_pixel() -> tuple[float, float]:
        seeds, reference = pictures()
        seeds[:, 0, 3] = reference[0, 3]
        found = wm.compare(seeds, reference)
        return (0.0 if found.passed and found.z[0, 3] == 0 else 1.0), 0.5

    yield Case("compare", "scatter of one pixel", "0", must_answer(quiet_pixel))

    def one_scatters() -> tuple[float, float]:
        seeds, reference = pictures(noise=0.0)
        seeds[:, 0, 3] *= 1 + 1e-3 * np.random.default_rng(1).standard_normal(16)
        return gained(wm.compare(seeds, reference), 0.0)

    yield Case("compare", "scatter of all but one pixel", "0", must_answer(one_scatters))
    for off in (0.0, 1e-6, 1e-4, 0.1, 10.0):

        def one_pixel(d: float = off) -> tuple[float, float]:
            seeds, reference = pictures(views=1, pixels=1, seeds=12, gain=d)
            found = wm.compare(seeds, reference)
            ratios = seeds[:, 0, 0] / reference[0, 0] - 1
            with mpmath.workdps(DIGITS):
                exact = [mpmath.mpf(float(s)) / mpmath.mpf(float(reference[0, 0])) - 1 for s in seeds[:, 0, 0]]
                mean = mpmath.fsum(exact) / 12
                error = mpmath.sqrt(mpmath.fsum((x - mean) ** 2 for x in exact) / 11 / 12)
                # float32 may be off by its eps in all seeds alike.
                beyond = max(abs(mean) - mpmath.mpf(float(np.finfo(np.float32).eps)), mpmath.mpf(0))
                p = student_p(float(beyond / error), 11)
                wrong = [
                    abs(mpmath.mpf(found.gain.estimate) - mean) / error,
                    abs(mpmath.mpf(found.gain.standard_error) / error - 1),
                ]
                wrong.append(abs(mpmath.mpf(found.gain.p_value) / p - 1))
            # The deviation from 1 is known to eps of 1, in units of its scatter, which the tail's exponent multiplies by t.
            spread = float(np.std(ratios))
            return float(max(wrong)), 100 * EPS / spread * max(1.0, float(beyond / error))

        yield Case("compare", "one pixel off by", f"{off:g}", must_answer(one_pixel))


def option_cases() -> Iterator[Case]:
    def with_options(quantity: str, value: str, good: bool | None, expected: float = 0.0, **options: Any) -> Case:
        def check() -> tuple[float, float]:
            return gained(wm.compare(*pictures(), **options), expected)

        return Case(
            "compare", quantity, value, check if good is None else must_answer(check) if good else must_refuse(check)
        )

    shape = (2, 40)
    for value in (1e-300, 1e300, -1.0, math.nan, math.inf):
        yield with_options("weights", f"{value:g}", 0 < value < math.inf, weights=np.full(shape, value))

    def blind(**options: Any) -> tuple[float, float]:
        # What nothing was seen of has no known gain, and no bias of it would have shown.
        gain = wm.compare(*pictures(), **options).gain
        return (0.0 if gain.standard_error == gain.detectable == math.inf else 1.0), 0.5

    yield Case("compare", "weights", "0", must_answer(lambda: blind(weights=np.zeros(shape))))
    yield Case("compare", "edges", "all", must_answer(lambda: blind(edges=np.ones(shape, dtype=bool))))
    for value in (0.0, 1e-300, 1e100, 1e300):
        yield with_options(
            "template",
            f"{value:g}",
            value < 1e300,
            templates={("lobe", "of 1"): np.full(shape, value)},
        )
    for value in (math.nan, math.inf):
        yield with_options("template", f"{value:g}", False, templates={("lobe", "of 1"): np.full(shape, value)})
    lone = np.ones(shape, dtype=bool)
    lone[1, 7] = False
    yield with_options("edges", "all but one", True, edges=lone)
    for name, bad in (
        ("weights", np.ones((3, 40))),
        ("templates", {("lobe", "of 1"): np.ones((2, 41))}),
        ("edges", np.ones((2, 41), dtype=bool)),
    ):
        yield with_options(f"shape of {name}", "another", False, **{name: bad})


def weight_cases() -> Iterator[Case]:
    for power in (-300, 0, 300):
        for noise in (0.0, 1e-3):

            def weighed(p: int = power, n: float = noise) -> tuple[float, float]:
                seeds, reference = pictures(level=10.0**p, noise=n)
                weights = cross_weights(seeds, reference)
                if not (np.all(np.isfinite(weights)) and np.all(weights > 0)):
                    return math.nan, 0.0
                # Scatter in proportion to the radiance: inverse variances go as its inverse square.
                got, ideal = (
                    w / w.mean(axis=(-2, -1), keepdims=True)
                    for w in (
                        weights,
                        np.broadcast_to(reference**-2.0 if p == 0 else (reference / 10.0**p) ** -2.0, seeds.shape),
                    )
                )
                # From 12 seeds and four neighbours a variance is known to a factor of two or so.
                return (float(np.max(np.abs(np.log(got / ideal)))) if n else 0.0), math.log(4)

            yield Case("cross_weights", f"radiance, scatter {noise:g}", f"1e{power:+d}", must_answer(weighed))

            def foretold(p: int = power, n: float = noise) -> tuple[float, float]:
                seeds, reference = pictures(level=10.0**p, noise=n, seeds=8, draw=1)
                told = detectable_gain(seeds, reference, planned=32)
                later = wm.compare(*pictures(level=10.0**p, noise=n, seeds=32, draw=2)).gain.detectable
                # Both are known to 1 / sqrt(2 S - 2), here 13 % of one and less of the other, so that five of that decide.
                return abs(math.log(told / later)), 5 * 0.13

            yield Case("detectable_gain", f"radiance, scatter {noise:g}", f"1e{power:+d}", must_answer(foretold))


def cases() -> Iterator[Case]:
    yield from scale_cases()
    yield from scatter_cases()
    yield from option_cases()
    yield from weight_cases()
    for value in (1e-300, 1e300):
        yield Case("scale_free_error", "estimate x", f"{value:g}", lambda v=value: (
            abs(wm.scale_free_error(v * np.array([1.0, 2.0, 3.3]), np.array([1.0, 2.0, 3.0]))
                - wm.scale_free_error(np.array([1.0, 2.0, 3.3]), np.array([1.0, 2.0, 3.0]))), 4 * EPS))  # fmt: skip
    one = np.ones(3)
    for name, estimate, truth, right in (
        ("estimate 0", 0 * one, one, 1.0),
        ("estimate of the other sign", -one, one, 0.0),
        ("truth denormal", one, 1e-310 * one, 0.0),
    ):
        yield Case("scale_free_error", "arrays", name, lambda e=estimate, t=truth, r=right: (
            abs(wm.scale_free_error(e, t) - r), 1e-12))  # fmt: skip
    for name, estimate, truth in (
        ("truth 0", one, 0 * one),
        ("both 0", 0 * one, 0 * one),
        ("empty", np.ones(0), np.ones(0)),
    ):
        yield Case("scale_free_error", "arrays", name, lambda e=estimate, t=truth: (
            0.0 if wm.scale_free_error(e, t) == math.inf else 1.0, 0.5))  # fmt: skip
    for name, estimate, truth in (
        ("estimate NaN", math.nan * one, one),
        ("estimate inf", math.inf * one, one),
        ("truth NaN", one, math.nan * one),
        ("shapes differ", one, np.ones(4)),
    ):
        yield Case(
            "scale_free_error", "arrays", name, must_refuse(lambda e=estimate, t=truth: wm.scale_free_error(e, t))
        )
