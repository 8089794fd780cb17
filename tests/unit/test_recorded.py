"""MATLAB files: what SciPy writes is read alike, and what lies about itself is refused before it is unpacked."""

from __future__ import annotations

import math
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from scipy.sparse import eye_array

from wallmirror.captures.recorded import read_recorded_run
from wallmirror.geometry import wall_points
from wallmirror.matfile import read_matrices

from .helpers import refused

A, N, M, B = 3, 8, 2, 4
HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def recorded() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    shapes = {
        "g": (N, B, A),
        "s": (M, B),
        "s_est": (M, B),
        "brdf_mat": (N, M, A),
        "brdf_est": (N, M, A),
        "x_axis": (A, N),
    }
    run = {name: rng.random(shape) for name, shape in shapes.items()}
    return {**run, "obs": np.array([[0.0, -5.0, 45.0, -45.0, A, B, 60.0, 1.0]])}


def written(folder: Path, variables: dict[str, Any], *, compressed: bool = False) -> Path:
    path = folder / "run.mat"
    savemat(path, variables, do_compression=compressed)
    return path


def matrix(kind: int, shape: tuple[int, ...], name: bytes, data: bytes, *, of: int = 9, order: str = "<") -> bytes:
    """A matrix element with its tag, made by hand from the format's description."""
    dims = struct.pack(f"{order}{len(shape)}i", *shape)
    body = struct.pack(order + "IIII", 6, 8, kind, 0)
    for type_, content in ((5, dims), (1, name), (of, data)):
        body += struct.pack(order + "II", type_, len(content)) + content + b"\0" * (-len(content) % 8)
    return struct.pack(order + "II", 14, len(body)) + body


def squeezed(element: bytes) -> bytes:
    packed = zlib.compress(element)
    return struct.pack("<II", 15, len(packed)) + packed


# -- what comes back --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
def test_a_recorded_run_comes_back_in_our_axes(tmp_path: Path, compressed: bool) -> None:
    run = recorded()
    read = read_recorded_run(written(tmp_path, run, compressed=compressed))
    np.testing.assert_array_equal(read.radiance, run["g"].transpose(2, 0, 1))
    np.testing.assert_array_equal(read.brdf, run["brdf_mat"].transpose(2, 0, 1))
    np.testing.assert_array_equal(read.brdf_estimate, run["brdf_est"].transpose(2, 0, 1))
    np.testing.assert_array_equal(read.source, run["s"])
    np.testing.assert_array_equal(read.source_estimate, run["s_est"])
    np.testing.assert_array_equal(read.wall_x, run["x_axis"])
    assert read.observer.position == (0.0, -5.0)
    assert read.observer.view_angles == pytest.approx((math.radians(15), 0, -math.radians(15)), abs=1e-15)
    assert wall_points(read.observer).shape == (A, N)
    assert read.card.elements_x == (-2.5, 2.5)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
def test_every_kind_of_number_is_read_as_scipy_reads_it(tmp_path: Path, compressed: bool, dtype: str) -> None:
    values = np.random.default_rng(1).integers(0, 100, (3, 1, 5)).astype(dtype)
    beside = {"text": "abc", "cells": np.array([1.0, "x"], dtype=object), "thin": eye_array(3).tocsc(), "flag": True}
    path = written(tmp_path, {**beside, "a": values, "b": values[:, 0].T}, compressed=compressed)
    read = read_matrices(path, ["a", "b"])
    for name in ("a", "b"):
        np.testing.assert_array_equal(read[name], loadmat(path)[name])
        assert read[name].dtype == np.float64


def test_big_endian_files_and_small_elements_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    values = np.arange(6.0)
    big = "MATLAB 5.0 MAT-file".ljust(124).encode() + b"\x01\x00MI"
    path.write_bytes(big + matrix(6, (2, 3), b"long_name_g", values.astype(">f8").tobytes(), order=">"))
    np.testing.assert_array_equal(read_matrices(path, ["long_name_g"])["long_name_g"], values.reshape(2, 3, order="F"))
    # MATLAB stores whole numbers in bytes, up to four of them in the tag itself; SciPy writes names so.
    path.write_bytes(written(tmp_path, {"g": np.array([[7, 8, 9]], np.uint8)}).read_bytes())
    np.testing.assert_array_equal(read_matrices(path, ["g"])["g"], [[7, 8, 9]])


# -- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("g", np.ones((N, B)), "three axes"),
        ("s", np.ones((M, B + 1)), "beside g it needs (2, 4)"),
        ("s_est", np.ones((M + 1, B)), "beside g it needs (2, 4)"),
        ("brdf_mat", np.ones((N, M, A + 1)), "beside g"),
        ("x_axis", np.ones((N, A)), "beside g"),
        ("obs", np.ones((1, 7)), "beside g"),
        ("obs", np.array([[0.0, -5, 45, -45, A + 1, B, 60, 1]]), "4 views"),
        ("obs", np.array([[0.0, 5, 45, -45, A, B, 60, 1]]), "behind the wall"),
        ("obs", np.array([[0.0, -5, 45, -45, A, B, np.nan, 1]]), "not finite"),
        ("brdf_est", np.full((N, M, A), np.inf), "not finite"),
        ("g", np.ones((N, B, A)) * 1j, "no real"),
        ("s", "text", "no real"),
        ("s", np.ones((M, B)) > 0, "no real"),
        ("s", eye_array(2).tocsc(), "no real"),
        ("s", np.array([1.0, "x"], dtype=object), "no real"),
        ("s", np.ones((0, 4)), "shape"),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path: Path, name: str, value: Any, words: str) -> None:
    path = written(tmp_path, {**recorded(), name: value})
    error = refused(lambda: read_recorded_run(path))
    assert error.file == str(path)
    assert error.field == ("g" if words == "three axes" else name)
    assert words in error.message


def test_what_is_missing_or_twice_is_named(tmp_path: Path) -> None:
    run = recorded()
    del run["s"]
    assert refused(lambda: read_recorded_run(written(tmp_path, run))).message == "lacks s"
    path = written(tmp_path, recorded())
    path.write_bytes(path.read_bytes() + matrix(6, (1, 1), b"obs", b"\0" * 8))
    assert "twice" in refused(lambda: read_recorded_run(path)).message


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a MATLAB file"),
        (b"\x89HDF\r\n\x1a\n" + b"\0" * 500, "7.3"),
        (b"MATLAB 7.3 MAT-file".ljust(512), "7.3"),
        (b"x" * 200, "not a MATLAB file"),
        (HEAD, "lacks g"),
        (HEAD + b"\x0f\0\0", "ends within a tag"),
        (HEAD + struct.pack("<II", 15, 2**31) + b"x", "longer than the file"),
        (HEAD + struct.pack("<II", 99, 0), "unknown kind"),
        (HEAD + struct.pack("<II", 15, 8) + b"garbage!", "cannot be unpacked"),
        (HEAD + squeezed(b"\x63\0\0\0\0\0\0\0"), "holds no matrix"),
        (HEAD + matrix(6, (2, 2), b"g", b"\0" * 24), "24 bytes for 4 numbers"),
        (HEAD + matrix(6, (-2, -2), b"g", b"\0" * 32), "shape"),
        (HEAD + matrix(6, (2**30, 2**30), b"g", b"\0" * 32), "9.22 EB"),
        (HEAD + matrix(6, (2, 2), b"g", b"\0" * 32, of=99), "lengths disagree"),
        (HEAD + squeezed(matrix(6, (2, 2), b"g", b"\0" * 32) + b"more than it states"), "lengths disagree"),
        (HEAD + squeezed(matrix(6, (2, 2), b"g", b"\0" * 32)[:-8]), "lengths disagree"),
    ],
)
def test_files_that_lie_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    error = refused(lambda: read_matrices(path, ["g"]))
    assert error.file == str(path)
    assert words in error.message


def test_every_flip_in_a_compressed_matrix_is_refused(tmp_path: Path) -> None:
    """By deflate's own checksum."""
    values = np.random.default_rng(3).random((4, 5))
    path = written(tmp_path, {"g": values}, compressed=True)
    sound = path.read_bytes()
    for at in range(136, len(sound)):
        path.write_bytes(flipped(sound, at))
        refused(lambda: read_matrices(path, ["g"]))
    # The twin: in a file that is not compressed nothing tells, to us or to SciPy.
    sound = written(tmp_path, {"g": values}).read_bytes()
    path.write_bytes(flipped(sound, len(sound) - 10))
    spoiled = read_matrices(path, ["g"])["g"]
    assert not np.array_equal(spoiled, values)
    np.testing.assert_array_equal(spoiled, loadmat(path)["g"])


def flipped(content: bytes, at: int) -> bytes:
    changed = bytearray(content)
    changed[at] ^= 1 << (at % 8)
    return bytes(changed)


def peak(call: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        call()
    finally:
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return used


@pytest.mark.parametrize(("name", "shape"), [(b"g", (2, 2)), (b"other", (2**22, 1)), (b"g", (2**22, 2**20))])
def test_compressed_elements_that_swell_are_not_unpacked(tmp_path: Path, name: bytes, shape: tuple[int, int]) -> None:
    """32 MiB of zeros in 32 KiB: what nobody asked for, or what is more than its shape says, stays packed."""
    path = tmp_path / "a.mat"
    path.write_bytes(HEAD + squeezed(matrix(6, shape, name, b"\0" * 2**25)))
    assert path.stat().st_size < 2**16
    assert peak(lambda: refused(lambda: read_matrices(path, ["g"]))) < 2**20
    # The twin: unpacked as a whole it would be there in full.
    packed = path.read_bytes()[136:]
    assert peak(lambda: zlib.decompress(packed)) > 2**25


def test_the_limit_counts_all_matrices(tmp_path: Path) -> None:
    path = written(tmp_path, {"a": np.ones((10, 10)), "b": np.ones((10, 10))})
    read_matrices(path, ["a", "b"], max_numbers=200)
    error = refused(lambda: read_matrices(path, ["a", "b"], max_numbers=199))
    assert error.field == "b"
    assert "800 bytes" in error.message
