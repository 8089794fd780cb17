"""The errors that a user can meet, each with the exit code that the command line gives it."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Any


class WallmirrorError(Exception):
    """Base of every error that is told in one sentence instead of a traceback."""

    exit_code = 1


class InputError(WallmirrorError):
    """Bad input: one sentence that names the file, the field, what is wrong and what would be right.

    Parameters
    ----------
    message:
        What is wrong and how to mend it.
    file, field:
        Where it stands; either may be absent for values given from Python.
    """

    exit_code = 2

    def __init__(self, message: str, *, file: str | Path | None = None, field: str | None = None) -> None:
        self.message = message
        self.file = None if file is None else str(file)
        self.field = field
        super().__init__(": ".join(part for part in (self.file, self.field, message) if part))

    def located(self, *, file: str | Path | None = None, field: str | None = None) -> InputError:
        """The same error with a file or field that was not yet known where it was raised."""
        return InputError(self.message, file=self.file or file, field=self.field or field)


class UndeterminedError(WallmirrorError):
    """The data do not determine the answer; the message says what would."""

    exit_code = 3


class MissingRuntimeError(WallmirrorError):
    """Mitsuba cannot run as asked; the message says what to install."""

    exit_code = 1


def shown(value: Any, *, quote: bool = True) -> str:
    """A value from a file, fit for a sentence: one short line without control characters, whatever the file says.

    Examples
    --------
    >>> shown("two\\nlines"), shown(10**5000), shown([[[[1]]], 2]), len(shown("x" * 1000))
    ("'two\\\\nlines'", 'a huge number', '[[[[...]]], 2]', 57)
    """
    if isinstance(value, str) and not quote:
        line = "".join(c if c.isprintable() else "?" for c in value)
        return line if len(line) <= _SHOWN.maxstring + 60 else f"{line[: _SHOWN.maxstring]}..."
    try:
        return _SHOWN.repr(value)
    except (ValueError, RecursionError):  # an integer of more than 4300 digits
        return "a huge number"


_SHOWN = reprlib.Repr()
_SHOWN.maxlevel, _SHOWN.maxlist, _SHOWN.maxdict, _SHOWN.maxstring, _SHOWN.maxother = 3, 4, 4, 57, 57
