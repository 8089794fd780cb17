"""Sums of models: lobes over a diffuse coat, facets over a diffuse ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.brdf.base import BRDF, AngleSumBRDF, Array
from wallmirror.brdf.ideal import Mirror
from wallmirror.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Sum(AngleSumBRDF):
    """The sum of angle-sum models, e.g. lobes over a diffuse coat."""

    parts: tuple[AngleSumBRDF, ...]

    def __post_init__(self) -> None:
        if not all(isinstance(part, AngleSumBRDF) for part in self.parts):
            raise InputError("holds a model that is no function of the angle sum; use a GeneralSum", field="wall.parts")
        _require_parts(self.parts)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        total = np.zeros(np.shape(u))
        for part in self.parts:
            total += part.of_sum(u)
        return total

    @property
    def angular_scale(self) -> float:
        """The finest of its parts."""
        return min(part.angular_scale for part in self.parts)


@dataclass(frozen=True, kw_only=True)
class GeneralSum(BRDF):
    """The sum of any models with finite values, e.g. microfacets over a diffuse ground."""

    parts: tuple[BRDF, ...]

    def __post_init__(self) -> None:
        _require_parts(self.parts)

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        total = np.zeros(np.broadcast_shapes(np.shape(theta_s), np.shape(theta_o)))
        for part in self.parts:
            total += part(theta_s, theta_o)
        return total

    @property
    def angular_scale(self) -> float:
        """The finest of its parts."""
        return min(part.angular_scale for part in self.parts)


def _require_parts(parts: tuple[BRDF, ...]) -> None:
    if not parts or any(isinstance(part, Mirror) for part in parts):
        raise InputError(
            "needs at least one model, and none that is a mirror: a delta has no values", field="wall.parts"
        )
