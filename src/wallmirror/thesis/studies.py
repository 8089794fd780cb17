"""A picture that the thesis rendered, made again at one bounce and at fifty: what one bounce leaves out, and where.

The pictures are `wallmirror/scenes/pictures`; what the thesis says about them is judged in `picture_claims`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wallmirror.jobs.bouncing import DEEP
from wallmirror.jobs.picturing import RegionBounces, measure_picture_bounces
from wallmirror.pathtracing.picturing import PictureRenderer
from wallmirror.picture_scene import PictureScene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PASS_SPP = 4
#: A pass beyond this many times the pixel's median plus this share of white is cut there, in pictures alone.
SPARK = (2.0, 0.2)


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What a study spends: on the pictures, and on the numbers of regions.

    Parameters
    ----------
    width, passes:
        Of the pictures, in pixels and in passes of PASS_SPP samples per pixel.
    measured_width, seeds, spp:
        Of the render that is measured: pixels, seeds (at least 4), and samples per pixel of each.
    """

    width: int = 320
    passes: int = 9
    measured_width: int = 160
    seeds: int = 8
    spp: int = 4


@dataclass(frozen=True, kw_only=True)
class PictureStudy:
    """One picture studied.

    Parameters
    ----------
    one, deep:
        Radiance at one bounce and at DEEP - 1, by pass, shape (passes, height, width, 3), with common random numbers.
    found:
        Light of each bounce by region.
    """

    scene: PictureScene
    one: Array = field(repr=False)
    deep: Array = field(repr=False)
    found: dict[str, RegionBounces]

    @property
    def images(self) -> tuple[Array, Array]:
        """Both pictures for the eye, without sparks, white at 1."""
        white = white_of(self.deep.mean(axis=0))
        one, deep = (without_sparks(passes, white) / white for passes in (self.one, self.deep))
        return one, deep


def study(scene: PictureScene, effort: Effort, *, seed: int = 0) -> PictureStudy:
    """Render a picture at one bounce and at all, and measure what one bounce leaves out."""
    one, deep = renders(scene, effort.width, effort.passes)
    return PictureStudy(scene=scene, one=one, deep=deep, found=measure(scene, effort, seed=seed))


def measure(scene: PictureScene, effort: Effort, *, seed: int = 0) -> dict[str, RegionBounces]:
    """The light of each bounce by region, at the effort's size."""
    return measure_picture_bounces(scene, width=effort.measured_width, spp=effort.spp, seeds=effort.seeds, seed=seed)


def renders(scene: PictureScene, width: int, passes: int) -> tuple[Array, Array]:
    """One bounce and all, by pass: two arrays (passes, height, width, 3) with common random numbers."""
    height = round(width * scene.render.height / scene.render.width)
    renderer = PictureRenderer(scene, width=width, height=height)
    one, deep = (renderer.render(depth, spp=PASS_SPP, seeds=range(passes)).per_seed for depth in (2, DEEP))
    return one, deep


def white_of(image: Array) -> float:
    """Radiance to show as white: what all but the brightest 3 % of the lit pixels stay below."""
    light = image.mean(axis=-1) if image.ndim == 3 else image
    return float(np.quantile(light[light > 0], 0.97))


def without_sparks(per_pass: Array, white: float) -> Array:
    """Mean over the passes, after cutting what a rare bright path left in one of them."""
    cut: Array = np.minimum(per_pass, SPARK[0] * np.median(per_pass, axis=0) + SPARK[1] * white).mean(axis=0)
    return cut


def difference_of_shape(one: Array, deep: Array, mask: Mask, block: int = 8) -> float:
    """Relative difference of two pictures over a mask after the best common factor, noise taken out.

    The pictures are averaged over blocks of pixels that lie inside the mask; two halves of the passes have independent
    noise, so that the product of their differences has none on average.
    """
    height, width = (size // block * block for size in mask.shape)

    def blocks(image: Array) -> Array:
        means = image[:height, :width].reshape(height // block, block, width // block, block, -1).mean(axis=(1, 3))
        inside = mask[:height, :width].reshape(height // block, block, width // block, block).all(axis=(1, 3))
        chosen: Array = means[inside]
        return chosen

    halves = []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        a, b = blocks(one[half].mean(axis=0)), blocks(deep[half].mean(axis=0))
        halves.append((np.sum(a * b) / np.sum(a * a) * a - b, b))
    product = float(np.sum(halves[0][0] * halves[1][0]) / np.sum(halves[0][1] * halves[1][1]))
    return math.sqrt(max(0.0, product))


def angle_sums(scene: PictureScene, image: Array) -> list[float]:
    """Angle sums in degrees at which a card beside the axis shows in the columns of a picture, from left to right."""
    eye, card = scene.camera.position, scene.shape("card").geometry.centre
    height, width = image.shape[:2]
    half = math.tan(scene.camera.fov / 2) * width / height
    x = -eye[1] * half * ((np.arange(width) + 0.5) / width * 2 - 1)
    u = np.degrees(np.arctan2(card[0] - x, -card[1]) + np.arctan2(eye[0] - x, -eye[1]))
    light = image.mean(axis=(0, 2))
    found = []
    for side in (x < 0, x > 0):
        share = np.cumsum(light[side]) / light[side].sum()
        between = np.flatnonzero((share > 0.3) & (share < 0.7))
        smooth = np.convolve(light[side], np.ones(5) / 5, "same")
        cut = between[np.argmin(smooth[between])]
        for part in (slice(0, cut), slice(cut, None)):
            found.append(float(np.average(u[side][part], weights=light[side][part])))
    return found
