"""`wallmirror capture`: a scene in, a capture set out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from wallmirror.brdf import AngleSumBRDF
from wallmirror.captures import CaptureSet, Truth, write_captures
from wallmirror.console import Advance
from wallmirror.pathtracing.filming import render_captures
from wallmirror.scene import Scene

_TRUTH_NODES = 7201


def capture_scene(
    scene: Scene,
    out: Path,
    *,
    spp: int | None = None,
    seed: int = 0,
    max_depth: int | None = None,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> CaptureSet:
    """Render every view of every realisation of a scene and write them as a capture set with its truth.

    Parameters
    ----------
    out:
        Folder to write; an earlier capture set of ours there is replaced, anything else is refused.
    spp, max_depth:
        Samples per pixel and path depth; the scene's own where left out.
    seed:
        Root of all random numbers.

    Raises
    ------
    InputError
        If the folder holds something else, or the scene cannot be rendered.
    """
    captures = render_captures(scene, spp=spp, seed=seed, max_depth=max_depth, variant=variant, progress=progress)
    write_captures(out, captures, settings=dict(captures.provenance), truth=truth_of(scene))
    return captures


def truth_of(scene: Scene) -> Truth:
    """Pattern and BRDF that a scene is made of, to judge a solution by; without a BRDF that is no function of u."""
    u = np.linspace(-math.pi, math.pi, _TRUTH_NODES)
    if not isinstance(scene.wall.brdf, AngleSumBRDF):
        u = u[:0]
        return Truth(source=scene.source, theta_s=u, theta_o=u, brdf=u)
    return Truth(source=scene.source, theta_s=u / 2, theta_o=u / 2, brdf=scene.wall.brdf.of_sum(u))
