"""Blind de-rendering in the far field as a multi-channel blind deconvolution, the thesis's "missed opportunity".

Over the angle w = theta_o + theta_c (towards the card's middle) the render of pattern b tends to

    L_b(w) = sum_i v_ib rho(w + delta_i),        error as 1 / y_s at a fixed angular width    (`convolution.angle`)

If the M elements stand d apart in angle, samples of L_b that are d apart are a true convolution: the pattern is the
channel, M taps long, and rho the source that all channels share. Samples shifted by a fraction of d are a further record of
the same channels with another source, so that all pixels take part. The cross-relation (`cross_relation`) then gives
patterns and BRDF in closed form from two captures on, where the closed form of `solve` needs as many as elements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.convolution.angle import convolution_variable, cosine_factor, mirror_directions, mirror_points, resample
from wallmirror.convolution.spherical import PointWeights, scene_angles
from wallmirror.deconvolution.cross_relation import ChannelMethod, IdentifiedChannels, identify_channels
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.geometry import incident_angles, wall_points

Array = NDArray[np.float64]

_EVEN = 0.05  # of the spacing by which elements may stand off their even places in angle
_MOST_PHASES = 64
_ORDER = 5


@dataclass(frozen=True)
class FarField:
    """Result of `solve_far_field`, in the scale in which the pattern's norm is 1.

    Parameters
    ----------
    source:
        V, shape (M, B), in the card's order.
    angles, brdf:
        rho at these angle sums, both (K,), in radians; least squares, weakly known at both ends.
    spacing:
        d, radians.
    departure:
        Largest turn of a delta_i along the wall in radians, from the geometry: far field means that it is far below the
        width of the narrowest lobe.
    identified:
        What the cross-relation says of itself. Its predicted error is that of noise; where `departure` rules, a fault common
        to all captures, its error bound is the one to go by.
    """

    source: Array
    angles: Array
    brdf: Array
    spacing: float
    departure: float
    identified: IdentifiedChannels


def solve_far_field(captures: CaptureSet, *, method: ChannelMethod = "cross_relation") -> FarField:
    """Recover pattern and BRDF from captures of a far card by multi-channel blind deconvolution.

    Parameters
    ----------
    captures:
        "thesis" or "cosine" weights, at least two elements at even spaces and two realisations; variances are not used.
    method:
        Of `identify_channels`.

    Raises
    ------
    InputError
        For "physical" weights, or elements that are not evenly spaced in angle.
    UndeterminedError
        As `identify_channels`; and for views too narrow for the card.

    Examples
    --------
    >>> from wallmirror.brdf import GaussianTrain
    >>> from wallmirror.derendering.estimate import scale_free_error
    >>> from wallmirror.geometry import Card, Observer
    >>> from wallmirror.transport import radiance, transport_matrix
    >>> observer = Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=2000, pixels_at="edges")
    >>> card = Card(elements_x=tuple(1e4 * np.tan(np.radians([-4, -2, 0, 2, 4]))), y=-1e4)
    >>> v = np.random.default_rng(0).random((5, 2))
    >>> films = radiance(transport_matrix(observer, card, GaussianTrain.of_the_text(), weights="thesis"), v)
    >>> found = solve_far_field(CaptureSet(observer=observer, card=card, radiance=films, transport="thesis"))
    >>> scale_free_error(found.source, v) < 1e-4
    True
    """
    order, delta, spacing = _even_elements(captures)
    records, start = _records(captures, spacing)
    found = identify_channels(records, delta.size, method=method)
    if found.sources.sum() < 0:  # light and reflectance are positive; identify_channels has made the pattern so
        raise UndeterminedError(
            "the BRDF that fits is negative on the whole: the card is too near for a convolution, or there is too much noise"
        )
    source = np.empty((delta.size, captures.realisations))
    source[order] = found.channels[:, ::-1].T
    if captures.transport == "cosine":
        source /= _element_factor(captures)[:, None]
    angles = start[:, None] + delta[0] + spacing * np.arange(found.sources.shape[1])
    rank = np.argsort(angles, axis=None)
    return FarField(source, angles.ravel()[rank], found.sources.ravel()[rank], spacing, _departure(captures), found)


def _even_elements(captures: CaptureSet) -> tuple[NDArray[np.intp], Array, float]:
    """Order of the elements by delta, delta in that order, and their spacing."""
    if captures.transport == "physical":
        raise InputError('is "physical"; the far field is written for "thesis" and "cosine" weights', field="transport")
    if captures.card.elements < 2:
        raise InputError(
            "has one element, so there is nothing to deconvolve; give two or more", field="card.elements_x"
        )
    delta = -mirror_directions(captures.observer, captures.card)
    order = np.argsort(delta)
    delta = delta[order]
    spacing = float(delta[-1] - delta[0]) / (delta.size - 1)
    if spacing <= 0:
        raise UndeterminedError("the elements stand at one place in angle; bring the card nearer or widen it")
    off = float(np.abs(delta - delta[0] - spacing * np.arange(delta.size)).max()) / spacing
    if off > _EVEN:
        raise InputError(
            f"are up to {off:.2g} of their spacing off even places in angle; the far field needs them even to {_EVEN:g}: "
            "use `solve`, which takes any places",
            field="card.elements_x",
        )
    return order.astype(np.intp), delta, spacing


def _records(captures: CaptureSet, spacing: float) -> tuple[Array, Array]:
    """Renders at samples one spacing apart, (R, B, L), a record for each view and phase, and the first angle of each."""
    observer = captures.observer
    variable = convolution_variable(observer, captures.card)
    factor = cosine_factor(observer, captures.card, weights=_weights(captures))
    span = float(np.min(variable.max(axis=1) - variable.min(axis=1)))
    pitch = span / max(1, observer.pixels - 1)
    phases = min(_MOST_PHASES, max(1, math.floor(spacing / pitch + 1e-9)))
    length = math.floor((span - spacing * (phases - 1) / phases) / spacing + 1e-9) + 1
    if length < 2 * captures.card.elements:
        raise UndeterminedError(
            f"a view spans {math.degrees(span):.3g} deg, room for {length} samples {math.degrees(spacing):.3g} deg apart, but "
            f"the card takes {captures.card.elements} of them; widen the field or narrow the card"
        )
    records, start = [], []
    for film, w, q in zip(captures.radiance, variable, factor, strict=True):
        # Centred, so that as much is lost at either end.
        first = 0.5 * (w.max() + w.min() - spacing * (length - 1 / phases))
        onto = first + spacing / phases * np.arange(length * phases)
        even = resample(film / q[:, None], w, np.clip(onto, w.min(), w.max()), order=_ORDER)
        records.append(np.moveaxis(even.reshape(length, phases, -1), 0, 2))
        start.append(first + spacing / phases * np.arange(phases))
    return np.concatenate(records), np.concatenate(start)


def _weights(captures: CaptureSet) -> PointWeights:
    return "cosine" if captures.transport == "cosine" else "thesis"


def _element_factor(captures: CaptureSet) -> Array:
    """cos theta_s,i / cos theta_c where a mirror shows the card's middle: what Q does not hold of each element, (M,)."""
    card = captures.card
    at = mirror_points(captures.observer, card, card.middle)
    places = np.append(np.asarray(card.elements_x), card.middle)
    factor = np.cos(incident_angles(places, card.distance, at))
    return np.asarray(factor[:-1] / factor[-1], dtype=np.float64)


def _departure(captures: CaptureSet) -> float:
    theta_s = scene_angles(captures.observer, captures.card)[0]
    theta_c = incident_angles(captures.card.middle, captures.card.distance, wall_points(captures.observer))
    delta = theta_s - theta_c[..., None]
    return float(np.abs(delta + mirror_directions(captures.observer, captures.card)).max())
