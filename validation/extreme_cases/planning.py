"""Advice and what the trade-offs foretell: tolerances, costs and laws at their ends.

References: films at a quadrature tolerance of 1e-9, which the transport's own cells hold against mpmath; the laws of Monte
Carlo and of least squares in rational numbers and at 50 digits; that advice knows no unit of light.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath
import numpy as np

import wallmirror as wm
from wallmirror.jobs.advising import advise
from wallmirror.planning.plan import Term, total_error
from wallmirror.planning.sampling import LEAST_SEEDS, NoiseLevel, cheapest_sampling
from wallmirror.tradeoff.pareto import fit_line, short_seconds
from wallmirror.tradeoff.splits import PASS, Costs, affordable

from .harness import DIGITS, EPS, Case, must_answer, must_refuse
from .scene_files import scene_text


def in_the_open(level: str = "1.0") -> wm.Scene:
    """One view of eight pixels of a wall with one lobe, before a black card, so that one bounce is all."""
    text = scene_text("source", "level", level)
    text = text.replace("albedo = 0.1\nboard", "albedo = 0.0\nboard")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        start, end = text.index("[room]"), text.index("[render]")
        path.write_text(text[:start] + text[end:])
        return wm.load_scene(path)


def advised(tolerance: float, level: str = "1.0") -> tuple[float, float]:
    """The advised quadrature keeps the tolerance, by films at 1e-9, and misses its own forecast by no more than they do."""
    given = in_the_open(level)
    plan = advise(given, tolerance, parts=("forward", "capture"))
    assert plan.forward is not None
    assert plan.capture is not None
    q = plan.forward.quadrature
    orders = (q.across_pixel, q.across_strip)
    points = {"element_width": 0.0, "element_height": 0.0}
    if q.strips == "points":
        area = given.card.element_width * given.card.element_height
        strips = wm.Card(elements_x=given.card.elements_x, y=given.card.y, **points)
        coarse = area * wm.transport_matrix(given.observer, strips, given.wall.brdf, orders=orders)
    else:
        coarse = wm.transport_matrix(given.observer, given.card, given.wall.brdf, orders=orders)
    exact = wm.transport_matrix(given.observer, given.card, given.wall.brdf, tolerance=1e-9)
    films, true = (wm.radiance(t, given.source / given.source.max()) for t in (coarse, exact))
    error = float(np.linalg.norm(films - true) / np.linalg.norm(true))
    if not (error <= tolerance and abs(error - q.error) <= 0.1 * error + 1e-6):
        raise RuntimeError(f"the quadrature is off by {error:.1e}, foretold {q.error:.1e}")
    return plan.capture.error, tolerance


def advice_cases() -> Iterator[Case]:
    for value in (0.0, -1.0, 1e-16, 9e-6, 0.51, 1e3, math.inf, math.nan):
        yield Case("advise", "tolerance", f"{value:g}", must_refuse(lambda t=value: advise(in_the_open(), t)))
    for value in (1e-5, 1e-2, 0.5):
        yield Case("advise", "tolerance", f"{value:g}", must_answer(lambda t=value: advised(t)))
    for level in ("1e-300", "1e-30", "1e30", "1e300"):
        yield Case("advise", "radiance", level, lambda v=level: advised(1e-2, v))
    yield Case("advise", "radiance", "0", must_refuse(lambda: advise(in_the_open("0.0"), 1e-2)))


def sampling_cases() -> Iterator[Case]:
    def sampled(noise: float, *, level: float = 0.04, seconds: float = 0.01) -> tuple[float, float]:
        pilot = NoiseLevel(sampler="multijitter", spp=64, noise=level, seconds=seconds)
        found = cheapest_sampling([pilot], noise=noise)
        # Independent seeds: their number is the least whole one with level / sqrt(n) <= noise, and LEAST_SEEDS.
        with mpmath.workdps(DIGITS + 650):
            ratio = (mpmath.mpf(level) / mpmath.mpf(noise)) ** 2
            least = max(1, int(mpmath.ceil(ratio * (1 - mpmath.mpf(10) ** -11))))
        if found.seeds < least or found.noise > noise * (1 + 1e-9):
            raise RuntimeError(f"{found.seeds} seeds with a noise of {found.noise:g}")
        return abs(float(Fraction(found.seeds, max(least, LEAST_SEEDS)) - 1)), 1e-9

    for noise in (1e-300, 1e-12, 1e-2, 1.0, 1e300):
        yield Case("cheapest_sampling", "noise wanted", f"{noise:g}", lambda n=noise: sampled(n))
    for noise in (0.0, -1.0, math.nan, math.inf):
        yield Case("cheapest_sampling", "noise wanted", f"{noise:g}", must_refuse(lambda n=noise: sampled(n)))
    for level in (0.0, 1e-300, 1e300):
        yield Case("cheapest_sampling", "noise of the pilot", f"{level:g}", lambda v=level: sampled(1e-2, level=v))
    for level in (-1.0, math.nan, math.inf):
        yield Case(
            "cheapest_sampling", "noise of the pilot", f"{level:g}", must_refuse(lambda v=level: sampled(1e-2, level=v))
        )
    for seconds in (0.0, 1e-300, 1e300):
        yield Case(
            "cheapest_sampling", "seconds of the pilot", f"{seconds:g}", lambda s=seconds: sampled(1e-2, seconds=s)
        )

    def summed(bias: float, noise: float) -> tuple[float, float]:
        found = total_error((Term(name="a", error=bias, kind="bias"), Term(name="b", error=noise, kind="noise")))
        with mpmath.workdps(DIGITS):
            exact = mpmath.sqrt(mpmath.mpf(bias) ** 2 + mpmath.mpf(noise) ** 2)
            return float(abs(mpmath.mpf(found) / exact - 1)) if exact else found, 4 * EPS

    for bias, noise in ((0.0, 0.0), (1e-300, 1e-300), (1e300, 1e300), (1e-300, 1e300), (0.3, 0.4)):
        yield Case(
            "total_error", "bias, noise", f"{bias:g}, {noise:g}", must_answer(lambda b=bias, n=noise: summed(b, n))
        )


def afforded(seconds: float, start: float, sample: float) -> tuple[float, float]:
    """The most samples whose price, by the law that Costs states, is within the budget; in rational numbers."""
    found = affordable(seconds, Costs(start=start, sample=sample, scatter=1.0, doubt=0.1))
    price = lambda n: Fraction(start) * math.ceil(Fraction(n, PASS)) + Fraction(sample) * n  # noqa: E731
    # The quotients are rounded: one part in 1e12 of the budget decides nothing.
    slack = Fraction(1, 10**12)
    if (
        found < 0
        or price(found) > Fraction(seconds) * (1 + slack)
        or price(found + 1) * (1 + slack) < Fraction(seconds) * (1 - slack)
    ):
        return 1.0, 0.5
    return 0.0, 0.5


def law_cases() -> Iterator[Case]:
    for seconds in (0.0, 1e-300, 1e-6, 1e-3, 1.0, 1e6, 1e15, 1e300):
        yield Case("affordable", "seconds", f"{seconds:g}", lambda s=seconds: afforded(s, 1e-3, 1e-6))
    for seconds in (-1.0, math.nan, math.inf):
        yield Case("affordable", "seconds", f"{seconds:g}", must_refuse(lambda s=seconds: afforded(s, 1e-3, 1e-6)))
    for start, sample in ((0.0, 1e-6), (1e-3, 1e-12), (1e3, 1e-6), (0.0, 1e-300), (1e300, 1e-6)):
        yield Case(
            "affordable", "start, sample", f"{start:g}, {sample:g} s", lambda a=start, b=sample: afforded(1.0, a, b)
        )
    for start, sample in ((0.0, 0.0), (-1.0, 1e-6), (1e-3, -1.0), (math.nan, 1.0), (1.0, math.nan)):
        yield Case(
            "affordable",
            "start, sample",
            f"{start:g}, {sample:g} s",
            must_refuse(lambda a=start, b=sample: afforded(1.0, a, b)),
        )

    def line(factor: float, slope: float, x: Any) -> tuple[float, float]:
        with mpmath.workdps(DIGITS):
            y = [float(mpmath.mpf(factor) * mpmath.mpf(float(v)) ** mpmath.mpf(slope)) for v in x]
        found = fit_line(x, y)
        # log y is known to eps of itself; a value beyond the points moves by that over their spread.
        size = max(abs(math.log(v)) for v in (*x, *y)) + 1
        spread = max(math.log(v) for v in x) - min(math.log(v) for v in x)
        allowed = 16 * EPS * size / spread
        within = abs(math.log(found.at(x[1]) / y[1])) if y[1] > 1e-307 else 0.0
        return max(abs(found.slope - slope), within / size), allowed

    for factor in (1e-300, 1.0, 1e300):
        yield Case("fit_line", "factor", f"{factor:g}", must_answer(lambda f=factor: line(f, -0.5, [1.0, 10.0, 100.0])))
    for slope in (-300.0, 0.0, 1e-12, 2.0, 290.0):
        yield Case("fit_line", "slope", f"{slope:g}", must_answer(lambda s=slope: line(1.0, s, [1.0, 3.0, 10.0])))
    for x in ([1e-300, 1.0, 1e300], [1.0, 1 + 1e-9, 1 + 2e-9], [1.0, 2.0]):
        yield Case(
            "fit_line",
            "sizes",
            str(x),
            must_answer(lambda v=x: line(3.0, 1.0, v) if v[-1] < 1e299 else line(1.0, 1.0, v)),
        )
    for name, x, y in (
        ("one size", [1.0], [1.0]),
        ("sizes alike", [2.0, 2.0], [1.0, 3.0]),
        ("none", [], []),
        ("size 0", [0.0, 1.0], [1.0, 1.0]),
        ("error 0", [1.0, 2.0], [0.0, 1.0]),
        ("error negative", [1.0, 2.0], [-1.0, 1.0]),
        ("error NaN", [1.0, 2.0], [math.nan, 1.0]),
        ("error inf", [1.0, 2.0], [math.inf, 1.0]),
        ("unequal numbers", [1.0, 2.0], [1.0]),
    ):
        yield Case("fit_line", "points", name, must_refuse(lambda a=x, b=y: fit_line(a, b)))

    def crossing(slope: float, level: float) -> tuple[float, float]:
        x = fit_line([1.0, 10.0], [1.0, 10.0**slope]).where(level)
        with mpmath.workdps(DIGITS):
            exact = mpmath.mpf(level) ** (1 / mpmath.mpf(slope))
            if exact > mpmath.mpf(1e308) or exact < mpmath.mpf(1e-307):
                return 0.0 if x > 1e308 or x < 1e-306 else 1.0, 0.5
            return float(abs(mpmath.mpf(x) / exact - 1)), 1e-9 * (1 + abs(float(mpmath.log(exact))))

    for slope, level in ((-0.5, 1e-300), (1.0, 1e300), (1e-3, 2.0), (-1e-3, 1e-3), (2.0, 1.0)):
        yield Case(
            "Line.where", "slope, value", f"{slope:g}, {level:g}", must_answer(lambda s=slope, v=level: crossing(s, v))
        )
    for slope, level in ((0.0, 2.0), (1.0, 0.0), (1.0, -1.0), (1.0, math.nan)):
        yield Case(
            "Line.where", "slope, value", f"{slope:g}, {level:g}", must_refuse(lambda s=slope, v=level: crossing(s, v))
        )
    for seconds, words in (
        (0.0, "0 µs"),
        (1e-300, "1e-294 µs"),
        (1e-6, "1 µs"),
        (0.9994, "999 ms"),
        (0.9996, "1 s"),
        (59.0, "59 s"),
        (3600.0, "1 h"),
        (1e300, "2.78e+296 h"),
    ):
        yield Case("short_seconds", "seconds", f"{seconds:g}", must_answer(
            lambda s=seconds, w=words: (0.0 if short_seconds(s) == w else 1.0, 0.5)))  # fmt: skip


def cases() -> Iterator[Case]:
    yield from advice_cases()
    yield from sampling_cases()
    yield from law_cases()
