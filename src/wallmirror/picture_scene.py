"""Pictures of spheres and rectangles: what the thesis rendered to argue for its hypotheses.

A `PictureScene` is not a wall with a card and an observer: it is a camera, shapes of some material that may shine, and
a background. Lengths are in whatever unit its file is written in (`picture_reading`); directions are right-handed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF
from wallmirror.errors import InputError, shown

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
#: Red, green and blue, linear.
Colour = tuple[float, float, float]

BLACK: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A sphere, seen from outside."""

    centre: Vector
    radius: float


@dataclass(frozen=True, kw_only=True)
class Rectangle:
    """A rectangle by its centre and two perpendicular half edges; its front faces along `right` x `up`.

    Whoever looks at the front sees `right` point to the right and `up` up, and an image on it the right way round.
    """

    centre: Vector
    right: Vector
    up: Vector


@dataclass(frozen=True, kw_only=True)
class Disk:
    """A disk whose front faces along `normal`."""

    centre: Vector
    normal: Vector
    radius: float


@dataclass(frozen=True, kw_only=True)
class Paint:
    """A diffuse coat: albedo by colour."""

    colour: Colour


@dataclass(frozen=True, kw_only=True)
class Metal:
    """A mirror, or with a GGX roughness > 0 a rough one; reflectance by colour."""

    colour: Colour
    roughness: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Glass:
    """Clear glass of one refractive index, in air."""

    index: float = 1.5


@dataclass(frozen=True, kw_only=True)
class Lobes:
    """A BRDF of the sum of the angles in the plane of `right` and the normal, constant along `up` (cylindrical)."""

    brdf: AngleSumBRDF


@dataclass(frozen=True, kw_only=True)
class TiltedMirrors:
    """Equal shares of mirrors whose normals are tilted towards `right`: they turn the image by twice each tilt.

    Parameters
    ----------
    tilts:
        In radians, a power of two of them.
    reflectance:
        Of all the mirrors together.
    """

    tilts: tuple[float, ...]
    reflectance: float = 1.0


Geometry = Sphere | Rectangle | Disk
Material = Paint | Metal | Glass | Lobes | TiltedMirrors


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One thing in the picture.

    Parameters
    ----------
    emission:
        Radiance that its front gives off, by colour; all 0 where it does not shine.
    image:
        Factor on `emission` over a rectangle, shape (rows, columns, 3), row 0 at the top; None for 1 everywhere.
    """

    name: str
    geometry: Geometry
    material: Material
    emission: Colour = BLACK
    image: Array | None = field(default=None, repr=False)

    @property
    def shines(self) -> bool:
        """Whether it gives off light."""
        return any(self.emission)


@dataclass(frozen=True, kw_only=True)
class PictureCamera:
    """A pinhole camera; `fov` is the full vertical field of view in radians."""

    position: Vector
    target: Vector
    up: Vector
    fov: float


@dataclass(frozen=True, kw_only=True)
class Background:
    """Radiance from infinity, linear in the height sin(elevation) above the plane y = 0, from `nadir` to `zenith`."""

    nadir: Colour
    zenith: Colour


@dataclass(frozen=True, kw_only=True)
class Region:
    """A part of the picture to measure: pixels that show the shape of that name, inside `box`.

    Parameters
    ----------
    box:
        Left, top, right and bottom as fractions of the picture.
    """

    name: str
    shape: str
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class PictureSettings:
    """What the path tracer makes of the picture.

    Parameters
    ----------
    width, height, spp, max_depth, rr_depth:
        Size, samples per pixel, depth (2: one bounce), and where Russian roulette begins.
    hide_emitters:
        Whether the camera looks through all that shines, the background included; mirrors still show it.
    unit, origin:
        Length of one unit of the path tracer, and the point that it calls the origin: it starts rays about
        9e-5 (unit + |p - origin|) beside the point p that they leave.
    """

    width: int = 640
    height: int = 360
    spp: int = 256
    max_depth: int = 50
    rr_depth: int = 5
    hide_emitters: bool = False
    unit: float = 1.0
    origin: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class PictureScene:
    """A picture of spheres, rectangles and disks.

    Raises
    ------
    InputError
        If nothing shines, if two shapes or regions share a name, or a region names a shape that is not there.
    """

    name: str
    title: str
    about: str
    camera: PictureCamera
    shapes: tuple[Shape, ...] = field(repr=False)
    background: Background | None = None
    regions: tuple[Region, ...] = ()
    render: PictureSettings = field(default_factory=PictureSettings)

    def __post_init__(self) -> None:
        names = [shape.name for shape in self.shapes]
        for what, all_names in (("shape", names), ("region", [region.name for region in self.regions])):
            twice = sorted(name for name, count in Counter(all_names).items() if count > 1)
            if twice:
                message = f'two are called "{shown(twice[0], quote=False)}"; give each a name of its own'
                raise InputError(message, field=f"{what}.name")
        known = set(names)
        for region in self.regions:
            if region.shape not in known:
                raise InputError(f'no shape is called "{shown(region.shape, quote=False)}"', field="region.shape")
        sky = self.background
        if not any(shape.shines for shape in self.shapes) and (sky is None or not any(sky.nadir + sky.zenith)):
            raise InputError("nothing shines; give a shape an emission, or a background", field="shape.emission")

    def shape(self, name: str) -> Shape:
        """The shape of that name."""
        return next(shape for shape in self.shapes if shape.name == name)
