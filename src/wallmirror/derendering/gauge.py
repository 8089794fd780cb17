"""The one scale that no capture can tell, and what may settle it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumTable, directional_albedo
from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: What settles the global scale: max rho = 1, a known albedo of the wall, or a known mean level of the pattern.
Scale = Literal["peak", "albedo", "level"]


@dataclass(frozen=True, kw_only=True)
class Gauge:
    """The choice of the one scale that no capture can tell.

    Parameters
    ----------
    scale:
        "peak": max rho = 1; "albedo": the directional albedo at normal incidence is `wall_albedo`; "level": the mean of
        V is `source_level`.
    """

    scale: Scale = "peak"
    wall_albedo: float | None = None
    source_level: float | None = None

    def __post_init__(self) -> None:
        if self.scale not in get_args(Scale):
            raise InputError(f'is "{self.scale}"; choose one of {", ".join(get_args(Scale))}', field="scale")
        if self.wall_albedo is not None and not 0 < self.wall_albedo <= 1:
            raise InputError(f"is {self.wall_albedo:g}; an albedo lies between 0 and 1", field="wall_albedo")
        if self.source_level is not None and not 0 < self.source_level < math.inf:
            raise InputError(f"is {self.source_level:g}; give the pattern's mean radiance > 0", field="source_level")
        if self.scale == "albedo" and self.wall_albedo is None:
            raise InputError('the scale "albedo" needs the albedo; give it', field="wall_albedo")
        if self.scale == "level" and self.source_level is None:
            raise InputError('the scale "level" needs the mean radiance of the pattern; give it', field="source_level")

    @property
    def words(self) -> str:
        """The gauge in a few words."""
        match self.scale:
            case "albedo":
                return f"directional albedo of the wall = {self.wall_albedo:g}"
            case "level":
                return f"mean of the pattern = {self.source_level:g}"
            case _:
                return "max rho = 1"

    def factor(self, angle_sum: Array, brdf: Array, source: Array) -> float:
        """What a BRDF of peak 1 is to be multiplied with, and its pattern divided by."""
        match self.scale:
            case "albedo":
                assert self.wall_albedo is not None
                nodes = np.linspace(angle_sum[0], angle_sum[-1], angle_sum.size)
                values = np.maximum(np.interp(nodes, angle_sum, brdf), 0.0)
                table = AngleSumTable(start=float(nodes[0]), stop=float(nodes[-1]), values=values)
                return self.wall_albedo / directional_albedo(table)
            case "level":
                assert self.source_level is not None
                return float(np.mean(source)) / self.source_level
            case _:
                return 1.0
