"""Damage that knows nothing of a file's structure: what disks, networks and careless hands do to bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Rng = np.random.Generator

#: Numbers at which sizes, signs and products overflow.
NUMBERS = (0, 1, 2, 3, 7, 8, 255, 256, 2**15, 2**16, 2**24, 2**27, 2**28, 2**30, 2**31 - 2, 2**31 - 1, 2**31, 2**32 - 1)


def flip(data: bytes, rng: Rng) -> bytes:
    changed = bytearray(data)
    for at in rng.integers(len(data), size=int(rng.integers(1, 9))):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def overwrite(data: bytes, rng: Rng) -> bytes:
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 17))
    filling = (rng.bytes(size), b"\0" * size, b"\xff" * size)[int(rng.integers(3))]
    return data[:at] + filling + data[at + size :]


def number(data: bytes, rng: Rng) -> bytes:
    """A number of four bytes, small, huge or negative, anywhere."""
    at = int(rng.integers(max(1, len(data) - 3)))
    return data[:at] + int(rng.choice(NUMBERS)).to_bytes(4, "little") + data[at + 4 :]


def truncate(data: bytes, rng: Rng) -> bytes:
    return data[: int(rng.integers(len(data)))]


def remove(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + data[at + int(rng.integers(1, 65)) :]


def insert(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 65))) + data[at:]


def repeat(data: bytes, rng: Rng) -> bytes:
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 257))
    return data[: at + size] + data[at : at + size] * int(rng.integers(1, 5)) + data[at + size :]


def append(data: bytes, rng: Rng) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 1025)))


def splice(data: bytes, other: bytes, rng: Rng) -> bytes:
    """The start of one file and the end of another."""
    return data[: int(rng.integers(len(data)))] + other[int(rng.integers(len(other))) :]


MUTATIONS: dict[str, Callable[[bytes, Rng], bytes]] = {
    f.__name__: f for f in (flip, overwrite, number, truncate, remove, insert, repeat, append)
}


def damage(data: bytes, others: list[bytes], rng: Rng) -> tuple[str, bytes]:
    """One kind of damage drawn at random: its name, and the damaged bytes."""
    names = [*MUTATIONS, "splice"]
    name = names[int(rng.integers(len(names)))]
    if name == "splice":
        return name, splice(data, others[int(rng.integers(len(others)))], rng)
    return name, MUTATIONS[name](data, rng)
