"""How much memory a computation needs, from its sizes alone, and a refusal before any of it is taken.

Without it the operating system ends the process without a word. The estimates count float64 arrays that live at the same
time; `tests/unit/test_memory.py` holds them against measured peaks.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from wallmirror.errors import InputError
from wallmirror.limits import size_text

#: Environment variable that lowers (or raises) the limit, in GB of 1e9 bytes.
LIMIT_VARIABLE = "WALLMIRROR_MEMORY_GB"

_FLOAT = 8
# Arrays of the kernel's size that live while it is built or applied: three stored, the rest temporary.
_KERNEL_ARRAYS = 8
# Beside F a block of nodes with its temporary arrays.
_BLOCK_BYTES = 4e6
# A picture's own float64, the film with its channels in float32, and a block of paths.
_PICTURE_ARRAYS, _PATH_BYTES = 7, 64e6
# The films, normalised, weighted, and in their QR factorisation.
_FILM_ARRAYS = 6
# A solution: films of the problem and of its fits, cubic splines and their dense windows, and what does not grow.
_SOLUTION_ARRAYS, _ELEMENT_ARRAYS, _SOLUTION_BYTES = 8.5, 24, 20e6
# Squares of the smaller side of the films that their singular values take.
_DECOMPOSED_SQUARES = 12
# Bytes of an entry of the sparse Gram matrix of T_1 .. T_M while its band is ordered; and squares of the columns among which
# its factorisation pivots with those that they reach.
_GRAM_ENTRY, _WINDOW_SQUARES = 44, 4
# Bytes of an entry of T_i^T W T_j while it is made and for as long as it is held; a bound on the entries is 1.4 times them.
_ENTRY_MADE, _ENTRY_HELD = 36, 19
# Beside degree + 1 basis functions at all nodes: their sums and places, and one element's share with the weight.
_NODE_ARRAYS = 8
# Squares of the number of knots: Fisher information, its factors, and the covariance that follows.
_KNOT_SQUARES = 8


def memory_limit() -> float:
    """Bytes that this process may still take: what is available, or what WALLMIRROR_MEMORY_GB says; inf if nobody knows.

    Raises
    ------
    InputError
        If the variable holds no positive number.
    """
    asked = os.environ.get(LIMIT_VARIABLE)
    if asked is None:
        return min(_available(), _left_in_control_group())
    try:
        gigabytes = float(asked)
    except ValueError:
        gigabytes = math.nan
    if not gigabytes > 0:
        raise InputError(f'is "{asked}"; give gigabytes > 0', field=LIMIT_VARIABLE)
    return gigabytes * 1e9


def require_memory(needed: float, what: str) -> None:
    """Refuse what does not fit, before it is allocated.

    Parameters
    ----------
    needed:
        Bytes.
    what:
        Whose they are, for the message: "F of 20 views x ...".

    Raises
    ------
    InputError
        With the size that it would need, and the limit.

    Examples
    --------
    >>> require_memory(1e18, "F of too many pixels")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    wallmirror.errors.InputError: memory: F of too many pixels needs 1 EB of memory and ... are left; ...
    """
    limit = memory_limit()
    if needed > limit:
        raise InputError(
            f"{what} needs {size_text(needed)} of memory and {size_text(limit)} are left; take fewer of them, or raise "
            f"{LIMIT_VARIABLE} if the memory is there",
            field="memory",
        )


def kernel_bytes(views: int, pixels: int, elements: int, nodes: int) -> float:
    """Peak of building a `Kernel` of A x N x M x Q nodes and of applying it."""
    return float(_FLOAT * _KERNEL_ARRAYS) * views * pixels * elements * nodes


def transport_bytes(views: int, pixels: int, elements: int, *, compared: bool = True) -> float:
    """Peak of `transport_matrix`, which goes through the nodes block by block; F at two orders where they are `compared`."""
    return float(_FLOAT * (2 if compared else 1)) * views * pixels * elements + _BLOCK_BYTES


def design_bytes(views: int, pixels: int, elements: int, nodes: int, *, degree: int, knots: int) -> float:
    """Peak of turning a kernel into sparse matrices over B-splines, and of the dense ones that a fit makes of them."""
    return float(_FLOAT) * (
        views * pixels * float(elements) * nodes * (degree + _NODE_ARRAYS) + float(_KNOT_SQUARES) * knots**2
    )


def solution_bytes(views: int, pixels: int, elements: int, realisations: int) -> float:
    """Peak of solving a capture set but for its pairs of elements (`pairs_bytes`): films, and matrices over the pixels."""
    per_pixel = _SOLUTION_ARRAYS * realisations + _ELEMENT_ARRAYS * elements
    decomposed = _DECOMPOSED_SQUARES * float(min(views * pixels, realisations)) ** 2
    return float(_FLOAT) * (float(views) * pixels * per_pixel + decomposed) + _SOLUTION_BYTES


def span_bytes(entries: float, columns: int = 0, reach: int = 0, together: int = 0) -> float:
    """Peak of a sparse Gram matrix of so many entries, and of the factor of its band.

    The band reaches so far from the diagonal, and the factorisation pivots among so many columns together.
    """
    window = float(together + reach)
    return float(_GRAM_ENTRY) * entries + float(_FLOAT) * (_WINDOW_SQUARES * window**2 + float(columns) * reach)


def pairs_bytes(entries: int, weights: int) -> float:
    """Peak of T_i^T W T_j of all pairs with so many entries at most, for so many different W, and of their use."""
    return float(entries) * (_ENTRY_MADE + _ENTRY_HELD * (weights - 1))


def picture_bytes(width: int, height: int) -> float:
    """Peak of rendering a picture, which goes through the paths block by block."""
    return float(_FLOAT * _PICTURE_ARRAYS) * width * height + _PATH_BYTES


def film_bytes(views: int, pixels: int, realisations: int) -> float:
    """Peak of making a capture set ready to solve, or of filming it: A x N x B radiances with their variances."""
    return float(_FLOAT * _FILM_ARRAYS) * views * pixels * realisations


def _available() -> float:
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            name, value = line.split(":")
            if name == "MemAvailable":
                return 1024.0 * float(value.split()[0])
    except (OSError, ValueError):
        pass
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on every system
        return math.inf


def _left_in_control_group() -> float:
    """Bytes that a container still allows (cgroup version 2); inf where there is no limit."""
    group = Path("/sys/fs/cgroup")
    try:
        most = float((group / "memory.max").read_text(encoding="ascii"))
        return most - float((group / "memory.current").read_text(encoding="ascii"))
    except (OSError, ValueError):  # no control groups, or "max"
        return math.inf
