"""The command line at extreme options: one sentence, a documented exit code, no traceback, nothing left behind.

Each cell runs a command in an empty folder. Refused must be what has no meaning: exit code 2 or 3, one line on stderr (or
Typer's usage with its box), nothing on stdout but the JSON document where one is asked for, and no file more than before.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import wallmirror as wm
from wallmirror.cli import main

from .harness import Case
from .scene_files import scene_text
from .scenes import films


@dataclass(frozen=True)
class Left:
    """How a command ended: exit code, what it wrote on both streams, and the files that it left."""

    code: int
    out: str
    err: str
    files: tuple[str, ...]


def left_by(arguments: Sequence[str], prepare: Callable[[], None] = lambda: None) -> Left:
    """Run a command in an empty folder, into which `prepare` may put files first."""
    out, err = io.StringIO(), io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        prepare()
        before = set(Path().rglob("*"))
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main(list(arguments))
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
        made = tuple(sorted(str(p) for p in set(Path().rglob("*")) - before))
    return Left(code, out.getvalue(), err.getvalue(), made)


def capture_set() -> None:
    """A capture set that `solve` recovers."""
    captures, source = films(noise=1e-3)
    u = np.zeros(1)
    wm.write_captures("set", captures, truth=wm.Truth(source=source, theta_s=u, theta_o=u, brdf=u + 1))


def scene_file() -> None:
    Path("small.toml").write_text(scene_text("source", "level", "1.0"))


def points_file() -> None:
    text = scene_text("card", "element_width", "0.0").replace("element_height = 0.03", "element_height = 0.0")
    Path("points.toml").write_text(text)


def dark_file() -> None:
    Path("dark.toml").write_text(scene_text("source", "level", "0.0"))


def everything() -> None:
    capture_set()
    scene_file()
    points_file()
    dark_file()
    Path("text.toml").write_text("no toml at all")
    Path("file").write_text("a file, no folder")
    Path("holds").mkdir()
    Path("holds/photograph.exr").write_bytes(b"")


def refused_well(arguments: Sequence[str]) -> tuple[float, float]:
    plain = left_by(arguments, everything)
    spoken = left_by([*arguments, "--json"], everything)
    for left in (plain, spoken):
        if left.code not in (2, 3):
            raise RuntimeError(f"left with {left.code}: {(left.out + left.err)[-200:]}")
        if left.files:
            raise RuntimeError(f"left {', '.join(left.files[:3])} behind")
        if "Traceback" in left.err or "Warning" in left.err:
            raise RuntimeError(left.err[-200:])
        sentences = [line for line in left.err.splitlines() if line.startswith("wallmirror: ")]
        # Typer's box has one message between its lines; a command that ran tells of its stages first.
        if len(sentences) != 1 and "─ Error ─" not in left.err:
            raise RuntimeError(f"said {left.err[-200:]!r}")
    if plain.out:
        raise RuntimeError(f"wrote {plain.out[:100]!r} on stdout")
    document = json.loads(spoken.out)
    if not (document["exit_code"] == spoken.code and isinstance(document["error"], str) and document["error"]):
        raise RuntimeError(f"its document is {spoken.out[:200]}")
    return 0.0, 0.5


def done_well(arguments: Sequence[str], code: int, key: str) -> tuple[float, float]:
    left = left_by([*arguments, "--json"], everything)
    if left.code != code or "Traceback" in left.err or key not in json.loads(left.out):
        raise RuntimeError(f"left with {left.code}: {left.out[-100:]} {left.err[-200:]}")
    return 0.0, 0.5


_NUMBERS = ("0", "-1", "nan", "inf", "-inf", "1e400", "1e-300", "1e300", "text", "")
_WHOLE = ("-1", "0.5", "nan", "1e9", "99999999999999999999999", "text", "")
_SEEDS = ("-1", "0.5", "nan", "text", "")

#: Commands with options that each refuse every value of the list, after what the command needs.
_REFUSED: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("validate small.toml", "--tolerance", tuple(v for v in _NUMBERS if v != "1e-300")),
    ("validate small.toml", "--spp", ("0", "3", "1025", "5", *_WHOLE)),
    ("validate small.toml", "--views", ("0", "-1", "0.5", "nan", "text")),
    ("validate small.toml", "--seed", _SEEDS),
    ("validate small.toml --bounces", "--tolerance", tuple(v for v in _NUMBERS if v != "1e-300")),
    ("validate small.toml --bounces", "--spp", ("0", "3", "1025", *_WHOLE)),
    ("validate", "", ("nosuch", "nosuch.toml", "text.toml", "points.toml", "../..", "file")),
    ("advise small.toml", "--tolerance", (*_NUMBERS, "0.6", "1e-6", "1e3")),
    ("advise small.toml", "--seed", _SEEDS),
    ("advise", "", ("nosuch", "nosuch.toml", "text.toml", "dark.toml", "file")),
    ("capture small.toml -o out", "--tolerance", (*_NUMBERS, "0.6", "1e-6")),
    ("capture small.toml -o out", "--spp", ("0", "1", *_WHOLE)),
    ("capture small.toml -o out", "--max-depth", ("0", "1", *_WHOLE)),
    ("capture small.toml -o out", "--seed", _SEEDS),
    ("capture small.toml", "-o", ("file", "holds", "file/inside", "/proc/nothing")),
    ("capture -o out", "", ("nosuch", "nosuch.toml", "text.toml", "points.toml")),
    ("solve set -o out", "--tolerance", tuple(v for v in _NUMBERS if v != "1e-300")),
    ("solve set -o out", "--step-deg", _NUMBERS),
    ("solve set -o out --method poisson", "--counts", tuple(v for v in _NUMBERS if v != "1e-300")),
    ("solve set -o out --method poisson --counts 1e6", "--background", ("-1", "nan", "inf", "-inf", "text", "")),
    ("solve set -o out --method few_captures", "--support-deg", ("0", "-1", "nan", "inf", "181", "text")),
    ("solve set -o out --scale albedo", "--wall-albedo", ("0", "-1", "nan", "inf", "1.1", "text")),
    ("solve set -o out --scale level", "--source-level", ("0", "-1", "nan", "inf", "text")),
    ("solve set -o out", "--seed", _SEEDS),
    ("solve set -o out", "--method", ("", "nosuch")),
    ("solve set -o out", "--wall", ("", "nosuch")),
    ("solve set -o out", "--scale", ("", "nosuch")),
    ("solve set", "-o", ("file", "file/inside", "/proc/nothing")),
    ("solve -o out", "", ("nosuch", "file", "holds", "small.toml", "")),
    ("solve -o out --general", "", ("set", "nosuch", "file")),
    ("solve set -o out", "--nosuch", ("1",)),
    ("figures -o out", "", ("nosuch", "99.9", "", "-1")),
    ("figures 3.2 -o out", "--seed", _SEEDS),
    ("tradeoff -o out", "", ("nosuch", "", "forward nosuch")),
    ("tradeoff scaling -o out", "--seed", _SEEDS),
    ("demo -o out", "--seed", _SEEDS),
    ("doctor", "", ("nosuch", "--nosuch")),
    ("", "", ("nosuch", "--nosuch")),
)


def cases() -> Iterator[Case]:
    for command, option, values in _REFUSED:
        for value in values:
            words = [*command.split(), *([option] if option else []), *([value] if option else value.split() or [""])]
            name = command.split()[0] if command else "wallmirror"
            quantity = f"{command.partition(' ')[2]} {option}".strip() or "argument"
            yield Case(f"wallmirror {name}".replace("wallmirror wallmirror", "wallmirror"), quantity, value[:24] or '""', (
                lambda w=words: refused_well(w)))  # fmt: skip
    for words, code, key in (
        ("solve set -o out --tolerance 1e-300", 1, "verdict"),
        ("solve set -o out --tolerance 0.999", 0, "verdict"),
        ("solve set -o out --step-deg 45", 0, "verdict"),
        ("solve set -o out --seed 99999999999999999999999", 0, "verdict"),
        ("validate small.toml -o out --spp 4 --views 99999999999999999999", 0, "passed"),
        ("validate small.toml -o out --spp 4 --tolerance 1e-9 --views 1", 1, "passed"),
        ("validate dark.toml -o out --spp 4", 1, "passed"),
        ("capture small.toml -o out --spp 2 --seed 99999999999999999999", 0, "views"),
        ("capture dark.toml -o out --spp 2", 0, "views"),
        ("doctor", 0, "ok"),
    ):
        yield Case(f"wallmirror {words.split()[0]}", "options", " ".join(words.split()[1:]) or "none", (
            lambda w=words, c=code, k=key: done_well(w.split(), c, k)))  # fmt: skip
