"""Mitsuba's chi-square test of samples against densities, for broad and narrow lobes, in the plane and out of it.

The test's own domain, (cos(theta), phi) about the normal, cuts narrow lobes of ours aslant: at sigma 1 deg its
default quadrature misses the cells' masses and rejects right samplers. `CylinderDomain` has the coordinates theta and
y of `wallmirror.pathtracing.bsdf`, which keep areas too (d omega = d theta dy) and in which lobes run along the cells.
Plugins are seen through their public methods alone, so a wrong use of theta or y in them is not shared by the domain,
which is tested against Mitsuba's own hemispheres first.

Every case has two twins that the same test must reject: samples judged by a density that is slightly elsewhere, and
samples whose y is uniform instead of a coordinate of a point on a disk.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from .soundness import diffuse, directions, lobes, measured, of_sum, phong, plugin_dict, ridge

Array = NDArray[np.float64]
Sampler = Callable[[Any], tuple[Any, Any]]
Density = Callable[[Any], Any]

#: theta and y of the given direction. At grazing, the horizon cuts a flank off one broad lobe.
GIVEN = {"in plane": (math.radians(40), 0.0), "out of plane": (math.radians(-25), 0.6), "grazing": (-1.3, -0.3)}


@dataclass(frozen=True)
class Case:
    """A table, one whose density is slightly elsewhere, and the angle in degrees that cells must resolve."""

    table: Array
    elsewhere: Array
    scale: float


#: Elsewhere: lobes moved by a fifth of their sigma, a diffuse wall that is 10 % brighter per radian of u, a measured
#: table with both directions mistaken for each other.
CASES = {
    **{
        f"lobes of {sigma} deg": Case(of_sum(lobes(sigma)), of_sum(lobes(sigma, shift=0.2)), sigma)
        for sigma in (15, 5, 1, 0.3)
    },
    "diffuse": Case(diffuse(0.7), diffuse(0.7, slope=0.1), 18),
    "phong": Case(of_sum(phong()), of_sum(phong(), shift=0.2 / math.sqrt(50)), 8),
    "measured": Case(measured(), measured().T, 9),
    "ridge": Case(ridge(), ridge(shift=0.2), 1),
}
#: Light and camera differ for tables of both angles only.
MODES = [(name, False) for name in CASES] + [("measured", True), ("ridge", True)]
TESTS = len(MODES) * len(GIVEN)


class CylinderDomain:
    """The hemisphere by theta in [-pi/2, pi/2] and y in [-1, 1]; cells of a third of `scale` degrees in theta."""

    ROWS = 12

    def __init__(self, mi: Any, scale: float) -> None:
        self.mi, self.columns = mi, math.ceil(180 / (scale / 3))

    def bounds(self) -> Any:
        return self.mi.ScalarBoundingBox2f([-math.pi / 2, -1], [math.pi / 2, 1])

    def aspect(self) -> float:
        # Half a cell more, because the test cuts the number of columns ROWS / aspect down to an integer.
        return self.ROWS / (self.columns + 0.5)

    def map_forward(self, p: Any) -> Any:
        c = dr.safe_sqrt(dr.fma(-p.y, p.y, 1))
        sine, cosine = dr.sincos(p.x)
        return self.mi.Vector3f(sine * c, p.y, cosine * c)

    def map_backward(self, w: Any) -> Any:
        return self.mi.Vector2f(dr.atan2(w.x, w.z), w.y)


def prepared(mi: Any, sample: Sampler, pdf: Density, scale: float, seed: int = 0) -> Any:
    """A test with 2^19 samples.

    Trapezoids of a 1/45 of the lobe's sigma err by 1e-4 at most. At y = 1 the density is a square root, and 16 of
    them miss 0.5 % of the outermost cells, which hold 4 % of the samples: 0.5 in a statistic that scatters by > 25.
    """
    return mi.chi2.ChiSquareTest(
        CylinderDomain(mi, scale), sample, pdf, 3, 2**19, res=CylinderDomain.ROWS, ires=16, seed=seed
    )


def passes(test: Any) -> bool:
    """Mitsuba's own verdict, all tests of this file sharing a level of 1 %."""
    return bool(test.run(significance_level=0.01, test_count=TESTS, quiet=True))


def functions(
    mi: Any, plugin: Any, given: tuple[float, float], *, importance: bool = False, uniform_y: bool = False
) -> tuple[Sampler, Density]:
    """What the test needs of a plugin; with `uniform_y` the sampler carries that fault."""
    ctx = mi.BSDFContext(mi.TransportMode.Importance if importance else mi.TransportMode.Radiance)
    wi = mi.Vector3f(mi.ScalarVector3f(*(float(x) for x in directions(*given)[:, 0])))
    dr.make_opaque(wi)  # or each direction would be compiled in

    def interaction(count: int) -> Any:
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.wi = wi
        return si

    def sample(points: Any) -> tuple[Any, Any]:
        si = interaction(dr.width(points))
        drawn, weight = plugin.sample(ctx, si, points[0], mi.Point2f(points[1], points[2]))
        wo = drawn.wo
        if uniform_y:
            y = 2 * points[2] - 1
            stretch = dr.safe_sqrt((1 - y * y) / (1 - wo.y * wo.y))
            wo = mi.Vector3f(wo.x * stretch, y, wo.z * stretch)
        return wo, dr.select(dr.all(weight > 0), mi.Float(1), 0)

    def pdf(wo: Any) -> Any:
        return plugin.pdf(ctx, interaction(dr.width(wo)), wo)

    return sample, pdf


def test_the_domain_keeps_areas_and_directions(mi: Any) -> None:
    uniform, cosine = mi.warp.square_to_uniform_hemisphere, mi.warp.square_to_cosine_hemisphere

    def test(warp: Any, pdf: Density) -> Any:
        return prepared(mi, lambda p: (warp(mi.Point2f(p[0], p[1])), mi.Float(1)), pdf, 15)

    assert passes(test(uniform, mi.warp.square_to_uniform_hemisphere_pdf))
    assert passes(test(cosine, mi.warp.square_to_cosine_hemisphere_pdf))
    assert not passes(test(uniform, mi.warp.square_to_cosine_hemisphere_pdf))
    assert not passes(test(cosine, mi.warp.square_to_uniform_hemisphere_pdf))


@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize(("name", "importance"), MODES)
def test_samples_follow_the_density(mi: Any, name: str, importance: bool, given: str) -> None:
    case = CASES[name]
    plugin, elsewhere = (mi.load_dict(plugin_dict(mi, table)) for table in (case.table, case.elsewhere))
    sample, pdf = functions(mi, plugin, GIVEN[given], importance=importance)
    right = prepared(mi, sample, pdf, case.scale)
    assert passes(right)
    # What the verdict rests on: the masses add up, and most of the lobe's cells are compared one by one.
    assert right.pdf_sum[0] == pytest.approx(1, abs=1e-3)
    assert np.count_nonzero(right.pdf.numpy() > 5) > 50

    _, pdf_elsewhere = functions(mi, elsewhere, GIVEN[given], importance=importance)
    twin = prepared(mi, sample, pdf_elsewhere, case.scale)
    twin.tabulate_pdf()
    assert twin.pdf_sum[0] == pytest.approx(1, abs=1e-3)  # a density itself: refused for its place alone
    assert not passes(twin)

    sample_uniform_y, _ = functions(mi, plugin, GIVEN[given], importance=importance, uniform_y=True)
    assert not passes(prepared(mi, sample_uniform_y, pdf, case.scale))


@pytest.mark.parametrize(
    ("name", "nearly"),
    [
        ("lobes of 1 deg", of_sum(lobes(1, shift=0.007))),
        ("measured", 0.987 * measured() + 0.013 * measured().T),
    ],
)
def test_p_values_are_uniform_over_seeds(mi: Any, name: str, nearly: Array) -> None:
    """Faults too small for one test add up over 24, and samples more even than random ones would show as well."""
    case, given = CASES[name], GIVEN["out of plane"]
    sample, pdf = functions(mi, mi.load_dict(plugin_dict(mi, case.table)), given)
    _, pdf_nearly = functions(mi, mi.load_dict(plugin_dict(mi, nearly)), given)
    tests = [prepared(mi, sample, density, case.scale) for density in (pdf, pdf_nearly)]
    for test in tests:
        test.tabulate_pdf()
    right, twin = [], []
    for seed in range(24):
        for test, p_values in zip(tests, (right, twin), strict=True):
            test.seed = seed
            test.tabulate_histogram()
            test.run(quiet=True)
            p_values.append(test.p_value)
    assert stats.kstest(right, "uniform").pvalue > 1e-3
    # Planted: a lobe moved by 0.7 % of its sigma, a table with 1.3 % of the other way round. One test passes them.
    assert np.median(twin) > 0.01
    assert stats.kstest(twin, "uniform").pvalue < 1e-3
