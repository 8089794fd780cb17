"""Both convolutions and the mirror as the thesis's published code computes them, traps included, for comparison.

What it does, and its text does not say:

- the mirror is a box of the angle sum .1 deg wide, at most .05 deg from 0, sampled at the wall points. Neighbouring
  points may be further apart than that, and the box then falls between them;
- the half circle has as many directions as the wall has points, from edge to edge (both +-90 deg). A source goes to the
  nearest one. The BRDF's map is tabulated about each wall point's own exact theta_o and shifts against the source's
  map, so the value is read at a shift of 2 theta_o, rounded to the grid;
- the projected BRDF is scattered: N uniform angles over the view go each to the nearest wall point, where the last one
  stays. The points are uniform in the tangent, so towards the edges several angles fall on one and in the middle some
  points get none: holes;
- the middle of a kernel of N samples lies between two of them for even N, and the crop of the full convolution takes
  one of the two: half a sample off.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import rescaled
from wallmirror.brdf import AngleSumBRDF
from wallmirror.convolution.half_circle import require_angle_sum
from wallmirror.convolution.spherical import checked_source, scene_angles, source_in_unit
from wallmirror.convolution.wall import parallel_view
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer

Array = NDArray[np.float64]

MIRROR_BOX = math.radians(0.1)


def box_mirror_render(observer: Observer, card: Card, source: ArrayLike, *, width: float = MIRROR_BOX) -> Array:
    """Algorithm 1 with a mirror that is a box of the angle sum, (A, N) or (A, N, B).

    Parameters
    ----------
    width:
        Full width of the box in radians.

    Examples
    --------
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=500, pixels_at="edges")
    >>> int(np.count_nonzero(box_mirror_render(observer, Card(elements_x=(-5.0, 5.0), y=-5), [0.5, 1.0])))
    0
    """
    theta_s, theta_o = scene_angles(observer, card)
    inside = np.abs(theta_s + theta_o[..., None]) <= width / 2
    return np.asarray(inside @ checked_source(card, source), dtype=np.float64)


def nearest_spherical(observer: Observer, card: Card, brdf: AngleSumBRDF, source: ArrayLike) -> Array:
    """The thesis's spherical convolution, with as many directions as pixels and the nearest one taken, (A, N)."""
    require_angle_sum(brdf)
    source, unit = source_in_unit(card, source)
    if observer.pixels < 2:
        raise InputError("needs at least two pixels, which are its directions as well", field="observer.pixels")
    theta_s, theta_o = scene_angles(observer, card)
    step = math.pi / (observer.pixels - 1)

    def nearest(theta: Array, step: float) -> Array:
        return np.round((theta + math.pi / 2) / step) * step - math.pi / 2

    # Index k of the source and l of the BRDF's map meet in the full convolution's sample k + l, whose 2N - 1 samples are
    # read as if they covered the half circle: half a step each. With rho's map about theta_o the sum comes out as this.
    shift = 2 * nearest(theta_o, step / 2) - theta_o
    return rescaled(brdf.of_sum(nearest(theta_s, step) + shift[..., None]) @ source, unit, field="source")


def scattered_projection(observer: Observer, brdf: AngleSumBRDF) -> tuple[Array, NDArray[np.bool_]]:
    """rho_wall with its holes, and which wall points were written, both (N,)."""
    require_angle_sum(brdf)
    x = parallel_view(observer)
    angles = np.linspace(-observer.fov / 2, observer.fov / 2, x.size)
    places = observer.position[0] + observer.position[1] * np.tan(angles)
    written = np.zeros(x.size, dtype=np.bool_)
    values = np.zeros(x.size)
    nearest = np.argmin(np.abs(x[:, None] - places), axis=0)
    for place, value in zip(nearest, brdf.of_sum(angles), strict=True):  # in order: the last one stays
        values[place] = value
        written[place] = True
    return values, written


def scattered_wall_convolution(observer: Observer, card: Card, brdf: AngleSumBRDF, source: ArrayLike) -> Array:
    """The thesis's 1-D convolution: box mirror, projection with holes, crop half a sample off, (N,)."""
    if np.ndim(source) != 1:
        raise InputError(f"has shape {np.shape(source)}; give the radiance of one realisation, (M,)", field="source")
    mirror = box_mirror_render(observer, card, source)[0]
    values, _ = scattered_projection(observer, brdf)
    start = mirror.size // 2
    return np.asarray(np.convolve(mirror, values)[start : start + mirror.size], dtype=np.float64)
