"""Rendering a PictureScene in colour: at any depth, seed by seed, and which pixels show what.

A `PictureRenderer` loads its scene once. Depths differ by the integrator alone, so that two depths with equal seeds
share their random numbers and their difference scatters far less than either.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.brdf import AngleSumBRDF, tabulate
from wallmirror.errors import InputError
from wallmirror.pathtracing import bsdf
from wallmirror.pathtracing.building import integrator_dict
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.pathtracing.rendering import spread_seeds
from wallmirror.pathtracing.runtime import activate
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
Mask = NDArray[np.bool_]

_PASS_RAYS = 2**23  # bounds the memory of a pass
_PASS_SAMPLES = 1024  # the film adds in float32
_SKY_ROWS = 1024


@dataclass(frozen=True, kw_only=True)
class PictureRender:
    """One depth of a picture.

    Parameters
    ----------
    per_seed:
        Radiance by seed, shape (S, height, width, 3), linear red, green and blue.
    spp, seeds, max_depth:
        Samples per pixel and seed, the S seeds, and the longest path (2: one bounce).
    """

    per_seed: Array = field(repr=False)
    spp: int
    seeds: tuple[int, ...]
    max_depth: int

    @property
    def mean(self) -> Array:
        """Radiance averaged over the seeds, shape (height, width, 3)."""
        return np.asarray(self.per_seed.mean(axis=0))


class PictureRenderer:
    """A PictureScene inside Mitsuba, loaded once.

    Parameters
    ----------
    scene:
        What to render.
    width, height:
        Size of the picture; the scene's own where left out.
    sampler:
        "multijitter", which takes square numbers of samples, or "independent".
    variant, threads:
        As for `runtime.activate`; a variant in colour.

    Raises
    ------
    MissingRuntimeError
        If Mitsuba cannot run.

    Notes
    -----
    The same call renders the same again, on this object or on a new one: to the bit if samples per pixel are a power
    of two, else up to float32 rounding, since threads then add to one pixel in any order.
    """

    def __init__(
        self,
        scene: PictureScene,
        *,
        width: int | None = None,
        height: int | None = None,
        sampler: Sampler = "multijitter",
        variant: str = "llvm_ad_rgb",
        threads: int | None = None,
    ) -> None:
        if not variant.endswith("_rgb"):
            raise InputError(f'is "{variant}"; pictures are in colour, give llvm_ad_rgb', field="variant")
        self.runtime = activate(variant, threads=threads)
        self.scene = scene
        self.width = scene.render.width if width is None else width
        self.height = scene.render.height if height is None else height
        self._mi: Any = importlib.import_module("mitsuba")
        self._world = picture_dict(scene, width=self.width, height=self.height, sampler=sampler)
        # Unoptimised, for the same reason as a wall's scene: emitters keep their order from load to load.
        self._loaded = self._mi.load_dict(self._world, optimize=False)

    def render(
        self,
        max_depth: int | None = None,
        *,
        spp: int | None = None,
        seeds: Sequence[int] = (0,),
        rr_depth: int | None = None,
    ) -> PictureRender:
        """Render at one depth.

        Parameters
        ----------
        max_depth, rr_depth:
            Longest path (1: what shines, seen directly; 2: one bounce more) and where Russian roulette begins; the
            scene's own where left out.
        spp:
            Samples per pixel for EACH seed.
        seeds:
            Distinct integers in [0, 2^32); equal seeds share their random numbers at every depth.

        Raises
        ------
        InputError
            For a depth or seed that cannot be, and for a number of samples that the sampler cannot take.
        """
        settings = self.scene.render
        depth = settings.max_depth if max_depth is None else max_depth
        roulette = settings.rr_depth if rr_depth is None else rr_depth
        samples = settings.spp if spp is None else spp
        if depth < 1 or roulette < 1:
            raise InputError(f"is {min(depth, roulette)}; give depths of at least 1", field="max_depth")
        if samples < 1:
            raise InputError(f"is {samples}; give at least one sample per pixel", field="spp")
        if not seeds or len(set(seeds)) < len(seeds) or not all(0 <= seed < 2**32 for seed in seeds):
            raise InputError("give distinct integers from 0 to 2^32 - 1", field="seeds")
        self._mi.set_variant(self.runtime.variant)
        integrator = self._mi.load_dict(integrator_dict(depth, roulette, hide_emitters=settings.hide_emitters))
        return PictureRender(
            per_seed=np.array([self._seed(integrator, samples, seed) for seed in seeds]),
            spp=samples,
            seeds=tuple(int(seed) for seed in seeds),
            max_depth=depth,
        )

    def _seed(self, integrator: Any, spp: int, seed: int) -> Array:
        passes = _passes(spp, self.width * self.height)
        seeds = [seed] if len(passes) == 1 else spread_seeds(seed, len(passes))
        image = np.zeros((self.height, self.width, 3))
        for samples, pass_seed in zip(passes, seeds, strict=True):
            film = self._mi.render(self._loaded, integrator=integrator, seed=pass_seed, spp=samples)
            drawn = self._loaded.sensors()[0].sampler().sample_count()
            if drawn != samples:
                raise InputError(f"cannot be {samples} for this sampler; {drawn} can", field="spp")
            image += np.asarray(film, dtype=np.float64)[..., :3] * (samples / spp)
        return image

    def regions(self) -> dict[str, Mask]:
        """Pixels of each region of the scene, shape (height, width): those whose centre and corners all show it.

        Raises
        ------
        InputError
            For a region that no pixel shows.
        """
        self._mi.set_variant(self.runtime.variant)
        visible = self._loaded
        if self.scene.render.hide_emitters:
            hidden = {_key(index) for index, shape in enumerate(self.scene.shapes) if shape.shines}
            world = picture_dict(self.scene, width=self.width, height=self.height)
            visible = self._mi.load_dict({k: v for k, v in world.items() if k not in hidden}, optimize=False)
        masks = {}
        index_of = {shape.name: index for index, shape in enumerate(self.scene.shapes)}
        pixels = self.width * self.height
        wanted = {region.name: np.ones(pixels, dtype=np.bool_) for region in self.scene.regions}
        pointers = {shape.id(): self._mi.ShapePtr(shape) for shape in visible.shapes()}
        row, column = np.divmod(np.arange(pixels), self.width)
        for right, down in ((0.5, 0.5), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
            place = self._mi.Point2f((column + right) / self.width, (row + down) / self.height)
            ray, _ = self._loaded.sensors()[0].sample_ray(0.0, 0.5, place, self._mi.Point2f(0.5))
            met = visible.ray_intersect(self._mi.Ray3f(ray)).shape
            for region in self.scene.regions:
                pointer = pointers.get(_key(index_of[region.shape]))
                wanted[region.name] &= False if pointer is None else np.asarray(met == pointer, dtype=np.bool_)
        for region in self.scene.regions:
            left, top, end, bottom = np.multiply(region.box, (self.width, self.height) * 2)
            inside = (column >= left) & (column < end) & (row >= top) & (row < bottom)
            mask = (wanted[region.name] & inside).reshape(self.height, self.width)
            if not mask.any():
                raise InputError(f'"{region.name}" shows in no pixel; widen it or the picture', field="region")
            masks[region.name] = mask
        return masks


def picture_dict(
    scene: PictureScene, *, width: int | None = None, height: int | None = None, sampler: Sampler = "multijitter"
) -> dict[str, Any]:
    """The scene with its camera and integrator for `mi.load_dict(..., optimize=False)`, in a variant in colour."""
    settings = scene.render
    return {
        "type": "scene",
        "integrator": integrator_dict(settings.max_depth, settings.rr_depth, hide_emitters=settings.hide_emitters),
        "sensor": _sensor(scene, width or settings.width, height or settings.height, sampler),
        **{_key(index): _shape(scene, shape) for index, shape in enumerate(scene.shapes)},
        **({} if scene.background is None else {"background": _background(scene.background)}),
    }


def lobes_as_rendered(brdf: AngleSumBRDF) -> AngleSumBRDF:
    """The float32 table that stands for a BRDF of the angle sum in the picture."""
    return tabulate(brdf)


def _mitsuba() -> Any:
    return importlib.import_module("mitsuba")


def _key(index: int) -> str:
    return f"shape_{index}"


def _passes(spp: int, pixels: int) -> list[int]:
    """Samples per pixel of each pass: powers of four and a rest, which stratified samplers can take."""
    largest = max(1, min(_PASS_SAMPLES, 4 ** int(math.log(max(1.0, _PASS_RAYS / pixels), 4) + 1e-9)))
    rest = spp % largest
    return [largest] * (spp // largest) + ([rest] if rest else [])


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
