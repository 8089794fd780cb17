"""The operator U of the thesis's Algorithm 2: one row for each wall point that is seen for the first time.

Where the fields of two views overlap, a view repeats the BRDF of the last one up to the shift of its wall points
(Hypothesis 7bis). U therefore keeps all rows of one starting view and, of each next one, those beyond the edge of
the one before; U^-1 gives every other pixel the value of the nearest wall point of the view before, and so on down
the chain. Both are linear and need the geometry alone: U picks rows, U^-1 repeats them.

U^-1 U is not the identity. A pixel takes its value from a neighbour up to half a pixel away, once in each view of
the chain: that error, and no noise, is what limits the unstructured solver.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.geometry import Observer, wall_points

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: The view from which the chain runs: the middle one outwards (what the thesis advises), or the first (its Algorithm 2).
Start = Literal["middle", "first"]


@dataclass(frozen=True, eq=False)
class Chain:
    """Which pixel each row of B_diff is taken from, and which row each pixel is given back.

    Parameters
    ----------
    picked:
        Pixel a * N + j of each row that holds something, shape (N + xi,).
    given:
        Row that U^-1 gives each pixel, shape (A, N).
    views:
        The views from left to right (x on the wall grows), shape (A,).

    Examples
    --------
    >>> chain = chain_views(Observer(position=(0.0, -5.0), fov=1.0, view_angles=(0.1, 0.0, -0.1), pixels=50))
    >>> bool(np.array_equal(chain.structured(chain.spread(np.ones((chain.rows, 2))))[:-1], np.ones((chain.rows - 1, 2))))
    True
    """

    picked: Indices
    given: Indices
    views: Indices

    @property
    def rows(self) -> int:
        """N + xi rows, and one of zeros at the end where A > 1: Algorithm 2 truncates one row too late."""
        return self.picked.size + (1 if self.views.size > 1 else 0)

    def structured(self, matrices: ArrayLike) -> Array:
        """U: the A matrices B_a, shape (A, N, C), to B_diff, shape (rows, C) (eq. 4.14)."""
        flat = np.asarray(matrices, dtype=np.float64)
        flat = flat.reshape(-1, flat.shape[-1])
        result = np.zeros((self.rows, flat.shape[1]))
        result[: self.picked.size] = flat[self.picked]
        return result

    def spread(self, structured: ArrayLike) -> Array:
        """U^-1: B_diff, shape (rows, C), to the A matrices B_a, shape (A, N, C) (eq. 4.15)."""
        matrices: Array = np.asarray(structured, dtype=np.float64)[self.given]
        return matrices


def chain_views(observer: Observer, *, start: Start = "middle") -> Chain:
    """The chain of nearest wall points through all views (Algorithm 2; section 4.2.2 for the middle view).

    Parameters
    ----------
    start:
        "middle" (view A/2, rounded up; then all views to its right, then those to its left) or "first".

    Raises
    ------
    InputError
        For an unknown start.
    """
    if start not in get_args(Start):
        raise InputError(f'is "{start}"; choose one of {", ".join(get_args(Start))}', field="start")
    order = np.argsort(-np.asarray(observer.view_angles), kind="stable")
    points = wall_points(observer)[order]
    views, pixels = points.shape
    given = np.empty((views, pixels), dtype=np.intp)
    first = (views + 1) // 2 - 1 if start == "middle" else 0
    given[first] = np.arange(pixels)
    picked = [order[first] * pixels + np.arange(pixels)]
    rows = pixels
    for sequence, rightwards in ((range(first + 1, views), True), (range(first - 1, -1, -1), False)):
        last = first
        for view in sequence:
            new = points[view] > points[last, -1] if rightwards else points[view] < points[last, 0]
            given[view, ~new] = given[last, _nearest(points[last], points[view, ~new])]
            count = int(np.count_nonzero(new))
            given[view, new] = rows + np.arange(count)
            picked.append(order[view] * pixels + np.flatnonzero(new))
            rows += count
            last = view
    unsorted = np.empty_like(given)
    unsorted[order] = given
    return Chain(np.concatenate(picked), unsorted, order)


def _nearest(sorted_points: Array, points: Array) -> Indices:
    """Index of the nearest of the sorted points, the lower one of two that are equally near."""
    upper = np.clip(np.searchsorted(sorted_points, points), 1, max(1, sorted_points.size - 1))
    if sorted_points.size == 1:
        return np.zeros(points.shape, dtype=np.intp)
    closer = points - sorted_points[upper - 1] <= sorted_points[upper] - points
    return np.where(closer, upper - 1, upper)
