"""The path tracer over samples, sampler, depth, roulette and variant."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import tabulate
from wallmirror.tradeoff.clock import Timing, once
from wallmirror.tradeoff.forward_task import IMAGE, Task
from wallmirror.tradeoff.runs import Run
from wallmirror.tradeoff.timed_runs import run_of

Array = NDArray[np.float64]

SAMPLERS: tuple[tuple[Any, tuple[int, ...]], ...] = (
    ("independent", (16, 64, 256, 1024, 4096, 16384)),
    ("stratified", (16, 64, 256, 1024, 4096, 16384)),
    ("multijitter", (16, 64, 256, 1024, 4096, 16384)),
    ("orthogonal", (25, 49, 289, 1369, 4489, 17161)),
    ("ldsampler", (16, 64, 256, 1024, 4096, 16384)),
)
_QUICK_SPP = 2000  # samples per pixel up to which the quick run goes
_QUICK_SAMPLERS = ("independent", "multijitter", "orthogonal")
# Nodes of the path tracer's table: fine enough that a linear interpolation does not end its lines early.
TABLE_NODES = 57_601
_SEEDS = 2


def path_tracing_steps(task: Task, *, quick: bool, seed: int) -> list[Callable[[], list[Run]]]:
    """One step for each line of the path tracer, so that progress can be told."""
    steps: list[Callable[[], list[Run]]] = [
        partial(
            rendered_runs, task, f"Mitsuba, {sampler}", tuple(n for n in counts if not quick or n < _QUICK_SPP), seed=seed,
            sampler=sampler,
        )
        for sampler, counts in SAMPLERS if not quick or sampler in _QUICK_SAMPLERS
    ]  # fmt: skip
    if quick:
        steps.append(
            partial(
                rendered_runs,
                task,
                "Mitsuba, depth 50, roulette from 5",
                (64, 1024),
                seed=seed,
                max_depth=50,
                rr_depth=5,
            )
        )
        return steps
    some = (64, 256, 1024, 4096)
    variations: tuple[tuple[str, dict[str, Any]], ...] = (
        ("Mitsuba, depth 8", {"max_depth": 8}),
        ("Mitsuba, depth 50, roulette from 5", {"max_depth": 50, "rr_depth": 5}),
        ("Mitsuba, rgb", {"variant": "llvm_ad_rgb"}),
    )
    steps += [partial(rendered_runs, task, name, some, seed=seed, **options) for name, options in variations]
    steps.append(partial(rendered_runs, task, "Mitsuba, scalar", (4,), seed=seed, variant="scalar_rgb", seeds=1))
    return steps


def rendered_runs(
    task: Task,
    method: str,
    counts: Sequence[int],
    *,
    seed: int,
    sampler: Any = "independent",
    max_depth: int = 2,
    rr_depth: int = 1000,
    variant: str = "llvm_ad_mono",
    seeds: int = _SEEDS,
) -> list[Run]:
    """One line of the path tracer: the image with so many samples per pixel each."""
    from wallmirror.pathtracing.rendering import Renderer, spread_seeds

    scene = replace(task.scene, wall=replace(task.scene.wall, brdf=tabulate(task.parts[2], TABLE_NODES)))
    renderer = Renderer(scene, variant=variant, pass_samples=max(counts))

    def image(spp: int, number: int, views: range) -> Array:
        # Where the samples are not independent, two seeds are what a variance needs; both are kept, each its own image.
        render = partial(
            renderer.render,
            radiances=task.pattern[:, 0],
            spp=spp,
            max_depth=max_depth,
            rr_depth=rr_depth,
            sampler=sampler,
        )
        return np.stack([render(view, seeds=spread_seeds(number, seeds), method="seeds" if seeds > 1 else None).per_seed
                         for view in views], axis=1)  # fmt: skip

    runs = []
    for spp in counts:
        image(spp, seed, range(1))  # compiles
        films, timing = once(partial(image, spp, seed + 1, range(scene.observer.views)))
        error = math.sqrt(float(np.mean([task.error(films[s][..., None]) ** 2 for s in range(seeds)])))
        knobs = {"spp": spp, "sampler": sampler, "max depth": max_depth, "roulette from": rr_depth, "variant": variant}
        share = Timing(timing.seconds / seeds, timing.wall_seconds / seeds, seeds)
        runs.append(run_of(IMAGE, method, knobs, share, error, work=float(spp), images=float(seeds)))
    return runs
