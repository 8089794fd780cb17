"""The error of a split: foretold by the bound, measured with drawn noise, and rendered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.foresight import foresee
from wallmirror.derendering.solve import solve
from wallmirror.tradeoff.clock import once
from wallmirror.tradeoff.runs import Run
from wallmirror.tradeoff.splits import Noise, Split, World
from wallmirror.tradeoff.timed_runs import run_of, solved_run
from wallmirror.transport import radiance

Array = NDArray[np.float64]

FORETOLD, DRAWN, RENDERED = "foretold by the bound", "run with drawn noise", "rendered and solved"
#: The thesis's split.
THESIS = (20, 20)

STEP_DEG = 0.5


def foretold_run(group: str, world: World, split: Split, noise: Noise) -> Run:
    """What the bound says of a split, or why it has no say."""
    knobs = {"views": split.views, "realisations": split.realisations, "each": split.each}
    if split.each < 1 and "rendering" in group:
        return Run(
            group=group,
            method=FORETOLD,
            knobs=knobs,
            seconds=math.nan,
            failure="the budget does not pay for one sample a pixel",
        )
    scene = world.seen_by(split.views)
    # The noise's mean square over the patterns: the bound knows it pixel by pixel, and is quicker by the number of patterns.
    std = np.sqrt(np.mean(noise(split) ** 2, axis=-1, keepdims=True))

    def forecast() -> float:
        source = world.source[:, : split.realisations]
        return foresee(scene.observer, scene.card, world.brdf, source, noise=std, step_deg=STEP_DEG).source_error

    error, timing = once(forecast)
    failure = "" if math.isfinite(error) else "the captures would not determine the pattern"
    return run_of(group, FORETOLD, knobs, timing, error if not failure else math.nan, failure=failure)


def chosen_splits(found: Sequence[Run]) -> list[Run]:
    """What is run: the best split, the best with other numbers of realisations, the thesis's, a middling one and the worst."""
    good = sorted((run for run in found if not run.failure), key=lambda r: r.error)
    if not good:
        return []
    best_of = {run.knobs["realisations"]: run for run in reversed(good)}
    thesis = [run for run in good if (run.knobs["views"], run.knobs["realisations"]) == THESIS]
    others = sorted(best_of.values(), key=lambda r: r.error)[:3]
    picked = [*others, *thesis, good[len(good) // 2], good[-1]]
    return list({id(run): run for run in picked}.values())


def drawn_run(group: str, world: World, foretold: Run, noise: Noise, draw: int, seed: int) -> Run:
    """A split solved from films with drawn noise of the variance that was assumed."""
    split = Split(foretold.knobs["views"], foretold.knobs["realisations"], foretold.knobs["each"])
    std = noise(split)
    clean = radiance(world.transport(split.views), world.source[:, : split.realisations])
    rng = np.random.default_rng((43, seed, draw, split.views, split.realisations))
    scene = world.seen_by(split.views)
    captures = CaptureSet(
        observer=scene.observer,
        card=scene.card,
        radiance=clean + std * rng.standard_normal(clean.shape),
        variance=std**2,
    )
    return _solved(group, DRAWN, {**foretold.knobs, "draw": draw}, captures, world, foretold)


def rendered_run(group: str, world: World, foretold: Run, seed: int) -> Run:
    """A split rendered and solved."""
    from wallmirror.pathtracing.filming import render_captures

    views, realisations = foretold.knobs["views"], foretold.knobs["realisations"]
    scene = replace(world.seen_by(views), source=world.source[:, :realisations])
    captures, timing = once(lambda: render_captures(scene, spp=int(foretold.knobs["each"]), seed=seed + 7, max_depth=2))
    return _solved(group, RENDERED, dict(foretold.knobs), captures, world, foretold, rendering=timing.seconds)


def _solved(
    group: str, method: str, knobs: dict[str, Any], captures: CaptureSet, world: World, foretold: Run, **extra: float
) -> Run:
    def solver() -> Array:
        return solve(captures, method="maximum_likelihood", nonnegative=False, step_deg=STEP_DEG).source

    truth = world.source[:, : captures.realisations]
    return solved_run(group, method, knobs, solver, truth, foretold=foretold.error, **extra)
