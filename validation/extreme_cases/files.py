"""Files: what is written reads back as the same numbers to float32's rounding, and every field at its ends is refused or kept.

References: the numbers that were written, rounded by NumPy; for a scene, Python's own reading of the field; for .mat files,
SciPy's writer; for half floats, NumPy's.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.captures.writing import exact_degrees
from wallmirror.exr import read_exr, write_exr
from wallmirror.matfile import read_matrices
from wallmirror.table_files import read_table

from .harness import Case
from .inverse import answered, refused
from .scenes import card, observer

Array = NDArray[np.float64]

_DENORMAL = 2.0**-149  # the least float32


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def rounded(values: Array) -> Array:
    """The nearest float32, as float64."""
    with np.errstate(over="ignore", under="ignore"):
        return values.astype(np.float32).astype(np.float64)


# -- capture sets -----------------------------------------------------------------------------------------------------


def small_set(films: Array, variance: Array | None = None, **changes: Any) -> wm.CaptureSet:
    eye = changes.pop("observer", None) or observer(
        pixels=films.shape[1], view_angles=tuple(np.linspace(0.2, -0.2, films.shape[0]))
    )
    return wm.CaptureSet(observer=eye, card=changes.pop("card", card()), radiance=films, variance=variance, **changes)


def round_trip(films: Array, variance: Array | None = None) -> tuple[float, float]:
    """Films and variances are those written to float32's rounding, which comes on top of the variance, as documented."""
    with folder() as at:
        wm.write_captures(at / "set", small_set(films, variance))
        found = wm.read_captures(at / "set")
    if not np.array_equal(found.radiance, rounded(films)):
        return math.inf, 0.0
    if variance is None:
        return (0.0 if found.variance is None else math.inf), 0.0
    assert found.variance is not None
    infinite = np.isinf(variance)
    if not np.array_equal(np.isinf(found.variance), infinite):
        return math.inf, 0.0
    # Half a unit in the last place of the stored radiance, uniformly: its square over three.
    own = np.maximum(2.0**-24 * np.abs(rounded(films)), 2.0**-150) ** 2 / 3
    expected = np.where(infinite, 0.0, rounded(np.where(infinite, 0.0, variance)) + own)
    stored = np.where(infinite, 0.0, found.variance)
    return float(np.max(np.abs(stored - expected) / np.maximum(expected, 1e-300))), 1e-12


def capture_cases() -> Iterator[Case]:
    entry = "write_captures, read_captures"
    for value in (0.0, -1.0, 1.2e-38, 1.0, 3.4e38):
        yield Case(entry, "radiance", f"{value:g}", answered(lambda v=value: round_trip(np.full((2, 3, 2), v))))
    for value in (1e-320, 1e-50, _DENORMAL, 1e-38, 3.5e38, 1e300, -1e300, math.inf, math.nan):
        yield Case(entry, "radiance", f"{value:g}", refused(lambda v=value: round_trip(np.full((2, 3, 2), v))))
    for value in (0.0, 1e-320, 1e-50, _DENORMAL, 1.0, 3.4e38, math.inf):
        yield Case(entry, "variance", f"{value:g}", answered(
            lambda v=value: round_trip(np.ones((2, 3, 2)), np.full((2, 3, 2), v))))  # fmt: skip
    for value in (1e-46, 1e-40, 1e-320):
        yield Case(entry, "radiance 1e-20, variance", f"{value:g}", (refused if value > 1e-60 else answered)(
            lambda v=value: round_trip(np.full((2, 3, 2), 1e-20), np.full((2, 3, 2), v))))  # fmt: skip
    for value in (3.5e38, 1e300, -1.0, math.nan):
        yield Case(entry, "variance", f"{value:g}", refused(
            lambda v=value: round_trip(np.ones((2, 3, 2)), np.full((2, 3, 2), v))))  # fmt: skip
    for shape in ((1, 1, 1), (1, 2, 1), (1, 100_000, 1), (120, 2, 1), (1, 2, 120)):
        yield Case(entry, "views x pixels x realisations", "{} x {} x {}".format(*shape), answered(
            lambda s=shape: round_trip(np.random.default_rng(1).random(s))))  # fmt: skip
    for shape in ((1, 2, 0), (0, 2, 1), (1, 0, 1)):
        yield Case(entry, "views x pixels x realisations", "{} x {} x {}".format(*shape), refused(
            lambda s=shape: round_trip(np.zeros(s))))  # fmt: skip
    yield Case(entry, "radiance", "any floats", answered(lambda: round_trip(np.ldexp(
        np.random.default_rng(2).standard_normal((2, 50, 3)), np.random.default_rng(3).integers(-170, 120, (2, 50, 3))))))  # fmt: skip

    def geometry(eye: dict[str, Any], strips: dict[str, Any]) -> tuple[float, float]:
        films = np.ones((1, 2, 1))
        given = small_set(films, observer=observer(**{"pixels": 2, "view_angles": (0.1,), **eye}), card=card(**strips))
        with folder() as at:
            wm.write_captures(at / "set", given)
            found = wm.read_captures(at / "set")
        if found.card != given.card or found.observer.position != given.observer.position:
            return math.inf, 0.0
        angles = (found.observer.fov, *found.observer.view_angles), (given.observer.fov, *given.observer.view_angles)
        # An angle is stored in degrees, of which the nearest may be one unit in the last place off in radians.
        return max(abs(a - b) / abs(b) if b else abs(a) for a, b in zip(*angles)), 2.3e-16

    for metres in (1e-100, 1e-6, 1e8, 1e99):
        points = {"element_width": 0.0, "element_height": 0.0}
        yield Case(entry, "card's distance", f"{metres:g} m", lambda m=metres: geometry({}, {"y": -m, **points}))
        yield Case(
            entry, "observer's distance", f"{metres:g} m", lambda m=metres: geometry({"position": (0.1, -m)}, {})
        )
    for angle in (0.0, 1e-300, 1e-8, 0.7, -0.7):
        yield Case(entry, "view angle", f"{angle:g} rad", lambda a=angle: geometry({"view_angles": (a,)}, {}))
    for angle in (1e-5, 1.0, 3.0):
        yield Case(
            entry, "field of view", f"{angle:g} rad", lambda a=angle: geometry({"fov": a, "view_angles": (0.0,)}, {})
        )
    for angle in (0.0, 5e-324, 1e-300, 1e-8, math.pi / 2, -1.2):
        yield Case("exact_degrees", "angle", f"{angle:g} rad", lambda a=angle: (
            abs(math.radians(exact_degrees(a)) - a) / (abs(a) or 1.0), 2.3e-16 if abs(a) > 1e-300 else 1.0))  # fmt: skip


#: What is wrong with a field [[captures]] or its value; None where it may stand.
_CAPTURE_FIELDS: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = (
    ("exposure", ("1e-12", "1e12", "0.001"), ("0", "-1.0", "1e-300", "1e300", "inf", "nan", '"1"', "true", "[1]")),
    ("saturation", ("1e-300", "1e300", "2.0"), ("0", "-1.0", "inf", "nan", '"1"', "true")),
    ("row", ("0",), ("-1", "1", "0.5", "1e300", "nan", "99999999999999999999", '"0"')),
    ("view", (), ("-1", "7", "0.5", "nan", "99999999999999999999")),
    ("realisation", (), ("-1", "7", "0.5", "nan", "99999999999999999999", "2147483647")),
    ("channel", (), ('""', '"Z"', "1", "nan")),
    ("file", (), ('""', '"no.exr"', '"../x.exr"', '"/etc/hostname"', "1", '"a\\u0000b"')),
)


def stored_field_cases() -> Iterator[Case]:
    def with_field(name: str, value: str) -> tuple[float, float]:
        films = np.full((1, 2, 1), 0.5)
        with folder() as at:
            wm.write_captures(at / "set", small_set(films))
            path = at / "set" / "captures.toml"
            lines = [line for line in path.read_text().splitlines() if line.split(" = ")[0] != name]
            path.write_text("\n".join([*lines, f"{name} = {value}"]) + "\n")
            found = wm.read_captures(at / "set")
        number = float(value) if name in ("exposure", "saturation") else 1.0
        expected = 0.5 / number if name == "exposure" else 0.5
        lost = name == "saturation" and number <= 0.5
        told = found.variance is not None and bool(np.all(np.isinf(found.variance)))
        return float(np.max(np.abs(found.radiance / expected - 1))) + (0.0 if lost == told else 1.0), 1e-15

    for name, good, bad in _CAPTURE_FIELDS:
        for value in good:
            yield Case("read_captures", name, value, answered(lambda n=name, v=value: with_field(n, v)))
        for value in bad:
            yield Case("read_captures", name, value, refused(lambda n=name, v=value: with_field(n, v)))


def truth_cases() -> Iterator[Case]:
    def kept(value: float) -> tuple[float, float]:
        angles = np.array([-1.0, 0.0, 1.0])
        given = wm.Truth(source=np.full((3, 1), value), theta_s=angles, theta_o=angles, brdf=np.full(3, value))
        with folder() as at:
            wm.write_captures(at / "set", small_set(np.ones((1, 2, 1))), truth=given)
            found = wm.read_truth(at / "set")
        assert found is not None
        return (
            0.0 if np.array_equal(found.source, given.source) and np.array_equal(found.brdf, given.brdf) else 1.0
        ), 0.0

    for value in (0.0, -1.0, 5e-324, 1e-300, 0.1, 1.7976931348623157e308):
        yield Case("write_captures, read_truth", "numbers", f"{value:g}", answered(lambda v=value: kept(v)))
    for value in (math.inf, math.nan):
        yield Case("write_captures, read_truth", "numbers", f"{value:g}", refused(lambda v=value: kept(v)))
    for text in ("1e400", "-1e400", "NaN", "Infinity", '"1"', "true", "null", "[1]", "{}", "1" * 5000):

        def spoilt(t: str = text) -> object:
            with folder() as at:
                wm.write_captures(at / "set", small_set(np.ones((1, 2, 1))), truth=wm.Truth(
                    source=np.ones((3, 1)), theta_s=np.zeros(1), theta_o=np.zeros(1), brdf=np.ones(1)))  # fmt: skip
                path = at / "set" / "truth.json"
                table = json.loads(path.read_text())
                table["brdf"] = ["MARK"]
                path.write_text(json.dumps(table).replace('"MARK"', t))
                return wm.read_truth(at / "set")

        yield Case("read_truth", "a number", text[:12], refused(spoilt))


# -- scenes -----------------------------------------------------------------------------------------------------------


_SCENE: dict[str, dict[str, Any]] = {
    "": {"format": 1, "title": '"t"'},
    "wall": {
        "brdf": '"gaussian_train"',
        "centres_deg": "[0.0]",
        "sigma_deg": 5.0,
        "scale": 1.0,
        "half_width": 50.0,
        "half_height": 50.0,
        "diffuse_albedo": 0.1,
    },
    "observer": {"position": "[0.0, -5.0]", "fov_deg": 40.0, "view_angles_deg": "[5.0]", "pixels": 8},
    "card": {
        "elements_x": "[-0.5, 0.5]",
        "y": -1.0,
        "element_width": 0.02,
        "element_height": 0.03,
        "albedo": 0.1,
        "board_width": 2.0,
        "board_height": 1.0,
    },
    "source": {"level": 1.0, "realisations": 2, "seed": 1},
    "room": {"half_width": 10.0, "half_height": 10.0, "depth": 20.0, "albedo": 0.5},
    "render": {"max_depth": 4, "spp": 16, "rr_depth": 5},
}
_VALUES = (
    "0",
    "-1",
    "1e-300",
    "1e300",
    "-1e300",
    "inf",
    "-inf",
    "nan",
    "1e400",
    '"1"',
    "true",
    "[]",
    "{}",
    "[nan]",
    "1" * 400,
)


def scene_text(table: str, name: str, value: str) -> str:
    blocks = []
    for title, fields in _SCENE.items():
        given = {**fields, **({name: value} if title == table else {})}
        blocks.append("\n".join([*([f"[{title}]"] if title else []), *(f"{k} = {v}" for k, v in given.items())]))
    return "\n".join(blocks) + "\n"


def loaded(text: str) -> wm.Scene:
    with folder() as at:
        (at / "scene.toml").write_text(text)
        return wm.load_scene(at / "scene.toml")


def kept_value(scene: wm.Scene, table: str, name: str) -> Any:
    """What became of a field."""
    at = {
        "wall": scene.wall,
        "observer": scene.observer,
        "card": scene.card,
        "room": scene.room,
        "render": scene.render,
    }.get(table)
    if table == "wall" and name in ("sigma_deg", "scale"):
        (train, _) = scene.wall.brdf.parts  # type: ignore[attr-defined]
        return math.degrees(train.sigma) if name == "sigma_deg" else train.scale
    if table == "observer" and name == "fov_deg":
        return math.degrees(scene.observer.fov)
    return getattr(at, name, None)


def scene_cases() -> Iterator[Case]:
    for table, fields in _SCENE.items():
        for name, value in itertools.product(fields, _VALUES):

            def field(t: str = table, n: str = name, v: str = value) -> tuple[float, float]:
                scene = loaded(scene_text(t, n, v))  # refused, most of them
                # What is accepted must stand there as Python reads it, and make films without NaN or a warning, or refuse to.
                kept = kept_value(scene, t, n)
                if kept is not None and (
                    not isinstance(kept, (int, float)) or abs(kept - float(v)) > 1e-12 * abs(float(v))
                ):
                    raise RuntimeError(f"became {kept}")
                if not np.all(np.isfinite(scene.source)):
                    return math.nan, 0.0
                films = wm.radiance(wm.transport_matrix(scene.observer, scene.card, scene.wall.brdf), scene.source)
                return (math.nan if not np.all(np.isfinite(films)) else 0.0), 1.0

            yield Case("load_scene", f"{table}.{name}" if table else name, value[:12], field)


# -- single files -----------------------------------------------------------------------------------------------------


def single_file_cases() -> Iterator[Case]:
    def exr(values: Any, good: bool) -> Callable[[], tuple[float, float]]:
        def check() -> tuple[float, float]:
            with folder() as at:
                write_exr(at / "a.exr", {"Y": values})
                found = read_exr(at / "a.exr").channels["Y"]
            return (0.0 if np.array_equal(found, rounded(np.asarray(values)), equal_nan=True) else 1.0), 0.0

        return answered(check) if good else refused(check)

    for value in (0.0, -0.0, _DENORMAL, 1e-320, 3.4e38, math.inf, math.nan):
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
        yield Case("read_exr", "half float", f"{value:g}", answered(lambda v=value: half(v)))

    def mat(values: Any) -> tuple[float, float]:
        with folder() as at:
            scipy.io.savemat(at / "a.mat", {"g": values})
            found = read_matrices(at / "a.mat", ["g"])["g"]
        return (
            0.0 if np.array_equal(found, np.atleast_2d(np.asarray(values)).astype(np.float64), equal_nan=True) else 1.0
        ), 0.0

    for value in (0.0, 5e-324, 1e300, math.inf, math.nan):
        yield Case("read_matrices", "number", f"{value:g}", answered(lambda v=value: mat(np.full((2, 3), v))))
    for dtype in ("f4", "i1", "u1", "i2", "u2", "i4", "u4"):
        info: Any = np.finfo(dtype) if dtype == "f4" else np.iinfo(dtype)
        yield Case("read_matrices", "type", f"{np.dtype(dtype)}, its ends", answered(
            lambda d=dtype, i=info: mat(np.array([[i.min, i.max]], dtype=d))))  # fmt: skip
    for name, values in (
        ("complex", np.array([[1j]])),
        ("text", np.array(["abc"])),
        ("a cell", np.array([{}], dtype=object)),
        ("logical", np.array([[True]])),
    ):
        yield Case("read_matrices", "type", name, refused(lambda v=values: mat(v)))
    yield Case("read_matrices", "size", "0 x 0", lambda: mat(np.zeros((0, 0))))

    def npy(values: Any, *, pickled: bool = False) -> tuple[float, float]:
        with folder() as at:
            np.save(at / "a.npy", values, allow_pickle=pickled)
            found = read_table(at / "a.npy")
        return (0.0 if np.array_equal(found, np.asarray(values, dtype=np.float64), equal_nan=True) else 1.0), 0.0

    for value in (0.0, 5e-324, 1e300, math.inf, math.nan):
        yield Case("read_table, .npy", "number", f"{value:g}", answered(lambda v=value: npy(np.full((2, 3), v))))
    for dtype in ("f2", "f4", ">f8", "i1", "u8"):
        yield Case(
            "read_table, .npy", "type", str(np.dtype(dtype)), answered(lambda d=dtype: npy(np.ones((2, 2), dtype=d)))
        )
    for name, values in (
        ("complex", np.ones((2, 2), dtype=complex)),
        ("text", np.array(["a"])),
        ("no axis", np.array(1.0)),
        ("three axes", np.ones((2, 2, 2))),
        ("structured", np.zeros(2, dtype=[("a", "f8")])),
        ("bool", np.ones((2, 2), dtype=bool)),
    ):
        yield Case("read_table, .npy", "type", name, refused(lambda v=values: npy(v)))
    yield Case("read_table, .npy", "type", "a pickle", refused(lambda: npy(np.array([{}], dtype=object), pickled=True)))
    for text in ("", "\n", "a,b", "1,2\n3", "1e400", "1;2", "0x10", "1" * 5000):

        def csv(t: str = text) -> tuple[float, float]:
            with folder() as at:
                (at / "a.csv").write_text(t)
                found = read_table(at / "a.csv")
            return (0.0 if np.array_equal(found, [[float(t)]]) else 1.0), 0.0

        yield Case("read_table, .csv", "text", repr(text[:10]), csv)


def cases() -> Iterator[Case]:
    yield from capture_cases()
    yield from stored_field_cases()
    yield from truth_cases()
    yield from scene_cases()
    yield from single_file_cases()
