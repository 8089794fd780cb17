"""Hostile files: no crash, no hang, no memory without bound, no wrong pixel; and each guard's planted twin.

The inputs are those of validation/fuzz_files.py, of which the recorded run tries 28,000 and this module a few hundred.
"""

from __future__ import annotations

import importlib
import io
import os
import struct
import sys
import tomllib
import tracemalloc
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wallmirror import exr, exr_header, limits, load_scene, read_captures, read_truth
from wallmirror import toml as bounded_toml
from wallmirror.errors import InputError, shown
from wallmirror.exr import read_exr
from wallmirror.picture_reading import load_picture

from .helpers import refused

_VALIDATION = Path(__file__).parents[2] / "validation"


@pytest.fixture(scope="module")
def fuzz() -> Any:
    sys.path.insert(0, str(_VALIDATION))
    try:
        return importlib.import_module("fuzz_files")
    finally:
        sys.path.remove(str(_VALIDATION))


def outcomes(fuzz: Any, kind: str, numbers: range, folder: Path) -> dict[int, str]:
    return {number: fuzz.try_input(kind, number, folder)[0] for number in numbers}


# -- the fuzzing run in small -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "count"), [("exr", 400), ("captures", 100), ("scene", 100), ("picture", 60), ("truth", 60), ("mat", 80)]
)
def test_hostile_inputs_are_refused_or_read_right(fuzz: Any, tmp_path: Path, kind: str, count: int) -> None:
    found = outcomes(fuzz, kind, range(count), tmp_path)
    assert {n: outcome for n, outcome in found.items() if outcome not in fuzz.GOOD} == {}
    counts = Counter(found.values())
    assert counts["refused"] > count / 4
    assert counts["same"] + counts["another"] > 0


def test_without_the_checksums_wrong_pixels_would_be_seen(
    fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exr, "_verified_settings", lambda *_: None)
    assert Counter(outcomes(fuzz, "exr", range(400), tmp_path).values())["silent"] >= 5


def test_without_the_table_of_chunks_guessed_pixels_would_be_seen(
    fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exr, "require_sound_chunks", lambda *_: None)
    assert "silent" in outcomes(fuzz, "exr", range(400), tmp_path).values()


def test_a_reader_that_breaks_is_found_out(fuzz: Any, tmp_path: Path) -> None:
    def judged(error: BaseException | None, verdict: str = "silent") -> str:
        def read(_: Path) -> None:
            if error is not None:
                raise error

        return fuzz.judged(tmp_path / "a", "", b"", read, lambda _: verdict)[0]

    here = str(tmp_path / "a")
    assert judged(ValueError("a bug")) == "traceback"
    assert judged(MemoryError()) == "memory"
    assert judged(InputError("is wrong")) == "unclear"  # names no file
    assert judged(InputError("is wrong\nand more", file=here)) == "unclear"
    assert judged(InputError("x" * 5000, file=here)) == "unclear"
    assert judged(InputError("is wrong", file=here)) == "refused"
    assert judged(None) == "silent"
    rows = [
        {"kind": "exr", "number": 0, "outcome": o, "mutation": "", "seconds": 1.0, "peak": 1} for o in ("same", "hang")
    ]
    assert fuzz.summary(rows)["hangs"] == 1
    assert len(fuzz.summary(rows)["faults"]) == 1


@pytest.mark.parametrize(
    ("end", "outcome"),
    [("os.kill(os.getpid(), 11)", "crash"), ("os._exit(0)", "crash"), ("time.sleep(60)", "hang")],
)
def test_processes_that_die_or_hang_are_found_out_and_replaced(fuzz: Any, end: str, outcome: str) -> None:
    program = (
        "import os, sys, time; print('ready', flush=True)\n"
        "for line in sys.stdin:\n"
        f"    if line == 'exr 2\\n': {end}\n"
        '    print(\'["same", "", "", 0.0, 1]\', flush=True)'
    )
    worker = fuzz.Worker([sys.executable, "-S", "-c", program], seconds=1.0)
    try:
        assert [worker("exr", n)["outcome"] for n in range(4)] == ["same", "same", outcome, "same"]
    finally:
        worker.close()


def test_the_real_process_works_under_its_limits(fuzz: Any) -> None:
    worker = fuzz.Worker([sys.executable, "-W", "ignore", str(_VALIDATION / "fuzz_files.py"), "--work"])
    try:
        rows = [worker(kind, 1) for kind in fuzz.INPUTS]
    finally:
        worker.close()
    assert {row["outcome"] for row in rows} <= set(fuzz.GOOD)
    assert all(0 < row["peak"] < 1e9 for row in rows)


# -- EXR --------------------------------------------------------------------------------------------------------


def test_every_sound_flat_file_is_read_and_the_decoder_agrees(fuzz: Any, tmp_path: Path) -> None:
    """Strictness costs no sound file; and the judge, which is not OpenEXR, reads what OpenEXR reads."""
    judge = sys.modules["fuzz_exr"]
    decoded = 0
    for sound in judge.corpus():
        path = tmp_path / "a.exr"
        path.write_bytes(sound.content)
        if not sound.pixels:
            refused(lambda path=path: read_exr(path))
            continue
        assert judge.verdict(sound, sound.content, read_exr(path).channels) == "same"
        found = judge.decode(sound.content)
        decoded += found is not None
        assert found is None or all(np.array_equal(found[c], sound.pixels[c]) for c in sound.pixels)
    assert decoded >= 12


def parts_of(fuzz: Any, name: str = "none") -> Any:
    judge = sys.modules["fuzz_exr"]
    return judge.take_apart(next(s.content for s in judge.corpus() if s.name == name))


@pytest.mark.parametrize(
    ("window", "words"),
    [
        ((0, 0, 2**14 - 1, 2**13 - 1), "cannot hold 16384 x 8192 pixels"),
        ((0, 0, 2**14, 2**13 - 1), "16385 x 8192 pixels in 1 channels, 537 MB; at most 134217728 numbers (537 MB)"),
        ((-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), "4294967296 x 4294967296 pixels in 1 channels, 73.8 EB"),
        ((0, 0, -1, 5), "data window"),
        ((5, 5, 4, 4), "data window"),
    ],
)
def test_sizes_are_judged_before_openexr_allocates(
    fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: tuple[int, ...], words: str
) -> None:
    def load(_: Path) -> None:
        raise AssertionError("OpenEXR was asked")

    monkeypatch.setattr(exr, "_load", load)
    path = tmp_path / "a.exr"
    changed = parts_of(fuzz).with_value(b"dataWindow", struct.pack("<4i", *window))
    path.write_bytes(changed.joined(mended=True))
    assert words in refused(lambda: read_exr(path)).message
    # The twin: the sound file goes on to OpenEXR.
    path.write_bytes(parts_of(fuzz).joined(mended=True))
    with pytest.raises(AssertionError):
        read_exr(path)


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        (b"compression", b"\x0e", "compression"),
        (b"lineOrder", b"\x09", "order of lines"),
        (b"dataWindow", b"\0" * 15, "dataWindow"),
        (b"type", b"scanline", "neither scan lines nor tiles"),
        (b"channels", b"\0", "list of channels"),
        (b"channels", b"Y\0" + struct.pack("<iIii", 9, 0, 1, 1) + b"\0", "list of channels"),
        (b"channels", (b"Y\0" + struct.pack("<iIii", 2, 0, 1, 1)) * 2 + b"\0", "out of order"),
        (b"channels", b"Y\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"A\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0",
         "out of order"),
        (b"channels", b"\xff\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0", "no text"),
        (b"channels", b"Y" * 300 + b"\0", "ends early"),
    ],
)  # fmt: skip
def test_headers_that_openexr_would_bend_are_refused(
    fuzz: Any, tmp_path: Path, attribute: bytes, value: bytes, words: str
) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(parts_of(fuzz).with_value(attribute, value).joined(mended=True))
    assert words in refused(lambda: read_exr(path)).message


@pytest.mark.parametrize("size", [-1, 2**20, 2**31 - 1])
def test_attributes_longer_than_the_file_are_refused(fuzz: Any, tmp_path: Path, size: int) -> None:
    parts = parts_of(fuzz)
    lying = (b"extra", b"string", size, b"abc")
    path = tmp_path / "a.exr"
    changed = type(parts)(**{**vars(parts), "attributes": (lying, *parts.attributes)})
    path.write_bytes(changed.joined(mended=True))
    assert "damaged" in refused(lambda: read_exr(path)).message


def test_a_header_without_end_is_not_read_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exr_header, "MAX_HEADER_BYTES", 1000)
    path = tmp_path / "a.exr"
    start = struct.pack("<II", 20000630, 2)
    path.write_bytes(start + b"a" * 5000)
    assert "does not end" in refused(lambda: read_exr(path)).message
    path.write_bytes(start + b"".join(f"a{k}\0int\0".encode() + b"\4\0\0\0abcd" for k in range(500)))
    assert "longer than" in refused(lambda: read_exr(path)).message


@pytest.mark.parametrize(
    ("name", "width", "height"), [("tiles", 0, 16), ("tiles", 2**24, 2), ("tiles", 2**32 - 1, 2**32 - 1)]
)
def test_tiles_of_any_size_are_not(fuzz: Any, tmp_path: Path, name: str, width: int, height: int) -> None:
    path = tmp_path / "a.exr"
    changed = parts_of(fuzz, name).with_value(b"tiles", struct.pack("<IIB", width, height, 0))
    path.write_bytes(changed.joined(mended=True))
    assert "its tiles are" in refused(lambda: read_exr(path)).message


def test_nothing_but_the_sentence_reaches_the_terminal(
    fuzz: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    judge = sys.modules["fuzz_exr"]
    sound = next(s for s in judge.corpus() if s.name == "zip")
    path = tmp_path / "a.exr"
    path.write_bytes(sound.content[:-20] + b"\0" * 20)  # the header is sound, so that OpenEXR has to complain
    refused(lambda: read_exr(path))
    assert capfd.readouterr() == ("", "")


def test_threads_that_read_at_once_lose_no_stderr(fuzz: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(parts_of(fuzz).joined(mended=True))
    with ThreadPoolExecutor(8) as pool:
        images = list(pool.map(lambda _: read_exr(path), range(200)))
    assert all(np.array_equal(image.channels["Y"], images[0].channels["Y"]) for image in images)
    os.write(2, b"still here")
    assert capfd.readouterr().err == "still here"


# -- TOML -------------------------------------------------------------------------------------------------------

SCENE = """
format = 1
title = "A wall"
[wall]
brdf = "diffuse"
albedo = 0.5
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
views = {views}
scan_deg = 90.0
pixels = {pixels}
[card]
elements_x = [{elements}]
y = -1.0
[source]
realisations = {realisations}
"""


def scene(path: Path, *, views: int = 3, pixels: int = 50, elements: int = 2, realisations: int = 4) -> Path:
    places = ", ".join(str(0.01 * k) for k in range(elements))
    path.write_text(SCENE.format(views=views, pixels=pixels, elements=places, realisations=realisations))
    return path


@pytest.mark.parametrize(
    ("sizes", "field", "words"),
    [
        ({"views": 100_000, "pixels": 1_000_000}, "observer.pixels", "100000 views x 1000000 pixels x 4 realisations"),
        ({"views": 100_000, "pixels": 1_000_000}, "observer.pixels", "make 3.2 TB; at most 1.07 GB"),
        ({"views": 1000, "pixels": 1000, "elements": 200}, "observer.pixels", "200 elements make 1.6 GB"),
        ({"elements": 1500, "realisations": 100_000}, "source.realisations", "make 1.2 GB"),
    ],
)
def test_scenes_beyond_memory_are_refused_with_their_size(
    tmp_path: Path, sizes: dict[str, int], field: str, words: str
) -> None:
    path = scene(tmp_path / "a.toml", **sizes)
    error = refused(lambda: load_scene(path))
    assert (error.file, error.field) == (str(path), field)
    assert words in error.message


def test_it_is_the_limit_that_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = scene(tmp_path / "a.toml")
    load_scene(path)
    monkeypatch.setattr(limits, "MAX_NUMBERS", 3 * 50 * 4 - 1)
    assert "3 views x 50 pixels x 4 realisations make 4800 bytes" in refused(lambda: load_scene(path)).message
    monkeypatch.setattr(limits, "MAX_NUMBERS", 3 * 50 * 4)
    load_scene(path)


def test_capture_sets_beyond_memory_are_refused_before_their_films_are_read(
    fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = sys.modules["fuzz_toml"]
    cases.lay_out(tmp_path)
    (tmp_path / "captures.toml").write_text(cases.corpus("captures")[0])
    assert read_captures(tmp_path).radiance.size == 2 * 6 * 3
    monkeypatch.setattr(limits, "MAX_NUMBERS", 2 * 6 * 4 - 1)  # the matrix of four elements is larger than the films
    assert "4 elements" in refused(lambda: read_captures(tmp_path)).message


@pytest.mark.parametrize(
    "key", ["a" + ".a" * 100_000 + " = 1", "[" + "a ." * 100_000 + " a]", "x = {a" + ".'b'" * 99 + "=1}"]
)
def test_keys_of_many_parts_are_refused_at_once(tmp_path: Path, key: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f'about = """\n " \\""" a.b \n"""  # it\'s\n{key}\n')
    assert "a key in line 4 has over 32 parts" in refused(lambda: load_scene(path)).message


def test_dots_in_texts_numbers_and_comments_are_no_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dots = ".".join("a" * 100)
    text = f'x = "{dots}"\ny = \'{dots}\'\nz = """\n{dots}\n"" {dots}"""""\n# {dots}\nw = [{"1.5, " * 100}]\n'
    text += f"v = '''{dots}'' '\n\"{dots}'''\nt = {{ a.b.c = 1.5 }}\n[{'.'.join('abcdefgh' * 4)}]\n"
    (tmp_path / "a.toml").write_text(text)
    assert bounded_toml.parse_toml(tmp_path / "a.toml") == tomllib.loads(text)
    # The twin: the same dots outside of texts are counted, and without the count tomllib would take them.
    (tmp_path / "b.toml").write_text(f"{dots} = 1\n")
    refused(lambda: bounded_toml.parse_toml(tmp_path / "b.toml"))
    monkeypatch.setattr(bounded_toml, "_MAX_PARTS", 1000)
    assert "a" in bounded_toml.parse_toml(tmp_path / "b.toml")


def test_long_files_are_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = scene(tmp_path / "a.toml")
    monkeypatch.setattr(bounded_toml, "MAX_TOML_BYTES", path.stat().st_size)
    load_scene(path)
    monkeypatch.setattr(bounded_toml, "MAX_TOML_BYTES", path.stat().st_size - 1)
    assert "is longer than" in refused(lambda: load_scene(path)).message


@pytest.mark.parametrize(
    ("value", "seen"),
    [
        ('"\\u001b[31mred\\nline"', "is '\\x1b[31mred\\nline'; give a whole number"),
        ('"' + "x" * 100_000 + '"', "xxx...xxx"),
        ("[" + "1, " * 1000 + "]", "[1, 1, 1, 1, ...]"),
        ("[" * 50 + "]" * 50, "[[[[...]]]]"),
        ("[0x" + "f" * 5000 + "]", "a huge number"),
    ],
)
def test_sentences_stay_short_and_plain_whatever_the_file_says(tmp_path: Path, value: str, seen: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"format = {value}\n")
    message = refused(lambda: load_scene(path)).message
    assert seen in message
    assert message.isprintable()
    assert len(message) < 200


def test_names_from_files_are_shown_plain() -> None:
    assert shown("a\x1b[1m\u202e", quote=False) == "a?[1m?"
    assert len(shown("x" * 10_000, quote=False)) < 100


def test_pipes_are_not_waited_for(tmp_path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("this system has no named pipes")
    for name in ("a.toml", "captures.toml", "truth.json", "a.exr"):
        os.mkfifo(tmp_path / name)
    readers = (lambda: load_scene(tmp_path / "a.toml"), lambda: load_picture(tmp_path / "a.toml"),
               lambda: read_captures(tmp_path), lambda: read_truth(tmp_path), lambda: read_exr(tmp_path / "a.exr"))  # fmt: skip
    for read in readers:
        assert refused(read).message == "is not a file"


@pytest.mark.parametrize("shape", ["(1099511627776,)", "(1048576, 1048576)", "(33554433,)"])
def test_tables_whose_header_lies_are_refused_before_they_are_allocated(tmp_path: Path, shape: str) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.ones(49))
    content = buffer.getvalue()
    start = content.index(b"(49,)")
    # The header keeps its length: what the shape needs is taken from its padding.
    lying = content[:start] + shape.encode() + content[start + 5 :].replace(b" " * (len(shape) - 5), b"", 1)
    (tmp_path / "wall.npy").write_bytes(lying)
    path = scene(tmp_path / "a.toml")
    path.write_text(path.read_text().replace('"diffuse"\nalbedo = 0.5', '"table"\nfile = "wall.npy"'))
    tracemalloc.start()
    try:
        error = refused(lambda: load_scene(path))
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()
    assert error.field == "wall.file"
    assert "its header states" in error.message
    # The twin: the sound header is read.
    (tmp_path / "wall.npy").write_bytes(content)
    assert np.asarray(load_scene(path).wall.brdf(0.1, 0.1)) == 1


# -- paths ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", ["file", "variance_file"])
@pytest.mark.parametrize(
    "name",
    ["C:/v00.exr", "C:v00.exr", "C:\\\\v00.exr", "raw\\\\v00.exr", "..\\\\v00.exr", "\\\\\\\\server\\\\share\\\\v00.exr",
     "/etc/passwd", "//server/share/a.exr", "../v00.exr", "up/v00.exr", "raw/../../v00.exr", "loop.exr", "", "a\\u0000.exr",
     "a\\nb.exr", "x" * 5000, "./../v00.exr"],
)  # fmt: skip
def test_paths_out_of_the_folder_on_any_system(fuzz: Any, tmp_path: Path, field: str, name: str) -> None:
    cases = sys.modules["fuzz_toml"]
    home = tmp_path / "set"
    home.mkdir()
    cases.lay_out(home)
    (tmp_path / "v00.exr").write_bytes((home / "v00.exr").read_bytes())  # what the paths would lead to is there
    text = cases.corpus("captures")[0]
    good = 'file = "v00.exr"\n'
    bad = f'file = "{name}"\n' if field == "file" else f'{good}variance_file = "{name}"\n'
    (home / "captures.toml").write_text(text.replace(good, bad))
    error = refused(lambda: read_captures(home))
    assert error.field == f"captures[0].{field}"
    assert "folder" in error.message
    # The twin: the same file inside is taken.
    inside = good if field == "file" else good + 'variance_file = "variance.exr"\n'
    (home / "captures.toml").write_text(text.replace(good, inside))
    if field == "file":
        read_captures(home)
    else:
        assert "for all or for none" in refused(lambda: read_captures(home)).message


def test_names_too_long_for_the_disk_are_told(fuzz: Any, tmp_path: Path) -> None:
    cases = sys.modules["fuzz_toml"]
    cases.lay_out(tmp_path)
    text = cases.corpus("captures")[0].replace('"v00.exr"', f'"{"x" * 900}.exr"')
    (tmp_path / "captures.toml").write_text(text)
    assert "captures[0].file" in str(refused(lambda: read_captures(tmp_path)))
