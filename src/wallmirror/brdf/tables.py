"""Reflectance in tables, and any model sampled onto one with its interpolation error measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two
from wallmirror.brdf.base import BRDF, AngleSumBRDF, Array, require_range
from wallmirror.errors import InputError

#: Most nodes that `tabulate_to` gives a table: along the angle sum, and along each of two angles.
MOST_SUM_NODES, MOST_ANGLE_NODES = 1_152_001, 2881
_FARTHEST, _CLOSEST = 1e6, 1e-100  # nodes, in radians


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleSumTable(AngleSumBRDF):
    """Values on uniform nodes of the angle sum, linear in between, zero outside.

    Parameters
    ----------
    start, stop:
        First and last node in radians.
    values:
        BRDF at the nodes, shape (K,), in 1/sr, finite and >= 0.
    """

    start: float
    stop: float
    values: Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", _checked_table(self.values, 1))
        if not -_FARTHEST <= self.start < self.stop <= _FARTHEST:
            raise InputError(
                f"the first node must lie before the last, both within {_FARTHEST:g} rad", field="wall.table"
            )
        if self.angular_scale < max(_CLOSEST, 4 * math.ulp(max(abs(self.start), abs(self.stop)))):
            raise InputError(f"has nodes {self.angular_scale:.2g} rad apart, which coincide", field="wall.table")

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        nodes = np.linspace(self.start, self.stop, self.values.size)
        # In units of the largest value: a slope at 1e300 or of denormals would leave the range of float64.
        unit = power_of_two(self.values)
        found = np.interp(np.asarray(u, dtype=np.float64), nodes, self.values / unit, left=0.0, right=0.0)
        return np.asarray(found * unit, dtype=np.float64)

    @property
    def angular_scale(self) -> float:
        """Spacing of the nodes in radians."""
        return float(self.stop - self.start) / (self.values.size - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Table(BRDF):
    """Values on uniform nodes of both angles over [-pi/2, pi/2], bilinear in between.

    Parameters
    ----------
    values:
        BRDF, shape (K_s, K_o): rows theta_s, columns theta_o; in 1/sr, finite and >= 0.
    """

    values: Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", _checked_table(self.values, 2))

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        (i, f), (j, g) = (_cell(theta, size) for theta, size in zip((theta_s, theta_o), self.values.shape, strict=True))
        v = self.values
        return (1 - f) * ((1 - g) * v[i, j] + g * v[i, j + 1]) + f * ((1 - g) * v[i + 1, j] + g * v[i + 1, j + 1])

    @property
    def angular_scale(self) -> float:
        """Spacing of the finer axis in radians."""
        return math.pi / float(max(self.values.shape) - 1)


@dataclass(frozen=True, kw_only=True)
class Tabulated:
    """A model sampled onto a table, and how far interpolation is off.

    Parameters
    ----------
    table:
        Of the angle sum over [-pi, pi], or of both angles.
    error:
        Largest error found between the nodes, relative to the table's largest value.
    where:
        (theta_s, theta_o) of that error in radians.
    """

    table: AngleSumTable | Table
    error: float
    where: tuple[float, float]


def tabulate(brdf: AngleSumBRDF, nodes: int = 7201) -> AngleSumTable:
    """Sample a model onto `nodes` uniform angle sums over [-pi, pi], rounded to float32 as a path tracer holds it.

    Raises
    ------
    InputError
        For a model that is no function of the angle sum, fewer than 2 or more than 1,152,001 nodes, or values whose largest
        lies outside the range of float32.
    """
    if not isinstance(brdf, AngleSumBRDF):
        raise InputError(
            f"is a {type(brdf).__name__}, no function of the angle sum; use tabulate_to", field="wall.brdf"
        )
    require_range("nodes", nodes, 2, MOST_SUM_NODES)
    values = brdf.of_sum(np.linspace(-math.pi, math.pi, nodes))
    largest, single = float(values.max()), np.finfo(np.float32)
    if largest != 0 and not float(single.tiny) <= largest <= float(single.max):
        raise InputError(
            f"peaks at {largest:.3g} / sr, outside the range of float32; use other units", field="wall.brdf"
        )
    return AngleSumTable(start=-math.pi, stop=math.pi, values=values.astype(np.float32))


def tabulate_to(brdf: BRDF, tolerance: float = 1e-4) -> Tabulated:
    """Sample a model with finite values onto the coarsest table, by doubling, that is right to `tolerance`.

    Angle-sum models go onto an `AngleSumTable` over [-pi, pi], all others onto a `Table`. The first nodes are as close as
    half the model's `angular_scale`, so that no feature lies between them unseen; then the step is halved until the
    values in the middle of every cell, and of its edges, are right. There a piecewise linear interpolant of a smooth
    model is furthest off, by step^2 / 8 times its curvature along each axis, so every doubling gains a factor of 4.

    Parameters
    ----------
    tolerance:
        Largest error wanted, relative to the largest value, from 1e-9.

    Raises
    ------
    InputError
        If the largest table allowed (1,152,001 or 2881 x 2881 nodes) is not fine enough, with the error that it leaves.

    Examples
    --------
    >>> from wallmirror.brdf import Phong
    >>> found = tabulate_to(Phong(exponent=50), 1e-3)
    >>> found.table.values.size, found.error < 1e-3
    (577, True)
    """
    require_range("tolerance", tolerance, 1e-9, 1)
    sample, span, most = _sample, math.pi, MOST_ANGLE_NODES
    if isinstance(brdf, AngleSumBRDF):
        sample, span, most = _sample_sum, 2 * math.pi, MOST_SUM_NODES
    cells = 36
    while span / cells > brdf.angular_scale / 2:
        cells *= 2
    left = ""
    while cells < most:
        fine = sample(brdf, 2 * cells + 1)  # the table with every second node, and what lies between its nodes
        found = _judged(fine)
        if found.error <= tolerance:
            return found
        left = f"; {found.error:.2g} is left"
        cells *= 2
    raise InputError(
        f"needs more than {most} nodes along an angle to be right to {tolerance:g}{left}", field="wall.brdf"
    )


def _sample_sum(brdf: BRDF, nodes: int) -> Array:
    u = np.linspace(-math.pi, math.pi, nodes)
    return brdf(u / 2, u / 2)


def _sample(brdf: BRDF, nodes: int) -> Array:
    theta = np.linspace(-math.pi / 2, math.pi / 2, nodes)
    return brdf(theta[:, None], theta)


def _judged(fine: Array) -> Tabulated:
    """The table of every second node, and how far its interpolant is from the values at the others."""
    coarse = fine[(slice(None, None, 2),) * fine.ndim]
    between = coarse
    for axis in range(fine.ndim):  # in the middle a linear interpolant is the mean of its neighbours
        between = np.moveaxis(between, axis, 0)
        middle = (between[1:] + between[:-1]) / 2
        between = np.moveaxis(np.insert(between, np.arange(1, len(between)), middle, axis=0), 0, axis)
    apart = np.abs(between - fine)
    worst = np.unravel_index(int(np.argmax(apart)), apart.shape)
    places = [(float(index) / (size - 1) - 0.5) * math.pi for index, size in zip(worst, fine.shape, strict=True)]
    table = AngleSumTable(start=-math.pi, stop=math.pi, values=coarse) if fine.ndim == 1 else Table(values=coarse)
    return Tabulated(table=table, error=_relative(float(apart[worst]), coarse), where=(places[0], places[-1]))


def _relative(error: float, values: Array) -> float:
    """Relative to the largest value; 0 / 0 is no error."""
    return float(error / values.max()) if error > 0 else 0.0


def _cell(theta: ArrayLike, size: int) -> tuple[NDArray[np.intp], Array]:
    """Index and fraction of angles in a uniform grid of `size` nodes over [-pi/2, pi/2]."""
    place = (np.asarray(theta, dtype=np.float64) / math.pi + 0.5) * (size - 1)
    index = np.fmax(np.fmin(np.floor(place), size - 2), 0).astype(np.intp)  # of a NaN any, which its fraction keeps
    return index, np.clip(place - index, 0.0, 1.0)


def _checked_table(values: ArrayLike, ndim: int) -> Array:
    table = np.array(values, dtype=np.float64)
    if table.ndim != ndim or min(table.shape) < 2:
        raise InputError(f"a table needs {ndim} axes of at least 2 nodes, not shape {table.shape}", field="wall.table")
    if not np.all(np.isfinite(table)) or table.min() < 0:
        raise InputError("holds a value that is negative or not finite; a BRDF is >= 0", field="wall.table")
    table.flags.writeable = False
    return table
