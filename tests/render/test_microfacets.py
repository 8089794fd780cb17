"""Cook-Torrance in the plane against Mitsuba's own rough surfaces, which share no code with ours.

`roughconductor` and `roughplastic` are rotationally symmetric: F D G / (4 cos cos) with Smith's G for any two directions.
Our "isotropic" form claims to be their value for directions in one plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.brdf import CookTorrance, Fresnel

from .soundness import directions, u

Array = NDArray[np.float64]

METAL = Fresnel(eta=0.2, k=3.9)
GLAZE = Fresnel(eta=1.5)


def grey(value: float) -> dict[str, Any]:
    return {"type": "uniform", "value": value}


def roughconductor(mi: Any, model: CookTorrance) -> Any:
    assert isinstance(model.fresnel, Fresnel)
    return mi.load_dict(
        {
            "type": "roughconductor",
            "distribution": model.distribution,
            "alpha": model.alpha,
            "eta": grey(model.fresnel.eta),
            "k": grey(model.fresnel.k),
        }
    )


def roughplastic(mi: Any, model: CookTorrance) -> Any:
    """With a black ground: nothing but its glossy coat."""
    assert isinstance(model.fresnel, Fresnel)
    return mi.load_dict(
        {
            "type": "roughplastic",
            "distribution": model.distribution,
            "alpha": model.alpha,
            "int_ior": model.fresnel.eta,
            "ext_ior": 1.0,
            "diffuse_reflectance": grey(0.0),
        }
    )


def pairs(count: int = 4000) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Directions to light and camera in the plane, up to a degree from grazing, half of them about the mirror."""
    rng = np.random.default_rng(31)
    light = rng.uniform(-1.55, 1.55, count)
    camera = np.where(np.arange(count) % 2, rng.uniform(-1.55, 1.55, count), -light + rng.normal(0, 0.1, count))
    camera = np.clip(camera, -1.55, 1.55)
    return directions(light, 0.0), directions(camera, 0.0)


def theirs(mi: Any, plugin: Any, light: NDArray[np.float32], camera: NDArray[np.float32]) -> Array:
    si = dr.zeros(mi.SurfaceInteraction3f, light.shape[1])
    si.wi = mi.Vector3f(camera)
    value = plugin.eval(mi.BSDFContext(), si, mi.Vector3f(light)).numpy().ravel()
    return np.asarray(value.astype(np.float64) / light[2])


def ours(model: CookTorrance, light: NDArray[np.float32], camera: NDArray[np.float32]) -> Array:
    """At the angles of the very directions that Mitsuba was given."""
    s, o = (np.arctan2(w[0].astype(np.float64), w[2].astype(np.float64)) for w in (light, camera))
    return model(s, o)


def worst(mi: Any, plugin: Any, model: CookTorrance) -> float:
    light, camera = pairs()
    expected = ours(model, light, camera)
    seen = expected > 1e-6 * expected.max()  # Beckmann's tail leaves the range of float32
    assert seen.mean() > 0.5
    return float(np.max(np.abs(theirs(mi, plugin, light, camera)[seen] / expected[seen] - 1)))


@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.8])
@pytest.mark.parametrize(("surface", "fresnel"), [(roughconductor, METAL), (roughplastic, GLAZE)])
def test_ggx_in_the_plane_is_mitsubas_to_single_precision(
    mi: Any, surface: Any, fresnel: Fresnel, alpha: float
) -> None:
    model = CookTorrance(alpha=alpha, fresnel=fresnel, facets="isotropic")
    plugin = surface(mi, model)
    # Some twenty roundings of float32; the half direction of two directions d = 1.5 apart from it has lost up to
    # 1 / cos(1.5) = 14 times as much, and a facet as steep as alpha squares what is left.
    tolerance = 160 * u
    assert worst(mi, plugin, model) < tolerance
    # The twins: the same formula with one term wrong.
    for wrong in (
        replace(model, alpha=alpha * 1.001),
        replace(model, fresnel=replace(fresnel, eta=fresnel.eta * 1.02)),
        WithoutShadowing(**vars(model)),
    ):
        assert worst(mi, plugin, wrong) > 10 * tolerance, wrong


class WithoutShadowing(CookTorrance):
    """G = 1."""

    def masking(self, theta: Any) -> Array:
        return np.asarray(1 / np.cos(theta))


def test_beckmann_in_the_plane_is_mitsubas_up_to_its_rational_shadowing(mi: Any) -> None:
    # Its G1 is a fit, stated to be within 0.35 %; G has two.
    model = CookTorrance(alpha=0.4, distribution="beckmann", fresnel=METAL, facets="isotropic")
    found = worst(mi, roughconductor(mi, model), model)
    assert 1e-4 < found < 0.0071
    assert worst(mi, roughconductor(mi, model), replace(model, distribution="ggx")) > 0.1
