"""`wallmirror validate --bounces`: does Hypothesis 2, "one bounce is enough", hold in these scenes?"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.console import Advance
from wallmirror.files import write_atomically
from wallmirror.jobs.bouncing import DEEP, TOLERANCES, Bounces, measure_bounces, summary
from wallmirror.pathtracing.rendering import picture
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.figures import one_tone, scene_plan
from wallmirror.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Effort:
    """Views, seeds and samples per pixel of each seed, and the pictures' samples."""

    views: int
    seeds: int
    spp: int
    picture_spp: int


EFFORT = Effort(views=3, seeds=12, spp=256, picture_spp=128)
QUICK_EFFORT = Effort(views=1, seeds=6, spp=256, picture_spp=16)
_PICTURE = (480, 270)


@dataclass(frozen=True)
class BounceVerdict:
    """One scene's Neumann series, with pictures of one bounce and of all.

    Parameters
    ----------
    pictures:
        Radiance that a visitor would see at depths 2 and DEEP, each (height, width).
    tolerance:
        Share of the light that one bounce may leave out; None where only measurement was asked for.
    """

    scene: Scene
    bounces: Bounces
    pictures: tuple[Array, Array]
    tolerance: float | None
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether one bounce is enough within the tolerance, or none was asked for."""
        return self.tolerance is None or self.bounces.verdict(self.tolerance) == "holds"

    @property
    def text(self) -> str:
        """One sentence on the scene."""
        name = self.scene.name
        if self.bounces.exact:
            return f"{name}: one bounce is all there is, to the bit"
        asked = TOLERANCES if self.tolerance is None else (self.tolerance,)
        found = "; ".join(f"within {100 * t:g} % it {_SAID[self.bounces.verdict(t)]}" for t in asked)
        return f"{name}: one bounce leaves out {self.bounces.beyond.percent}; {found}"

    def summary(self) -> dict[str, Any]:
        """The scene's part of bounces.json."""
        return {**summary(self.bounces), "tolerance": self.tolerance, "passed": self.passed, "seconds": self.seconds}


_SAID = {"holds": "is enough", "fails": "is not enough", "undecided": "stays undecided"}


def count_bounces(
    scenes: list[Scene],
    out: Path,
    *,
    tolerance: float | None = None,
    quick: bool = False,
    views: int | None = None,
    spp: int | None = None,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> list[BounceVerdict]:
    """Measure the Neumann series of several scenes; leaves bounces.json and bounces.html in a folder.

    Parameters
    ----------
    tolerance:
        Share of the one-bounce light that may be left out; without one the series are only measured.
    quick:
        One view and few seeds.
    views, spp:
        Views to look at and samples per pixel of each seed, where they are not to be the default's.
    """
    effort = QUICK_EFFORT if quick else EFFORT
    results = []
    for number, scene in enumerate(scenes):
        started = time.perf_counter()
        bounces = measure_bounces(
            scene, views=views or effort.views, spp=spp or effort.spp, seeds=effort.seeds, seed=seed, variant=variant
        )
        one, deep = (
            picture(scene, *_PICTURE, spp=effort.picture_spp, max_depth=depth, seed=seed, variant=variant)
            for depth in (2, DEEP)
        )
        results.append(BounceVerdict(scene, bounces, (one, deep), tolerance, time.perf_counter() - started))
        if progress is not None:
            progress(number + 1, len(scenes))
    write_page(
        out / "bounces.html",
        title="Is one bounce enough? Light by the number of its reflections",
        lead="Hypothesis 2 says that light which the wall reflects once is all that matters. Here the path tracer counts: "
        "renders of growing depth share their random numbers, and their differences are the single bounces.",
        verdicts=[Verdict(_colour(r), r.text) for r in results],
        sections=[section(r) for r in results],
    )
    write_atomically(out / "bounces.json", json.dumps([r.summary() for r in results], indent=2, allow_nan=False) + "\n")
    return results


def _colour(result: BounceVerdict) -> bool | None:
    """Green or red where a tolerance was asked for or nothing is left out at all."""
    return True if result.bounces.exact else None if result.tolerance is None else result.passed


def section(result: BounceVerdict) -> Section:
    """The report's section on one scene: prose, plan, pictures, series."""
    scene = result.scene
    return Section(
        scene.title,
        (
            scene.about,
            Verdict(_colour(result), result.text),
            FigureBlock(
                scene_plan(scene.observer, scene.card, half_width=scene.wall.half_width, room=scene.room),
                "The scene from above, to scale.",
            ),
            FigureBlock(
                one_tone(result.pictures, ("one bounce", f"{DEEP - 1} bounces")),
                "What a visitor beside the observer would see, both on one tone scale. White dots are paths that found a "
                "bright strip by chance.",
            ),
            *(() if result.bounces.exact else (series(result.bounces),)),
        ),
    )


def series(bounces: Bounces) -> TableBlock:
    """The terms of the Neumann series in a table."""
    rows = [(f"after {k} reflections", term.percent, "") for k, term in enumerate(bounces.terms, start=2)]
    for k, ratio in enumerate(bounces.ratios, start=1):
        if k + 2 <= len(bounces.terms) + 1:
            old = rows[k + 2 - 2]
            rows[k + 2 - 2] = (old[0], old[1], ratio.percent)
    bound = "no bound" if math.isinf(bounces.tail_bound) else f"at most {100 * bounces.tail_bound:.2g} %"
    rows.append((f"all further, to depth {DEEP}", bounces.rest.percent, f"{bound} by the ratios"))
    rows.append(("all beyond one bounce", bounces.beyond.percent, ""))
    return TableBlock(
        ("light that reached the camera", "share of the one-bounce light", "ratio to two reflections before"),
        tuple(rows),
    )
