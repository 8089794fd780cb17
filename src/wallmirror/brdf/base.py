"""What every reflectance is: a function of the two in-plane angles theta_s (to the light) and theta_o (to the camera).

In three dimensions theta is the angle of the direction's projection on the x-y plane, so that every model of this
package is constant along z ("cylindrical"): rho(w_s, w_o) = rho(theta_s, theta_o), whatever the directions' heights. For
the diffuse wall this is no choice. For a lobe it means a streak along z instead of a spot, and that light is conserved
where (pi/2) int rho cos theta_o dtheta_o <= 1 (see `energy`), not where a rotationally symmetric lobe of the same values
in the plane would conserve it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: What the scale of a lobe means: the share of light at normal incidence that comes back, or the peak's value.
LobeForm = Literal["conserving", "plain"]


class BRDF:
    """A reflectance of the two in-plane angles theta_s and theta_o."""

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        raise TypeError(f"{type(self).__name__} has no finite values")

    @property
    def angular_scale(self) -> float:
        """Smallest angle in radians over which the value changes appreciably (sets quadrature orders)."""
        return math.pi / 4


class AngleSumBRDF(BRDF):
    """A reflectance that depends on u = theta_s + theta_o alone (Hypothesis 8)."""

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        return self.of_sum(np.asarray(theta_s, dtype=np.float64) + np.asarray(theta_o, dtype=np.float64))

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        raise TypeError(f"{type(self).__name__} has no finite values")


def require_range(name: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless low <= value <= high and the value is finite."""
    if not low <= value <= high or math.isinf(value):
        raise InputError(f"is {value:g}; give a number from {low:g} to {high:g}", field=name)


def require_choice(name: str, value: str, options: tuple[str, ...]) -> None:
    """Raise InputError unless the value is one of the options."""
    if value not in options:
        listed = ", ".join(f'"{option}"' for option in options[:-1])
        raise InputError(f'is "{value}"; choose {listed} or "{options[-1]}"', field=name)
