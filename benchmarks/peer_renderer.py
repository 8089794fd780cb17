"""The peer of `peers.py` that knows F by path tracing only: Adam through Mitsuba's own differentiable renderer.

The unknown table is that of wallmirror's plugin; each of the M strips is rendered alone, all views as one film
(Mitsuba's `batch` sensor), and its derivative with respect to the table is Mitsuba's `prb` integrator in reverse
("path replay backpropagation"). D = F V is linear in V, so that M renders and their M reverse passes a step serve all
realisations at once: one render for each view and realisation would cost B times as much.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_methods import Recorder

from wallmirror import AngleSumTable, CaptureSet, Kernel, Scene, build_kernel
from wallmirror.pathtracing import building
from wallmirror.pathtracing.runtime import activate

Array = NDArray[np.float64]


class Strips:
    """The transport of a table and its derivative, by path tracing.

    Parameters
    ----------
    scene:
        Camera, card and wall; the wall's BRDF gives way to the table.
    nodes:
        Number of nodes of the table over [-pi, pi].
    spp:
        Stratified samples per pixel; only the lit strip is sampled.
    """

    def __init__(self, scene: Scene, *, nodes: int, spp: int) -> None:
        activate("llvm_ad_mono")
        self._dr, self._mi = (importlib.import_module(name) for name in ("drjit", "mitsuba"))
        # The same single thread that all peers have.
        self._dr.set_thread_count(1)
        flat = AngleSumTable(start=-math.pi, stop=math.pi, values=np.ones(nodes))
        scene = replace(scene, wall=replace(scene.wall, brdf=flat))
        self._spp = spp
        self._lit = [self._with_one_strip(scene, element) for element in range(scene.card.elements)]
        (self._table,) = [key for key in self._lit[0][1].keys() if key.endswith(".table")]  # noqa: SIM118
        self._sensor = self._mi.load_dict(_batch(scene, spp))
        self._method = self._mi.load_dict({"type": "prb", "max_depth": 2, "rr_depth": 9, "hide_emitters": True})

    def _with_one_strip(self, scene: Scene, element: int) -> tuple[Any, Any]:
        """The scene with one strip alight, the only one that is sampled, and its parameters."""
        alight = np.eye(scene.card.elements)[element]
        loaded = self._mi.load_dict(building.mitsuba_dict(scene, None, radiances=alight), optimize=False)
        parameters = self._mi.traverse(loaded)
        for i, level in enumerate(alight):
            parameters[f"strip_{i}.emitter.sampling_weight"] = float(level)
        parameters.update()
        return loaded, parameters

    def set(self, table: Array) -> None:
        """Give the wall another table."""
        for _, parameters in self._lit:
            parameters[self._table] = self._mi.TensorXf(table.astype(np.float32))
            self._dr.enable_grad(parameters[self._table])
            parameters.update()

    def transport(self, seed: int) -> Array:
        """F, shape (A N, M)."""
        columns = []
        for element, (scene, _) in enumerate(self._lit):
            film = self._method.render(scene, self._sensor, seed=seed + element, spp=self._spp)
            columns.append(np.asarray(film, dtype=np.float64)[0, :, 0])
        return np.stack(columns, axis=1)

    def reverse(self, seed: int, slope: Array) -> Array:
        """The derivative with respect to the table of a function whose derivative with respect to F is `slope`."""
        total = np.zeros(self._lit[0][1][self._table].shape)
        for element, (scene, parameters) in enumerate(self._lit):
            given = self._mi.TensorXf(slope[None, :, element, None].astype(np.float32))
            self._method.render_backward(
                scene, parameters, grad_in=given, sensor=self._sensor, seed=seed + element, spp=self._spp
            )
            total += np.asarray(self._dr.grad(parameters[self._table]).numpy(), dtype=np.float64)
        return total


def descend_by_rendering(
    scene: Scene,
    captures: CaptureSet,
    rng: np.random.Generator,
    recorder: Recorder,
    *,
    nodes: int,
    spp: int,
    rate: float,
) -> str:
    """Adam (Kingma and Ba, ICLR 2015) on table and V, both kept >= 0; its rate falls to 0 as a cosine over the budget."""
    strips = Strips(scene, nodes=nodes, spp=spp)

    @functools.cache
    def kernel() -> Kernel:
        return build_kernel(captures.observer, captures.card, weights="physical", resolution=2 * math.pi / nodes)

    def judged(table: Array) -> Array:
        # Without the noise of a render, and off the clock.
        brdf = AngleSumTable(start=-math.pi, stop=math.pi, values=table)
        return kernel().apply(brdf).reshape(len(data), -1)

    data = captures.radiance.reshape(-1, captures.radiance.shape[2])
    source, table = rng.random((captures.card.elements, data.shape[1])), np.full(nodes, 0.5)
    strips.set(table)
    rendered = strips.transport(1)
    # The unit of the films in which the start explains most of D: all unknowns are then of order one.
    guess = rendered @ source
    data = data * float(np.sum(guess * guess) / np.sum(guess * data))
    level = 1 / float(np.sum(data * data))
    moments = [(np.zeros_like(x), np.zeros_like(x)) for x in (table, source)]
    for step in itertools.count(1):
        strips.set(table)
        # Each factor of a product has samples of its own, or the mean of the product would not be that of the means.
        seed = 64 * step
        residual = strips.transport(seed) @ source - data
        slope = 2 * level * residual @ source.T
        slopes = [strips.reverse(seed + 16, slope), 2 * level * strips.transport(seed + 32).T @ residual]
        now = rate * 0.5 * (1 + math.cos(math.pi * min(1.0, recorder.share)))
        table, source = (
            np.maximum(x - now * _adam(moment, slope, step), 0.0)
            for x, moment, slope in zip((table, source), moments, slopes, strict=True)
        )
        recorder(source, lambda t=table: judged(t))
    raise AssertionError("the recorder ends the loop")


def _adam(moment: tuple[Array, Array], slope: Array, step: int, *, first: float = 0.9, second: float = 0.99) -> Array:
    """The direction of Adam; updates both moments in place."""
    mean, square = moment
    mean += (1 - first) * (slope - mean)
    square += (1 - second) * (slope**2 - square)
    return np.asarray(mean / (1 - first**step) / (np.sqrt(square / (1 - second**step)) + 1e-12))


def _batch(scene: Scene, spp: int) -> dict[str, Any]:
    """All views of the observer side by side on one film."""
    views = scene.observer.views
    sensors = [building.sensor_dict(scene, view, sampler="multijitter", spp=spp) for view in range(views)]
    film = {**sensors[0]["film"], "width": views * scene.observer.pixels}
    bare = [{key: value for key, value in sensor.items() if key not in ("film", "sampler")} for sensor in sensors]
    return {
        "type": "batch",
        **{f"view_{view}": sensor for view, sensor in enumerate(bare)},
        "film": film,
        "sampler": sensors[0]["sampler"],
    }
