"""A cell of the table of extremes, how it is judged, and what the references share.

A cell is right (the error stays below a tolerance that the reference states), refused (one sentence that names the field),
or a fault: a wrong number, a NaN, a warning of NumPy's, or any other exception.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import wallmirror as wm

DIGITS = 50  # of the references that mpmath computes
EPS = float(np.finfo(np.float64).eps)
REFUSALS = (wm.InputError, wm.UndeterminedError)


@dataclass(frozen=True)
class Cell:
    """One quantity at one value, seen by one entry point."""

    entry: str
    quantity: str
    value: str
    outcome: str  # "right", "refused" or "fault"
    error: float | None
    tolerance: float | None
    words: str


@dataclass(frozen=True)
class Case:
    """What a cell runs: `check` returns the error and its tolerance, or raises."""

    entry: str
    quantity: str
    value: str
    check: Callable[[], tuple[float, float]]


def run(case: Case) -> Cell:
    """Run a cell with NumPy's warnings as errors."""
    name = (case.entry, case.quantity, case.value)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            error, tolerance = case.check()
    except REFUSALS as refusal:
        return Cell(*name, "refused", None, None, str(refusal))
    except Exception as failure:  # noqa: BLE001 - that is what the table is about
        return Cell(*name, "fault", None, None, f"{type(failure).__name__}: {failure}")
    if not math.isfinite(error):
        return Cell(*name, "fault", None, tolerance, "the result is not a number")
    if not error <= tolerance:
        return Cell(*name, "fault", error, tolerance, f"off by {error:.1e}, allowed {tolerance:.1e}")
    return Cell(*name, "right", error, tolerance, "")
