"""EXR files made hostile, and a decoder of the format's own, written from its specification, to judge what is read.

A file that the reader accepts must hold the pixels that it held before, or, where it carries no checksums, those that
this decoder finds in it. Only compressions that the decoder lacks leave nothing to judge by.
"""

from __future__ import annotations

import contextlib
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from fuzz_bytes import NUMBERS, Rng, damage

from wallmirror.exr import write_exr

Pixels = dict[str, np.ndarray]

_DTYPES = ("<u4", "<f2", "<f4")
_ROWS = {0: 1, 1: 1, 2: 1, 3: 16}  # of a chunk, by the compressions that the decoder knows


@dataclass(frozen=True)
class Sound:
    """A sound file: its bytes, its float channels, and whether it carries checksums."""

    name: str
    content: bytes
    pixels: Pixels
    signed: bool


@cache
def corpus() -> tuple[Sound, ...]:
    """Small files of every kind that a camera, a renderer or a person might hand over."""
    rng = np.random.default_rng(2024)
    ramp = np.round(np.linspace(0, 4, 20 * 37).reshape(20, 37), 2).astype(np.float32)
    noise = rng.standard_normal((5, 37)).astype(np.float32)
    half, whole = noise.astype(np.float16), np.arange(5 * 37, dtype=np.uint32).reshape(5, 37)
    rgb = {c: noise + k for k, c in enumerate("BGR")}
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    compressions = {"none": 0, "rle": 1, "zips": 2, "zip": 3, "piz": 4, "pxr24": 5, "b44": 6, "dwaa": 8, "dwab": 9}
    plain: dict[str, tuple[dict[str, Any], dict[str, np.ndarray]]] = {
        name: ({"compression": OpenEXR.Compression(number)}, {"Y": ramp}) for name, number in compressions.items()
    }
    plain |= {
        "half": ({"compression": OpenEXR.ZIP_COMPRESSION}, {"Y": half}),
        "mixed": ({"compression": OpenEXR.NO_COMPRESSION}, {"Y": noise, "id": whole, "Z": half}),
        "rgb": ({"compression": OpenEXR.ZIPS_COMPRESSION}, rgb),
        "rle rgb": ({"compression": OpenEXR.RLE_COMPRESSION}, {c: np.round(v) for c, v in rgb.items()}),
        "tiles": ({**tiles, "compression": OpenEXR.NO_COMPRESSION}, {"Y": ramp}),
        "zip tiles": ({**tiles, "compression": OpenEXR.ZIP_COMPRESSION}, {"Y": ramp}),
        "whole numbers": ({}, {"Y": whole}),
    }
    found = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        for name, (header, channels) in plain.items():
            with OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(channels)) as file:
                file.write(str(path))
            found.append(Sound(name, path.read_bytes(), _read(path), signed=False))
        for name, channels in {"signed ramp": {"Y": ramp}, "signed noise": {"Y": noise}, "signed rgb": rgb}.items():
            write_exr(path, channels, settings={"spp": 16, "name": "grün", "view": 0})
            found.append(Sound(name, path.read_bytes(), _read(path), signed=True))
        parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage, "name": name}, {"Y": noise}) for name in "ab"]
        OpenEXR.File(parts).write(str(path))
        found.append(Sound("two images", path.read_bytes(), {}, signed=False))
        deep = np.empty((1, 2), dtype=object)
        deep[0, 0], deep[0, 1] = np.ones(3, np.float32), np.ones(1, np.float32)
        kind = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
        with OpenEXR.File(kind, {"Y": deep}) as file:
            file.write(str(path))
        found.append(Sound("deep", path.read_bytes(), {}, signed=False))
    return tuple(found)


def _read(path: Path) -> Pixels:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    return {name: np.asarray(v, np.float32) for name, v in channels.items() if v.dtype.kind == "f"}


# -- the file taken apart ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Parts:
    """An EXR file of one image as version, attributes (name, type, stated size, value), offsets and chunks."""

    version: int
    attributes: tuple[tuple[bytes, bytes, int, bytes], ...]
    offsets: tuple[int, ...]
    chunks: bytes
    chunks_at: int

    def value(self, name: bytes) -> bytes:
        return next((v for n, _, _, v in self.attributes if n == name), b"")

    def with_value(self, name: bytes, value: bytes) -> Parts:
        kept = ((n, t, len(value), value) if n == name else (n, t, s, v) for n, t, s, v in self.attributes)
        return replace(self, attributes=tuple(kept))

    def joined(self, *, mended: bool) -> bytes:
        """The file again; `mended` moves the offsets along with the chunks."""
        head = struct.pack("<II", 20000630, self.version)
        for name, kind, size, value in self.attributes:
            head += name + b"\0" + kind + b"\0" + struct.pack("<I", size % 2**32) + value
        head += b"\0"
        shift = len(head) + 8 * len(self.offsets) - self.chunks_at if mended else 0
        table = b"".join(struct.pack("<Q", (offset + shift) % 2**64) for offset in self.offsets)
        return head + table + self.chunks


def take_apart(content: bytes) -> Parts | None:
    """The parts of a file of one flat image; None where they do not follow the specification."""
    try:
        magic, version = struct.unpack_from("<II", content)
        if magic != 20000630 or version & 0xFF != 2 or version & ~0x6FF:
            return None
        at, attributes = 8, []
        while content[at] != 0:
            name_end = content.index(b"\0", at)
            kind_end = content.index(b"\0", name_end + 1)
            (size,) = struct.unpack_from("<I", content, kind_end + 1)
            value_at = kind_end + 5
            if value_at + size > len(content):
                return None
            attributes.append(
                (content[at:name_end], content[name_end + 1 : kind_end], size, content[value_at : value_at + size])
            )
            at = value_at + size
        parts = Parts(version, tuple(attributes), (), b"", 0)
        count = chunk_count(parts)
        if count is None or len(content) < at + 1 + 8 * count:
            return None
        offsets = struct.unpack_from(f"<{count}Q", content, at + 1)
        start = at + 1 + 8 * count
    except (IndexError, ValueError, struct.error):
        return None
    return replace(parts, offsets=offsets, chunks=content[start:], chunks_at=start)


def window(parts: Parts) -> tuple[int, int, int, int]:
    return struct.unpack("<4i", parts.value(b"dataWindow"))


def is_tiled(parts: Parts) -> bool:
    return bool(parts.version & 0x200)


def chunk_count(parts: Parts) -> int | None:
    left, top, right, bottom = window(parts)
    rows, columns = bottom - top + 1, right - left + 1
    if is_tiled(parts):
        width, height, mode = struct.unpack("<IIB", parts.value(b"tiles"))
        return -(-rows // height) * -(-columns // width) if mode == 0 and width and height else None
    compression = parts.value(b"compression")[0]
    lines = {4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, **_ROWS}.get(compression)
    return None if lines is None or not 0 < rows < 10**6 else -(-rows // lines)


def channel_list(parts: Parts) -> list[tuple[str, int]]:
    """(name, type) of each channel; ValueError where the list is malformed or not of full resolution."""
    value, at, found = parts.value(b"channels"), 0, []
    while value[at] != 0:
        end = value.index(b"\0", at)
        kind, _, x, y = struct.unpack_from("<iIii", value, end + 1)
        if (x, y) != (1, 1) or not 0 <= kind <= 2:
            raise ValueError(kind)
        found.append((value[at:end].decode(), kind))
        at = end + 17
    if at != len(value) - 1:
        raise ValueError(at)
    return found


# -- the decoder ------------------------------------------------------------------------------------------------


def decode(content: bytes) -> Pixels | None:
    """The float channels that a file holds by the specification; None where it breaks it or cannot be judged."""
    parts = take_apart(content)
    if parts is None:
        return None
    try:
        return _decode(parts, content)
    except (IndexError, ValueError, KeyError, struct.error, zlib.error):
        return None


def _decode(parts: Parts, content: bytes) -> Pixels | None:
    left, top, right, bottom = window(parts)
    rows, columns = bottom - top + 1, right - left + 1
    compression, channels = parts.value(b"compression")[0], channel_list(parts)
    if (
        compression not in _ROWS
        or len({name for name, _ in channels}) < len(channels)
        or not 0 < rows * columns < 10**7
    ):
        return None
    planes = {name: np.zeros((rows, columns), _DTYPES[kind]) for name, kind in channels}
    if is_tiled(parts):
        width, height, _ = struct.unpack("<IIB", parts.value(b"tiles"))
        across = -(-columns // width)
        boxes = [(k // across * height, k % across * width, height, width) for k in range(len(parts.offsets))]
    else:
        lines = _ROWS[compression]
        boxes = [(k * lines, 0, lines, columns) for k in range(len(parts.offsets))]
    for index, (offset, (row, column, height, width)) in enumerate(zip(parts.offsets, boxes)):
        height, width = min(height, rows - row), min(width, columns - column)
        if is_tiled(parts):
            x, y, level_x, level_y, size = struct.unpack_from("<5i", content, offset)
            across = -(-columns // struct.unpack("<I", parts.value(b"tiles")[:4])[0])
            at, placed = offset + 20, (x + y * across, level_x, level_y) == (index, 0, 0)
        else:
            y, size = struct.unpack_from("<2i", content, offset)
            at, placed = offset + 8, y == row + top
        raw_size = height * width * sum(np.dtype(_DTYPES[kind]).itemsize for _, kind in channels)
        if not placed or size < 0 or at + size > len(content):
            return None
        data = _unpacked(content[at : at + size], compression, raw_size)
        cursor = 0
        for line in range(height):
            for name, kind in channels:
                row_values = np.frombuffer(data, _DTYPES[kind], width, cursor)
                planes[name][row + line, column : column + width] = row_values
                cursor += row_values.nbytes
    return {name: plane.astype(np.float32) for name, plane in planes.items() if plane.dtype.kind == "f"}


def _unpacked(data: bytes, compression: int, raw_size: int) -> bytes:
    if compression == 0 or len(data) == raw_size:
        # A chunk that does not shrink is stored as it is.
        if len(data) != raw_size:
            raise ValueError(len(data))
        return data
    plain = _run_lengths(data) if compression == 1 else zlib.decompress(data)
    if len(plain) != raw_size:
        raise ValueError(len(plain))
    predicted = np.frombuffer(plain, np.uint8).astype(np.int64)
    steps = predicted.copy()
    steps[1:] -= 128
    bytes_ = (np.cumsum(steps) % 256).astype(np.uint8)
    middle = (raw_size + 1) // 2
    result = np.empty(raw_size, np.uint8)
    result[0::2], result[1::2] = bytes_[:middle], bytes_[middle:]
    return result.tobytes()


def _run_lengths(data: bytes) -> bytes:
    out, at = bytearray(), 0
    while at < len(data):
        count = struct.unpack_from("<b", data, at)[0]
        if count < 0:
            if at + 1 - count > len(data):
                raise ValueError(at)
            out += data[at + 1 : at + 1 - count]
            at += 1 - count
        else:
            out += data[at + 1 : at + 2] * (count + 1)
            if at + 2 > len(data):
                raise ValueError(at)
            at += 2
    return bytes(out)


# -- mutations that know the structure --------------------------------------------------------------------------


def _pick(rng: Rng, options: Any) -> Any:
    return options[int(rng.integers(len(options)))]


def _int(rng: Rng) -> int:
    """A signed number of 32 bits: an edge, one beside it, or its negative."""
    value = int(rng.choice(NUMBERS)) + int(rng.integers(-1, 2))
    return ((-value if rng.random() < 0.4 else value) + 2**31) % 2**32 - 2**31


def _window(parts: Parts, rng: Rng) -> Parts:
    corners = list(window(parts))
    if rng.random() < 0.3:  # moved as a whole: the same pixels elsewhere
        by = (_int(rng) // 4, _int(rng) // 4)
        corners = [c + by[k % 2] for k, c in enumerate(corners)]
    else:
        for k in rng.integers(4, size=int(rng.integers(1, 5))):
            corners[k] = _int(rng) if rng.random() < 0.6 else corners[k] + int(rng.integers(-40, 41))
    packed = struct.pack("<4i", *((c + 2**31) % 2**32 - 2**31 for c in corners))
    return parts.with_value(_pick(rng, (b"dataWindow", b"dataWindow", b"dataWindow", b"displayWindow")), packed)


def _channels(parts: Parts, rng: Rng) -> Parts:
    value = parts.value(b"channels")
    entry = struct.pack("<iIii", *(_pick(rng, ((2, 0, 1, 1), (1, 0, 1, 1), (0, 0, 1, 1), (_int(rng), 0, 1, 1)))))
    many = int(rng.choice((1, 2, 30, 1000, 5000)))
    changed = _pick(
        rng,
        (
            lambda: b"A\0" + entry + value,
            lambda: b"".join(f"c{k:05d}".encode() + b"\0" + entry for k in range(many)) + value,
            lambda: value[:2] + entry + value[18:],
            lambda: value[: int(rng.integers(len(value)))],
            lambda: value + value,
            lambda: b"x" * int(rng.choice((31, 32, 255, 256, 70_000))) + value,
            lambda: b"\0",
            lambda: value[:10] + struct.pack("<2i", _int(rng), _int(rng)) + value[18:],
            lambda: b"\xff\xfe" + value,
            lambda: b"Z" + value[1:],
        ),
    )()
    return parts.with_value(b"channels", changed)


def _compression(parts: Parts, rng: Rng) -> Parts:
    name = _pick(rng, (b"compression", b"compression", b"lineOrder"))
    return parts.with_value(name, bytes([int(rng.integers(256 if rng.random() < 0.2 else 15))]))


def _tiles(parts: Parts, rng: Rng) -> Parts:
    mode = int(rng.choice((0, 1, 2, 3, 16, 17, 18, 255)))
    value = struct.pack("<IIB", _int(rng) % 2**32, _int(rng) % 2**32, mode)
    if b"tiles" in [name for name, *_ in parts.attributes] and rng.random() < 0.8:
        return parts.with_value(b"tiles", value)
    return replace(parts, attributes=(*parts.attributes, (b"tiles", b"tiledesc", 9, value)))


def _flags(parts: Parts, rng: Rng) -> Parts:
    return replace(parts, version=parts.version ^ (1 << int(rng.integers(32 if rng.random() < 0.3 else 13))))


def _attribute(parts: Parts, rng: Rng) -> Parts:
    """One attribute removed, doubled, renamed, retyped, with a lying size or another value; or a new one."""
    chosen = int(rng.integers(len(parts.attributes)))
    name, kind, size, value = parts.attributes[chosen]
    kinds = (b"string", b"int", b"box2i", b"chlist", b"preview", b"stringvector", b"m44f", b"opaque", b"", b"float")
    lying = _pick(rng, (size - 1, size + 1, 0, *NUMBERS))
    new = _pick(
        rng,
        (
            (),
            ((name, kind, size, value), (name, kind, size, value)),
            ((name + b"x", kind, size, value),),
            ((name, _pick(rng, kinds), size, value),),
            ((name, kind, lying, value),),
            ((name, kind, len(value) - 1, value[:-1]),),
            ((name, kind, size, rng.bytes(len(value))),),
            ((b"extra", _pick(rng, kinds), lying, b"abc"), (name, kind, size, value)),
            ((b"extra", _pick(rng, kinds), 8, rng.bytes(8)), (name, kind, size, value)),
        ),
    )
    return replace(parts, attributes=(*parts.attributes[:chosen], *new, *parts.attributes[chosen + 1 :]))


def _offsets(parts: Parts, rng: Rng) -> Parts:
    offsets = list(parts.offsets)
    chosen, other = (int(k) for k in rng.integers(len(offsets), size=2))
    choice = int(rng.integers(5))
    if choice == 0:
        offsets[chosen], offsets[other] = offsets[other], offsets[chosen]
    elif choice == 1:
        offsets[chosen] = offsets[other]
    elif choice == 2:
        offsets[chosen] = int(rng.choice((0, 1, 8, 2**31, 2**32, 2**40, 2**62))) + int(rng.integers(2)) * 2**63
    elif choice == 3:
        offsets[chosen] += int(rng.integers(-9, 10))
    else:
        offsets = offsets[: chosen + 1] if rng.random() < 0.5 else [*offsets, offsets[-1]]
    return replace(parts, offsets=tuple(offsets))


def _chunk(parts: Parts, rng: Rng) -> Parts:
    """Place or length of a chunk, or bytes within one."""
    leader = 20 if is_tiled(parts) else 8
    start = _pick(rng, parts.offsets) - parts.chunks_at
    chunks = bytearray(parts.chunks)
    if rng.random() < 0.7:
        at = start + 4 * int(rng.integers(leader // 4))
        (old,) = struct.unpack_from("<i", chunks, at)
        new = _int(rng) if rng.random() < 0.5 else old + int(rng.integers(-20, 21))
        struct.pack_into("<i", chunks, at, (new + 2**31) % 2**32 - 2**31)
    else:
        for _ in range(int(rng.integers(1, 9))):
            at = min(len(chunks) - 1, start + leader + int(rng.integers(64)))
            chunks[at] = int(rng.integers(256))
    return replace(parts, chunks=bytes(chunks))


def _shuffled(parts: Parts, rng: Rng) -> Parts:
    """Chunks stored in another order, with offsets that follow: the same image."""
    ends = [*sorted(parts.offsets)[1:], parts.chunks_at + len(parts.chunks)]
    spans = dict(zip(sorted(parts.offsets), ends))
    chunks, moved, at = b"", {}, parts.chunks_at
    for offset in rng.permutation(np.array(parts.offsets, dtype=np.int64)).tolist():
        moved[offset] = at
        piece = parts.chunks[offset - parts.chunks_at : spans[offset] - parts.chunks_at]
        chunks += piece
        at += len(piece)
    return replace(parts, chunks=chunks, offsets=tuple(moved[o] for o in parts.offsets))


def _signature(parts: Parts, rng: Rng) -> Parts:
    """Our own attribute: values of other types, lost sums, doubled keys, deep nesting, numbers that no float holds."""
    text = parts.value(b"wallmirror").decode()
    if not text.startswith('{"settings": {'):
        text = '{"settings": null, "sha256": {"Y": "00"}, "settings_sha256": "00"}'
        parts = replace(parts, attributes=(*parts.attributes, (b"wallmirror", b"string", 0, b"")))
    table = json.loads(text)
    value = _pick(rng, (None, 1, 1e308, "x", [], {}, [[]], {"Y": None}, {"Y": 3}, -1, True, "0" * 64))
    key = _pick(rng, tuple(table))
    changed = _pick(
        rng,
        (
            lambda: json.dumps({**table, key: value}),
            lambda: json.dumps({k: v for k, v in table.items() if k != key}),
            lambda: json.dumps({**table, "sha256": {**dict.fromkeys("XYZ", "0" * 64)}}),
            lambda: text[:-1] + f', "{key}": {json.dumps(value)}}}',
            lambda: text.replace("16", _pick(rng, ("17", "1e999", "NaN", "1" * 5000, "16.0"))),
            lambda: "[" * int(rng.choice((10, 10_000, 200_000))),
            lambda: '{"settings":' * int(rng.choice((10, 10_000))),
            lambda: json.dumps(value),
            lambda: text.upper(),
            lambda: text + " " * int(rng.choice((1, 1000, 200_000))),
        ),
    )()
    return parts.with_value(b"wallmirror", changed.encode())


STRUCTURE: dict[str, Callable[[Parts, Rng], Parts]] = {
    f.__name__.strip("_"): f
    for f in (
        _window, _window, _channels, _compression, _tiles, _flags, _attribute, _offsets, _chunk, _shuffled, _signature
    )
}  # fmt: skip


def hostile(number: int) -> tuple[Sound, str, bytes]:
    """Input number `number`: the sound file that it was, what was done, and the bytes that became of it."""
    rng = np.random.default_rng((1, number))
    sound = _pick(rng, corpus())
    parts = take_apart(sound.content)
    if parts is None or rng.random() < 0.45:
        name, content = damage(sound.content, [s.content for s in corpus()], rng)
        return sound, name, content
    names = list(STRUCTURE)
    chosen = [_pick(rng, names) for _ in range(1 if rng.random() < 0.8 else 2)]
    for name in chosen:
        with contextlib.suppress(struct.error, ValueError, OverflowError, IndexError):  # after another one
            parts = STRUCTURE[name](parts, rng)
    return sound, "+".join(chosen), parts.joined(mended=rng.random() < 0.7)


def verdict(sound: Sound, content: bytes, accepted: Pixels) -> str:
    """What an accepted file is: "same", "another" image by the specification, "unjudged", or "silent" fault."""
    if _equal(accepted, sound.pixels):
        return "same"
    parts = take_apart(content)
    if parts is None or parts.value(b"wallmirror"):  # checksums are there and cannot agree with other pixels
        return "silent"
    decoded = decode(content)
    if decoded is not None and _equal(accepted, decoded):
        return "another"
    return "silent" if parts.value(b"compression")[:1] in map(bytes, zip(_ROWS)) else "unjudged"


def _equal(a: Pixels, b: Pixels) -> bool:
    return set(a) == set(b) and all(a[k].shape == b[k].shape and a[k].tobytes() == b[k].tobytes() for k in a)
