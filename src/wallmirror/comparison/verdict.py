"""What a comparison says: the amplitude of each named bias, the scores of the pixels, and whether the model stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BiasTest:
    """Amplitude of one named bias in units of its template.

    Parameters
    ----------
    name, unit:
        E.g. "gain" in parts of 1, "lobe shift" in degrees.
    estimate, standard_error, interval:
        Mean over seeds, its standard error and its 99 % confidence interval.
    p_value:
        Of the hypothesis that the amplitude is zero.
    detectable:
        Smallest amplitude that this run would have rejected with 99 % power.
    """

    name: str
    unit: str
    estimate: float
    standard_error: float
    interval: tuple[float, float]
    p_value: float
    detectable: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Verdict of a render against its analytic reference.

    Parameters
    ----------
    passed:
        Whether no test rejects the model at the significance level, shared over the tests (Bonferroni).
    biases:
        The template tests, the gain first.
    z:
        z score of each pixel, (A, N); nan where left out.
    z_mean, z_std:
        Of the kept pixels; (0, 1) is what noise alone makes.
    largest_z, largest_p:
        Largest |z| and its Sidak-corrected p-value.
    uniformity_p:
        Kolmogorov-Smirnov p-value of the tiles' p-values against the uniform distribution.
    tile_p:
        p-value of each tile of pixels, (A, tiles); nan for tiles left out.
    kept, starved, edges:
        Numbers of pixels compared, left out as starved, left out as edges.
    exact:
        Whether the seeds do not scatter at all (a mirror), so that only rounding is left to compare.
    """

    passed: bool
    biases: tuple[BiasTest, ...]
    z: Array = field(repr=False)
    z_mean: float
    z_std: float
    largest_z: float
    largest_p: float
    uniformity_p: float
    tile_p: Array = field(repr=False)
    relative_rms: float
    kept: int
    starved: int
    edges: int
    exact: bool

    @property
    def gain(self) -> BiasTest:
        """The overall factor between render and reference, minus one."""
        return self.biases[0]

    def summary(self) -> dict[str, Any]:
        """Everything but the maps, ready for JSON."""
        return {
            "passed": self.passed,
            "biases": [
                {
                    "name": b.name,
                    "unit": b.unit,
                    "estimate": b.estimate,
                    "standard_error": b.standard_error if math.isfinite(b.standard_error) else None,
                    "interval_99": [end if math.isfinite(end) else None for end in b.interval],
                    "p_value": b.p_value,
                    "detectable_99": b.detectable if math.isfinite(b.detectable) else None,
                }
                for b in self.biases
            ],
            "z_mean": self.z_mean,
            "z_std": self.z_std,
            "largest_z": self.largest_z,
            "largest_p_sidak": self.largest_p,
            "uniformity_p": self.uniformity_p,
            "relative_rms": self.relative_rms,
            "pixels": {"kept": self.kept, "starved": self.starved, "edges": self.edges},
            "exact": self.exact,
        }
