"""A cell of the table of extremes, how it is judged, and what the references share.

A cell is right (the error stays below a tolerance that the reference states), refused (one sentence that names the field),
or a fault: a wrong number, a NaN, a warning of NumPy's, or any other exception.
"""

from __future__ import annotations

import math
import re
import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mpmath
import numpy as np
from numpy.typing import ArrayLike

import wallmirror as wm

DIGITS = 50  # of the references that mpmath computes
EPS = float(np.finfo(np.float64).eps)
REFUSALS = (wm.InputError, wm.UndeterminedError)
# The folder of a temporary file, whose name differs from run to run.
_SCRATCH = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp\w+/")


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
        return Cell(*name, "refused", None, None, _SCRATCH.sub("", str(refusal)))
    except Exception as failure:  # noqa: BLE001 - that is what the table is about
        return Cell(*name, "fault", None, None, f"{type(failure).__name__}: {failure}")
    if not (math.isfinite(error) and math.isfinite(tolerance)):
        return Cell(*name, "fault", None, None, "the result or what it may be off by is not a number")
    if not error <= tolerance:
        return Cell(*name, "fault", error, tolerance, f"off by {error:.1e}, allowed {tolerance:.1e}")
    return Cell(*name, "right", error, tolerance, "")


def off(found: ArrayLike, exact: ArrayLike) -> float:
    """Largest difference relative to the largest exact magnitude; NaN where anything found is none or missing.

    Both are taken in units of that magnitude, so that neither 1e300 nor a denormal leaves the range of float64.
    """
    one, two = np.asarray(found, dtype=np.float64), np.asarray(exact, dtype=np.float64)
    if one.shape != two.shape or not np.all(np.isfinite(one)):
        return math.nan
    largest = float(np.max(np.abs(two)))
    if largest == 0:
        return 0.0 if not np.any(one) else math.inf
    exponent = math.frexp(largest)[1]
    return float(np.max(np.abs(np.ldexp(one, -exponent) - np.ldexp(two, -exponent)))) / math.ldexp(largest, -exponent)


def off_relative(found: ArrayLike, exact: Iterable[mpmath.mpf], *, floor: float = 1e-290) -> float:
    """Largest relative difference of single values, at the precision that mpmath has; what is below the floor may be 0."""

    def ratio(value: float, true: mpmath.mpf) -> float:
        if not math.isfinite(value):
            return math.nan
        if abs(true) < floor:
            return 0.0 if abs(value) < 10 * floor else math.inf
        return float(abs(mpmath.mpf(value) / true - 1))

    return float(np.max([ratio(float(f), e) for f, e in zip(np.ravel(found), exact, strict=True)]))


def must_refuse(call: Callable[[], object]) -> Callable[[], tuple[float, float]]:
    """The check of an input that has no right answer: whatever comes back is a fault."""

    def check() -> tuple[float, float]:
        raise RuntimeError(f"accepted, with the result {str(call())[:60]}")

    return check


def must_answer(check: Callable[[], tuple[float, float]]) -> Callable[[], tuple[float, float]]:
    """The check of an input whose right answer is within reach: a refusal is a fault."""

    def strict() -> tuple[float, float]:
        try:
            return check()
        except REFUSALS as refusal:
            raise RuntimeError(f"refused what it can answer: {refusal}") from None

    return strict
