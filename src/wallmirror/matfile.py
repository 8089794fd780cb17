"""Real matrices from MATLAB files (version 5 to 7.2), judged by their tags before anything is allocated.

SciPy's reader is made for files that one trusts: it allocates what a tag states and unpacks a compressed element whole.
Here each element is unpacked up to its name first; what nobody asked for is passed over unread. The layout is that of
"MAT-File Format" (The MathWorks), level 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import InputError, shown
from wallmirror.files import read_bounded
from wallmirror.limits import size_text

Array = NDArray[np.float64]

#: Largest MATLAB file that is read, in bytes, and the most numbers that are taken from one: 268 MB each.
MAX_MAT_BYTES = 2**28
MAX_MAT_NUMBERS = 2**25

_MATRIX, _COMPRESSED, _INT8, _INT32, _UINT32 = 14, 15, 1, 5, 6
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = range(6, 16)  # double, single, and integers of 8 to 64 bits
_COMPLEX, _LOGICAL = 0x0800, 0x0200
_MAX_NAME, _MAX_AXES = 63, 8
_HEAD = 512  # bytes; flags, dimensions and name of a matrix take less


@dataclass(frozen=True)
class _Head:
    """What a matrix says of itself before its numbers."""

    kind: int
    flags: int
    shape: tuple[int, ...]
    name: str
    end: int


def read_matrices(path: str | Path, names: Sequence[str], *, max_numbers: int = MAX_MAT_NUMBERS) -> dict[str, Array]:
    """Read some matrices of a MATLAB file by name, as float64 of their own shape.

    Parameters
    ----------
    names:
        Which; other variables of the file may be of any kind.
    max_numbers:
        Most numbers that all of them together may have.

    Raises
    ------
    InputError
        If the file is missing, no MATLAB file of that version, damaged, or cut short, or a matrix is missing, doubled,
        too large, no real and full matrix of numbers, or does not match its checksum. Values are not judged.

    Examples
    --------
    >>> read_matrices("thesis_recorded_run.mat", ["g"])["g"].shape  # doctest: +SKIP
    (500, 20, 20)
    """
    path = Path(path)
    content = read_bounded(path, MAX_MAT_BYTES)
    order = _byte_order(content, path)
    found: dict[str, Array] = {}
    at = 128
    while at < len(content):
        if len(content) - at < 8:
            raise _damaged(path, "it ends within a tag")
        kind, size = struct.unpack(order + "II", content[at : at + 8])
        body = memoryview(content)[at + 8 : at + 8 + size]
        if len(body) < size or kind not in (_MATRIX, _COMPRESSED):
            raise _damaged(path, f"an element at byte {at} is of an unknown kind, or longer than the file")
        # Only elements that are not compressed are padded to 8 bytes.
        at += 8 + size + (-size % 8 if kind == _MATRIX else 0)
        head = _head(_start(body, order, path) if kind == _COMPRESSED else bytes(body[:_HEAD]), order, path)
        if head is None or head.name not in names:
            continue
        if head.name in found:
            raise InputError("is there twice", file=path, field=head.name)
        _require_numbers(head, max_numbers - sum(matrix.size for matrix in found.values()), path)
        found[head.name] = _numbers(head, body, order, path, compressed=kind == _COMPRESSED)
    missing = [name for name in names if name not in found]
    if missing:
        raise InputError(f"lacks {', '.join(missing)}", file=path)
    return found


def _byte_order(content: bytes, path: Path) -> str:
    """ "<" or ">" by the mark at the end of the file's header."""
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[:19] == b"MATLAB 7.3 MAT-file":
        raise InputError("is a MATLAB 7.3 file; save it with -v7", file=path)
    order = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}.get(content[124:128])
    if order is None:
        raise InputError("is not a MATLAB file of version 5 to 7.2", file=path)
    return order


def _start(body: memoryview, order: str, path: Path) -> bytes:
    """The first bytes of the matrix in a compressed element, behind its tag."""
    try:
        start = zlib.decompressobj().decompress(body, 8 + _HEAD)
    except zlib.error as error:
        raise _damaged(path, f"a compressed element cannot be unpacked ({error})") from None
    if len(start) < 8 or struct.unpack(order + "I", start[:4])[0] != _MATRIX:
        raise _damaged(path, "a compressed element holds no matrix")
    return start[8:]


def _head(start: bytes, order: str, path: Path) -> _Head | None:
    """Flags, shape and name; None for an opaque object, which has no shape."""
    flags, at = _element(start, 0, order, path)
    if flags[0] != _UINT32 or len(flags[1]) != 8:
        raise _damaged(path, "a matrix has no flags")
    (word,) = struct.unpack(order + "I", flags[1][:4])
    if word & 0xFF == 17:
        return None
    dimensions, at = _element(start, at, order, path)
    if dimensions[0] != _INT32 or len(dimensions[1]) % 4 or len(dimensions[1]) < 8:
        raise _damaged(path, "a matrix has no dimensions")
    shape = struct.unpack(f"{order}{len(dimensions[1]) // 4}i", dimensions[1])
    name, at = _element(start, at, order, path)
    text = bytes(name[1])
    if name[0] != _INT8 or len(text) > _MAX_NAME or not text.isascii():
        raise _damaged(path, "a matrix has no name")
    return _Head(word & 0xFF, word, shape, text.decode(), at)


def _require_numbers(head: _Head, max_numbers: int, path: Path) -> None:
    if head.kind not in _CLASSES or head.flags & (_COMPLEX | _LOGICAL):
        raise InputError("is no real and full matrix of numbers", file=path, field=head.name)
    if len(head.shape) > _MAX_AXES or min(head.shape) < 1:
        raise InputError(f"has shape {shown(head.shape)}", file=path, field=head.name)
    count = math.prod(head.shape)
    if count > max_numbers:
        raise InputError(
            f"has shape {head.shape}, {size_text(8 * count)}, but only {size_text(8 * max_numbers)} more are read",
            file=path,
            field=head.name,
        )


def _numbers(head: _Head, body: memoryview, order: str, path: Path, *, compressed: bool) -> Array:
    """The numbers of a matrix whose head was let through."""
    count = math.prod(head.shape)
    whole: bytes | memoryview = body
    if compressed:
        # No type is wider than 8 bytes; one byte more than fits tells of a matrix that holds more than it states.
        unpacking = zlib.decompressobj()
        try:
            inner = unpacking.decompress(body, 8 + head.end + 8 + 8 * count + 8 + 1)
            inner += unpacking.decompress(unpacking.unconsumed_tail, 1)
        except zlib.error as error:
            raise InputError(f"is damaged: {error}", file=path, field=head.name) from None
        # Only the end of the stream has its checksum verified.
        if not unpacking.eof or unpacking.unused_data or struct.unpack(order + "I", inner[4:8])[0] != len(inner) - 8:
            raise InputError("is damaged: its lengths disagree", file=path, field=head.name)
        whole = memoryview(inner)[8:]
    (kind, data), end = _element(whole, head.end, order, path)
    if kind not in _DTYPES or end < len(whole) - 7:
        raise InputError("is damaged: its lengths disagree", file=path, field=head.name)
    dtype = np.dtype(order + _DTYPES[kind])
    if len(data) != count * dtype.itemsize:
        raise InputError(f"is damaged: {len(data)} bytes for {count} numbers", file=path, field=head.name)
    values: Array = np.frombuffer(data, dtype=dtype).astype(np.float64).reshape(head.shape, order="F")
    return values


def _element(start: bytes | memoryview, at: int, order: str, path: Path) -> tuple[tuple[int, bytes | memoryview], int]:
    """(type, data) of the element at a place, and where the next one begins."""
    if len(start) - at < 8:
        raise _damaged(path, "a matrix ends early")
    (word,) = struct.unpack(order + "I", start[at : at + 4])
    if word >> 16:  # up to four bytes stand in the tag itself
        kind, size, data_at, end = word & 0xFFFF, word >> 16, at + 4, at + 8
        if size > 4:
            raise _damaged(path, "a short element is longer than 4 bytes")
    else:
        kind, (size,) = word, struct.unpack(order + "I", start[at + 4 : at + 8])
        data_at = at + 8
        end = data_at + size + -size % 8
    if len(start) - data_at < size:
        raise _damaged(path, "a matrix ends early")
    return (kind, start[data_at : data_at + size]), end


def _damaged(path: Path, detail: str) -> InputError:
    return InputError(f"is damaged or cut short: {detail}", file=path)
