"""Errors of a blind estimate: one global scale, a shift between signal and kernel, and which is which, no data can tell.

(c f shifted by d) * (h / c shifted by -d) = f * h = h * f.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.checking import Array, in_unit, real_samples
from wallmirror.errors import InputError


@dataclass(frozen=True)
class Aligned:
    """An estimate compared with the truth.

    Parameters
    ----------
    error:
        min over scale c and shift d of |truth - c shifted estimate| / |truth|, in [0, 1].
    shift:
        d, by how many samples along each axis the estimate has to be moved onto the truth.
    scale:
        c.
    """

    error: float
    shift: tuple[int, ...]
    scale: float


def align(estimate: ArrayLike, truth: ArrayLike) -> Aligned:
    """Error that is left after the best scale and the best shift by whole samples; outside their arrays both are zero.

    Raises
    ------
    InputError
        For a truth that is zero everywhere, arrays of different numbers of axes, or a scale outside the range of float64.

    Examples
    --------
    >>> aligned = align([0.0, 0.0, 2.0, 4.0], [1.0, 2.0, 0.0])
    >>> round(aligned.error, 6), aligned.shift, round(aligned.scale, 6)
    (0.0, (-2,), 0.5)
    """
    t = real_samples(truth, "truth")
    e = real_samples(estimate, "estimate", ndim=t.ndim)
    (t, true_unit), (e, unit) = in_unit(t), in_unit(e)
    size, energy = float(np.sum(t * t)), float(np.sum(e * e))
    if size == 0:
        raise InputError("is zero everywhere, so there is nothing to compare with", field="truth")
    if energy == 0:
        return Aligned(1.0, (0,) * t.ndim, 0.0)
    grid = tuple(n + m - 1 for n, m in zip(t.shape, e.shape, strict=True))
    correlation: Array = scipy.fft.irfftn(scipy.fft.rfftn(t, s=grid) * scipy.fft.rfftn(e, s=grid).conj(), s=grid)
    best = np.unravel_index(int(np.argmax(correlation)), grid)
    shift = tuple(int(b) if b < n else int(b) - p for b, n, p in zip(best, t.shape, grid, strict=True))
    # The residual itself: 1 - correlation^2 / (size energy) would lose half of the digits.
    scale = max(float(correlation[best]), 0.0) / energy
    moved = np.zeros(t.shape)
    into = tuple(slice(max(d, 0), max(min(n, m + d), 0)) for d, n, m in zip(shift, t.shape, e.shape, strict=True))
    taken = tuple(slice(i.start - d, i.stop - d) for i, d in zip(into, shift, strict=True))
    moved[into] = e[taken]
    beyond = e.copy()
    beyond[taken] = 0.0
    error = math.sqrt((float(np.sum((t - scale * moved) ** 2)) + scale**2 * float(np.sum(beyond**2))) / size)
    return Aligned(error, shift, float(rescaled(scale, true_unit, 1 / unit, field="estimate")))
