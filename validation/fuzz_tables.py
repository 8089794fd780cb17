"""Tables of a wall's BRDF made hostile: .npy headers that lie, .csv files of anything."""

from __future__ import annotations

import ast
import io
import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_bytes import NUMBERS, Rng, damage

from wallmirror import Scene

_SCENE = """format = 1
title = "A wall"
[wall]
brdf = "table"
file = "wall.{suffix}"
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
views = 3
scan_deg = 90.0
pixels = 50
[card]
elements_x = [-1.0, 1.0]
y = -1.0
[source]
realisations = 2
"""


@cache
def corpus(suffix: str) -> tuple[bytes, ...]:
    """Sound files: rows, columns and squares, of every kind of number that NumPy writes."""
    values = np.round(np.random.default_rng(3).random((7, 7)), 3)
    arrays = [values, values[0], values[:, :1], values.astype("f4"), (values * 9).astype("u1"), np.asfortranarray(values),
              values.astype(">f8")]  # fmt: skip
    found = []
    for array in arrays:
        if suffix == "npy":
            buffer = io.BytesIO()
            np.save(buffer, array)
            found.append(buffer.getvalue())
        else:
            rows = np.atleast_2d(array).tolist()
            found.append("".join(",".join(map(repr, row)) + "\n" for row in rows).encode())
    return tuple(found)


def _header(content: bytes, rng: Rng) -> bytes:
    """Another shape, type or order in the header of a .npy file, or a length that it has not."""
    (size,) = struct.unpack_from("<H", content, 8)
    text, data = content[10 : 10 + size].decode(), content[10 + size :]
    n = int(rng.choice(NUMBERS)) + int(rng.integers(-1, 2))
    shapes = (
        f"({n},)",
        f"({n}, {n})",
        "()",
        "(0, 7)",
        "(-1, 7)",
        "(7, 7, 1)",
        "(7,",
        "(1,) * 99",
        "(True, 7)",
        "7",
        "(49,)",
    )
    kinds = (
        "|O",
        "<f8",
        "<c16",
        "<f2",
        "|S8",
        "<U4",
        "|V8",
        "<M8[s]",
        "|b1",
        "<i8",
        "[('a', '<f8')]",
        "f" * 9000,
        "<f16",
    )
    old = text[text.index("'shape': ") + 9 : text.rindex(")") + 1]
    choice = int(rng.integers(5))
    if choice < 2:
        text = text.replace(old, shapes[int(rng.integers(len(shapes)))])
    elif choice == 2:
        start = text.index("'descr': ") + 9
        text = text[:start] + repr(kinds[int(rng.integers(len(kinds)))]) + text[text.index(",", start) :]
    elif choice == 3:
        text = text.replace("False", "True") if "False" in text else text.replace("True", "False")
    else:
        text = ("[" * 5000, "__import__('os')", text.replace("}", ""), text + "#" * 60_000)[int(rng.integers(4))]
    length = n % 2**16 if rng.random() < 0.1 else len(text) % 2**16
    return content[:6] + bytes((int(rng.integers(1, 5)) if rng.random() < 0.1 else 1, 0)) + struct.pack("<H", length) + (
        text.encode() + data
    )  # fmt: skip


def _cells(content: bytes, rng: Rng) -> bytes:
    """Another cell, row or separator in a .csv file."""
    lines = content.decode().splitlines()
    at, n = int(rng.integers(len(lines))), int(rng.choice((1, 1000, 50_000)))
    wild = ("nan", "inf", "-1", "1e999", "x", "", '"1"', "1;2", "0x1p3", "1_000", "١", "1" * n, "x" * n, "1," * n + "1",
            "# 1", "\0", "1+2j", "true", "0.125", "0.5", "7")  # fmt: skip
    cells = lines[at].split(",")
    cells[int(rng.integers(len(cells)))] = wild[int(rng.integers(len(wild)))]
    lines[at] = ",".join(cells)
    if rng.random() < 0.2:
        lines[at:at] = [lines[at]] * min(n, 2**22 // len(lines[at] + " ")) if rng.random() < 0.5 else [""]
    return "\n".join(lines).encode()


def hostile(number: int) -> tuple[str, str, bytes]:
    """Input number `number`: the suffix of the file, what was done, and its bytes."""
    rng = np.random.default_rng((5, number))
    suffix = ("npy", "csv")[int(rng.integers(2))]
    sound = corpus(suffix)[int(rng.integers(len(corpus(suffix))))]
    if rng.random() < 0.4:
        return suffix, *damage(sound, list(corpus(suffix)), rng)
    return (suffix, "header", _header(sound, rng)) if suffix == "npy" else (suffix, "cells", _cells(sound, rng))


def lay_out(folder: Path, suffix: str, content: bytes) -> Path:
    """A scene that names the table, and the table beside it."""
    (folder / f"wall.{suffix}").write_bytes(content)
    path = folder / f"table_{suffix}.toml"
    path.write_text(_SCENE.format(suffix=suffix))
    return path


def judge(suffix: str, content: bytes, read: Scene) -> bool:
    """Whether the wall's table is what the file says, read without NumPy's readers."""
    brdf: Any = read.wall.brdf
    found = np.asarray(brdf.values)
    if suffix == "csv":
        lines = [line.split("#")[0].strip() for line in content.decode().splitlines()]
        expected = np.array([[float(cell) for cell in line.split(",")] for line in lines if line])
    else:
        wide = content[6] > 1
        (size,) = struct.unpack_from("<I" if wide else "<H", content, 8)
        start = 12 if wide else 10
        header = ast.literal_eval(content[start : start + size].decode("utf-8" if content[6] > 2 else "latin-1"))
        data = np.frombuffer(content, np.dtype(header["descr"]), int(np.prod(header["shape"])), start + size)
        expected = data.astype(np.float64).reshape(header["shape"], order="F" if header["fortran_order"] else "C")
    return np.array_equal(found.ravel(), expected.ravel()) and bool(np.all(np.isfinite(found)))
