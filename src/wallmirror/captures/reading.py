"""Reading a capture set: captures.toml, the EXR files it names, and truth.json if it is there.

Every fault is refused with file and field. Values are taken in the units of the stored pixels and divided by the
exposure last, so that saturation and variances of a camera can be given as the camera states them.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures.capture_set import CaptureSet, Truth
from wallmirror.errors import InputError, shown
from wallmirror.exr import ExrImage, read_exr
from wallmirror.fields import Fields, read_toml
from wallmirror.files import read_bounded
from wallmirror.geometry import Observer
from wallmirror.scene import read_card, read_observer, read_room, require_affordable_films
from wallmirror.transport import Weights

Array = NDArray[np.float64]

#: Names of the two text files in the folder of a capture set.
CAPTURES_FILE = "captures.toml"
TRUTH_FILE = "truth.json"

# Half the distance of neighbouring numbers: relative for normal numbers, absolute for denormal ones.
_HALF_ULP = (2.0**-11, 2.0**-25)
_FLOAT_ULP = (2.0**-24, 2.0**-150)
_MAX_EXPOSURE = 1e12
# 64 MiB: a truth of three million numbers.
_MAX_TRUTH_BYTES = 2**26


@dataclass(frozen=True)
class _Capture:
    """One table [[captures]], checked, its files still unread."""

    fields: Fields
    file: Path
    variance_file: Path | None
    view: int
    realisation: int
    channel: str
    row: int | None
    exposure: float
    saturation: float


@dataclass(frozen=True)
class _Line:
    """One capture's radiance and variance, shape (N,), and what its variance rests on."""

    radiance: Array
    variance: Array
    half: bool


def read_captures(directory: str | Path) -> CaptureSet:
    """Read the capture set that a folder holds: captures.toml and the EXR files that it names.

    Pixels at or above `saturation` get an infinite variance, and an infinite one in a file says the same. Where
    variances are known, files hold half floats, or a pixel is saturated, the rounding of the stored numbers adds its
    variance; else `variance` is None. `channel` and `row` (the centre one, rows // 2, if absent) of a capture hold
    for its variance file as well.

    Raises
    ------
    InputError
        For everything missing, doubled, of another size, not finite, altered, misspelt or out of range, and for a
        path that leaves the folder; the message names file and field.

    Examples
    --------
    >>> read_captures("my_captures")  # doctest: +SKIP
    CaptureSet(observer=Observer(position=(0.0, -5.0), ...
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"no such folder; give the one that holds {CAPTURES_FILE}", file=directory)
    root = read_toml(directory / CAPTURES_FILE)
    try:
        return _capture_set(root)
    except InputError as error:
        raise error.located(file=root.file) from None


def read_truth(directory: str | Path) -> Truth | None:
    """The truth beside a rendered capture set; None where there is none.

    Raises
    ------
    InputError
        If truth.json is there but malformed.
    """
    path = Path(directory) / TRUTH_FILE
    if not path.exists():
        return None
    try:
        table = json.loads(read_bounded(path, _MAX_TRUTH_BYTES))
        if not isinstance(table, dict) or table.pop("format", None) != 1 or set(table) != _TRUTH_FIELDS:
            raise InputError(f"needs format 1 and the fields {', '.join(sorted(_TRUTH_FIELDS))}", file=path)
        values = {name: np.asarray(entry) for name, entry in table.items()}
    except (OSError, ValueError, RecursionError):
        raise InputError("is not the JSON that wallmirror writes", file=path) from None
    for name, array in values.items():
        if array.dtype.kind not in "fiu" and array.size:
            raise InputError("holds something that is no number", file=path, field=name)
    try:
        return Truth(
            source=values["source"],
            theta_s=np.radians(values["theta_s_deg"]),
            theta_o=np.radians(values["theta_o_deg"]),
            brdf=values["brdf"],
        )
    except InputError as error:
        raise error.located(file=path) from None


_TRUTH_FIELDS = {"source", "theta_s_deg", "theta_o_deg", "brdf"}


def _capture_set(root: Fields) -> CaptureSet:
    if root.integer("format") != 1:
        raise root.error("format", "is not 1, the only format of capture sets that this version reads")
    weights: Sequence[Weights] = get_args(Weights)
    transport = root.choice("transport", weights)
    observer_fields = root.table("observer")
    channel = _holder(root, observer_fields, "channel").text("channel", "Y")
    row = _row_number(_holder(root, observer_fields, "row"))
    observer = read_observer(observer_fields)
    card = read_card(root.table("card"))
    room = read_room(root.table("room")) if root.has("room") else None
    provenance = root.table("provenance", required=False).texts()
    variance_is_floor = root.flag("variance_is_floor", False)
    captures = [_capture(fields, observer, channel, row) for fields in root.tables("captures")]
    root.finish()
    realisations = _require_complete(root, captures, observer)
    require_affordable_films(observer, realisations=realisations, elements=card.elements)

    read = functools.lru_cache(maxsize=2)(read_exr)  # colours of one file are captures of their own
    shape = (observer.views, observer.pixels, realisations)
    radiance, variance = np.empty(shape), np.empty(shape)
    is_known = False
    for capture in captures:
        line = _line(capture, observer, read)
        radiance[capture.view, :, capture.realisation] = line.radiance
        variance[capture.view, :, capture.realisation] = line.variance
        is_known |= line.half or capture.variance_file is not None or bool(np.isinf(line.variance).any())
    measured = captures[0].variance_file is not None
    if variance_is_floor and not measured:
        raise root.error("variance_is_floor", "is true, but no capture names a variance_file")
    return CaptureSet(
        observer=observer,
        card=card,
        transport=next(w for w in weights if w == transport),
        radiance=radiance,
        variance=variance if is_known else None,
        variance_is_floor=is_known and (variance_is_floor or not measured),
        room=room,
        provenance=provenance,
    )


def _holder(root: Fields, observer: Fields, name: str) -> Fields:
    """The table that sets a default for all captures: the top of the file or [observer], but not both."""
    if root.has(name) and observer.has(name):
        raise root.error(name, "is given twice, here and in [observer]; keep one")
    return root if root.has(name) else observer


def _row_number(fields: Fields) -> int | None:
    return fields.integer("row", high=1_000_000) if fields.has("row") else None


def _capture(fields: Fields, observer: Observer, channel: str, row: int | None) -> _Capture:
    exposure = fields.number("exposure", 1.0, low=1 / _MAX_EXPOSURE, high=_MAX_EXPOSURE)
    saturation = fields.number("saturation", low=0.0) if fields.has("saturation") else math.inf
    if saturation == 0:
        raise fields.error("saturation", "is 0; give the pixel value, above 0, at which the camera clips")
    own_row = _row_number(fields)
    capture = _Capture(
        fields=fields,
        file=fields.inside("file", "set's"),
        variance_file=fields.inside("variance_file", "set's") if fields.has("variance_file") else None,
        view=fields.integer("view", high=observer.views - 1),
        realisation=fields.integer("realisation"),
        channel=fields.text("channel", channel),
        row=row if own_row is None else own_row,
        exposure=exposure,
        saturation=saturation,
    )
    fields.finish()
    return capture


def _require_complete(root: Fields, captures: list[_Capture], observer: Observer) -> int:
    """B, once every (view, realisation) has exactly one capture, and each capture its own pixels."""
    if not captures:
        raise root.error("captures", "is empty; give one table [[captures]] for each view and realisation")
    pairs: dict[tuple[int, int], Fields] = {}
    origins: dict[tuple[Path, str, int | None], Fields] = {}
    for capture in captures:
        pair = (capture.view, capture.realisation)
        if pair in pairs:
            message = f"view {pair[0]}, realisation {pair[1]} is captured twice, in {pairs[pair].path} and here"
            raise capture.fields.error("realisation", message)
        pairs[pair] = capture.fields
        origin = (capture.file.resolve(), capture.channel, capture.row)
        if origin in origins:
            message = f'"{capture.file.name}" already serves {origins[origin].path}; each capture needs its own pixels'
            raise capture.fields.error("file", message)
        origins[origin] = capture.fields
        if (capture.variance_file is None) != (captures[0].variance_file is None):
            raise capture.fields.error("variance_file", "is given for some captures only; give it for all or for none")
    realisations = 1 + max(realisation for _, realisation in pairs)
    missing = observer.views * realisations - len(pairs)
    if missing:
        # Among the first len(pairs) + 1 pairs one must be missing, however large a realisation's number is.
        view, realisation = next(
            (view, b) for b in range(realisations) for view in range(observer.views) if (view, b) not in pairs
        )
        more = f" (and {missing - 1} more)" if missing > 1 else ""
        raise root.error("captures", f"view {view}, realisation {realisation} is missing{more}; capture every pair")
    return realisations


def _line(capture: _Capture, observer: Observer, read: Callable[[Path], ExrImage]) -> _Line:
    image = _image(capture, "file", capture.file, read)
    pixels = _pixels(capture, "file", capture.file, image, observer)
    _require(np.isfinite(pixels), capture, "file", capture.file, pixels, "give finite radiances")
    relative, absolute = _HALF_ULP if image.half[capture.channel] else _FLOAT_ULP
    variance = np.maximum(relative * np.abs(pixels), absolute) ** 2 / 3
    if capture.variance_file is not None:
        beside = _image(capture, "variance_file", capture.variance_file, read)
        if beside.shape != image.shape:
            raise capture.fields.error(
                "variance_file",
                f'"{capture.variance_file.name}" has {_size(beside)} pixels, but "{capture.file.name}" {_size(image)}',
            )
        stated = _pixels(capture, "variance_file", capture.variance_file, beside, observer)
        _require(stated >= 0, capture, "variance_file", capture.variance_file, stated, "give variances >= 0")
        variance += stated
    variance[pixels >= capture.saturation] = np.inf
    return _Line(pixels / capture.exposure, variance / capture.exposure**2, image.half[capture.channel])


def _image(capture: _Capture, name: str, path: Path, read: Callable[[Path], ExrImage]) -> ExrImage:
    try:
        return read(path)
    except InputError as error:
        # The fault lies in a file that the field names: both belong into the sentence.
        raise capture.fields.error(name, f'"{path.name}" {error.message}') from error


def _pixels(capture: _Capture, name: str, path: Path, image: ExrImage, observer: Observer) -> Array:
    """The row and channel of an image that a capture uses, shape (N,)."""
    rows, columns = image.shape
    if capture.channel not in image.channels:
        asked, held = (shown(text, quote=False) for text in (capture.channel, ", ".join(image.channels)))
        raise capture.fields.error(name, f'"{path.name}" has no channel "{asked}"; it holds: {held}')
    if columns != observer.pixels:
        raise capture.fields.error(
            name, f'"{path.name}" is {columns} pixels wide, but observer.pixels is {observer.pixels}'
        )
    row = rows // 2 if capture.row is None else capture.row
    if row >= rows:
        raise capture.fields.error(name, f'"{path.name}" has {rows} rows, so no row {row}')
    line: Array = image.channels[capture.channel][row].astype(np.float64)
    return line


def _require(good: NDArray[np.bool_], capture: _Capture, name: str, path: Path, pixels: Array, advice: str) -> None:
    if not good.all():
        j = int(np.argmin(good))
        raise capture.fields.error(name, f'"{path.name}" holds {pixels[j]:g} at pixel {j}; {advice}')


def _size(image: ExrImage) -> str:
    rows, columns = image.shape
    return f"{columns} x {rows}"
