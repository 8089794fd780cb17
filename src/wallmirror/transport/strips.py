"""The light of a strip of the card at a point of the wall, and its mean over the height of a pixel, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.errors import InputError
from wallmirror.geometry import Array

#: atan x - x / (1 + x^2) = x^3 (2/3 - 4/5 x^2 + 6/7 x^4 ..).
_BEND = tuple((-1) ** k * (2 * k + 2) / (2 * k + 3) for k in range(14))
_HUGE = 1e300  # what a product of heights is cut to, far beyond where it decides anything


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

    Raises
    ------
    InputError
        For a distance that is not positive, or values that are not finite.

    Notes
    -----
    The integrand is z^2 / (a^2 + h^2)^2 with a^2 = z^2 + dx^2; its antiderivative is
    z^2 [h / (2 a^2 (a^2 + h^2)) + atan(h / a) / (2 a^3)]. For a strip on one side of the wall point its values at both ends
    nearly cancel. With heights in units of a, p their product and x = (h2 - h1) / (1 + p) the difference is then taken as

        z^2 / (2 a^3) [(atan x - x / (1 + x^2)) + 2 x / ((1 + p)(1 + x^2))].
    """
    dx, low, high = (np.asarray(value, dtype=np.float64) for value in (dx, low, high))
    if not (0 < distance < np.inf and all(np.all(np.isfinite(value)) for value in (dx, low, high))):
        raise InputError("or an offset or height is not finite, or it is not > 0", field="distance")
    a = np.hypot(distance, dx)

    def antiderivative(h: Array) -> Array:
        # In units of a, so that neither tiny nor huge scenes leave the range of float64.
        h = h / a
        far = np.abs(h) > 1e8  # h / (1 + h^2) is 1 / h to rounding, and h^2 may overflow
        ratio: Array = np.where(far, 1 / np.where(far, h, 1.0), h / (1 + np.where(far, 0.0, h) ** 2))
        return ratio + np.arctan(h)

    with np.errstate(over="ignore"):
        product = np.maximum((low / a) * (high / a), 0.0)
    x = (high - low) / a / (1 + product)
    small = np.minimum(np.abs(x), 0.25)
    series = small**3 * np.polynomial.polynomial.polyval(small**2, _BEND)
    bend = np.where(np.abs(x) <= 0.25, np.copysign(series, x), np.arctan(x) - x / (1 + x * x))
    one_side = bend + 2 * x / (1 + product) / (1 + x * x)
    value = np.where(product > 0, one_side, antiderivative(high) - antiderivative(low))
    return np.asarray(0.5 * (distance / a) ** 2 / a * value, dtype=np.float64)


def mean_strip_factor(distance: float, slope: Array, half: float, reach: Array | None) -> Array:
    """Mean of `strip_factor` over wall points from -reach to reach below a strip from -half to half, in 1/m.

    With G(h) = z^2 h atan(h / a) / (2 a^3), whose derivative is the antiderivative of `strip_factor`, the mean is
    [G(half + reach) - G(half - reach)] / reach; sum and difference of the arctangents are taken as one each, since both
    may cancel. With s = a / z and p = (half^2 - reach^2) / z^2 they are the angles of (s^2 + p, 2 s reach / z) and
    (s^2 - p, 2 s half / z): no division.

    Parameters
    ----------
    slope:
        tan theta_s = dx / z, so that s^2 = 1 + slope^2.
    reach:
        None for points.
    """
    with np.errstate(over="ignore", divide="ignore"):  # beyond 1e154 z nothing arrives
        square = slope * slope
        square += 1.0
        root = np.sqrt(square)
        if reach is None:
            h = half / distance / root
            mean = 1 / (h + 1 / h)  # h / (1 + h^2), whose square may overflow
            mean += np.arctan(h, out=h)
            mean *= 1 / distance
        else:
            product = np.clip((half + reach) / distance * ((half - reach) / distance), -_HUGE, _HUGE)
            y, x = root * (2 * reach / distance), square + product
            mean = np.arctan2(y, x)
            mean *= half / reach
            np.arctan2(np.multiply(root, 2 * half / distance, out=y), np.subtract(square, product, out=x), out=y)
            mean += y
            mean *= 0.5 / distance
        square *= root
        mean /= square
    return mean
