"""Rendering a Scene: one view of one pattern with its noise, and a picture for the report.

A `Renderer` loads its scene once and from then on only changes the camera's place and the strips' radiances, which
compiles nothing anew. Three properties of Mitsuba shape what happens here:

- its film adds samples in float32, so no pass takes more than 1024 samples per pixel (rounding is then below
  `FILM_ROUNDING`), and passes are averaged in float64;
- its `moment` integrator, nested around `path`, costs nothing and yields the second moment of the samples;
- radiance is linear in the pattern, so patterns are scaled to about 1 on their way in and back on the way out, and
  their squares neither overflow nor vanish in float32.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.memory import picture_bytes, require_memory
from wallmirror.pathtracing import building, cameras
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.pathtracing.runtime import activate
from wallmirror.scene import Scene

Array = NDArray[np.float64]

#: Where a variance comes from: the samples' second moment, or the scatter of the seeds.
VarianceMethod = Literal["moments", "seeds"]

#: Largest relative error that the float32 film leaves on mean and second moment of a pass, with room to spare:
#: measured 7e-7 and 2e-6 on equal samples, the worst case, and 4e-7 on scattered ones.
FILM_ROUNDING = 4e-6

_PASS_SAMPLES = 1024
_PASS_RAYS = 2**22  # bounds the memory of a pass, whatever the number of pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Render:
    """One view of one pattern, with its noise.

    Parameters
    ----------
    per_seed:
        Radiance by seed, shape (S, N), in W m^-2 sr^-1; rows are independent and identically distributed.
    moment_variance:
        Variance of the mean from the samples' second moment, shape (N,); None for stratified samples, for which
        the second moment says nothing. Where it would drown in the film's rounding (samples scattering by less than
        0.2 %, as inside a strip seen in a mirror) it is `FILM_ROUNDING` times the second moment: too large, never
        too small. It is 0 where no sample found light.
    spp, seeds, sampler:
        Samples per pixel and seed, the S seeds, and how the samples were drawn.
    method:
        Which variance `variance` is.
    """

    per_seed: Array = field(repr=False)
    moment_variance: Array | None = field(repr=False)
    spp: int
    seeds: tuple[int, ...]
    sampler: Sampler
    method: VarianceMethod

    @property
    def mean(self) -> Array:
        """Radiance averaged over the seeds, shape (N,)."""
        return np.asarray(self.per_seed.mean(axis=0))

    @property
    def seed_variance(self) -> Array | None:
        """Variance of the mean from the scatter of the seeds, S - 1 degrees of freedom, shape (N,); None for one."""
        seeds = len(self.seeds)
        if seeds < 2:
            return None
        return np.asarray(self.per_seed.var(axis=0, ddof=1) / seeds + (FILM_ROUNDING * self.mean) ** 2)

    @property
    def variance(self) -> Array:
        """Variance of the mean by `method`, shape (N,)."""
        variance = self.moment_variance if self.method == "moments" else self.seed_variance
        assert variance is not None  # `Renderer.render` refuses the combinations without one
        return variance


class Renderer:
    """A Scene inside Mitsuba, loaded once.

    Parameters
    ----------
    scene:
        What to render.
    variant, threads:
        As for `runtime.activate`; what it set up is `self.runtime`.
    pass_samples:
        Most samples per pixel in one pass. More than the default keep stratified samples together, at the cost of memory
        and of the film's rounding (1.6e-4 at 16384).

    Raises
    ------
    InputError
        If paths cannot meet what the scene asks for (points for elements or pixels, an unknown BRDF).
    MissingRuntimeError
        If Mitsuba cannot run.

    Notes
    -----
    The same call renders the same again, on this object or on a new one: to the bit if samples per pixel are a power
    of two of at least 256, else up to `FILM_ROUNDING`, since threads then add to one pixel in any order. Two renders
    with equal seeds share their random numbers, which makes differences between them (a depth, a pattern) far less
    noisy than either.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        variant: str = "llvm_ad_mono",
        threads: int | None = None,
        pass_samples: int | None = None,
    ) -> None:
        self.runtime = activate(variant, threads=threads)
        self.scene = scene
        self._pass_samples = pass_samples
        self._mi: Any = importlib.import_module("mitsuba")
        # Unoptimised: merging equal materials would shuffle the emitters from load to load.
        self._loaded = self._mi.load_dict(building.mitsuba_dict(scene, None), optimize=False)
        self._parameters = self._mi.traverse(self._loaded)
        self._sensors: dict[Sampler, tuple[Any, Any]] = {}
        self._integrators: dict[tuple[int, int], tuple[Any, int, int]] = {}

    def render(
        self,
        view: int,
        radiances: ArrayLike,
        *,
        spp: int | None = None,
        seeds: Sequence[int] = (0,),
        max_depth: int | None = None,
        rr_depth: int | None = None,
        sampler: Sampler = "independent",
        method: VarianceMethod | None = None,
    ) -> Render:
        """Render one view of one pattern.

        Parameters
        ----------
        view:
            Index of the view.
        radiances:
            Radiance of each strip, shape (M,), finite and >= 0.
        spp:
            Samples per pixel for EACH seed. More than 1024 (or 4e6 rays) are split into passes whose seeds follow
            from the seed given.
        seeds:
            Distinct integers in [0, 2^32).
        max_depth, rr_depth:
            Longest path (2: one bounce) and where Russian roulette begins; the scene's own where left out.
        sampler:
            "independent", or a stratified one for 10 to 100 times less noise, whose variance only the seeds can tell.
        method:
            Variance wanted; by default "moments" for independent samples and "seeds" else.

        Raises
        ------
        InputError
            For a view, radiance, seed or number of samples that cannot be, and for a variance that cannot be known.
        """
        pattern = self._checked_pattern(radiances)
        settings = self.scene.render
        spp = settings.spp if spp is None else spp
        method = method or ("moments" if sampler == "independent" else "seeds")
        _check_sampling(spp, seeds, sampler, method)
        largest = float(pattern.max(initial=0.0))
        # A power of two, so that the scaling itself rounds nothing.
        scale = 2.0 ** math.frexp(largest)[1] if largest > 0 else 1.0
        self._mi.set_variant(self.runtime.variant)
        self._set_pattern(pattern / scale)
        sensor = self._aimed(view, sampler)
        integrator = self._integrator(
            settings.max_depth if max_depth is None else max_depth, settings.rr_depth if rr_depth is None else rr_depth
        )
        first, second = zip(*(self._seed(sensor, integrator, spp, seed) for seed in seeds), strict=True)
        per_seed = np.array(first)
        moment_variance = None
        if sampler == "independent":
            moment_variance = _moment_variance(per_seed.mean(axis=0), np.mean(second, axis=0), spp * len(seeds))
            moment_variance *= scale**2
        return Render(
            per_seed=per_seed * scale,
            moment_variance=moment_variance,
            spp=spp,
            seeds=tuple(int(seed) for seed in seeds),
            sampler=sampler,
            method=method,
        )

    def _checked_pattern(self, radiances: ArrayLike) -> Array:
        pattern = np.asarray(radiances, dtype=np.float64)
        elements = self.scene.card.elements
        if pattern.shape != (elements,):
            raise InputError(
                f"has shape {pattern.shape}; give one radiance for each of the {elements} strips", field="radiances"
            )
        if not np.all(np.isfinite(pattern)) or np.any(pattern < 0):
            raise InputError("holds a value that is negative or not finite", field="radiances")
        return pattern

    def _set_pattern(self, pattern: Array) -> None:
        for element, radiance in enumerate(pattern):
            self._parameters[building.radiance_key(element)] = float(radiance)
        self._parameters.update()

    def _aimed(self, view: int, sampler: Sampler) -> Any:
        """The camera with this sampler, turned to the view."""
        if sampler not in self._sensors:
            sensor = self._mi.load_dict(cameras.sensor_dict(self.scene, view, sampler=sampler))
            self._sensors[sampler] = sensor, self._mi.traverse(sensor)
        sensor, parameters = self._sensors[sampler]
        parameters["to_world"] = cameras.camera_to_world(self.scene, view)
        parameters.update()
        return sensor

    def _integrator(self, max_depth: int, rr_depth: int) -> tuple[Any, int, int]:
        """The integrator, with the film's channels of the samples' mean and second moment."""
        if max_depth < 1 or rr_depth < 1:
            raise InputError(f"is {min(max_depth, rr_depth)}; give depths of at least 1", field="max_depth")
        key = (max_depth, rr_depth)
        if key not in self._integrators:
            path = building.integrator_dict(max_depth, rr_depth)
            integrator = self._mi.load_dict({"type": "moment", "path": path})
            # Channel 0 is the film's own luminance. In a colour variant X, Y and Z of grey differ, and Y is its value.
            names = integrator.aov_names()
            self._integrators[key] = integrator, 1 + names.index("path.Y"), 1 + names.index("m2_path.Y")
        return self._integrators[key]

    def _seed(self, sensor: Any, integrator: tuple[Any, int, int], spp: int, seed: int) -> tuple[Array, Array]:
        """Mean and second moment of one seed's samples, each (N,)."""
        method, mean_channel, second_channel = integrator
        passes = _passes(spp, self.scene.observer.pixels, self._pass_samples)
        seeds = [seed] if len(passes) == 1 else np.random.SeedSequence(seed).generate_state(len(passes))
        mean, second = np.zeros((2, self.scene.observer.pixels))
        for samples, pass_seed in zip(passes, seeds, strict=True):
            film = self._mi.render(
                self._loaded, sensor=sensor, integrator=method, seed=int(pass_seed), spp=int(samples)
            )
            drawn = sensor.sampler().sample_count()
            if drawn != samples:
                raise InputError(f"cannot be {samples} for this sampler; {drawn} can", field="spp")
            image = np.asarray(film, dtype=np.float64)[0]
            mean += image[:, mean_channel] * (samples / spp)
            second += image[:, second_channel] * (samples / spp)
        return mean, second


def picture(
    scene: Scene,
    width: int = 640,
    height: int = 360,
    *,
    spp: int = 256,
    max_depth: int | None = None,
    realisation: int = 0,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
) -> Array:
    """Radiance that a visitor beside the observer would see, wall, card and room, shape (height, width).

    Raises
    ------
    InputError
        If the picture is larger than the memory.
    """
    require_memory(picture_bytes(width, height), f"a picture of {width} x {height} pixels")
    activate(variant)
    mi: Any = importlib.import_module("mitsuba")
    world = building.mitsuba_dict(scene, None, radiances=scene.source[:, realisation])
    world["sensor"] = cameras.picture_sensor_dict(scene, width, height)
    depth = scene.render.max_depth if max_depth is None else max_depth
    world["integrator"] = building.integrator_dict(depth, scene.render.rr_depth, hide_emitters=False)
    loaded = mi.load_dict(world, optimize=False)
    passes = _passes(spp, width * height)
    image = np.zeros((height, width))
    for samples, pass_seed in zip(passes, spread_seeds(seed, len(passes)), strict=True):
        film = mi.render(loaded, seed=pass_seed, spp=samples)
        image += np.asarray(film, dtype=np.float64)[..., 0] * (samples / spp)
    return image


def spread_seeds(root: int, count: int) -> list[int]:
    """`count` distinct seeds below 2^32 that follow from one root seed."""
    if root < 0:
        raise InputError(f"is {root}; give a number >= 0", field="seed")
    # Consecutive from a random start: Mitsuba hashes them, and unlike single draws they cannot coincide.
    start = int(np.random.SeedSequence(root).generate_state(1)[0])
    return [(start + index) % 2**32 for index in range(count)]


def _passes(spp: int, pixels: int, most: int | None = None) -> list[int]:
    """Samples per pixel of each pass: powers of two and a rest (see the notes on `Renderer`), or as many as asked for."""
    largest = most or largest_pass(pixels)
    rest = spp % largest
    return [largest] * (spp // largest) + ([rest] if rest else [])


def largest_pass(pixels: int) -> int:
    """Most samples per pixel that one pass over `pixels` pixels takes, a power of two."""
    return max(1, min(_PASS_SAMPLES, 2 ** int(math.log2(_PASS_RAYS / pixels)) if pixels < _PASS_RAYS else 1))


def _moment_variance(first: Array, second: Array, samples: int) -> Array:
    """Variance of the mean of independent samples from their first two moments (see `Render.moment_variance`)."""
    spread = np.maximum(second - first**2, FILM_ROUNDING * second)
    return spread / max(1, samples - 1)


def _check_sampling(spp: int, seeds: Sequence[int], sampler: Sampler, method: VarianceMethod) -> None:
    if spp < 1:
        raise InputError(f"is {spp}; give at least one sample per pixel", field="spp")
    if not seeds or len(set(seeds)) < len(seeds) or not all(0 <= seed < 2**32 for seed in seeds):
        raise InputError("give distinct integers from 0 to 2^32 - 1", field="seeds")
    if method == "moments" and sampler != "independent":
        raise InputError(f'"{sampler}" samples depend on each other; give method = "seeds"', field="method")
    if method == "moments" and spp * len(seeds) < 2:
        raise InputError("is 1; a variance needs at least two samples per pixel", field="spp")
    if method == "seeds" and len(seeds) < 2:
        raise InputError("needs at least two to tell a variance from their scatter", field="seeds")
