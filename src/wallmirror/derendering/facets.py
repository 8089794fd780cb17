"""Walls that are nearly a function of the angle sum: rho = r(theta_s + theta_o) prod_k f_k(theta_s, theta_o)^x_k.

Any reciprocal BRDF is a function of the angle sum and of d = (theta_s - theta_o) / 2. What turns a rough surface away from
the angle sum alone is known and smooth, so that a few factors with exponents of their own say it; at exponents given
the transport is linear in r as before, its weights G times the factors.

===============  ======================================  ===============================================================
factor           f                                       in the microfacet model (Cook and Torrance 1982)
===============  ======================================  ===============================================================
"foreshortening" 1 / (cos theta_s cos theta_o)           1: the facets' density per area of the wall
"incidence"      1 / cos d                               -1 for facets that tilt in a plane; metals' reflectance: near 0
"fresnel"        1 + 24 (1 - cos d)^5                    1 for a dielectric of index 1.5 (Schlick 1994)
"shadowing"      G1(theta_s) G1(theta_o) at alpha = 0.4  about (alpha / 0.4)^2 (Smith; Walter et al. 2007, eq. 34)
===============  ======================================  ===============================================================

At all exponents 0 this is Hypothesis 8.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.transport import Kernel

Array = NDArray[np.float64]

Factor = Literal["foreshortening", "incidence", "fresnel", "shadowing"]

#: The factors that a fit of a wall of facets finds exponents for: captures seldom tell more of them apart.
FITTED: tuple[Factor, ...] = ("foreshortening", "incidence")
#: Those that such a fit is held against.
EVERY: tuple[Factor, ...] = (*FITTED, "fresnel", "shadowing")
#: Standard deviation of an exponent before the captures have a say: those of the microfacet model are of order one.
PRIOR_STD = 1.0

_DIELECTRIC = 24.0  # (1 - f0) / f0 at f0 = 0.04
_ROUGH = 0.4


def _foreshortening(theta_s: Array, theta_o: Array) -> Array:
    return np.asarray(-np.log(np.cos(theta_s) * np.cos(theta_o)))


def _incidence(theta_s: Array, theta_o: Array) -> Array:
    return np.asarray(-np.log(np.cos((theta_s - theta_o) / 2)))


def _fresnel(theta_s: Array, theta_o: Array) -> Array:
    return np.asarray(np.log1p(_DIELECTRIC * (1 - np.cos((theta_s - theta_o) / 2)) ** 5))


def _shadowing(theta_s: Array, theta_o: Array) -> Array:
    def unshadowed(theta: Array) -> Array:
        return np.asarray(np.log(2 / (1 + np.hypot(1, _ROUGH * np.tan(theta)))))

    return unshadowed(theta_s) + unshadowed(theta_o)


_LOGARITHMS: dict[Factor, Callable[[Array, Array], Array]] = {
    "foreshortening": _foreshortening,
    "incidence": _incidence,
    "fresnel": _fresnel,
    "shadowing": _shadowing,
}


def logarithm(factor: Factor, theta_s: Array, theta_o: Array) -> Array:
    """log f at angles in radians, of the shape that they broadcast to."""
    return _LOGARITHMS[factor](theta_s, theta_o)


def weighted(kernel: Kernel, exponents: Mapping[Factor, float]) -> Kernel:
    """The kernel with G multiplied by the factors to their exponents."""
    if not any(exponents.values()):
        return kernel
    power = np.zeros(1)
    for factor, exponent in exponents.items():
        power = power + exponent * logarithm(factor, kernel.theta_s, kernel.theta_o)
    return replace(kernel, weight=kernel.weight * np.exp(power))
