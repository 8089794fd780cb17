"""The image that everybody renders, and the reference that all are held against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.geometry import Card, Observer
from wallmirror.scene import Scene, load_scene
from wallmirror.tradeoff.reference import brute_force
from wallmirror.tradeoff.runs import Statement
from wallmirror.transport import radiance, transport_matrix

Array = NDArray[np.float64]

IMAGE = "image of a lobed wall (sigma 1°)"


@dataclass(frozen=True)
class Task:
    """The image that everybody renders, with its reference."""

    scene: Scene
    pattern: Array
    reference: Array
    tolerance: float

    @property
    def parts(self) -> tuple[Observer, Card, GaussianTrain]:
        brdf = self.scene.wall.brdf
        assert isinstance(brdf, GaussianTrain)
        return self.scene.observer, self.scene.card, brdf

    def error(self, films: Array) -> float:
        """Relative error over all views and pixels."""
        return float(np.linalg.norm(films - self.reference) / np.linalg.norm(self.reference))


def image_task(views: int) -> Task:
    """So many views of the lobed wall, one pattern, and their reference."""
    scene = load_scene("flat_wall_lobes")
    angles = scene.observer.view_angles
    chosen = tuple(angles[i] for i in np.linspace(0, len(angles) - 1, views).round().astype(int))
    scene = replace(scene, observer=replace(scene.observer, view_angles=chosen))
    pattern = scene.source[:, :1]
    tolerance = 1e-12
    reference = radiance(transport_matrix(scene.observer, scene.card, scene.wall.brdf, tolerance=tolerance), pattern)
    return Task(scene, pattern, reference, tolerance)


def check_reference(task: Task, entries: int) -> tuple[Statement, float]:
    """The reference against an integral that shares no formula with it."""
    observer, card, brdf = task.parts
    transport = transport_matrix(observer, card, brdf, tolerance=task.tolerance)
    order = np.argsort(transport, axis=None)[::-1]
    # From the brightest entry down to a hundredth of it, evenly in rank.
    bright = order[: int(np.count_nonzero(transport > 0.01 * transport.max()))]
    picked = bright[np.linspace(0, bright.size - 1, entries).astype(int)]
    worst = 0.0
    for flat in picked:
        place = np.unravel_index(flat, transport.shape)
        worst = max(worst, abs(brute_force(observer, card, brdf, place) / float(transport[place]) - 1))
    return (
        Statement(
            f"The reference is right to {worst:.0e}: {entries} of its entries, from the brightest down to a hundredth of it, "
            "against the reflection equation integrated by brute force in four dimensions.",
            worst < 1e-9,
        ),
        worst,
    )
