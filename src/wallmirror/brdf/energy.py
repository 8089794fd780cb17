"""How much of the light from one direction a wall sends back: the left-hand side of eq. 1.9.

With y the out-of-plane sine of the outgoing direction, d omega = d theta dy and its cosine is sqrt(1 - y^2) cos theta;
a model that is constant along z (`base`) leaves int sqrt(1 - y^2) dy = pi/2 in front of the integral in the plane. The
height of the incident direction does not matter either.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.brdf.base import BRDF, Array
from wallmirror.brdf.ideal import Mirror
from wallmirror.errors import InputError

_LEAST_PANELS = 90
_ORDER = 4  # Gauss-Legendre nodes a panel, which is as wide as the model's angular scale
_CHUNK = 2**21
_MOST_PANELS = 2**19


def directional_albedo(brdf: BRDF, incidence: float = 0.0) -> float:
    """Share of light from one in-plane direction (radians) that the wall reflects: (pi/2) int rho cos theta_o.

    Examples
    --------
    >>> from wallmirror.brdf import Diffuse
    >>> round(directional_albedo(Diffuse(albedo=0.5)), 6)
    0.5
    """
    return float(directional_albedos(brdf, [incidence])[0])


def directional_albedos(brdf: BRDF, incidence: ArrayLike, *, finer: int = 1) -> Array:
    """`directional_albedo` for many angles of incidence in radians, same shape, with `finer` times as many nodes.

    Raises
    ------
    InputError
        If the model changes within less than 6e-6 rad, which the quadrature cannot resolve, or an angle lies beyond the
        horizon.
    """
    angles = np.asarray(incidence, dtype=np.float64)
    if not np.all(np.abs(angles) <= math.pi / 2):
        raise InputError("holds an angle beyond the horizon; give radians from -pi/2 to pi/2", field="incidence")
    if isinstance(brdf, Mirror):
        return np.full(angles.shape, brdf.reflectance)
    if math.pi / brdf.angular_scale > _MOST_PANELS:
        raise InputError(f"changes within {brdf.angular_scale:.2g} rad, too fine to integrate", field="wall.brdf")
    panels = finer * max(_LEAST_PANELS, math.ceil(math.pi / brdf.angular_scale - 1e-9))
    nodes, shares = np.polynomial.legendre.leggauss(_ORDER)
    half = math.pi / 2 / panels
    theta = ((np.arange(panels)[:, None] + 0.5) * 2 * half - math.pi / 2 + half * nodes).ravel()
    weight = math.pi / 2 * half * np.tile(shares, panels) * np.cos(theta)
    albedos = np.empty(angles.size)
    rows = max(1, _CHUNK // theta.size)
    for first in range(0, angles.size, rows):
        part = slice(first, first + rows)
        albedos[part] = brdf(angles.ravel()[part, None], theta) @ weight
    return albedos.reshape(angles.shape)
