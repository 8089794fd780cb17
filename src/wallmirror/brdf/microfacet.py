"""Cook-Torrance: rho = F D G / (normalising cosines), of mirror-like facets under a Fresnel reflectance.

Half direction and facet angles in the plane: the half angle is h = (theta_s + theta_o) / 2, and light meets a facet
that reflects it to the camera at the angle d = (theta_s - theta_o) / 2, with the cosine <s,h> = cos d.

================  =============================================================================================
`facets`          reflectance in the plane
================  =============================================================================================
"isotropic"       F(d) D(h) G / (4 cos theta_s cos theta_o): facets tilt every way, D of Walter, Marschner, Li and
                  Torrance (2007), their eqs. 20, 25, 33; the values that a rotationally symmetric wall has in the plane
"grooves"         (2/pi) F(d) D1(h) G cos d / (2 cos theta_s cos theta_o): facets tilt in the plane alone, as those of
                  grooves along z; D1(h) = int D over the slopes along z, so that int D1 cos h dh = 1
================  =============================================================================================

Both have the same Smith term G: the shadowing of a height field in a plane depends on the slopes in that plane alone.
The difference matters because this package continues every model along z (`base`). Grooves conserve energy so
continued: facets that tilt in the plane turn light in the plane, and 2/pi spreads it along z as a diffuse wall does. The
isotropic values, whose lobe is as short along z as it is wide in the plane, become a streak of the same brightness when
continued, and reflect more than they receive if alpha is below about 0.4 (at normal incidence; 0.65 at grazing): take
them to compare with a renderer.

G / cos theta is formed without the quotient of two numbers that vanish at grazing angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erfc

from wallmirror.brdf.base import BRDF, Array, require_choice, require_range

#: Distribution of facet normals: Trowbridge and Reitz (1975), called GGX, or Beckmann and Spizzichino (1963).
FacetDistribution = Literal["ggx", "beckmann"]
#: Which way facets tilt; see the module's text.
Facets = Literal["grooves", "isotropic"]


@dataclass(frozen=True, kw_only=True)
class Fresnel:
    """Unpolarised Fresnel reflectance of a smooth surface of index eta + i k in air; k = 0 for a dielectric.

    Examples
    --------
    >>> round(float(Fresnel(eta=1.5)(1.0)), 6)
    0.04
    """

    eta: float = 1.5
    k: float = 0.0

    def __post_init__(self) -> None:
        require_range("wall.eta", self.eta, 1e-3, 1e3)
        require_range("wall.k", self.k, 0, 1e3)

    def __call__(self, cosine: ArrayLike) -> Array:
        """Share reflected for cosines of incidence from 0 to 1, same shape."""
        cosine = np.asarray(cosine, dtype=np.float64)
        n = complex(self.eta, self.k)
        n2, jump = n**2, (n - 1) * (n + 1)
        if jump == 0:  # no surface at all
            return np.where(np.isnan(cosine), np.nan, 0.0)
        square, sine = cosine**2, (1 - cosine) * (1 + cosine)  # of the cosine, and sin^2
        # n cos of the refracted angle by Snell's law, n^2 - sin^2 in the form that does not cancel.
        bent = np.sqrt(np.where(square < 0.5, jump + square, n2 - sine))
        with np.errstate(invalid="ignore"):  # of NaN
            across = np.abs(_contrast(cosine, bent, -jump)) ** 2
            along = np.abs(_contrast(n2 * cosine, bent, jump * (n2 * square - sine))) ** 2
        return np.asarray((across + along) / 2, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Schlick:
    """Schlick's (1994) approximation of a Fresnel reflectance: f0 + (1 - f0) (1 - cos)^5."""

    f0: float = 0.04

    def __post_init__(self) -> None:
        require_range("wall.f0", self.f0, 0, 1)

    def __call__(self, cosine: ArrayLike) -> Array:
        """Share reflected for cosines of incidence from 0 to 1, same shape."""
        cosine = np.asarray(cosine, dtype=np.float64)
        return np.asarray(self.f0 + (1 - self.f0) * (1 - cosine) ** 5, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class CookTorrance(BRDF):
    """A wall of mirror-like facets (Cook and Torrance 1982), with Smith's shadowing and masking.

    Parameters
    ----------
    alpha:
        Roughness, from 0.001 to 1: the slopes' scale.
    distribution:
        "ggx" or "beckmann".
    fresnel:
        What a facet reflects.
    facets:
        "grooves" (conserves energy as a wall) or "isotropic" (the usual model's values in the plane); see the module.

    Examples
    --------
    >>> gold = CookTorrance(alpha=0.2, fresnel=Fresnel(eta=0.18, k=3.4))
    >>> bool(gold(0.4, -0.4) > gold(0.4, 0.4)), bool(gold(0.9, -0.2) == gold(-0.2, 0.9))
    (True, True)
    """

    alpha: float = 0.2
    distribution: FacetDistribution = "ggx"
    fresnel: Fresnel | Schlick = field(default_factory=Fresnel)
    facets: Facets = "grooves"

    def __post_init__(self) -> None:
        require_range("wall.alpha", self.alpha, 1e-3, 1)
        require_choice("wall.distribution", self.distribution, get_args(FacetDistribution))
        require_choice("wall.facets", self.facets, get_args(Facets))

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians; 0 from below the horizon."""
        s, o = (np.clip(np.asarray(theta, dtype=np.float64), -math.pi, math.pi) for theta in (theta_s, theta_o))
        # The horizon itself counts as above: angles of pi/2 are rounded.
        below = (np.abs(s) > math.pi / 2) | (np.abs(o) > math.pi / 2)
        cos_d = np.cos((s - o) / 2)
        reflected = self.fresnel(np.where(below, 1.0, np.maximum(cos_d, 0.0)))
        shape = self.density((s + o) / 2) * (cos_d / math.pi if self.facets == "grooves" else 0.25)
        value = np.maximum(reflected * shape, 0.0) * self.masking(s) * self.masking(o)
        return np.where(below, 0.0, value)

    def density(self, h: ArrayLike) -> Array:
        """D(h) per sr ("isotropic") or D1(h) per radian ("grooves") of facets tilted by h in the plane, in radians."""
        h = np.asarray(h, dtype=np.float64)
        cosine = np.maximum(np.cos(h), 1e-300)
        a, isotropic = self.alpha, self.facets == "isotropic"
        if self.distribution == "ggx":
            # cos(h)^2 (1 + tan(h)^2 / a^2), so that D = q^-2 / (pi a^2) and D1 = q^-3/2 / (2 a).
            q = np.cos(h) ** 2 + (np.sin(h) / a) ** 2
            return np.asarray(1 / (math.pi * (a * q) ** 2) if isotropic else q**-1.5 / (2 * a), dtype=np.float64)
        fall = np.exp(-np.minimum((np.tan(h) / a) ** 2, 800.0))
        scale = math.pi * a**2 * cosine**4 if isotropic else math.sqrt(math.pi) * a * cosine**3
        return np.where(cosine > 1e-60, fall / np.maximum(scale, 1e-300), 0.0)

    def masking(self, theta: ArrayLike) -> Array:
        """Smith's G1(theta) / cos(theta) = 1 / (cos + cos Lambda), shape of theta (radians); finite at the horizon."""
        cosine = np.maximum(np.cos(np.asarray(theta, dtype=np.float64)), 0.0)
        tilt = self.alpha * np.abs(np.sin(theta))  # alpha tan theta, times the cosine
        if self.distribution == "ggx":  # Lambda = (sqrt(1 + (alpha tan)^2) - 1) / 2
            return np.asarray(2 / (cosine + np.hypot(cosine, tilt)), dtype=np.float64)
        # Lambda = exp(-v^2) / (2 v sqrt(pi)) - erfc(v) / 2 with v = 1 / (alpha tan).
        v = cosine / np.maximum(tilt, 1e-300)
        fall = np.exp(-(np.minimum(v, 27.0) ** 2))
        unlit = tilt * fall / (2 * math.sqrt(math.pi)) - cosine * erfc(v) / 2
        return np.asarray(1 / (cosine + np.maximum(unlit, 0.0)), dtype=np.float64)

    @property
    def angular_scale(self) -> float:
        """About the standard deviation of the lobe in u, alpha in radians."""
        return min(math.pi / 4, self.alpha)


def _contrast(one: Any, two: Any, squares: Any) -> Any:
    """(one - two) / (one + two), by the difference of their squares where that of themselves cancels."""
    total, difference = one + two, one - two
    return np.where(np.abs(difference) < 0.5 * np.abs(total), squares / total, difference) / total
