"""How much a file may ask for: sizes are judged before anything is allocated, and refused with what they would take."""

from __future__ import annotations

import math

from wallmirror.errors import InputError

#: Most numbers in one array that a file asks for: 1 GiB as float64, and reading holds at most four of them at once.
MAX_NUMBERS = 2**27

#: Largest TOML file that is read, in bytes. Parsed, the worst of that size takes about 110 times as much.
MAX_TOML_BYTES = 2**22


def require_affordable(shape: tuple[int, ...], names: tuple[str, ...], *, field: str | None = None) -> None:
    """Refuse an array of float64 that would have more than MAX_NUMBERS numbers.

    Parameters
    ----------
    shape, names:
        Extent along each axis and what it counts ("views", "pixels"), for the sentence.

    Raises
    ------
    InputError
        With the size that the array would have.

    Examples
    --------
    >>> require_affordable((20, 500, 20), ("views", "pixels", "realisations"))
    >>> require_affordable((100_000, 1_000_000), ("views", "pixels"))
    Traceback (most recent call last):
    wallmirror.errors.InputError: 100000 views x 1000000 pixels make 800 GB; at most 1.07 GB are allowed, so make one smaller
    """
    total = math.prod(shape)
    if total > MAX_NUMBERS:
        product = " x ".join(f"{extent} {name}" for extent, name in zip(shape, names, strict=True))
        raise InputError(
            f"{product} make {size_text(8 * total)}; at most {size_text(8 * MAX_NUMBERS)} are allowed, so make one smaller",
            field=field,
        )


def size_text(size: float) -> str:
    """A number of bytes as people say it: 1.07 GB.

    Examples
    --------
    >>> size_text(2**29), size_text(12)
    ('537 MB', '12 bytes')
    """
    for power, unit in ((1e18, "EB"), (1e15, "PB"), (1e12, "TB"), (1e9, "GB"), (1e6, "MB")):
        if size >= power:
            return f"{size / power:.3g} {unit}"
    return f"{size:.0f} bytes"
