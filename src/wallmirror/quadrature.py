"""Gauss-Legendre rules, and the order that averages a lobe over a pixel or strip to a tolerance."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: Orders beyond this are refused.
MAX_ORDER = 256


def quadrature_order(width: float, tolerance: float) -> int:
    """Smallest Gauss-Legendre order that averages exp(-u^2/2) over an interval of `width` to `tolerance`.

    Parameters
    ----------
    width:
        Length of the interval in standard deviations of the lobe; the worst offset of the lobe counts.
    """
    if width <= 0:
        return 1
    too_wide = InputError(
        f"a strip or pixel spans {width:.3g} lobe widths of the BRDF, more than {MAX_ORDER} quadrature nodes resolve "
        f"to {tolerance:g}; narrow the strips, use more pixels or accept a larger tolerance",
        field="card.element_width",
    )
    if not width < 4 * MAX_ORDER:
        raise too_wide
    # Lobes every quarter of their width, so that none slips between the nodes unseen.
    offsets = np.linspace(0.0, width / 2 + 4.0, 33 + int(2 * width))
    reference = _lobe_average(width, offsets)

    def missed(order: int) -> float:
        nodes, weights = gauss_legendre(order)
        values = np.exp(-0.5 * (offsets[:, None] + 0.5 * width * nodes) ** 2) @ (0.5 * weights)
        return float(np.max(np.abs(values - reference)))

    if width > MAX_ORDER / 4 and not missed(MAX_ORDER) <= tolerance:
        raise too_wide  # before a hundred orders are tried
    for order in range(1 + int(width / 4), MAX_ORDER + 1):  # nodes further apart than the lobe's width see nothing
        if missed(order) <= tolerance:
            return order
    raise too_wide


def order_across_peak(width: float, tolerance: float) -> int:
    """Gauss-Legendre order that averages 1 / (1 + x^2), and its powers, over an interval of `width` at any place.

    The function has poles at x = +-i, and the rule's error falls as r^(-2 n) with r the sum of the semi-axes of the ellipse
    through them whose foci are the interval's ends (Davis and Rabinowitz 1984, section 4.6): log r = asinh(2 / width) where
    the peak is in the middle.
    """
    if width <= 0:
        return 1
    order = math.log(4 / tolerance) / (2 * math.asinh(2 / width))
    if order > MAX_ORDER:
        raise InputError(
            f"a strip or pixel is {width:.3g} times as wide as the card is far, more than {MAX_ORDER} quadrature nodes "
            f"resolve to {tolerance:g}; narrow the strips, use more pixels or move the card away",
            field="card.element_width",
        )
    return max(1, math.ceil(order))


@functools.cache
def gauss_legendre(order: int) -> tuple[Array, Array]:
    """Nodes and weights on [-1, 1], kept: a search for the card asks for the same ones hundreds of times."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def _lobe_average(width: float, offsets: Array) -> Array:
    """Exact average of exp(-u^2/2) over [offset - width/2, offset + width/2]."""
    ends = (offsets[:, None] + 0.5 * width * np.array([1.0, -1.0])) / math.sqrt(2)
    if width < 1e-3:  # the difference of two erf would cancel
        return np.exp(-0.5 * offsets**2) * (1 + (offsets**2 - 1) * width**2 / 24)
    difference = erf(ends[:, 0]) - erf(ends[:, 1])
    return np.asarray(math.sqrt(math.pi / 2) * difference / width, dtype=np.float64)
