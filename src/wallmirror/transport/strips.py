"""The light of a strip of the card at a point of the wall, and its mean over the height of a pixel, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.geometry import Array


def strip_factor(distance: float, dx: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Integral of cos theta_s cos theta_l / r^2 over the height of a strip parallel to the wall, in 1/m.

    Parameters
    ----------
    distance:
        z, distance between card and wall in metres.
    dx:
        Offset along x from wall point to strip, in metres.
    low, high:
        Ends of the strip above the wall point, in metres.

    Notes
    -----
    The integrand is z^2 / (a^2 + h^2)^2 with a^2 = z^2 + dx^2; its antiderivative is
    z^2 [h / (2 a^2 (a^2 + h^2)) + atan(h / a) / (2 a^3)].
    """
    a = np.hypot(distance, np.asarray(dx, dtype=np.float64))

    def antiderivative(h: ArrayLike) -> Array:
        # In units of a, so that neither tiny nor huge scenes leave the range of float64.
        h = np.asarray(h, dtype=np.float64) / a
        far = np.abs(h) > 1e8  # h / (1 + h^2) is 1 / h to rounding, and h^2 may overflow
        ratio = np.where(far, 1 / np.where(far, h, 1.0), h / (1 + np.where(far, 0.0, h) ** 2))
        whole: Array = 0.5 * (distance / a) ** 2 / a * (ratio + np.arctan(h))
        return whole

    return antiderivative(high) - antiderivative(low)


def mean_strip_factor(distance: float, slope: Array, half: float, reach: Array | None) -> Array:
    """Mean of `strip_factor` over wall points from -reach to reach below a strip from -half to half, in 1/m.

    With G(h) = z^2 h atan(h / a) / (2 a^3), whose derivative is the antiderivative of `strip_factor`, the mean is
    [G(half + reach) - G(half - reach)] / reach; sum and difference of the arctangents are taken as one each, since both
    may cancel.

    Parameters
    ----------
    slope:
        tan theta_s = dx / z, so that a^2 = z^2 (1 + slope^2).
    reach:
        None for points.
    """
    with np.errstate(over="ignore", divide="ignore"):  # beyond 1e154 z nothing arrives
        square = slope * slope
        square += 1.0
        inverse = np.sqrt(square)  # 1 / a
        inverse *= distance
        np.divide(1.0, inverse, out=inverse)
        if reach is None:
            h = half * inverse
            mean = 1 / (h + 1 / h)  # h / (1 + h^2), whose square may overflow
            mean += np.arctan(h, out=h)
            mean *= 2
        else:
            product, both = (half + reach) * inverse, (half - reach) * inverse
            product *= both
            mean = 1 + product
            np.arctan2(np.multiply(2 * reach, inverse, out=both), mean, out=mean)
            mean *= half / reach
            np.subtract(1, product, out=product)
            np.arctan2(np.multiply(2 * half, inverse, out=both), product, out=both)
            mean += both
    mean *= 0.5
    mean *= inverse
    mean /= square
    return mean
