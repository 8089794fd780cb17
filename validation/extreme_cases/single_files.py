"""EXR, MATLAB, .npy and .csv files: numbers, types and sizes at their ends.

References: NumPy's rounding and half floats, SciPy's writer of MATLAB files, Python's own reading of a number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.io

from wallmirror.exr import read_exr, write_exr
from wallmirror.matfile import read_matrices
from wallmirror.table_files import read_table

from .capture_sets import LEAST, folder, rounded
from .harness import Case, must_answer, must_refuse


def cases() -> Iterator[Case]:
    def exr(values: Any, good: bool) -> Callable[[], tuple[float, float]]:
        def check() -> tuple[float, float]:
            with folder() as at:
                write_exr(at / "a.exr", {"Y": values})
                found = read_exr(at / "a.exr").channels["Y"]
            return (0.0 if np.array_equal(found, rounded(np.asarray(values)), equal_nan=True) else 1.0), 0.0

        return must_answer(check) if good else must_refuse(check)

    for value in (0.0, -0.0, LEAST, 1e-320, 3.4e38, math.inf, math.nan):
        yield Case("write_exr, read_exr", "pixel", f"{value:g}", exr([[value]], good=True))
    for value in (3.5e38, 1e300, -1e300):
        yield Case("write_exr, read_exr", "pixel", f"{value:g}", exr([[value]], good=False))
    for shape in ((1, 1), (1, 100_000), (3000, 1)):
        yield Case("write_exr, read_exr", "rows x columns", "{} x {}".format(*shape), exr(np.ones(shape), good=True))
    for shape in ((0, 1), (1, 0), (0, 0)):
        yield Case("write_exr, read_exr", "rows x columns", "{} x {}".format(*shape), exr(np.ones(shape), good=False))
    yield Case("write_exr, read_exr", "pixel", "complex", exr([[1j]], good=False))
    yield Case("write_exr, read_exr", "pixel", "text", exr([["a"]], good=False))
    yield Case("write_exr, read_exr", "pixel", "2^200, an integer", exr([[2**200]], good=False))

    def half(value: float) -> tuple[float, float]:
        import OpenEXR

        with folder() as at:
            pixels = np.full((1, 2), value, dtype=np.float16)
            with OpenEXR.File(
                {"type": OpenEXR.scanlineimage, "compression": OpenEXR.NO_COMPRESSION}, {"Y": pixels}
            ) as file:
                file.write(str(at / "a.exr"))
            found = read_exr(at / "a.exr")
        same = np.array_equal(found.channels["Y"].astype(np.float64), pixels.astype(np.float64), equal_nan=True)
        return (0.0 if same and found.half["Y"] else 1.0), 0.0

    for value in (0.0, 2.0**-24, 65504.0, math.inf, math.nan):
        yield Case("read_exr", "half float", f"{value:g}", must_answer(lambda v=value: half(v)))

    def mat(values: Any) -> tuple[float, float]:
        with folder() as at:
            scipy.io.savemat(at / "a.mat", {"g": values})
            found = read_matrices(at / "a.mat", ["g"])["g"]
        return (
            0.0 if np.array_equal(found, np.atleast_2d(np.asarray(values)).astype(np.float64), equal_nan=True) else 1.0
        ), 0.0

    for value in (0.0, 5e-324, 1e300, math.inf, math.nan):
        yield Case("read_matrices", "number", f"{value:g}", must_answer(lambda v=value: mat(np.full((2, 3), v))))
    for dtype in ("f4", "i1", "u1", "i2", "u2", "i4", "u4"):
        info: Any = np.finfo(dtype) if dtype == "f4" else np.iinfo(dtype)
        yield Case("read_matrices", "type", f"{np.dtype(dtype)}, its ends", must_answer(
            lambda d=dtype, i=info: mat(np.array([[i.min, i.max]], dtype=d))))  # fmt: skip
    for name, values in (
        ("complex", np.array([[1j]])),
        ("text", np.array(["abc"])),
        ("a cell", np.array([{}], dtype=object)),
        ("logical", np.array([[True]])),
    ):
        yield Case("read_matrices", "type", name, must_refuse(lambda v=values: mat(v)))
    yield Case("read_matrices", "size", "0 x 0", lambda: mat(np.zeros((0, 0))))

    def npy(values: Any, *, pickled: bool = False) -> tuple[float, float]:
        with folder() as at:
            np.save(at / "a.npy", values, allow_pickle=pickled)
            found = read_table(at / "a.npy")
        return (0.0 if np.array_equal(found, np.asarray(values, dtype=np.float64), equal_nan=True) else 1.0), 0.0

    for value in (0.0, 5e-324, 1e300, math.inf, math.nan):
        yield Case("read_table, .npy", "number", f"{value:g}", must_answer(lambda v=value: npy(np.full((2, 3), v))))
    for dtype in ("f2", "f4", ">f8", "i1", "u8"):
        yield Case(
            "read_table, .npy", "type", str(np.dtype(dtype)), must_answer(lambda d=dtype: npy(np.ones((2, 2), dtype=d)))
        )
    for name, values in (
        ("complex", np.ones((2, 2), dtype=complex)),
        ("text", np.array(["a"])),
        ("no axis", np.array(1.0)),
        ("three axes", np.ones((2, 2, 2))),
        ("structured", np.zeros(2, dtype=[("a", "f8")])),
        ("bool", np.ones((2, 2), dtype=bool)),
    ):
        yield Case("read_table, .npy", "type", name, must_refuse(lambda v=values: npy(v)))
    yield Case(
        "read_table, .npy", "type", "a pickle", must_refuse(lambda: npy(np.array([{}], dtype=object), pickled=True))
    )
    for text in ("", "\n", "a,b", "1,2\n3", "1e400", "1;2", "0x10", "1" * 5000):

        def csv(t: str = text) -> tuple[float, float]:
            with folder() as at:
                (at / "a.csv").write_text(t)
                found = read_table(at / "a.csv")
            return (0.0 if np.array_equal(found, [[float(t)]]) else 1.0), 0.0

        yield Case("read_table, .csv", "text", repr(text[:10]), csv)
