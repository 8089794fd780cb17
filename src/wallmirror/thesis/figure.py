"""A figure of the thesis made again: the picture, the data behind it, its numbers, and what becomes of its claims."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Literal, get_args

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from wallmirror.errors import InputError

#: What measurement makes of a claim: it holds, it holds with a change that is named, it does not hold, or the run was too
#: short to tell.
Outcome = Literal["confirmed", "corrected", "refuted", "undecided"]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Something that the thesis says, and what was measured.

    Parameters
    ----------
    thesis:
        The claim in a sentence of our own.
    outcome:
        "confirmed", "corrected", "refuted" or "undecided", computed from the numbers and never written down beforehand.
    measured:
        A sentence with the numbers that decide.
    """

    thesis: str
    outcome: Outcome
    measured: str

    def __post_init__(self) -> None:
        if self.outcome not in get_args(Outcome):
            raise InputError(f'is "{self.outcome}"; choose one of {", ".join(get_args(Outcome))}', field="outcome")


@dataclass(frozen=True, kw_only=True)
class ThesisFigure:
    """One figure with everything that it shows.

    Parameters
    ----------
    id:
        The thesis's number ("3.9"), or its section and a word where we add a figure ("1.4-neumann").
    title:
        A few words.
    about:
        What is shown and with which settings, and where it departs from the thesis, in a sentence or more.
    figure:
        The picture.
    columns:
        What the picture draws, by the name and unit of each column; one-dimensional, of any lengths.
    numbers:
        The figures that a reader would quote, by a phrase with its unit.
    claims:
        What the thesis says about it.
    """

    id: str
    title: str
    about: str
    figure: Figure = field(repr=False)
    columns: Mapping[str, ArrayLike] = field(repr=False)
    numbers: Mapping[str, float]
    claims: tuple[Claim, ...] = ()

    def __post_init__(self) -> None:
        for name, column in self.columns.items():
            if np.ndim(column) != 1:
                raise InputError(f"has shape {np.shape(column)}; give one dimension", field=f"{self.id}.{name}")
        for name, number in self.numbers.items():
            if not math.isfinite(number):
                raise InputError(f"is {number}; give a finite number", field=f"{self.id}.{name}")

    @property
    def line(self) -> str:
        """Its numbers in one line."""
        return "; ".join(f"{name}: {number:.4g}" for name, number in self.numbers.items())

    def to_csv(self) -> str:
        """The columns as CSV with a heading; shorter ones end in empty cells."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self.columns)
        arrays = [np.asarray(column).tolist() for column in self.columns.values()]
        writer.writerows(zip_longest(*arrays, fillvalue=""))
        return stream.getvalue()

    def to_png(self) -> bytes:
        """The picture as a PNG file."""
        stream = io.BytesIO()
        self.figure.savefig(stream, format="png", dpi=130, metadata={"Software": None})
        return stream.getvalue()
