"""The physical one-bounce model in float32, to see what halving the precision buys. The library itself computes in float64."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.geometry import Card, Observer, outgoing_angles, pixel_half_width, pixel_tangents, wall_points

Single = NDArray[np.float32]


def transport_in_single_precision(
    observer: Observer, card: Card, brdf: GaussianTrain, *, orders: tuple[int, int]
) -> Single:
    """F for lobes of height "peak", shape (A, N, M), with the nodes and formulas of `transport_matrix` in float32.

    Positions on the wall are float64 still: they are few, and what cancels in them would spoil the angles.
    """
    of_pixel, pixel_weights = np.polynomial.legendre.leggauss(orders[0])
    of_strip, strip_weights = np.polynomial.legendre.leggauss(orders[1])
    t = pixel_tangents(observer)
    half_pixel, z, half = pixel_half_width(observer), card.distance, np.float32(card.element_height / 2)
    sums = np.zeros((card.elements, observer.views, observer.pixels), dtype=np.float32)
    view = np.asarray(observer.view_angles)[:, None]
    for node, pixel_weight in zip(of_pixel, pixel_weights, strict=True):
        at = t + half_pixel * node
        wall_x = wall_points(observer, at)
        theta_o = outgoing_angles(observer, wall_x).astype(np.float32)
        reach = (half_pixel * observer.distance / (np.cos(view) + at * np.sin(view))).astype(np.float32)
        for offset, strip_weight in zip(of_strip, strip_weights, strict=True):
            source_x = np.asarray(card.elements_x)[:, None, None] + 0.5 * card.element_width * offset
            slope = ((source_x - wall_x) / z).astype(np.float32)
            square = 1 + slope * slope
            inverse = 1 / (np.float32(z) * np.sqrt(square))
            upper, lower = (half + reach) * inverse, (half - reach) * inverse
            mean = np.arctan2(2 * reach * inverse, 1 + upper * lower) * (half / reach)
            mean += np.arctan(upper) + np.arctan(lower)
            u = np.arctan(slope) + theta_o
            rho = np.zeros_like(u)
            for centre in brdf.centres:
                # exp(-87) is the smallest that float32 holds without the slow path.
                rho += np.exp(np.maximum(-0.5 * ((u - np.float32(centre)) / np.float32(brdf.sigma)) ** 2, -87.0))
            factor = 0.5 * card.element_width * brdf.scale * pixel_weight * strip_weight / 4
            sums += rho * mean * inverse / square * np.float32(factor)
    assert math.isfinite(float(sums.max()))
    return np.ascontiguousarray(np.moveaxis(sums, 0, -1))
