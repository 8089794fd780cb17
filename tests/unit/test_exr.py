"""EXR in and out: exact where it succeeds, one sentence where it does not, and never a silently wrong pixel."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from wallmirror import exr
from wallmirror.errors import InputError
from wallmirror.exr import read_exr, write_exr

SETTINGS = {"spp": 2**40, "sigma": 0.1 + 0.2, "seeds": [1, 2], "name": 'grün "q" \\ \n', "none": None, "yes": True}


def noise(rows: int = 1, columns: int = 500, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((rows, columns)).astype(np.float32)


def plain(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    """A file as any other program writes it: no wallmirror attribute."""
    header = {"type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def refused(path: Path, **options: int) -> str:
    with pytest.raises(InputError) as caught:
        read_exr(path, **options)
    assert caught.value.file == str(path)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    return caught.value.message


# -- what comes back ------------------------------------------------------------------------------------------


def test_pixels_and_settings_come_back_exactly(tmp_path: Path) -> None:
    channels = {"Y": noise(3), "R": noise(3, seed=1), "G": noise(3, seed=2), "B": noise(3, seed=3)}
    write_exr(tmp_path / "a.exr", channels, settings=SETTINGS)
    image = read_exr(tmp_path / "a.exr")
    assert image.shape == (3, 500)
    assert image.settings == SETTINGS
    assert image.half == dict.fromkeys(channels, False)
    assert set(image.channels) == set(channels)
    for name, values in channels.items():
        np.testing.assert_array_equal(image.channels[name].view(np.uint32), values.view(np.uint32))


def test_extremes_of_float32_survive(tmp_path: Path) -> None:
    values = np.array([[0.0, -0.0, 1e-45, 1e-38, 3.4e38, -3.4e38, math.inf, -math.inf, math.nan]], np.float32)
    write_exr(tmp_path / "a.exr", {"Y": values})
    back = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back.channels["Y"].view(np.uint32), values.view(np.uint32))
    assert back.settings is None


@pytest.mark.parametrize("order", ["fortran", "strided", "float64", "reversed"])
def test_memory_order_does_not_matter(tmp_path: Path, order: str) -> None:
    values = noise(4, 6)
    given = {
        "fortran": np.asfortranarray(values),
        "strided": np.repeat(values, 2, axis=1)[:, ::2],
        "float64": values.astype(np.float64),
        "reversed": values[::-1, ::-1].copy()[::-1, ::-1],
    }[order]
    write_exr(tmp_path / "a.exr", {"Y": given})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr").channels["Y"], values)


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, {"Y": noise()}, settings=SETTINGS)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_half_floats_are_read_and_marked(tmp_path: Path) -> None:
    half = noise().astype(np.float16)
    image = read_exr(plain(tmp_path / "a.exr", {"Y": half, "Z": noise(), "id": np.ones((1, 500), np.uint32)}))
    assert image.half == {"Y": True, "Z": False}  # whole numbers are no radiances
    np.testing.assert_array_equal(image.channels["Y"], half.astype(np.float32))
    assert image.settings is None


def test_colours_are_read_one_by_one(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).random((2, 3, 3)).astype(np.float32)
    image = read_exr(plain(tmp_path / "a.exr", {"RGB": rgb}))
    for k, name in enumerate("RGB"):
        np.testing.assert_array_equal(image.channels[name], rgb[..., k])


def test_tiled_files_are_read(tmp_path: Path) -> None:
    values = noise(9)
    path = plain(tmp_path / "a.exr", {"Y": values}, type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription())
    np.testing.assert_array_equal(read_exr(path).channels["Y"], values)


# -- damage ---------------------------------------------------------------------------------------------------


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    write_exr(tmp_path / "sound.exr", {"Y": noise()}, settings=SETTINGS)
    return tmp_path / "sound.exr"


def pixel_start(content: bytes) -> int:
    """Where a one-chunk file's pixels begin: behind the chunk's row number and length."""
    return len(content) - 500 * 4


def flipped(path: Path, at: int, mask: int = 0x10) -> Path:
    content = bytearray(path.read_bytes())
    content[at] ^= mask
    other = path.with_name("flipped.exr")
    other.write_bytes(content)
    return other


def test_every_flip_in_the_pixels_is_refused(sound: Path) -> None:
    content = sound.read_bytes()
    start = pixel_start(content)
    for at in (*range(start, len(content), 97), len(content) - 1):
        assert "do not match their checksum" in refused(flipped(sound, at))


def test_flips_in_compressed_pixels_are_refused(tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 20 * 500, dtype=np.float32).reshape(20, 500)
    write_exr(tmp_path / "a.exr", {"Y": np.round(ramp, 3)})
    content = (tmp_path / "a.exr").read_bytes()
    assert len(content) < ramp.nbytes / 2  # it is compressed
    for at in range(len(content) - 2000, len(content), 61):
        refused(flipped(tmp_path / "a.exr", at))


def test_it_is_the_checksum_that_catches_flipped_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fault twin: without the check OpenEXR alone lets twelve flips of twelve pass."""
    monkeypatch.setattr(exr, "_pixel_digest", lambda pixels: "same")
    write_exr(tmp_path / "a.exr", {"Y": noise()}, settings=SETTINGS)
    size = len((tmp_path / "a.exr").read_bytes())
    silent = [
        not np.array_equal(read_exr(flipped(tmp_path / "a.exr", at)).channels["Y"], noise())
        for at in range(size - 1990, size, 170)
    ]
    assert silent == [True] * 12


def test_a_flip_anywhere_is_refused_or_changes_no_pixel(sound: Path) -> None:
    """In the header too; a flip in the attribute's own name loses the settings, never a pixel."""
    content = sound.read_bytes()
    value = range(content.index(b'{"settings"'), content.index(b"}", content.index(b'"settings_sha256"')))
    harmless = 0
    for at in range(pixel_start(content)):
        path = flipped(sound, at, mask=1 << (at % 8))
        try:
            image = read_exr(path)
        except InputError:
            refused(path)
            continue
        harmless += at in value
        assert list(image.half) == ["Y"]
        assert image.settings == SETTINGS or (image.settings is None and at not in value)
        np.testing.assert_array_equal(image.channels["Y"], noise())
    assert harmless <= 2  # \u00fc may be written \u00Fc


def test_a_file_cut_short_is_refused_at_every_length(sound: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = sound.read_bytes()
    short = sound.with_name("short.exr")
    for length in (*range(0, len(content), 37), len(content) - 1):
        short.write_bytes(content[:length])
        refused(short)
    assert capsys.readouterr().out == ""  # OpenEXR's own complaints would spoil --json


def test_a_file_without_checksums_cut_short_is_refused(tmp_path: Path) -> None:
    content = plain(tmp_path / "a.exr", {"Y": noise(40)}).read_bytes()
    short = tmp_path / "short.exr"
    for length in range(0, len(content), 997):
        short.write_bytes(content[:length])
        refused(short)


def test_bytes_inserted_or_lost_are_refused_or_change_no_pixel(sound: Path) -> None:
    content = sound.read_bytes()
    rng = np.random.default_rng(0)
    other = sound.with_name("other.exr")
    for _ in range(200):
        at = int(rng.integers(len(content)))
        middle = rng.bytes(4) if rng.random() < 0.5 else b""
        other.write_bytes(content[:at] + middle + content[at + 4 * (not middle) :])
        try:
            image = read_exr(other)
        except InputError:
            continue
        np.testing.assert_array_equal(image.channels["Y"], noise())


@pytest.mark.parametrize(
    "attribute",
    [
        "",
        "{",
        "[]",
        "null",
        "7",
        "{}",
        '{"settings": 1}',
        "[" * 100_000,
        '{"settings":[1],"sha256":{},"settings_sha256":""}',
    ],
)
def test_a_malformed_attribute_is_refused(tmp_path: Path, attribute: str) -> None:
    assert "was altered" in refused(plain(tmp_path / "a.exr", {"Y": noise()}, wallmirror=attribute))


def test_settings_that_are_no_table_are_refused(tmp_path: Path) -> None:
    attribute = exr._attribute({"Y": noise()}, {"a": 1})
    good = plain(tmp_path / "a.exr", {"Y": noise()}, wallmirror=attribute)
    assert read_exr(good).settings == {"a": 1}
    parts = json.loads(attribute)
    parts.update(settings=[1], settings_sha256=exr._settings_digest([1]))
    assert "no table" in refused(plain(tmp_path / "a.exr", {"Y": noise()}, wallmirror=json.dumps(parts)))


def test_an_attribute_of_another_type_is_refused(tmp_path: Path) -> None:
    assert "was altered" in refused(plain(tmp_path / "a.exr", {"Y": noise()}, wallmirror=1.5))


def test_channels_added_or_lost_are_noticed(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"Y": noise(), "Z": noise(seed=1)})
    with OpenEXR.File(str(tmp_path / "a.exr"), header_only=True) as file:
        attribute = file.header()["wallmirror"]
    assert "was altered" in refused(plain(tmp_path / "lost.exr", {"Y": noise()}, wallmirror=attribute))
    three = {"Y": noise(), "Z": noise(seed=1), "X": noise()}
    assert "channel X" in refused(plain(tmp_path / "added.exr", three, wallmirror=attribute))


# -- what is no image -----------------------------------------------------------------------------------------


def test_what_is_no_exr_file_is_named(tmp_path: Path) -> None:
    assert refused(tmp_path / "absent.exr") == "no such file"
    assert refused(tmp_path) == "is not a file"
    (tmp_path / "empty.exr").touch()
    assert refused(tmp_path / "empty.exr") == "is empty"
    (tmp_path / "a.exr").write_text("P6 500 1 255")
    assert refused(tmp_path / "a.exr") == "is not an EXR file"


def test_too_large_an_image_is_refused_by_its_header(tmp_path: Path) -> None:
    path = plain(tmp_path / "a.exr", {"Y": noise(), "Z": noise()})
    assert "500 x 1 pixels in 2 channels" in refused(path, max_pixels=999)
    assert read_exr(path, max_pixels=1000).shape == (1, 500)
    content = bytearray(path.read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[at + 8 : at + 16] = b"\xff\xff\xff\x6f" * 2
    path.write_bytes(content)
    refused(path)  # 3.5e18 pixels: refused at once, nothing is allocated


def test_several_images_are_refused(tmp_path: Path) -> None:
    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage, "name": name}, {"Y": noise()}) for name in "ab"]
    OpenEXR.File(parts).write(str(tmp_path / "two.exr"))
    assert "2 images" in refused(tmp_path / "two.exr")


def test_deep_images_are_refused(tmp_path: Path) -> None:
    deep = np.empty((1, 2), dtype=object)
    deep[0, 0], deep[0, 1] = np.ones(3, np.float32), np.ones(1, np.float32)
    kind = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    assert "deep" in refused(plain(tmp_path / "a.exr", {"Y": deep}, **kind))


@pytest.mark.parametrize("sampling", [b"\2\0\0\0\1\0\0\0", b"\1\0\0\0\2\0\0\0"])
def test_channels_at_reduced_resolution_are_refused(tmp_path: Path, sampling: bytes) -> None:
    content = plain(tmp_path / "a.exr", {"Y": noise(2)}).read_bytes()
    at = content.index(b"chlist\0") + len(b"chlist\0") + 4 + len(b"Y\0") + 8
    assert content[at : at + 8] == b"\1\0\0\0" * 2
    (tmp_path / "a.exr").write_bytes(content[:at] + sampling + content[at + 8 :])
    assert "reduced resolution" in refused(tmp_path / "a.exr")


def test_a_file_of_whole_numbers_is_refused(tmp_path: Path) -> None:
    assert "no channel of floats" in refused(plain(tmp_path / "a.exr", {"Y": np.ones((1, 4), np.uint32)}))


# -- writing --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("channels", "field"),
    [
        ({}, None),
        ({"Y": np.ones((1, 3)), "Z": np.ones((1, 4))}, None),
        ({"": np.ones((1, 3))}, None),
        ({"Y": np.ones(3)}, "Y"),
        ({"Y": np.ones((0, 3))}, "Y"),
        ({"Y": np.array([[1.0, 1e39]])}, "Y"),
    ],
)
def test_what_no_file_can_hold_is_refused_untouched(
    tmp_path: Path, channels: dict[str, np.ndarray], field: str | None
) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": noise()})
    before = path.read_bytes()
    with pytest.raises(InputError) as caught:
        write_exr(path, channels)
    assert (caught.value.file, caught.value.field) == (str(path), field)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_settings_that_json_cannot_hold_leave_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_exr(tmp_path / "a.exr", {"Y": noise()}, settings={"x": math.nan})
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_exr(tmp_path / "absent" / "a.exr", {"Y": noise()})


def test_a_full_disk_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenEXR reports no error when the disk is full; reading back does."""

    class FullDisk:
        def __init__(self, *arguments: object, **options: object) -> None:
            self.file = genuine(*arguments, **options)

        def __enter__(self) -> FullDisk:
            return self

        def __exit__(self, *_: object) -> None:
            self.file.__exit__(None, None, None)

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

        def write(self, path: str) -> None:
            self.file.write(path)
            Path(path).write_bytes(Path(path).read_bytes()[:-100])

    genuine = OpenEXR.File
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": noise()})
    before = path.read_bytes()
    monkeypatch.setattr(OpenEXR, "File", FullDisk)
    with pytest.raises(InputError, match="room on the disk"):
        write_exr(path, {"Y": noise(seed=1)})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_an_interrupted_write_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": noise()})
    before = path.read_bytes()

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(exr, "read_exr", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_exr(path, {"Y": noise(seed=1)})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
