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
from numpy.typing import NDArray

from wallmirror.errors import InputError
from wallmirror.pathtracing.building import integrator_dict
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.pathtracing.picture_building import picture_dict, shape_key
from wallmirror.pathtracing.rendering import spread_seeds
from wallmirror.pathtracing.runtime import activate
from wallmirror.picture_scene import PictureScene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PASS_RAYS = 2**23  # bounds the memory of a pass
_PASS_SAMPLES = 1024  # the film adds in float32


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
            hidden = {shape_key(index) for index, shape in enumerate(self.scene.shapes) if shape.shines}
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
                pointer = pointers.get(shape_key(index_of[region.shape]))
                wanted[region.name] &= False if pointer is None else np.asarray(met == pointer, dtype=np.bool_)
        for region in self.scene.regions:
            left, top, end, bottom = np.multiply(region.box, (self.width, self.height) * 2)
            inside = (column >= left) & (column < end) & (row >= top) & (row < bottom)
            mask = (wanted[region.name] & inside).reshape(self.height, self.width)
            if not mask.any():
                raise InputError(f'"{region.name}" shows in no pixel; widen it or the picture', field="region")
            masks[region.name] = mask
        return masks


def _mitsuba() -> Any:
    return importlib.import_module("mitsuba")


def _passes(spp: int, pixels: int) -> list[int]:
    """Samples per pixel of each pass: powers of four and a rest, which stratified samplers can take."""
    largest = max(1, min(_PASS_SAMPLES, 4 ** int(math.log(max(1.0, _PASS_RAYS / pixels), 4) + 1e-9)))
    rest = spp % largest
    return [largest] * (spp // largest) + ([rest] if rest else [])
