"""Blind identification of several channels in closed form: the cross-relation and the subspace method.

Two channels that one source feeds obey g_b * h_c = g_c * h_b, whatever the source: linear equations in the channels,
which determine them up to one scale if the number of taps is known, the channels have no zero in common, and the source is
rich enough (Xu, Liu, Tong, Kailath, "A least-squares approach to blind channel identification", IEEE Trans. Signal Processing
43(12), 1995). The subspace method asks that the channels be orthogonal to the noise space of windows of the outputs
(Moulines, Duhamel, Cardoso, Mayrargue, ibid. 43(2), 1995).

Only samples are used in which all taps lie within the record, so that records may be windows of longer ones; several
records of the same channels with different sources add their equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.linalg as sl
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.channels import checked_outputs
from wallmirror.deconvolution.checking import real_samples
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.threads import one_blas_thread

Array = NDArray[np.float64]

ChannelMethod = Literal["cross_relation", "subspace"]

# An eigenvalue below this share of the largest is zero: rounding of the Gram matrix reaches 1e-15 or so.
_ZERO = 1e-13
# The smallest eigenvalue must lie this far below the next, so that the channels turn by a fifth at most (Davis, Kahan 1970);
# one tap too few leaves them closer together.
_SEPARATED = 0.04
_REFINEMENTS = 3


@dataclass(frozen=True)
class IdentifiedChannels:
    """Result of `identify_channels`.

    Parameters
    ----------
    channels:
        h (K, n), |h| = 1, with positive sum.
    sources:
        The source within each record, (R, L + n - 1): least squares, weakly known at the ends; in the outputs' units.
    misfit:
        Root of the smallest eigenvalue over that of the largest: how far the equations are from having a solution.
    gap:
        The same of the second smallest: 0 where a family of channels fits.
    predicted_error:
        Relative error of the channels that the misfit would make if it were noise, to first order.
    """

    channels: Array
    sources: Array
    misfit: float
    gap: float
    predicted_error: float

    @property
    def error_bound(self) -> float:
        """Relative error that such a misfit could make at worst, as a fault common to all outputs does (Davis-Kahan)."""
        return self.misfit / max(self.gap, 1e-300)


def identify_channels(
    outputs: ArrayLike, taps: int, *, method: ChannelMethod = "cross_relation", window: int | None = None
) -> IdentifiedChannels:
    """Channels and sources from the outputs alone, without iteration.

    Parameters
    ----------
    outputs:
        g, shape (K, L), or (R, K, L) for R records of the same K >= 2 channels.
    taps:
        n, the exact number of taps.
    method:
        "cross_relation" or "subspace".
    window:
        Of the subspace method, in samples; n when left out, more where K = 2 asks for it.

    Raises
    ------
    InputError
        For arrays that are not finite, channels longer than the record, or an unknown method.
    UndeterminedError
        For one channel, outputs that are multiples of one, too few samples, channels that share a zero or are shorter than
        `taps`, and outputs that no source of that length explains.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import aligned_error, convolve_channels
    >>> rng = np.random.default_rng(0)
    >>> f, h = rng.standard_normal(60), rng.standard_normal((3, 5))
    >>> aligned_error(identify_channels(convolve_channels(f, h), 5).channels, h) < 1e-12
    True
    """
    if method not in get_args(ChannelMethod):
        raise InputError(f'is "{method}"; choose one of {", ".join(get_args(ChannelMethod))}', field="method")
    if method == "cross_relation" and window is not None:
        raise InputError("has a meaning for the subspace method alone; leave it out", field="window")
    g, scale = _records(outputs, taps)
    records, channels, length = g.shape
    rows = records * (length - taps + 1) * channels * (channels - 1) // 2
    unknowns = channels * taps
    if rows < unknowns:
        raise UndeterminedError(
            f"{rows} equations cannot determine {channels} channels of {taps} taps; give longer records or fewer taps"
        )
    with one_blas_thread():
        if method == "cross_relation":
            matrix = _cross_relation_gram(g, taps)
        else:
            matrix, rows = _subspace_gram(g, taps, window)
        values, vectors = np.linalg.eigh(matrix)
        _require_one_answer(values, taps)
        h = vectors[:, 0].reshape(channels, taps)
        smallest = max(float(values[0]), 0.0)
        if method == "cross_relation":
            h, smallest = _refined(g, h, values, vectors)
    h = h if h.sum() >= 0 else -h
    # K (K - 1) / 2 equations a sample share the noise of K outputs, so that only K - 1 of them count.
    noise = smallest / max(1.0, rows * 2 / channels - unknowns)
    return IdentifiedChannels(
        channels=h,
        sources=rescaled(np.array([windowed_source(record, h) for record in g]), scale, field="outputs"),
        misfit=float(np.sqrt(smallest / values[-1])),
        gap=float(np.sqrt(values[1] / values[-1])),
        predicted_error=float(np.sqrt(noise * np.sum(1 / values[1:]))),
    )


def rival_channels(outputs: ArrayLike, taps: int) -> int:
    """Dimension of the family of channels that fit the outputs as well as the best do; 1 where they are determined.

    Channels with d taps fewer than `taps` leave d + 1: any factor of d + 1 taps could be theirs or the source's.

    Examples
    --------
    >>> from wallmirror.deconvolution.channels import convolve_channels
    >>> rng = np.random.default_rng(0)
    >>> g = convolve_channels(rng.standard_normal(60), rng.standard_normal((3, 5)))
    >>> rival_channels(g, 5), rival_channels(g, 7)
    (1, 3)
    """
    with one_blas_thread():
        values = np.linalg.eigvalsh(_cross_relation_gram(_records(outputs, taps)[0], taps))
    best = max(float(values[0]), _ZERO * float(values[-1]))
    return max(1, int(np.count_nonzero(values <= best / _SEPARATED)))


def windowed_source(outputs: Array, channels: Array) -> Array:
    """Source (L + n - 1,) within a window of outputs (K, L) for known channels (K, n), of least squares."""
    taps, length = channels.shape[1], outputs.shape[1]
    samples = length + taps - 1
    # g_k[l] = sum_t h_k[t] f[l + n - 1 - t]: column l + n - 1 - t of row l.
    band, right = np.zeros((taps, samples)), np.zeros(samples)
    for s in range(taps):
        right[s : s + length] += channels[:, taps - 1 - s] @ outputs
        for t in range(s + 1):
            band[s - t, t : t + length] += float(channels[:, taps - 1 - s] @ channels[:, taps - 1 - t])
    band[0] += 1e-14 * band[0].max()
    return np.asarray(sl.solveh_banded(band, right, lower=True), dtype=np.float64)


def _records(outputs: ArrayLike, taps: int) -> tuple[Array, float]:
    """Outputs (R, K, L) divided by a power of two near their largest magnitude, and that power."""
    try:
        records_given = np.ndim(outputs) == 3
    except ValueError:  # rows of unequal lengths, refused below
        records_given = False
    if not records_given:
        one, scale = checked_outputs(outputs, taps)
        return one[None], scale
    g = real_samples(outputs, "outputs", ndim=3)
    # All records laid end to end stand or fall together.
    joined = np.moveaxis(g, 1, 0).reshape(g.shape[1], -1)
    scale = checked_outputs(joined, taps)[1]
    if taps > g.shape[2]:
        raise InputError(f"is {taps}, longer than the record of {g.shape[2]} samples; give fewer taps", field="taps")
    return g / scale, scale


def _windows(g: Array, width: int) -> Array:
    """Y with Y[r, k, l, t] = g[r, k, l + width - 1 - t], so that Y h = g * h where all taps lie within the record."""
    return np.lib.stride_tricks.sliding_window_view(g, width, axis=2)[..., ::-1]


def _cross_relation_gram(g: Array, taps: int) -> Array:
    """A^T A of all equations Y_b h_c - Y_c h_b = 0, b < c, shape (K n, K n)."""
    channels = g.shape[1]
    y = np.moveaxis(_windows(g, taps), 1, 2).reshape(-1, channels * taps)
    products = (y.T @ y).reshape(channels, taps, channels, taps)
    own = np.einsum("btbs->ts", products)
    # Block (b, c) of the mixed terms is -Y_c^T Y_b.
    gram = -np.transpose(products, (2, 1, 0, 3)).copy()
    for c in range(channels):
        gram[c, :, c, :] += own
    return np.asarray(gram.reshape(channels * taps, channels * taps), dtype=np.float64)


def _refined(g: Array, h: Array, values: Array, vectors: Array) -> tuple[Array, float]:
    """The null vector to the accuracy of the equations themselves: the Gram matrix squares their condition.

    Each step subtracts (A^T A)^+ A^T (A h) with A h computed from the outputs (corrected seminormal equations).
    """
    y = _windows(g, h.shape[1])
    smallest = 0.0
    for _ in range(_REFINEMENTS):
        filtered = np.einsum("rblt,ct->rbcl", y, h, optimize=True)
        missed = filtered - np.swapaxes(filtered, 1, 2)
        smallest = 0.5 * float(np.sum(missed**2))
        pulled = np.einsum("rblt,rbcl->ct", y, missed, optimize=True).ravel()
        along = vectors[:, 1:].T @ pulled
        h = h - (vectors[:, 1:] @ (along / values[1:])).reshape(h.shape)
        h = h / np.linalg.norm(h)
        if smallest > _ZERO * values[-1]:
            break  # noise: the eigenvector stands already
    return h, smallest


def _subspace_gram(g: Array, taps: int, window: int | None) -> tuple[Array, int]:
    """Q of the form h^T Q h that all noise vectors of the outputs' windows make, and how many equations it sums."""
    _, channels, length = g.shape
    width = window if window is not None else max(taps, -(-taps // (channels - 1)) + 1)
    signal = width + taps - 1
    if not isinstance(width, int) or not channels * width > signal or width > length:
        raise InputError(
            f"is {width}; give from {taps // (channels - 1) + 1} samples to the record's {length}", field="window"
        )
    columns = np.moveaxis(_windows(g, width), 1, 2).reshape(-1, channels * width)
    if columns.shape[0] < signal:
        raise UndeterminedError(
            f"{columns.shape[0]} windows cannot span the {signal} dimensions of the signal; give longer records"
        )
    values, vectors = np.linalg.eigh(columns.T @ columns)
    noise_values = values[: channels * width - signal]
    if values[-signal] <= _ZERO * values[-1]:
        raise UndeterminedError(_no_single_answer(taps))
    if values[-signal] < noise_values[-1] / _SEPARATED:
        raise UndeterminedError(_no_source(taps))
    noise = vectors[:, : channels * width - signal].reshape(channels, width, -1)
    # Each noise vector e (K, W) asks sum_k (e_k * h_k)[m] = 0 for every sample m of the source in the window.
    equations = np.zeros((noise.shape[2], signal, channels, taps))
    for t in range(taps):
        equations[:, t : t + width, :, t] = np.transpose(noise, (2, 1, 0))
    stacked = equations.reshape(-1, channels * taps)
    return stacked.T @ stacked, stacked.shape[0]


def _require_one_answer(values: Array, taps: int) -> None:
    if values.size < 2 or values[1] <= _ZERO * values[-1]:
        raise UndeterminedError(_no_single_answer(taps))
    if values[0] > _SEPARATED * values[1]:
        raise UndeterminedError(_no_source(taps))


def _no_source(taps: int) -> str:
    return (
        f"no source explains the outputs through channels of {taps} taps better than others would: the channels are "
        "longer, there is too much noise, or the outputs are no convolutions; give more taps or better records"
    )


def _no_single_answer(taps: int) -> str:
    return (
        f"a whole family of channels of {taps} taps fits the outputs: the channels share a zero or have fewer taps, or the "
        "source is too poor; give the true number of taps, channels that differ more, or a richer source"
    )
