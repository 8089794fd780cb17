"""Rendering as a convolution against Algorithm 1."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

import wallmirror as wm
from wallmirror.convolution import angle_convolution, spherical_convolution

from .harness import Case
from .scenes import card, lobes, observer


def cases() -> Iterator[Case]:
    """The half circle against Algorithm 1: it needs Hypothesis 8 alone, so that only its sampling may be off."""
    forms = {"spherical_convolution": spherical_convolution, "angle_convolution": angle_convolution}

    def each(quantity: str, value: str, form: str, allowed: float, **changes: Any) -> Case:
        def check() -> tuple[float, float]:
            options = dict(changes)
            eye = options.pop("observer", observer(pixels_at="edges"))
            strips = options.pop("card", card(element_width=0.0, element_height=0.0))
            brdf = options.pop("brdf", lobes())
            source = np.random.default_rng(5).random(strips.elements)
            exact = wm.radiance(wm.transport_matrix(eye, strips, brdf, weights="thesis"), source)
            found = forms[form](eye, strips, brdf, source, order=5, **options)
            # Relative to the lobe's peak, 1: where only its far tail is seen, the tail is not resolved.
            return float(np.max(np.abs(found - exact)) / max(1.0, np.max(np.abs(exact)))), allowed

        return Case(form, quantity, value, check)

    points = {"element_width": 0.0, "element_height": 0.0}
    for metres in (1e-6, 1e-2, 1e2, 1e8):
        yield each("card's distance", f"{metres:g} m", "spherical_convolution", 1e-5, card=card(y=-metres, **points))
    yield each("card's distance", "1e8 m", "angle_convolution", 1e-5, card=card(y=-1e8, **points))
    for degrees in (1e-3, 0.05, 1.0, 90.0):
        yield each("lobe's width", f"{degrees:g}°", "spherical_convolution", 1e-3, brdf=lobes(degrees))
    for samples in (0, 1, 2, 100_000):
        yield each("directions K", str(samples), "spherical_convolution", 1e-5, samples=samples, brdf=lobes(30.0))
    yield each("elements M", "1", "spherical_convolution", 1e-5, card=card(elements_x=(0.3,), **points))
    yield each("view angle", "59.999°", "spherical_convolution", 1e-5, observer=observer(
        view_angles=(math.radians(59.999),), pixels_at="edges"))  # fmt: skip
