"""The tabulated BRDF against NumPy: values, densities, samples, both transport modes, updates and refusals.

u below is the unit roundoff of float32; deterministic seeds make every statistical verdict repeatable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from wallmirror.pathtracing import bsdf
from wallmirror.pathtracing.tables import checked_table, loaded_table, parsed_table, table_text

Array = NDArray[np.float64]

u = 2.0**-24
SIGMA = math.radians(15)
EPS_DIRECTION = 2 * u  # a direction's float32 components turn its projection of length c by at most this / c


def sum_table(count: int = 361) -> Array:
    """A lobe of sigma 15 deg about the mirror direction, over a faint and lopsided floor."""
    nodes = np.linspace(-math.pi, math.pi, count)
    return np.exp(-0.5 * (nodes / SIGMA) ** 2) + 0.02 * (2 + np.sin(nodes))


def symmetric_table(count: int = 181) -> Array:
    """The sigma = 15 deg lobe as a function of both angles."""
    nodes = np.linspace(-math.pi / 2, math.pi / 2, count)
    return np.exp(-0.5 * ((nodes[:, None] + nodes) / SIGMA) ** 2)


def lopsided_table() -> Array:
    """A table without any symmetry, with different numbers of nodes along its axes."""
    s, o = np.linspace(-1, 1, 91)[:, None], np.linspace(-1, 1, 61)
    return np.exp(-((s - 0.4 + 0.5 * o) ** 2) / 0.1) * (1.2 + np.sin(3 * o)) + 0.05 * (1 + s)


TABLES: dict[str, Array] = {"sum": sum_table(), "symmetric": symmetric_table(), "lopsided": lopsided_table()}
#: theta and out-of-plane sine y of the given direction: normal, oblique in the plane, oblique out of it.
GIVEN = {"normal": (0.0, 0.0), "in plane": (math.radians(40), 0.0), "out of plane": (math.radians(-25), 0.6)}


def load(mi: Any, table: Array) -> Any:
    return mi.load_dict({"type": bsdf.ANGLE_SUM if table.ndim == 1 else bsdf.TABLE, "table": mi.TensorXf(table)})


def directions(theta: Any, y: Any) -> NDArray[np.float32]:
    """Unit vectors (sin(theta) c, y, cos(theta) c), shape (3, n), as Mitsuba will see them."""
    theta, y = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(y, dtype=float))
    c = np.sqrt(1 - y**2)
    return np.array([np.sin(theta) * c, y, np.cos(theta) * c]).reshape(3, -1).astype(np.float32)


def angles(w: NDArray[np.float32]) -> Array:
    return np.arctan2(w[0].astype(float), w[2].astype(float))


def interaction(mi: Any, wi: NDArray[np.float32]) -> Any:
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = mi.Vector3f(wi)
    return si


def context(mi: Any, *, importance: bool = False) -> Any:
    return mi.BSDFContext(mi.TransportMode.Importance if importance else mi.TransportMode.Radiance)


def truth(table: Array, theta_s: Array, theta_o: Array) -> Array:
    """SciPy's interpolation in float64 of the table's float32 values."""
    stored = table.astype(np.float32).astype(np.float64)
    if table.ndim == 1:
        return np.interp(theta_s + theta_o, np.linspace(-math.pi, math.pi, table.size), stored)
    grid = tuple(np.linspace(-math.pi / 2, math.pi / 2, size) for size in table.shape)
    return np.asarray(RegularGridInterpolator(grid, stored)(np.stack([theta_s, theta_o], axis=-1)))


def given_and_free(table: Array, theta_i: float, theta: Array, *, importance: bool) -> Array:
    """rho at a given and a free direction, whichever of them points to the light."""
    given = np.full_like(theta, theta_i)
    return truth(table, given, theta) if importance else truth(table, theta, given)


def pieces(table: Array, theta_i: float, *, importance: bool) -> tuple[Array, Array]:
    """Nodes and weights in theta of the 2-point Gauss rule between all kinks of the interpolant: exact for cubics."""
    if table.ndim == 1:
        kinks = np.linspace(-math.pi, math.pi, table.size) - theta_i
    else:
        kinks = np.linspace(-math.pi / 2, math.pi / 2, table.shape[1 if importance else 0])
    half = math.pi / 2
    edges = np.unique(np.concatenate([[-half], kinks[np.abs(kinks) < half], [half]]))
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    offset = width / (2 * math.sqrt(3))
    return np.concatenate([middle - offset, middle + offset]), np.concatenate([width, width]) / 2


def pdf_integral(mi: Any, plugin: Any, table: Array, theta_i: float, y_i: float, *, importance: bool = False) -> float:
    """Integral of the pdf over the hemisphere: pieces in theta, Gauss-Chebyshev of the second kind in y."""
    theta, weight = pieces(table, theta_i, importance=importance)
    j = np.arange(1, 6) * math.pi / 6
    y, weight_y = np.cos(j), math.pi / 6 * np.sin(j)  # for f itself: sin^2 / sqrt(1 - y^2)
    wo = directions(theta[:, None], y)
    si = interaction(mi, np.repeat(directions(theta_i, y_i), wo.shape[1], axis=1))
    pdf = plugin.pdf(context(mi, importance=importance), si, mi.Vector3f(wo)).numpy().astype(float)
    return float(weight @ pdf.reshape(theta.size, y.size) @ weight_y)


def uniforms(mi: Any, count: int, seed: int) -> tuple[Any, Any]:
    points = np.random.default_rng(seed).random((3, count)).astype(np.float32)
    return mi.Float(points[0]), mi.Point2f(points[1:])


class Faulty:
    """A plugin whose pdf is some multiple of the right one: what the checks below must catch."""

    def __init__(self, plugin: Any, factor: Callable[[Any], Any]) -> None:
        self.plugin, self.factor = plugin, factor

    def __getattr__(self, name: str) -> Any:
        return getattr(self.plugin, name)

    def pdf(self, ctx: Any, si: Any, wo: Any) -> Any:
        return self.plugin.pdf(ctx, si, wo) * self.factor(wo)


# ------------------------------------------------------------------------------------------------------------ values


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("importance", [False, True])
def test_eval_is_the_interpolated_table_times_the_cosine(mi: Any, name: str, importance: bool) -> None:
    table, rng = TABLES[name], np.random.default_rng(1)
    wi, wo = (directions(rng.uniform(-1.57, 1.57, 20_000), rng.uniform(-0.99, 0.99, 20_000)) for _ in range(2))
    value = load(mi, table).eval(context(mi, importance=importance), interaction(mi, wi), mi.Vector3f(wo)).numpy()
    light, camera = (wi, wo) if importance else (wo, wi)

    def error(shift: float) -> float:
        exact = truth(table, angles(light) + shift, angles(camera)) * wo[2]
        return float(np.abs(value.ravel() - exact).max() / table.max())

    # A linear step rounds its fraction, difference and result; bilinear takes three steps; the cosine rounds once.
    tolerance = (4 if table.ndim == 1 else 10) * u
    assert error(0.0) <= tolerance
    # Planted: angles as wrong as float32 arctangents are.
    assert error(2e-6) > tolerance


def test_a_narrow_lobe_on_many_nodes_keeps_its_digits(mi: Any) -> None:
    # sigma 0.1 deg on 7201 nodes, seen within three sigma of its peak.
    nodes, sigma, rng = np.linspace(-math.pi, math.pi, 7201), math.radians(0.1), np.random.default_rng(11)
    table = np.exp(-0.5 * ((nodes - math.radians(15)) / sigma) ** 2)
    theta_i = rng.uniform(-1.2, 1.4, 10_000)
    wi = directions(theta_i, rng.uniform(-0.9, 0.9, 10_000))
    wo = directions(math.radians(15) - theta_i + rng.uniform(-3, 3, 10_000) * sigma, rng.uniform(-0.9, 0.9, 10_000))
    value = load(mi, table).eval(context(mi), interaction(mi, wi), mi.Vector3f(wo)).numpy().ravel()
    exact = truth(table, angles(wo), angles(wi)) * wo[2]
    assert exact.max() > 0.99
    np.testing.assert_allclose(value, exact, rtol=0, atol=4 * u)
    # With the lobe in the middle, near one horizon, and beyond the other but for its flank. The quadrature's float32
    # directions miss its nodes by EPS_DIRECTION, on slopes of 1 / sigma.
    for theta in (0.0, 1.2, math.radians(15.2) - math.pi / 2):
        integral = pdf_integral(mi, load(mi, table), table, theta, 0.0)
        assert integral == pytest.approx(1, abs=20 * u + EPS_DIRECTION / sigma)


@pytest.mark.parametrize("name", TABLES)
def test_the_table_is_cylindrical(mi: Any, name: str) -> None:
    table, theta_i, theta = TABLES[name], 0.3, -0.2
    y = np.linspace(-0.95, 0.95, 39)
    wi, wo = directions(theta_i, -y[::-1] / 2), directions(theta, y)
    rho = load(mi, table).eval(context(mi), interaction(mi, wi), mi.Vector3f(wo)).numpy().ravel() / wo[2]
    flat = float(truth(table, np.array([theta]), np.array([theta_i]))[0])
    slope = np.abs(np.gradient(table)).max() * max(table.shape) / math.pi  # of the steeper axis, per radian
    np.testing.assert_allclose(rho, flat, rtol=0, atol=2 * slope * EPS_DIRECTION / math.sqrt(1 - 0.95**2) + 12 * u)


@pytest.mark.parametrize("name", ["sum", "lopsided"])
@pytest.mark.parametrize(("side_i", "side_o"), [(1, -1), (-1, 1), (-1, -1), (0, 1), (1, 0)])
def test_both_directions_must_be_above_the_surface(mi: Any, name: str, side_i: int, side_o: int) -> None:
    def on(side: int, x: float) -> NDArray[np.float32]:
        return np.array([[1.0], [0.0], [0.0]] if side == 0 else [[x], [0.1], [side * 0.7]], dtype=np.float32)

    plugin, si, wo = load(mi, TABLES[name]), interaction(mi, on(side_i, 0.3)), mi.Vector3f(on(side_o, -0.3))
    value, pdf = plugin.eval_pdf(context(mi), si, wo)
    assert value.numpy().item() == 0
    assert pdf.numpy().item() == 0
    if side_i != 1:
        sample, weight = plugin.sample(context(mi), si, mi.Float(0.4), mi.Point2f(0.3, 0.6))
        assert sample.pdf.numpy().item() == 0
        assert weight.numpy().item() == 0


def test_the_table_axis_is_the_wall_s_x_and_the_light_comes_first(mi: Any) -> None:
    # A table lit from theta_s > 0 only and seen from theta_o < 0 only; a sun at theta_s, a camera at theta_o. The
    # radiance is rho cos(theta_s) E, without noise: this fixes signs and order of the axes in a whole scene.
    nodes = np.linspace(-math.pi / 2, math.pi / 2, 181)
    table = 0.1 + np.clip(nodes, 0, None)[:, None] * np.clip(-nodes, 0, None)
    sun, camera = 0.5, -0.7

    def radiance(theta_s: float, theta_o: float) -> float:
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct"},
                "wall": {"type": "rectangle", "bsdf": {"type": bsdf.TABLE, "table": mi.TensorXf(table)}},
                "sun": {
                    "type": "directional",
                    "direction": [-math.sin(theta_s), 0, -math.cos(theta_s)],
                    "irradiance": 2.0,
                },
                "sensor": {
                    "type": "perspective",
                    "fov": 0.01,
                    "to_world": mi.ScalarTransform4f().look_at(
                        [5 * math.sin(theta_o), 0, 5 * math.cos(theta_o)], [0, 0, 0], [0, 1, 0]
                    ),
                    "film": {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance"},
                },
            }
        )
        return float(mi.render(scene, spp=4, seed=0).numpy().item())

    def expected(theta_s: float, theta_o: float) -> float:
        rho = truth(table, np.array([theta_s]), np.array([theta_o]))[0]
        return float(2 * rho * math.cos(theta_s))

    # The pixel is 1.7e-4 rad wide and the logarithmic slope of the table at most 1 / 0.5.
    for pair in [(sun, camera), (-sun, camera), (sun, -camera), (camera, sun)]:
        assert radiance(*pair) == pytest.approx(expected(*pair), rel=5e-4)
    assert expected(sun, camera) > 2 * max(expected(-sun, camera), expected(sun, -camera))


# ---------------------------------------------------------------------------------------------- densities and samples


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("importance", [False, True])
def test_the_pdf_integrates_to_one(mi: Any, name: str, given: str, importance: bool) -> None:
    table = TABLES[name]
    plugin = load(mi, table)
    # Each of the pdf's factors and of the directions rounds once or twice; a systematic 20 u is the worst of them.
    tolerance = 20 * u
    assert pdf_integral(mi, plugin, table, *GIVEN[given], importance=importance) == pytest.approx(1, abs=tolerance)
    wrong = Faulty(plugin, lambda wo: 1.02)
    assert pdf_integral(mi, wrong, table, *GIVEN[given], importance=importance) != pytest.approx(1, abs=tolerance)


@pytest.mark.parametrize("count", [2, 3, 4, 360])
def test_the_window_is_exact_inside_cells(mi: Any, count: int) -> None:
    # Few nodes: the window's ends fall deep into cells. All directions, up to 1e-3 rad from grazing.
    table = np.random.default_rng(count).random(count)
    for theta_i in [-math.pi / 2 + 1e-3, -0.4, 0.77, math.pi / 2 - 1e-3]:
        assert pdf_integral(mi, load(mi, table), table, theta_i, 0.0) == pytest.approx(1, abs=20 * u)


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("importance", [False, True])
def test_a_sample_s_weight_is_eval_over_pdf(mi: Any, name: str, given: str, importance: bool) -> None:
    table, ctx = TABLES[name], context(mi, importance=importance)
    plugin, si = load(mi, table), interaction(mi, np.repeat(directions(*GIVEN[given]), 10_000, axis=1))
    sample, weight = plugin.sample(ctx, si, *uniforms(mi, 10_000, seed=2))
    value, pdf = plugin.eval_pdf(ctx, si, sample.wo)
    weight, value = weight.numpy().ravel(), value.numpy().ravel()
    lit = sample.pdf.numpy() > 0
    assert lit.mean() > 0.999
    # rho cancels, whichever angle it is looked up at: what remains are some ten roundings of the other factors.
    np.testing.assert_allclose(weight[lit], (value / pdf.numpy())[lit], rtol=16 * u)
    # The sampled angle and the angle of the rounded direction differ by EPS_DIRECTION / c; the pdf has a factor c.
    steepest = np.abs(np.diff(table, axis=0)).max() * (table.shape[0] - 1) / (math.pi * (3 - table.ndim))
    steepest = max(
        steepest, np.abs(np.diff(table, axis=-1)).max() * (table.shape[-1] - 1) / (math.pi * (3 - table.ndim))
    )
    brightest = pdf.numpy().max() / np.max(value / sample.wo.z.numpy(), initial=0, where=lit)  # density of rho = 1
    tolerance = brightest * (steepest * EPS_DIRECTION + 16 * u * table.max())
    np.testing.assert_allclose(sample.pdf.numpy()[lit], pdf.numpy()[lit], rtol=0, atol=tolerance)


def reflectance(table: Array, theta_i: float, *, importance: bool) -> float:
    """Integral of rho cos over the hemisphere: pi/2 times that of rho cos(theta) over theta."""
    theta, weight = pieces(table, theta_i, importance=importance)
    rho = given_and_free(table, theta_i, theta, importance=importance)
    # The Gauss rule on rho cos(theta), no cubic: its error is of order (cell / 2)^4 / 135 < 1e-6 of the result.
    return math.pi / 2 * float(weight @ (rho * np.cos(theta)))


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("importance", [False, True])
def test_samples_add_up_to_the_reflectance(mi: Any, name: str, given: str, importance: bool) -> None:
    table, count = TABLES[name], 400_000
    theta_i, y_i = GIVEN[given]
    si = interaction(mi, np.repeat(directions(theta_i, y_i), count, axis=1))
    _, weight = load(mi, table).sample(context(mi, importance=importance), si, *uniforms(mi, count, seed=3))
    weights = weight.numpy().ravel().astype(float)
    exact = reflectance(table, theta_i, importance=importance)
    error = weights.std() / math.sqrt(count)
    assert error < 1.2e-3 * exact  # so that half a per cent would be seen
    # Five standard errors: 6e-7 for a false alarm under a new seed.
    assert abs(weights.mean() - exact) < 5 * error
    assert abs(weights.mean() - 1.01 * exact) > 5 * error


def chi_square(mi: Any, plugin: Any, given: tuple[float, float], *, importance: bool = False) -> float:
    """p-value of Mitsuba's chi-square test of the samples against the pdf; 0 if it cannot even be made.

    1e6 samples on 101 x 202 cells; 8 x 8 trapezoids a cell resolve a lobe of 15 deg (8 cells wide) to 1e-4.
    """
    wi = directions(*given)
    ctx = context(mi, importance=importance)

    def sample(points: Any) -> tuple[Any, Any]:
        si = interaction(mi, np.repeat(wi, dr.width(points), axis=1))
        drawn, weight = plugin.sample(ctx, si, points[0], mi.Point2f(points[1], points[2]))
        return drawn.wo, dr.select(dr.all(weight > 0), mi.Float(1), 0)

    def pdf(wo: Any) -> Any:
        return plugin.pdf(ctx, interaction(mi, np.repeat(wi, dr.width(wo), axis=1)), wo)

    test = mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, res=101, ires=8)
    test.run(quiet=True)
    return 0.0 if test.fail else float(test.p_value)  # fails on samples where the pdf is 0, or on a mass above 1.1


# 12 tests share a level of 1 %: Sidak's bound for each of them.
LEVEL = 1 - (1 - 0.01) ** (1 / 12)


@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize(
    ("name", "importance"), [("sum", False), ("symmetric", False), ("lopsided", False), ("lopsided", True)]
)
def test_samples_follow_the_pdf(mi: Any, name: str, given: str, importance: bool) -> None:
    assert chi_square(mi, load(mi, TABLES[name]), GIVEN[given], importance=importance) > LEVEL


@pytest.mark.parametrize("name", TABLES)
def test_the_chi_square_test_sees_planted_faults(mi: Any, name: str) -> None:
    plugin = load(mi, TABLES[name])
    # Too large by 2 %; tilted along the table's axis, which keeps the integral near 1; the wrong law along t. A factor
    # 1 + t raises the statistic by 1e6 mean(t^2), against its standard deviation of 55 to 140.
    for factor in (lambda wo: 1.02, lambda wo: 1 + 0.1 * wo.x, lambda wo: 4 / 3 * dr.sqrt(1 - wo.y * wo.y)):
        assert chi_square(mi, Faulty(plugin, factor), GIVEN["normal"]) < LEVEL


def test_importance_mode_swaps_light_and_camera(mi: Any) -> None:
    plugin, rng = load(mi, TABLES["lopsided"]), np.random.default_rng(4)
    a, b = (directions(rng.uniform(-1.5, 1.5, 1000), rng.uniform(-0.9, 0.9, 1000)) for _ in range(2))

    def rho(wi: NDArray[np.float32], wo: NDArray[np.float32], *, importance: bool) -> Array:
        value = plugin.eval(context(mi, importance=importance), interaction(mi, wi), mi.Vector3f(wo))
        return np.asarray(value.numpy().ravel() / wo[2], dtype=float)

    # The same four table entries, mixed in the same order: only the cosine's rounding differs.
    np.testing.assert_allclose(rho(a, b, importance=True), rho(b, a, importance=False), rtol=4 * u)
    assert np.abs(rho(a, b, importance=True) / rho(a, b, importance=False) - 1).max() > 0.5


def test_light_and_path_tracing_agree_on_a_table_that_is_not_reciprocal(mi: Any) -> None:
    nodes = np.linspace(-math.pi / 2, math.pi / 2, 61)
    table = np.exp(-0.5 * ((nodes[:, None] - 0.5) / 0.4) ** 2) * (1 + 0.8 * np.sin(2 * nodes))
    move = mi.ScalarTransform4f

    def image(table: Array, integrator: str, seeds: int) -> Array:
        """Means over the pixels left of the card, one for each seed; the card hides the rest from light paths."""
        scene = mi.load_dict(
            {
                "type": "scene",
                "wall": {
                    "type": "rectangle",
                    "to_world": move().scale([20, 20, 1]),
                    "bsdf": {"type": bsdf.TABLE, "table": mi.TensorXf(table)},
                },
                "card": {
                    "type": "rectangle",
                    "to_world": move().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale([0.5, 0.5, 1]),
                    "bsdf": {"type": "diffuse", "reflectance": 0.0},
                    "emitter": {"type": "area", "radiance": 1.0},
                },
                "sensor": {
                    "type": "perspective",
                    "fov": 60,
                    "to_world": move().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": 100,
                        "height": 1,
                        "pixel_format": "luminance",
                        "rfilter": {"type": "box"},
                    },
                },
            }
        )
        method = mi.load_dict({"type": integrator, "max_depth": 2, "hide_emitters": True})
        images = [mi.render(scene, integrator=method, spp=1024, seed=seed).numpy() for seed in range(seeds)]
        return np.array([picture[0, :30, 0].astype(float).mean() for picture in images])

    def z(one: Array, other: Array) -> float:
        spread = math.hypot(one.std(ddof=1) / math.sqrt(one.size), other.std(ddof=1) / math.sqrt(other.size))
        return float(abs(one.mean() - other.mean()) / spread)

    by_path, by_light = image(table, "path", 16), image(table, "ptracer", 32)
    assert z(by_path, by_light) < 4.5  # Student's t with at least 15 degrees of freedom: 4e-4
    # Planted: light tracing through the transposed table, as if importance mode did not swap.
    assert z(by_path, image(table.T, "ptracer", 32)) > 10


# ------------------------------------------------------------------------------------------- dark, dim and bright rows


def finite_sample(mi: Any, plugin: Any, theta_i: float) -> tuple[Array, Array]:
    si = interaction(mi, np.repeat(directions(theta_i, 0.2), 5000, axis=1))
    sample, weight = plugin.sample(context(mi), si, *uniforms(mi, 5000, seed=5))
    assert np.isfinite(sample.wo.numpy()).all()
    assert np.isfinite(sample.pdf.numpy()).all()
    assert np.isfinite(weight.numpy()).all()
    return sample.pdf.numpy(), weight.numpy().ravel()


@pytest.mark.parametrize("table", [np.zeros(7), np.zeros((5, 4))])
def test_a_black_table_gives_inactive_samples(mi: Any, table: Array) -> None:
    pdf, weight = finite_sample(mi, load(mi, table), 0.3)
    assert not pdf.any()
    assert not weight.any()
    assert not load(mi, table).pdf(context(mi), interaction(mi, directions(0.3, 0)), mi.Vector3f(0, 0, 1)).numpy().any()


def test_a_dark_row_beside_a_lit_one_gives_inactive_samples(mi: Any) -> None:
    lit = np.zeros((5, 5))
    lit[:, 4] = 1  # seen from theta_o > pi/4 only
    assert not finite_sample(mi, load(mi, lit), -0.5)[1].any()
    assert finite_sample(mi, load(mi, lit), 1.2)[1].all()
    window = np.where(np.linspace(-math.pi, math.pi, 361) > 3, 1.0, 0.0)  # out of sight from theta_i = 0
    assert not finite_sample(mi, load(mi, window), 0.0)[1].any()
    assert finite_sample(mi, load(mi, window), 1.55)[1].any()


def test_a_single_lit_node_is_sampled_only_where_it_is(mi: Any) -> None:
    spike = np.zeros(361)
    spike[200] = 1
    pdf, weight = finite_sample(mi, load(mi, spike), 0.1)
    assert (pdf > 0).mean() > 0.999
    assert pdf_integral(mi, load(mi, spike), spike, 0.1, 0.0) == pytest.approx(1, abs=20 * u)
    # All of them lie within a cell of u = 20 deg, where the weight is total (pi/2) cos(theta).
    theta = math.radians(20) - 0.1
    expected = math.radians(1) * math.pi / 2 * math.cos(theta)
    np.testing.assert_allclose(weight[weight > 0], expected, rtol=math.radians(1) * math.tan(theta) * 1.1)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e6, 1e30])
@pytest.mark.parametrize("name", ["sum", "lopsided"])
def test_weights_scale_with_the_table(mi: Any, name: str, scale: float) -> None:
    pdf, weight = finite_sample(mi, load(mi, TABLES[name]), 0.3)
    scaled_pdf, scaled = finite_sample(mi, load(mi, TABLES[name] * scale), 0.3)
    # Scaling rounds each entry anew: u relative in rho, total and ratio, and absolute in the sampled angle, whose
    # cosine is a factor of the weight.
    np.testing.assert_allclose(scaled / scale, weight, rtol=32 * u, atol=4 * u * weight.max())
    np.testing.assert_allclose(scaled_pdf, pdf, rtol=1e-4)


# ----------------------------------------------------------------------------------------------------------- updates


def values(mi: Any, plugin: Any) -> tuple[Array, Array]:
    rng = np.random.default_rng(6)
    wi, wo = (directions(rng.uniform(-1.5, 1.5, 500), rng.uniform(-0.9, 0.9, 500)) for _ in range(2))
    value, pdf = plugin.eval_pdf(context(mi), interaction(mi, wi), mi.Vector3f(wo))
    return value.numpy().ravel(), pdf.numpy()


@pytest.mark.parametrize("name", ["sum", "lopsided"])
@pytest.mark.parametrize("resize", [False, True])
def test_an_updated_table_is_as_good_as_a_fresh_one(mi: Any, name: str, resize: bool) -> None:
    table = TABLES[name]
    new = table[..., ::-1][..., : 31 if resize else None] + 0.3
    plugin = load(mi, table)
    params = mi.traverse(plugin)
    params["table"] = mi.TensorXf(new)
    params.update()
    np.testing.assert_array_equal(values(mi, plugin), values(mi, load(mi, new)))
    assert pdf_integral(mi, plugin, new, 0.3, 0.0) == pytest.approx(1, abs=20 * u)
    # Planted: a sampler that missed the update.
    assert pdf_integral(mi, load(mi, table), new, 0.3, 0.0) == pytest.approx(1, abs=0.2)
    assert not np.array_equal(values(mi, plugin), values(mi, load(mi, table)))


def test_an_update_compiles_nothing(mi: Any) -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "wall": {"type": "rectangle", "bsdf": {"type": bsdf.ANGLE_SUM, "table": mi.TensorXf(TABLES["sum"])}},
            "sky": {"type": "constant", "radiance": 1.0},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 2, "height": 2, "pixel_format": "luminance"},
            },
        }
    )
    params = mi.traverse(scene)
    mi.render(scene, spp=4).numpy()
    params["wall.bsdf.table"] = mi.TensorXf(2 * TABLES["sum"])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        params.update()
        mi.render(scene, spp=4, seed=1).numpy()
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.mark.parametrize("bad", [math.nan, -1e-3, math.inf])
@pytest.mark.parametrize("name", ["sum", "lopsided"])
def test_a_bad_update_is_refused_and_leaves_the_old_table(mi: Any, name: str, bad: float) -> None:
    plugin = load(mi, TABLES[name])
    before = values(mi, plugin)
    wrong = TABLES[name].copy()
    wrong[(3,) * wrong.ndim] = bad
    params = mi.traverse(plugin)
    params["table"] = mi.TensorXf(wrong)
    with pytest.raises(ValueError, match="at node"):
        params.update()
    np.testing.assert_array_equal(values(mi, plugin), before)
    params["table"] = mi.TensorXf(TABLES[name])
    params.update()
    np.testing.assert_array_equal(values(mi, plugin), before)


@pytest.mark.parametrize("name", ["sum", "lopsided"])
def test_gradients_with_respect_to_the_table(mi: Any, name: str) -> None:
    # eval and a sample's value (weight times its fixed pdf) are linear in the table: sum(table * gradient) gives the
    # value back (Euler), and the gradient of no entry is negative.
    table = TABLES[name]
    plugin = load(mi, table)
    params = mi.traverse(plugin)
    dr.enable_grad(params["table"])
    params.update()
    si = interaction(mi, directions(np.linspace(-1, 1, 50), 0.2))
    _, weight = plugin.sample(context(mi), si, *uniforms(mi, 50, seed=7))
    for value in (plugin.eval(context(mi), si, mi.Vector3f(0.3, 0.1, 0.9)), weight):
        total = dr.sum(value, axis=None)
        dr.set_grad(params["table"], 0)
        dr.backward(total)
        gradient = dr.grad(params["table"]).numpy()
        assert gradient.min() >= 0
        # Sums of some hundred float32 terms.
        assert float((gradient.astype(float) * table).sum()) == pytest.approx(total.numpy().item(), rel=100 * u)


# --------------------------------------------------------------------------------------------------- other ways in


@pytest.mark.parametrize("name", ["sum", "lopsided"])
@pytest.mark.parametrize("way", ["values", "filename"])
def test_a_scene_written_to_xml_loads_back(mi: Any, name: str, way: str, tmp_path: Path) -> None:
    table = TABLES[name].astype(np.float32)
    np.save(tmp_path / "wall.npy", table)
    given = {"values": table_text(table)} if way == "values" else {"filename": "wall.npy"}
    plugin = {"type": bsdf.ANGLE_SUM if table.ndim == 1 else bsdf.TABLE, **given}
    state = mi.parser.parse_dict(
        mi.parser.ParserConfig(mi.variant()), {"type": "scene", "wall": {"type": "rectangle", "bsdf": plugin}}
    )
    mi.parser.write_file(bsdf.declare(state), str(tmp_path / "scene.xml"))
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    (shape,) = scene.shapes()
    np.testing.assert_array_equal(values(mi, shape.bsdf()), values(mi, load(mi, table)))


def test_the_scalar_variant_gives_the_same_values(mi: Any) -> None:
    for table in (TABLES["sum"], TABLES["lopsided"]):
        rng = np.random.default_rng(8)
        wi, wo = (directions(rng.uniform(-1.5, 1.5, 20), rng.uniform(-0.9, 0.9, 20)) for _ in range(2))
        value, pdf = load(mi, table).eval_pdf(context(mi), interaction(mi, wi), mi.Vector3f(wo))
        point, square = uniforms(mi, 20, seed=9)
        drawn, weight = load(mi, table).sample(context(mi), interaction(mi, wi), point, square)
        point, square, drawn_wo = point.numpy(), square.numpy(), drawn.wo.numpy()
        value, pdf, weight = value.numpy().ravel(), pdf.numpy(), weight.numpy().ravel()
        with mi.scoped_set_variant("scalar_rgb"):
            bsdf.register()
            plugin, si = load(mi, table), mi.SurfaceInteraction3f()
            for k in range(20):
                si.wi = mi.Vector3f(wi[:, k].tolist())
                one, density = plugin.eval_pdf(context(mi), si, mi.Vector3f(wo[:, k].tolist()))
                # Both round differently, the scalar variant computing partly in double precision.
                assert one[0] == pytest.approx(value[k], rel=32 * u, abs=1e-12)
                assert density == pytest.approx(pdf[k], rel=32 * u, abs=1e-12)
                sample, one = plugin.sample(context(mi), si, float(point[k]), mi.Point2f(square[:, k].tolist()))
                assert one[0] == pytest.approx(weight[k], rel=32 * u)
                np.testing.assert_allclose(np.array(sample.wo), drawn_wo[:, k], rtol=0, atol=8 * u)


def test_plugins_describe_themselves(mi: Any) -> None:
    assert str(load(mi, np.ones((3, 4)))) == "wallmirror_table[nodes = 3 x 4, largest value = 1 / sr]"
    assert str(load(mi, np.ones(5))) == "wallmirror_angle_sum[nodes = 5, largest value = 1 / sr]"


# ----------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("table", "dimensions", "told"),
    [
        (np.ones(1), 1, "at least 2"),
        (np.ones((3, 1)), 2, "at least 2"),
        (np.ones((2, 2)), 1, "give \\(nodes,\\)"),
        (np.ones(4), 2, "theta_s nodes, theta_o nodes"),
        (0.5, 1, "shape \\(\\)"),
        ([1.0, math.nan], 1, "nan at node 1"),
        ([1.0, -1e-9], 1, "-1e-09 at node 1"),
        ([[1.0, 1.0], [1.0, math.inf]], 2, "inf at node \\(1, 1\\)"),
        ([1e39, 1.0], 1, "1e\\+39 at node 0"),
        ([1.0, None, "x"], 1, "no array of numbers"),
    ],
)
def test_what_is_no_table_is_refused(table: Any, dimensions: int, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        checked_table(table, dimensions)


def test_a_float32_table_survives_text_bit_for_bit() -> None:
    rng = np.random.default_rng(10)
    for table in (rng.random(50).astype(np.float32) * np.float32(1e-30), rng.random((7, 3)).astype(np.float32)):
        back = checked_table(parsed_table(table_text(table), table.ndim), table.ndim)
        assert back.tobytes() == table.tobytes()
    np.testing.assert_array_equal(parsed_table(" 1, 2\n3,4 ", 1), [1, 2, 3, 4])


@pytest.mark.parametrize(("text", "told"), [("1 2 x", "not made of numbers"), ("1 2; 3", "differ in length")])
def test_text_that_is_no_table_is_refused(text: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        parsed_table(text, 2)


def test_files_that_are_no_table_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        loaded_table(tmp_path / "missing.npy")
    (tmp_path / "text.npy").write_text("1 2 3")
    np.save(tmp_path / "pickle.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    for name in ("text.npy", "pickle.npy"):
        with pytest.raises(ValueError, match="cannot be read"):
            loaded_table(tmp_path / name)
    np.save(tmp_path / "complex.npy", np.ones(3, dtype=complex))
    with pytest.raises(ValueError, match="complex"):
        loaded_table(tmp_path / "complex.npy")
    # A header may state what no file of that length holds: it is judged before anything is allocated.
    vast = tmp_path / "vast.npy"
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**40}, {2**20}), }}".encode().ljust(117) + b"\n"
    vast.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 32)
    with pytest.raises(ValueError, match="its header states"):
        loaded_table(vast)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "the scene gives none"),
        ({"values": "1 1", "filename": "x.npy"}, "one of table, values and filename"),
        ({"values": "1 -1"}, "-1 at node 1"),
        ({"filename": "missing.npy"}, "missing.npy: no such file"),
    ],
)
def test_a_scene_with_a_bad_table_is_refused(mi: Any, given: dict[str, str], told: str) -> None:
    # Mitsuba wraps the ValueError of a constructor, text and all.
    with pytest.raises(RuntimeError, match=told):
        mi.load_dict({"type": bsdf.ANGLE_SUM, **given})
