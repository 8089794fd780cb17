"""The small scene that the cells change one quantity of, and its films."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

import wallmirror as wm


def observer(**changes: Any) -> wm.Observer:
    given = {"position": (0.0, -5.0), "fov": math.radians(60), "view_angles": (0.26, 0.0, -0.26), "pixels": 60}
    return wm.Observer(**{**given, **changes})


def card(**changes: Any) -> wm.Card:
    given = {"elements_x": (-1.0, 0.2, 1.1), "y": -1.0, "element_width": 0.02, "element_height": 0.03}
    return wm.Card(**{**given, **changes})


def lobes(sigma_deg: float = 5.0) -> wm.GaussianTrain:
    return wm.GaussianTrain(centres=(math.radians(-15), math.radians(15)), sigma=math.radians(sigma_deg))


def films(
    *, realisations: int = 6, scale: float = 1.0, noise: float = 0.0, **changes: Any
) -> tuple[wm.CaptureSet, np.ndarray]:
    eye = changes.pop("observer", None) or observer(pixels=200, pixels_at="edges")
    strips = changes.pop("card", None) or card(element_width=0.0, element_height=0.0)
    source = np.random.default_rng(3).random((strips.elements, realisations))
    brdf = changes.pop("brdf", None) or lobes()
    clean = wm.radiance(wm.transport_matrix(eye, strips, brdf, weights="cosine"), source)
    clean = clean + noise * float(clean.max()) * np.random.default_rng(4).standard_normal(clean.shape)
    dtype = changes.pop("dtype", None)
    stored = (clean * scale) if dtype is None else (clean * scale).astype(dtype).astype(np.float64)
    captures = wm.CaptureSet(observer=eye, card=strips, transport="cosine", radiance=stored)
    return (replace(captures, **changes) if changes else captures), source
