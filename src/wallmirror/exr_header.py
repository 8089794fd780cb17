"""The header of an EXR file, read strictly and bounded before OpenEXR allocates what it states.

OpenEXR is lenient where a damaged file needs the contrary: it passes over attributes whose size cannot be, falls back
on defaults for required ones, and reads what is left. The layout is that of "OpenEXR File Layout" (openexr.com).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from wallmirror.errors import InputError
from wallmirror.limits import size_text

#: Largest header that is read, in bytes: room for any settings that are meant for people.
MAX_HEADER_BYTES = 2**24

_MAGIC = b"\x76\x2f\x31\x01"
_VERSION, _TILED, _LONG_NAMES, _DEEP, _PARTS = 2, 0x200, 0x400, 0x800, 0x1000
_SAMPLE_BYTES = (4, 2, 4)  # unsigned integers, half floats, floats
# Type and size of the attributes that a file must have; the list of channels has any size.
_REQUIRED = {
    b"channels": (b"chlist", None),
    b"compression": (b"compression", 1),
    b"dataWindow": (b"box2i", 16),
    b"displayWindow": (b"box2i", 16),
    b"lineOrder": (b"lineOrder", 1),
    b"pixelAspectRatio": (b"float", 4),
    b"screenWindowCenter": (b"v2f", 8),
    b"screenWindowWidth": (b"float", 4),
}
_MAX_ATTRIBUTES = 4096
_MAX_CHANNELS = 4096
_MAX_TILE = 2**24  # pixels
_MAX_NAME = 255
# Rows of a chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB, HTJ2K256, HTJ2K32.
_CHUNK_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
# Most bytes of pixels that one byte of the file can stand for: a run of 128 in two bytes; deflate's limit is 1032,
# and PXR24 drops a quarter of each float before that. The others have no such bound.
_MOST_PER_BYTE = {0: 1, 1: 64, 2: 1032, 3: 1032, 5: 1376}


@dataclass(frozen=True, kw_only=True)
class ExrHeader:
    """What the header of a flat single image states.

    Parameters
    ----------
    rows, columns:
        Size of the data window, both at least 1.
    channels:
        Bytes of a sample by channel name.
    top:
        Row number of the data window's first row.
    compression:
        Its number in the file's format.
    tile:
        Columns and rows of a tile; None where chunks are rows.
    is_multipart:
        Whether the file could hold several images; it holds one.
    table_at:
        Where in the file the table of chunks begins.
    attributes:
        (type, value) of each attribute by name, as bytes.
    """

    rows: int
    columns: int
    top: int
    channels: dict[str, int]
    compression: int
    tile: tuple[int, int] | None
    is_multipart: bool
    table_at: int
    attributes: dict[bytes, tuple[bytes, bytes]]

    @property
    def samples(self) -> int:
        """rows x columns x channels."""
        return self.rows * self.columns * len(self.channels)

    @property
    def chunk_rows(self) -> int:
        """Rows of a chunk that is no tile."""
        return _CHUNK_ROWS[self.compression]

    @property
    def chunks(self) -> int:
        """Number of chunks of the image at its full resolution."""
        if self.tile is None:
            return -(-self.rows // self.chunk_rows)
        return -(-self.columns // self.tile[0]) * -(-self.rows // self.tile[1])

    @property
    def data_bytes(self) -> int:
        """Bytes of all pixels once they are decompressed."""
        return self.rows * self.columns * sum(self.channels.values())


def read_exr_header(path: Path, *, max_samples: int) -> ExrHeader:
    """Read and judge the header of an EXR file.

    Parameters
    ----------
    max_samples:
        Largest rows x columns x channels that is let through.

    Raises
    ------
    InputError
        If the file is missing, no EXR file, malformed, too large, too short for what it states, deep, subsampled, or
        holds several images.

    Examples
    --------
    >>> read_exr_header(Path("view00_real00.exr"), max_samples=2**27).columns  # doctest: +SKIP
    500
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe would wait for ever
            raise InputError("is not a file", file=path)
        with path.open("rb") as file:
            size = path.stat().st_size
            start = file.read(8)
            if start[:4] != _MAGIC:
                raise InputError("is empty" if not start else "is not an EXR file", file=path)
            header = _Reader(file, path).header(start)
    except FileNotFoundError:
        raise InputError("no such file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", file=path) from None
    if header.samples > max_samples:
        raise InputError(
            f"states {header.columns} x {header.rows} pixels in {len(header.channels)} channels, "
            f"{size_text(4 * header.samples)}; at most {max_samples} numbers ({size_text(4 * max_samples)}) are read",
            file=path,
        )
    _require_long_enough(header, path, size - header.table_at)
    return header


def _require_long_enough(header: ExrHeader, path: Path, rest: int) -> None:
    """Refuse a file that cannot hold its pixels, whatever stands in it; `rest` bytes follow the header."""
    # Each chunk has an entry of 8 bytes in the table of offsets, and at least 8 for place and length before its pixels.
    most = (rest - 16 * header.chunks) * _MOST_PER_BYTE.get(header.compression, 2**62)
    if rest < 16 * header.chunks or most < header.data_bytes:
        raise InputError(
            f"is damaged or cut short: {rest} bytes cannot hold {header.columns} x {header.rows} pixels in "
            f"{len(header.channels)} channels",
            file=path,
        )


class _Reader:
    """Takes a header apart; refuses at the first byte that cannot be."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file = file
        self._path = path
        self._left = MAX_HEADER_BYTES

    def header(self, start: bytes) -> ExrHeader:
        if len(start) < 8:
            raise self._damaged("its header ends early")
        (flags,) = struct.unpack("<I", start[4:])
        if flags & 0xFF != _VERSION or flags & ~(0xFF | _TILED | _LONG_NAMES | _DEEP | _PARTS):
            raise self._damaged(f"its version field is {flags:#x}")
        attributes = self._attributes()
        if flags & _PARTS:
            parts = 1
            while self._attributes():
                parts += 1
            if parts > 1:
                raise InputError(f"holds {parts} images; give a file with one", file=self._path)
        kind = attributes.get(b"type", (b"string", b"tiledimage" if flags & _TILED else b"scanlineimage"))
        if flags & _DEEP or kind[1].startswith(b"deep"):
            raise InputError("is a deep EXR file; give a flat one", file=self._path)
        tiled = kind == (b"string", b"tiledimage")
        if not (tiled or kind == (b"string", b"scanlineimage")) or (flags & _TILED and not tiled):
            raise self._damaged("its type is neither scan lines nor tiles")
        for name, (of, size) in _REQUIRED.items():
            if name not in attributes or attributes[name][0] != of or size not in (None, len(attributes[name][1])):
                raise self._damaged(f"its attribute {name.decode()} is missing or malformed")
        if tiled != (b"tiles" in attributes):
            raise self._damaged("its attribute tiles is missing or out of place")
        compression = attributes[b"compression"][1][0]
        if compression >= len(_CHUNK_ROWS) or attributes[b"lineOrder"][1][0] > 2:
            raise self._damaged("its compression or order of lines is unknown")
        left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"][1])
        if right < left or bottom < top:
            raise self._damaged(f"its data window runs from ({left}, {top}) to ({right}, {bottom})")
        return ExrHeader(
            rows=bottom - top + 1,
            columns=right - left + 1,
            top=top,
            channels=self._channels(attributes[b"channels"][1]),
            compression=compression,
            tile=self._tile(*attributes[b"tiles"]) if tiled else None,
            is_multipart=bool(flags & _PARTS),
            table_at=self._file.tell(),
            attributes=attributes,
        )

    def _attributes(self) -> dict[bytes, tuple[bytes, bytes]]:
        """Name to (type, value), up to and with the empty name that ends a header."""
        found: dict[bytes, tuple[bytes, bytes]] = {}
        while name := self._name():
            of = self._name()
            (size,) = struct.unpack("<i", self._take(4))
            if not of or size < 0 or name in found or len(found) == _MAX_ATTRIBUTES:
                raise self._damaged("its attributes are malformed, doubled or too many")
            found[name] = of, self._take(size)
        return found

    def _channels(self, value: bytes) -> dict[str, int]:
        found: dict[str, int] = {}
        at, last = 0, b""
        while value[at : at + 1] != b"\0":
            end = value.find(b"\0", at, at + _MAX_NAME + 1)
            if end < 0 or end + 17 > len(value) - 1:
                raise self._damaged("its list of channels ends early")
            kind, _, *sampling = struct.unpack("<iIii", value[end + 1 : end + 17])
            try:
                name = value[at:end].decode("utf-8")
            except UnicodeDecodeError:
                raise self._damaged("a channel's name is no text") from None
            # Sorted, since OpenEXR sorts them and would take one channel's pixels for another's.
            if not 0 <= kind < len(_SAMPLE_BYTES) or value[at:end] <= last or len(found) == _MAX_CHANNELS:
                raise self._damaged("its list of channels is malformed, out of order or too long")
            last = value[at:end]
            if sampling != [1, 1]:
                raise InputError(
                    "has channels at reduced resolution; give every channel all its pixels", file=self._path
                )
            found[name] = _SAMPLE_BYTES[kind]
            at = end + 17
        if at != len(value) - 1 or not found:
            raise self._damaged("its list of channels is empty or ends late")
        return found

    def _tile(self, of: bytes, value: bytes) -> tuple[int, int]:
        if (of, len(value)) != (b"tiledesc", 9):
            raise self._damaged("its attribute tiles is malformed")
        width, height, mode = struct.unpack("<IIB", value)
        # OpenEXR allocates a tile, whatever the image needs of it.
        if not 0 < width * height <= _MAX_TILE or mode & 0x0F > 2 or mode >> 4 > 1:
            raise self._damaged(f"its tiles are {width} x {height}")
        return width, height

    def _name(self) -> bytes:
        """A text ended by a zero byte, without it."""
        name = bytearray()
        while byte := self._take(1).rstrip(b"\0"):
            name += byte
            if len(name) > _MAX_NAME:
                raise self._damaged("a name in its header does not end")
        return bytes(name)

    def _take(self, size: int) -> bytes:
        if size > self._left:
            raise self._damaged(f"its header is longer than {size_text(MAX_HEADER_BYTES)}")
        self._left -= size
        taken = self._file.read(size)
        if len(taken) < size:
            raise self._damaged("its header ends early")
        return taken

    def _damaged(self, detail: str) -> InputError:
        return InputError(f"is damaged or cut short: {detail}", file=self._path)
