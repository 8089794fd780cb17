"""One scene rendered at one bounce with many seeds, and held against the analytic model."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.comparison import Comparison, compare, cross_weights
from wallmirror.console import Advance
from wallmirror.jobs.bouncing import spread
from wallmirror.jobs.expecting import Expectation, expect
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.scene import Scene

Array = NDArray[np.float64]

#: Views and samples per pixel of each seed, by default and in a hurry.
VIEWS, SPP = 8, 256
QUICK_VIEWS, QUICK_SPP = 3, 64

#: Seeds of one comparison: enough to know their scatter to 13 %.
SEEDS = 32


@dataclass(frozen=True)
class Validation:
    """One scene's render against its analytic reference, at one bounce.

    Parameters
    ----------
    reference, mean:
        Analytic and path-traced radiance of the views compared, (A, N).
    views:
        Indices of those views.
    interpolation:
        How far the table that Mitsuba holds is from the wall's model after transport: the largest difference of two
        analytic radiances over the largest radiance. The comparison is with the table and does not contain it.
    same_as:
        Name of the scene whose render this is, where two differ in nothing that one bounce meets; else empty.
    tolerance:
        Gain error that the run was to see, if one was asked for.
    """

    scene: Scene
    views: tuple[int, ...]
    reference: Array
    mean: Array
    comparison: Comparison
    spp: int
    seconds: float
    interpolation: float
    same_as: str = ""
    tolerance: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the model was not rejected, by a run that would have seen a gain error of the tolerance, if one is set."""
        return self.comparison.passed and self.fine_enough

    @property
    def fine_enough(self) -> bool:
        """Whether a gain error of the tolerance would have shown; True where none is set."""
        return self.tolerance is None or self.comparison.gain.detectable <= self.tolerance

    def summary(self) -> dict[str, Any]:
        """The scene's part of results.json."""
        return {
            "scene": self.scene.name,
            "views": list(self.views),
            "seeds": SEEDS,
            "spp_per_seed": self.spp,
            "same_as": self.same_as or None,
            "tolerance": self.tolerance,
            "seconds": self.seconds,
            "table_interpolation": self.interpolation,
            **self.comparison.summary(),
        }


def validate_scene(
    scene: Scene,
    *,
    views: int = VIEWS,
    spp: int = SPP,
    seed: int = 0,
    realisation: int = 0,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> Validation:
    """Render a scene at one bounce with many seeds and test it against the physical model.

    Parameters
    ----------
    views:
        How many of the scene's views to compare, spread evenly.
    spp:
        Samples per pixel of each of the 32 seeds.
    realisation:
        Which of the scene's patterns lights the card.

    Notes
    -----
    At one bounce a room or a reflective card adds nothing, so every scene can be compared; what further bounces add is
    another question. Stratified samples are used, as the statistics rest on the scatter between seeds alone.
    """
    started = time.perf_counter()
    sample = render_seeds(
        scene, views=views, spp=spp, seed=seed, realisation=realisation, variant=variant, progress=progress
    )
    expectation = expect(scene, sample.views, realisation=realisation)
    return Validation(
        scene,
        sample.views,
        expectation.reference,
        sample.seeds.mean(axis=0),
        judge(sample, expectation),
        spp,
        seconds=time.perf_counter() - started,
        interpolation=expectation.interpolation,
    )


@dataclass(frozen=True)
class Sample:
    """The rendered side of a comparison: independent one-bounce renders of some views, `seeds` of shape (S, A, N)."""

    views: tuple[int, ...]
    seeds: Array


def render_seeds(
    scene: Scene,
    *,
    views: int,
    spp: int,
    seed: int = 0,
    realisation: int = 0,
    count: int = SEEDS,
    variant: str = "llvm_ad_mono",
    progress: Advance | None = None,
) -> Sample:
    """The rendered side, with parameters as for `validate_scene`, and `count` seeds."""
    chosen = spread(scene.observer.views, views)
    # Looking through a board displaces what is seen by a hundredth of a pixel (see `building`), which this test would
    # notice. At one bounce the board has no other effect, so it is taken away.
    bare = replace(scene, card=replace(scene.card, board_width=0.0, board_height=0.0))
    renderer = Renderer(bare, variant=variant)
    roots = spread_seeds(seed, len(chosen) * count)
    seeds = np.empty((count, len(chosen), scene.observer.pixels))
    for a, view in enumerate(chosen):
        mine = roots[a * count : (a + 1) * count]
        pattern = scene.source[:, realisation]
        render = renderer.render(view, pattern, spp=spp, seeds=mine, max_depth=2, sampler="multijitter", method="seeds")
        seeds[:, a] = render.per_seed
        if progress is not None:
            progress(a + 1, len(chosen))
    return Sample(chosen, seeds)


def judge(sample: Sample, expectation: Expectation) -> Comparison:
    """The verdict of `validate` on two sides, whatever they are."""
    return compare(
        sample.seeds,
        expectation.reference,
        templates=expectation.templates,
        edges=expectation.edges,
        weights=cross_weights(sample.seeds, expectation.reference),
    )
