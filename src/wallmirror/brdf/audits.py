"""Whether a reflectance can be one: non-negativity, reciprocity and energy conservation (section 1.2), with the worst
direction named.

Values are inspected on a grid of both angles that is as fine as the model's `angular_scale`, from grazing to grazing
(1e-4 rad from the horizon); the albedo is integrated at angles of incidence a degree apart or closer, and its largest
value is refined between them. An audit is therefore a measurement: it finds a fault as wide as the angular scale that
the model states, and proves nothing about finer ones. Models of the angle sum are reciprocal by form, since theta_s +
theta_o does not know which is which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from wallmirror.brdf.base import BRDF, AngleSumBRDF, Array, require_range
from wallmirror.brdf.energy import directional_albedos
from wallmirror.brdf.ideal import Mirror
from wallmirror.errors import InputError

#: How close to the horizon an audit looks, in radians.
GRAZING = 1e-4
_LEAST_NODES, _MOST_NODES = 361, 3001


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One property of a reflectance.

    Parameters
    ----------
    passed:
        Whether it holds, up to the audit's tolerance.
    value:
        What was measured where it is worst; see `Audit`.
    where:
        (theta_s, theta_o) there in radians; for energy the angle of incidence alone.
    """

    passed: bool
    value: float
    where: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Audit:
    """What an audit found.

    Parameters
    ----------
    non_negativity:
        Smallest value, in 1/sr.
    reciprocity:
        Largest |rho(theta_s, theta_o) - rho(theta_o, theta_s)|, relative to the largest |value|.
    energy:
        Largest share of light from one direction that comes back, the left-hand side of eq. 1.9.
    """

    non_negativity: Finding
    reciprocity: Finding
    energy: Finding

    @property
    def passed(self) -> bool:
        """Whether all three hold."""
        return self.non_negativity.passed and self.reciprocity.passed and self.energy.passed

    @property
    def violated(self) -> tuple[str, ...]:
        """Names of the properties that do not hold."""
        found = {
            "non-negativity": self.non_negativity,
            "reciprocity": self.reciprocity,
            "energy conservation": self.energy,
        }
        return tuple(name for name, finding in found.items() if not finding.passed)

    def sentences(self) -> tuple[str, str, str]:
        """One sentence for each property, with the amount and the worst direction."""
        (s, o), (a, b), (i,) = (
            tuple(round(math.degrees(angle), 2) + 0.0 for angle in finding.where)
            for finding in (self.non_negativity, self.reciprocity, self.energy)
        )
        return (
            f"{_holds(self.non_negativity)} non-negative: the smallest value is {self.non_negativity.value:.3g} / sr, at "
            f"theta_s = {s:g}, theta_o = {o:g} deg.",
            f"{_holds(self.reciprocity)} reciprocal: swapping light and camera changes the value by at most "
            f"{self.reciprocity.value:.2g} of the largest, at theta_s = {a:g}, theta_o = {b:g} deg.",
            f"{_holds(self.energy)} energy-conserving: at most {self.energy.value:.4g} of the light comes back, from "
            f"theta_s = {i:g} deg.",
        )


def audit(brdf: BRDF, *, tolerance: float = 1e-6) -> Audit:
    """Measure whether a reflectance is non-negative, reciprocal and energy-conserving.

    Parameters
    ----------
    tolerance:
        Negative values and asymmetries up to this share of the largest |value|, and albedos up to 1 + this plus the
        quadrature's own error, still pass: rounding, and that of float32 tables.

    Raises
    ------
    InputError
        If the model is finer than 3001 nodes along an angle (6e-6 rad for one of the angle sum) can show, or not finite
        somewhere.

    Examples
    --------
    >>> from wallmirror.brdf import Phong, PhongIllumination
    >>> audit(Phong(exponent=50)).passed
    True
    >>> audit(PhongIllumination(exponent=50)).violated
    ('reciprocity', 'energy conservation')
    """
    require_range("tolerance", tolerance, 0, 1)
    if isinstance(brdf, Mirror):  # int delta(cos theta_i - cos theta_r) d(cos theta_r) = 1 (eq. 1.11)
        fine = Finding(passed=True, value=0.0, where=(0.0, 0.0))
        energy = Finding(passed=brdf.reflectance <= 1 + tolerance, value=brdf.reflectance, where=(0.0,))
        return Audit(non_negativity=fine, reciprocity=fine, energy=energy)
    signs = _signs_of_sum if isinstance(brdf, AngleSumBRDF) else _signs
    energy = _energy(brdf, tolerance)
    non_negativity, reciprocity = signs(brdf, tolerance)
    return Audit(non_negativity=non_negativity, reciprocity=reciprocity, energy=energy)


def _signs_of_sum(brdf: BRDF, tolerance: float) -> tuple[Finding, Finding]:
    """Non-negativity along u; reciprocity holds by form, and the horizon is (+-pi/2, +-pi/2)."""
    reach = math.pi - 2 * GRAZING
    u = np.linspace(-reach, reach, 2 * max(_LEAST_NODES, math.ceil(2 * math.pi / brdf.angular_scale)) + 1)
    values = _finite(brdf(u / 2, u / 2))
    worst = int(np.argmin(values))
    # Of the pairs with that sum the plainest: the camera upright where that is possible.
    theta_s = float(np.clip(u[worst], -math.pi / 2 + GRAZING, math.pi / 2 - GRAZING))
    smallest = _non_negative(float(values[worst]), values, (theta_s, float(u[worst]) - theta_s), tolerance)
    return smallest, Finding(passed=True, value=0.0, where=(0.0, 0.0))


def _signs(brdf: BRDF, tolerance: float) -> tuple[Finding, Finding]:
    nodes = max(_LEAST_NODES, math.ceil(math.pi / brdf.angular_scale - 1e-9) + 1)
    if nodes > _MOST_NODES:
        raise InputError(
            f"changes within {math.degrees(brdf.angular_scale):.2g} deg, too fine to audit", field="wall.brdf"
        )
    theta = np.linspace(-math.pi / 2, math.pi / 2, nodes)
    theta[[0, -1]] += np.array([GRAZING, -GRAZING])
    values = _finite(brdf(theta[:, None], theta))
    i, j = np.unravel_index(int(np.argmin(values)), values.shape)
    smallest = _non_negative(float(values[i, j]), values, (float(theta[i]), float(theta[j])), tolerance)
    apart = np.abs(values - values.T)
    largest = float(np.abs(values).max())
    i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
    share = float(apart[i, j]) / largest if largest > 0 else 0.0
    return smallest, Finding(passed=share <= tolerance, value=share, where=(float(theta[i]), float(theta[j])))


def _non_negative(value: float, values: Array, where: tuple[float, float], tolerance: float) -> Finding:
    return Finding(passed=value >= -tolerance * float(np.abs(values).max()), value=value, where=where)


def _finite(values: Array) -> Array:
    if not np.all(np.isfinite(values)):
        raise InputError("has a value that is not finite", field="wall.brdf")
    return values


def _energy(brdf: BRDF, tolerance: float) -> Finding:
    # An albedo is an integral over outgoing angles, so it changes with incidence no faster than the value does.
    count = min(_LEAST_NODES, max(181, math.ceil(math.pi / brdf.angular_scale) + 1))
    incidence = np.linspace(GRAZING - math.pi / 2, math.pi / 2 - GRAZING, 2 * (count // 2) + 1)
    albedos = directional_albedos(brdf, incidence)
    # Of directions that are equally bad the most upright one.
    worst = np.flatnonzero(albedos >= albedos.max() * (1 - 1e-12))
    best = int(worst[np.argmin(np.abs(incidence[worst]))])
    around = incidence[max(best - 1, 0)], incidence[min(best + 1, incidence.size - 1)]

    def shortfall(angle: float) -> float:
        return -float(directional_albedos(brdf, [angle])[0])

    refined = minimize_scalar(shortfall, bounds=around, method="bounded", options={"xatol": 1e-4})
    angle = float(refined.x) if -refined.fun > albedos[best] * (1 + 1e-9) else float(incidence[best])
    coarse, fine = (float(directional_albedos(brdf, [angle], finer=f)[0]) for f in (1, 2))
    return Finding(passed=fine - abs(fine - coarse) <= 1 + tolerance, value=fine, where=(angle,))


def _holds(finding: Finding) -> str:
    return "Is" if finding.passed else "Is NOT"
