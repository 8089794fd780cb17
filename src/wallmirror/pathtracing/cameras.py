"""A Scene's cameras in Mitsuba: the unit of length, where the cameras stand and look, and how they sample.

Every function that returns a dictionary or a transform needs a variant to be set (`runtime.activate`), because
transforms belong to one.
"""

from __future__ import annotations

import importlib
import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.scene import Scene

Array = NDArray[np.float64]

#: Mitsuba's sample generators: independent samples, or stratified ones with far less noise. "orthogonal" converges fastest
#: and takes the squares of primes only; "ldsampler" correlates neighbouring pixels and does not converge here.
Sampler = Literal["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]

_UP = (0.0, 0.0, 1.0)
_PICTURE_FOV = 70.0


def metres_per_unit(scene: Scene) -> float:
    """Length of one Mitsuba unit in metres: 1, or the power of two that brings the card between 1 and 2 units.

    Radiance does not know the unit, and a power of two rounds nothing.
    """
    distance = scene.card.distance
    return 1.0 if 1 <= distance < 1024 else 2.0 ** math.floor(math.log2(distance))


def camera_to_world(scene: Scene, view: int) -> Any:
    """Mitsuba's camera transform for one view: looking along the view's angle, z up, x growing with the pixel.

    Raises
    ------
    InputError
        For a view that is not there.
    """
    observer = scene.observer
    if not 0 <= view < observer.views:
        raise InputError(f"{view} is not there; the views are 0 to {observer.views - 1}", field="view")
    angle = observer.view_angles[view]
    forward = (-math.sin(angle), math.cos(angle), 0.0)
    return _camera_transform(forward, (*observer.position, 0.0), metres_per_unit(scene))


def sensor_dict(scene: Scene, view: int, *, sampler: Sampler = "independent", spp: int | None = None) -> dict[str, Any]:
    """The observer's camera for one view: N x 1 square pixels with a box filter, in float32."""
    observer = scene.observer
    if observer.pixels_at != "centres":
        raise InputError('"edges" samples points; a path tracer has pixels, "centres"', field="observer.pixels_at")
    if sampler not in get_args(Sampler):
        raise InputError(f'is "{sampler}"; choose one of {", ".join(get_args(Sampler))}', field="sampler")
    return {
        **_pinhole(scene, math.degrees(observer.fov), observer.pixels, 1),
        "to_world": camera_to_world(scene, view),
        "sampler": {"type": sampler, "sample_count": spp or scene.render.spp},
    }


def picture_sensor_dict(scene: Scene, width: int, height: int) -> dict[str, Any]:
    """A camera beside and above the observer that shows wall, card and room as a visitor would see them."""
    reach = max(scene.observer.distance, scene.card.distance)
    place = np.array([0.35 * reach, -1.5 * reach, 0.25 * reach])
    if scene.room is not None:
        half = np.array([scene.room.half_width, scene.room.depth, scene.room.half_height])
        place = np.clip(place, [0, -0.97, 0] * half, [0.6, 0, 0.6] * half)
    target = np.array([0.0, -0.5 * scene.card.distance, 0.0])
    forward = (target - place) / np.linalg.norm(target - place)
    return {
        **_pinhole(scene, _PICTURE_FOV, width, height),
        "to_world": _camera_transform(forward, place, metres_per_unit(scene)),
        "sampler": {"type": "independent"},
    }


def _pinhole(scene: Scene, fov_deg: float, width: int, height: int) -> dict[str, Any]:
    # The clips are absolute lengths, so they must follow the scene; neither costs precision.
    reach = (scene.observer.distance + scene.card.distance) / metres_per_unit(scene)
    return {
        "type": "perspective",
        "fov": fov_deg,
        "fov_axis": "x",
        # An observer close to the wall under a far card must not look past the wall.
        "near_clip": 1e-3 * min(reach, scene.observer.distance / metres_per_unit(scene)),
        "far_clip": 1e5 * reach,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def _camera_transform(forward: ArrayLike, place: ArrayLike, unit: float) -> Any:
    """Camera axes: x to the left of the picture, y up, z forward."""
    forward = np.asarray(forward, dtype=np.float64)
    left = np.cross(_UP, forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = left, np.cross(forward, left), forward
    matrix[:3, 3] = np.divide(place, unit)
    return to_world(matrix)


def to_world(matrix: Array) -> Any:
    """Mitsuba's transform from a 4 x 4 matrix."""
    return importlib.import_module("mitsuba").ScalarTransform4f(matrix.tolist())
