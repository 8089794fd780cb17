"""Reflectance models of section 1.2: each maps (theta_s, theta_o) to a BRDF value in 1/sr.

Models that depend on the angle sum u = theta_s + theta_o alone (Hypothesis 8) derive from `AngleSumBRDF` and
are functions of u as well. In three dimensions theta is the angle of the direction's projection on the x-y
plane, so that every model here is constant along z ("cylindrical"); for the diffuse wall this is no choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.errors import InputError

Array = NDArray[np.float64]

_FAR = -703.0  # the exponent from which on a Gaussian is taken for 0
_NOTHING = float(np.exp(_FAR))

#: What the height of a lobe means: 1 at its peak (the thesis's code) or unit integral per degree or radian (its text).
LobeHeight = Literal["peak", "per_degree", "per_radian"]


class BRDF:
    """A reflectance of the two in-plane angles theta_s and theta_o."""

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        raise TypeError(f"{type(self).__name__} has no finite values")

    @property
    def angular_scale(self) -> float:
        """Smallest angle in radians over which the value changes appreciably (sets quadrature orders)."""
        return math.pi / 4


class AngleSumBRDF(BRDF):
    """A reflectance that depends on u = theta_s + theta_o alone (Hypothesis 8)."""

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        return self.of_sum(np.asarray(theta_s, dtype=np.float64) + np.asarray(theta_o, dtype=np.float64))

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        raise TypeError(f"{type(self).__name__} has no finite values")


@dataclass(frozen=True, kw_only=True)
class Diffuse(AngleSumBRDF):
    """Lambertian: albedo / pi everywhere (eq. 1.12)."""

    albedo: float = 0.5

    def __post_init__(self) -> None:
        _require_range("wall.albedo", self.albedo, 0, 1)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        return np.full(np.shape(u), self.albedo / math.pi)


@dataclass(frozen=True, kw_only=True)
class Mirror(BRDF):
    """A perfect mirror, delta(theta_s + theta_o) (eqs. 1.11, 2.14): a distribution, without finite values.

    `transport` integrates it exactly over pixels instead of sampling it.
    """

    reflectance: float = 1.0

    def __post_init__(self) -> None:
        _require_range("wall.reflectance", self.reflectance, 0, 1)


@dataclass(frozen=True, kw_only=True)
class Phong(AngleSumBRDF):
    """Specular Phong lobe c cos(u)^n about the mirror direction, zero beyond 90 deg.

    In the plane this is Phong's cosine of the angle to the mirrored direction; along z it is continued
    cylindrically like every model of this module, so it is not the rotationally symmetric 3-D lobe. `reflectance` R
    is the share of light at normal incidence that comes back, R = c (pi/2) B(n/2 + 1, 1/2), so energy is conserved
    for R <= 1.
    """

    exponent: float = 50.0
    reflectance: float = 0.5

    def __post_init__(self) -> None:
        _require_range("wall.exponent", self.exponent, 0, 1e8)
        _require_range("wall.reflectance", self.reflectance, 0, 1)

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        u = np.asarray(u, dtype=np.float64)
        front = np.abs(u) < math.pi / 2
        power = np.where(front, np.cos(u), 1.0) ** self.exponent
        return np.where(front, self._peak() * power, 0.0)

    def _peak(self) -> float:
        half = self.exponent / 2
        log_beta = math.lgamma(half + 1) + math.lgamma(0.5) - math.lgamma(half + 1.5)
        return self.reflectance / (math.pi / 2) * math.exp(-log_beta)

    @property
    def angular_scale(self) -> float:
        """Width of the Gaussian that the lobe approaches, 1 / sqrt(n), in radians."""
        return min(math.pi / 4, 1 / math.sqrt(max(self.exponent, 1.0)))


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
            _require_range("wall.centres_deg", math.degrees(centre), -180, 180)
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(f"is {math.degrees(self.sigma):g}; give a width > 0", field="wall.sigma_deg")
        if self.height not in ("peak", "per_degree", "per_radian"):
            raise InputError(f'is "{self.height}"; choose "peak", "per_degree" or "per_radian"', field="wall.height")
        _require_range("wall.scale", self.scale, 0, math.inf)
        if not math.isfinite(self._peak()):
            raise InputError(f"is {math.degrees(self.sigma):g}, too narrow for a finite height", field="wall.sigma_deg")

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
        # is 0, since an exp that underflows takes eight times as long.
        total = np.zeros(angle.shape)
        for centre in self.centres:
            z = angle - centre
            with np.errstate(over="ignore"):
                z /= self.sigma
                z *= z
            z *= -0.5
            np.maximum(z, _FAR, out=z)
            np.exp(z, out=z)
            z -= _NOTHING
            total += z
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


@dataclass(frozen=True, kw_only=True)
class AngleSumTable(AngleSumBRDF):
    """Values on uniform nodes of the angle sum, linear in between, zero outside.

    Parameters
    ----------
    start, stop:
        First and last node in radians.
    values:
        BRDF at the nodes, shape (K,), in 1/sr, finite and >= 0.
    """

    start: float
    stop: float
    values: Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", _checked_table(self.values, 1))
        if not -math.inf < self.start < self.stop < math.inf:
            raise InputError("the first node must lie before the last", field="wall.table")

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        nodes = np.linspace(self.start, self.stop, self.values.size)
        return np.interp(np.asarray(u, dtype=np.float64), nodes, self.values, left=0.0, right=0.0)

    @property
    def angular_scale(self) -> float:
        """Spacing of the nodes in radians."""
        return float(self.stop - self.start) / (self.values.size - 1)


@dataclass(frozen=True, kw_only=True)
class Table(BRDF):
    """Values on uniform nodes of both angles over [-pi/2, pi/2], bilinear in between.

    Parameters
    ----------
    values:
        BRDF, shape (K_s, K_o): rows theta_s, columns theta_o; in 1/sr, finite and >= 0.
    """

    values: Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", _checked_table(self.values, 2))

    def __call__(self, theta_s: ArrayLike, theta_o: ArrayLike) -> Array:
        """Value in 1/sr, broadcast over two arrays of angles in radians."""
        (i, f), (j, g) = (_cell(theta, size) for theta, size in zip((theta_s, theta_o), self.values.shape, strict=True))
        v = self.values
        return (1 - f) * ((1 - g) * v[i, j] + g * v[i, j + 1]) + f * ((1 - g) * v[i + 1, j] + g * v[i + 1, j + 1])

    @property
    def angular_scale(self) -> float:
        """Spacing of the finer axis in radians."""
        return math.pi / float(max(self.values.shape) - 1)


@dataclass(frozen=True, kw_only=True)
class Sum(AngleSumBRDF):
    """The sum of angle-sum models, e.g. lobes over a diffuse coat."""

    parts: tuple[AngleSumBRDF, ...]

    def of_sum(self, u: ArrayLike) -> Array:
        """Value in 1/sr at angle sums u in radians, same shape."""
        total = np.zeros(np.shape(u))
        for part in self.parts:
            total += part.of_sum(u)
        return total

    @property
    def angular_scale(self) -> float:
        """The finest of its parts."""
        return min(part.angular_scale for part in self.parts)


def tabulate(brdf: AngleSumBRDF, nodes: int = 7201) -> AngleSumTable:
    """Sample a model onto `nodes` uniform angle sums over [-pi, pi], rounded to float32 as a path tracer holds it."""
    u = np.linspace(-math.pi, math.pi, nodes)
    return AngleSumTable(start=-math.pi, stop=math.pi, values=brdf.of_sum(u).astype(np.float32))


def _cell(theta: ArrayLike, size: int) -> tuple[NDArray[np.intp], Array]:
    """Index and fraction of angles in a uniform grid of `size` nodes over [-pi/2, pi/2]."""
    place = (np.asarray(theta, dtype=np.float64) / math.pi + 0.5) * (size - 1)
    index = np.clip(np.floor(place), 0, size - 2).astype(np.intp)
    return index, np.clip(place - index, 0.0, 1.0)


def _checked_table(values: ArrayLike, ndim: int) -> Array:
    table = np.array(values, dtype=np.float64)
    if table.ndim != ndim or min(table.shape) < 2:
        raise InputError(f"a table needs {ndim} axes of at least 2 nodes, not shape {table.shape}", field="wall.table")
    if not np.all(np.isfinite(table)) or table.min() < 0:
        raise InputError("holds a value that is negative or not finite; a BRDF is >= 0", field="wall.table")
    table.flags.writeable = False
    return table


def _require_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high or math.isinf(value):
        raise InputError(f"is {value:g}; give a number from {low:g} to {high:g}", field=name)
