"""Tables, directions and plugins that the tests of the two BSDF plugins share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from wallmirror.brdf import AngleSumBRDF, GaussianTrain, Phong
from wallmirror.pathtracing import bsdf

Array = NDArray[np.float64]

u = 2.0**-24  # unit roundoff of float32
NODES = 7201


def lobes(sigma_deg: float, *, shift: float = 0.0) -> GaussianTrain:
    """Two lobes at u = -25 and 10 deg, without symmetry in u; `shift` moves them, in units of sigma."""
    sigma = math.radians(sigma_deg)
    return GaussianTrain(centres=tuple(math.radians(c) + shift * sigma for c in (-25, 10)), sigma=sigma)


def phong() -> Phong:
    """A Phong lobe of 8 deg that returns 0.6 of what comes in along the normal."""
    return Phong(exponent=50, reflectance=0.6)


def of_sum(brdf: AngleSumBRDF, *, shift: float = 0.0) -> Array:
    """A model on the nodes of `wallmirror_angle_sum`, moved along u by `shift` radians."""
    return brdf.of_sum(np.linspace(-math.pi, math.pi, NODES) - shift)


def diffuse(albedo: float, *, slope: float = 0.0) -> Array:
    """albedo / pi on the nodes of `wallmirror_angle_sum`, tilted by `slope` per radian of u."""
    return albedo / math.pi * (1 + slope * np.linspace(-math.pi, math.pi, NODES))


def measured() -> Array:
    """A smooth random positive table, like a measured one: neither symmetric nor reciprocal, 91 x 91 nodes."""
    noise = gaussian_filter(np.random.default_rng(12).standard_normal((91, 91)), 9, mode="reflect")
    return np.exp(noise / noise.std()) / (4 * math.pi)


def ridge(sigma_deg: float = 1.0, *, shift: float = 0.0) -> Array:
    """A narrow lobe about u = 10 deg that fades towards one side of theta_o only, 721 x 721 nodes."""
    theta, sigma = np.linspace(-math.pi / 2, math.pi / 2, 721), math.radians(sigma_deg)
    away = theta[:, None] + theta - math.radians(10) - shift * sigma
    return np.exp(-0.5 * (away / sigma) ** 2) * (1 + 0.5 * np.sin(theta))


def plugin_dict(mi: Any, table: Array) -> dict[str, Any]:
    """The plugin that holds a table, for a scene."""
    return {"type": bsdf.ANGLE_SUM if table.ndim == 1 else bsdf.TABLE, "table": mi.TensorXf(table)}


def directions(theta: Any, y: Any) -> NDArray[np.float32]:
    """Unit vectors (sin(theta) c, y, cos(theta) c), c = sqrt(1 - y^2), shape (3, n)."""
    theta, y = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(y, dtype=float))
    c = np.sqrt(1 - y**2)
    return np.array([np.sin(theta) * c, y, np.cos(theta) * c]).reshape(3, -1).astype(np.float32)
