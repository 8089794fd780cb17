"""One TOML file, one typed Scene: the analytic model and the path tracer are both built from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import BRDF
from wallmirror.errors import InputError
from wallmirror.fields import Fields, named_toml, read_toml, shipped_names
from wallmirror.geometry import Card, Observer, scan_angles, wall_points
from wallmirror.limits import require_affordable
from wallmirror.wall_reading import read_brdf

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Wall:
    """The wall y = 0: its reflectance and its extent in metres (centred at the origin)."""

    brdf: BRDF
    half_width: float = 20.0
    half_height: float = 20.0

    def __post_init__(self) -> None:
        for name in ("half_width", "half_height"):
            _require_length(f"wall.{name}", getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class Room:
    """A box around wall, card and observer: floor, ceiling and two sides, diffuse; open behind the observer.

    The wall y = 0 closes it at the far end. Lengths in metres.
    """

    half_width: float
    half_height: float
    depth: float
    albedo: float

    def __post_init__(self) -> None:
        for name in ("half_width", "half_height", "depth"):
            _require_length(f"room.{name}", getattr(self, name))
        if not 0 <= self.albedo < 1:
            raise InputError(f"is {self.albedo:g}; an albedo lies in [0, 1)", field="room.albedo")


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """What the path tracer spends by default: depth, samples per pixel, and where Russian roulette starts."""

    max_depth: int = 2
    spp: int = 1024
    rr_depth: int = 1000


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A wall, a card, an observer and what surrounds them.

    Parameters
    ----------
    source:
        V, shape (M, B): radiance of each element in each realisation, in W m^-2 sr^-1.
    """

    name: str
    title: str
    about: str
    observer: Observer
    card: Card
    wall: Wall
    source: Array = field(repr=False)
    room: Room | None = None
    render: RenderSettings = field(default_factory=RenderSettings)

    def __post_init__(self) -> None:
        source = np.array(self.source, dtype=np.float64)
        if source.ndim != 2 or source.shape[0] != self.card.elements:
            raise InputError(
                f"has shape {source.shape}; give one row for each of the {self.card.elements} elements",
                field="source.patterns",
            )
        if not np.all(np.isfinite(source)) or source.min(initial=0.0) < 0:
            raise InputError("holds a radiance that is negative or not finite", field="source.patterns")
        source.flags.writeable = False
        object.__setattr__(self, "source", source)
        reach = float(np.abs(wall_points(self.observer, _field_edges(self.observer))).max())
        if reach > self.wall.half_width:
            raise InputError(
                f"is {self.wall.half_width:g} m, but the views reach {reach:.4g} m; widen the wall or narrow the scan",
                field="wall.half_width",
            )
        if self.room is not None:
            _require_inside(self.room, self.card, self.observer)

    @property
    def is_one_bounce(self) -> bool:
        """Whether nothing but the wall reflects light, so that Hypothesis 2 holds exactly."""
        return self.room is None and self.card.albedo == 0


def _require_length(field: str, value: float) -> None:
    """Raise InputError naming the field unless the value is a length whose fourth power float64 holds beside others."""
    if not 1e-100 <= value <= 1e100:
        raise InputError(f"is {value:g}; give a length > 0 in metres", field=field)


def _require_inside(room: Room, card: Card, observer: Observer) -> None:
    """Refuse a room whose walls would stand between wall, card and observer."""
    if not (card.distance < room.depth and observer.distance < room.depth):
        raise InputError("the room must be deeper than card and observer are far", field="room.depth")
    half_card = 0.5 * max(card.board_width, max(card.elements_x) - min(card.elements_x) + card.element_width)
    reach = max(abs(observer.position[0]), abs(card.middle) + half_card)
    if reach >= room.half_width:
        raise InputError(
            f"is {room.half_width:g} m, but card or observer stand {reach:.4g} m from the middle; widen the room",
            field="room.half_width",
        )
    if 0.5 * max(card.board_height, card.element_height) >= room.half_height:
        raise InputError(
            f"is {room.half_height:g} m, less than half of the card's height; raise the room", field="room.half_height"
        )


def scene_names() -> tuple[str, ...]:
    """Names of the scenes that come with wallmirror, sorted."""
    return shipped_names("scenes")


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a scene from a TOML file, or by the name of one that comes with wallmirror.

    Raises
    ------
    InputError
        For an unknown name, and for every missing, unknown or out-of-range field, with file and field.

    Examples
    --------
    >>> load_scene("flat_wall_lobes").card.elements
    4
    """
    path = named_toml(name_or_path, "scenes", kind="scene")
    root = read_toml(path)
    try:
        return _scene(root, name=path.stem)
    except InputError as error:
        raise error.located(file=path) from None


def _scene(root: Fields, *, name: str) -> Scene:
    if root.integer("format") != 1:
        raise root.error("format", "is not 1, the only format of scenes that this version reads")
    card = read_card(root.table("card"))
    scene = Scene(
        name=name,
        title=root.text("title"),
        about=root.text("about", ""),
        observer=read_observer(root.table("observer")),
        card=card,
        wall=_wall(root.table("wall")),
        source=_source(root.table("source"), card),
        room=read_room(root.table("room")) if root.has("room") else None,
        render=_render(root.table("render", required=False)),
    )
    root.finish()
    require_affordable_films(scene.observer, realisations=scene.source.shape[1], elements=card.elements)
    return scene


def require_affordable_films(observer: Observer, *, realisations: int, elements: int) -> None:
    """Refuse films or a transport matrix that would not fit into memory, with the size that they would have."""
    films = ("views", "pixels", "realisations"), (observer.views, observer.pixels, realisations)
    matrix = ("views", "pixels", "elements"), (observer.views, observer.pixels, elements)
    for names, shape in (films, matrix):
        require_affordable(shape, names, field="observer.pixels")


def read_observer(fields: Fields) -> Observer:
    """An Observer from the table [observer] of a scene or capture set; the caller handles extra fields."""
    fov_deg = fields.number("fov_deg")
    if not 0 < fov_deg < 180:
        raise fields.error("fov_deg", f"a field of view of {fov_deg:g} deg is not between 0 and 180")
    fov = math.radians(fov_deg)
    position = fields.numbers("position", size=2)
    pixels = fields.integer("pixels", low=1, high=1_000_000)
    placement = fields.choice("pixels_at", ("centres", "edges"), "centres")
    if fields.has("view_angles_deg"):
        angles = tuple(math.radians(a) for a in fields.numbers("view_angles_deg"))
    else:
        angles = scan_angles(
            fields.integer("views", low=1, high=100_000),
            scan=math.radians(fields.number("scan_deg")),
            fov=fov,
        )
    fields.finish()
    return Observer(
        position=(position[0], position[1]),
        fov=fov,
        view_angles=angles,
        pixels=pixels,
        pixels_at="edges" if placement == "edges" else "centres",
    )


def read_card(fields: Fields) -> Card:
    """A Card from the table [card] of a scene or capture set."""
    card = Card(
        elements_x=fields.numbers("elements_x"),
        y=fields.number("y"),
        element_width=fields.number("element_width", 0.0),
        element_height=fields.number("element_height", 0.0),
        albedo=fields.number("albedo", 0.0),
        board_width=fields.number("board_width", 0.0),
        board_height=fields.number("board_height", 0.0),
    )
    fields.finish()
    return card


def read_room(fields: Fields) -> Room:
    """A Room from the table [room] of a scene or capture set."""
    room = Room(
        half_width=fields.number("half_width", low=1e-3, high=1e6),
        half_height=fields.number("half_height", low=1e-3, high=1e6),
        depth=fields.number("depth", low=1e-3, high=1e6),
        albedo=fields.number("albedo", low=0.0, high=0.999),
    )
    fields.finish()
    return room


def _wall(fields: Fields) -> Wall:
    wall = Wall(
        brdf=read_brdf(fields),
        half_width=fields.number("half_width", 20.0, low=1e-3, high=1e6),
        half_height=fields.number("half_height", 20.0, low=1e-3, high=1e6),
    )
    fields.finish()
    return wall


def _source(fields: Fields, card: Card) -> Array:
    """V of shape (M, B): `patterns` (one list of M radiances a realisation) or random `realisations`."""
    level = fields.number("level", 1.0, low=0.0)
    if fields.has("patterns"):
        rows = fields.rows("patterns")
        if not rows:
            raise fields.error("patterns", "names no pattern; give at least one")
        source = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1).T
    else:
        rng = np.random.default_rng(fields.integer("seed", 0))
        shape = (card.elements, fields.integer("realisations", low=1, high=100_000))
        require_affordable(shape, ("elements", "realisations"), field="source.realisations")
        source = rng.random(shape)
    fields.finish()
    with np.errstate(over="ignore"):  # refused as not finite by Scene
        return np.asarray(level * source, dtype=np.float64)


def _render(fields: Fields) -> RenderSettings:
    settings = RenderSettings(
        max_depth=fields.integer("max_depth", 2, low=2, high=1000),
        spp=fields.integer("spp", 1024, low=1, high=2**24),
        rr_depth=fields.integer("rr_depth", 1000, low=1, high=100_000),
    )
    fields.finish()
    return settings


def _field_edges(observer: Observer) -> Array:
    half = math.tan(observer.fov / 2)
    return np.array([-half, half])
