"""From a Scene to Mitsuba: wall, card, room and integrator as the dictionaries that `mi.load_dict` takes.

Every function that returns a dictionary needs a variant to be set (`runtime.activate`), because transforms belong to
one. Load with `mi.load_dict(..., optimize=False)`: the optimisation merges equal materials in an order that changes
from load to load, and with it the emitters' order and every sample drawn from them; without it, loads render alike.

What the path tracer sees differs from the Scene in three ways:

- BRDFs of the angle sum are tables of float32 (`wall_as_rendered` gives what is really there);
- lengths are in units of `cameras.metres_per_unit`, 1 for scenes of ordinary size: Mitsuba starts rays about
  9e-5 (1 + |p|) beside the point p that they leave, which a card closer than one unit would notice;
- the camera looks through the card, which is an emitter, strips and board, so that `hide_emitters` hides it; what it
  sees through a board is displaced sideways by that same 9e-5 (1 + |p|), a hundredth of a pixel in our scenes.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.brdf import BRDF, AngleSumBRDF, AngleSumTable, Diffuse, Mirror, Table, tabulate
from wallmirror.errors import InputError
from wallmirror.pathtracing import bsdf
from wallmirror.pathtracing.cameras import Sampler, metres_per_unit, sensor_dict, to_world
from wallmirror.pathtracing.tables import table_text
from wallmirror.scene import Scene

Array = NDArray[np.float64]

_X = (1.0, 0.0, 0.0)
_Y = (0.0, 1.0, 0.0)
_Z = (0.0, 0.0, 1.0)
_BOARD_GAP = 1e-3  # between strips and board, in card distances: far above float32, far below what light would notice


@dataclass(frozen=True, kw_only=True)
class RenderedTable(AngleSumTable):
    """The float32 table that stands for a smooth model in a render.

    Parameters
    ----------
    smooth_over:
        Angular scale of the model in radians: quadratures need not resolve the nodes, which are far denser.
    """

    smooth_over: float

    @property
    def angular_scale(self) -> float:
        """That of the model which was tabulated, in radians."""
        return self.smooth_over


def wall_as_rendered(scene: Scene) -> BRDF:
    """The wall's BRDF as the path tracer holds it; compare the analytic model with this, not with `scene.wall.brdf`.

    Tables keep their nodes where a plugin can hold them; every other model of the angle sum is tabulated on 7201
    nodes (a lobe of sigma 1 deg is at most 3e-4 of its peak off), or for narrower lobes on proportionally more, up to
    720001. All values are rounded to float32.

    Raises
    ------
    InputError
        For a BRDF that no plugin can hold.
    """
    brdf = scene.wall.brdf
    match brdf:
        case Diffuse():
            return Diffuse(albedo=float(np.float32(brdf.albedo)))
        case Mirror():
            return Mirror(reflectance=float(np.float32(brdf.reflectance)))
        case AngleSumTable() if (brdf.start, brdf.stop) == (-math.pi, math.pi):
            return AngleSumTable(start=brdf.start, stop=brdf.stop, values=_float32(brdf.values))
        case AngleSumBRDF():
            finer = min(100, math.ceil(math.radians(1) / brdf.angular_scale))
            table = tabulate(brdf, 1 + 7200 * finer)
            return RenderedTable(
                start=table.start,
                stop=table.stop,
                values=_float32(table.values),
                smooth_over=brdf.angular_scale,
            )
        case Table():
            return Table(values=_float32(brdf.values))
        case _:
            raise InputError(f"{type(brdf).__name__} cannot be rendered; tabulate it", field="wall.brdf")


def mitsuba_dict(
    scene: Scene,
    view: int | None,
    *,
    radiances: ArrayLike | None = None,
    sampler: Sampler = "independent",
    spp: int | None = None,
    max_depth: int | None = None,
    rr_depth: int | None = None,
    as_text: bool = False,
) -> dict[str, Any]:
    """The scene, its `path` integrator and the camera of one view, for `mi.load_dict(..., optimize=False)`.

    Parameters
    ----------
    view:
        Index of the view; None leaves the camera out.
    radiances:
        One for each of the M strips, in W m^-2 sr^-1; the scene's first realisation if left out.
    spp, max_depth, rr_depth:
        The scene's own settings where left out.
    as_text:
        Write the BRDF's table as text, as XML needs it.

    Returns
    -------
    A dictionary whose strips are called `strip_0` ... `strip_{M-1}`; `radiance_key` names their parameters.

    Raises
    ------
    InputError
        If the card's elements or the pixels are points, which paths never meet, or for a view that is not there.
    """
    values = np.asarray(scene.source[:, 0] if radiances is None else radiances, dtype=np.float64)
    if values.shape != (scene.card.elements,):
        raise InputError(
            f"has shape {values.shape}; give one radiance for each of the {scene.card.elements} strips",
            field="radiances",
        )
    world: dict[str, Any] = {
        "type": "scene",
        "integrator": integrator_dict(
            scene.render.max_depth if max_depth is None else max_depth,
            scene.render.rr_depth if rr_depth is None else rr_depth,
        ),
        "wall": _wall(scene, as_text=as_text),
        **_card(scene, values),
        **_room(scene),
    }
    if view is not None:
        world["sensor"] = sensor_dict(scene, view, sampler=sampler, spp=spp)
    return world


def radiance_key(element: int) -> str:
    """Name of a strip's radiance in `mi.traverse(scene)`."""
    return f"strip_{element}.emitter.radiance.value"


def integrator_dict(max_depth: int, rr_depth: int, *, hide_emitters: bool = True) -> dict[str, Any]:
    """Mitsuba's path tracer; `max_depth` 2 is one bounce, `rr_depth` is where Russian roulette begins."""
    return {"type": "path", "max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}


def export_xml(scene: Scene, path: str | Path, *, view: int = 0, realisation: int = 0) -> None:
    """Write one view of one realisation as an XML file that `mi.load_file(path, optimize=False)` renders alike.

    Whoever loads it must have our plugins registered (`runtime.activate`) unless the wall is diffuse or a mirror.

    Raises
    ------
    InputError
        For a view or realisation that is not there.
    """
    realisations = scene.source.shape[1]
    if not 0 <= realisation < realisations:
        raise InputError(
            f"{realisation} is not there; the realisations are 0 to {realisations - 1}", field="realisation"
        )
    mi = _mitsuba()
    world = mitsuba_dict(scene, view, radiances=scene.source[:, realisation], as_text=True)
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), world)
    mi.parser.write_file(bsdf.declare(state), str(path))


def _float32(values: Array) -> Array:
    """Values rounded as Mitsuba rounds them: to float32, subnormal numbers to zero."""
    rounded = values.astype(np.float32)
    return np.where(rounded < np.finfo(np.float32).tiny, 0.0, rounded).astype(np.float64)


def _mitsuba() -> Any:
    return importlib.import_module("mitsuba")


def _wall(scene: Scene, *, as_text: bool) -> dict[str, Any]:
    wall = scene.wall
    # n = -y and s = +x leave t = n x s = +z: the in-plane angle atan2(w.s, w.n) is our atan2(dx, -dy).
    return {
        **_rectangle(
            scene, (0.0, 0.0, 0.0), normal=(0.0, -1.0, 0.0), along=_X, size=(wall.half_width, wall.half_height)
        ),
        "bsdf": _wall_bsdf(wall_as_rendered(scene), as_text=as_text),
    }


def _wall_bsdf(brdf: BRDF, *, as_text: bool) -> dict[str, Any]:
    match brdf:
        case Diffuse():
            return _diffuse(brdf.albedo)
        case Mirror():
            return {"type": "conductor", "material": "none", "specular_reflectance": brdf.reflectance}
        case AngleSumTable() | Table():
            values = table_text(brdf.values) if as_text else _mitsuba().TensorXf(brdf.values.astype(np.float32))
            plugin = bsdf.TABLE if isinstance(brdf, Table) else bsdf.ANGLE_SUM
            return {"type": plugin, "values" if as_text else "table": values}
        case _:
            raise AssertionError(f"wall_as_rendered gave {type(brdf).__name__}")


def _card(scene: Scene, radiances: Array) -> dict[str, Any]:
    card = scene.card
    if card.is_points:
        raise InputError(
            "points have no radiance that a path could meet; give the strips a width and a height",
            field="card.element_width",
        )
    half_strip = (card.element_width / 2, card.element_height / 2)
    parts: dict[str, Any] = {}
    for element, x in enumerate(card.elements_x):
        parts[f"strip_{element}"] = {
            **_rectangle(scene, (x, card.y, 0.0), normal=_Y, along=_X, size=half_strip),
            "bsdf": _diffuse(card.albedo),
            "emitter": {"type": "area", "radiance": {"type": "uniform", "value": float(radiances[element])}},
        }
    if card.board_width > 0 and card.board_height > 0:
        behind = card.y - _BOARD_GAP * card.distance
        parts["board"] = {
            **_rectangle(
                scene,
                (card.middle, behind, 0.0),
                normal=_Y,
                along=_X,
                size=(card.board_width / 2, card.board_height / 2),
            ),
            "bsdf": _diffuse(card.albedo),
            # Dark, and never chosen for a connection: an emitter only so that the camera looks through it.
            "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 0.0}, "sampling_weight": 0.0},
        }
    return parts


def _room(scene: Scene) -> dict[str, Any]:
    room = scene.room
    if room is None:
        return {}
    w, h, middle = room.half_width, room.half_height, -room.depth / 2
    faces = {
        "floor": ((0.0, middle, -h), _Z, _X, (w, room.depth / 2)),
        "ceiling": ((0.0, middle, h), (0.0, 0.0, -1.0), _X, (w, room.depth / 2)),
        "left": ((-w, middle, 0.0), _X, _Y, (room.depth / 2, h)),
        "right": ((w, middle, 0.0), (-1.0, 0.0, 0.0), _Y, (room.depth / 2, h)),
    }
    return {
        name: {**_rectangle(scene, centre, normal=normal, along=along, size=size), "bsdf": _diffuse(room.albedo)}
        for name, (centre, normal, along, size) in faces.items()
    }


def _diffuse(albedo: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": albedo}}


def _rectangle(
    scene: Scene,
    centre: tuple[float, float, float],
    *,
    normal: tuple[float, float, float],
    along: tuple[float, float, float],
    size: tuple[float, float],
) -> dict[str, Any]:
    """A rectangle of half sizes (along s, along t) in metres; s = `along`, t = n x s: a rotation, never a mirroring."""
    unit = metres_per_unit(scene)
    matrix = np.eye(4)
    matrix[:3, 0] = np.multiply(along, size[0] / unit)
    matrix[:3, 1] = np.cross(normal, along) * (size[1] / unit)
    matrix[:3, 2] = normal
    matrix[:3, 3] = np.divide(centre, unit)
    return {"type": "rectangle", "to_world": to_world(matrix)}
