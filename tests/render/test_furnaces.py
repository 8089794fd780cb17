"""Energy and reciprocity: furnaces whose radiance is known exactly, and swapped directions.

- White furnace: a wall under a sky of radiance 1 shows its albedo for the camera's direction, the integral of
  rho cos over the hemisphere, here by SciPy over the projected disk (cos d omega = dx dy), by adaptive quadrature.
- Grey furnace: what emits (1 - a) L, reflects the share a and stands in a sky of radiance L is invisible.
- Closed room: walls that emit Le and reflect a shine with Le / (1 - a) everywhere.

Errors are judged by the scatter of 16 seeds, at a chance of 1e-4 for each verdict, and every verdict must also
reject its twin, a table 0.5 % too bright.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, special, stats
from scipy.interpolate import RegularGridInterpolator

from wallmirror.brdf import AngleSumTable, CookTorrance, Schlick, Table, directional_albedo

from .soundness import diffuse, directions, lobes, measured, of_sum, phong, plugin_dict, ridge, u

Array = NDArray[np.float64]

SEEDS = 16
FAULT = 1.005
LIMIT = float(stats.t.isf(0.5e-4, SEEDS - 1))  # Student's t, two-sided: 5.2


def grooves() -> Array:
    """White facets across grooves on 181 x 181 nodes: what they lose is what they shadow."""
    theta = np.linspace(-math.pi / 2, math.pi / 2, 181)
    return CookTorrance(alpha=0.3, fresnel=Schlick(f0=1.0))(theta[:, None], theta)


MODELS: dict[str, Array] = {
    "diffuse": diffuse(0.7),
    "lobes of 15 deg": of_sum(lobes(15)),
    "lobes of 1 deg": of_sum(lobes(1)),
    "phong": of_sum(phong()),
    "measured": measured(),
    "ridge": ridge(),
    "grooves": grooves(),
}
#: theta and y towards the camera.
VIEWS = [(0.7, 0.0), (-0.5, 0.6), (-1.2, 0.3)]


# ---------------------------------------------------------------------------------------------------------- rendering


def camera(mi: Any, origin: Any, target: Any, *, fov: float, pixels: int = 8) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(
            [float(x) for x in origin], [float(x) for x in target], [0.1, 1, 0.2]
        ),
        "film": {
            "type": "hdrfilm",
            "width": pixels,
            "height": pixels,
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def rectangle(mi: Any, centre: tuple[float, ...], **parts: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate(list(centre)), **parts}


def radiances(mi: Any, scene: Any, *, depth: int, spp: int, integrator: str = "path") -> Array:
    """The picture for each seed, shape (seeds, pixels), without Russian roulette."""
    method = mi.load_dict({"type": integrator, "max_depth": depth, "rr_depth": 2 * depth})
    pictures = [mi.render(scene, integrator=method, spp=spp, seed=seed).numpy() for seed in range(SEEDS)]
    return np.array(pictures, dtype=np.float64).reshape(SEEDS, -1)


def score(per_seed: Array, expected: float) -> float:
    """Student's t of the seeds' mean radiance against what is expected, |t| if above 0.

    The film adds float32 samples: 4e-6 of the mean, as `rendering.FILM_ROUNDING`, is granted as a standard error.
    """
    means = per_seed.mean(axis=1)
    error = math.hypot(float(means.std(ddof=1)) / math.sqrt(SEEDS), 4e-6 * expected)
    return abs(float(means.mean()) - expected) / error


def brightened(mi: Any, scene: Any, factor: float) -> None:
    """Multiply every table and every reflectance of a scene by a factor."""
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.endswith((".table", ".reflectance.value"))]  # noqa: SIM118
    assert keys
    for key in keys:
        params[key] = params[key] * factor
    params.update()


# ------------------------------------------------------------------------------------------------------ white furnace


def albedo(table: Array, theta_o: float) -> float:
    """Integral of rho(theta_s, theta_o) cos over the hemisphere of light, as the integral of rho over the unit disk.

    SciPy's adaptive rule along x, Gauss-Chebyshev slices in y, theta_s = atan2(x, z) for each point (x, y, z).
    """
    stored = table.astype(np.float32).astype(np.float64)
    if table.ndim == 1:
        theta_s, row = np.linspace(-math.pi, math.pi, table.size) - theta_o, stored
    else:
        grid = [np.linspace(-math.pi / 2, math.pi / 2, size) for size in table.shape]
        theta_s = grid[0]  # the bilinear interpolant is linear between its nodes
        row = RegularGridInterpolator(tuple(grid), stored)(np.stack([theta_s, np.full_like(theta_s, theta_o)], axis=-1))
    y, weight = special.roots_chebyu(8)  # for the weight sqrt(1 - y^2) = c, half the length of a slice
    c = np.sqrt(1 - y**2)

    def slices(t: float) -> Array:
        x = c * t
        return np.asarray(np.interp(np.arctan2(x, np.sqrt(1 - y**2 - x**2)), theta_s, row))

    # The rule needs to be told of kinks; those of a smooth lobe on fine nodes are none to it.
    kinks = theta_s[1:-1][np.abs(np.diff(row, 2)) > 1e-4 * row.max()]
    points = np.sin(kinks[np.abs(kinks) < math.pi / 2 - 1e-6])
    lengths, error = integrate.quad_vec(slices, -1, 1, points=points, epsrel=1e-5, limit=100_000)
    assert error < 2e-5 * np.abs(lengths).max()
    return float(weight @ lengths)


@pytest.mark.parametrize("name", MODELS)
def test_a_wall_under_a_white_sky_shows_its_albedo(mi: Any, name: str) -> None:
    table = MODELS[name]
    for view in VIEWS:
        expected = albedo(table, view[0])
        # 1e-4 rad of field of view: less than 1e-4 of any of these albedos' change over it.
        scene = mi.load_dict(
            {
                "type": "scene",
                "wall": rectangle(mi, (0, 0, 0), bsdf=plugin_dict(mi, table)),
                "sky": {"type": "constant", "radiance": 1.0},
                "sensor": camera(mi, 5 * directions(*view)[:, 0], (0, 0, 0), fov=0.005),
            }
        )
        right = radiances(mi, scene, depth=2, spp=1024)
        assert score(right, expected) < LIMIT
        brightened(mi, scene, FAULT)
        assert score(radiances(mi, scene, depth=2, spp=1024), expected) > LIMIT


def test_albedos_agree_with_closed_forms_and_with_the_plane_integral() -> None:
    """What the white furnace is judged by: a for a diffuse wall, R for Phong at normal incidence."""
    assert albedo(MODELS["diffuse"], 0.4) == pytest.approx(0.7, rel=1e-5)
    # The quadrature asks for 1e-5; chords of nodes under a lobe of 8 deg add (step / sigma)^2 / 12 = 3e-6.
    assert albedo(MODELS["phong"], 0.0) == pytest.approx(0.6, rel=2e-5)
    for table in MODELS.values():
        # `directional_albedo` is given theta_s and integrates over theta_o, the furnace the other way round.
        brdf = AngleSumTable(start=-math.pi, stop=math.pi, values=table) if table.ndim == 1 else Table(values=table.T)
        for theta_o, _ in VIEWS:
            # A panel to each node; kinks inside panels cost some 1e-5 of a lobe of 1 deg.
            assert directional_albedo(brdf, theta_o) == pytest.approx(albedo(table, theta_o), rel=5e-5)


# ------------------------------------------------------------------------------------------------------- grey furnace


@pytest.mark.parametrize("shape", ["corner", "sphere"])
def test_a_grey_furnace_shows_nothing_but_its_sky(mi: Any, shape: str) -> None:
    a, sky = 0.8, 2.0
    grey = {
        "bsdf": plugin_dict(mi, diffuse(a)),
        "emitter": {"type": "area", "radiance": (1 - a) * sky},
    }
    move = mi.ScalarTransform4f
    things: dict[str, Any] = {"ball": {"type": "sphere", **grey}}
    if shape == "corner":
        # Floor and wall light each other; their black backs face outwards.
        things = {
            "floor": rectangle(mi, (0, 0, 0), **grey),
            "wall": {"type": "rectangle", "to_world": move().translate([-1, 0, 1]).rotate([0, 1, 0], 90), **grey},
        }
    scene = mi.load_dict(
        {
            "type": "scene",
            **things,
            "sky": {"type": "constant", "radiance": sky},
            "sensor": camera(mi, (3, 0.5, 2.5), (0, 0, 0.2), fov=35),
        },
        optimize=False,
    )
    right = radiances(mi, scene, depth=40, spp=1024)
    assert score(right, sky) < LIMIT
    # The thing is there: pixels with it scatter, pixels with nothing but sky do not.
    assert 0.1 < np.mean(right.std(axis=0) > 1e-3 * sky) < 1
    for factor in (FAULT, FAULT**-2):  # 0.5 % too bright, and from there to 0.5 % too dark
        brightened(mi, scene, factor)
        assert score(radiances(mi, scene, depth=40, spp=1024), sky) > LIMIT


# ------------------------------------------------------------------------------------------------------- closed rooms


#: Mitsuba's spheres are not for emitter sampling from their own inside: its `path` then finds 0.2 % too much, with its
#: own `diffuse` just as well. So the sphere is for paths that only scatter, the box for both kinds at once.
ROOMS = {"box": ("cube", "path"), "sphere": ("sphere", "prb_basic")}


@pytest.mark.parametrize("room", ROOMS)
@pytest.mark.parametrize("a", [0.5, 0.8])
@pytest.mark.parametrize("reflector", ["ours", "mitsuba's"])
def test_a_closed_room_shines_with_the_sum_of_its_bounces(mi: Any, room: str, a: float, reflector: str) -> None:
    emitted = 1.5
    expected = emitted / (1 - a)
    bsdf = (
        plugin_dict(mi, diffuse(a))
        if reflector == "ours"
        else {"type": "diffuse", "reflectance": {"type": "uniform", "value": a}}
    )
    shape, integrator = ROOMS[room]
    scene = mi.load_dict(
        {
            "type": "scene",
            "room": {
                "type": shape,
                "flip_normals": True,
                "bsdf": bsdf,
                "emitter": {"type": "area", "radiance": emitted},
            },
            "sensor": camera(mi, (0.3, 0.2, -0.1), (-0.4, 0.6, 0.5), fov=60),
        }
    )
    depth = math.ceil(math.log(1e-6) / math.log(a))  # what longer paths would bring is a millionth of the whole
    right = radiances(mi, scene, depth=depth, spp=128, integrator=integrator)
    assert score(right, expected) < LIMIT
    brightened(mi, scene, FAULT)
    assert score(radiances(mi, scene, depth=depth, spp=128, integrator=integrator), expected) > LIMIT


# -------------------------------------------------------------------------------------------------------- reciprocity


def rho(mi: Any, plugin: Any, wi: NDArray[np.float32], wo: NDArray[np.float32]) -> Array:
    """The BRDF for light from `wo` and a camera at `wi`, from eval and the cosine towards the light."""
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = mi.Vector3f(wi)
    value = plugin.eval(mi.BSDFContext(), si, mi.Vector3f(wo)).numpy().ravel()
    return np.asarray(value.astype(float) / wo[2])


def pairs(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(21)
    first, second = (directions(rng.uniform(-1.5, 1.5, count), rng.uniform(-0.95, 0.95, count)) for _ in range(2))
    return first, second


@pytest.mark.parametrize("name", ["diffuse", "lobes of 15 deg", "lobes of 1 deg", "phong"])
def test_every_angle_sum_is_reciprocal(mi: Any, name: str) -> None:
    """theta_s + theta_o does not know which is which, so no symmetry of the table is needed, even or other."""
    a, b = pairs(20_000)
    plugin = mi.load_dict(plugin_dict(mi, MODELS[name]))
    # The same sum, hence the same cell, fraction and rho to the bit; then cosines of two sizes round once each,
    # but for values that times a cosine are subnormal, which the processor takes for 0.
    np.testing.assert_allclose(rho(mi, plugin, a, b), rho(mi, plugin, b, a), rtol=2 * u, atol=2**-120)


def test_an_even_angle_sum_is_mirror_symmetric_and_that_is_another_matter(mi: Any) -> None:
    """u -> -u turns both directions about the normal: rho is even in u if left and right are alike."""
    a, b = pairs(20_000)
    left = np.array([[-1], [1], [1]], dtype=np.float32)
    for name, even in (("phong", True), ("lobes of 15 deg", False)):
        plugin = mi.load_dict(plugin_dict(mi, MODELS[name]))
        here, there = rho(mi, plugin, a, b), rho(mi, plugin, a * left, b * left)
        # A cell's mirror image counts its fraction from the other node: some roundings of the largest value.
        assert (np.abs(here - there).max() < 8 * u * here.max()) == even
    # Planted: the same table as a function of theta_s - theta_o, as if one sign were wrong, is not reciprocal.
    nodes = np.linspace(-math.pi / 2, math.pi / 2, 361)
    wrong = mi.load_dict(plugin_dict(mi, lobes(15).of_sum(nodes[:, None] - nodes)))
    assert np.abs(rho(mi, wrong, a, b) - rho(mi, wrong, b, a)).max() > 0.5


def test_a_table_is_as_reciprocal_as_it_is_symmetric(mi: Any) -> None:
    table = measured()
    nodes = np.linspace(-math.pi / 2, math.pi / 2, table.shape[0])[1:-1]  # those at the horizon are black
    theta_s, theta_o = (angles.ravel() for angles in np.meshgrid(nodes, nodes, indexing="ij"))
    rng = np.random.default_rng(22)
    light, camera_ = (directions(theta, rng.uniform(-0.5, 0.5, theta.size)) for theta in (theta_s, theta_o))
    plugin = mi.load_dict(plugin_dict(mi, table))
    asymmetry = rho(mi, plugin, camera_, light) - rho(mi, plugin, light, camera_)
    expected = (table - table.T)[1:-1, 1:-1].ravel()
    # Directions in float32 turn the projection of length c > 0.86 by 2 u / c, on the table's steepest slope in both
    # angles, for each of two values that round like bilinear ones do (10 u of the largest).
    slope = np.abs(np.gradient(table)).max() / (nodes[1] - nodes[0])
    tolerance = 2 * (2 * slope * 2 * u / 0.86 + 10 * u * table.max())
    assert np.abs(asymmetry - expected).max() < tolerance
    assert np.abs(expected).max() > 1e4 * tolerance
    # Planted: light and camera mistaken for each other turn the sign.
    assert np.abs(-asymmetry - expected).max() > 1e4 * tolerance

    symmetric = mi.load_dict(plugin_dict(mi, (table + table.T) / 2))
    a, b = pairs(20_000)
    # The same four entries, mixed along the other angle first: each order errs by 10 u of the largest at most.
    assert np.abs(rho(mi, symmetric, a, b) - rho(mi, symmetric, b, a)).max() < 20 * u * table.max()
    assert np.abs(rho(mi, plugin, a, b) - rho(mi, plugin, b, a)).max() > 0.1 * table.max()
