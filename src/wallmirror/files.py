"""Reading no more than is sensible, and writing so that nothing is lost: to a temporary name, then renamed."""

from __future__ import annotations

import contextlib
import os
import shutil
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


def write_together(folder: Path, contents: dict[str, str | bytes]) -> None:
    """Replace several files of a folder, all or none; creates the folder.

    Everything is written beside first. The earlier files then move into a hidden folder, the new ones into their
    places, in the order given. A failure or an interrupt moves all of them back. A kill or a power cut within these few
    renames leaves the earlier files in the hidden folder, and the last name, which should be the one that readers look
    for, absent; the next call puts them back before it does anything else.

    Raises
    ------
    InputError
        If the folder cannot be made or written to; the earlier files are then in their places.
    """
    last = folder / next(reversed(contents))
    staged, earlier = (folder / f".{last.stem}.{part}" for part in ("next", "earlier"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _put_back(earlier, last)
        shutil.rmtree(staged, ignore_errors=True)
        staged.mkdir()
        for name, content in contents.items():
            (staged / name).write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        earlier.mkdir()
        try:
            # The last first, so that where it is, the others are of its kind.
            for name in reversed(contents):
                if (folder / name).exists():
                    (folder / name).rename(earlier / name)
            for name in contents:
                (staged / name).rename(folder / name)
        except BaseException:
            _put_back(earlier, last)
            raise
        shutil.rmtree(earlier)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror or error})", file=folder) from None
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _put_back(earlier: Path, last: Path) -> None:
    """Move files back from where an unfinished replacement left them; a finished one has its last file in place."""
    if not earlier.is_dir():
        return
    if not last.exists():
        for path in sorted(earlier.iterdir(), key=lambda path: path.name == last.name):
            path.replace(last.with_name(path.name))
    shutil.rmtree(earlier)


def read_bounded(path: Path, most: int) -> bytes:
    """A file's bytes; InputError if it is absent, cannot be read, or has more than `most`."""
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            raise InputError("is not a file", file=path)
        with path.open("rb") as file:
            # No more than is there is asked for, since that much is allocated.
            content = file.read(min(most, os.fstat(file.fileno()).st_size) + 1)
    except FileNotFoundError:
        raise InputError("no such file", file=path) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", file=path) from None
    if len(content) > most:
        raise InputError(f"is longer than {size_text(most)}, the most that is read", file=path)
    return content
