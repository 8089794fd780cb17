"""Scenes: each field at its ends is refused, or kept as Python reads it and makes films without a NaN or a warning."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

import wallmirror as wm

from .capture_sets import folder
from .harness import Case

_SCENE: dict[str, dict[str, Any]] = {
    "": {"format": 1, "title": '"t"'},
    "wall": {
        "brdf": '"gaussian_train"',
        "centres_deg": "[0.0]",
        "sigma_deg": 5.0,
        "scale": 1.0,
        "half_width": 50.0,
        "half_height": 50.0,
        "diffuse_albedo": 0.1,
    },
    "observer": {"position": "[0.0, -5.0]", "fov_deg": 40.0, "view_angles_deg": "[5.0]", "pixels": 8},
    "card": {
        "elements_x": "[-0.5, 0.5]",
        "y": -1.0,
        "element_width": 0.02,
        "element_height": 0.03,
        "albedo": 0.1,
        "board_width": 2.0,
        "board_height": 1.0,
    },
    "source": {"level": 1.0, "realisations": 2, "seed": 1},
    "room": {"half_width": 10.0, "half_height": 10.0, "depth": 20.0, "albedo": 0.5},
    "render": {"max_depth": 4, "spp": 16, "rr_depth": 5},
}
_VALUES = (
    "0",
    "-1",
    "1e-300",
    "1e300",
    "-1e300",
    "inf",
    "-inf",
    "nan",
    "1e400",
    '"1"',
    "true",
    "[]",
    "{}",
    "[nan]",
    "1" * 400,
)


def scene_text(table: str, name: str, value: str) -> str:
    blocks = []
    for title, fields in _SCENE.items():
        given = {**fields, **({name: value} if title == table else {})}
        blocks.append("\n".join([*([f"[{title}]"] if title else []), *(f"{k} = {v}" for k, v in given.items())]))
    return "\n".join(blocks) + "\n"


def loaded(text: str) -> wm.Scene:
    with folder() as at:
        (at / "scene.toml").write_text(text)
        return wm.load_scene(at / "scene.toml")


def kept_value(scene: wm.Scene, table: str, name: str) -> Any:
    """What became of a field."""
    at = {
        "wall": scene.wall,
        "observer": scene.observer,
        "card": scene.card,
        "room": scene.room,
        "render": scene.render,
    }.get(table)
    if table == "wall" and name in ("sigma_deg", "scale"):
        (train, _) = scene.wall.brdf.parts  # type: ignore[attr-defined]
        return math.degrees(train.sigma) if name == "sigma_deg" else train.scale
    if table == "observer" and name == "fov_deg":
        return math.degrees(scene.observer.fov)
    return getattr(at, name, None)


def cases() -> Iterator[Case]:
    for table, fields in _SCENE.items():
        for name, value in itertools.product(fields, _VALUES):

            def field(t: str = table, n: str = name, v: str = value) -> tuple[float, float]:
                scene = loaded(scene_text(t, n, v))  # refused, most of them
                # What is accepted must stand there as Python reads it, and make films without NaN or a warning, or refuse to.
                kept = kept_value(scene, t, n)
                if kept is not None and (
                    not isinstance(kept, (int, float)) or abs(kept - float(v)) > 1e-12 * abs(float(v))
                ):
                    raise RuntimeError(f"became {kept}")
                if not np.all(np.isfinite(scene.source)):
                    return math.nan, 0.0
                films = wm.radiance(wm.transport_matrix(scene.observer, scene.card, scene.wall.brdf), scene.source)
                return (math.nan if not np.all(np.isfinite(films)) else 0.0), 1.0

            yield Case("load_scene", f"{table}.{name}" if table else name, value[:12], field)
