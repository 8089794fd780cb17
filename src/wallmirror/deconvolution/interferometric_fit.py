"""First stage of focused blind deconvolution: the source's auto-correlation and the channels' cross-correlations.

    minimise  sum_ij |g_ij - f_a * h_ij|^2 + alpha sum_i t^2 h_ii(t)^2,    f_a(0) = 1

with alpha taken from infinity to 0 (Bharadwaj, Demanet, Fournier, IEEE Trans. Signal Processing 67(12), 2019, section IV).
At infinity each h_ii is a spike, the channels are "maximally white" and all colour goes to the source; lowering alpha
gives the channels back what the source cannot explain. Alternating least squares, both halves exact: 2n - 1
unknowns in a Toeplitz system for each pair, then one banded Toeplitz system for f_a. Alternation is slow where colour can move
between f_a and h_ij nearly for free, so its steps are combined by Anderson's mixing (J. ACM 12(4), 1965).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.channels import checked_outputs
from wallmirror.deconvolution.checking import count
from wallmirror.deconvolution.interferometry import pairs
from wallmirror.errors import InputError
from wallmirror.threads import one_blas_thread

Array = NDArray[np.float64]

_MEMORY = 60  # steps that Anderson's mixing combines
_FOCUSED_STEPS = 10  # at alpha > 0, where only the start for the next alpha is wanted
_AT_REST = 1e-13
_PATIENCE = 80  # steps without a gain of a thousandth, as where noise is all that is left
_RIDGE = 1e-14


@dataclass(frozen=True)
class InterferometricFit:
    """Result of `fit_interferometric`.

    Parameters
    ----------
    autocorrelation:
        f_a over lags 0 .. S-1, with f_a(0) = 1.
    correlations:
        h_ij over all pairs i <= j and lags -(n-1) .. n-1.
    misfit:
        |g_ij - f_a * h_ij| / |g_ij|.
    whiteness:
        Share of the energy of the h_ii that lies at zero lag.
    history:
        The misfit after each step, all alphas in turn.
    """

    autocorrelation: Array
    correlations: Array
    misfit: float
    whiteness: float
    history: tuple[float, ...]


def fit_interferometric(
    outputs: ArrayLike, taps: int, *, weights: Sequence[float] = (np.inf, 0.0), steps: int = 300, target: float = 1e-11
) -> InterferometricFit:
    """Split the cross-correlations of the outputs into those of source and channels.

    Parameters
    ----------
    outputs:
        g, shape (K, L): full records of K channels, L = S + n - 1.
    taps:
        n, the largest number of taps of a channel.
    weights:
        alpha in units of f_a's energy, falling; the first should be infinite and the last 0.
    steps:
        Largest number of alternations at the last alpha.
    target:
        Misfit at which the fit is as good as rounding lets it be.

    Raises
    ------
    InputError, UndeterminedError
        As `checked_outputs`; InputError for weights that rise, and for correlations outside the range of float64.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import aligned_error, convolve_channels
    >>> from wallmirror.deconvolution.interferometry import cross_correlations
    >>> rng = np.random.default_rng(0)
    >>> f, h = rng.standard_normal(100), rng.standard_normal((5, 4))
    >>> fit = fit_interferometric(convolve_channels(f, h), 4)
    >>> aligned_error(fit.correlations, cross_correlations(h)) < 1e-6
    True
    """
    g, scale = checked_outputs(outputs, taps)
    count(steps, "steps")
    if not target >= 0:
        raise InputError(f"is {target:g}; give a number >= 0", field="target")
    if len(weights) == 0 or not all(w >= 0 for w in weights) or any(b > a for a, b in itertools.pairwise(weights)):
        raise InputError(f"is {tuple(weights)}; give weights >= 0 that fall", field="weights")
    history: list[float] = []
    with one_blas_thread():
        problem = _Problem(g, taps)
        f_a = problem.start()
        for weight in weights:
            last = weight == weights[-1]
            f_a = _mixed_alternation(problem, f_a, weight, steps if last else _FOCUSED_STEPS, target, history)
        correlations = problem.channels(f_a, weights[-1])
        misfit = problem.misfit(f_a, correlations)
    auto = correlations[problem.is_auto]
    whiteness = float(np.sum(auto[:, taps - 1] ** 2) / max(np.sum(auto * auto), 1e-300))
    correlations = rescaled(correlations, scale, scale, field="outputs")
    return InterferometricFit(f_a, correlations, misfit, whiteness, tuple(history))


def _mixed_alternation(
    problem: _Problem, f_a: Array, weight: float, steps: int, target: float, history: list[float]
) -> Array:
    """Alternate at one alpha: of each step's answer and those before, take the combination that moves least."""
    answers: list[Array] = []
    moves: list[Array] = []
    best, best_misfit = f_a, np.inf
    patience, reached = _PATIENCE, np.inf
    for _ in range(steps):
        h_ij = problem.channels(f_a, weight)
        misfit = problem.misfit(f_a, h_ij)
        history.append(misfit)
        if misfit < best_misfit:
            best, best_misfit = f_a, misfit
        elif misfit > 2 * best_misfit and weight == 0:
            # Mixing has gone astray: begin again from the best point, plainly.
            answers, moves, f_a = [], [], best
            h_ij = problem.channels(f_a, weight)
        patience = _PATIENCE if best_misfit < 0.999 * reached else patience - 1
        reached = best_misfit if patience == _PATIENCE else reached
        answer = problem.source(h_ij)
        move = answer - f_a
        if misfit <= target or patience == 0 or np.linalg.norm(move) <= _AT_REST * np.linalg.norm(f_a):
            break
        answers, moves = [*answers, answer][-_MEMORY:], [*moves, move][-_MEMORY:]
        f_a = answer
        if len(moves) > 1:
            change, turn = np.diff(np.array(moves), axis=0).T, np.diff(np.array(answers), axis=0).T
            f_a = answer - turn @ np.linalg.lstsq(change, move, rcond=1e-12)[0]
    return best if weight == 0 else f_a


class _Problem:
    """Spectra of the g_ij and the two exact halves of the alternation."""

    def __init__(self, outputs: Array, taps: int) -> None:
        channels, length = outputs.shape
        self.taps, self.samples = taps, length - taps + 1
        # All of f_a * h_ij and g_ij lies within lags -(L-1) .. L-1, so that this circle does not wrap.
        self.size = next_fast_len(2 * length - 1, real=True)
        i, j = pairs(channels)
        self.is_auto = i == j
        self.count = np.where(self.is_auto, 1.0, 2.0)  # (i, j) and (j, i)
        spectra = rfft(outputs, self.size)
        self.spectra = spectra[i] * np.conj(spectra[j])
        frequencies = np.arange(self.size // 2 + 1)
        # A real spectrum's two halves are conjugates; only its ends stand alone.
        self.twice = np.where((frequencies == 0) | (2 * frequencies == self.size), 1.0, 2.0) / self.size
        self.lags = np.arange(-(taps - 1), taps)
        turn = np.exp(-2j * np.pi / self.size * ((self.lags[:, None] * frequencies) % self.size))
        # Few lags of many spectra: a product with the transform's own matrix is cheaper than padded FFTs.
        self.to_spectrum = turn
        self.to_lags = np.conj(turn.T) * self.twice[:, None]
        self.power = float(self.count @ (np.abs(self.spectra) ** 2 @ self.twice))

    def start(self) -> Array:
        """The auto-correlation that white channels would leave."""
        total: Array = irfft(np.sum(self.spectra[self.is_auto], axis=0), self.size)[: self.samples]
        return np.asarray(total / total[0], dtype=np.float64)

    def _spectrum(self, f_a: Array) -> Array:
        full = np.zeros(self.size)
        full[: self.samples] = f_a
        if self.samples > 1:
            full[-(self.samples - 1) :] = f_a[:0:-1]
        return np.asarray(rfft(full).real)

    def channels(self, f_a: Array, weight: float) -> Array:
        """h_ij of least squares for known f_a."""
        spectrum = self._spectrum(f_a)
        right = ((spectrum * self.spectra) @ self.to_lags).real
        correlation = irfft(spectrum**2, self.size)[: self.lags.size]
        matrix = sl.toeplitz(correlation)
        matrix[np.diag_indices_from(matrix)] *= 1 + _RIDGE
        h_ij = sl.solve(matrix, right.T, assume_a="pos").T
        if np.isinf(weight):
            h_ij[self.is_auto] = 0
            h_ij[self.is_auto, self.taps - 1] = right[self.is_auto, self.taps - 1] / correlation[0]
        elif weight > 0:
            focus = matrix + weight * correlation[0] * np.diag(self.lags.astype(np.float64) ** 2)
            h_ij[self.is_auto] = sl.solve(focus, right[self.is_auto].T, assume_a="pos").T
        return np.asarray(h_ij, dtype=np.float64)

    def source(self, h_ij: Array) -> Array:
        """f_a of least squares for known h_ij, scaled to f_a(0) = 1."""
        spectra = h_ij @ self.to_spectrum
        correlation = irfft(self.count @ np.abs(spectra) ** 2, self.size)[
            : min(4 * self.taps - 3, 2 * self.samples - 1)
        ]
        right = irfft(self.count @ (np.conj(spectra) * self.spectra).real, self.size)
        band = np.repeat(correlation[:, None], 2 * self.samples - 1, axis=1)
        band[0] *= 1 + _RIDGE
        lags = np.arange(-(self.samples - 1), self.samples)
        f_a = sl.solveh_banded(band, right[lags], lower=True)[self.samples - 1 :]
        return np.asarray(f_a / f_a[0], dtype=np.float64)

    def misfit(self, f_a: Array, h_ij: Array) -> float:
        missed = self._spectrum(f_a) * (h_ij @ self.to_spectrum) - self.spectra
        squares = missed.real**2 + missed.imag**2
        return float(np.sqrt(self.count @ (squares @ self.twice) / self.power))
