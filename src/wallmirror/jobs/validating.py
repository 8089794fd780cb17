"""`wallmirror validate`: is the one-bounce model what a path tracer renders, and how small a fault would show?"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from wallmirror.console import Advance
from wallmirror.files import write_atomically
from wallmirror.jobs.validating_one import SPP, VIEWS, Validation, validate_scene
from wallmirror.jobs.validation_report import section, verdict
from wallmirror.report import write_page
from wallmirror.scene import Scene


def validate_scenes(
    scenes: list[Scene],
    out: Path,
    *,
    views: int | None = None,
    spp: int | None = None,
    tolerance: float | None = None,
    effort: Callable[[Scene], tuple[int, int]] = lambda _: (VIEWS, SPP),
    seed: int = 0,
    progress: Advance | None = None,
) -> list[Validation]:
    """Validate several scenes; leaves results.json and report.html in a folder.

    Scenes that one bounce cannot tell apart (a white card or a black one) are rendered once.

    Parameters
    ----------
    views, spp:
        As for `validate_scene`; those of `effort` where left out.
    tolerance:
        Gain error that each run must be able to see, or else does not pass.
    effort:
        Views and samples per pixel for a scene, such as a plan's.
    """
    results: list[Validation] = []
    rendered: dict[bytes, Validation] = {}
    for number, scene in enumerate(scenes):
        met = _met_at_one_bounce(scene)
        earlier = rendered.get(met)
        if earlier is None:
            planned = effort(scene) if views is None or spp is None else (views, spp)
            found = validate_scene(scene, views=views or planned[0], spp=spp or planned[1], seed=seed)
            rendered[met] = replace(found, tolerance=tolerance)
            results.append(rendered[met])
        else:
            results.append(replace(earlier, scene=scene, seconds=0.0, same_as=earlier.scene.name))
        if progress is not None:
            progress(number + 1, len(scenes))
    write_page(
        out / "report.html",
        title="Does the model hold? Analytic one-bounce transport against Mitsuba 3",
        lead="Every scene is rendered by a path tracer that shares no code with the model, with independent seeds, and "
        "compared pixel by pixel. A pass says what bias would have been caught, not only that none was.",
        verdicts=[verdict(r) for r in results],
        sections=[section(r) for r in results],
    )
    write_atomically(out / "results.json", json.dumps([r.summary() for r in results], indent=2, allow_nan=False) + "\n")
    return results


def _met_at_one_bounce(scene: Scene) -> bytes:
    """All of a scene that paths of one bounce meet: the card's board and albedo are not of it."""
    card = replace(scene.card, albedo=0.0, board_width=0.0, board_height=0.0)
    return pickle.dumps((scene.observer, card, scene.wall, scene.room, scene.source.tolist()))
