"""Second stage of focused blind deconvolution: channels from their cross-correlations.

    minimise  sum_ij |h_ij - h_i x h_j|^2 + beta sum_t t^2 h_f(t)^2

with beta taken from infinity to 0, where f is the channel nearest to the source, whose energy lies nearest to t = 0 if
the channels are "maximally front-loaded" (Bharadwaj, Demanet, Fournier, IEEE Trans. Signal Processing 67(12), 2019, section V).
At beta = infinity h_f is a spike and the other channels are their correlations with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from wallmirror.deconvolution.checking import count, in_unit, real_samples
from wallmirror.deconvolution.interferometry import pairs
from wallmirror.deconvolution.levenberg import descend
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.threads import one_blas_thread

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RetrievedChannels:
    """Result of `retrieve_channels`: h (K, n), which channel was taken as the nearest, and |h_ij - h_i x h_j| / |h_ij|."""

    channels: Array
    nearest: int
    misfit: float
    steps: int


def retrieve_channels(
    correlations: ArrayLike,
    channels: int,
    *,
    nearest: int | None = None,
    weights: Sequence[float] = (0.0,),
    steps: int = 200,
) -> RetrievedChannels:
    """Channels from the cross-correlations of every pair, from a start that is focused at t = 0.

    Parameters
    ----------
    correlations:
        h_ij for i <= j, shape (K (K+1) / 2, 2n - 1), as `cross_correlations` lays them out.
    channels:
        K.
    nearest:
        Index of the channel nearest to the source; the one that all others lag behind when left out.
    weights:
        beta / sum of h_ff(0) after the focused start, falling; the last should be 0.

    Raises
    ------
    InputError
        If shapes disagree, a value or weight is not finite, or there is no such nearest channel.
    UndeterminedError
        For a table in which no channel, or not the nearest, has energy.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import aligned_error
    >>> from wallmirror.deconvolution.interferometry import cross_correlations
    >>> h = np.array([[1.0, 0.2, 0.0], [0.0, 0.7, -0.4], [0.1, 0.0, 0.8]])
    >>> aligned_error(retrieve_channels(cross_correlations(h), 3).channels, h) < 1e-8
    True
    """
    h_ij, unit = in_unit(real_samples(correlations, "correlations", ndim=2))
    count(channels, "channels")
    if h_ij.shape[0] != channels * (channels + 1) // 2 or h_ij.shape[1] % 2 == 0:
        raise InputError(
            f"has shape {h_ij.shape}; {channels} channels have {channels * (channels + 1) // 2} pairs, over an odd "
            "number of lags",
            field="correlations",
        )
    if nearest is not None and not (isinstance(nearest, (int, np.integer)) and 0 <= nearest < channels):
        raise InputError(f"is {nearest}; give the index of one of {channels} channels", field="nearest")
    if len(weights) == 0 or not all(0 <= weight < np.inf for weight in weights):
        raise InputError(f"is {tuple(weights)}; give finite weights >= 0", field="weights")
    if not isinstance(steps, (int, np.integer)) or steps < 0:
        raise InputError(f"is {steps}; give a whole number >= 0", field="steps")
    root = math.ldexp(1.0, (math.frexp(unit)[1] - 1) // 2)  # the channels' unit: that of the correlations is its square
    problem = _Problem(h_ij * (unit / root / root), channels)
    if not np.any(problem.power > 0):
        raise UndeterminedError(
            "no channel has a positive auto-correlation at lag 0, so these are correlations of no channels; the "
            "interferometric fit has failed on outputs that are too short, too noisy or too far from white channels"
        )
    if nearest is None:
        nearest = problem.leading_channel()
    if problem.power[nearest] <= 0:
        raise UndeterminedError(
            f"channel {nearest} has no energy in these correlations, so nothing can be focused on it; "
            "name another as the nearest"
        )
    x = problem.focused(nearest).ravel()
    power = float(np.sum(problem.table**2))
    taken = 0
    with one_blas_thread():
        for weight in weights:
            problem.focus_on(nearest, weight)
            end = descend(problem.cost, problem.normal_equations, x, target=0.5e-30 * power, steps=steps)
            x, taken = end.point, taken + end.steps
    problem.focus_on(nearest, 0.0)
    misfit = float(np.sqrt(2 * problem.cost(x) / power))
    return RetrievedChannels(root * x.reshape(channels, -1), nearest, misfit, taken)


class _Problem:
    """The full table h_ij over all ordered pairs, and what the descent asks of it; x = h flattened."""

    def __init__(self, h_ij: Array, channels: int) -> None:
        self.count, self.taps = channels, (h_ij.shape[1] + 1) // 2
        self.size = next_fast_len(3 * self.taps, real=True)  # R_ij * h_j must not wrap into the taps
        i, j = pairs(channels)
        self.table = np.zeros((channels, channels, self.size))
        lags = np.arange(-(self.taps - 1), self.taps)
        self.table[i[:, None], j[:, None], lags] = h_ij
        self.table[j[:, None], i[:, None], -lags] = h_ij
        self.power = self.table[np.arange(channels), np.arange(channels), 0]
        self.penalty = np.zeros((channels, self.taps))

    def leading_channel(self) -> int:
        """The channel k whose others lag behind it: h_jk has the largest share of its energy at t >= 0."""
        energy = np.sum(self.table[:, :, : self.taps] ** 2, axis=(0, 2))
        total = np.sum(self.table**2, axis=(0, 2))
        share = np.divide(energy, total, out=np.zeros_like(total), where=total > 0)
        return int(np.argmax(np.where(self.power > 0, share, -1.0)))

    def focused(self, nearest: int) -> Array:
        """h_f a spike at t = 0, the others their correlations with it."""
        peak = np.sqrt(self.power[nearest])
        start: Array = self.table[:, nearest, : self.taps] / peak
        start[nearest] = 0
        start[nearest, 0] = peak
        return start

    def focus_on(self, nearest: int, weight: float) -> None:
        self.penalty[nearest] = weight * float(np.sum(self.power)) * np.arange(self.taps) ** 2.0

    def _residual(self, h: Array) -> Array:
        spectra = rfft(h, self.size)
        fitted: Array = irfft(spectra[:, None] * np.conj(spectra[None]), self.size)
        return self.table - fitted

    def cost(self, x: Array) -> float:
        h = x.reshape(self.count, -1)
        return 0.5 * float(np.sum(self._residual(h) ** 2) + np.sum(self.penalty * h * h))

    def normal_equations(self, x: Array) -> tuple[Array, Array]:
        h = x.reshape(self.count, -1)
        spectra = rfft(h, self.size)
        # Both (i, j) and (j, i) hold h_i, hence the factors 2.
        pulled = irfft(np.sum(rfft(self._residual(h)) * spectra[None], axis=1), self.size)[:, : self.taps]
        gradient = -2 * pulled + self.penalty * h
        common = irfft(np.sum(np.abs(spectra) ** 2, axis=0), self.size)[: self.taps]
        products = irfft(spectra[:, None] * spectra[None], self.size)  # h_i * h_j
        sums = np.arange(self.taps)[:, None] + np.arange(self.taps)
        hankel = np.moveaxis(products[:, :, sums], 1, 2).reshape(x.size, x.size)
        matrix = 2 * (np.kron(np.eye(self.count), sl.toeplitz(common)) + hankel)
        return gradient.ravel(), matrix + np.diag(self.penalty.ravel())
