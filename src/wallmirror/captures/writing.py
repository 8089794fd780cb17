"""Writing a capture set: EXR files, captures.toml and, for renders, truth.json, all at once or not at all."""

from __future__ import annotations

import json
import math
import re
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wallmirror.captures.capture_set import CaptureSet, Truth
from wallmirror.captures.reading import CAPTURES_FILE, TRUTH_FILE
from wallmirror.errors import InputError
from wallmirror.exr import write_exr
from wallmirror.files import write_atomically

_OWN_FILES = re.compile(rf"view\d+_real\d+(_variance)?\.exr|{re.escape(CAPTURES_FILE)}|{re.escape(TRUTH_FILE)}")
_NOTE = b"# Written by wallmirror, which may replace this folder; remove this line to keep it."
_LEAST_NORMAL = float(np.finfo(np.float32).tiny)
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def write_captures(
    directory: str | Path,
    captures: CaptureSet,
    *,
    settings: Mapping[str, Any] | None = None,
    truth: Truth | None = None,
) -> None:
    """Write a capture set to a folder of its own: float32 EXR files, one row each, and captures.toml.

    Everything is written beside the folder first and then takes its place, so that a write that is refused, fails
    or is interrupted leaves an earlier set whole.

    Parameters
    ----------
    directory:
        A new folder, an empty one, or one that `write_captures` wrote, which is replaced.
    settings:
        Exact settings of the render, kept in every EXR file together with its view and realisation.
    truth:
        What was rendered, kept in truth.json.

    Raises
    ------
    InputError
        If the folder holds anything else, a value is beyond float32, radiance or variance so small that float32 rounds it
        away, or the disk refuses.

    Examples
    --------
    >>> write_captures("out/captures", captures, settings={"spp": 1024})  # doctest: +SKIP
    """
    # Links are followed: the folder itself is replaced, not the link to it.
    target = Path(directory).resolve()
    shape = (captures.card.elements, captures.realisations)
    if truth is not None and truth.source.shape != shape:
        raise InputError(f"has shape {truth.source.shape}; give {shape}", field="truth.source")
    _require_kept(captures)
    scratch = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    try:
        require_replaceable(target)
        recover_swap(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch.mkdir()
        _write_images(scratch, captures, settings or {})
        write_texts(scratch, captures, truth)
        swap(scratch, target)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror or error})", file=target) from error
    except InputError as error:
        named = str(error.file).replace(str(scratch), str(target))  # the scratch folder is gone when this is read
        raise InputError(error.message, file=named, field=error.field) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _require_kept(captures: CaptureSet) -> None:
    """Refuse films that float32 would store as dark, and noise that it would store as none."""
    brightest = float(np.max(np.abs(captures.radiance)))
    if 0 < brightest < _LEAST_NORMAL:
        raise InputError(
            f"is {brightest:.2g} at most, which float32 files hold hardly or not at all; choose a smaller unit",
            field="radiance",
        )
    if captures.variance is not None:
        # Faint pixels beside brighter ones may lose theirs, and noise below the rounding of the radiance.
        largest = float(np.max(captures.variance, initial=0.0, where=np.isfinite(captures.variance)))
        if (2.0**-24 * brightest) ** 2 < largest < _LEAST_NORMAL:
            raise InputError(
                f"is {largest:.2g} at most, which float32 files hold hardly or not at all; choose a smaller unit of the "
                "radiance",
                field="variance",
            )


def require_replaceable(target: Path) -> None:
    """Refuse to replace anything but an empty folder or a set that `write_captures` wrote."""
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError("is a file; give a folder for the capture set", file=target)
    names = sorted(entry.name for entry in target.iterdir())
    foreign = [name for name in names if not _OWN_FILES.fullmatch(name)]
    if names and not foreign and not _is_written_by_us(target / CAPTURES_FILE):
        foreign = names
    if foreign:
        raise InputError(f'holds "{foreign[0]}", which wallmirror did not write; choose another folder', file=target)


def _is_written_by_us(captures_file: Path) -> bool:
    """Whether a captures.toml begins with our note: a set made by hand holds photographs that nobody can remake."""
    if not captures_file.is_file():
        return False
    with captures_file.open("rb") as file:
        return file.readline(len(_NOTE) + 1).strip() == _NOTE


def swap(scratch: Path, target: Path) -> None:
    """Put a folder in the place of an earlier set; whatever happens, one of them is there in the end."""
    if not target.exists():
        scratch.rename(target)
        return
    earlier = _earlier(target)
    target.rename(earlier)
    try:
        scratch.rename(target)
    except BaseException:  # an interrupt, too, must not leave the set under its other name
        earlier.rename(target)
        raise
    shutil.rmtree(earlier, ignore_errors=True)


def recover_swap(target: Path) -> None:
    """Undo a swap that a kill or a power cut left half done."""
    earlier = _earlier(target)
    if not earlier.is_dir():
        return
    require_replaceable(earlier)
    if target.exists():
        shutil.rmtree(earlier)
    else:
        earlier.rename(target)


def _earlier(target: Path) -> Path:
    return target.with_name(f".{target.name}.earlier")


def file_names(view: int, realisation: int) -> dict[str, str]:
    """Names of a capture's files by what they hold: "radiance" and "variance"."""
    stem = f"view{view:02d}_real{realisation:02d}"
    return {"radiance": f"{stem}.exr", "variance": f"{stem}_variance.exr"}


def capture_settings(settings: Mapping[str, Any], view: int, realisation: int, holds: str) -> dict[str, Any]:
    """What a capture's EXR file says of how it was made."""
    return {**settings, "view": view, "realisation": realisation, "holds": holds}


def _write_images(folder: Path, captures: CaptureSet, settings: Mapping[str, Any]) -> None:
    for view in range(captures.observer.views):
        for realisation in range(captures.realisations):
            names = file_names(view, realisation)
            for holds, values in (("radiance", captures.radiance), ("variance", captures.variance)):
                if values is not None:
                    row = values[view, :, realisation][np.newaxis]
                    exact = capture_settings(settings, view, realisation, holds)
                    write_exr(folder / names[holds], {"Y": row}, settings=exact)


def write_texts(folder: Path, captures: CaptureSet, truth: Truth | None) -> None:
    """Write captures.toml, which names the EXR files, and truth.json."""
    entries = []
    for view in range(captures.observer.views):
        for realisation in range(captures.realisations):
            names = file_names(view, realisation)
            entry: dict[str, Any] = {"file": names["radiance"], "view": view, "realisation": realisation}
            if captures.variance is not None:
                entry["variance_file"] = names["variance"]
            entries.append(entry)
    write_atomically(folder / CAPTURES_FILE, _toml(captures, entries))
    if truth is not None:
        write_atomically(folder / TRUTH_FILE, _truth_json(truth))


def _toml(captures: CaptureSet, entries: list[dict[str, Any]]) -> str:
    observer, card, room = captures.observer, captures.card, captures.room
    top: dict[str, Any] = {"format": 1, "transport": captures.transport}
    if captures.variance_is_floor:
        top["variance_is_floor"] = True
    tables: list[tuple[str, Mapping[str, Any]]] = [
        ("", top),
        (
            "[observer]",
            {
                "position": observer.position,
                "fov_deg": exact_degrees(observer.fov),
                "view_angles_deg": tuple(exact_degrees(angle) for angle in observer.view_angles),
                "pixels": observer.pixels,
                "pixels_at": observer.pixels_at,
            },
        ),
        (
            "[card]",
            {
                "elements_x": card.elements_x,
                "y": card.y,
                "element_width": card.element_width,
                "element_height": card.element_height,
                "albedo": card.albedo,
                "board_width": card.board_width,
                "board_height": card.board_height,
            },
        ),
    ]
    if room is not None:
        tables.append(("[room]", vars(room)))
    if captures.provenance:
        tables.append(("[provenance]", captures.provenance))
    tables.extend(("[[captures]]", entry) for entry in entries)
    blocks = ("\n".join([*([title] if title else []), *_lines(table)]) for title, table in tables)
    return "\n\n".join([_NOTE.decode(), *blocks]) + "\n"


def _lines(table: Mapping[str, Any]) -> list[str]:
    return [f"{name if _BARE_KEY.fullmatch(name) else _quoted(name)} = {_value(v)}" for name, v in table.items()]


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    return repr(float(value))  # the shortest text that reads back as the same number


def _quoted(text: str) -> str:
    """A TOML string: JSON's escapes are TOML's, save that TOML escapes DEL as well."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def exact_degrees(angle: float) -> float:
    """The number of degrees that reads back as the same radians, or where no such float exists as a neighbour's.

    Examples
    --------
    >>> exact_degrees(math.radians(16.1))
    16.1
    """
    degrees = math.degrees(angle)
    nearby = (round(degrees, 9), degrees, math.nextafter(degrees, math.inf), math.nextafter(degrees, -math.inf))
    return next((d for d in nearby if math.radians(d) == angle), degrees)


def _truth_json(truth: Truth) -> str:
    return json.dumps(
        {
            "format": 1,
            "source": truth.source.tolist(),
            "theta_s_deg": np.degrees(truth.theta_s).tolist(),
            "theta_o_deg": np.degrees(truth.theta_o).tolist(),
            "brdf": truth.brdf.tolist(),
        },
        indent=1,
    )
