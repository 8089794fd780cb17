"""A PictureScene as Mitsuba's dictionary: camera, shapes, materials and what lies beyond."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.brdf import AngleSumBRDF, tabulate
from wallmirror.pathtracing import bsdf
from wallmirror.pathtracing.building import integrator_dict
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.picture_scene import (
    Background,
    Colour,
    Disk,
    Glass,
    Lobes,
    Material,
    Metal,
    Paint,
    PictureScene,
    Rectangle,
    Shape,
    Sphere,
    TiltedMirrors,
)

Array = NDArray[np.float64]

_SKY_ROWS = 1024


def picture_dict(
    scene: PictureScene, *, width: int | None = None, height: int | None = None, sampler: Sampler = "multijitter"
) -> dict[str, Any]:
    """The scene with its camera and integrator for `mi.load_dict(..., optimize=False)`, in a variant in colour."""
    settings = scene.render
    return {
        "type": "scene",
        "integrator": integrator_dict(settings.max_depth, settings.rr_depth, hide_emitters=settings.hide_emitters),
        "sensor": _sensor(scene, width or settings.width, height or settings.height, sampler),
        **{shape_key(index): _shape(scene, shape) for index, shape in enumerate(scene.shapes)},
        **({} if scene.background is None else {"background": _background(scene.background)}),
    }


def lobes_as_rendered(brdf: AngleSumBRDF) -> AngleSumBRDF:
    """The float32 table that stands for a BRDF of the angle sum in the picture."""
    return tabulate(brdf)


def _mitsuba() -> Any:
    return importlib.import_module("mitsuba")


def shape_key(index: int) -> str:
    """The name of a shape in the scene."""
    return f"shape_{index}"


def _sensor(scene: PictureScene, width: int, height: int, sampler: Sampler) -> dict[str, Any]:
    camera = scene.camera
    position, target = _place(scene, camera.position), _place(scene, camera.target)
    reach = math.dist(position, target)
    return {
        "type": "perspective",
        "fov": math.degrees(camera.fov),
        "fov_axis": "y",
        # The clips are absolute lengths, so they must follow the scene.
        "near_clip": 1e-3 * reach,
        "far_clip": 1e5 * reach,
        "to_world": _mitsuba().ScalarTransform4f().look_at(origin=position, target=target, up=list(camera.up)),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": sampler, "sample_count": scene.render.spp},
    }


def _place(scene: PictureScene, point: ArrayLike) -> list[float]:
    settings = scene.render
    place: list[float] = (np.subtract(point, settings.origin) / settings.unit).tolist()
    return place


def _shape(scene: PictureScene, shape: Shape) -> dict[str, Any]:
    unit = scene.render.unit
    match shape.geometry:
        case Sphere(centre=centre, radius=radius):
            world: dict[str, Any] = {"type": "sphere", "center": _place(scene, centre), "radius": radius / unit}
        case Rectangle(centre=centre, right=right, up=up):
            world = {"type": "rectangle", "to_world": _frame(scene, centre, right, up)}
        case Disk(centre=centre, normal=normal, radius=radius):
            s, t = _across(normal)
            world = {"type": "disk", "to_world": _frame(scene, centre, radius * s, radius * t)}
    world["bsdf"] = _material(shape.material)
    if shape.shines:
        world["emitter"] = {"type": "area", "radiance": _radiance(shape)}
    return world


def _frame(scene: PictureScene, centre: ArrayLike, right: ArrayLike, up: ArrayLike) -> Any:
    """Columns right, up and the normal right x up: a rotation and two scales, never a mirroring."""
    normal = np.cross(np.asarray(right, dtype=np.float64), np.asarray(up, dtype=np.float64))
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1] = np.divide(right, scene.render.unit), np.divide(up, scene.render.unit)
    matrix[:3, 2] = normal / np.linalg.norm(normal)
    matrix[:3, 3] = _place(scene, centre)
    return _mitsuba().ScalarTransform4f(matrix.tolist())


def _across(normal: ArrayLike) -> tuple[Array, Array]:
    """Two unit vectors whose cross product points along the normal."""
    n = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    right = np.cross(np.eye(3)[int(np.argmin(np.abs(n)))], n)
    right /= np.linalg.norm(right)
    return right, np.cross(n, right)


def _rgb(colour: Colour) -> dict[str, Any]:
    return {"type": "rgb", "value": list(colour)}


def _radiance(shape: Shape) -> dict[str, Any]:
    if shape.image is None:
        return _rgb(shape.emission)
    # Row 0 of a bitmap is v = 0, the lower edge; row 0 of ours is the upper edge.
    texels = np.ascontiguousarray((shape.image * shape.emission)[::-1], dtype=np.float32)
    return {
        "type": "bitmap",
        "data": _mitsuba().TensorXf(texels),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
        "format": "variant",
    }


def _material(material: Material) -> dict[str, Any]:
    match material:
        case Paint(colour=colour):
            return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(colour)}}
        case Metal(colour=colour, roughness=roughness):
            metal: dict[str, Any] = {"material": "none", "specular_reflectance": _rgb(colour)}
            if roughness < 1e-3:
                return {"type": "twosided", "bsdf": {"type": "conductor", **metal}}
            return {
                "type": "twosided",
                "bsdf": {"type": "roughconductor", "distribution": "ggx", "alpha": roughness, **metal},
            }
        case Glass(index=index):
            return {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
        case Lobes(brdf=brdf):
            values = lobes_as_rendered(brdf).values  # type: ignore[attr-defined]
            return {"type": bsdf.ANGLE_SUM, "table": _mitsuba().TensorXf(values.astype(np.float32))}
        case TiltedMirrors(tilts=tilts, reflectance=reflectance):
            return _tilted(tilts, reflectance)


def _tilted(tilts: tuple[float, ...], reflectance: float) -> dict[str, Any]:
    """A mixture, by halves of halves, of mirrors with their normals turned in the shading frame."""
    if len(tilts) > 1:
        half = len(tilts) // 2
        return {
            "type": "blendbsdf",
            "weight": 0.5,
            "first": _tilted(tilts[:half], reflectance),
            "second": _tilted(tilts[half:], reflectance),
        }
    normal = np.array([math.sin(tilts[0]), 0.0, math.cos(tilts[0])])
    texels = np.broadcast_to(((normal + 1) / 2).astype(np.float32), (2, 2, 3))
    return {
        "type": "normalmap",
        "use_shadowing_function": False,  # it darkens what a real tilted mirror would show
        "normalmap": {
            "type": "bitmap",
            "data": _mitsuba().TensorXf(np.ascontiguousarray(texels)),
            "raw": True,
            "format": "variant",  # half floats would err by 1e-4
        },
        "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": reflectance},
    }


def _background(background: Background) -> dict[str, Any]:
    if background.nadir == background.zenith:
        return {"type": "constant", "radiance": _rgb(background.nadir)}
    # Rows of an environment map run from +y down to -y, evenly in the angle.
    height = np.cos(np.linspace(0, math.pi, _SKY_ROWS))[:, None, None]
    sky = (1 - height) / 2 * np.array(background.nadir) + (1 + height) / 2 * np.array(background.zenith)
    texels = np.ascontiguousarray(np.broadcast_to(sky, (_SKY_ROWS, 4, 3)), dtype=np.float32)
    return {"type": "envmap", "bitmap": _mitsuba().Bitmap(texels)}
