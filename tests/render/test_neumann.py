"""Each partial sum of the Neumann series against a path tracer that stops after as many reflections.

A box of grey walls, one of them brighter and one shining. Mitsuba measures the irradiance of a whole face, whose analytic
value is pi times the mean of F L over its patches; the longest path of max_depth d has d - 1 reflections, so it is the
partial sum with as many. Patches of constant radiance err by a power of their size; the finest two tell how much is left.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from wallmirror.radiosity import FACES, Box, Face, NeumannSeries, neumann_series, transport_operator

Array = NDArray[np.float64]
SIZE = (2.0, 3.0, 1.0)
ALBEDO: dict[str, float] = {**dict.fromkeys(FACES, 0.5), "x0": 0.8}
LAMP: Face = "z1"
SEEDS = 16
DEPTHS = (1, 2, 3, 6, 40)
LIMIT = float(stats.t.isf(0.5e-4, SEEDS - 1))


def series(cells: int, box_albedo: dict[str, float]) -> tuple[Box, Array, NeumannSeries]:
    box = Box(size=SIZE, cells=cells)
    factors = box.form_factors()
    albedo = np.array([box_albedo[FACES[k]] for k in box.face])
    return box, factors, neumann_series(transport_operator(factors, albedo), box.on(LAMP), 39)


def analytic(face: Face, box_albedo: dict[str, float]) -> tuple[Array, Array]:
    """Irradiance of a face at each depth, extrapolated from two sizes of patches, and what the extrapolation moved."""
    values = []
    for cells in (4, 8):
        box, factors, found = series(cells, box_albedo)
        reached = math.pi * found.partial_sums @ factors.T
        values.append(reached[:, box.on(face) == 1].mean(axis=1)[[d - 1 for d in DEPTHS]])
    finer = values[1] + (values[1] - values[0]) / 3  # the error falls with the patch's area
    return finer, np.abs(finer - values[1])


def room(mi: Any, face: Face) -> Any:
    """Six rectangles about the box, the lamp black to light, a meter on one face."""
    transform = mi.ScalarTransform4f
    world: dict[str, Any] = {"type": "scene"}
    for k, name in enumerate(FACES):
        axis, end = divmod(k, 2)
        centre = [length / 2 for length in SIZE]
        centre[axis] = end * SIZE[axis]
        inwards = [0.0, 0.0, 0.0]
        inwards[axis] = 1.0 - 2 * end
        one, two = (a for a in range(3) if a != axis)
        up = [0.0, 0.0, 0.0]
        up[two] = 1.0
        target = [c + n for c, n in zip(centre, inwards, strict=True)]
        shape = {
            "type": "rectangle",
            "to_world": transform().look_at(origin=centre, target=target, up=up)
            @ transform().scale([SIZE[one] / 2, SIZE[two] / 2, 1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": ALBEDO[name]}},
        }
        if name == LAMP:
            shape["emitter"] = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
        if name == face:
            shape["meter"] = {
                "type": "irradiancemeter",
                "film": {
                    "type": "hdrfilm",
                    "width": 1,
                    "height": 1,
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            }
        world[name] = shape
    return mi.load_dict(world)


def measured(mi: Any, face: Face) -> Array:
    """Irradiance by seed and depth."""
    scene = room(mi, face)
    found = []
    for depth in DEPTHS:
        method = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
        found.append(
            [
                float(mi.render(scene, integrator=method, spp=2**12, seed=seed + 100 * depth).numpy().item())
                for seed in range(SEEDS)
            ]
        )
    return np.array(found).T


@pytest.mark.parametrize("face", ["z0", "x0"])
def test_partial_sums_are_what_shorter_paths_bring(mi: Any, face: Face) -> None:
    found = measured(mi, face)
    error = found.std(axis=0, ddof=1) / math.sqrt(SEEDS)
    expected, left = analytic(face, ALBEDO)
    assert np.all(left < 2e-3 * expected)
    scores = np.abs(found.mean(axis=0) - expected) / np.hypot(error, left / 2)
    assert np.all(scores < LIMIT)
    # The twins: an albedo 2 % too large, and one reflection too many.
    brighter, _ = analytic(face, {name: 1.02 * a for name, a in ALBEDO.items()})
    assert np.abs(found.mean(axis=0) - brighter)[-1] / np.hypot(error, left / 2)[-1] > LIMIT
    assert np.all((expected[1:] - expected[:-1]) / np.hypot(error, left)[:-1] > LIMIT)


def test_the_endless_sum_of_a_furnace_is_known_without_any_patches() -> None:
    box = Box(size=SIZE, cells=2)
    found = neumann_series(transport_operator(box.form_factors(), 0.8), np.ones(box.face.size), 100)
    np.testing.assert_allclose(found.exact, 1 / (1 - 0.8), rtol=1e-12)
    np.testing.assert_allclose(found.partial_sums[-1], (1 - 0.8**101) / (1 - 0.8), rtol=1e-12)
