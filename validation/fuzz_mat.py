"""MATLAB files made hostile: tags, lengths, shapes, cells within cells, and compressed elements that swell."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from fuzz_bytes import NUMBERS, Rng, damage
from scipy.io import loadmat, savemat
from scipy.sparse import eye_array

from wallmirror.captures.recorded import RecordedRun

A, N, M, B = 3, 8, 2, 4


@cache
def run() -> dict[str, np.ndarray]:
    """A small recorded run with numbers of its own in every place."""
    rng = np.random.default_rng(7)
    return {
        "g": rng.random((N, B, A)),
        "s": rng.random((M, B)),
        "s_est": rng.random((M, B)),
        "brdf_mat": rng.random((N, M, A)),
        "brdf_est": np.round(rng.random((N, M, A)) * 200),  # SciPy stores it as doubles, MATLAB in bytes
        "x_axis": rng.random((A, N)),
        "obs": np.array([[0.0, -5.0, 45.0, -45.0, A, B, 60.0, 1.0]]),
    }


@dataclass(frozen=True)
class Sound:
    name: str
    content: bytes
    compressed: bool


@cache
def corpus() -> tuple[Sound, ...]:
    inner = np.empty(2, dtype=object)
    inner[:] = [np.ones(2), "x"]
    cells = np.empty(2, dtype=object)
    cells[:] = [inner, 1.0]
    beside = {
        "title": "text", "cells": cells, "table": {"a": 1.0, "b": {"c": "x"}}, "flags": np.array([True, False]),
        "wave": np.array([1 + 2j]), "thin": eye_array(4).tocsc(), "bytes": np.arange(9, dtype=np.uint8),
    }  # fmt: skip
    found = []
    for name, variables in {"plain": run(), "beside": {**beside, **run()}}.items():
        for compressed in (False, True):
            buffer = io.BytesIO()
            savemat(buffer, variables, do_compression=compressed)
            found.append(Sound(f"{name}{' compressed' * compressed}", buffer.getvalue(), compressed))
    return tuple(found)


def elements(content: bytes) -> list[tuple[int, bytes]]:
    """(type, body) of each element of a sound file."""
    at, found = 128, []
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        found.append((kind, content[at + 8 : at + 8 + size]))
        at += 8 + size
    return found


def joined(head: bytes, parts: list[tuple[int, bytes]], stated: dict[int, int]) -> bytes:
    """The file again; `stated` gives some elements a length that they have not."""
    pieces = (struct.pack("<II", kind, stated.get(k, len(body)) % 2**32) + body for k, (kind, body) in enumerate(parts))
    return head + b"".join(pieces)


def _number(rng: Rng) -> int:
    return int(rng.choice(NUMBERS)) + int(rng.integers(-1, 2))


def _inner(body: bytes, rng: Rng) -> bytes:
    """A matrix (with its tag) changed: flags, lengths, shape, name, types, or its numbers."""
    changed = bytearray(body)
    # Tag, flags (16 bytes), dimensions, name, numbers: words of four bytes.
    at = 4 * int(rng.integers(len(body) // 4 if rng.random() < 0.3 else min(24, len(body) // 4)))
    (old,) = struct.unpack_from("<I", changed, at)
    options = (_number(rng), old + 1, old - 1, old * 2, old ^ (1 << int(rng.integers(32))), int(rng.integers(20)))
    struct.pack_into("<I", changed, at, options[int(rng.integers(len(options)))] % 2**32)
    return bytes(changed)


def _matrix(kind: int, shape: tuple[int, ...], name: bytes, data: bytes, of: int = 9) -> bytes:
    """A matrix element with its tag, whatever it says."""
    dims = struct.pack(f"<{len(shape)}i", *shape)
    parts = [struct.pack("<IIII", 6, 8, kind, 0)]
    parts += [struct.pack("<II", t, len(d)) + d + b"\0" * (-len(d) % 8) for t, d in ((5, dims), (1, name), (of, data))]
    body = b"".join(parts)
    return struct.pack("<II", 14, len(body)) + body


def _bomb(rng: Rng) -> bytes:
    """A few kilobytes that swell to a great many zeros, with a shape that says so, or not."""
    count = int(rng.choice((2**16, 2**20, 2**23)))
    shape = ((count, 1), (2, 2), (2**30, 2**30), (46341, 46341), (-1, 5))[int(rng.integers(5))]
    name = (b"g", b"s", b"brdf_mat", b"other")[int(rng.integers(4))]
    matrix = _matrix(6, shape, name, b"\0" * (8 * count))
    squeezed = zlib.compress(matrix, 9)
    return squeezed if rng.random() < 0.7 else squeezed[: -int(rng.integers(1, 9))]


def _cells(rng: Rng) -> bytes:
    """Cells within cells within cells."""
    body = _matrix(6, (1, 1), b"", b"\0" * 8)
    for _ in range(int(rng.choice((3, 100, 2000)))):
        head = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIiiII", 5, 8, 1, 1, 1, 0)
        body = struct.pack("<II", 14, len(head) + len(body)) + head + body
    return body


def hostile(number: int) -> tuple[Sound, str, bytes]:
    """Input number `number`: the sound file that it was, what was done, and the bytes that became of it."""
    rng = np.random.default_rng((4, number))
    sound = corpus()[int(rng.integers(len(corpus())))]
    if rng.random() < 0.35:
        return sound, *damage(sound.content, [s.content for s in corpus()], rng)
    parts, stated, head = elements(sound.content), {}, sound.content[:128]
    at = int(rng.integers(len(parts)))
    kind, body = parts[at]

    def inner() -> None:
        whole = zlib.decompress(body) if kind == 15 else struct.pack("<II", kind, len(body)) + body
        whole = _inner(whole, rng)
        parts[at] = (15, zlib.compress(whole)) if kind == 15 else (struct.unpack("<I", whole[:4])[0], whole[8:])

    def checksum() -> None:
        parts[at] = kind, body[:-4] + rng.bytes(4)

    def swapped() -> None:
        other = int(rng.integers(len(parts)))
        parts[at], parts[other] = parts[other], parts[at]

    actions: dict[str, Callable[[], None]] = {
        "inner": inner,
        "inner again": inner,
        "length": lambda: stated.update({at: _number(rng)}),
        "kind": lambda: parts.__setitem__(at, (_number(rng) % 2**32, body)),
        "lost": lambda: parts.pop(at),
        "twice": lambda: parts.insert(at, parts[at]),
        "swapped": swapped,
        "checksum": checksum,
        "bomb": lambda: parts.insert(at, (15, _bomb(rng))),
        "cells": lambda: parts.insert(at, (15, zlib.compress(_cells(rng)))),
        "garbage": lambda: parts.insert(at, (15, rng.bytes(100))),
    }
    name = list(actions)[int(rng.integers(len(actions)))]
    actions[name]()
    if rng.random() < 0.05:
        name, head = "header", head[:116] + rng.bytes(12)
    return sound, name, joined(head, parts, stated)


def arrays(read: RecordedRun) -> dict[str, np.ndarray]:
    """The numbers that were read, in the file's own axes."""
    return {
        "g": read.radiance.transpose(1, 2, 0),
        "s": read.source,
        "s_est": read.source_estimate,
        "brdf_mat": read.brdf.transpose(1, 2, 0),
        "brdf_est": read.brdf_estimate.transpose(1, 2, 0),
        "x_axis": read.wall_x,
    }


def verdict(sound: Sound, content: bytes, read: RecordedRun) -> str:
    """What an accepted file is: the "same" numbers, "another" run that SciPy reads alike, or a "silent" fault."""
    found = arrays(read)
    if all(np.array_equal(found[name], run()[name]) for name in found):
        return "same"
    names = [name for name in found if not np.array_equal(found[name], run()[name])]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            judge = loadmat(io.BytesIO(content), variable_names=names)
    except Exception:  # noqa: BLE001  # whatever SciPy raises, it does not confirm the numbers
        return "silent"
    return "another" if all(np.array_equal(found[name], judge.get(name)) for name in names) else "silent"
