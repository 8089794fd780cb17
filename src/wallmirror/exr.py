"""Float32 EXR images in and out, with exact settings and checksums in one JSON attribute called `wallmirror`.

OpenEXR itself notices little: it reads most byte-flipped files without a word, prints its complaint about a file
cut short on stdout and returns nothing, and reports no error when the disk is full. Hence the checksums, verified
on reading wherever the attribute is present, and the reading back of every file before it gets its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError

Pixels = NDArray[np.float32]

#: Largest rows x columns x channels that `read_exr` allocates unless told otherwise: 512 MiB.
MAX_PIXELS = 2**27

_ATTRIBUTE = "wallmirror"
_MAGIC = b"\x76\x2f\x31\x01"


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
        If shapes differ, a finite value is beyond float32, or the file cannot be written; an earlier file of that
        name is then untouched.

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

    Not for several threads at once: sys.stdout is diverted meanwhile.

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
    _require_exr(path)
    header, _ = _load(path, header_only=True)
    _require_flat_and_small(path, header, max_pixels)
    header, loaded = _load(path, header_only=False)
    half = {name: array.dtype == np.float16 for name, array in loaded.items() if array.dtype.kind == "f"}
    if not half:
        raise InputError("holds no channel of floats", file=path)
    channels = {name: np.ascontiguousarray(loaded[name], dtype=np.float32) for name in half}
    return ExrImage(channels, half, _verified_settings(path, header, channels))


def _float32(values: ArrayLike, name: str, path: Path) -> Pixels:
    exact = np.asarray(values)
    with np.errstate(over="ignore"):
        # OpenEXR writes Fortran-ordered and strided arrays wrongly without a word.
        rounded = np.ascontiguousarray(exact, dtype=np.float32)
    if rounded.ndim != 2 or rounded.size == 0:
        raise InputError(f"has shape {rounded.shape}; give rows and columns", file=path, field=name)
    if np.any(np.isinf(rounded) & np.isfinite(exact)):
        raise InputError("holds a value beyond float32 (3.4e38)", file=path, field=name)
    return rounded


def _load(path: Path, *, header_only: bool) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and pixels of a single-part file: OpenEXR drops a damaged part with no more than a line on stdout."""
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file,
        ):
            parts = len(file.parts)
            if parts == 1:
                # Copied, since leaving the block empties both.
                header = dict(file.header())
                return header, {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:  # UnicodeDecodeError, from flipped names, is a ValueError
        raise InputError("is damaged or cut short: OpenEXR cannot read it", file=path) from error
    if parts > 1:
        raise InputError(f"holds {parts} images; give a file with one", file=path)
    raise InputError("is damaged or cut short: OpenEXR cannot read its pixels", file=path)


def _require_exr(path: Path) -> None:
    """Refuse what is no EXR file, which OpenEXR would also announce on stderr."""
    if not path.exists():
        raise InputError("no such file", file=path)
    if not path.is_file():
        raise InputError("is not a file", file=path)
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None
    if start != _MAGIC:
        raise InputError("is empty" if not start else "is not an EXR file", file=path)


def _require_flat_and_small(path: Path, header: dict[str, Any], max_pixels: int) -> None:
    if header.get("type", OpenEXR.scanlineimage) not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise InputError("is a deep EXR file; give a flat one", file=path)
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in header["channels"]):
        raise InputError("has channels at reduced resolution; give every channel all its pixels", file=path)
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    rows, columns = bottom - top + 1, right - left + 1
    samples = rows * columns * len(header["channels"])
    if rows < 1 or columns < 1 or samples > max_pixels:
        raise InputError(
            f"states {columns} x {rows} pixels in {len(header['channels'])} channels; "
            f"at least one and at most {max_pixels} numbers are read",
            file=path,
        )


def _attribute(channels: Mapping[str, Pixels], settings: Mapping[str, Any] | None) -> str:
    text = json.dumps(None if settings is None else dict(settings), allow_nan=False)
    return json.dumps(
        {
            "settings": json.loads(text),
            "sha256": {name: _pixel_digest(array) for name, array in channels.items()},
            "settings_sha256": _settings_digest(json.loads(text)),
        }
    )


def _verified_settings(path: Path, header: Mapping[str, Any], channels: Mapping[str, Pixels]) -> dict[str, Any] | None:
    """The settings in the attribute once its checksums agree with pixels and settings; None without attribute."""
    if _ATTRIBUTE not in header:
        return None
    try:
        carried = json.loads(header[_ATTRIBUTE])
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
    return hashlib.sha256(pixels.astype("<f4").tobytes()).hexdigest()


def _settings_digest(settings: Any) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
