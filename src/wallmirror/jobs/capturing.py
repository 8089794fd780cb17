"""`wallmirror capture`: a scene in, a capture set out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from wallmirror.brdf import AngleSumBRDF, tabulate
from wallmirror.captures import CaptureSet, Truth, write_captures
from wallmirror.console import Advance
from wallmirror.pathtracing.filming import render_captures
from wallmirror.planning import CapturePlan
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
    progress: Advance | None = None,
) -> CaptureSet:
    """Render every view of every realisation of a scene and write them as a capture set with its truth.

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

    Raises
    ------
    InputError
        If the folder holds something else, or the scene cannot be rendered.
    """
    if plan is None:
        captures = render_captures(scene, spp=spp, seed=seed, max_depth=max_depth, variant=variant, progress=progress)
    else:
        captures = film_as_planned(
            scene, plan, spp=spp, seed=seed, max_depth=max_depth, variant=variant, progress=progress
        )
    write_captures(out, captures, settings=dict(captures.provenance), truth=truth_of(scene))
    return captures


def film_as_planned(
    scene: Scene,
    plan: CapturePlan,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
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
    )
    if not whole:
        return captures
    # What was promised goes with the films, as far as they are what was planned.
    promise = {"tolerance": f"{plan.tolerance:g}", "predicted_error": f"{plan.error:.3g}"}
    return replace(captures, provenance={**captures.provenance, **promise})


def truth_of(scene: Scene) -> Truth:
    """Pattern and BRDF that a scene is made of, to judge a solution by; without a BRDF that is no function of u."""
    u = np.linspace(-math.pi, math.pi, _TRUTH_NODES)
    if not isinstance(scene.wall.brdf, AngleSumBRDF):
        u = u[:0]
        return Truth(source=scene.source, theta_s=u, theta_o=u, brdf=u)
    return Truth(source=scene.source, theta_s=u / 2, theta_o=u / 2, brdf=scene.wall.brdf.of_sum(u))
