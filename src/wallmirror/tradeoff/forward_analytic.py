"""The analytic model over its quadrature and tables, and its cheaper forms: points, single precision, convolutions."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, GaussianTrain, tabulate
from wallmirror.convolution import angle_convolution, spherical_convolution, wall_convolution
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.scene import load_scene
from wallmirror.tradeoff.clock import timed
from wallmirror.tradeoff.forward_task import IMAGE, Task
from wallmirror.tradeoff.reference import points_in_extended_precision
from wallmirror.tradeoff.runs import Run
from wallmirror.tradeoff.single_precision import transport_in_single_precision
from wallmirror.tradeoff.timed_runs import run_of
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

#: Groups of the convolutions, and how many times as far the card then stands.
POINTS = {"convolutions, card at 1 m": 1.0, "convolutions, card at 500 m": 500.0}
BY_TOLERANCE = "physical model, to a tolerance"
PHYSICAL, SINGLE = "physical model, float64", "physical model, float32"
ALGORITHM_1 = "Algorithm 1, points (free scale)"
TABLED = "physical model, BRDF table"


def analytic_runs(task: Task, *, quick: bool) -> list[Run]:
    """The physical model over its orders, in both precisions and with tables, and Algorithm 1."""
    observer, card, brdf = task.parts
    orders = ((1, 1), (1, 2), (1, 3), (2, 4), (2, 6), (4, 8)) if quick else tuple(
        (p, s) for p in (1, 2, 3, 4, 6) for s in (1, 2, 3, 4, 5, 6, 8, 10, 12)
    )  # fmt: skip
    repeats = 3 if quick else 5

    def run(method: str, knobs: dict[str, Any], work: Callable[[], Array], *, free_scale: bool = False) -> Run:
        films, timing = timed(work, repeats=repeats)
        error = scale_free_error(films, task.reference) if free_scale else task.error(films)
        return run_of(IMAGE, method, knobs, timing, error)

    runs = []
    for p, s in orders:
        knobs = {"pixel nodes": p, "strip nodes": s}
        runs.append(run(PHYSICAL, knobs, partial(films_of, task, brdf, (p, s))))
        runs.append(run(SINGLE, knobs, partial(_single_films, task, (p, s))))
    for tolerance in (1e-2, 1e-4, 1e-8) if quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10):
        work = partial(_to_tolerance, task, tolerance)
        runs.append(run(BY_TOLERANCE, {"tolerance": tolerance}, work))
    for nodes in (361, 1801, 7201) if quick else (181, 361, 721, 1801, 3601, 7201, 14401, 28801):
        table = tabulate(brdf, nodes)
        runs.append(run(TABLED, {"table nodes": nodes}, partial(films_of, task, table, (4, 10))))
    for points in (1, 2, 4) if quick else (1, 2, 4, 8, 16):
        cut = _as_points(card, points)
        pattern = np.repeat(task.pattern, points, axis=0) / points
        runs.append(
            run(
                ALGORITHM_1,
                {"points per strip": points},
                partial(_algorithm_1, observer, cut, brdf, pattern),
                free_scale=True,
            )
        )
    return runs


def films_of(task: Task, brdf: BRDF, orders: tuple[int, int]) -> Array:
    """The image by the physical model with so many nodes across pixel and strip, (A, N, 1)."""
    return radiance(transport_matrix(task.scene.observer, task.scene.card, brdf, orders=orders), task.pattern)


def _to_tolerance(task: Task, tolerance: float) -> Array:
    """What a user does, who does not know the orders: they grow until F moves by less than the tolerance."""
    return radiance(transport_matrix(*task.parts, tolerance=tolerance), task.pattern)


def _single_films(task: Task, orders: tuple[int, int]) -> NDArray[Any]:
    return transport_in_single_precision(*task.parts, orders=orders) @ task.pattern.astype(np.float32)


def _algorithm_1(observer: Observer, card: Card, brdf: BRDF, pattern: Array) -> Array:
    return radiance(transport_matrix(observer, card, brdf, weights="cosine"), pattern)


def _as_points(card: Card, points: int) -> Card:
    """Each strip as so many points, evenly spread over its width."""
    offsets = ((np.arange(points) + 0.5) / points - 0.5) * card.element_width
    places = (np.asarray(card.elements_x)[:, None] + offsets).ravel()
    return Card(elements_x=tuple(map(float, places)), y=card.y)


def convolution_runs(group: str, *, quick: bool) -> list[Run]:
    """The forms of section 3.1 against Algorithm 1, all with points and cos theta_s; a far card is as much larger."""
    scene = load_scene("flat_wall_lobes")
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    angles = scene.observer.view_angles[:: 10 if quick else 5]
    observer = replace(scene.observer, view_angles=angles, pixels_at="edges")
    places = tuple(x * POINTS[group] for x in scene.card.elements_x)
    card = Card(elements_x=places, y=scene.card.y * POINTS[group])
    pattern = scene.source[:, 0]
    reference = points_in_extended_precision(observer, card, brdf, pattern)

    def run(method: str, knobs: dict[str, Any], work: Callable[[], Any]) -> Run:
        started = time.process_time()
        try:
            films, timing = timed(work, repeats=3)
        except InputError as refusal:
            seconds = time.process_time() - started
            return Run(group=group, method=method, knobs=knobs, seconds=seconds, failure=str(refusal))
        error = float(np.linalg.norm(np.asarray(films - reference, dtype=np.float64)) / np.linalg.norm(reference))
        return run_of(group, method, knobs, timing, error)

    runs = [run("Algorithm 1, float64", {}, partial(_algorithm_1, observer, card, brdf, pattern))]
    samples = (250, 500, 1000, 2000) if quick else (125, 250, 500, 1000, 2000, 4000, 8000, 16000)
    for order in (3, 5):
        for k in samples:
            knobs = {"directions": k, "spline order": order}
            runs.append(
                run(
                    f"one convolution a wall point (eq. 3.5), order {order}",
                    knobs,
                    partial(
                        spherical_convolution, observer, card, brdf, pattern, samples=k, order=order, weights="cosine"
                    ),
                )
            )
    runs += [
        run(
            "one convolution over the angle sum",
            {"directions": k},
            partial(angle_convolution, observer, card, brdf, pattern, samples=k, weights="cosine"),
        )
        for k in samples
    ]
    projections: tuple[Literal["observer", "both"], ...] = ("observer", "both")
    runs += [
        run(
            "one convolution along the wall (eq. 3.7)",
            {"projected from": where},
            partial(wall_convolution, observer, card, brdf, pattern, projected_from=where, weights="cosine"),
        )
        for where in projections
    ]
    return runs
