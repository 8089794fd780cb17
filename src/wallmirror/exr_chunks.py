"""The table of an EXR file's chunks, verified: where it is damaged, OpenEXR guesses another one without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import InputError
from wallmirror.exr_header import ExrHeader

Indices = NDArray[np.int64]

_AT_ONCE = 2**18  # chunks


def require_sound_chunks(path: Path, header: ExrHeader) -> None:
    """Refuse a file whose table of offsets leads out of it, or to anything but the chunk that should be there.

    Of tiled images with several resolutions the chunks of the full one are looked at, which is the one that is read.

    Raises
    ------
    InputError
        At the first chunk that is not where the table says.
    """
    with path.open("rb") as file:
        content = np.memmap(file, np.uint8, mode="r")
        for first in range(0, header.chunks, _AT_ONCE):
            index = np.arange(first, min(first + _AT_ONCE, header.chunks))
            offsets = _numbers(content, header.table_at + 8 * index, "<i8")
            words = (1 if header.is_multipart else 0) + (4 if header.tile else 1)
            leader = 4 * words + 4
            lowest, highest = header.table_at + 8 * header.chunks, content.size - leader
            inside = (lowest <= offsets) & (offsets <= highest)
            places = np.where(inside, offsets, lowest)
            if lowest > highest:
                raise InputError("is damaged or cut short: it ends before its pixels", file=path)
            expected = _leaders(header, index)
            stated = [_numbers(content, places + 4 * k, "<i4") for k in range(words)]
            good = inside & np.all([s == e for s, e in zip(stated, expected, strict=True)], axis=0)
            size = _numbers(content, places + 4 * words, "<i4")
            good &= (size >= 0) & (places + leader + size <= content.size)
            if not good.all():
                chunk = int(index[np.argmin(good)])
                raise InputError(
                    f"is damaged or cut short: chunk {chunk} of {header.chunks} is not where its table says", file=path
                )


def _leaders(header: ExrHeader, index: Indices) -> list[Indices]:
    """What each chunk says of its place before its length: the part, then a row, or a tile's column, row and level."""
    zero = np.zeros_like(index)
    part = [zero] if header.is_multipart else []
    if header.tile is None:
        return [*part, header.top + index * header.chunk_rows]
    across = -(-header.columns // header.tile[0])
    return [*part, index % across, index // across, zero, zero]


def _numbers(content: NDArray[np.uint8], at: Indices, dtype: str) -> Indices:
    """Little-endian numbers at places in the file."""
    gathered = np.ascontiguousarray(content[at[:, np.newaxis] + np.arange(np.dtype(dtype).itemsize)])
    return gathered.view(dtype)[:, 0].astype(np.int64)
