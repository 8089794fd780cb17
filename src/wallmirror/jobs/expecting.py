"""What `validate` holds renders against: the analytic one-bounce radiance, and what a bias would change of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, GaussianTrain, Mirror, Sum
from wallmirror.geometry import Card, Observer, pixel_half_width, pixel_tangents, wall_points
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.scene import Scene
from wallmirror.transport import Kernel, build_kernel, mirror_matrix, radiance

Array = NDArray[np.float64]

#: From observer, card and BRDF to F, shape (A, N, M).
Transport = Callable[[Observer, Card, BRDF], Array]

_SHIFT = math.radians(1e-3)


@dataclass(frozen=True)
class Expectation:
    """The analytic side of a comparison.

    Parameters
    ----------
    reference:
        One-bounce radiance, shape (A, N).
    templates:
        For each (name, unit) of a bias its change of the reference per unit, shape (A, N).
    edges:
        Pixels that are left out, shape (A, N).
    interpolation:
        As for `Validation`.
    """

    reference: Array
    templates: dict[tuple[str, str], Array]
    edges: NDArray[np.bool_]
    interpolation: float


def expect(
    scene: Scene, views: tuple[int, ...], *, realisation: int = 0, transport: Transport | None = None
) -> Expectation:
    """The analytic side of chosen views; a `transport` of one's own shows what a wrong one would do."""
    observer = replace(scene.observer, view_angles=tuple(scene.observer.view_angles[v] for v in views))
    pattern = scene.source[:, realisation]
    brdf = wall_as_rendered(scene)
    kernels: dict[float, Kernel] = {}  # the templates share the scene's angular scale, and with it the kernel

    def analytic(model: BRDF) -> Array:
        if transport is not None:
            matrix = transport(observer, scene.card, model)
        elif isinstance(model, Mirror):
            matrix = mirror_matrix(observer, scene.card, model)
        else:
            scale = model.angular_scale
            kernels[scale] = kernels.get(scale) or physical_kernel(observer, scene.card, scale)
            matrix = kernels[scale].apply(model)
        return radiance(matrix, pattern[:, None])[..., 0]

    if isinstance(brdf, Mirror):
        # Pixels that see a strip's border: there the share of the pixel, not the transport, is what is compared.
        share = mirror_matrix(observer, scene.card, brdf)
        edges = np.any((share > 0) & (share < share.max() * (1 - 1e-9)), axis=-1)
        edges |= _beside(edges)
    else:
        edges = _behind_strips(observer, scene.card)
    reference = analytic(brdf)
    off = float(np.max(np.abs(reference - analytic(scene.wall.brdf)), initial=0.0))
    return Expectation(
        reference,
        _templates(scene, analytic),
        edges,
        interpolation=off / max(float(reference.max(initial=0.0)), 1e-300),
    )


def physical_transport(observer: Observer, card: Card, brdf: BRDF) -> Array:
    """F to about 1e-5 of its peak and 3e-7 in the gain."""
    if isinstance(brdf, Mirror):
        return mirror_matrix(observer, card, brdf)
    return physical_kernel(observer, card, brdf.angular_scale).apply(brdf)


def physical_kernel(observer: Observer, card: Card, angular_scale: float) -> Kernel:
    """The kernel that `validate` compares with, for BRDFs of an angular scale in radians.

    The kinks of an interpolated table keep a quadrature from converging further, so no tolerance is pursued here.
    """
    return build_kernel(observer, card, resolution=angular_scale / 8, tolerance=1e-9)


def _behind_strips(observer: Observer, card: Card) -> NDArray[np.bool_]:
    """Pixels, shape (A, N), that may see the wall through a strip, which displaces the rays (see `building`)."""
    if observer.distance <= card.distance:
        return np.zeros((observer.views, observer.pixels), dtype=bool)
    half = pixel_half_width(observer)
    ends = wall_points(observer, pixel_tangents(observer)[:, None] + 2 * half * np.array([-1.0, 1.0]))
    x_o = observer.position[0]
    at_card = x_o + (ends - x_o) * (1 - card.distance / observer.distance)
    low, high = at_card.min(axis=-1)[..., None], at_card.max(axis=-1)[..., None]
    centres = np.asarray(card.elements_x)
    through = (low < centres + card.element_width / 2) & (high > centres - card.element_width / 2)
    return np.asarray(through.any(axis=-1))


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The neighbours of marked pixels, which a sample at the very border can reach."""
    wide = np.pad(mask, ((0, 0), (1, 1)))
    return np.asarray(wide[:, :-2] | wide[:, 2:])


def _templates(scene: Scene, analytic: Callable[[BRDF], Array]) -> dict[tuple[str, str], Array]:
    """What a shift of all lobes and the loss of each single lobe would do to the picture."""
    brdf = scene.wall.brdf
    if isinstance(brdf, Mirror) or not isinstance(brdf, AngleSumBRDF):
        return {}
    train = next((b for b in (brdf.parts if isinstance(brdf, Sum) else (brdf,)) if isinstance(b, GaussianTrain)), None)
    if train is None:
        return {}
    shifted = replace(train, centres=tuple(c + _SHIFT for c in train.centres))
    templates = {("lobe shift", "deg"): (analytic(shifted) - analytic(train)) / math.degrees(_SHIFT)}
    for centre in train.centres:
        name = f"lobe at {math.degrees(centre):+.0f} deg"
        templates[(name, "of 1")] = analytic(replace(train, centres=(centre,)))
    return templates
