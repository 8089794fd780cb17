"""The plugins in Mitsuba's other variants, and their derivatives with respect to the table.

What is equal in which variants:

- `llvm_ad_rgb` draws the numbers that `llvm_ad_mono` draws and carries three equal channels: pictures differ by
  rounding alone, that of the film (its luminance is a sum of three weights) and that of another order of operations;
- `llvm_ad_spectral` draws a wavelength first, so its samples are others, and grey light keeps its value in the mean
  only: pictures agree within their errors;
- `scalar_rgb` draws its numbers in blocks of its own: within errors;
- `cuda_ad_mono` draws those of `llvm_ad_mono` but has an arithmetic of its own (arctangents, fused products), which
  now and then decides otherwise where a path goes: within errors as well.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from wallmirror import load_scene
from wallmirror.errors import MissingRuntimeError
from wallmirror.pathtracing.rendering import FILM_ROUNDING, Render, Renderer
from wallmirror.scene import Scene

from .soundness import plugin_dict

Array = NDArray[np.float64]

LEVEL = 1e-4  # the chance of a false alarm of each verdict under a new seed


@pytest.fixture
def restored_variant(mi: Any) -> Iterator[None]:
    yield
    importlib.import_module("mitsuba").set_variant("llvm_ad_mono")


# ----------------------------------------------------------------------------------------------------------- variants


def small(pixels: int = 24) -> Scene:
    """The shipped scene of four narrow lobes, with few pixels and a single view, and strips that single paths meet."""
    scene = load_scene("flat_wall_lobes")
    observer = replace(scene.observer, pixels=pixels, view_angles=(0.1,))
    return replace(scene, observer=observer, card=replace(scene.card, element_width=1.5, element_height=6.0))


PATTERN = np.array([3.0, 1.0, 2.0, 5.0])


def rendered(variant: str, *, scale: float = 1.0, spp: int = 4096, pixels: int = 24) -> Render:
    return Renderer(small(pixels), variant=variant).render(0, scale * PATTERN, spp=spp, seeds=(5,))


def agree(one: Render, other: Render) -> bool:
    """The pictures' sums within their errors, and the pixels' differences of the spread that their errors say."""
    lit = one.mean > 0.01 * one.mean.max()
    difference = (one.mean - other.mean)[lit]
    variance = (one.variance + other.variance)[lit]
    pooled = abs(difference.sum()) / math.sqrt(variance.sum())
    spread = float((difference**2 / variance).sum())
    return bool(pooled < stats.norm.isf(LEVEL / 2) and spread < stats.chi2.isf(LEVEL, lit.sum()))


@pytest.fixture(scope="module")
def mono(mi: Any) -> Render:
    return rendered("llvm_ad_mono")


@pytest.mark.usefixtures("restored_variant")
def test_the_colour_variant_renders_the_same_samples(mono: Render) -> None:
    colour = rendered("llvm_ad_rgb")
    np.testing.assert_allclose(colour.mean, mono.mean, rtol=FILM_ROUNDING)
    # Planted: other samples, of another seed.
    other = Renderer(small(), variant="llvm_ad_rgb").render(0, PATTERN, spp=4096, seeds=(6,))
    assert not np.allclose(other.mean, mono.mean, rtol=FILM_ROUNDING, atol=0)
    assert agree(other, mono)


@pytest.mark.usefixtures("restored_variant")
def test_the_spectral_variant_agrees_within_errors(mono: Render) -> None:
    spectral = rendered("llvm_ad_spectral")
    assert agree(spectral, mono)
    # Planted: 3 % too bright.
    assert not agree(rendered("llvm_ad_spectral", scale=1.03), mono)


@pytest.mark.usefixtures("restored_variant")
def test_the_scalar_variant_agrees_within_errors(mi: Any) -> None:
    reference = rendered("llvm_ad_mono", pixels=6)
    scalar = rendered("scalar_rgb", pixels=6, spp=128)
    assert agree(scalar, reference)
    # Planted: as much too bright as so few samples can tell.
    assert not agree(rendered("scalar_rgb", scale=1.3, pixels=6, spp=128), reference)


@pytest.mark.usefixtures("restored_variant")
def test_the_gpu_agrees_within_errors(mono: Render) -> None:
    try:
        gpu = rendered("cuda_ad_mono")
    except MissingRuntimeError as error:
        pytest.skip(str(error))
    assert agree(gpu, mono)
    assert not agree(rendered("cuda_ad_mono", scale=1.03), mono)


# ---------------------------------------------------------------------------------------------------------- gradients

_THETA = np.linspace(-math.pi / 2, math.pi / 2, 9)
TABLES: dict[str, Array] = {
    "sum": (0.3 + 0.5 * np.exp(-2 * (np.linspace(-math.pi, math.pi, 41) - 0.3) ** 2)) / math.pi,
    "lopsided": (0.5 + 0.3 * np.sin(2 * _THETA)[:, None] + 0.15 * np.cos(3 * _THETA)) / math.pi,
}
WEIGHTS = 0.5 + np.random.default_rng(31).random((8, 8, 1))  # of the pixels, in the sum that is differentiated


def half_detached(mi: Any, table: Array) -> dict[str, Any]:
    """Our plugin but for the planted fault: light from theta_s < 0 hides its derivatives."""
    known = plugin_dict(mi, table)

    class HalfDetached(type(mi.load_dict(known))):  # type: ignore[misc]
        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            value, pdf = super().eval_pdf(ctx, si, wo, active)
            return dr.select(wo.x > 0, value, dr.detach(value)), pdf

    name = f"half_detached_{table.ndim}"
    mi.register_bsdf(name, HalfDetached)
    return {**known, "type": name}


def sensor(mi: Any, origin: list[float], target: list[float]) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": 50,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0.1]),
        "film": {
            "type": "hdrfilm",
            "width": 8,
            "height": 8,
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def lamp_over_wall(mi: Any, bsdf: dict[str, Any]) -> Any:
    """One bounce from a point: no sample depends on the table, and radiance is linear in it."""
    return mi.load_dict(
        {
            "type": "scene",
            "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([3, 3, 1]), "bsdf": bsdf},
            "lamp": {"type": "point", "position": [-0.7, 0.2, 1.0], "intensity": 3.0},
            "sensor": sensor(mi, [0.5, 0, 2.5], [0, 0, 0]),
        }
    )


def glowing_box(mi: Any, bsdf: dict[str, Any]) -> Any:
    """Several bounces inside: radiance is a polynomial in the table, and so are samples and weights functions of it."""
    return mi.load_dict(
        {
            "type": "scene",
            "box": {
                "type": "cube",
                "flip_normals": True,
                "bsdf": bsdf,
                "emitter": {"type": "area", "radiance": 1.0},
            },
            "sensor": sensor(mi, [0.3, 0.2, -0.1], [-0.4, 0.6, 0.5]),
        }
    )


class Derivatives:
    """Both ways to differentiate the weighted sum of a picture with respect to the table."""

    def __init__(self, mi: Any, scene: Any, *, depth: int, spp: int) -> None:
        self.mi, self.scene, self.spp = mi, scene, spp
        self.params = mi.traverse(scene)
        (self.key,) = [key for key in self.params.keys() if key.endswith(".table")]  # noqa: SIM118
        self.table = self.params[self.key].numpy().astype(float)
        self.method = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 2 * depth})

    def set(self, table: Array) -> None:
        self.params[self.key] = self.mi.TensorXf(table)
        self.params.update()

    def total(self, seed: int) -> float:
        picture = self.mi.render(self.scene, integrator=self.method, spp=self.spp, seed=seed)
        return float((WEIGHTS * picture.numpy().astype(float)).sum())

    def backward(self, seed: int) -> Array:
        """By `dr.backward`; the seed (not 0, which means "choose one") is that of the derivative's samples."""
        self.set(self.table)
        dr.enable_grad(self.params[self.key])
        self.params.update()
        picture = self.mi.render(
            self.scene, self.params, integrator=self.method, spp=self.spp, seed=seed + 1000, seed_grad=seed
        )
        dr.backward(dr.sum(self.mi.TensorXf(WEIGHTS) * picture, axis=None))
        return np.asarray(dr.grad(self.params[self.key]).numpy(), dtype=np.float64)

    def central(self, seed: int, node: tuple[int, ...], step: float) -> float:
        """By central differences of one entry, both pictures with the same random numbers."""
        totals = []
        for sign in (1, -1):
            table = self.table.copy()
            table[node] += sign * step
            self.set(table)
            totals.append(self.total(seed))
        return (totals[0] - totals[1]) / (2 * step)


@pytest.mark.parametrize("name", TABLES)
def test_gradients_are_differences_where_radiance_is_linear(mi: Any, name: str) -> None:
    table = TABLES[name]
    right = Derivatives(mi, lamp_over_wall(mi, plugin_dict(mi, table)), depth=2, spp=256)
    gradient = right.backward(seed=1)
    order = np.argsort(gradient, axis=None)
    nodes = [tuple(int(i) for i in np.unravel_index(k, table.shape)) for k in (*order[[-1, -2, -3, -5]], order[0])]
    # Steps may be as large as entries, and rounding is all there is: that of two films, for any node alike.
    step = float(table.min()) / 2
    differences = np.array([right.central(1, node, step) for node in nodes])
    tolerance = FILM_ROUNDING * right.total(1) / step

    def matches(gradient: Array) -> bool:
        return bool(np.abs(np.array([gradient[node] for node in nodes]) - differences).max() < tolerance)

    assert matches(gradient)
    assert differences[-1] == 0  # a node that no light reaches
    assert differences[:4].min() > 100 * tolerance
    # Planted: gradients that belong to the next node, and some that are lost on their way.
    assert not matches(np.roll(gradient, 1, axis=-1))
    assert not matches(Derivatives(mi, lamp_over_wall(mi, half_detached(mi, table)), depth=2, spp=256).backward(seed=1))


@pytest.mark.parametrize(("name", "nodes"), [("sum", [(18,), (21,), (25,)]), ("lopsided", [(4, 4), (2, 5), (6, 3)])])
def test_gradients_are_differences_in_the_mean_after_many_bounces(
    mi: Any, name: str, nodes: list[tuple[int, ...]]
) -> None:
    """Derivatives keep samples where they are and differences move them, so that they are equal in the mean only."""
    table, seeds = TABLES[name], range(1, 17)
    right = Derivatives(mi, glowing_box(mi, plugin_dict(mi, table)), depth=4, spp=256)
    # 2 % of the largest entry change the radiance by less than 1 %: third orders are below (1 %)^2.
    step = 0.02 * float(table.max())
    differences = np.array([[right.central(seed, node, step) for node in nodes] for seed in seeds])
    gradients = np.array([right.backward(seed) for seed in seeds])

    def errors(gradients: Array) -> tuple[Array, Array]:
        """Mean over the seeds, and its standard error, of what gradients of the nodes exceed differences by."""
        excess = np.array([gradients[:, *node] for node in nodes]).T - differences
        return excess.mean(axis=0), excess.std(axis=0, ddof=1) / math.sqrt(len(seeds))

    def worst(gradients: Array) -> float:
        """Largest Student's t of the nodes, in units of what LEVEL allows."""
        mean, scatter = errors(gradients)
        return float(np.abs(mean / scatter).max() / stats.t.isf(LEVEL / 2 / len(nodes), len(seeds) - 1))

    assert worst(gradients) < 1
    assert (errors(gradients)[1] < 0.03 * differences.mean(axis=0)).all()  # so that agreement says something
    # Planted: gradients that belong to the next node, and some that are lost on their way.
    assert worst(np.roll(gradients, 1, axis=-1)) > 1
    lost = Derivatives(mi, glowing_box(mi, half_detached(mi, table)), depth=4, spp=256)
    assert worst(np.array([lost.backward(seed) for seed in seeds])) > 1
