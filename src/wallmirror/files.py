"""Reading no more than is sensible, and writing so that nothing is lost: to a temporary name, then renamed."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from wallmirror.errors import InputError
from wallmirror.limits import size_text


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace a file as a whole; an interruption leaves the earlier one. Creates the folder.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
        temporary = None
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror or error})", file=path) from None
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()


def read_bounded(path: Path, most: int) -> bytes:
    """A file's bytes; InputError if it is absent, cannot be read, or has more than `most`."""
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            raise InputError("is not a file", file=path)
        with path.open("rb") as file:
            content = file.read(most + 1)
    except FileNotFoundError:
        raise InputError("no such file", file=path) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", file=path) from None
    if len(content) > most:
        raise InputError(f"is longer than {size_text(most)}, the most that is read", file=path)
    return content
