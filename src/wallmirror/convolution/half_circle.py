"""Functions of a direction on a uniform grid: spread deltas onto it, convolve with a BRDF, read between its nodes.

Everything is B-spline interpolation of one degree p, the order. With the centred B-spline beta and the step h, a
delta at theta_s is spread over p + 1 nodes with the weights beta(theta_s / h - k), and a map is read at theta_o with
beta(theta_o / h - l). For that the samples of rho are divided by those of beta, once for each of the two, in the
Fourier domain (the splines' prefilter). The discrete convolution is then the spline in both angles that interpolates
rho(theta_s + theta_o) on the grid, and its error falls as h^(p + 1) where rho is smooth. Order 0 is the nearest node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from wallmirror.brdf import BRDF, AngleSumBRDF, Mirror
from wallmirror.errors import InputError

Array = NDArray[np.float64]

_MAX_ORDER = 9
_MOST_SAMPLES = 10**7


@dataclass(frozen=True, kw_only=True)
class HalfCircle:
    """K uniform directions over the half circle in front of a wall, and as many behind it to close the circle.

    The sum of two directions in front of the wall lies within (-pi, pi), so a circular convolution never wraps.

    Parameters
    ----------
    samples:
        K >= 2; the step is pi / K.
    order:
        Degree of the B-splines, 0 (nearest node) to 9.

    Examples
    --------
    A delta at 10.3 deg on a wall with one wide lobe, seen from -20.1 deg, with nodes 1 deg apart:

    >>> from wallmirror.brdf import GaussianTrain
    >>> lobe, grid = GaussianTrain(centres=(0.0,), sigma=0.1), HalfCircle(samples=180, order=5)
    >>> seen = grid.read(grid.outgoing(grid.spread(np.radians([10.3]), [2.0]), lobe), np.radians([-20.1]))
    >>> bool(abs(seen[0] - 2 * lobe.of_sum(np.radians(-9.8))) < 1e-6)
    True
    """

    samples: int
    order: int = 3

    def __post_init__(self) -> None:
        if not isinstance(self.samples, (int, np.integer)) or not 2 <= self.samples <= _MOST_SAMPLES:
            raise InputError(
                f"needs at least two directions and at most {_MOST_SAMPLES}, not {self.samples}", field="samples"
            )
        if self.order not in range(_MAX_ORDER + 1):
            raise InputError(f"is {self.order}; give a whole number from 0 to {_MAX_ORDER}", field="order")

    @property
    def step(self) -> float:
        """h, the angle between neighbouring nodes in radians."""
        return math.pi / self.samples

    @property
    def angles(self) -> Array:
        """The 2K nodes in the order of a Fourier transform: 0, h, ..., then from -pi to -h; in radians."""
        nodes: Array = self.step * np.fft.ifftshift(np.arange(-self.samples, self.samples, dtype=np.float64))
        return nodes

    def weights(self, angles: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        """The p + 1 nodes around each angle and their B-splines' values, both of shape (p + 1, *angles.shape)."""
        place = _finite("angles", angles) / self.step
        first = np.ceil(place - 0.5 * (self.order + 1)).astype(np.intp)
        near = np.arange(self.order + 1).reshape((-1,) + (1,) * place.ndim)
        beta = BSpline.basis_element(np.arange(self.order + 2) - 0.5 * (self.order + 1), extrapolate=False)
        values = np.nan_to_num(beta(place - (first + near)))
        return (first + near) % (2 * self.samples), values

    def spread(self, angles: ArrayLike, strengths: ArrayLike) -> Array:
        """The map of deltas: (..., M) angles and strengths that broadcast with them to (..., 2K)."""
        nodes, values = self.weights(angles)
        values = values * _finite("source", strengths)
        nodes = np.broadcast_to(nodes, values.shape)
        lead = values.shape[1:-1]
        map_ = np.zeros((*lead, 2 * self.samples))
        rows = np.indices(nodes.shape)[1:-1]
        np.add.at(map_, (*rows, nodes), values)
        return map_

    def coefficients(self, brdf: AngleSumBRDF) -> Array:
        """Spline coefficients of rho for a delta that is spread and a map that is read, shape (2K,).

        Raises
        ------
        InputError
            If rho is no function of the angle sum, has no values, or is narrower than a step.
        """
        spectrum = scipy.fft.rfft(self._samples(brdf)) / self._beta_spectrum() ** 2
        return np.asarray(scipy.fft.irfft(spectrum, 2 * self.samples), dtype=np.float64)

    def outgoing(self, incoming: ArrayLike, brdf: AngleSumBRDF) -> Array:
        """Coefficients of the light sent into all directions for maps of the incoming light, both (..., 2K).

        One circular convolution each, by FFT: L(theta_o) = sum over theta_s of rho(theta_o + theta_s) E(theta_s).
        The sum in place of Hypothesis 8's difference turns the map round, which conjugates its spectrum.
        """
        spectrum = np.conj(scipy.fft.rfft(_finite("incoming", incoming), axis=-1))
        spectrum = spectrum * scipy.fft.rfft(self.coefficients(brdf))
        return np.asarray(scipy.fft.irfft(spectrum, 2 * self.samples, axis=-1), dtype=np.float64)

    def read(self, outgoing: ArrayLike, angles: ArrayLike) -> Array:
        """Values at angles of shape S from coefficients (2K,), or from one row each of coefficients (*S, 2K)."""
        nodes, values = self.weights(angles)
        outgoing = _finite("outgoing", outgoing)
        if outgoing.shape not in ((2 * self.samples,), (*nodes.shape[1:], 2 * self.samples)):
            raise InputError(
                f"has shape {outgoing.shape}; give {2 * self.samples} coefficients, or as many for each angle",
                field="outgoing",
            )
        if outgoing.ndim == 1:
            taken = outgoing[nodes]
        else:
            taken = np.take_along_axis(outgoing, np.moveaxis(nodes, 0, -1), axis=-1)
            taken = np.moveaxis(taken, -1, 0)
        return np.asarray(np.sum(values * taken, axis=0), dtype=np.float64)

    def _samples(self, brdf: AngleSumBRDF) -> Array:
        require_angle_sum(brdf)
        if self.order > 0 and self.step > brdf.angular_scale:
            needed = math.ceil(math.pi / brdf.angular_scale)
            raise InputError(
                f"{self.samples} directions are {math.degrees(self.step):.3g} deg apart and step over a BRDF that changes "
                f"within {math.degrees(brdf.angular_scale):.3g} deg; give at least {needed}",
                field="samples",
            )
        return brdf.of_sum(self.angles)

    def _beta_spectrum(self) -> Array:
        """Fourier transform of the B-spline sampled at the nodes: real, even and positive."""
        samples = np.zeros(2 * self.samples)
        nodes, values = self.weights(np.zeros(()))
        np.add.at(samples, nodes, values)
        spectrum: Array = np.real(scipy.fft.rfft(samples))
        return spectrum


def require_angle_sum(brdf: BRDF) -> None:
    """Raise InputError unless the BRDF has values that depend on the angle sum alone (Hypothesis 8)."""
    if isinstance(brdf, Mirror):
        raise InputError(
            "is a mirror, a delta without values to convolve with; `transport_matrix` renders it exactly",
            field="wall.brdf",
        )
    if not isinstance(brdf, AngleSumBRDF):
        raise InputError(
            f"is a {type(brdf).__name__}, which is no function of the angle sum (Hypothesis 8); "
            "`best_angle_sum` gives the nearest one that is, and how far off it is",
            field="wall.brdf",
        )


def _finite(name: str, values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if not np.all(np.isfinite(array)):
        raise InputError("holds a value that is not finite", field=name)
    return array
