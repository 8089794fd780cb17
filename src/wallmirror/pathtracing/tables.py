"""Tables on uniform nodes of an angle: reading, checking, cells and cumulative sums.

Nothing here needs a Mitsuba variant: `UniformNodes.cell` takes Dr.Jit arrays as they come.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.table_files import read_npy


@dataclass(frozen=True)
class UniformNodes:
    """`count` nodes of an angle, uniform over [-half_range, half_range], in radians."""

    half_range: float
    count: int

    @property
    def step(self) -> float:
        """Distance between neighbouring nodes in radians."""
        return 2 * self.half_range / (self.count - 1)

    def cell(self, angle: Any) -> tuple[Any, Any]:
        """Index of the cell that holds each angle, and the position 0..1 inside it.

        Parameters
        ----------
        angle:
            NumPy or Dr.Jit array (or float) of angles in radians, in DOUBLE precision: with thousands of nodes a
            float32 angle would spend its digits on the index and leave a coarse fraction. Angles outside the nodes
            are clamped to the last ones.

        Returns
        -------
        index, fraction:
            k in 0..count - 2, still a floating point number, and (angle - node k) / step.
        """
        dr: Any = importlib.import_module("drjit")
        position = (angle + self.half_range) * (1 / self.step)
        # Selected, not clipped: NaN must become a valid index too, or gathers leave the table's memory.
        index = dr.select(position > 0, dr.select(position < self.count - 1, dr.floor(position), self.count - 2), 0)
        return index, dr.clip(position - index, 0, 1)


def cumulative(table: NDArray[np.float32]) -> NDArray[np.float64]:
    """Integral of the linear interpolant from the first node to each node, in units of the step.

    Parameters
    ----------
    table:
        Values at the nodes, shape (..., K).

    Returns
    -------
    Trapezoid sums in float64, shape (..., K), the first of them 0; exact for the interpolant that `cell` yields.
    """
    sums = np.zeros(table.shape)
    wide = table.astype(np.float64)
    np.cumsum((wide[..., 1:] + wide[..., :-1]) / 2, axis=-1, out=sums[..., 1:])
    return sums


def checked_table(values: ArrayLike, dimensions: int) -> NDArray[np.float32]:
    """Float32 copy of a BRDF table in 1/sr, if it is one.

    Raises
    ------
    ValueError
        Unless there are `dimensions` axes of at least 2 nodes, and every value is finite in float32 and >= 0: one NaN
        spoils pixels far from its node, and a negative value would be accepted silently by the renderer.
    """
    try:
        table = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the BRDF table is no array of numbers: {error}") from None
    if table.ndim != dimensions or min(table.shape, default=0) < 2:
        nodes = "(nodes,)" if dimensions == 1 else "(theta_s nodes, theta_o nodes)"
        raise ValueError(f"the BRDF table has shape {table.shape}; give {nodes}, at least 2 along each axis")
    largest = float(np.finfo(np.float32).max)
    wrong = ~((table >= 0) & (table <= largest))  # also catches NaN
    if wrong.any():
        node = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"the BRDF table holds {table[node]:g} at node {node[0] if dimensions == 1 else node}; "
            "give finite float32 values >= 0, in 1/sr"
        )
    return table.astype(np.float32)


def table_text(table: ArrayLike) -> str:
    """A table as the text that the plugins' `values` property takes: numbers apart by spaces, rows by semicolons.

    Float32 values survive the way there and back bit for bit.
    """
    rows = np.atleast_2d(np.asarray(table, dtype=np.float32))
    return "; ".join(" ".join(str(value) for value in row) for row in rows)


def parsed_table(text: str, dimensions: int) -> NDArray[np.float64]:
    """The table that `table_text` wrote; commas between numbers are accepted too.

    Raises
    ------
    ValueError
        For text that holds something else than numbers, or rows of unequal length.
    """
    rows = [row.replace(",", " ").split() for row in text.split(";")]
    if len({len(row) for row in rows}) > 1:
        raise ValueError("the rows of the BRDF table differ in length; separate rows by semicolons")
    try:
        table = np.array([[float(value) for value in row] for row in rows])
    except ValueError as error:
        raise ValueError(f"the text of the BRDF table is not made of numbers: {error}") from None
    return table[0] if dimensions == 1 and len(rows) == 1 else table


def loaded_table(path: Path) -> NDArray[np.float64]:
    """The table in a .npy file of numbers.

    Raises
    ------
    ValueError
        If the file is missing, too long, no .npy file, or holds something else than real numbers.
    """
    try:
        return read_npy(path)
    except InputError as error:
        raise ValueError(f"the BRDF table {path}: {error.message}") from None


def given_table(mi: Any, props: Any, dimensions: int) -> NDArray[np.float32]:
    """The checked table from whichever of `table`, `values` and `filename` a plugin's properties give.

    Raises
    ------
    ValueError
        If they give none or several, or no BRDF table.
    """
    given = [name for name in ("table", "values", "filename") if name in props]
    if len(given) != 1:
        raise ValueError(f"give the BRDF as one of table, values and filename; the scene gives {given or 'none'}")
    match given[0]:
        case "table":
            dr: Any = importlib.import_module("drjit")
            return checked_table(dr.detach(props["table"]), dimensions)
        case "values":
            return checked_table(parsed_table(props["values"], dimensions), dimensions)
        case _:
            path = Path(str(mi.file_resolver().resolve(props["filename"])))
            return checked_table(loaded_table(path), dimensions)
