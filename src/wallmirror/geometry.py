"""The observer, its rotating camera, the card and the wall: positions to signed angles.

Sections 2.1 and 4.1.1 of the thesis. The wall is the plane y = 0 with normal (0, -1, 0); everything else has
y < 0; x runs along the wall and z is up. Angles are signed in the x-y plane and in radians; a mirror sends
theta_s to theta_o = -theta_s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError

Array = NDArray[np.float64]

# Lengths in metres beyond which squares and cubes of them would leave the range of float64.
_SHORTEST, _LONGEST = 1e-100, 1e100
_NARROWEST = 1e-100  # field of view in radians
_MOST_VIEWS = 10**6

#: Where the samples of a view lie: the centres of finite pixels, or points from edge to edge of the field.
PixelPlacement = Literal["centres", "edges"]


@dataclass(frozen=True, kw_only=True)
class Observer:
    """A pinhole camera at a fixed place that turns about it (section 4.1.1).

    Parameters
    ----------
    position:
        (x, y) in metres, y < 0.
    fov:
        Full horizontal field of view in radians, in (0, pi).
    view_angles:
        Optical axis of each of the A views, from the wall's inward normal, in radians; +45 deg looks at x < x_o.
    pixels:
        N, the number of pixels of one view.
    pixels_at:
        "centres" (a real pinhole, finite pixels) or "edges" (the thesis's linspace from edge to edge, points).

    Raises
    ------
    InputError
        If a value is outside its range, or a view looks past the wall's horizon.
    """

    position: tuple[float, float]
    fov: float
    view_angles: tuple[float, ...]
    pixels: int
    pixels_at: PixelPlacement = "centres"

    def __post_init__(self) -> None:
        require_finite("observer.position", self.position)
        require_finite("observer.view_angles_deg", self.view_angles)
        if self.position[1] >= 0:
            raise InputError(
                f"the observer stands on or behind the wall (y = {self.position[1]:g}); give y < 0",
                field="observer.position",
            )
        _require_lengths("observer.position", self.position[:1], distance=self.distance)
        if not _NARROWEST <= self.fov < math.pi:
            raise InputError(
                f"a field of view of {math.degrees(self.fov):g} deg is not between 0 and 180",
                field="observer.fov_deg",
            )
        require_count("observer.pixels", self.pixels, "pixel")
        if self.pixels_at == "edges" and self.pixels < 2:
            raise InputError('pixels_at = "edges" needs at least two pixels', field="observer.pixels")
        if self.pixels_at not in ("centres", "edges"):
            raise InputError(f'is "{self.pixels_at}"; choose "centres" or "edges"', field="observer.pixels_at")
        if not self.view_angles:
            raise InputError("names no view; give at least one angle", field="observer.view_angles_deg")
        for angle in self.view_angles:
            if abs(angle) + self.fov / 2 >= math.pi / 2:
                raise InputError(
                    f"the view at {math.degrees(angle):g} deg with a field of {math.degrees(self.fov):g} deg looks "
                    "past the wall's horizon (90 deg); turn it back or narrow the field",
                    field="observer.view_angles_deg",
                )

    @property
    def views(self) -> int:
        """A, the number of views."""
        return len(self.view_angles)

    @property
    def distance(self) -> float:
        """Distance from the wall in metres."""
        return -self.position[1]


@dataclass(frozen=True, kw_only=True)
class Card:
    """The glowing card: M vertical strips, parallel to the wall, centred at z = 0.

    Parameters
    ----------
    elements_x:
        Centres of the M strips in metres.
    y:
        Position in front of the wall in metres, y < 0.
    element_width, element_height:
        Extent of one strip in metres; a width or height of 0 makes the elements points of unit area.
    albedo:
        Lambertian reflectance of the strips and of the board that carries them, in [0, 1).
    board_width, board_height:
        Extent of the board behind the strips in metres; 0 for a card without a board. It is centred on the strips.
    """

    elements_x: tuple[float, ...]
    y: float
    element_width: float = 0.0
    element_height: float = 0.0
    albedo: float = 0.0
    board_width: float = 0.0
    board_height: float = 0.0

    def __post_init__(self) -> None:
        require_finite("card.elements_x", self.elements_x)
        require_finite("card.y", (self.y,))
        if not self.elements_x:
            raise InputError("names no element; give at least one position", field="card.elements_x")
        if self.y >= 0:
            raise InputError(f"the card lies on or behind the wall (y = {self.y:g}); give y < 0", field="card.y")
        _require_lengths("card.elements_x", self.elements_x)
        _require_lengths("card.y", distance=self.distance)
        for name in ("element_width", "element_height", "board_width", "board_height"):
            value = getattr(self, name)
            if not 0 <= value <= _LONGEST:
                raise InputError(
                    f"is {value:g}; give a length >= 0 in metres, up to {_LONGEST:g}", field=f"card.{name}"
                )
        if (self.element_width == 0) != (self.element_height == 0):
            raise InputError(
                "strips need both a width and a height; give both, or 0 for both (points)",
                field="card.element_height" if self.element_height == 0 else "card.element_width",
            )
        if not 0 <= self.albedo < 1:
            raise InputError(f"is {self.albedo:g}; an albedo lies in [0, 1)", field="card.albedo")
        centres = np.sort(np.asarray(self.elements_x))
        if self.element_width > 0 and np.any(np.diff(centres) < self.element_width * (1 - 1e-12)):
            raise InputError(
                "two elements overlap; move them apart or make element_width smaller", field="card.elements_x"
            )

    @property
    def elements(self) -> int:
        """M, the number of elements."""
        return len(self.elements_x)

    @property
    def distance(self) -> float:
        """Distance from the wall in metres."""
        return -self.y

    @property
    def middle(self) -> float:
        """Where along the wall the card is centred, halfway between its outermost elements, in metres."""
        return 0.5 * (min(self.elements_x) + max(self.elements_x))

    @property
    def is_points(self) -> bool:
        """Whether the elements are points instead of strips."""
        return self.element_width == 0


def scan_angles(views: int, *, scan: float, fov: float) -> tuple[float, ...]:
    """Optical axes of A views whose fields together cover a scan, from +x_angle to -x_angle (section 4.1.1).

    Parameters
    ----------
    views:
        A >= 1. A single view looks straight at the wall.
    scan, fov:
        Full width of the scan and of one field in radians; pi >= scan >= fov > 0.

    Raises
    ------
    InputError
        For fewer than one or more than a million views, or widths out of range.

    Examples
    --------
    >>> [round(math.degrees(a), 1) for a in scan_angles(3, scan=math.radians(90), fov=math.radians(60))]
    [15.0, 0.0, -15.0]
    """
    require_count("observer.views", views, "view")
    if views > _MOST_VIEWS:
        raise InputError(f"are {views}; give at most {_MOST_VIEWS}", field="observer.views")
    for name, width in (("scan_deg", scan), ("fov_deg", fov)):
        if not 0 < width <= math.pi:
            raise InputError(
                f"is {math.degrees(width):g} deg; give more than 0 and, since the wall's horizon lies there, up to 180 deg",
                field=f"observer.{name}",
            )
    if scan < fov:
        raise InputError(
            f"a scan of {math.degrees(scan):g} deg is narrower than one field of {math.degrees(fov):g} deg",
            field="observer.scan_deg",
        )
    if views == 1:
        return (0.0,)
    edge = (scan - fov) / 2
    return tuple(float(a) for a in np.linspace(edge, -edge, views))


def pixel_tangents(observer: Observer) -> Array:
    """Tangent t_j of each pixel's offset from the optical axis, shape (N,); x on the wall grows with j (eq. 4.2).

    A view at angle a sees the wall at a - atan(t_j).
    """
    half = math.tan(observer.fov / 2)
    n = observer.pixels
    if observer.pixels_at == "edges":
        return np.linspace(-half, half, n)
    return (2 * (np.arange(n) + 0.5) / n - 1) * half


def pixel_half_width(observer: Observer) -> float:
    """Half the width (and height) of a square pixel in tangent units; 0 where the samples are points."""
    return 0.0 if observer.pixels_at == "edges" else math.tan(observer.fov / 2) / observer.pixels


def wall_points(observer: Observer, tangents: ArrayLike | None = None) -> Array:
    """x of the wall point behind each image position, shape (A, *tangents.shape), in metres (eqs. 4.3, 4.4).

    Parameters
    ----------
    tangents:
        Offsets t from the optical axis, any shape; the pixels' own positions when left out.
    """
    t = pixel_tangents(observer) if tangents is None else np.asarray(tangents, dtype=np.float64)
    if not np.all(np.isfinite(t)):
        raise InputError("hold a value that is not finite; a tangent of 90 deg meets no wall", field="tangents")
    x_o, y_o = observer.position
    view = np.asarray(observer.view_angles).reshape((-1,) + (1,) * t.ndim)
    x: Array = x_o + y_o * np.tan(view - np.arctan(t))
    return x


def outgoing_angles(observer: Observer, wall_x: ArrayLike) -> Array:
    """theta_o, signed angle from the wall's normal to the observer, same shape as `wall_x`, in radians."""
    return np.arctan2(observer.position[0] - np.asarray(wall_x, dtype=np.float64), observer.distance)


def incident_angles(source_x: ArrayLike, source_distance: float, wall_x: ArrayLike) -> Array:
    """theta_s, signed angle from the wall's normal to a source point, broadcast over x positions, in radians."""
    dx = np.asarray(source_x, dtype=np.float64) - np.asarray(wall_x, dtype=np.float64)
    return np.arctan2(dx, source_distance)


def require_finite(field: str, values: tuple[float, ...]) -> None:
    """Raise InputError naming the field unless every value is a finite number."""
    for value in values:
        if not math.isfinite(value):
            raise InputError(f"holds {value}; give finite numbers", field=field)


def require_count(field: str, value: int, thing: str) -> None:
    """Raise InputError naming the field unless the value is a whole number of things, at least one."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"needs at least one {thing}, a whole number, not {value}", field=field)


def _require_lengths(field: str, places: tuple[float, ...] = (), *, distance: float = 1.0) -> None:
    """Refuse places and distances whose squares and cubes float64 cannot hold."""
    if not _SHORTEST <= distance <= _LONGEST or any(abs(place) > _LONGEST for place in places):
        raise InputError(f"holds a length beyond {_SHORTEST:g} to {_LONGEST:g} metres; use other units", field=field)
