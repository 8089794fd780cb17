"""Capture sets, scenes and pictures whose TOML was made hostile, and truth.json beside them.

What is accepted must say what the file says: the judge reads the file with the standard library and computes on its
own which pixels and numbers should have come out.
"""

from __future__ import annotations

import importlib.resources
import json
import math
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from fuzz_bytes import Rng, damage

from wallmirror import CaptureSet, Scene, Truth
from wallmirror.exr import write_exr
from wallmirror.picture_scene import PictureScene

_VIEWS, _PIXELS, _REALISATIONS = 2, 6, 3

_HAND = """format = 1
transport = "physical"
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
view_angles_deg = [15.0, -15.0]
pixels = 6
pixels_at = "centres"
[card]
elements_x = [-2.5, -0.83, 0.83, 2.5]
y = -1.0
element_width = 0.02
element_height = 0.02
albedo = 0.5
board_width = 0.3
board_height = 0.2
[room]
half_width = 6.0
half_height = 3.0
depth = 8.0
albedo = 0.8
[provenance]
camera = "X100"
"""

_SCENE = """format = 1
title = "A wall"
[wall]
brdf = "gaussian_train"
centres_deg = [-15.0, 15.0]
sigma_deg = 1.0
scale = 1.0
half_width = 20.0
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
views = 3
scan_deg = 90.0
pixels = 50
[card]
elements_x = [-1.0, 1.0]
y = -1.0
element_width = 0.02
element_height = 0.02
[source]
level = 2.0
patterns = [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]
[render]
max_depth = 2
spp = 64
"""


def stored(view: int, realisation: int) -> np.ndarray:
    """Pixels that name their capture, exact in float32; two rows, of which the second is the centre one."""
    row = np.array([-0.125, 1, 2, 3, 4, 5], np.float32) + np.float32(8 * view + 64 * realisation)
    return np.stack([row + np.float32(1000), row])


def lay_out(folder: Path) -> None:
    """The EXR files of the capture set, once; each input only replaces captures.toml."""
    for view in range(_VIEWS):
        for realisation in range(_REALISATIONS):
            pixels = stored(view, realisation)
            path = folder / f"v{view}{realisation}.exr"
            if realisation == 0:
                write_exr(path, {"Y": pixels, "R": pixels + 1}, settings={"spp": 16})
                continue
            with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": pixels, "R": pixels + 1}) as file:
                file.write(str(path))
    write_exr(folder / "variance.exr", {"Y": np.ones((2, _PIXELS)), "R": np.ones((2, _PIXELS))})
    (folder / "raw").mkdir()
    (folder / "up").symlink_to(folder.parent)
    (folder / "loop.exr").symlink_to("loop.exr")


@cache
def corpus(kind: str) -> tuple[str, ...]:
    """Sound texts of one kind: "captures", "scene" or "picture"."""
    if kind == "captures":
        entries = "".join(
            f'[[captures]]\nfile = "v{v}{b}.exr"\nview = {v}\nrealisation = {b}\nexposure = 2.0\nrow = 1\n'
            for v in range(_VIEWS)
            for b in range(_REALISATIONS)
        )
        photographs = "".join(
            f'[[captures]]\nfile = "v{v}{b % 2}.exr"\nview = {v}\nrealisation = {b}\nchannel = "{"YYR"[b]}"\n'
            for v in range(_VIEWS)
            for b in range(_REALISATIONS)
        )
        return _HAND + entries, _HAND + photographs
    scenes = Path(str(importlib.resources.files("wallmirror"))) / "scenes"
    folder = scenes if kind == "scene" else scenes / "pictures"
    shipped = tuple(path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.toml")))
    return (_SCENE, _SCENE, _SCENE, *shipped) if kind == "scene" else shipped


# -- mutations --------------------------------------------------------------------------------------------------


def _nested(depth: int) -> str:
    return "[" * depth + "1" + "]" * depth


def values(rng: Rng) -> str:
    """A value of TOML that its field hardly expects."""
    n = int(rng.choice((1, 10, 1000, 30_000)))
    options = (
        "true", "-1", "0", "1", "2", "0.5", "-0.0", "1e300", "-1e300", "1e-300", "5e-324", "inf", "-inf", "nan",
        "1e9999", "100000", "1000000", "2147483647", "2147483648", "9223372036854775807", "0x" + "f" * n, "1" * n,
        '""', '"x"', '"nan"', '"' + "x" * n + '"', '"\\u0000"', '"\\u001b[31m"', '"\\u202e"', '"a\\nb"', "'''\nx\n'''",
        '"\U0001f600"', "[]", "[[]]", "[1]", "[1.0, 2.0]", "[" + "1.0, " * n + "]", "[" + "[], " * n + "]",
        "[" + "[1.0, 2.0], " * n + "]", _nested(n), '["a", 1]', "[nan, 0.0]", "[1e308, -1e308]", "[0.0, -5.0, 1.0]",
        "{}", "{a = 1}", "{a = {b = {c = 1}}}", "{" + "a = {" * (n // 10) + "}" * (n // 10) + "}", "1979-05-27T07:32:00Z",
        "07:32:00", "a" + ".a" * n, "{a" + ".a" * n + " = 1}", '"../v00.exr"', '"/etc/passwd"', '"up/set/v00.exr"',
        '"loop.exr"', '"raw"', '"."', '"C:\\\\v00.exr"', '"\\\\\\\\server\\\\a.exr"', '"v01.exr"', '"v11.exr"', '"R"',
        '"Y"', '"variance.exr"', '"physical"', '"thesis"', '"edges"', '"diffuse"', '"mirror"', '"phong"',
        f"{float(rng.normal()) * 10.0 ** int(rng.integers(-12, 13))!r}", str(int(rng.integers(-10, 200))),
    )  # fmt: skip
    return options[int(rng.integers(len(options)))]


def _value(lines: list[str], rng: Rng) -> None:
    places = [k for k, line in enumerate(lines) if "=" in line]
    at = places[int(rng.integers(len(places)))]
    lines[at] = f"{lines[at].split('=')[0]}= {values(rng)}"


def _bent(lines: list[str], rng: Rng) -> None:
    """One number in place of another, within a value that is otherwise as it was."""
    places = [k for k, line in enumerate(lines) if "=" in line and any(c.isdigit() for c in line)]
    at = places[int(rng.integers(len(places)))]
    digits = [k for k, c in enumerate(lines[at]) if c.isdigit()]
    k = digits[int(rng.integers(len(digits)))]
    lines[at] = lines[at][:k] + str(int(rng.integers(10 ** int(rng.integers(1, 8))))) + lines[at][k + 1 :]


def _lost(lines: list[str], rng: Rng) -> None:
    del lines[int(rng.integers(len(lines)))]


def _twice(lines: list[str], rng: Rng) -> None:
    lines.insert(int(rng.integers(len(lines))), lines[int(rng.integers(len(lines)))])


def _moved(lines: list[str], rng: Rng) -> None:
    line = lines.pop(int(rng.integers(len(lines))))
    lines.insert(int(rng.integers(len(lines) + 1)), line)


def _key(lines: list[str], rng: Rng) -> None:
    """A key nobody knows, misspelt, of a wild form or of another table."""
    places = [k for k, line in enumerate(lines) if "=" in line]
    at = places[int(rng.integers(len(places)))]
    key, _, rest = lines[at].partition("=")
    n = int(rng.choice((1, 40, 5000)))
    wild = (key.strip() + "x", '""', '"a\\nb"', "x" * n, "a" + ".a" * n, "row", "channel", "variance_file", "saturation",
            "image", "views", "patterns", "seed", "realisations", "level", "'\u202e'", "format")  # fmt: skip
    new = wild[int(rng.integers(len(wild)))]
    lines[at] = f"{new} ={rest}" if rng.random() < 0.5 else f"{lines[at]}\n{new} = {values(rng)}"


def _table(lines: list[str], rng: Rng) -> None:
    places = [k for k, line in enumerate(lines) if line.startswith("[")]
    heads = ("[card]", "[x]", "[[captures]]", "[captures]", "[observer.card]", "[" + "a." * 5000 + "a]", "[[card]]",
             "[room]", "[source]", "[[shape]]", "[render]", '["a\\u0007"]', "[card", "[]")  # fmt: skip
    head = heads[int(rng.integers(len(heads)))]
    if places and rng.random() < 0.6:
        lines[places[int(rng.integers(len(places)))]] = head
    else:
        lines.insert(int(rng.integers(len(lines))), head)


def _flood(lines: list[str], rng: Rng) -> None:
    """Much of something."""
    n = int(rng.choice((1000, 20_000)))
    floods = ("[[captures]]\n" * n, "\n".join(f"k{k} = 1" for k in range(n)), "# x\n" * n, "[[shape]]\n" * n,
              "a = [" + "{}, " * n + "]", "a = [" + "{a.b.c = 1}, " * (n // 4) + "]", " " * n * 50,
              "".join(f"[t{k}.a.b]\n" for k in range(n // 4)), 'a = "' + "x" * n * 300 + '"', "'" * n, '"' * n)  # fmt: skip
    lines.insert(int(rng.integers(len(lines))), floods[int(rng.integers(len(floods)))])


STRUCTURE = {f.__name__.strip("_"): f for f in (_value, _bent, _lost, _twice, _moved, _key, _table, _flood)}
_WEIGHTS = np.array([7, 8, 1, 1, 1, 3, 1, 1], dtype=float) / 23


def hostile(kind: str, number: int) -> tuple[str, bytes]:
    """Input number `number` of a kind: what was done, and the bytes that became of a sound text."""
    rng = np.random.default_rng((2, ("captures", "scene", "picture").index(kind), number))
    texts = corpus(kind)
    text = texts[int(rng.integers(len(texts)))]
    if rng.random() < 0.2:
        return damage(text.encode(), [t.encode() for t in texts], rng)
    lines = text.splitlines()
    chosen = [str(rng.choice(list(STRUCTURE), p=_WEIGHTS)) for _ in range(1 if rng.random() < 0.7 else 2)]
    for name in chosen:
        STRUCTURE[name](lines, rng)
    return "+".join(chosen), "\n".join([*lines, ""]).encode()


def hostile_truth(number: int) -> tuple[str, bytes]:
    """A truth.json made hostile."""
    rng = np.random.default_rng((3, number))
    table: dict[str, Any] = {
        "format": 1, "source": [[1.0, 0.5], [0.25, 2.0]], "theta_s_deg": [-10.0, 0.0, 10.0],
        "theta_o_deg": [0.0, 5.0, 10.0], "brdf": [0.5, 1.0, 0.5],
    }  # fmt: skip
    entries = {key: json.dumps(value) for key, value in table.items()}
    key = list(table)[int(rng.integers(len(table)))]
    n = int(rng.choice((1, 1000, 100_000)))
    wild = ("NaN", "Infinity", "1e999", "-1", "null", "true", '"x"', "[]", "{}", "[[1], [1, 2]]", "[null]", "1" * n,
            "[" * n, "[" + "1," * n + "1]", '["1"]', "[[[1]]]", "[1e308, 1e308]", "[true]", "[9223372036854775808]",
            "[" + "[]," * n + "[]]", '{"a":' * n, "[[3.0, 1.0], [0.5, 0.0]]", "[0.25, 0.5, 0.125]")  # fmt: skip
    value = wild[int(rng.integers(len(wild)))]
    choice = int(rng.integers(4))
    if choice == 0:
        del entries[key]
    elif choice == 1:
        entries["unknown" if rng.random() < 0.5 else "x" * n] = value
    else:
        entries[key] = value
    text = "{" + ", ".join(f'"{name}": {value}' for name, value in entries.items())
    if choice == 3:
        return "key twice", (text + f', "{key}": {value}}}').encode()
    if rng.random() < 0.4:
        return damage((text + "}").encode(), [b'{"a": 1}', b"[[[]]]"], rng)
    return "value", (text + "}").encode()


# -- judges -----------------------------------------------------------------------------------------------------


def _held(name: str, channel: str) -> np.ndarray:
    """What `lay_out` put into a channel of a file."""
    if name == "variance.exr":
        return np.ones((2, _PIXELS), np.float32)
    return stored(int(name[1]), int(name[2])) + (channel == "R")


def judge_captures(content: bytes, read: CaptureSet) -> bool:
    """Whether a capture set that was read is what its captures.toml and the EXR files say."""
    table = tomllib.loads(content.decode())
    observer, card = table["observer"], table["card"]
    expected = np.full(read.radiance.shape, np.nan)
    for capture in table["captures"]:
        holder = {**observer, **table, **capture}
        pixels = _held(Path(capture["file"]).name, holder.get("channel", "Y"))
        line = pixels[holder.get("row", 1)].astype(np.float64) / capture.get("exposure", 1.0)
        expected[capture["view"], :, capture["realisation"]] = line
    angles = observer.get("view_angles_deg")
    return (
        np.array_equal(expected, read.radiance)
        and read.observer.position == tuple(observer["position"])
        and read.observer.fov == math.radians(observer["fov_deg"])
        and (angles is None or read.observer.view_angles == tuple(map(math.radians, angles)))
        and read.card.elements_x == tuple(card["elements_x"])
        and read.card.y == card["y"]
        and read.card.element_width == card.get("element_width", 0.0)
        and read.card.albedo == card.get("albedo", 0.0)
        and (read.room is None or read.room.depth == table["room"]["depth"])
        and (read.variance is None or bool(np.all(read.variance >= 0)))
        and dict(read.provenance) == table.get("provenance", {})
    )


def judge_scene(content: bytes, read: Scene) -> bool:
    """Whether a scene that was read is what its text says."""
    table = tomllib.loads(content.decode())
    source = table["source"]
    level = source.get("level", 1.0)
    if "patterns" in source:
        expected = level * np.array(source["patterns"], dtype=float).reshape(len(source["patterns"]), -1).T
    else:
        shape = len(table["card"]["elements_x"]), source["realisations"]
        expected = level * np.random.default_rng(source.get("seed", 0)).random(shape)
    return (
        np.array_equal(read.source, expected)
        and read.title == table["title"]
        and read.observer.position == tuple(table["observer"]["position"])
        and read.observer.pixels == table["observer"]["pixels"]
        and read.card.elements_x == tuple(table["card"]["elements_x"])
        and read.card.y == table["card"]["y"]
        and read.wall.half_width == table["wall"].get("half_width", 20.0)
        and read.render.spp == table.get("render", {}).get("spp", 1024)
        and bool(np.all(np.isfinite(read.source)))
    )


def judge_picture(content: bytes, read: PictureScene) -> bool:
    """Whether a picture that was read is what its text says."""
    table = tomllib.loads(content.decode())
    shapes = table["shape"]
    return (
        read.title == table["title"]
        and read.camera.position == tuple(table["camera"]["position"])
        and read.camera.fov == math.radians(table["camera"]["fov_deg"])
        and [s.name for s in read.shapes[: len(shapes)]] == [s["name"] for s in shapes]
        and all(s.emission == tuple(t.get("emission", (0, 0, 0))) for s, t in zip(read.shapes, shapes))
        and read.render.width == table.get("render", {}).get("width", 640)
        and (len(read.shapes) == len(shapes)) >= ("sphere_field" not in table)
    )


def judge_truth(content: bytes, read: Truth) -> bool:
    """Whether a truth that was read is what its text says."""
    table = json.loads(content)
    return np.array_equal(read.source, np.array(table["source"], float)) and np.array_equal(
        read.brdf, np.array(table["brdf"], float)
    )
