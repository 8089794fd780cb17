"""Iterative blind deconvolution: inverse filters in turn, with non-negativity and supports in between (eqs. 3.15, 3.16).

Each iteration goes from F, the transform of the signal's estimate, to the kernel and back,

    H~ = G F* / (|F|^2 + alpha / |H|^2),    h = |h~| on its support, 0 elsewhere                          (3.15)
    F~ = G H* / (|H|^2 + alpha / |F~|^2),   f = |f~| on its support, 0 elsewhere                          (3.16)

with |F~| on the right that of the iteration before. No objective falls along the way and nothing is known about
convergence: look at the residual, and do not trust it alone.

References
----------
G. R. Ayers, J. C. Dainty, "Iterative blind deconvolution method and its applications", Opt. Lett. 13, 547-549 (1988),
doi:10.1364/OL.13.000547. B. L. K. Davey, R. G. Lane, R. H. T. Bates, "Blind deconvolution of noisy complex-valued image",
Opt. Commun. 69, 353-356 (1989), doi:10.1016/0030-4018(89)90018-7 (the Wiener filters with alpha).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.blind import BlindEstimate
from wallmirror.deconvolution.checking import Array, count, in_unit, one_of, positive, real_samples, require_squares
from wallmirror.deconvolution.operators import inverse, transform
from wallmirror.errors import InputError, UndeterminedError

#: What becomes of negative values: their absolute value (the thesis), or zero (Ayers and Dainty, less their
#: redistribution of energy).
Nonnegativity = Literal["absolute", "zero"]


def iterative_blind(
    data: ArrayLike,
    *,
    signal_support: ArrayLike,
    kernel_support: ArrayLike,
    alpha: float,
    iterations: int = 100,
    signal_start: ArrayLike | None = None,
    kernel_start: ArrayLike | None = None,
    nonnegativity: Nonnegativity = "absolute",
) -> BlindEstimate:
    """Signal and kernel from their convolution by alternating Wiener filters, in any number of dimensions.

    Parameters
    ----------
    data:
        g, any shape; the convolution is periodic in it, so give uncropped data (N + K - 1 samples).
    signal_support, kernel_support:
        Where f and h may differ from zero: boolean, shape of the data, corner-based (`corner_support` makes them).
    alpha:
        Weight of the noise, > 0, in units of |F|^2 |H|^2.
    iterations:
        How many.
    signal_start, kernel_start:
        Shape of the data; the data themselves and a delta in the middle of its support when left out, as in the thesis.
    nonnegativity:
        "absolute" (the thesis) or "zero".

    Returns
    -------
    BlindEstimate with f and h on the grid of the data; neither is rescaled.

    Raises
    ------
    UndeterminedError
        For data that are zero everywhere, or an estimate that vanished.

    Examples
    --------
    >>> f, h = np.array([0, 1.0, 0, 0, 0.5, 0, 0, 0]), np.array([1.0, 0.6, 0.2])
    >>> signal, kernel = corner_support((10,), (8,)), corner_support((10,), (3,))
    >>> found = iterative_blind(np.convolve(f, h), signal_support=signal, kernel_support=kernel, alpha=1e-3)
    >>> bool(found.residual[-1] < 0.1)
    True
    """
    g = real_samples(data, "data")
    where_f = _support(signal_support, g.shape, "signal_support")
    where_h = _support(kernel_support, g.shape, "kernel_support")
    positive(alpha, "alpha")
    count(iterations, "iterations")
    one_of(nonnegativity, get_args(Nonnegativity), "nonnegativity")
    if not np.any(g):
        raise UndeterminedError("the data are zero everywhere, which any signal with a kernel of zero explains")
    g, unit = in_unit(g)
    size = float(np.linalg.norm(g))
    f = g if signal_start is None else _start(signal_start, g.shape, "signal_start", unit)
    h = _middle(where_h) if kernel_start is None else _start(kernel_start, g.shape, "kernel_start")
    alpha = alpha / unit / unit  # in these units: as good as nothing for bright data, and infinite for dark ones

    def constrained(spectrum: NDArray[np.complex128], where: NDArray[np.bool_]) -> Array:
        values = inverse(spectrum, g.shape)
        return np.where(where, np.abs(values) if nonnegativity == "absolute" else np.maximum(values, 0.0), 0.0)

    data_spectrum = transform(g, g.shape)
    signal_spectrum, kernel_spectrum = transform(f, g.shape), transform(h, g.shape)
    filtered = signal_spectrum  # F~ of the iteration before
    residual = []
    for _ in range(iterations):
        h = constrained(_wiener(data_spectrum, signal_spectrum, kernel_spectrum, alpha), where_h)
        kernel_spectrum = transform(h, g.shape)
        filtered = _wiener(data_spectrum, kernel_spectrum, filtered, alpha)
        f = constrained(filtered.copy(), where_f)
        signal_spectrum = transform(f, g.shape)
        residual.append(float(np.linalg.norm(g - inverse(signal_spectrum * kernel_spectrum, g.shape))) / size)
        if not (np.any(f) and np.any(h)):
            raise UndeterminedError(
                f"the estimate vanished after {len(residual)} iterations; lower alpha or widen the supports"
            )
    return BlindEstimate(
        signal=rescaled(f, unit, field="data"), kernel=h, iterations=iterations, residual=np.array(residual)
    )


def corner_support(shape: tuple[int, ...], extent: tuple[int, ...]) -> NDArray[np.bool_]:
    """True in the first `extent` samples along each axis of an array of that shape: the support in uncropped data.

    Examples
    --------
    >>> corner_support((4,), (2,)).tolist()
    [True, True, False, False]
    """
    if len(shape) != len(extent) or any(
        not (isinstance(k, (int, np.integer)) and 1 <= k <= n) for n, k in zip(shape, extent, strict=False)
    ):
        raise InputError(f"is {extent}; give 1 to as many samples as the data {shape} along each axis", field="extent")
    support = np.zeros(shape, dtype=np.bool_)
    support[tuple(slice(0, k) for k in extent)] = True
    return support


def _wiener(
    data: NDArray[np.complex128], known: NDArray[np.complex128], sought: NDArray[np.complex128], alpha: float
) -> NDArray[np.complex128]:
    """G K* / (|K|^2 + alpha / |S|^2), without a division by |S| = 0 or by nothing, where it is zero."""
    power = np.abs(sought) ** 2
    weight = np.abs(known) ** 2 * power + alpha
    return np.asarray(data * known.conj() * np.divide(power, weight, out=np.zeros_like(power), where=weight > 0))


def _middle(support: NDArray[np.bool_]) -> Array:
    """A delta in the middle of a support's bounding box."""
    places = np.argwhere(support)
    delta = np.zeros(support.shape)
    delta[tuple((places.min(axis=0) + places.max(axis=0) + 1) // 2)] = 1.0
    return delta


def _support(values: ArrayLike, shape: tuple[int, ...], field: str) -> NDArray[np.bool_]:
    support = np.asarray(values)
    if support.dtype != np.bool_ or support.shape != shape or not support.any():
        raise InputError(f"needs booleans in the shape of the data {shape}, some of them true", field=field)
    return support


def _start(values: ArrayLike, shape: tuple[int, ...], field: str, unit: float = 1.0) -> Array:
    start = real_samples(values, field) / unit
    require_squares(start, field)
    if start.shape != shape or not start.any():
        raise InputError(f"needs the shape of the data {shape} and some value other than zero", field=field)
    return start
