"""The path tracer's lines of `wallmirror tradeoff`, on few samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from wallmirror.scene import load_scene
from wallmirror.tradeoff import forward_task, forward_tracing, split_runs, splits


@pytest.mark.parametrize(
    ("sampler", "counts", "fall"),
    [
        # Sixteen times the samples: a quarter of the error, give or take the scatter of two images of 1,000 pixels, few of
        # which are bright.
        ("independent", (64, 1024), (0.15, 0.45)),
        # 49 and 289 samples, the squares of primes that this sampler takes: it falls about as 1 / n, so to a sixth.
        ("orthogonal", (49, 289), (0.08, 0.35)),
    ],
)
def test_errors_fall_as_the_sampler_lets_them(
    mi: Any, sampler: str, counts: tuple[int, int], fall: tuple[float, float]
) -> None:
    task = forward_task.image_task(views=2)
    few, many = forward_tracing.rendered_runs(task, f"Mitsuba, {sampler}", counts, seed=0, sampler=sampler)
    assert (few.work, many.work) == counts
    assert fall[0] < many.error / few.error < fall[1]
    # The twin: an image of another pattern is no better with more samples.
    other = replace(task, reference=task.reference[:, ::-1])
    wrong = forward_tracing.rendered_runs(other, f"Mitsuba, {sampler}", counts, seed=0, sampler=sampler)
    assert wrong[1].error > 10 * many.error


def test_a_pilot_finds_what_a_sample_scatters_and_the_forecast_holds(mi: Any) -> None:
    scene = load_scene("flat_wall_lobes")
    scene = replace(scene, observer=replace(scene.observer, pixels=60))
    world = splits.World(scene, 100 * np.random.default_rng(0).random((scene.card.elements, 12)))
    costs = splits.measure_costs(world, spp=256, seed=0)
    assert costs.sample > 0
    # One strip of four is chosen at random; sampling the BRDF as well changes that by less than a factor of two.
    assert 0.5 < costs.scatter < 2
    noise = splits.sampling_noise(costs, world)
    foretold = split_runs.foretold_run("g", world, splits.Split(5, 12, 512.0), noise)
    found = split_runs.rendered_run("g", world, foretold, 0)
    # One draw of 48 numbers with a scale in common; a quarter of the noise's variance or four times it would not pass.
    assert 1 / 2 < found.error / foretold.error < 2
