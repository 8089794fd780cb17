"""F of a mirror, whose BRDF is a delta: what each pixel sees is cut out exactly."""

from __future__ import annotations

import math

import numpy as np

from wallmirror.brdf import Mirror
from wallmirror.errors import InputError
from wallmirror.geometry import Array, Card, Observer, incident_angles, pixel_half_width, pixel_tangents, wall_points
from wallmirror.transport.nodes import Weights, require_weights


def mirror_matrix(observer: Observer, card: Card, mirror: Mirror, *, weights: Weights = "physical") -> Array:
    """F of a mirror, shape (A, N, M): the share of each pixel in which the mirrored strip is seen, exactly.

    The observer sees the strip as if from its own image behind the wall. With "thesis" and "cosine" weights
    each element lights the one pixel that its image falls into, with 1 or cos theta_s: a delta has no width.
    """
    require_weights(weights)
    t = pixel_tangents(observer)
    x_o = observer.position[0]
    depth = observer.distance + card.distance
    view = np.asarray(observer.view_angles)[:, None, None]
    centres = np.asarray(card.elements_x)

    def image_tangent(x: Array) -> Array:
        # x = x_o + depth tan(atan t - view): where on the sensor the point x of the card appears.
        # What lies behind the image plane is infinitely far out on its side.
        tangent: Array = np.tan(np.clip(np.arctan((x - x_o) / depth) + view, -math.pi / 2, math.pi / 2))
        return tangent

    if weights != "physical" or card.is_points:
        if weights == "physical":
            raise InputError(
                "points in a mirror have no radiance; give the strips a width and a height",
                field="card.element_width",
            )
        pitch = t[1] - t[0] if t.size > 1 else 2 * math.tan(observer.fov / 2)
        # Round, so that an image on the edge of two pixels falls into one of them and into no more.
        hit = np.arange(t.size)[:, None] == np.floor((image_tangent(centres) - t[0]) / pitch + 0.5)
        theta_s = incident_angles(centres, card.distance, wall_points(observer)[..., None])
        factor = np.cos(theta_s) if weights == "cosine" else 1.0
        return np.where(hit, mirror.reflectance * factor, 0.0)

    half = pixel_half_width(observer)
    if half == 0:  # points
        ends = [image_tangent(centres + side * card.element_width / 2) for side in (-1, 1)]
        return np.where((t[:, None] > ends[0]) & (t[:, None] < ends[1]), mirror.reflectance, 0.0)
    low = np.maximum(t[:, None] - half, image_tangent(centres - card.element_width / 2))
    high = np.minimum(t[:, None] + half, image_tangent(centres + card.element_width / 2))
    high = np.maximum(low, high)
    # A pixel's rays reach heights up to `half * path` on the card, path = depth / (cos view + t sin view); those within
    # the strip see it. Their share is a line in t, cut off at 1: exact by the midpoint rule on each side of the bend.
    slope, rise = np.cos(view), np.sin(view)
    strip = card.element_height / (2 * half * depth)
    bend = np.divide(1 / strip - slope, rise, out=np.zeros_like(view), where=rise != 0)
    bend = np.clip(bend, low, high)
    seen = np.zeros(low.shape)
    for a, b in ((low, bend), (bend, high)):
        seen += (b - a) * np.minimum(1.0, strip * (slope + 0.5 * (a + b) * rise))
    matrix: Array = mirror.reflectance * (seen / (2 * half))
    return matrix
