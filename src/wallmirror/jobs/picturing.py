"""Hypothesis 2 measured on a picture: how much of the light of a glass sphere or a wall one bounce leaves out.

Light that was reflected k times is the difference of depths k + 1 and k. A picture also shows what shines directly,
depth 1, which no bounce can leave out; it is taken off every depth with the same random numbers, so that what remains
has been reflected at least once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.console import Advance
from wallmirror.errors import InputError
from wallmirror.jobs.bouncing import DEEP, TERMS, Bounces, Measured, series_of
from wallmirror.pathtracing.picturing import PictureRenderer
from wallmirror.pathtracing.rendering import spread_seeds
from wallmirror.picture_scene import PictureScene

Array = NDArray[np.float64]

_RR_DEPTH = 5


#: Key of the whole picture among the regions.
WHOLE = "whole picture"


@dataclass(frozen=True, kw_only=True)
class RegionBounces:
    """The light of each bounce over one region of a picture.

    Parameters
    ----------
    series:
        Its Neumann series, in units of the region's one-bounce light; None where one bounce brings no light at all.
    """

    series: Bounces | None

    @property
    def exact(self) -> bool:
        """Whether one bounce gives all the light, to the bit."""
        return self.series is not None and self.series.exact

    @property
    def missing(self) -> Measured:
        """Share of ALL the reflected light that one bounce leaves out: b / (1 + b) with b = `Bounces.beyond`."""
        if self.series is None:
            return Measured(1.0, 0.0, 1.0, 1.0)
        beyond = self.series.beyond
        value, low, high = (b / (1 + b) for b in (beyond.value, max(beyond.low, 0.0), beyond.high))
        return Measured(value, beyond.error / (1 + beyond.value) ** 2, low, high)


def measure_picture_bounces(
    scene: PictureScene,
    *,
    width: int = 320,
    spp: int = 4,
    seeds: int = 8,
    seed: int = 0,
    variant: str = "llvm_ad_rgb",
    progress: Advance | None = None,
) -> dict[str, RegionBounces]:
    """Measure the terms of a picture's Neumann series by depth differences with common random numbers.

    Light is the mean over pixels and over red, green and blue.

    Parameters
    ----------
    width:
        Of the picture that is measured, in the proportions of the scene's own.
    spp, seeds, seed:
        Samples per pixel of each seed (1, 4, 16, ... render alike to the bit), number of seeds (at least 4), and
        their root.

    Returns
    -------
    By name of the region, and under WHOLE over all pixels.

    Raises
    ------
    InputError
        For too few seeds, and for a region that no pixel shows or that is dark at every depth.
    """
    settings = scene.render
    height = max(1, round(width * settings.height / settings.width))
    renderer = PictureRenderer(scene, width=width, height=height, variant=variant)
    masks = {WHOLE: np.ones((height, width), dtype=np.bool_), **renderer.regions()}
    depths = (*range(1, TERMS + 2), DEEP)
    light = {name: np.zeros((seeds, len(depths))) for name in masks}
    exact = dict.fromkeys(masks, True)
    for number, root in enumerate(spread_seeds(seed, seeds)):
        one_bounce = np.zeros(0)
        for place, depth in enumerate(depths):
            image = renderer.render(depth, spp=spp, seeds=(root,), rr_depth=_RR_DEPTH).per_seed[0]
            one_bounce = image if depth == 2 else one_bounce
            for name, mask in masks.items():
                light[name][number, place] = image[mask].mean()
                if depth == DEEP:
                    exact[name] = exact[name] and bool(np.array_equal(image[mask], one_bounce[mask]))
        if progress is not None:
            progress(number + 1, seeds)
    return {name: _region(f"{scene.name}, {name}", every, exact[name]) for name, every in light.items()}


def _region(name: str, light: Array, exact: bool) -> RegionBounces:
    """From the light of each seed at depths 1, 2, ..., TERMS + 1 and DEEP."""
    reflected = light[:, 1:] - light[:, :1]
    if not reflected[:, -1].any():
        raise InputError("is dark at every depth; leave it out", field=name)
    return RegionBounces(series=series_of(name, reflected, exact=exact) if reflected[:, 0].any() else None)
