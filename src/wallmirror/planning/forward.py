"""The fewest evaluations of the BRDF that still predict a scene's one-bounce films to a tolerance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from wallmirror.brdf import AngleSumBRDF
from wallmirror.derendering.foresight import closest_spline
from wallmirror.derendering.splines import grid_for
from wallmirror.planning.hypotheses import table_error
from wallmirror.planning.sketch import Sketch

Strips = Literal["points", "strips", "exact"]

_LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
_TABLES = (46, 91, 181, 361, 721, 1441, 2881, 7201, 14401, 28801, 72001, 144001, 720001)
_KNOTS_DEG = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125)


@dataclass(frozen=True, kw_only=True)
class Quadrature:
    """How finely one bounce is to be computed.

    Parameters
    ----------
    strips:
        "points" (cos cos / r^2), "strips" (of their width and height), or "exact" for a mirror, which needs no nodes.
    across_pixel, across_strip:
        Gauss-Legendre nodes.
    error:
        Relative L2 error of the films.
    seconds:
        Of one evaluation of all views, as timed here.
    """

    strips: Strips
    across_pixel: int
    across_strip: int
    error: float
    seconds: float

    def summary(self) -> dict[str, Any]:
        """As part of a JSON document."""
        return dict(vars(self))


def cheapest_quadrature(sketch: Sketch, *, tolerance: float, views: int) -> Quadrature:
    """The cheapest that keeps a tolerance; the sketch's own where nothing cheaper does.

    Parameters
    ----------
    views:
        Of the scene, for the seconds; the sketch may have fewer.
    """
    if sketch.kernel is None:
        return Quadrature(strips="exact", across_pixel=0, across_strip=0, error=0.0, seconds=0.0)
    across, along = sketch.orders
    # An order that is not enough alone is not enough together with another; orders beyond the sketch's own buy nothing.
    pixel = _enough(across, lambda n: sketch.error(sketch.with_kernel(orders=(n, along))), tolerance)
    strip = _enough(along, lambda n: sketch.error(sketch.with_kernel(orders=(across, n))), tolerance)
    candidates: list[tuple[Strips, int, int]] = [("strips", p, s) for p, s in product(pixel, strip)]
    if not sketch.card.is_points:
        candidates += [("points", p, 1) for p in pixel]
    # Points save the arctangents of the height as well, so of equal numbers of nodes they go first.
    for strips, p, s in sorted(candidates, key=lambda c: (c[1] * c[2], c[0] != "points")):
        started = time.perf_counter()
        transport = sketch.with_kernel(orders=(p, s), points=strips == "points")
        seconds = (time.perf_counter() - started) * views / sketch.observer.views
        error = sketch.error(transport)
        if error <= tolerance:
            return Quadrature(strips=strips, across_pixel=p, across_strip=s, error=error, seconds=seconds)
    raise AssertionError("the sketch's own orders are a candidate and have no error")


def _enough(own: int, error_of: Callable[[int], float], tolerance: float) -> list[int]:
    """Orders up to the sketch's own that keep the tolerance by themselves."""
    orders = [n for n in _LADDER if n < own]
    for position, n in enumerate(orders):
        if error_of(n) <= tolerance:
            return [*orders[position:], own][:4]
    return [own]


def fewest_table_nodes(sketch: Sketch, *, tolerance: float) -> tuple[int, float] | None:
    """The fewest nodes of a BRDF table over [-pi, pi] that keep a tolerance, and their error; None where none is needed."""
    if sketch.kernel is None or sketch.brdf.angular_scale >= math.pi / 4:
        return None
    found = None
    for nodes in _TABLES:
        # Nodes wider apart than the lobe miss it, or hit it by luck.
        if 2 * math.pi / (nodes - 1) > 2 * sketch.brdf.angular_scale:
            continue
        found = nodes, table_error(sketch, nodes)
        if found[1] <= tolerance:
            break
    return found


def coarsest_knots(sketch: Sketch, *, tolerance: float) -> tuple[float, float] | None:
    """The widest knot spacing in degrees whose cubic spline gives films within a tolerance, and its error."""
    if sketch.kernel is None or not isinstance(sketch.brdf, AngleSumBRDF):
        return None
    found = None
    for step in _KNOTS_DEG:
        grid = grid_for(sketch.kernel, step=math.radians(step), degree=3)
        rho = grid.evaluate(closest_spline(grid, sketch.brdf), sketch.kernel.angle_sum)
        found = step, sketch.error(np.sum(sketch.kernel.weight * rho, axis=-1))
        if found[1] <= tolerance:
            break
    return found
