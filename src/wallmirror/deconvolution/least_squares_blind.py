"""Least-squares blind deconvolution: the fit that focused blind deconvolution starts from and repairs.

    minimise  sum_i |g_i - f * h_i|^2    over f and h,    |h| = 1

f is eliminated (variable projection, Golub and Pereyra, SIAM J. Numerical Analysis 10(2), 1973, in the form of
Kaufman, BIT 15, 1975): given h it is one banded Toeplitz system. If the channels are given more taps than they have, zeros
of f can move into all of them at no cost, and for long records nearly so (Bharadwaj, Demanet, Fournier, IEEE Trans.
Signal Processing 67(12), 2019, section II): the answer depends on the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.channels import checked_outputs
from wallmirror.deconvolution.checking import in_unit, real_samples
from wallmirror.deconvolution.levenberg import descend
from wallmirror.errors import InputError
from wallmirror.threads import one_blas_thread

Array = NDArray[np.float64]

_ROUNDING = 1e-14  # of the outputs; no fit gets closer


@dataclass(frozen=True)
class LeastSquaresBlind:
    """Result of `least_squares_blind`.

    Parameters
    ----------
    source, channels:
        f (S,) and h (K, n), |h| = 1.
    misfit:
        |g - f * h| / |g|.
    amplification:
        Largest relative error of h that a relative error 1 of the outputs could make, to first order; infinite where the
        outputs leave a family of answers.
    steps:
        Of the descent.
    """

    source: Array
    channels: Array
    misfit: float
    amplification: float
    steps: int

    @property
    def predicted_error(self) -> float:
        """Relative error of h that a misfit of this size can hide nearby; answers far away may fit as well."""
        return self.amplification * max(self.misfit, float(np.finfo(np.float64).eps))


def least_squares_blind(outputs: ArrayLike, taps: int, *, start: ArrayLike, steps: int = 100) -> LeastSquaresBlind:
    """Fit source and channels to the outputs from a start.

    Parameters
    ----------
    outputs:
        g, shape (K, L): full records, L = S + taps - 1.
    taps:
        n, the number of taps of each channel.
    start:
        Channels (K, n) to start from.

    Raises
    ------
    InputError, UndeterminedError
        As `checked_outputs`.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import aligned_error, convolve_channels
    >>> rng = np.random.default_rng(0)
    >>> f, h = rng.standard_normal(60), rng.standard_normal((4, 5))
    >>> fit = least_squares_blind(convolve_channels(f, h), 5, start=h + 0.1 * rng.standard_normal(h.shape))
    >>> aligned_error(fit.channels, h) < 1e-10
    True
    """
    g, scale = checked_outputs(outputs, taps)
    h = in_unit(real_samples(start, "start", ndim=2))[0]
    if not isinstance(steps, (int, np.integer)) or steps < 0:
        raise InputError(f"is {steps}; give a whole number >= 0", field="steps")
    if h.shape != (g.shape[0], taps) or not np.any(h):
        raise InputError(
            f"has shape {h.shape}; give channels of shape {(g.shape[0], taps)}, not all zero", field="start"
        )
    problem = _Problem(g, taps)
    target = 0.5 * (_ROUNDING**2) * float(np.sum(g * g))
    with one_blas_thread():
        end = descend(
            problem.cost, problem.normal_equations, (h / np.linalg.norm(h)).ravel(), target=target, steps=steps
        )
        channels = problem.shaped(end.point) / np.linalg.norm(end.point)
        amplification = problem.amplification(channels)
    power = float(np.sum(g * g))
    return LeastSquaresBlind(
        source=rescaled(problem.source(channels), scale, field="outputs"),
        channels=channels,
        misfit=float(np.sqrt(2 * end.cost / power)),
        amplification=amplification,
        steps=end.steps,
    )


class _Problem:
    """The outputs, and what the descent asks of them; x = h flattened."""

    def __init__(self, outputs: Array, taps: int) -> None:
        self.g, self.taps = outputs, taps
        self.samples = outputs.shape[1] - taps + 1
        self.size = next_fast_len(outputs.shape[1], real=True)
        self.spectra = rfft(outputs, self.size)

    def shaped(self, x: Array) -> Array:
        return x.reshape(-1, self.taps)

    def _normal_band(self, spectra: Array) -> Array:
        """Lower band of sum_i H_i^T H_i, ridged so that common zeros on the unit circle do not stop the solve."""
        correlation = irfft(np.sum(np.abs(spectra) ** 2, axis=0), self.size)[: min(self.taps, self.samples)]
        band = np.repeat(correlation[:, None], self.samples, axis=1)
        band[0] *= 1 + 1e-14
        return band

    def source(self, channels: Array) -> Array:
        spectra = rfft(channels, self.size)
        right = irfft(np.sum(np.conj(spectra) * self.spectra, axis=0), self.size)[: self.samples]
        return np.asarray(sl.solveh_banded(self._normal_band(spectra), right, lower=True), dtype=np.float64)

    def residual(self, channels: Array, source: Array) -> Array:
        fitted: Array = irfft(rfft(source, self.size) * rfft(channels, self.size), self.size)
        return self.g - fitted[:, : self.g.shape[1]]

    def cost(self, x: Array) -> float:
        channels = self.shaped(x)
        return 0.5 * float(np.sum(self.residual(channels, self.source(channels)) ** 2))

    def normal_equations(self, x: Array) -> tuple[Array, Array]:
        channels = self.shaped(x)
        f = self.source(channels)
        f_spectrum = rfft(f, self.size)
        residual = rfft(self.residual(channels, f), self.size)
        gradient = -irfft(np.conj(f_spectrum) * residual, self.size)[:, : self.taps].ravel()
        matrix = self.reduced(channels, f)
        # The scale of h is no direction to move in; a unit weight on it keeps the matrix regular.
        unit = x / np.linalg.norm(x)
        return gradient, matrix + matrix[0, 0] * np.outer(unit, unit)

    def reduced(self, channels: Array, f: Array) -> Array:
        """J^T J over h with f eliminated: I x Toeplitz(f_a) - B^T A^-1 B, shape (K n, K n)."""
        f_spectrum, spectra = rfft(f, self.size), rfft(channels, self.size)
        correlation = irfft(np.abs(f_spectrum) ** 2, self.size)[: self.taps]
        # B[m, (i, t)] = sum_u h_i(u) f(u + m - t), a Toeplitz block for each channel.
        crossed = irfft(f_spectrum * np.conj(spectra), self.size)
        lag = np.arange(self.samples)[:, None] - np.arange(self.taps)
        mixed = np.moveaxis(crossed[:, lag], 0, 1).reshape(self.samples, -1)
        solved = sl.solveh_banded(self._normal_band(spectra), mixed, lower=True)
        matrix = np.kron(np.eye(channels.shape[0]), sl.toeplitz(correlation)) - mixed.T @ solved
        return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)

    def amplification(self, channels: Array) -> float:
        f = self.source(channels)
        values = np.linalg.eigvalsh(self.reduced(channels, f))
        # The smallest belongs to h itself, the scale; the second is the least certain direction.
        second = float(values[1]) if values.size > 1 else np.inf
        if second <= 1e-13 * float(values[-1]):
            return np.inf
        return float(np.linalg.norm(self.g) / np.sqrt(second) / np.linalg.norm(channels))
