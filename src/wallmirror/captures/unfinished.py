"""A capture set in the making: each finished capture is kept, so that a run that was cut short goes on where it was.

Captures lie in a folder beside the set's own, called NAME.unfinished, as the complete and verified EXR files that the
set will consist of. What they were rendered with stands in each of them, so nothing else is needed to go on. When the
last one is there, the folder takes the place of an earlier set.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.captures.capture_set import CaptureSet, Truth
from wallmirror.captures.reading import CAPTURES_FILE, TRUTH_FILE
from wallmirror.captures.writing import (
    capture_settings,
    file_names,
    recover_swap,
    require_replaceable,
    swap,
    write_texts,
)
from wallmirror.errors import InputError, shown
from wallmirror.exr import read_exr, write_exr

Pixels = NDArray[np.float32]

_NAME = re.compile(r"view(\d+)_real(\d+)(_variance)?\.exr")
_LEFT_OVER = re.compile(r"\..+\.[0-9a-f]{8}\.partial|\.(captures\.toml|truth\.json)\.\w+")


def unfinished_folder(directory: str | Path) -> Path:
    """Where the finished captures of an unfinished set lie."""
    target = Path(directory).resolve()
    return target.with_name(f"{target.name}.unfinished")


def unfinished_settings(directory: str | Path) -> dict[str, Any] | None:
    """What the first capture of an unfinished set was rendered with; None where there is none that can be read."""
    for path in sorted(unfinished_folder(directory).glob("view*_real*.exr")):
        with contextlib.suppress(InputError):
            return read_exr(path).settings
    return None


class UnfinishedSet:
    """The captures of a set that are there already, and a place for the others.

    Parameters
    ----------
    directory:
        Folder of the set, as for `write_captures`.
    settings:
        Exact settings of the render, as for `write_captures`; only captures with the same ones are taken up.
    restart:
        Throw away what an earlier run left instead.

    Raises
    ------
    InputError
        If either folder holds what wallmirror did not write or cannot be written, or an earlier run with other
        settings left captures; the message names the first difference.
    """

    def __init__(self, directory: str | Path, settings: Mapping[str, Any], *, restart: bool = False) -> None:
        self.target = Path(directory).resolve()
        self.folder = unfinished_folder(directory)
        self._settings = dict(settings)
        self._done: dict[tuple[int, int], tuple[Pixels, Pixels]] = {}
        require_replaceable(self.target)
        try:
            recover_swap(self.target)
            if restart and self.folder.is_dir():
                self._require_ours()
                shutil.rmtree(self.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
            self._take_up()
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror or error})", file=self.folder) from error

    @property
    def finished(self) -> int:
        """Number of captures that are there already."""
        return len(self._done)

    def load(self, view: int, realisation: int) -> tuple[Pixels, Pixels] | None:
        """Radiance and variance of a finished capture, shape (N,) each; None where it is missing."""
        return self._done.get((view, realisation))

    def save(self, view: int, realisation: int, radiance: ArrayLike, variance: ArrayLike) -> tuple[Pixels, Pixels]:
        """Keep a capture; what comes back is what was stored, as float32."""
        lines = tuple(np.atleast_2d(np.asarray(values, dtype=np.float64)) for values in (radiance, variance))
        for (holds, name), line in zip(file_names(view, realisation).items(), lines, strict=True):
            settings = capture_settings(self._settings, view, realisation, holds)
            write_exr(self.folder / name, {"Y": line}, settings=settings)
        kept = lines[0][0].astype(np.float32), lines[1][0].astype(np.float32)
        self._done[view, realisation] = kept
        return kept

    def finish(self, captures: CaptureSet, truth: Truth | None) -> None:
        """Add captures.toml and the truth, and take the place of an earlier set."""
        try:
            write_texts(self.folder, captures, truth)
            swap(self.folder, self.target)
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror or error})", file=self.target) from error

    def close(self) -> None:
        """Leave no empty folder behind; finished captures stay."""
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _require_ours(self) -> None:
        for path in sorted(self.folder.iterdir()):
            if not (_NAME.fullmatch(path.name) or _is_passing(path.name)):
                raise InputError(
                    f'holds "{shown(path.name, quote=False)}", which wallmirror did not write; move it away',
                    file=self.folder,
                )

    def _take_up(self) -> None:
        """Read what an earlier run finished; drop what it was just writing, and what was damaged since."""
        self._require_ours()
        found: dict[tuple[int, int], dict[str, Pixels]] = {}
        for path in sorted(self.folder.iterdir()):
            match = _NAME.fullmatch(path.name)
            if match is None:
                path.unlink()
                continue
            try:
                image = read_exr(path)
            except InputError:
                path.unlink()
                continue
            view, realisation = int(match[1]), int(match[2])
            holds = "variance" if match[3] else "radiance"
            self._require_same(image.settings, capture_settings(self._settings, view, realisation, holds))
            found.setdefault((view, realisation), {})[holds] = image.channels["Y"][0]
        self._done = {
            pair: (images["radiance"], images["variance"]) for pair, images in found.items() if len(images) == 2
        }

    def _require_same(self, earlier: Mapping[str, Any] | None, now: Mapping[str, Any]) -> None:
        if earlier == now:
            return
        was = earlier or {}
        name = next(key for key in (*now, *was) if was.get(key) != now.get(key))
        raise InputError(
            f"holds captures of an unfinished run with other settings: {shown(name, quote=False)} was "
            f"{shown(was.get(name))} and is {shown(now.get(name))}; run that one again, or --restart to throw them away",
            file=self.folder,
        )


def _is_passing(name: str) -> bool:
    """Whether a file is one that a run adds last or was just writing."""
    return name in (CAPTURES_FILE, TRUTH_FILE) or bool(_LEFT_OVER.fullmatch(name))
