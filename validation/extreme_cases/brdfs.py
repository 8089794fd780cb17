"""Reflectances against mpmath at 50 digits."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mpmath
import numpy as np

import wallmirror as wm

from .harness import DIGITS, EPS, Case


def cases() -> Iterator[Case]:
    """Every cell of the reflectances."""
    for sigma in (1e-320, 1e-12, 1e-3, 1.0, 90.0, 1e6):

        def lobe(s: float = sigma) -> tuple[float, float]:
            brdf = wm.GaussianTrain(centres=(0.0,), sigma=math.radians(s))
            u = np.radians(s) * np.array([0.0, 0.5, 1.0, 6.0, 30.0, 1e6])
            with mpmath.workdps(DIGITS):
                exact = [float(mpmath.exp(-((mpmath.mpf(float(v)) / mpmath.mpf(brdf.sigma)) ** 2) / 2)) for v in u]
            # The exponent is known to eps of itself.
            return float(np.max(np.abs(brdf.of_sum(u) - exact))), 8 * EPS

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
            allowed = EPS * (8 + 2 * n * math.log(max(n, 2.0)))
            return float(np.max(np.abs(brdf.of_sum(u) - exact))) / scale, allowed

        yield Case("Phong", "exponent", f"{exponent:g}", phong)
