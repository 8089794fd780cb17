"""Lobes: Phong, Blinn and trains of Gaussians in the angle sum, and Phong's formula of 1975."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import beta, betainc

from wallmirror.brdf.base import BRDF, AngleSumBRDF, Array, LobeForm, require_choice, require_range
from wallmirror.errors import InputError

_FAR = -703.0  # the exponent from which on a Gaussian is taken for 0
_NOTHING = float(np.exp(_FAR))

#: What the height of a lobe means: 1 at its peak (the thesis's code) or unit integral per degree or radian (its text).
LobeHeight = Literal["peak", "per_degree", "per_radian"]

_MAX_EXPONENT = 1e8
_LEAST_COSINE = 1e-15
#: Of Gamma(a + 1/2) / (Gamma(a) sqrt(a)).
_GAMMA_QUOTIENT = (1, -1 / 8, 1 / 128, 5 / 1024, -21 / 32768, -399 / 262144, 869 / 4194304)


@dataclass(frozen=True, kw_only=True)
class Phong(AngleSumBRDF):
    """Specular Phong lobe c cos(u)^n about the mirror direction, zero beyond 90 deg.

    In the plane this is Phong's cosine of the angle to the mirrored direction; along z it is continued
    cylindrically like every model of this package, so it is not the rotationally symmetric 3-D lobe.

    Parameters
    ----------
    exponent:
        n, from 0.
    reflectance:
        R, from 0 to 1, by `form`.
    form:
        "conserving": R is the share of light at normal incidence that comes back, R = c (pi/2) B(n/2 + 1, 1/2), the
        largest share of all directions, so energy is conserved. "plain": R is the peak c, whatever that reflects.
    """

    exponent: float = 50.0
    reflectance: float = 0.5
    form: LobeForm = "conserving"

    def __post_init__(self) -> None:
        _require_lobe(self.exponent, self.reflectance, self.form)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        u = np.abs(np.asarray(u, dtype=np.float64))
        power = _power_of_cosine(np.minimum(u, math.pi / 2), self.exponent)
        return np.where(u >= math.pi / 2, 0.0, self._peak() * power)

    def _peak(self) -> float:
        if self.form == "plain":
            return self.reflectance
        return self.reflectance / (math.pi / 2) / _beta_half(self.exponent / 2 + 1)

    @property
    def angular_scale(self) -> float:
        """Width of the Gaussian that the lobe approaches, 1 / sqrt(n), in radians."""
        return min(math.pi / 4, 1 / math.sqrt(max(self.exponent, 1.0)))


@dataclass(frozen=True, kw_only=True)
class PhongIllumination(BRDF):
    """Phong's illumination model of 1975 read as a BRDF: specular cos(u)^n / cos(theta_s).

    It gives a radiance that knows no cosine of incidence, so the quotient of eq. 1.8 has one in its denominator. It is
    neither reciprocal nor does it conserve energy, and it grows without bound towards grazing light: for audits, not for
    walls.
    """

    exponent: float = 50.0
    specular: float = 0.5

    def __post_init__(self) -> None:
        require_range("wall.exponent", self.exponent, 0, _MAX_EXPONENT)
        require_range("wall.specular", self.specular, 0, 1)

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians; 0 for light from below the horizon."""
        lobe = Phong(exponent=self.exponent, reflectance=self.specular, form="plain")
        tilt = np.abs(np.asarray(theta_s, dtype=np.float64))
        # A rounded angle of 90 deg lies a little above the horizon, as its cosine says.
        return np.where(tilt > math.pi / 2, 0.0, lobe(theta_s, theta_o) / np.cos(np.minimum(tilt, math.pi / 2)))

    @property
    def angular_scale(self) -> float:
        """That of the lobe, in radians."""
        return Phong(exponent=self.exponent).angular_scale


@dataclass(frozen=True, kw_only=True)
class Blinn(AngleSumBRDF):
    """Blinn's lobe c cos(h)^n of the half angle (Blinn 1977); in the plane h = (theta_s + theta_o) / 2.

    Parameters
    ----------
    exponent:
        n, from 0. The lobe is about as wide as Phong's of exponent n / 4.
    reflectance, form:
        As for `Phong`; in the conserving form R = 2 pi c int_0^(pi/4) cos(t)^n cos(2 t) dt.

    Examples
    --------
    >>> lobe = Blinn(exponent=100, reflectance=0.8, form="plain")
    >>> round(float(lobe(0.5, -0.5)), 3), round(float(lobe(0.5, -0.3)), 3)
    (0.8, 0.485)
    """

    exponent: float = 200.0
    reflectance: float = 0.5
    form: LobeForm = "conserving"

    def __post_init__(self) -> None:
        _require_lobe(self.exponent, self.reflectance, self.form)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        half = np.minimum(np.abs(np.asarray(u, dtype=np.float64)) / 2, math.pi / 2)
        return np.asarray(self._peak() * _power_of_cosine(half, self.exponent), dtype=np.float64)

    def _peak(self) -> float:
        if self.form == "plain":
            return self.reflectance
        # cos 2t = 2 cos(t)^2 - 1, and int_0^(pi/4) cos(t)^m dt is an incomplete beta function of sin(t)^2.
        share = 2 * _cosine_power(self.exponent + 2) - _cosine_power(self.exponent)
        return self.reflectance / (2 * math.pi * share)

    @property
    def angular_scale(self) -> float:
        """Width of the Gaussian in u that the lobe approaches, 2 / sqrt(n), in radians."""
        return min(math.pi / 4, 2 / math.sqrt(max(self.exponent, 1.0)))


@dataclass(frozen=True, kw_only=True)
class GaussianTrain(AngleSumBRDF):
    """A train of Gaussian lobes in the angle sum (eq. 2.15, rho_test).

    Parameters
    ----------
    centres:
        Lobe centres in radians.
    sigma:
        Standard deviation of each lobe in radians.
    height:
        "peak": each lobe peaks at `scale` (what the thesis's code computes); "per_degree" or "per_radian":
        each integrates to `scale` over u in that unit ("normalised", what its text says).
    scale:
        Factor in 1/sr.

    Examples
    --------
    >>> float(GaussianTrain.of_the_code().of_sum(math.radians(15)))
    1.0
    """

    centres: tuple[float, ...]
    sigma: float
    height: LobeHeight = "peak"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.centres:
            raise InputError("names no lobe; give at least one centre", field="wall.centres_deg")
        for centre in self.centres:
            require_range("wall.centres_deg", math.degrees(centre), -180, 180)
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(f"is {math.degrees(self.sigma):g}; give a width > 0", field="wall.sigma_deg")
        require_choice("wall.height", self.height, get_args(LobeHeight))
        require_range("wall.scale", self.scale, 0, sys.float_info.max)
        if not math.isfinite(self._peak()):
            raise InputError(f"is {math.degrees(self.sigma):g}, too narrow for a finite height", field="wall.sigma_deg")
        if not math.isfinite(self._peak() * len(self.centres)):
            raise InputError(
                f"is {self.scale:g}, too large for the sum of {len(self.centres)} lobes; use other units",
                field="wall.scale",
            )

    @classmethod
    def of_the_text(cls) -> GaussianTrain:
        """Eq. 2.15 as printed: lobes at +-15 and +-30 deg, sigma 1 deg, unit integral per degree."""
        return cls(
            centres=tuple(math.radians(c) for c in (-30, -15, 15, 30)),
            sigma=math.radians(1),
            height="per_degree",
        )

    @classmethod
    def of_the_code(cls) -> GaussianTrain:
        """Eq. 2.15 as the recorded run computed it: lobes at +-15 and +-35 deg, sigma 1 deg, peak 1."""
        return cls(centres=tuple(math.radians(c) for c in (-35, -15, 15, 35)), sigma=math.radians(1))

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        u = np.asarray(u, dtype=np.float64)
        angle = np.atleast_1d(u)
        # exp(-z^2/2) directly: dividing a density by its peak turns into 0/0 for tiny sigma. Where it falls below 1e-305 it
        # is 0, since an exp that underflows takes eight times as long; clip takes half as long as maximum.
        total = np.zeros(angle.shape)
        z = np.empty(angle.shape)
        narrowness = 1 / self.sigma  # infinite for a denormal width alone
        nothing = 0.0
        for centre in self.centres:
            np.subtract(angle, centre, out=z)
            with np.errstate(over="ignore"):
                np.multiply(z, narrowness, out=z) if narrowness < math.inf else np.divide(z, self.sigma, out=z)
                z *= z
            z *= -0.5
            np.clip(z, _FAR, 0.0, out=z)
            total += np.exp(z, out=z)
            nothing += _NOTHING
        total -= nothing  # summed as the lobes are, so that what is left where all are far is 0 and never less
        total *= self._peak()
        return total.reshape(u.shape)

    def _peak(self) -> float:
        if self.height == "peak":
            return self.scale
        sigma = math.degrees(self.sigma) if self.height == "per_degree" else self.sigma
        return self.scale / (sigma * math.sqrt(2 * math.pi))

    @property
    def angular_scale(self) -> float:
        """The lobes' standard deviation in radians."""
        return min(math.pi / 4, self.sigma)


def _require_lobe(exponent: float, reflectance: float, form: str) -> None:
    require_range("wall.exponent", exponent, 0, _MAX_EXPONENT)
    require_range("wall.reflectance", reflectance, 0, 1)
    require_choice("wall.form", form, get_args(LobeForm))


def _power_of_cosine(angle: Array, exponent: float) -> Array:
    """cos(angle)^n for angles from 0 to pi/2, to some ten eps of the peak: a rounded cosine near 1 is off by n / 2 eps."""
    if exponent <= 64:
        return np.asarray(np.cos(angle) ** exponent, dtype=np.float64)
    fall = np.minimum(2 * np.sin(0.5 * angle) ** 2, 1 - _LEAST_COSINE)  # 1 - cos
    return np.asarray(np.exp(exponent * np.log1p(-fall)), dtype=np.float64)


def _beta_half(a: float) -> float:
    """The beta function B(a, 1/2) for a >= 1/2, to a few eps: log gammas of a large a would cancel."""
    if a < 100:
        return float(beta(a, 0.5))
    # sqrt(pi) Gamma(a) / Gamma(a + 1/2), by the series of the quotient in 1/a (Tricomi and Erdelyi 1951).
    quotient = np.polynomial.polynomial.polyval(1 / a, _GAMMA_QUOTIENT)
    return math.sqrt(math.pi / a) / float(quotient)


def _cosine_power(m: float) -> float:
    """int_0^(pi/4) cos(t)^m dt = B(1/2, b) I_1/2(1/2, b) / 2 with b = (m + 1) / 2."""
    b = (m + 1) / 2
    return float(0.5 * _beta_half(b) * betainc(0.5, b, 0.5))
