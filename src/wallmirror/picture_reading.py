"""Pictures from one TOML file each: what it may say, and one sentence for every fault in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import GaussianTrain
from wallmirror.errors import InputError
from wallmirror.fields import Fields, named_toml, read_toml, shipped_names
from wallmirror.picture_scene import (
    BLACK,
    Background,
    Colour,
    Disk,
    Geometry,
    Glass,
    Lobes,
    Material,
    Metal,
    Paint,
    PictureCamera,
    PictureScene,
    PictureSettings,
    Rectangle,
    Region,
    Shape,
    Sphere,
    TiltedMirrors,
    Vector,
)

Array = NDArray[np.float64]

_LARGEST = 1e9


def picture_names() -> tuple[str, ...]:
    """Names of the pictures that come with wallmirror, sorted."""
    return shipped_names("scenes/pictures")


def load_picture(name_or_path: str | Path) -> PictureScene:
    """Read a picture from a TOML file, or by the name of one that comes with wallmirror.

    Raises
    ------
    InputError
        For an unknown name, and for every missing, unknown or out-of-range field, with file and field.

    Examples
    --------
    >>> load_picture("thesis_box_mirror").shape("back wall").material
    Metal(colour=(0.8, 0.8, 0.8), roughness=0.0)
    """
    path = named_toml(name_or_path, "scenes/pictures", kind="picture")
    root = read_toml(path)
    try:
        return _picture(root, name=path.stem)
    except InputError as error:
        raise error.located(file=path) from None


def _picture(root: Fields, *, name: str) -> PictureScene:
    if root.integer("format") != 1:
        raise root.error("format", "is not 1, the only format of pictures that this version reads")
    root.choice("kind", ("picture",))
    shapes = tuple(_shape(fields) for fields in root.tables("shape"))
    if root.has("sphere_field"):
        shapes += _sphere_field(root.table("sphere_field"), shapes)
    picture = PictureScene(
        name=name,
        title=root.text("title"),
        about=root.text("about", ""),
        camera=_camera(root.table("camera")),
        shapes=shapes,
        background=_background(root.table("background")) if root.has("background") else None,
        regions=tuple(_region(fields) for fields in root.tables("region")) if root.has("region") else (),
        render=_settings(root.table("render", required=False)),
    )
    root.finish()
    return picture


def _camera(fields: Fields) -> PictureCamera:
    camera = PictureCamera(
        position=_vector(fields, "position"),
        target=_vector(fields, "target"),
        up=_vector(fields, "up", (0.0, 1.0, 0.0)),
        fov=math.radians(fields.number("fov_deg", low=1e-3, high=179.0)),
    )
    forward = np.subtract(camera.target, camera.position)
    if not float(np.linalg.norm(np.cross(forward, camera.up))) > 1e-6 * float(np.linalg.norm(forward)):
        raise fields.error("up", "lies along the view, or the target is the position; turn one of them")
    fields.finish()
    return camera


def _shape(fields: Fields) -> Shape:
    geometry = _GEOMETRIES[fields.choice("shape", tuple(_GEOMETRIES))](fields)
    emission = _colour(fields, "emission", BLACK, high=_LARGEST)
    material: Material = Paint(colour=BLACK)
    if fields.has("material") or not any(emission):
        material = _material(fields.table("material"))
    if isinstance(material, Lobes | TiltedMirrors) and not isinstance(geometry, Rectangle):
        raise fields.error("material", "has a direction of its own; give it to a rectangle")
    image = None
    if fields.has("image"):
        if not isinstance(geometry, Rectangle) or not any(emission):
            raise fields.error("image", "needs a rectangle with an emission")
        image = _image(fields)
    shape = Shape(name=fields.text("name"), geometry=geometry, material=material, emission=emission, image=image)
    fields.finish()
    return shape


def _rectangle(fields: Fields) -> Rectangle:
    rectangle = Rectangle(centre=_vector(fields, "centre"), right=_vector(fields, "right"), up=_vector(fields, "up"))
    lengths = float(np.linalg.norm(rectangle.right)) * float(np.linalg.norm(rectangle.up))
    if not lengths > 0:
        raise fields.error("right", "or up has no length; give half edges")
    if abs(float(np.dot(rectangle.right, rectangle.up))) > 1e-9 * lengths:
        raise fields.error("up", "is not perpendicular to right")
    return rectangle


def _disk(fields: Fields) -> Disk:
    disk = Disk(
        centre=_vector(fields, "centre"),
        normal=_vector(fields, "normal"),
        radius=fields.number("radius", low=1e-9, high=_LARGEST),
    )
    if not any(disk.normal):
        raise fields.error("normal", "has no length; give a direction")
    return disk


_GEOMETRIES: dict[str, Callable[[Fields], Geometry]] = {
    "sphere": lambda f: Sphere(centre=_vector(f, "centre"), radius=f.number("radius", low=1e-9, high=_LARGEST)),
    "rectangle": _rectangle,
    "disk": _disk,
}


def _material(fields: Fields) -> Material:
    material = _MATERIALS[fields.choice("kind", tuple(_MATERIALS))](fields)
    fields.finish()
    return material


def _gaussian_train(fields: Fields) -> Lobes:
    height = fields.choice("height", ("peak", "per_degree", "per_radian"), "peak")
    return Lobes(
        brdf=GaussianTrain(
            centres=tuple(math.radians(c) for c in fields.numbers("centres_deg")),
            sigma=math.radians(fields.number("sigma_deg")),
            height="per_degree" if height == "per_degree" else "per_radian" if height == "per_radian" else "peak",
            scale=fields.number("scale", 1.0),
        )
    )


def _tilted_mirrors(fields: Fields) -> TiltedMirrors:
    tilts = fields.numbers("tilts_deg")
    if not tilts or len(tilts) & (len(tilts) - 1):
        raise fields.error("tilts_deg", f"names {len(tilts)} mirrors; give 1, 2, 4 or another power of two")
    if max(map(abs, tilts)) >= 90:
        raise fields.error("tilts_deg", "turns a mirror away; give angles between -90 and 90")
    return TiltedMirrors(
        tilts=tuple(math.radians(tilt) for tilt in tilts),
        reflectance=fields.number("reflectance", 1.0, low=0.0, high=1.0),
    )


_MATERIALS: dict[str, Callable[[Fields], Material]] = {
    "diffuse": lambda f: Paint(colour=_colour(f, "colour")),
    "mirror": lambda f: Metal(colour=_colour(f, "colour"), roughness=f.number("roughness", 0.0, low=0.0, high=1.0)),
    "glass": lambda f: Glass(index=f.number("index", 1.5, low=1.0, high=5.0)),
    "gaussian_train": _gaussian_train,
    "tilted_mirrors": _tilted_mirrors,
}


def _image(fields: Fields) -> Array:
    """Colours from rows of text, each character a pixel of the colour that [palette] gives it."""
    rows = fields.text("image").strip("\n").split("\n")
    if not rows[0] or len({len(row) for row in rows}) > 1:
        raise fields.error("image", "has rows of different lengths; give each row as many characters")
    palette = fields.table("palette")
    colours = {character: _colour(palette, character) for character in sorted(set("".join(rows)))}
    palette.finish()
    return np.array([[colours[character] for character in row] for row in rows], dtype=np.float64)


def _sphere_field(fields: Fields, listed: tuple[Shape, ...]) -> tuple[Shape, ...]:
    """Small spheres on the plane y = 0, one to a cell of a grid about the origin, except where they would touch others.

    The kinds, colours and places are those of the scene that ends "Ray Tracing in One Weekend".
    """
    # Each sphere is held against all others: 4096 take a second.
    columns, rows = (fields.integer(name, low=1, high=64) for name in ("columns", "rows"))
    radius = fields.number("radius", low=1e-6, high=0.5)
    diffuse = fields.number("diffuse", low=0.0, high=1.0)
    metal = fields.number("metal", low=0.0, high=1.0)
    if diffuse + metal > 1 + 1e-12:
        raise fields.error("metal", "and diffuse add up to more than 1; what they leave is glass")
    jitter = fields.number("jitter", 0.9, low=0.0, high=1.0)
    roughness = fields.number("roughness", 0.0, low=0.0, high=1.0)
    rng = np.random.default_rng(fields.integer("seed"))
    fields.finish()
    balls = [shape.geometry for shape in listed if isinstance(shape.geometry, Sphere)]
    # A row to each sphere that stands already: centre and radius.
    taken = np.array([(*ball.centre, ball.radius) for ball in balls]).reshape(-1, 4)
    spheres = []
    for cell, numbers in enumerate(rng.random((columns * rows, 10))):
        column, row = divmod(cell, rows)
        x, z = column - columns // 2 + jitter * numbers[0], row - rows // 2 + jitter * numbers[1]
        centre = np.array([x, radius, z])
        if np.any(np.linalg.norm(taken[:, :3] - centre, axis=1) <= taken[:, 3] + radius):
            continue
        taken = np.vstack([taken, (*centre, radius)])
        a, b = numbers[3:6], numbers[6:9]
        material: Material = Glass()
        if numbers[2] < diffuse:
            material = Paint(colour=_triple(a * b))
        elif numbers[2] < diffuse + metal:
            material = Metal(colour=_triple((1 + a) / 2), roughness=roughness * float(numbers[9]))
        spheres.append(
            Shape(
                name=f"small sphere {cell}", geometry=Sphere(centre=_triple(centre), radius=radius), material=material
            )
        )
    return tuple(spheres)


def _background(fields: Fields) -> Background:
    nadir = _colour(fields, "radiance", high=_LARGEST)
    background = Background(nadir=nadir, zenith=_colour(fields, "zenith", nadir, high=_LARGEST))
    fields.finish()
    return background


def _region(fields: Fields) -> Region:
    box = fields.numbers("box", (0.0, 0.0, 1.0, 1.0), size=4)
    if not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
        raise fields.error("box", "is no part of the picture; give left, top, right, bottom as fractions, in order")
    region = Region(name=fields.text("name"), shape=fields.text("shape"), box=(box[0], box[1], box[2], box[3]))
    fields.finish()
    return region


def _settings(fields: Fields) -> PictureSettings:
    settings = PictureSettings(
        width=fields.integer("width", 640, low=1, high=8192),
        height=fields.integer("height", 360, low=1, high=8192),
        spp=fields.integer("spp", 256, low=1, high=2**20),
        max_depth=fields.integer("max_depth", 50, low=1, high=1000),
        rr_depth=fields.integer("rr_depth", 5, low=1, high=100_000),
        hide_emitters=fields.flag("hide_emitters", False),
        unit=fields.number("unit", 1.0, low=1e-9, high=_LARGEST),
        origin=_vector(fields, "origin", (0.0, 0.0, 0.0)),
    )
    fields.finish()
    return settings


def _vector(fields: Fields, name: str, default: Vector | None = None) -> Vector:
    return _triple(np.array(fields.numbers(name, default, size=3)))


def _colour(fields: Fields, name: str, default: Colour | None = None, *, high: float = 1.0) -> Colour:
    colour = _vector(fields, name, default)
    if min(colour) < 0 or max(colour) > high:
        raise fields.error(name, f"is {list(colour)}; give red, green and blue from 0 to {high:g}")
    return colour


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
