"""What every deconvolution asks of its input, each fault in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import power_of_two
from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: Of an operator applied by FFT, relative to its largest value: some eps times log2 of the length.
ROUNDING = 64 * float(np.finfo(np.float64).eps)
_SMALLEST = 1e-120  # of a kernel's largest values, of which alpha is the square


def real_samples(values: ArrayLike, field: str, *, ndim: int | None = None) -> Array:
    """The values in float64, whatever real type they came in; float64 is not copied.

    Raises
    ------
    InputError
        Unless they are real, finite, at least one, and of `ndim` axes.
    """
    try:
        given = np.asarray(values)
    except ValueError:
        raise InputError("holds rows of unequal lengths; give rows of one length", field=field) from None
    if given.dtype.kind not in "biuf":
        raise InputError(f"holds {given.dtype} values; give real numbers", field=field)
    samples = np.asarray(given, dtype=np.float64)
    if samples.size == 0 or samples.ndim == 0:
        raise InputError(f"has shape {samples.shape}; give at least one sample along each axis", field=field)
    if ndim is not None and samples.ndim != ndim:
        raise InputError(f"has {samples.ndim} axes where {ndim} are needed", field=field)
    if not np.all(np.isfinite(samples)):
        raise InputError("holds a value that is not finite; mend or mask such samples first", field=field)
    return samples


def nonnegative_samples(values: ArrayLike, field: str, *, ndim: int | None = None) -> Array:
    """As `real_samples`, and none below zero but by the rounding of an FFT, which becomes zero; no more is clipped."""
    samples = real_samples(values, field, ndim=ndim)
    lowest = float(samples.min())
    if lowest < -ROUNDING * float(samples.max()):
        raise InputError(
            f"holds {lowest:.3g}; Richardson-Lucy takes values >= 0: add the background that was subtracted and pass it "
            "as `background`, or use Tikhonov",
            field=field,
        )
    return np.maximum(samples, 0.0)


def positive(value: float, field: str) -> float:
    """The value, where it is finite and > 0."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"is {value:g}; give a finite number > 0", field=field)
    return float(value)


def count(value: int, field: str) -> int:
    """The value, where it is a whole number >= 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"is {value}; give a whole number >= 1", field=field)
    return int(value)


def in_unit(values: Array) -> tuple[Array, float]:
    """The values in units of a power of two near their largest, and that unit; no square of them leaves float64's range."""
    unit = power_of_two(values)
    return values / unit, unit


def require_squares(values: Array, field: str) -> None:
    """Raise InputError where the largest value has a square, or squares beside it, that float64 cannot hold."""
    largest = float(np.max(np.abs(values), initial=0.0))
    if largest > 0 and not _SMALLEST <= largest <= 1 / _SMALLEST:
        raise InputError(
            f"peaks at {largest:.3g}, whose square, in which alpha is measured, leaves the range of float64; use other units",
            field=field,
        )


def one_of(value: str, choices: Sequence[str], field: str) -> None:
    """Raise InputError unless the value is among the choices."""
    if value not in choices:
        raise InputError(f'is "{value}"; choose one of {", ".join(choices)}', field=field)
