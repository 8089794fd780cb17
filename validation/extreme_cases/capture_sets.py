"""Capture sets: what is written reads back as the same numbers to float32's rounding; every field at its ends; the truth.

Reference: the numbers that were written, rounded by NumPy.
"""

from __future__ import annotations

import contextlib
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wallmirror as wm
from wallmirror.captures.writing import exact_degrees

from .harness import Case, must_answer, must_refuse
from .scenes import card, observer

Array = NDArray[np.float64]

LEAST = 2.0**-149  # the least float32


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def rounded(values: Array) -> Array:
    """The nearest float32, as float64."""
    with np.errstate(over="ignore", under="ignore"):
        return values.astype(np.float32).astype(np.float64)


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
        yield Case(entry, "radiance", f"{value:g}", must_answer(lambda v=value: round_trip(np.full((2, 3, 2), v))))
    for value in (1e-320, 1e-50, LEAST, 1e-38, 3.5e38, 1e300, -1e300, math.inf, math.nan):
        yield Case(entry, "radiance", f"{value:g}", must_refuse(lambda v=value: round_trip(np.full((2, 3, 2), v))))
    for value in (0.0, 1e-320, 1e-50, LEAST, 1.0, 3.4e38, math.inf):
        yield Case(entry, "variance", f"{value:g}", must_answer(
            lambda v=value: round_trip(np.ones((2, 3, 2)), np.full((2, 3, 2), v))))  # fmt: skip
    for value in (1e-46, 1e-40, 1e-320):
        yield Case(entry, "radiance 1e-20, variance", f"{value:g}", (must_refuse if value > 1e-60 else must_answer)(
            lambda v=value: round_trip(np.full((2, 3, 2), 1e-20), np.full((2, 3, 2), v))))  # fmt: skip
    for value in (3.5e38, 1e300, -1.0, math.nan):
        yield Case(entry, "variance", f"{value:g}", must_refuse(
            lambda v=value: round_trip(np.ones((2, 3, 2)), np.full((2, 3, 2), v))))  # fmt: skip
    for shape in ((1, 1, 1), (1, 2, 1), (1, 100_000, 1), (120, 2, 1), (1, 2, 120)):
        yield Case(entry, "views x pixels x realisations", "{} x {} x {}".format(*shape), must_answer(
            lambda s=shape: round_trip(np.random.default_rng(1).random(s))))  # fmt: skip
    for shape in ((1, 2, 0), (0, 2, 1), (1, 0, 1)):
        yield Case(entry, "views x pixels x realisations", "{} x {} x {}".format(*shape), must_refuse(
            lambda s=shape: round_trip(np.zeros(s))))  # fmt: skip
    rng = np.random.default_rng(2)
    films = np.ldexp(rng.standard_normal((2, 50, 3)), rng.integers(-170, 120, (2, 50, 3)))
    yield Case(entry, "radiance", "any floats", must_answer(lambda: round_trip(films)))

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
        yield Case(entry, "card's distance", f"{metres:g} m", lambda m=metres: geometry(
            {}, {"y": -m, "element_width": 0.0, "element_height": 0.0}))  # fmt: skip
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
            yield Case("read_captures", name, value, must_answer(lambda n=name, v=value: with_field(n, v)))
        for value in bad:
            yield Case("read_captures", name, value, must_refuse(lambda n=name, v=value: with_field(n, v)))


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
        yield Case("write_captures, read_truth", "numbers", f"{value:g}", must_answer(lambda v=value: kept(v)))
    for value in (math.inf, math.nan):
        yield Case("write_captures, read_truth", "numbers", f"{value:g}", must_refuse(lambda v=value: kept(v)))
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

        yield Case("read_truth", "a number", text[:12], must_refuse(spoilt))


def cases() -> Iterator[Case]:
    yield from capture_cases()
    yield from stored_field_cases()
    yield from truth_cases()
