"""Capture sets on disk: what a person writes by hand means one thing, and every fault has a name and a place."""

from __future__ import annotations

import math
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from wallmirror import exr
from wallmirror.captures import CaptureSet, Truth, read_captures, read_truth, write_captures, writing
from wallmirror.captures.writing import exact_degrees
from wallmirror.errors import InputError
from wallmirror.exr import read_exr, write_exr
from wallmirror.geometry import Card, Observer, scan_angles
from wallmirror.scene import Room, load_scene

VIEWS, PIXELS, REALISATIONS = 2, 6, 3

BY_HAND = """
format = 1
transport = "physical"
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
view_angles_deg = [15.0, -15.0]
pixels = 6
[card]
elements_x = [-2.5, -0.83, 0.83, 2.5]
y = -1.0
element_width = 0.02
element_height = 0.02
"""


def pixels(view: int, realisation: int) -> np.ndarray:
    """Six radiances that are exact in float32 and name their capture; one is negative, as a camera's noise may be."""
    return np.array([[-0.125, 1, 2, 3, 4, 5]], np.float32) + np.float32(8 * view + 64 * realisation)


def plain(path: Path, channels: dict[str, np.ndarray]) -> Path:
    """An EXR file as a camera's software writes it: no wallmirror attribute."""
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))
    return path


def name(view: int, realisation: int) -> str:
    return f"view{view:02d}_real{realisation:02d}.exr"


def pairs() -> list[tuple[int, int]]:
    return [(view, realisation) for view in range(VIEWS) for realisation in range(REALISATIONS)]


def entry(view: int, realisation: int, *, file: str | None = None, more: str = "") -> str:
    file = name(view, realisation) if file is None else file
    return f'[[captures]]\nfile = "{file}"\nview = {view}\nrealisation = {realisation}\n{more}\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A set made by hand: six files, without any attribute, and captures.toml."""
    folder = tmp_path / "set"
    folder.mkdir()
    for view, realisation in pairs():
        plain(folder / name(view, realisation), {"Y": pixels(view, realisation)})
    rewrite(folder)
    return folder


def rewrite(folder: Path, text: str = BY_HAND, *, more: str = "", entries: str | None = None) -> None:
    """Write captures.toml: `text`, then the captures, each with the lines `more`."""
    entries = "".join(entry(*pair, more=more) for pair in pairs()) if entries is None else entries
    (folder / "captures.toml").write_text(text + entries, encoding="utf-8")


def with_first(more: str) -> str:
    """All captures, the first with more lines."""
    return entry(0, 0, more=more) + "".join(entry(*pair) for pair in pairs()[1:])


def assert_refused(folder: Path, field: str, *parts: str) -> str:
    with pytest.raises(InputError) as caught:
        read_captures(folder)
    error = caught.value
    assert (error.file, error.field) == (str(folder / "captures.toml"), field)
    assert error.exit_code == 2
    assert "\n" not in str(error)
    for part in (str(folder / "captures.toml"), field, *parts):
        assert part in str(error)
    return error.message


def sample_set(*, seed: int = 0, **changes: Any) -> CaptureSet:
    """A set with float32 radiances, so that it comes back to the last bit."""
    rng = np.random.default_rng(seed)
    shape = (VIEWS, PIXELS, REALISATIONS)
    values: dict[str, Any] = {
        "observer": Observer(
            position=(0.1, -5.0), fov=math.radians(60), view_angles=(math.radians(16.1), -0.2), pixels=PIXELS
        ),
        "card": Card(elements_x=(-1 / 3, 0.83), y=-1.0, element_width=0.02, element_height=0.03, albedo=0.25),
        "radiance": rng.standard_normal(shape).astype(np.float32),
        "variance": rng.random(shape).astype(np.float32),
        "provenance": {"scene": "flat_wall_lobes", "depth of path": 'two "2" \\ \n\x7f ü', "camera": ""},
    }
    return CaptureSet(**{**values, **changes})


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# -- by hand --------------------------------------------------------------------------------------------------


def test_a_set_made_by_hand_loads(folder: Path) -> None:
    captures = read_captures(folder)
    assert captures.transport == "physical"
    assert captures.observer.view_angles == (math.radians(15), math.radians(-15))
    assert captures.observer.fov == math.radians(60)
    assert captures.observer.pixels_at == "centres"
    assert captures.card == Card(elements_x=(-2.5, -0.83, 0.83, 2.5), y=-1.0, element_width=0.02, element_height=0.02)
    assert captures.radiance.shape == (VIEWS, PIXELS, REALISATIONS)
    assert captures.radiance.dtype == np.float64
    for view, realisation in pairs():
        np.testing.assert_array_equal(captures.radiance[view, :, realisation], pixels(view, realisation)[0])
    assert captures.variance is None
    assert not captures.variance_is_floor
    assert captures.room is None
    assert captures.provenance == {}
    assert read_truth(folder) is None


def test_order_of_captures_and_views_by_scan_do_not_matter(folder: Path) -> None:
    expected = read_captures(folder)
    text = BY_HAND.replace("view_angles_deg = [15.0, -15.0]", "views = 2\nscan_deg = 90.0")
    rewrite(folder, text, entries="".join(entry(*pair) for pair in reversed(pairs())))
    again = read_captures(folder)
    np.testing.assert_array_equal(again.radiance, expected.radiance)
    assert again.observer.view_angles == scan_angles(2, scan=math.radians(90), fov=math.radians(60))


def test_room_provenance_and_card_are_read(folder: Path) -> None:
    text = BY_HAND + "albedo = 0.5\nboard_width = 0.3\nboard_height = 0.2\n"
    text += "[room]\nhalf_width = 6.0\nhalf_height = 3.0\ndepth = 8.0\nalbedo = 0.8\n"
    rewrite(folder, text + '[provenance]\ncamera = "X100"\n"bit depth" = "14"\n')
    captures = read_captures(folder)
    assert captures.room == Room(half_width=6, half_height=3, depth=8, albedo=0.8)
    assert (captures.card.albedo, captures.card.board_width, captures.card.board_height) == (0.5, 0.3, 0.2)
    assert captures.provenance == {"camera": "X100", "bit depth": "14"}


def test_exposure_divides_the_radiance(folder: Path) -> None:
    expected = read_captures(folder).radiance
    rewrite(folder, entries=with_first("exposure = 4.0"))
    radiance = read_captures(folder).radiance
    np.testing.assert_array_equal(radiance[0, :, 0], expected[0, :, 0] / 4)
    np.testing.assert_array_equal(radiance[1], expected[1])


@pytest.mark.parametrize("place", ["observer", "top", "capture"])
def test_channel_and_row_are_chosen(folder: Path, place: str) -> None:
    for view, realisation in pairs():
        tall = np.concatenate([pixels(view, realisation) + 1000 * row for row in range(5)])
        plain(folder / name(view, realisation), {"R": tall, "G": tall + 7, "B": tall + 9})
    lines = 'channel = "G"\nrow = 4\n'
    if place == "capture":
        rewrite(folder, more=lines)
    elif place == "top":
        rewrite(folder, lines + BY_HAND)
    else:
        rewrite(folder, BY_HAND.replace("pixels = 6\n", "pixels = 6\n" + lines))
    np.testing.assert_array_equal(read_captures(folder).radiance[1, :, 2], pixels(1, 2)[0] + 4007)
    rewrite(folder, 'channel = "G"\n' + BY_HAND)
    np.testing.assert_array_equal(read_captures(folder).radiance[1, :, 2], pixels(1, 2)[0] + 2007)  # the centre row


def test_colours_of_one_photograph_are_realisations(folder: Path) -> None:
    for view in range(VIEWS):
        plain(folder / f"photo{view}.exr", {c: pixels(view, b) for b, c in enumerate("RGB")})
    captures = [entry(v, b, file=f"photo{v}.exr", more=f'channel = "{"RGB"[b]}"') for v, b in pairs()]
    rewrite(folder, entries="".join(captures))
    for view, realisation in pairs():
        line = read_captures(folder).radiance[view, :, realisation]
        np.testing.assert_array_equal(line, pixels(view, realisation)[0])


def test_a_file_in_a_folder_of_its_own_is_inside(folder: Path) -> None:
    (folder / "raw").mkdir()
    (folder / name(0, 0)).rename(folder / "raw" / "first.exr")
    (folder / name(0, 1)).rename(folder / "raw" / "second.exr")
    (folder / name(0, 1)).symlink_to("raw/second.exr")
    rewrite(folder, entries=entry(0, 0, file="raw/first.exr") + "".join(entry(*pair) for pair in pairs()[1:]))
    np.testing.assert_array_equal(read_captures(folder).radiance[0, :, :2].T, [pixels(0, 0)[0], pixels(0, 1)[0]])


# -- variance, saturation, rounding ---------------------------------------------------------------------------


def rounding(values: np.ndarray, *, half: bool) -> np.ndarray:
    """Variance of a uniform error of half the distance of neighbouring numbers, bounded from above."""
    step, least = (2.0**-11, 2.0**-25) if half else (2.0**-24, 2.0**-150)
    return np.maximum(step * np.abs(values), least) ** 2 / 3


def test_variance_files_are_in_stored_units(folder: Path) -> None:
    for view, realisation in pairs():
        beside = np.array([[0, 0.25, 0.5, 1, 2, math.inf]], np.float32)
        plain(folder / f"v{view}{realisation}.exr", {"Y": beside})
    captures = "".join(entry(v, b, more=f'variance_file = "v{v}{b}.exr"\nexposure = 2.0') for v, b in pairs())
    rewrite(folder, entries=captures)
    result = read_captures(folder)
    assert result.variance is not None
    assert not result.variance_is_floor
    stored = pixels(1, 2)[0].astype(np.float64)
    expected = (np.array([0, 0.25, 0.5, 1, 2, math.inf]) + rounding(stored, half=False)) / 4
    np.testing.assert_allclose(result.variance[1, :, 2], expected, rtol=1e-15)
    np.testing.assert_array_equal(result.radiance[1, :, 2], stored / 2)


def test_saturated_pixels_carry_no_weight(folder: Path) -> None:
    rewrite(folder, entries=with_first("saturation = 4.0\nexposure = 0.5"))
    result = read_captures(folder)
    assert result.variance is not None
    assert result.variance_is_floor  # the noise itself was never stated
    saturated = np.isinf(result.variance)
    assert saturated.sum() == 2
    assert saturated[0, 4:, 0].all()  # pixels of 4 and 5, before exposure
    np.testing.assert_array_equal(result.radiance[0, :, 0], pixels(0, 0)[0] / 0.5)
    np.testing.assert_allclose(result.variance[1], rounding(result.radiance[1], half=False), rtol=1e-15)


def test_saturation_that_no_pixel_reaches_changes_nothing(folder: Path) -> None:
    rewrite(folder, more="saturation = 1e6")
    assert read_captures(folder).variance is None


def test_half_floats_bring_their_rounding(folder: Path) -> None:
    stored = np.array([[0, 1e-7, 0.1, -1.0, 1000.5, 60000]], np.float16)
    plain(folder / name(0, 0), {"Y": stored})
    result = read_captures(folder)
    assert result.variance is not None
    assert result.variance_is_floor
    np.testing.assert_array_equal(result.radiance[0, :, 0], stored[0])
    expected = rounding(stored[0].astype(np.float64), half=True)
    assert expected.min() == 2.0**-50 / 3  # zero, too, may have been rounded
    np.testing.assert_allclose(result.variance[0, :, 0], expected, rtol=1e-15)
    np.testing.assert_allclose(result.variance[1], rounding(result.radiance[1], half=False), rtol=1e-15)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3])
def test_the_rounding_variance_bounds_the_true_error(scale: float) -> None:
    exact = np.random.default_rng(0).uniform(0.5, 4, 100_000) * scale
    error = np.mean((exact.astype(np.float16) - exact) ** 2)
    stated = np.mean(rounding(exact, half=True))
    assert error < stated < 4 * error  # a step of 2^-11 |v| is at most twice the true one


# -- what is refused ------------------------------------------------------------------------------------------


def test_folder_or_file_that_is_not_there(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(InputError, match=re.escape(str(tmp_path / "absent"))) as caught:
        read_captures(tmp_path / "absent")
    assert caught.value.exit_code == 2
    (folder / name(1, 0)).unlink()
    assert_refused(folder, "captures[3].file", name(1, 0), "no such file")
    (folder / "captures.toml").unlink()
    with pytest.raises(InputError, match=r"captures\.toml: no such file"):
        read_captures(folder)


@pytest.mark.parametrize(
    ("old", "new", "field", "part"),
    [
        ("format = 1", "", "format", "missing"),
        ("format = 1", "format = 2", "format", "not 1"),
        ("format = 1", 'format = "1"', "format", "whole number"),
        ('"physical"', '"fysical"', "transport", "choose"),
        ('transport = "physical"', "", "transport", "missing"),
        ("transport", "transprot", "transport", "missing"),
        ("position = [0.0, -5.0]", "", "observer.position", "missing"),
        ("[0.0, -5.0]", "[0.0, -5.0, 1.0]", "observer.position", "give 2"),
        ("[0.0, -5.0]", "[0.0, 5.0]", "observer.position", "behind the wall"),
        ("[0.0, -5.0]", "[0.0, 0.0]", "observer.position", "on or behind"),
        ("[0.0, -5.0]", "[nan, -5.0]", "observer.position", "finite"),
        ("[0.0, -5.0]", f"[1{'0' * 400}, -5.0]", "observer.position", "finite"),
        ("fov_deg = 60.0", "fov_deg = 180.0", "observer.fov_deg", "180"),
        ("fov_deg = 60.0", "fov_deg = 0.0", "observer.fov_deg", "0"),
        ("fov_deg = 60.0", "fov_deg = inf", "observer.fov_deg", "finite"),
        ("fov_deg", "fov", "observer.fov_deg", "missing"),
        ("[15.0, -15.0]", "[15.0, -75.0]", "observer.view_angles_deg", "horizon"),
        ("[15.0, -15.0]", "[]", "observer.view_angles_deg", "no view"),
        ("pixels = 6", "pixels = 0", "observer.pixels", "from 1"),
        ("pixels = 6", "pixels = 6.5", "observer.pixels", "whole number"),
        ("pixels = 6", f"pixels = 0x{'f' * 5000}", "observer.pixels", "huge"),
        ("pixels = 6", 'pixels = 6\nchanel = "R"', "observer.chanel", 'did you mean "channel"'),
        ("pixels = 6", "pixels = 6\nrow = -1", "observer.row", "from 0"),
        ("pixels = 6", 'pixels = 6\npixels_at = "edge"', "observer.pixels_at", "edges"),
        ("y = -1.0", "y = 0.0", "card.y", "on or behind"),
        ("y = -1.0", "", "card.y", "missing"),
        ("element_height", "element_hight", "card.element_height", "both"),
        ("element_height = 0.02", "element_height = 0.02\nalbdo = 0.5", "card.albdo", 'did you mean "albedo"'),
        ("element_height = 0.02", "element_height = 0.02\nalbedo = 1.0", "card.albedo", "[0, 1)"),
        ("[card]", "[cord]", "card", "missing"),
        ("format = 1", 'format = 1\nchanel = "R"', "chanel", 'did you mean "channel"'),
        ("format = 1", "format = 1\nvariance_is_floor = 1", "variance_is_floor", "true or false"),
        ("format = 1", "format = 1\nvariance_is_floor = true", "variance_is_floor", "variance_file"),
        ("[card]", "[provenance]\nspp = 16\n[card]", "provenance.spp", "quotes"),
        ("[card]", "[room]\nhalf_width = 6.0\n[card]", "room.half_height", "missing"),
    ],
)  # fmt: skip
def test_faults_of_the_geometry(folder: Path, old: str, new: str, field: str, part: str) -> None:
    assert BY_HAND.count(old) >= 1
    rewrite(folder, BY_HAND.replace(old, new, 1))
    assert_refused(folder, field, part)


def test_a_room_must_hold_card_and_observer(folder: Path) -> None:
    rewrite(folder, BY_HAND + "[room]\nhalf_width = 6.0\nhalf_height = 3.0\ndepth = 4.0\nalbedo = 0.8\n")
    assert_refused(folder, "room.depth", "deeper")


@pytest.mark.parametrize(
    ("more", "field", "part"),
    [
        ("exposre = 2.0", "exposre", 'did you mean "exposure"'),
        ("saturaton = 2.0", "saturaton", 'did you mean "saturation"'),
        ('varience_file = "v.exr"', "varience_file", 'did you mean "variance_file"'),
        ("exposure = 0.0", "exposure", "from 1e-12"),
        ("exposure = -1.0", "exposure", "from 1e-12"),
        ("exposure = nan", "exposure", "finite"),
        ("exposure = 1e13", "exposure", "to 1e+12"),
        ("saturation = 0.0", "saturation", "above 0"),
        ("saturation = -1.0", "saturation", "from 0"),
        ("row = 1", "file", "no row 1"),
        ("row = 1.0", "row", "whole number"),
        ('channel = "R"', "file", 'no channel "R"; it holds: Y'),
        ("channel = 1", "channel", "quotes"),
        ('variance_file = "v.exr"', "variance_file", "for all or for none"),
    ],
)
def test_faults_of_a_capture(folder: Path, more: str, field: str, part: str) -> None:
    plain(folder / "v.exr", {"Y": np.ones((1, PIXELS), np.float32)})
    rewrite(folder, entries="".join(entry(*pair) for pair in pairs()[:-1]) + entry(1, 2, more=more))
    where = "captures[1]" if field == "variance_file" else "captures[5]"
    if field == "variance_file":  # the first capture without one is named
        rewrite(folder, entries=with_first(more))
    assert_refused(folder, f"{where}.{field}", part)


@pytest.mark.parametrize("missing", ["file", "view", "realisation"])
def test_a_field_missing_from_a_capture(folder: Path, missing: str) -> None:
    last = "\n".join(line for line in entry(1, 2).splitlines() if not line.startswith(missing))
    rewrite(folder, entries="".join(entry(*pair) for pair in pairs()[:-1]) + last)
    assert_refused(folder, f"captures[5].{missing}", "is missing")


@pytest.mark.parametrize("place", ["channel = 'Y'", "row = 0"])
def test_a_default_given_twice(folder: Path, place: str) -> None:
    rewrite(folder, place + BY_HAND.replace("pixels = 6", "pixels = 6\n" + place))
    assert_refused(folder, place.split()[0], "given twice")


def test_missing_and_doubled_pairs_are_named(folder: Path) -> None:
    rewrite(folder, entries="".join(entry(*pair) for pair in pairs() if pair != (1, 0)))
    assert "view 1, realisation 0 is missing;" in assert_refused(folder, "captures")
    rewrite(folder, entries=entry(0, 0) + entry(1, 2))
    assert "view 1, realisation 0 is missing (and 3 more)" in assert_refused(folder, "captures")
    rewrite(folder, entries=entry(0, 2_000_000_000))
    assert "view 0, realisation 0 is missing" in assert_refused(folder, "captures")  # at once, however many there are
    rewrite(folder, entries="".join(entry(*pair) for pair in pairs()) + entry(1, 1, file="copy.exr"))
    assert_refused(folder, "captures[6].realisation", "view 1, realisation 1", "captured twice", "captures[4]")
    rewrite(folder, entries=entry(0, 0) + entry(2, 0))
    assert_refused(folder, "captures[1].view", "from 0 to 1")
    rewrite(folder, entries="")
    assert_refused(folder, "captures", "missing")
    rewrite(folder, "captures = []\n" + BY_HAND, entries="")
    assert_refused(folder, "captures", "empty")


def test_the_same_pixels_cannot_be_two_captures(folder: Path) -> None:
    rewrite(folder, entries="".join(entry(*pair) for pair in pairs()[:-1]) + entry(1, 2, file=name(1, 1)))
    assert_refused(folder, "captures[5].file", name(1, 1), "captures[4]")


def test_another_width_names_both_sizes(folder: Path) -> None:
    plain(folder / name(1, 1), {"Y": np.ones((1, 7), np.float32)})
    assert_refused(folder, "captures[4].file", name(1, 1), "7 pixels wide", "observer.pixels is 6")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite(folder: Path, value: float) -> None:
    spoiled = pixels(0, 1)
    spoiled[0, 3] = value
    plain(folder / name(0, 1), {"Y": spoiled})
    assert_refused(folder, "captures[1].file", name(0, 1), f"{value:g} at pixel 3")


@pytest.mark.parametrize("value", [math.nan, -1.0, -math.inf])
def test_variances_that_are_none(folder: Path, value: float) -> None:
    for v, b in pairs():
        plain(folder / f"v{v}{b}.exr", {"Y": np.ones((1, PIXELS), np.float32)})
    rewrite(folder, entries="".join(entry(v, b, more=f'variance_file = "v{v}{b}.exr"') for v, b in pairs()))
    spoiled = np.ones((1, PIXELS), np.float32)
    spoiled[0, 2] = value
    plain(folder / "v10.exr", {"Y": spoiled})
    assert_refused(folder, "captures[3].variance_file", "v10.exr", f"{value:g} at pixel 2", "variances >= 0")
    plain(folder / "v10.exr", {"Y": np.ones((2, PIXELS), np.float32)})
    assert_refused(folder, "captures[3].variance_file", "v10.exr", "6 x 2", "6 x 1")
    (folder / "v10.exr").unlink()
    assert_refused(folder, "captures[3].variance_file", "v10.exr", "no such file")


def test_files_cut_short_or_no_exr_at_all(folder: Path) -> None:
    content = (folder / name(0, 1)).read_bytes()
    for length in range(0, len(content), 23):
        (folder / name(0, 1)).write_bytes(content[:length])
        assert_refused(folder, "captures[1].file", name(0, 1))
    (folder / name(0, 1)).write_text("not an image")
    assert_refused(folder, "captures[1].file", "not an EXR file")


def test_an_altered_pixel_is_refused_where_checksums_are(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / name(0, 1)
    write_exr(path, {"Y": pixels(0, 1)}, settings={"spp": 16})
    expected = read_captures(folder).radiance
    content = bytearray(path.read_bytes())
    content[-10] ^= 0x40
    path.write_bytes(content)
    assert_refused(folder, "captures[1].file", name(0, 1), "altered")
    # Fault twin: with the check off the spoiled pixel goes through.
    monkeypatch.setattr(exr, "_verified_settings", lambda *_: None)
    assert not np.array_equal(read_captures(folder).radiance, expected)


def test_paths_that_leave_the_folder(folder: Path, tmp_path: Path) -> None:
    outside = plain(tmp_path / "outside.exr", {"Y": pixels(0, 0)})
    (folder / "link.exr").symlink_to(outside)
    (folder / "up").symlink_to(tmp_path)
    (folder / "loop.exr").symlink_to("loop.exr")
    (tmp_path / "set2").mkdir()
    plain(tmp_path / "set2" / "a.exr", {"Y": pixels(0, 0)})
    names = ["../outside.exr", "link.exr", "up/outside.exr", "loop.exr", "../set2/a.exr", "raw/../../outside.exr"]
    for file in [*names, str(outside), str(folder / name(0, 0)), "", "a\\u0000b.exr"]:
        rewrite(folder, entries=entry(0, 0, file=file) + "".join(entry(*pair) for pair in pairs()[1:]))
        assert_refused(folder, "captures[0].file", "folder")
        rewrite(folder, entries=with_first(f'variance_file = "{file}"'))
        assert_refused(folder, "captures[0].variance_file", "folder")
    for file in ("raw", "."):
        (folder / "raw").mkdir(exist_ok=True)
        rewrite(folder, entries=entry(0, 0, file=file) + "".join(entry(*pair) for pair in pairs()[1:]))
        assert_refused(folder, "captures[0].file", "is not a file")


@pytest.mark.parametrize("text", [b"format = ", b"\xff\xfe", b"a = " + b"1" * 5000, b"a = " + b"[" * 100_000])
def test_what_is_no_toml(folder: Path, text: bytes) -> None:
    (folder / "captures.toml").write_bytes(text)
    with pytest.raises(InputError) as caught:
        read_captures(folder)
    assert caught.value.file == str(folder / "captures.toml")


@pytest.mark.parametrize("entries", ["captures = 1\n", "captures = [1]\n", "[captures]\nfile = 'a'\n"])
def test_captures_that_are_no_list_of_tables(folder: Path, entries: str) -> None:
    inline = not entries.startswith("[")
    rewrite(folder, entries + BY_HAND if inline else BY_HAND, entries="" if inline else entries)
    assert_refused(folder, "captures", "[[captures]]")


# -- there and back -------------------------------------------------------------------------------------------


def test_a_set_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    room = Room(half_width=6.0, half_height=3.0, depth=8.0, albedo=1 / 3)
    before = sample_set(room=room, transport="cosine")
    write_captures(tmp_path / "set", before, settings={"spp": 2**40, "seeds": [1, 2]})
    after = read_captures(tmp_path / "set")
    np.testing.assert_array_equal(after.radiance, before.radiance)
    assert after.card == before.card
    assert after.room == room
    assert after.transport == "cosine"
    assert after.provenance == before.provenance
    assert after.observer.fov == before.observer.fov
    assert after.observer.view_angles[0] == before.observer.view_angles[0]
    np.testing.assert_array_max_ulp(after.observer.view_angles[1], before.observer.view_angles[1], 1)
    assert before.variance is not None
    assert after.variance is not None
    expected = before.variance + rounding(before.radiance, half=False)
    np.testing.assert_allclose(after.variance, expected, rtol=1e-15)
    assert not after.variance_is_floor
    assert read_exr(tmp_path / "set" / name(1, 2)).settings == {
        "spp": 2**40, "seeds": [1, 2], "view": 1, "realisation": 2, "holds": "radiance"
    }  # fmt: skip
    assert sorted(p.name for p in tmp_path.iterdir()) == ["set"]


def test_a_set_without_variance_stays_without(tmp_path: Path) -> None:
    write_captures(tmp_path / "set", sample_set(variance=None))
    assert read_captures(tmp_path / "set").variance is None
    assert len(list((tmp_path / "set").iterdir())) == 1 + VIEWS * REALISATIONS


def test_what_is_known_of_the_noise_comes_back(folder: Path, tmp_path: Path) -> None:
    """Saturated pixels and the rounding of half floats outlive a second writing, and stay a floor."""
    plain(folder / name(0, 0), {"Y": pixels(0, 0).astype(np.float16)})
    rewrite(folder, entries=with_first("saturation = 4.0"))
    first = read_captures(folder)
    write_captures(tmp_path / "copy", first)
    second = read_captures(tmp_path / "copy")
    assert first.variance is not None
    assert second.variance is not None
    assert second.variance_is_floor
    np.testing.assert_array_equal(np.isinf(second.variance), np.isinf(first.variance))
    # The copy's own rounding doubles that of its float32 pixels.
    assert np.all(second.variance >= first.variance * (1 - 1e-6))
    assert np.all(second.variance <= first.variance * (2 + 1e-6))


def test_angles_of_every_scene_come_back(tmp_path: Path) -> None:
    scene = load_scene("flat_wall_lobes")
    angles = (*scene.observer.view_angles, *(math.radians(k / 10) for k in range(-590, 600)))
    back = [math.radians(exact_degrees(angle)) for angle in angles]
    np.testing.assert_array_max_ulp(np.array(back), np.array(angles), 1)
    decimal = [k / 10 for k in range(-590, 600)]
    assert [exact_degrees(math.radians(degrees)) for degrees in decimal] == decimal


def test_awkward_numbers_come_back(tmp_path: Path) -> None:
    card = Card(elements_x=(-1e16, 5e-324, 0.1 + 0.2), y=-1e-99)
    write_captures(tmp_path / "set", sample_set(card=card))
    assert read_captures(tmp_path / "set").card == card


def test_points_from_edge_to_edge_come_back(tmp_path: Path) -> None:
    observer = Observer(position=(0, -5), fov=1.0, view_angles=(0.1, -0.1), pixels=PIXELS, pixels_at="edges")
    write_captures(tmp_path / "set", sample_set(observer=observer, transport="thesis"))
    assert read_captures(tmp_path / "set").observer.pixels_at == "edges"


def test_more_than_a_hundred_realisations(tmp_path: Path) -> None:
    radiance = np.arange(VIEWS * PIXELS * 101, dtype=np.float32).reshape(VIEWS, PIXELS, 101)
    write_captures(tmp_path / "set", sample_set(radiance=radiance, variance=None))
    np.testing.assert_array_equal(read_captures(tmp_path / "set").radiance, radiance)
    write_captures(tmp_path / "set", sample_set())  # its own names are recognised
    assert read_captures(tmp_path / "set").realisations == REALISATIONS


def truth(**changes: Any) -> Truth:
    u = np.radians(np.linspace(-90, 90, 7))
    values: dict[str, Any] = {"source": np.full((2, 3), 1 / 3), "theta_s": u, "theta_o": 0 * u, "brdf": np.cos(u)}
    return Truth(**{**values, **changes})


def test_the_truth_travels_beside(tmp_path: Path) -> None:
    write_captures(tmp_path / "set", sample_set(), truth=truth())
    back = read_truth(tmp_path / "set")
    assert back is not None
    np.testing.assert_array_equal(back.source, truth().source)
    np.testing.assert_array_equal(back.brdf, truth().brdf)
    np.testing.assert_allclose(back.angle_sum, truth().angle_sum, rtol=1e-15)
    read_captures(tmp_path / "set")
    write_captures(tmp_path / "set", sample_set())
    assert read_truth(tmp_path / "set") is None  # the old truth went with the old set
    mirror = truth(theta_s=np.empty(0), theta_o=np.empty(0), brdf=np.empty(0))
    write_captures(tmp_path / "set", sample_set(), truth=mirror)
    assert read_truth(tmp_path / "set") is not None


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"format": 2}', '{"format": 1}', "[" * 100_000,
     '{"format": 1, "source": [[1], [1, 2]], "theta_s_deg": [], "theta_o_deg": [], "brdf": []}',
     '{"format": 1, "source": [["1"]], "theta_s_deg": [], "theta_o_deg": [], "brdf": []}',
     '{"format": 1, "source": [1], "theta_s_deg": [], "theta_o_deg": [], "brdf": []}',
     '{"format": 1, "source": [[NaN]], "theta_s_deg": [], "theta_o_deg": [], "brdf": []}',
     '{"format": 1, "source": [[1]], "theta_s_deg": [0], "theta_o_deg": [], "brdf": []}'],
)  # fmt: skip
def test_a_malformed_truth_is_refused_but_the_set_still_loads(folder: Path, text: str) -> None:
    (folder / "truth.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_truth(folder)
    assert caught.value.file == str(folder / "truth.json")
    read_captures(folder)


# -- writing spares what is there -----------------------------------------------------------------------------


def refuse_to_write(folder: Path, match: str, captures: CaptureSet | None = None, **options: Any) -> None:
    before = snapshot(folder) if folder.is_dir() else None
    siblings = sorted(folder.parent.iterdir())
    with pytest.raises(InputError, match=match) as caught:
        write_captures(folder, captures or sample_set(), **options)
    assert caught.value.exit_code == 2
    assert (snapshot(folder) if folder.is_dir() else None) == before
    assert sorted(folder.parent.iterdir()) == siblings


def test_an_earlier_set_is_replaced_whole(tmp_path: Path) -> None:
    wide = sample_set(radiance=np.ones((VIEWS, PIXELS, 5)), variance=None)
    write_captures(tmp_path / "set", wide)
    write_captures(tmp_path / "set", sample_set())
    assert read_captures(tmp_path / "set").realisations == REALISATIONS
    assert not (tmp_path / "set" / name(0, 4)).exists()
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_new_nested_and_empty_folders_are_filled(tmp_path: Path) -> None:
    write_captures(tmp_path / "a" / "b" / "set", sample_set())
    assert read_captures(tmp_path / "a" / "b" / "set").realisations == REALISATIONS
    (tmp_path / "empty").mkdir()
    write_captures(tmp_path / "empty", sample_set())
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    write_captures(tmp_path / "link", sample_set(seed=1))
    assert (tmp_path / "link").is_symlink()
    np.testing.assert_array_equal(read_captures(tmp_path / "empty").radiance, sample_set(seed=1).radiance)


def test_folders_with_anything_else_are_left_alone(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    refuse_to_write(tmp_path / "thesis", "chapter1.tex")
    (tmp_path / "file").write_text("a file")
    refuse_to_write(tmp_path / "file", "is a file")
    refuse_to_write(folder, "captures.toml")  # made by hand: these photographs cannot be rendered again
    write_captures(tmp_path / "mine", sample_set())
    (tmp_path / "mine" / "notes.txt").write_text("keep me")
    refuse_to_write(tmp_path / "mine", "notes.txt")
    (tmp_path / "mine" / "notes.txt").unlink()
    (tmp_path / "mine" / "captures.toml").unlink()
    refuse_to_write(tmp_path / "mine", re.escape(name(0, 0)))


def test_values_that_no_file_can_hold_leave_the_earlier_set(tmp_path: Path) -> None:
    write_captures(tmp_path / "set", sample_set())
    huge = np.ones((VIEWS, PIXELS, REALISATIONS))
    huge[1, 2, 2] = 1e39
    refuse_to_write(tmp_path / "set", re.escape(name(1, 2)), sample_set(radiance=huge))
    refuse_to_write(tmp_path / "set", r"_variance\.exr", sample_set(variance=huge))
    refuse_to_write(tmp_path / "set", r"truth\.source", truth=truth(source=np.ones((3, 3))))


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("stage", ["write_exr", "_toml", "_truth_json"])
def test_an_interrupted_write_leaves_the_earlier_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, stage: str
) -> None:
    write_captures(tmp_path / "set", sample_set())
    before = snapshot(tmp_path / "set")
    genuine = getattr(writing, stage)
    calls = []

    def fail_in_the_middle(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        if stage == "write_exr" and len(calls) < 4:
            return genuine(*arguments, **options)
        raise failure

    monkeypatch.setattr(writing, stage, fail_in_the_middle)
    with pytest.raises((InputError, KeyboardInterrupt)):
        write_captures(tmp_path / "set", sample_set(seed=1), truth=truth())
    assert calls
    assert snapshot(tmp_path / "set") == before
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_swap_that_fails_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    write_captures(tmp_path / "set", sample_set())
    before = snapshot(tmp_path / "set")
    genuine = Path.rename
    calls = []

    def rename(self: Path, target: Path) -> Path:
        calls.append(target)
        if len(calls) == failing:
            raise OSError(13, "Permission denied")
        return genuine(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(InputError, match="Permission denied"):
        write_captures(tmp_path / "set", sample_set(seed=1))
    assert snapshot(tmp_path / "set") == before
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_the_written_file_is_plain_toml(tmp_path: Path) -> None:
    write_captures(tmp_path / "set", sample_set())
    table = tomllib.loads((tmp_path / "set" / "captures.toml").read_text(encoding="utf-8"))
    assert table["format"] == 1
    assert table["observer"]["view_angles_deg"][0] == 16.1
    assert table["captures"][0] == {
        "file": name(0, 0), "view": 0, "realisation": 0, "variance_file": "view00_real00_variance.exr"
    }  # fmt: skip
    umask = os.umask(0)
    os.umask(umask)
    assert (tmp_path / "set").stat().st_mode & 0o777 == 0o777 & ~umask


# -- the type itself ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"radiance": np.ones((VIEWS, PIXELS))}, "radiance"),
        ({"radiance": np.ones((VIEWS, PIXELS + 1, 2))}, "radiance"),
        ({"radiance": np.ones((VIEWS, PIXELS, 0))}, "radiance"),
        ({"radiance": np.full((VIEWS, PIXELS, REALISATIONS), np.nan)}, "radiance"),
        ({"variance": np.ones((VIEWS, PIXELS, 1))}, "variance"),
        ({"variance": np.full((VIEWS, PIXELS, REALISATIONS), -1.0)}, "variance"),
        ({"variance": np.full((VIEWS, PIXELS, REALISATIONS), np.nan)}, "variance"),
        ({"variance": None, "variance_is_floor": True}, "variance_is_floor"),
        ({"transport": "full"}, "transport"),
        ({"provenance": {"spp": 16}}, "provenance.spp"),
        ({"room": Room(half_width=1.0, half_height=1.0, depth=2.0, albedo=0.5)}, "room.depth"),
    ],
)
def test_a_capture_set_checks_itself(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        sample_set(**changes)
    assert caught.value.field == field


def test_a_capture_set_cannot_be_changed() -> None:
    radiance = np.ones((VIEWS, PIXELS, REALISATIONS))
    captures = sample_set(radiance=radiance)
    radiance[:] = 7
    assert captures.radiance.max() == 1
    with pytest.raises(ValueError, match="read-only"):
        captures.radiance[0, 0, 0] = 2
