"""Reading TOML with checked fields: every fault becomes one sentence with file and field."""

from __future__ import annotations

import difflib
import importlib.resources
import math
import sys
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

from wallmirror.errors import InputError, shown
from wallmirror.toml import parse_toml

Word = TypeVar("Word", bound=str)

_MAX_PATH = 1000  # characters


def shipped_names(folder: str) -> tuple[str, ...]:
    """Names of the TOML files that come with wallmirror in a folder of the package ("scenes"), sorted."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in _shipped(folder).iterdir() if p.name.endswith(".toml")))


def named_toml(name_or_path: str | Path, folder: str, *, kind: str) -> Path:
    """The path that was given, or that of the file with this name that comes with wallmirror.

    Raises
    ------
    InputError
        For a name that is not among them; `kind` says of what ("scene").
    """
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    names = shipped_names(folder)
    if str(name_or_path) not in names:
        raise InputError(f'no {kind} is called "{name_or_path}"; give a .toml file or one of: {", ".join(names)}')
    return _shipped(folder) / f"{name_or_path}.toml"


def _shipped(folder: str) -> Path:
    return Path(str(importlib.resources.files("wallmirror"))) / folder


def read_toml(path: Path) -> Fields:
    """Parse a TOML file into its root `Fields`; InputError names the file if it is absent, too long or malformed."""
    return Fields(parse_toml(path), file=path)


class Fields:
    """One TOML table whose entries are taken by name and type; `finish` refuses what nobody took.

    Parameters
    ----------
    table:
        The parsed table.
    file, path:
        Where it stands, for messages: the file, and the dotted name of the table in it.
    """

    def __init__(self, table: dict[str, Any], *, file: Path, path: str = "") -> None:
        self._table = table
        self._taken: set[str] = set()
        self._known: set[str] = set()
        self.file = file
        self.path = path

    def error(self, name: str, message: str) -> InputError:
        """An InputError located at one field of this table."""
        name = shown(name, quote=False)
        return InputError(message, file=self.file, field=f"{self.path}.{name}" if self.path else name)

    def has(self, name: str) -> bool:
        """Whether the field is present."""
        self._known.add(name)
        return name in self._table

    def flag(self, name: str, default: bool) -> bool:
        """true or false."""
        value = self._take(name, default)
        if not isinstance(value, bool):
            raise self.error(name, f"is {shown(value)}; give true or false")
        return value

    def number(
        self, name: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """A finite number in [low, high]; required when there is no default."""
        return self._as_number(name, self._take(name, default), low, high)

    def integer(self, name: str, default: int | None = None, *, low: int = 0, high: int = 2**31 - 1) -> int:
        """A whole number in [low, high]; required when there is no default."""
        value = self._take(name, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.error(name, f"is {shown(value)}; give a whole number")
        if not low <= value <= high:
            size = value if abs(value) < 10**20 else "huge"
            raise self.error(name, f"is {size}; give a whole number from {low} to {high}")
        return value

    def numbers(self, name: str, default: Sequence[float] | None = None, *, size: int = 0) -> tuple[float, ...]:
        """A list of finite numbers, of the given size unless that is 0; required when there is no default."""
        value = self._take(name, default)
        if not isinstance(value, (list, tuple)):
            raise self.error(name, f"is {shown(value)}; give a list of numbers")
        if size and len(value) != size:
            raise self.error(name, f"has {len(value)} entries; give {size}")
        return tuple(self._as_number(name, entry, -math.inf, math.inf) for entry in value)

    def one_of(self, name: str, options: tuple[Word, ...], default: Word) -> Word:
        """One of a few strings, typed as the options are."""
        value = self.choice(name, options, default)
        return next(option for option in options if option == value)

    def text(self, name: str, default: str | None = None) -> str:
        """A string; required when there is no default."""
        value = self._take(name, default)
        if not isinstance(value, str):
            raise self.error(name, f"is {shown(value)}; give a text in quotes")
        return value

    def inside(self, name: str, folder: str) -> Path:
        """A file beside the one being read, which may not leave its folder, links followed.

        Parameters
        ----------
        folder:
            What to call that folder in messages ("set's").
        """
        text = self.text(name)
        directory = self.file.parent
        # A backslash or drive letter would mean a folder on one system and a name on another.
        foreign = "\\" in text or bool(PureWindowsPath(text).drive)
        if not text.isprintable() or not 0 < len(text) <= _MAX_PATH or foreign or Path(text).is_absolute():
            raise self.error(
                name, f"is {shown(text)}; give the name of a file in the {folder} folder, such as raw/a.exr"
            )
        try:
            leaves = not (directory / text).resolve().is_relative_to(directory.resolve())
        except (OSError, RuntimeError):  # links that go round in circles
            leaves = True
        if leaves:
            raise self.error(
                name, f'"{shown(text, quote=False)}" leads out of the {folder} folder; move the file into it'
            )
        return directory / text

    def texts(self) -> dict[str, str]:
        """All entries of a free-form table of strings."""
        return {name: self.text(name) for name in self._table}

    def choice(self, name: str, options: Sequence[str], default: str | None = None) -> str:
        """One of a few strings."""
        value = self.text(name, default)
        if value not in options:
            raise self.error(name, f'is "{shown(value, quote=False)}"; choose {_listed(options)}')
        return value

    def table(self, name: str, *, required: bool = True) -> Fields:
        """A sub-table; an absent optional one reads as empty."""
        value = self._take(name, None if required else {})
        if not isinstance(value, dict):
            raise self.error(name, f"is {shown(value)}; give a table [{name}]")
        return Fields(value, file=self.file, path=f"{self.path}.{name}" if self.path else name)

    def tables(self, name: str) -> list[Fields]:
        """A list of tables [[name]]."""
        value = self._take(name, None)
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.error(name, f"give a list of tables [[{name}]]")
        return [Fields(entry, file=self.file, path=f"{name}[{i}]") for i, entry in enumerate(value)]

    def rows(self, name: str) -> list[tuple[float, ...]]:
        """A list of equally long lists of finite numbers."""
        value = self._take(name, None)
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            raise self.error(name, "give a list of lists of numbers")
        rows = [tuple(self._as_number(name, entry, -math.inf, math.inf) for entry in row) for row in value]
        if len({len(row) for row in rows}) > 1:
            raise self.error(name, "has rows of different lengths")
        return rows

    def finish(self) -> None:
        """Refuse the fields that nobody took, with the nearest known name."""
        for name in self._table:
            if name not in self._taken:
                known = self._taken | self._known
                near = difflib.get_close_matches(name, known, n=1)
                hint = f'; did you mean "{near[0]}"?' if near else f"; known here: {', '.join(sorted(known))}"
                raise self.error(name, f"is not a known field{hint}")

    def _take(self, name: str, default: Any) -> Any:
        self._taken.add(name)
        if name in self._table:
            return self._table[name]
        if default is None:
            raise self.error(name, "is missing")
        return default

    def _as_number(self, name: str, value: Any, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(name, f"holds {shown(value)}; give finite numbers")
        if not abs(value) <= sys.float_info.max:  # NaN, infinity, and integers that no float can hold
            raise self.error(
                name, f"holds {value if isinstance(value, float) else 'a huge number'}; give finite numbers"
            )
        if not low <= value <= high:
            raise self.error(name, f"is {value:g}; give a number from {low:g} to {high:g}")
        return float(value)


def _listed(options: Sequence[str]) -> str:
    quoted = [f'"{option}"' for option in options]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} or {quoted[-1]}"
