"""Float32 EXR images in and out, with exact settings and checksums in one JSON attribute called `wallmirror`.

OpenEXR itself notices little: it reads most byte-flipped files without a word, prints its complaint about a file
cut short on stdout or stderr and returns nothing, and reports no error when the disk is full. Hence the checksums,
verified on reading wherever the attribute is present, the header and table that are judged before OpenEXR sees them,
and the reading back of every file before it gets its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import secrets
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError
from wallmirror.exr_chunks import require_sound_chunks
from wallmirror.exr_header import ExrHeader, read_exr_header

Pixels = NDArray[np.float32]

#: Largest rows x columns x channels that `read_exr` allocates unless told otherwise: 512 MiB.
MAX_PIXELS = 2**27

_ATTRIBUTE = "wallmirror"
_SILENCING = threading.Lock()  # the process has one stderr


@dataclass(frozen=True, eq=False)
class ExrImage:
    """The channels of one EXR file.

    Parameters
    ----------
    channels:
        Pixels by channel name, each of shape (H, W), float32.
    half:
        Whether a channel was stored as half floats, by channel name.
    settings:
        What `write_exr` was told; None for files from elsewhere.
    """

    channels: dict[str, Pixels]
    half: dict[str, bool]
    settings: dict[str, Any] | None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), rows and columns."""
        rows, columns = next(iter(self.channels.values())).shape
        return rows, columns


def write_exr(
    path: str | Path, channels: Mapping[str, ArrayLike], *, settings: Mapping[str, Any] | None = None
) -> None:
    """Write float32 channels to an EXR file, wholly or not at all.

    Parameters
    ----------
    channels:
        Arrays by channel name, all of one shape (H, W); float64 is rounded to float32.
    settings:
        Anything that JSON can hold; numbers come back exactly.

    Raises
    ------
    InputError
        If shapes differ, a value is no real number or, though finite, beyond float32, or the file cannot be written; an
        earlier file of that name is then untouched.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_exr(Path(folder) / "a.exr", {"Y": [[0.25, 0.5]]}, settings={"spp": 16})
    ...     read_exr(Path(folder) / "a.exr").channels["Y"].tolist()
    [[0.25, 0.5]]
    """
    path = Path(path)
    pixels = {name: _float32(values, name, path) for name, values in channels.items()}
    if len({array.shape for array in pixels.values()}) != 1 or "" in pixels:
        raise InputError("needs one channel at least, each with a name and all of one size", file=path)
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        _ATTRIBUTE: _attribute(pixels, settings),
    }
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with OpenEXR.File(header, dict(pixels)) as file:
            file.write(str(scratch))
        read_exr(scratch, max_pixels=sum(array.size for array in pixels.values()))
        scratch.replace(path)
    except (OSError, RuntimeError, ValueError, InputError) as error:
        raise InputError("cannot be written; is there room on the disk, and permission?", file=path) from error
    finally:
        scratch.unlink(missing_ok=True)


def read_exr(path: str | Path, *, max_pixels: int = MAX_PIXELS) -> ExrImage:
    """Read the float and half channels of an EXR file, verified where it carries checksums.

    Threads read one after the other, since what OpenEXR prints is diverted meanwhile.

    Parameters
    ----------
    max_pixels:
        Largest rows x columns x channels to allocate; the header is checked against it before any pixel is read.

    Raises
    ------
    InputError
        If the file is missing, no EXR file, damaged, cut short, altered, too large, or holds anything but one flat
        image. Values are not judged: NaN and infinity pass.
    """
    path = Path(path)
    header = read_exr_header(path, max_samples=max_pixels)
    require_sound_chunks(path, header)
    loaded = _load(path)
    if {name: array.shape for name, array in loaded.items()} != dict.fromkeys(
        header.channels, (header.rows, header.columns)
    ):
        raise InputError("is damaged or cut short: OpenEXR reads other channels than its header states", file=path)
    half = {name: array.dtype == np.float16 for name, array in loaded.items() if array.dtype.kind == "f"}
    if not half:
        raise InputError("holds no channel of floats", file=path)
    channels = {name: np.ascontiguousarray(loaded.pop(name), dtype=np.float32) for name in half}
    return ExrImage(channels, half, _verified_settings(path, header, channels))


def _float32(values: ArrayLike, name: str, path: Path) -> Pixels:
    exact = np.asarray(values)
    if exact.dtype.kind not in "fiub":
        raise InputError(f"holds {exact.dtype}; give real numbers", file=path, field=name)
    with np.errstate(over="ignore"):
        # OpenEXR writes Fortran-ordered and strided arrays wrongly without a word.
        rounded = np.ascontiguousarray(exact, dtype=np.float32)
    if rounded.ndim != 2 or rounded.size == 0:
        raise InputError(f"has shape {rounded.shape}; give rows and columns", file=path, field=name)
    if np.any(np.isinf(rounded) & np.isfinite(exact)):
        raise InputError("holds a value beyond float32 (3.4e38)", file=path, field=name)
    return rounded


def _load(path: Path) -> dict[str, NDArray[Any]]:
    """Pixels of a single-part file: OpenEXR drops a damaged part with no more than a line on stdout or stderr."""
    try:
        with _silence(), OpenEXR.File(str(path), separate_channels=True) as file:
            if file.parts:
                # Copied, since leaving the block empties it.
                return {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:  # UnicodeDecodeError, from flipped names, is a ValueError
        raise InputError("is damaged or cut short: OpenEXR cannot read it", file=path) from error
    raise InputError("is damaged or cut short: OpenEXR cannot read its pixels", file=path)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop what Python prints and what C code writes to stderr: a refusal is one sentence."""
    with _SILENCING, contextlib.redirect_stdout(io.StringIO()):
        try:
            sys.stderr.flush()
            kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        except (OSError, ValueError, AttributeError):  # a process without a stderr
            yield
            return
        try:
            os.dup2(nowhere, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)


def _attribute(channels: Mapping[str, Pixels], settings: Mapping[str, Any] | None) -> str:
    text = json.dumps(None if settings is None else dict(settings), allow_nan=False)
    return json.dumps(
        {
            "settings": json.loads(text),
            "sha256": {name: _pixel_digest(array) for name, array in channels.items()},
            "settings_sha256": _settings_digest(json.loads(text)),
        }
    )


def _verified_settings(path: Path, header: ExrHeader, channels: Mapping[str, Pixels]) -> dict[str, Any] | None:
    """The settings in the attribute once its checksums agree with pixels and settings; None without attribute."""
    if _ATTRIBUTE.encode() not in header.attributes:
        return None
    kind, text = header.attributes[_ATTRIBUTE.encode()]
    try:
        carried = json.loads(text if kind == b"string" else b"")
        settings, pixel_sums, settings_sum = (carried[k] for k in ("settings", "sha256", "settings_sha256"))
    except (ValueError, TypeError, KeyError, RecursionError):
        raise InputError("was altered: its wallmirror attribute cannot be read", file=path) from None
    for name, array in channels.items():
        if not isinstance(pixel_sums, dict) or pixel_sums.get(name) != _pixel_digest(array):
            raise InputError(f"was altered: the pixels of channel {name} do not match their checksum", file=path)
    if len(pixel_sums) != len(channels) or settings_sum != _settings_digest(settings):
        raise InputError("was altered: its settings do not match their checksum", file=path)
    if not (settings is None or isinstance(settings, dict)):
        raise InputError("was altered: its settings are no table", file=path)
    return settings


def _pixel_digest(pixels: Pixels) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels, dtype="<f4").data).hexdigest()


def _settings_digest(settings: Any) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
