"""Powers of two as units, in which values of any size keep their digits and no square leaves the range of float64."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError

Array = NDArray[np.float64]


def power_of_two(values: ArrayLike) -> float:
    """A power of two near the largest magnitude, a unit in which it is about 1; 1 where all values are zero.

    Division by it and multiplication with it are exact, so that what is computed in this unit scales exactly by powers of
    two. It stays within 2^-1021 and 2^1022, so that neither it nor its reciprocal is denormal or infinite.

    Examples
    --------
    >>> power_of_two([3.0, -5.0]), power_of_two([0.0])
    (8.0, 1.0)
    """
    array = np.asarray(values, dtype=np.float64)
    largest = max(float(array.max(initial=0.0)), -float(array.min(initial=0.0)))
    if largest == 0:
        return 1.0
    return math.ldexp(1.0, min(max(math.frexp(largest)[1], -1021), 1022))


def rescaled(values: ArrayLike, *units: float, field: str) -> Array:
    """Values times powers of two that they were computed in units of, without overflow on the way.

    Raises
    ------
    InputError
        Naming the field, if a result is not finite.

    Examples
    --------
    >>> rescaled([3.0], 2.0**1000, 2.0**-1001, field="source")
    array([1.5])
    """
    with np.errstate(over="ignore"):
        whole = np.ldexp(np.asarray(values, dtype=np.float64), sum(math.frexp(unit)[1] - 1 for unit in units))
    if not np.all(np.isfinite(whole)):
        raise InputError("gives a result outside the range of float64; use other units", field=field)
    return np.asarray(whole, dtype=np.float64)
