"""TOML from anybody: bounded in size and in the time that the standard library's parser takes for it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from wallmirror.errors import InputError, shown
from wallmirror.files import read_bounded
from wallmirror.limits import MAX_TOML_BYTES

# What tells keys from text: strings (of three quotes first) and comments hide their dots. Wherever tomllib gets to,
# it has read these tokens alike.
_TOKEN = re.compile(
    r'''"""(?:[^"\\]|\\.|"{1,2}(?!"))*+"{3,5}|"(?:[^"\\\n]|\\.)*+"|'''
    r"""'{3}(?:[^']|'{1,2}(?!'))*+'{3,5}|'[^'\n]*+'|"""
    r"""\#[^\n]*+|(?P<dot>\.)|(?P<end>[][{},=\n])|[^]["'#.{},=\n]++|.""",
    re.DOTALL,
)
_MAX_PARTS = 32


def parse_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises
    ------
    InputError
        If the file is absent, too long, not UTF-8, or malformed.

    Examples
    --------
    >>> parse_toml(Path("captures.toml"))["format"]  # doctest: +SKIP
    1
    """
    try:
        text = read_bounded(path, MAX_TOML_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"cannot be read as UTF-8 text ({error})", file=path) from None
    _require_short_keys(text, path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a number of 5000 digits or 5000 nested lists are no decode errors
        raise InputError(f"is not valid TOML: {shown(str(error), quote=False)}", file=path) from None


def _require_short_keys(text: str, path: Path) -> None:
    """Refuse a.a.a.a...: tomllib's time for one key grows with the square of its parts, hours for a megabyte."""
    if text.count(".") <= _MAX_PARTS:
        return
    dots = 0
    for token in _TOKEN.finditer(text):
        if token.lastgroup == "end":
            dots = 0
        elif token.lastgroup == "dot":
            dots += 1
            if dots > _MAX_PARTS:
                line = text.count("\n", 0, token.start()) + 1
                raise InputError(f"is not valid here: a key in line {line} has over {_MAX_PARTS} parts", file=path)
