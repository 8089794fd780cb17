"""One bounce of a scene on a few of its views, to the last digit that matters: what every simplification is measured by.

Errors of films are relative L2 norms over views, pixels and patterns: the rms of the difference in units of the rms
radiance. So are the tolerances of a `Plan`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF, Mirror
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.scene import Scene
from wallmirror.transport import Kernel, build_kernel, mirror_matrix, quadrature_orders, radiance

Array = NDArray[np.float64]

# Evaluations of the BRDF that one sketch may cost, and the most that a single view may.
_EVALUATIONS = 1_000_000
_MOST = 20_000_000
# Of the tolerance: how far the sketch itself may be off.
_OWN_ERROR = 0.02


@dataclass(frozen=True, eq=False)
class Sketch:
    """Films of one bounce, the physical model, on some views of a scene.

    Parameters
    ----------
    observer:
        With the views chosen.
    orders:
        Quadrature nodes across pixel and strip behind `kernel`; (0, 0) for a mirror, which is exact.
    kernel:
        None for a mirror.
    films:
        Radiance, shape (A', N, B).
    own_error:
        What half as many nodes again still change.
    """

    observer: Observer
    card: Card
    brdf: BRDF
    source: Array = field(repr=False)
    orders: tuple[int, int]
    kernel: Kernel | None = field(repr=False)
    films: Array = field(repr=False)
    own_error: float

    def error(self, transport: Array, *, scaled: bool = False) -> float:
        """Relative L2 error of the films that a transport matrix (A', N, M) gives.

        Parameters
        ----------
        scaled:
            After the best global scale, for formulas that have none of their own.
        """
        return relative_error(radiance(transport, self.source), self.films, scaled=scaled)

    def with_kernel(self, *, orders: tuple[int, int], points: bool = False) -> Array:
        """F of the physical model with other quadrature nodes, or with strips taken as points, shape (A', N, M)."""
        card, area = self.card, 1.0
        if points and not card.is_points:
            area = card.element_width * card.element_height
            card = replace(card, element_width=0.0, element_height=0.0)
        return area * build_kernel(self.observer, card, orders=orders).apply(self.brdf)


def relative_error(films: Array, truth: Array, *, scaled: bool = False) -> float:
    """|films - truth| / |truth| in the L2 norm, `scaled` after the best factor on `films`; inf where truth is dark.

    Examples
    --------
    >>> relative_error(np.array([1.0, 1.0]), np.array([2.0, 2.0]))
    0.5
    >>> relative_error(np.array([1.0, 1.0]), np.array([2.0, 2.0]), scaled=True)
    0.0
    """
    norm = float(np.linalg.norm(truth))
    if norm == 0:
        return math.inf
    if scaled:
        power = float(np.sum(films**2))
        if power == 0:
            return 1.0
        films = films * (float(np.sum(films * truth)) / power)
    return float(np.linalg.norm(films - truth)) / norm


def sketch(scene: Scene, *, tolerance: float) -> Sketch:
    """The one-bounce films of a scene on as many views as are computed in a moment, spread evenly.

    Parameters
    ----------
    tolerance:
        Relative L2 error that matters; the sketch itself is made fifty times as good.

    Raises
    ------
    InputError
        Where a single view is too large to be measured in seconds, or one bounce brings no light.
    """
    observer, card, brdf = scene.observer, scene.card, scene.wall.brdf
    some = _some_views(observer, card, (1, 1))
    if isinstance(brdf, Mirror):
        films = _lit(radiance(mirror_matrix(some, card, brdf), scene.source))
        return Sketch(some, card, brdf, scene.source, (0, 0), None, films, 0.0)
    orders = quadrature_orders(some, card, resolution=brdf.angular_scale, tolerance=min(1e-4, 1e-2 * tolerance))
    while True:
        some = _some_views(observer, card, orders)
        kernel = build_kernel(some, card, orders=orders)
        films = _lit(radiance(kernel.apply(brdf), scene.source))
        more = _more(orders[0]), _more(orders[1])
        # One view is enough to see that the nodes are.
        middle = replace(some, view_angles=(some.view_angles[some.views // 2],))
        fine = radiance(build_kernel(middle, card, orders=more).apply(brdf), scene.source)
        coarse = films[some.views // 2][None]
        own = relative_error(coarse, fine) if np.any(fine) else 0.0
        if own <= _OWN_ERROR * tolerance:
            return Sketch(some, card, brdf, scene.source, orders, kernel, films, own)
        orders = more


def _lit(films: Array) -> Array:
    if not np.any(films):
        raise InputError("one bounce brings no light to the camera, so that nothing can be measured", field="scene")
    return films


def _more(order: int) -> int:
    return order + max(2, order // 2) if order > 1 else 2


def _some_views(observer: Observer, card: Card, orders: tuple[int, int]) -> Observer:
    """The observer with as many of its views as cost no more than `_EVALUATIONS`, at least one."""
    each = observer.pixels * card.elements * orders[0] * orders[1]
    if each > _MOST:
        raise InputError(
            f"needs {each:.2g} evaluations of the BRDF for a single view ({observer.pixels} pixels x {card.elements} "
            f"elements x {orders[0]} x {orders[1]} nodes), too many to be measured in seconds; ask about fewer pixels "
            "or elements",
            field="observer.pixels",
        )
    wanted = max(1, min(observer.views, _EVALUATIONS // each))
    chosen = np.unique(np.linspace(0, observer.views - 1, wanted).round().astype(int))
    return replace(observer, view_angles=tuple(observer.view_angles[v] for v in chosen))
