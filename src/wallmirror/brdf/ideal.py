"""The two extremes that the thesis begins with: diffuse and mirror."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.brdf.base import BRDF, AngleSumBRDF, Array, require_range
from wallmirror.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Diffuse(AngleSumBRDF):
    """Lambertian: albedo / pi everywhere (eq. 1.12)."""

    albedo: float = 0.5

    def __post_init__(self) -> None:
        require_range("wall.albedo", self.albedo, 0, 1)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        return np.where(np.isnan(np.asarray(u, dtype=np.float64)), np.nan, self.albedo / math.pi)


@dataclass(frozen=True, kw_only=True)
class Mirror(BRDF):
    """A perfect mirror, delta(theta_s + theta_o) (eqs. 1.11, 2.14): a distribution, without finite values.

    `transport` integrates it exactly over pixels instead of sampling it.
    """

    reflectance: float = 1.0

    def __post_init__(self) -> None:
        require_range("wall.reflectance", self.reflectance, 0, 1)

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Refused: a delta has no values."""
        raise InputError(
            "is a mirror, a delta without values; `transport_matrix` renders it exactly", field="wall.brdf"
        )
