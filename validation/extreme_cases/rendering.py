"""The path tracer against the model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

import wallmirror as wm
from wallmirror.jobs.validating_one import validate_scene

from .harness import Case
from .scenes import card, lobes, observer


def cases() -> Iterator[Case]:
    """Mitsuba against the model: right if no test rejects it and the gain is off by less than would have been seen."""

    def each(quantity: str, value: str, **changes: Any) -> Case:
        def check() -> tuple[float, float]:
            options = dict(changes)
            brdf = options.pop("brdf", lobes(15.0))
            level = options.pop("level", 1.0)
            eye = options.pop("observer", observer(pixels=24))
            strips = options.pop("card", card())
            wide = 4 * float(np.abs(wm.wall_points(eye)).max())
            scene = wm.Scene(
                name="extreme",
                title="",
                about="",
                observer=eye,
                card=strips,
                wall=wm.Wall(brdf=brdf, half_width=wide, half_height=wide),
                source=np.full((strips.elements, 1), level),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("default")  # those of the path tracer are not ours
                found = validate_scene(scene, views=3, spp=256)
            gain = found.comparison.gain
            if found.comparison.kept == 0:
                raise wm.UndeterminedError("every pixel shows a strip or an edge, so that nothing could be compared")
            # What the run could have seen is its tolerance; a run that would see nothing is no check.
            if not found.passed:
                raise RuntimeError(f"rejected: gain {gain.estimate:+.1e}, largest z {found.comparison.largest_z:.1f}")
            return (abs(gain.estimate) if gain.detectable < 0.5 else math.inf), max(gain.detectable, 1e-5)

        return Case("validate_scene", quantity, value, check)

    for factor in (1e-6, 1e-3, 1e3, 1e8):
        yield each("whole scene", f"x {factor:g}", observer=observer(position=(0.0, -5 * factor), pixels=24), card=card(
            elements_x=(-factor, 0.2 * factor, 1.1 * factor), y=-factor,
            element_width=0.02 * factor, element_height=0.03 * factor))  # fmt: skip
    for metres in (1e-6, 1e-4, 1e-2, 1e2, 1e4):
        yield each("card's distance", f"{metres:g} m", card=card(y=-metres))
    for level in (1e-300, 1e-36, 1e-30, 1e30, 1e37, 1e300):
        yield each("radiance", f"{level:g}", level=level)
    for degrees in (1e-3, 0.1, 1.0, 90.0):
        yield each("lobe's width", f"{degrees:g}°", brdf=lobes(degrees))
    for degrees in (45.0, 59.0, 59.9):
        yield each("view angle", f"{degrees:g}°", observer=observer(view_angles=(math.radians(degrees),), pixels=24))
    for number in (1, 2):
        yield each("pixels N", str(number), observer=observer(pixels=number))
