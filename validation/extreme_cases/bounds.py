"""The Cramer-Rao bounds and forecasts: against the inverse of the whole Fisher information at 50 digits, and scaling laws.

In the gauge that holds c r fixed the covariance of all unknowns x = (r, V) is the upper left block of the inverse of
[[I, c], [c^T, 0]], with I = J^T W J and J the derivative of F(r) V. A forecast hangs on noise over light alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import mpmath
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.likelihood import moments
from wallmirror.derendering.poisson import poisson_bound

from .harness import DIGITS, Case, must_answer, must_refuse
from .scenes import card, lobes, observer

Array = NDArray[np.float64]

_P, _K, _M, _B = 14, 4, 2, 3


def small_problem(elements: int = _M, realisations: int = _B) -> tuple[list[sp.csr_array], Array, Array, Array]:
    """T_1 .. T_M of order one, r, V and the gauge c."""
    rng = np.random.default_rng(8)
    designs = [sp.csr_array(0.2 + rng.random((_P, _K))) for _ in range(elements)]
    r, v = 0.5 + rng.random(_K), 0.5 + rng.random((elements, realisations))
    return designs, r, v, np.eye(_K)[1]


def exact_bound(
    designs: list[sp.csr_array], r: Array, v: Array, gauge: Array, weights: Callable[[int, int, Any], Any]
) -> tuple[Array, Any]:
    """Standard deviations of V and its expected relative error after the best scale, at DIGITS digits.

    `weights` gives the inverse variance of entry (p, b) from its mean.
    """
    mp = mpmath
    elements, realisations = v.shape
    t = [d.toarray() for d in designs]
    unknowns = r.size + v.size
    with mp.workdps(DIGITS + 700):  # entries of V may lie 600 decades from those of r
        rows = []
        information = mp.zeros(unknowns + 1)
        for p in range(t[0].shape[0]):
            f = [
                mp.fsum(mp.mpf(float(t[i][p, k])) * mp.mpf(float(r[k])) for k in range(r.size)) for i in range(elements)
            ]
            for b in range(realisations):
                mean = mp.fsum(f[i] * mp.mpf(float(v[i, b])) for i in range(elements))
                slope = {
                    k: mp.fsum(mp.mpf(float(t[i][p, k])) * mp.mpf(float(v[i, b])) for i in range(elements))
                    for k in range(r.size)
                }
                slope.update({r.size + i * realisations + b: f[i] for i in range(elements)})
                rows.append((slope, weights(p, b, mean)))
        for slope, weight in rows:
            for a, x in slope.items():
                for c, y in slope.items():
                    information[a, c] += weight * x * y
        for k in range(r.size):
            information[k, unknowns] = information[unknowns, k] = mp.mpf(float(gauge[k]))
        covariance = mp.inverse(information)
        at = range(r.size, unknowns)
        power = mp.fsum(mp.mpf(float(x)) ** 2 for x in v.ravel())
        flat = [mp.mpf(float(x)) for x in v.ravel()]
        along = mp.fsum(
            flat[i] * covariance[r.size + i, r.size + j] * flat[j] for i in range(v.size) for j in range(v.size)
        )
        total = mp.fsum(covariance[i, i] for i in at)
        error = mp.sqrt((total - along / power) / power)
        return np.array([mp.sqrt(covariance[i, i]) for i in at], dtype=object).reshape(v.shape), error


def _off(found: Array, exact: Array) -> float:
    with mpmath.workdps(DIGITS):
        return max(float(abs(mpmath.mpf(float(f)) / e - 1)) for f, e in zip(found.ravel(), exact.ravel(), strict=True))


def _relative(found: float, exact: Any) -> float:
    """Off by how much; of one number the scale takes all error away, and rounding is what is left."""
    with mpmath.workdps(DIGITS):
        return float(abs(found - exact) / exact) if exact > 1e-20 else found


# The bound is taken with a ridge of 1e-12 of the information's trace, which its condition (below 1e5 here) magnifies.
_ALLOWED = 1e-6


def normal_bound(
    *,
    light: float = 1.0,
    weight: float = 1.0,
    one_pixel: float | None = None,
    elements: int = _M,
    realisations: int = _B,
) -> tuple[float, float]:
    designs, r, v, gauge = small_problem(elements, realisations)
    v = v * light
    weights = np.full((_P, realisations), weight)
    if one_pixel is not None:
        weights[3, 0] = one_pixel
    # The information hangs on the model alone, whatever the films hold.
    found = cramer_rao(moments(np.zeros(weights.shape), designs, weights), r, v, gauge=gauge)
    std, error = exact_bound(designs, r, v, gauge, lambda p, b, _: mpmath.mpf(float(weights[p, b])))
    return max(_off(found.source_std, std), _relative(found.source_error, error)), _ALLOWED


def counting_bound(*, counts: float, background: float = 0.0) -> tuple[float, float]:
    designs, r, v, gauge = small_problem()
    v = v * counts
    found = poisson_bound(designs, r, v, gauge=gauge, background=background)
    std, error = exact_bound(designs, r, v, gauge, lambda p, b, mean: 1 / (mean + mpmath.mpf(background)))
    return max(_off(found.source_std, std), _relative(found.source_error, error)), _ALLOWED


def foreseen(*, light: float = 1.0, noise: float = 1e-3, changes: dict[str, Any] | None = None) -> wm.Forecast:
    given = {
        "observer": observer(),
        "card": card(element_width=0.0, element_height=0.0),
        "source": np.eye(3),
        **(changes or {}),
    }
    source = light * np.asarray(given["source"])
    return wm.foresee(given["observer"], given["card"], lobes(), source, noise=noise, weights="cosine")


def forecast_cases() -> Iterator[Case]:
    for light, noise in (
        (1e-300, 1e-303),
        (1e300, 1e297),
        (1e-150, 1e150),
        (1e300, 1e-300),
        (1.0, 1e-320),
        (1e-320, 1.0),
    ):

        def scaled(v: float = light, n: float = noise) -> tuple[float, float]:
            plain, found = foreseen(noise=1e-3), foreseen(light=v, noise=n)
            with mpmath.workdps(DIGITS):
                ratio = mpmath.mpf(n) / mpmath.mpf(v) * 1000
                errors = []
                for name in ("source_error", "transport_error", "known_brdf_error"):
                    expected = ratio * mpmath.mpf(getattr(plain, name))
                    told = getattr(found, name)
                    if expected > mpmath.mpf(1e308) or expected < mpmath.mpf(1e-307):
                        errors.append(0.0 if told > 1e308 or told < 1e-306 else 1.0)
                    else:
                        errors.append(float(abs(mpmath.mpf(told) / expected - 1)))
            # Denormal numbers know themselves to 5e-324.
            return max(errors), 1e-9 + 1e-323 / min(v, n)

        yield Case("foresee", "light, noise", f"{light:g}, {noise:g}", must_answer(scaled))
    for value in (0.0, -1.0, math.nan, math.inf):

        def one_entry(v: float = value) -> wm.Forecast:
            noise = np.full((3, 60, 3), 1e-3)
            noise[1, 30, 1] = v
            return wm.foresee(
                observer(),
                card(element_width=0.0, element_height=0.0),
                lobes(),
                np.eye(3),
                noise=noise,
                weights="cosine",
            )  # type: ignore[arg-type]

        yield Case("foresee", "noise of one pixel", f"{value:g}", must_refuse(one_entry))
    for value in (1e-300, 1e300):

        def spotted(v: float = value) -> tuple[float, float]:
            noise = np.full((3, 60, 3), 1e-3)
            noise[1, 30, 1] = v
            found = wm.foresee(
                observer(),
                card(element_width=0.0, element_height=0.0),
                lobes(),
                np.eye(3),
                noise=noise,
                weights="cosine",
            )
            plain = foreseen(noise=1e-3)
            # One pixel of 540 that knows nothing, or all: it cannot move the bound by more than a few of its shares.
            return abs(found.source_error / plain.source_error - 1), 0.05

        yield Case("foresee", "noise of one pixel", f"{value:g}", spotted)
    for value in (0.0, math.nan, math.inf):
        yield Case(
            "foresee",
            "pattern",
            f"{value:g}",
            must_refuse(lambda v=value: foreseen(changes={"source": np.full((3, 3), v)})),
        )
    for step in (0.0, -1.0, math.nan, math.inf):

        def stepped(v: float = step) -> wm.Forecast:
            return wm.foresee(observer(), card(), lobes(), np.eye(3), noise=1e-3, step_deg=v)

        yield Case("foresee", "step_deg", f"{step:g}", must_refuse(stepped))
    strips = {"element_width": 0.0, "element_height": 0.0}
    for quantity, value, changes in (
        ("elements M", "1", {"card": card(elements_x=(0.2,), **strips), "source": np.ones((1, 3))}),
        ("realisations B", "1", {"source": np.ones((3, 1))}),
        ("pixels N", "1", {"observer": observer(pixels=1)}),
        ("elements apart", "0 m", {"card": card(elements_x=(0.2, 0.2, 1.0), **strips)}),
        ("elements apart", "1e-12 m", {"card": card(elements_x=(0.2, 0.2 + 1e-12, 1.0), **strips)}),
        ("patterns", "all alike", {"source": np.ones((3, 5))}),
        ("patterns", "one element dark", {"source": np.diag([1.0, 0.0, 1.0])}),
    ):

        def hopeless(
            c: dict[str, Any] = changes, may: bool = quantity in ("elements M", "realisations B", "patterns")
        ) -> tuple[float, float]:
            found = foreseen(changes=c)
            if math.isnan(found.source_error) or math.isnan(found.transport_error) or np.any(np.isnan(found.shape_std)):
                return math.nan, 0.0
            # What determines nothing must not be foretold to be known: an error bar of half the pattern is none.
            return (0.0 if may or found.source_error > 0.5 else 1.0), 0.5

        yield Case("foresee", quantity, value, hopeless)
    for metres in (1e-6, 1e-2, 1e2, 1e8):
        yield Case("foresee", "card's distance", f"{metres:g} m", lambda m=metres: (
            (math.nan if math.isnan(foreseen(changes={"card": card(y=-m, **strips)}).source_error) else 0.0), 1.0))  # fmt: skip
        yield Case("foresee", "whole scene", f"x {metres:g}", must_answer(lambda m=metres: _rescaled(m)))


def _rescaled(m: float) -> tuple[float, float]:
    """Cosine weights know no length: a scene of any size has one forecast."""
    strips = card(elements_x=(-m, 0.2 * m, 1.1 * m), y=-m, element_width=0.0, element_height=0.0)
    found = foreseen(changes={"observer": observer(position=(0.0, -5 * m)), "card": strips})
    # The angles are rounded differently: eps, magnified by the condition of the information.
    return abs(found.source_error / foreseen().source_error - 1), 1e-9


def cases() -> Iterator[Case]:
    for light in (1e-300, 1e-150, 1e-49, 1.0, 1e49, 1e150, 1e300):
        yield Case("cramer_rao", "light", f"{light:g}", lambda v=light: normal_bound(light=v))
    for weight in (1e-300, 1e-150, 1.0, 1e150, 1e300):
        yield Case("cramer_rao", "weights", f"{weight:g}", lambda w=weight: normal_bound(weight=w))
    for weight in (0.0, 1e-320, 1e4):
        yield Case("cramer_rao", "weight of one pixel", f"{weight:g}", lambda w=weight: normal_bound(one_pixel=w))
    yield Case("cramer_rao", "elements M, realisations B", "1, 1", lambda: normal_bound(elements=1, realisations=1))
    yield Case("cramer_rao", "elements M, realisations B", "1, 5", lambda: normal_bound(elements=1, realisations=5))
    for counts in (1e-300, 1e-49, 1e-6, 1.0, 1e6, 1e15, 1e49, 1e300):
        yield Case("poisson_bound", "counts", f"{counts:g}", lambda c=counts: counting_bound(counts=c))
    for background in (1e-300, 1.0, 1e6, 1e300):
        yield Case(
            "poisson_bound",
            "background",
            f"{background:g}",
            lambda c=background: counting_bound(counts=10.0, background=c),
        )
    yield from forecast_cases()
