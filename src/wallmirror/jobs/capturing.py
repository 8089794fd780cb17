"""`wallmirror capture`: a scene in, a capture set out."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wallmirror.brdf import AngleSumBRDF, tabulate
from wallmirror.captures import CaptureSet, Truth
from wallmirror.captures.unfinished import UnfinishedSet, unfinished_settings
from wallmirror.captures.writing import require_replaceable
from wallmirror.console import Advance
from wallmirror.errors import InputError
from wallmirror.pathtracing.filming import Store, render_captures
from wallmirror.planning import CapturePlan, Sampling, Term
from wallmirror.scene import Scene

_TRUTH_NODES = 7201


def capture_scene(
    scene: Scene,
    out: Path,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    plan: CapturePlan | None = None,
    variant: str = "llvm_ad_mono",
    restart: bool = False,
    progress: Advance | None = None,
) -> CaptureSet:
    """Render every view of every realisation of a scene and write them as a capture set with its truth.

    A run that was cut short, even by a kill, goes on where it was when the same is asked again: finished captures are
    kept beside the folder (`wallmirror.captures.unfinished`), and the set takes its place once all are there. The
    result is then the same to the bit as without the interruption, as far as a render repeats itself (`Renderer`).

    Parameters
    ----------
    out:
        Folder to write; an earlier capture set of ours there is replaced, anything else is refused.
    spp, max_depth:
        Samples per pixel and path depth; the plan's where left out, or else the scene's own.
    plan:
        Sampler, samples, seeds, depth and BRDF table of `advise`. Samples that are given are independent ones.
    seed:
        Root of all random numbers.
    restart:
        Throw away what an unfinished run left.

    Returns
    -------
    The captures as they are stored: float32, before `read_captures` adds the variance of that rounding.

    Raises
    ------
    InputError
        If the folder holds something else or cannot be written, the scene cannot be rendered, or an unfinished run
        with other settings left captures.
    """
    require_replaceable(out.resolve())
    stores: list[UnfinishedSet] = []

    def open_store(provenance: dict[str, str]) -> UnfinishedSet:
        settings: dict[str, Any] = {**provenance, "scene_sha256": fingerprint(scene)}
        if plan is not None:
            settings["plan"] = json.loads(json.dumps(asdict(plan)))
        stores.append(UnfinishedSet(out, settings, restart=restart))
        return stores[-1]

    try:
        if plan is None:
            captures = render_captures(
                scene,
                spp=spp,
                seed=seed,
                max_depth=max_depth,
                variant=variant,
                progress=progress,
                open_store=open_store,
            )
        else:
            captures = film_as_planned(
                scene,
                plan,
                spp=spp,
                seed=seed,
                max_depth=max_depth,
                variant=variant,
                progress=progress,
                open_store=open_store,
            )
        stores[-1].finish(captures, truth_of(scene))
    finally:
        for store in stores:
            store.close()
    return captures


def planned_before(scene: Scene, out: Path, tolerance: float) -> CapturePlan | None:
    """The plan of an unfinished capture of this scene to this tolerance: plans rest on timings and differ each time."""
    settings = unfinished_settings(out) or {}
    try:
        plan = dict(settings["plan"])
        plan["sampling"] = Sampling(**plan["sampling"])
        plan["terms"] = tuple(Term(**term) for term in plan["terms"])
        found = CapturePlan(**plan)
    except (KeyError, TypeError):
        return None
    return found if found.tolerance == tolerance and settings.get("scene_sha256") == fingerprint(scene) else None


def film_as_planned(
    scene: Scene,
    plan: CapturePlan,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
    open_store: Callable[[dict[str, str]], Store] | None = None,
) -> CaptureSet:
    """Render a capture set with a plan's settings, as far as no explicit one beats them."""
    sampling, brdf = plan.sampling, scene.wall.brdf
    whole = spp is None and max_depth is None
    if plan.table_nodes is not None and isinstance(brdf, AngleSumBRDF):
        scene = replace(scene, wall=replace(scene.wall, brdf=tabulate(brdf, plan.table_nodes)))
    captures = render_captures(
        scene,
        spp=sampling.spp if spp is None else spp,
        seeds=sampling.seeds if spp is None else 1,
        sampler=sampling.sampler if spp is None else "independent",
        seed=seed,
        max_depth=plan.max_depth if max_depth is None else max_depth,
        rr_depth=plan.rr_depth if max_depth is None else None,
        variant=variant,
        progress=progress,
        open_store=open_store,
    )
    if not whole:
        return captures
    # What was promised goes with the films, as far as they are what was planned.
    promise = {"tolerance": f"{plan.tolerance:g}", "predicted_error": f"{plan.error:.3g}"}
    return replace(captures, provenance={**captures.provenance, **promise})


def fingerprint(scene: Scene) -> str:
    """A checksum of all that a scene's films depend on: everything but its texts."""
    return hashlib.sha256(repr(_plain(replace(scene, title="", about=""))).encode()).hexdigest()


def _plain(value: Any) -> Any:
    """A value as nested tuples of numbers and texts, whose repr tells different ones apart."""
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__, *((f.name, _plain(getattr(value, f.name))) for f in fields(value))
    if isinstance(value, np.ndarray):
        return value.shape, hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()
    if isinstance(value, tuple | list):
        return tuple(_plain(entry) for entry in value)
    if isinstance(value, bool | int | float | str | None):
        return value
    raise InputError(f"holds a {type(value).__name__}, which no scene file can hold", field="scene")


def truth_of(scene: Scene) -> Truth:
    """Pattern and BRDF that a scene is made of, to judge a solution by; without a BRDF that is no function of u."""
    u = np.linspace(-math.pi, math.pi, _TRUTH_NODES)
    if not isinstance(scene.wall.brdf, AngleSumBRDF):
        u = u[:0]
        return Truth(source=scene.source, theta_s=u, theta_o=u, brdf=u)
    return Truth(source=scene.source, theta_s=u / 2, theta_o=u / 2, brdf=scene.wall.brdf.of_sum(u))
