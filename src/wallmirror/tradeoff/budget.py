"""Budget: so many seconds of rendering, or photons of exposure, split between views, realisations and samples.

The Cramér-Rao bound foretells the error of every split (`foresee`), a few splits are run with noise of the variance that was
assumed, and of those some are rendered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from wallmirror.scene import load_scene
from wallmirror.tradeoff.budget_words import conclude
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement
from wallmirror.tradeoff.split_runs import STEP_DEG, chosen_splits, drawn_run, foretold_run, rendered_run
from wallmirror.tradeoff.splits import (
    READ_NOISE,
    Noise,
    Split,
    World,
    exposure,
    measure_costs,
    samples,
    sampling_noise,
    shot_noise,
)

Advance = Callable[[int, int], None]


def budget(*, quick: bool = False, seed: int = 0, mitsuba: bool = True, progress: Advance | None = None) -> Panel:
    """Measure the panel; without `mitsuba` the costs of rendering are not measured and only photons are split."""
    scene = load_scene("flat_wall_lobes")
    scene = replace(scene, observer=replace(scene.observer, pixels=100 if quick else 200))
    views, realisations = ((3, 20), (4, 20)) if quick else ((2, 3, 5, 10, 20, 40), (4, 6, 10, 20, 40))
    source = scene.source.max() * np.random.default_rng((41, seed)).random((scene.card.elements, max(realisations)))
    world = World(scene, source)
    runs: list[Run] = []
    conclusions: list[Statement] = []
    numbers: dict[str, Any] = {}
    omissions = [Omission("splits with fewer realisations than elements", "they need the search for few captures")]
    groups: list[tuple[str, Noise, Callable[[int, int], float], bool]] = []
    for photons in (1e4,) if quick else (1e3, 1e5):
        groups.append((f"{photons:g} photons a pixel in all", shot_noise(photons, world), exposure, False))
    if mitsuba:
        costs = measure_costs(world, spp=256, seed=seed)
        numbers["costs"] = vars(costs)
        for seconds in (1.0,) if quick else (2.0, 20.0):
            split = partial(samples, seconds, costs)
            groups.append((f"{seconds:g} s of rendering", sampling_noise(costs, world), split, True))
    else:
        omissions.append(Omission("rendering", "left out on request"))
    for number, (group, noise, each, rendered) in enumerate(groups):
        splits = [Split(a, b, each(a, b)) for a in views for b in realisations]
        found = [foretold_run(group, world, split, noise) for split in splits]
        runs += found
        chosen = chosen_splits(found)
        measured = [
            drawn_run(group, world, run, noise, draw, seed) for run in chosen for draw in range(1 if quick else 4)
        ]
        if rendered:
            measured += [rendered_run(group, world, run, seed) for run in chosen[: 1 if quick else 3]]
        runs += measured
        conclusions += conclude(group, found, measured)
        if progress is not None:
            progress(number + 1, len(groups))
    return Panel(
        name="budget",
        title="Budget: how to split seconds or photons",
        question="How should a budget be split between views A, realisations B and samples to get the smallest error?",
        setting=(
            f"{scene.observer.pixels} pixels a view, the views spread evenly over a scan of 90°, 4 strips, four lobes of sigma "
            "1°. Error: of all B patterns together, relative, after the best global scale. Photons: shot noise and "
            f"{READ_NOISE:g} counts of read noise a pixel and exposure. Rendering: independent samples of the variance that a "
            "pilot run measured, at its price a sample and a render. The error of a split is foretold by the Cramér-Rao bound "
            f"on knots every {STEP_DEG:g}°, then measured by solving captures with drawn noise, and rendered ones."
        ),
        runs=tuple(runs),
        conclusions=tuple(conclusions),
        omissions=tuple(omissions),
        numbers=numbers,
    )
