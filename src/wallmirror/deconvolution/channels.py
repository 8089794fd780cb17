"""Several channels that one source feeds: their outputs, checks of them, and errors up to what no output can tell.

    g_i = f * h_i,    i = 1 .. K        (full linear convolution, eq. 3.8)

A scale between source and channels is never seen, and a common delay only through the ends of the records.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.checking import in_unit, real_samples
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]


def convolve_channels(source: ArrayLike, channels: ArrayLike) -> Array:
    """Outputs g_i = f * h_i, shape (K, S + n - 1), of a source (S,) and channels (K, n).

    Raises
    ------
    InputError
        For arrays of other shapes, values that are not finite, or outputs outside the range of float64.

    Examples
    --------
    >>> convolve_channels([1, 2], [[1, 0], [0, 3]])
    array([[1., 2., 0.],
           [0., 3., 6.]])
    """
    f, source_unit = in_unit(real_samples(source, "source", ndim=1))
    h, unit = in_unit(real_samples(channels, "channels", ndim=2))
    length = f.size + h.shape[1] - 1
    size = next_fast_len(length, real=True)
    outputs: Array = irfft(rfft(f, size) * rfft(h, size), size)[:, :length]
    # Whole numbers stay whole to rounding; a short product is as cheap done directly, and exact.
    if f.size * h.shape[1] <= 4096:
        outputs = np.array([np.convolve(f, channel) for channel in h])
    return rescaled(outputs, source_unit, unit, field="channels")


def checked_outputs(outputs: ArrayLike, taps: int) -> tuple[Array, float]:
    """Outputs (K, L) divided by a power of two near their largest magnitude, and that power.

    Raises
    ------
    InputError
        For arrays of another kind, or channels longer than the record.
    UndeterminedError
        When several channels are needed and there are none: one output, darkness, or multiples of one output.
    """
    g, scale = in_unit(real_samples(outputs, "outputs", ndim=2))
    if isinstance(taps, bool) or not isinstance(taps, (int, np.integer)) or taps < 1:
        raise InputError(f"is {taps!r}; give a whole number of taps >= 1", field="taps")
    if taps > g.shape[1]:
        raise InputError(
            f"is {taps}, longer than the record of {g.shape[1]} samples; give fewer taps or a longer record",
            field="taps",
        )
    if g.shape[0] < 2:
        raise UndeterminedError(
            "one output cannot tell source from channel: any split of its zeros fits; record two channels or more"
        )
    if not np.any(g):
        raise UndeterminedError("every output is zero; record while the source is on")
    values = np.linalg.svd(g @ g.T, compute_uv=False)
    if values[1] <= (1e-13 * g.shape[1]) * values[0]:
        raise UndeterminedError(
            "all outputs are multiples of one, so nothing tells source from channel; record channels that differ"
        )
    return g, scale


def aligned_error(estimate: ArrayLike, truth: ArrayLike, *, shifts: int = 0) -> float:
    """Relative error after the best scale and the best common shift of up to that many samples (last axis).

    Raises
    ------
    InputError
        For arrays of two shapes, values that are not finite, a truth that is zero, or as many shifts as samples.

    Examples
    --------
    >>> aligned_error([0, 0, 2, 4], [0, 1, 2, 0], shifts=1)
    0.0
    """
    e, t = in_unit(real_samples(estimate, "estimate"))[0], in_unit(real_samples(truth, "truth"))[0]
    if e.shape != t.shape or not np.any(t):
        raise InputError(
            f"has shape {e.shape}; give that of the truth {t.shape}, which may not be zero", field="estimate"
        )
    if not isinstance(shifts, (int, np.integer)) or not 0 <= shifts < t.shape[-1]:
        raise InputError(f"is {shifts}; give a whole number below the {t.shape[-1]} samples", field="shifts")
    best = np.inf
    for shift in range(-shifts, shifts + 1):
        moved = np.roll(e, shift, axis=-1)
        if shift > 0:
            moved[..., :shift] = 0
        elif shift < 0:
            moved[..., shift:] = 0
        power = float(np.sum(moved * moved))
        scale = float(np.sum(moved * t)) / power if power > 0 else 0.0
        best = min(best, float(np.linalg.norm(scale * moved - t) / np.linalg.norm(t)))
    return best
