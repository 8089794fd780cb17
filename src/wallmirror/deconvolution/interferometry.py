"""Cross-correlations of channel outputs, and the identity on which focused blind deconvolution stands.

With (a x b)(t) = sum_s a(s + t) b(s), the outputs g_i = f * h_i obey

    g_ij = g_i x g_j = f_a * h_ij,    f_a = f x f,  h_ij = h_i x h_j        (section 3.2.4)

exactly: a property of convolutions, and of nothing else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.checking import in_unit, real_samples
from wallmirror.errors import InputError

Array = NDArray[np.float64]


def pairs(channels: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices i <= j of all pairs of channels; h_ji(t) = h_ij(-t) tells the others."""
    return np.triu_indices(channels)


def cross_correlations(signals: ArrayLike) -> Array:
    """h_ij of every pair i <= j over lags -(n-1) .. n-1, shape (K (K+1) / 2, 2n - 1), of signals (K, n).

    Examples
    --------
    >>> cross_correlations([[1, 2], [0, 1]]).round(12) + 0.0
    array([[2., 5., 2.],
           [1., 2., 0.],
           [0., 1., 0.]])
    """
    h, unit = in_unit(real_samples(signals, "signals", ndim=2))
    taps = h.shape[1]
    size = next_fast_len(2 * taps - 1, real=True)
    spectra = rfft(h, size)
    i, j = pairs(h.shape[0])
    correlations = irfft(spectra[i] * np.conj(spectra[j]), size)[:, np.arange(-(taps - 1), taps)]
    return rescaled(correlations, unit, unit, field="signals")


def identity_error(outputs: ArrayLike, source: ArrayLike, channels: ArrayLike, *, free_scale: bool = False) -> float:
    """|g_ij - f_a * h_ij| / |g_ij| over all pairs and lags: 0 for convolutions, the test of section 3.2.4.

    Parameters
    ----------
    outputs:
        g, shape (K, L).
    source, channels:
        f (S,) and h (K, n) with S + n - 1 = L.
    free_scale:
        Give f_a * h_ij the scale that fits best, where outputs and factors have units of their own.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import convolve_channels
    >>> f, h = [1.0, -2.0, 0.5], [[1.0, 0.3], [0.2, 1.0]]
    >>> identity_error(convolve_channels(f, h), f, h) < 1e-14
    True
    """
    g, unit = in_unit(real_samples(outputs, "outputs", ndim=2))
    f, source_unit = in_unit(real_samples(source, "source", ndim=1))
    h, channel_unit = in_unit(real_samples(channels, "channels", ndim=2))
    if not np.any(g):
        raise InputError("is zero everywhere, so no error can be relative to it", field="outputs")
    if f.size + h.shape[1] - 1 != g.shape[1] or h.shape[0] != g.shape[0]:
        raise InputError(
            f"has shape {g.shape}; {h.shape[0]} channels of {h.shape[1]} taps and a source of {f.size} samples make "
            f"({h.shape[0]}, {f.size + h.shape[1] - 1})",
            field="outputs",
        )
    size = next_fast_len(2 * g.shape[1] - 1, real=True)
    i, j = pairs(g.shape[0])
    outputs_spectra, channel_spectra = rfft(g, size), rfft(h, size)
    recorded = irfft(outputs_spectra[i] * np.conj(outputs_spectra[j]), size)
    predicted = irfft(np.abs(rfft(f, size)) ** 2 * channel_spectra[i] * np.conj(channel_spectra[j]), size)
    if free_scale:
        predicted *= np.sum(recorded * predicted) / max(float(np.sum(predicted * predicted)), 1e-300)
    else:
        predicted = rescaled(predicted, *2 * (source_unit, channel_unit, 1 / unit), field="source")
    return float(np.linalg.norm(recorded - predicted) / np.linalg.norm(recorded))
