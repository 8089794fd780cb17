"""The thesis's rendered pictures (Figs. 1.5, 2.2 to 2.7 and 2.11), path traced again with Mitsuba.

Pictures of one pair are one study, made once: the figure of fifty bounces and that of one share random numbers, tone
scale and numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from wallmirror.jobs.bouncing import DEEP
from wallmirror.jobs.picturing import WHOLE
from wallmirror.picture_reading import load_picture
from wallmirror.report.figures import pictures
from wallmirror.thesis.figure import Claim, ThesisFigure
from wallmirror.thesis.picture_claims import judge
from wallmirror.thesis.studies import Effort, PictureStudy, study

Array = NDArray[np.float64]

_BOTH = ("one bounce", f"{DEEP - 1} bounces")
_EFFORT = Effort()


@cache
def _studied(name: str, seed: int) -> tuple[PictureStudy, tuple[Claim, ...]]:
    studied = study(load_picture(name), _EFFORT, seed=seed)
    return studied, judge(studied, _EFFORT)


def _picture(figure_id: str, name: str, shown: str, seed: int) -> ThesisFigure:
    """The picture of a scene at one bounce, at all, or at both; the claims go with the one-bounce picture."""
    studied, claims = _studied(name, seed)
    one, deep = studied.images
    shown_images: dict[str, tuple[tuple[Array, ...], tuple[str, ...]]] = {
        "one": ((one,), _BOTH[:1]),
        "deep": ((deep,), _BOTH[1:]),
        "both": ((one, deep), _BOTH),
    }
    images, captions = shown_images[shown]
    if studied.found[WHOLE].exact:
        images, captions = (deep,), (f"one bounce and {DEEP - 1}: the same to the bit",)
    shares = {region: bounces.missing for region, bounces in studied.found.items()}
    return ThesisFigure(
        id=figure_id,
        title=studied.scene.title,
        about=" ".join(studied.scene.about.split()),
        figure=pictures(images, captions),
        columns={
            "region": list(shares),
            "share of reflected light beyond one bounce": [share.value for share in shares.values()],
            "standard error": [share.error for share in shares.values()],
        },
        numbers={f"missing with one bounce, {region}": share.value for region, share in shares.items()},
        claims=() if shown == "deep" else claims,
    )


_PICTURES = {
    "1.5": ("thesis_spheres", "deep"),
    "2.2": ("thesis_field", "deep"),
    "2.3": ("thesis_field", "one"),
    "2.4": ("thesis_box_diffuse", "deep"),
    "2.5": ("thesis_box_diffuse", "one"),
    "2.6": ("thesis_box_mirror", "deep"),
    "2.7": ("thesis_box_mirror", "one"),
    "2.11": ("thesis_test_wall", "both"),
    "2.11-tilted": ("thesis_tilted_mirrors", "both"),
}

FIGURES: dict[str, Callable[[int], ThesisFigure]] = {
    figure_id: partial(_picture, figure_id, name, shown) for figure_id, (name, shown) in _PICTURES.items()
}
