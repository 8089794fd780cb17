"""The radiance that an observer captured, with the geometry that a solver needs; and the truth behind a render."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.scene import Room
from wallmirror.transport import Weights

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CaptureSet:
    """A views x N pixels x B realisations of radiance, and where observer and card stood.

    Parameters
    ----------
    observer, card, room:
        The geometry; `room` and the card's albedo serve the check of Hypothesis 2 (one bounce).
    transport:
        Weights that a solver assumes: "physical", "cosine" or "thesis".
    radiance:
        Shape (A, N, B), in W m^-2 sr^-1 or relative; negative values, the noise of a real camera, are kept.
    variance:
        Variance of `radiance`, same shape, in its unit squared; infinite where a pixel carries no weight
        (saturated); None if nothing is known.
    variance_is_floor:
        True if the variance tells of rounding and saturation alone, so that the noise itself is still unknown.
    provenance:
        Free-form notes: scene, depth, samples per pixel, camera.

    Raises
    ------
    InputError
        If shapes disagree, radiance is not finite, or a variance is negative or NaN.

    Examples
    --------
    >>> observer = Observer(position=(0.0, -5.0), fov=1.0, view_angles=(0.0,), pixels=3)
    >>> card = Card(elements_x=(-1.0, 1.0), y=-1.0)
    >>> CaptureSet(observer=observer, card=card, radiance=np.ones((1, 3, 2))).realisations
    2
    """

    observer: Observer
    card: Card
    radiance: Array = field(repr=False)
    transport: Weights = "physical"
    variance: Array | None = field(default=None, repr=False)
    variance_is_floor: bool = False
    room: Room | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.transport not in get_args(Weights):
            raise InputError(f'is "{self.transport}"; choose one of {", ".join(get_args(Weights))}', field="transport")
        radiance = frozen_array(self.radiance)
        expected = (self.observer.views, self.observer.pixels)
        if radiance.ndim != 3 or radiance.shape[:2] != expected or radiance.shape[2] == 0:
            raise InputError(
                f"has shape {radiance.shape}; give (views, pixels, realisations) = ({expected[0]}, {expected[1]}, B)",
                field="radiance",
            )
        if not np.all(np.isfinite(radiance)):
            raise InputError("holds a value that is not finite", field="radiance")
        object.__setattr__(self, "radiance", radiance)
        if self.variance is not None:
            variance = frozen_array(self.variance)
            if variance.shape != radiance.shape:
                raise InputError(
                    f"has shape {variance.shape}; give {radiance.shape}, that of the radiance", field="variance"
                )
            if not np.all(variance >= 0):
                raise InputError("holds a negative value or NaN; give a variance >= 0", field="variance")
            object.__setattr__(self, "variance", variance)
        elif self.variance_is_floor:
            raise InputError("needs a variance", field="variance_is_floor")
        room = self.room
        if room is not None and not (self.card.distance < room.depth and self.observer.distance < room.depth):
            raise InputError("the room must be deeper than card and observer are far", field="room.depth")
        notes: dict[str, object] = dict(self.provenance)
        for name, note in notes.items():
            if not isinstance(note, str):
                raise InputError(f"is {note!r}; give a text", field=f"provenance.{name}")
        object.__setattr__(self, "provenance", notes)

    @property
    def realisations(self) -> int:
        """B, the number of realisations of the pattern."""
        return int(self.radiance.shape[2])


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What a rendered capture set was made from, to judge a solution by.

    Parameters
    ----------
    source:
        V, shape (M, B): radiance of each element in each realisation.
    theta_s, theta_o:
        Angles of the BRDF's samples in radians, shape (K,); K may be 0 (a mirror has no finite values).
    brdf:
        The BRDF there in 1/sr, shape (K,).
    """

    source: Array = field(repr=False)
    theta_s: Array = field(repr=False)
    theta_o: Array = field(repr=False)
    brdf: Array = field(repr=False)

    def __post_init__(self) -> None:
        for name in ("source", "theta_s", "theta_o", "brdf"):
            values = frozen_array(getattr(self, name))
            if values.ndim != (2 if name == "source" else 1):
                raise InputError(f"has shape {values.shape}", field=name)
            if not np.all(np.isfinite(values)):
                raise InputError("holds a value that is not finite", field=name)
            object.__setattr__(self, name, values)
        if not self.theta_s.shape == self.theta_o.shape == self.brdf.shape:
            raise InputError("theta_s, theta_o and brdf must be equally long", field="brdf")

    @property
    def angle_sum(self) -> Array:
        """u = theta_s + theta_o of each sample in radians, shape (K,)."""
        return self.theta_s + self.theta_o


def frozen_array(values: NDArray[np.float64]) -> Array:
    """A float64 copy that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
