"""The table of an EXR file's chunks, verified: where it is damaged, OpenEXR guesses another one without a word."""

from __future__ import annotations

import os
from io import RawIOBase
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
    # Without a buffer: leaders lie far apart. Not mapped into memory: a file cut short meanwhile would kill the process.
    with path.open("rb", buffering=0) as file:
        file_size = os.fstat(file.fileno()).st_size
        for first in range(0, header.chunks, _AT_ONCE):
            index = np.arange(first, min(first + _AT_ONCE, header.chunks))
            offsets = np.frombuffer(_read(file, header.table_at + 8 * first, 8 * index.size), "<i8")
            expected = _leaders(header, index)
            leader = 4 * len(expected) + 4
            good = (header.table_at + 8 * header.chunks <= offsets) & (offsets <= file_size - leader)
            words = [_read(file, at, leader) for at in np.where(good, offsets, header.table_at).tolist()]
            *stated, size = np.frombuffer(b"".join(words), "<i4").reshape(index.size, -1).T.astype(np.int64)
            good &= np.all([s == e for s, e in zip(stated, expected, strict=True)], axis=0)
            good &= (size >= 0) & (offsets <= file_size - leader - size)
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


def _read(file: RawIOBase, at: int, size: int) -> bytes:
    """Bytes at a place in the file; zeros stand for what is no longer there."""
    file.seek(at)
    return (file.read(size) or b"").ljust(size, b"\0")
