"""Tables of real numbers from .npy and .csv files, judged by the file's length before NumPy allocates what they state."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import InputError, shown
from wallmirror.files import read_bounded

Array = NDArray[np.float64]

_MOST_BYTES = 2**26  # of a file
_MOST_NUMBERS = 2**25
# NumPy reads a .npy header as Python, and lets through what Python's tokenizer and parser raise.
_FAULTS = (
    ValueError,
    TypeError,
    EOFError,
    OverflowError,
    UserWarning,
    SyntaxError,
    RecursionError,
    MemoryError,
    TokenError,
)


def read_table(path: Path) -> Array:
    """The numbers of a .npy or .csv file, by its ending, in one or two dimensions.

    Raises
    ------
    InputError
        If the file is missing, too long, damaged, or holds anything but real numbers. Values are not judged.

    Examples
    --------
    >>> read_table(Path("brdf.csv")).shape  # doctest: +SKIP
    (181, 181)
    """
    if path.suffix not in (".npy", ".csv"):
        raise InputError("is neither a .npy nor a .csv file")
    return read_npy(path) if path.suffix == ".npy" else _numbers(path, _csv)


def read_npy(path: Path) -> Array:
    """The same of a .npy file, whatever its name ends in."""
    return _numbers(path, _npy)


def _numbers(path: Path, parse: Callable[[bytes], NDArray[Any]]) -> Array:
    content = read_bounded(path, _MOST_BYTES)
    try:
        values = parse(content)
    except _FAULTS as error:
        raise InputError(f"cannot be read as a table of numbers ({shown(str(error), quote=False)})") from None
    if values.dtype.kind not in "fiu" or values.ndim not in (1, 2):
        kind, shape = shown(str(values.dtype), quote=False), shown(values.shape)
        raise InputError(f"holds {kind} of shape {shape}; give real numbers in one or two dimensions")
    return values.astype(np.float64)


def _npy(content: bytes) -> NDArray[Any]:
    """The array of a .npy file, whose header is judged by the file's length before NumPy allocates what it states."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = reader(stream)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ValueError(f"it holds {dtype} of shape {shape}")
    rest = len(content) - stream.tell()
    if math.prod(shape) * dtype.itemsize > rest or math.prod(shape) > _MOST_NUMBERS:
        raise ValueError(f"its header states {math.prod(shape)} numbers, but {rest} bytes follow, or it is too large")
    stream.seek(0)
    values: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return values


def _csv(content: bytes) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a file without numbers
        return np.loadtxt(io.StringIO(content.decode("utf-8")), delimiter=",", ndmin=2, dtype=np.float64)
