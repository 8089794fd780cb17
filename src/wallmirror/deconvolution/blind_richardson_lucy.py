"""Blind deconvolution by Richardson-Lucy steps in turn on kernel and signal (Fish et al. 1995).

Both f and h are unknown in g = f * h. Each iteration takes some steps of eq. 3.14 for h with f held, then as many for f
with h held. Every step lowers the Poisson deviance, so the alternation always settles; on what is another matter: the
deviance has many minima, (g, delta) among them.

References
----------
D. A. Fish, A. M. Brinicombe, E. R. Pike, J. G. Walker, "Blind deconvolution by means of the Richardson-Lucy algorithm", J.
Opt. Soc. Am. A 12, 58-65 (1995), doi:10.1364/JOSAA.12.000058.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.blind import BlindEstimate
from wallmirror.deconvolution.checking import Array, count, in_unit, nonnegative_samples
from wallmirror.deconvolution.operators import Convolution, Mode
from wallmirror.deconvolution.richardson_lucy import RichardsonLucyStep
from wallmirror.errors import InputError, UndeterminedError


def blind_richardson_lucy(
    data: ArrayLike,
    *,
    signal_start: ArrayLike,
    kernel_start: ArrayLike,
    mode: Mode = "full",
    iterations: int = 100,
    inner: int = 1,
    background: float = 0.0,
) -> BlindEstimate:
    """Signal and kernel from their convolution, in any number of dimensions.

    Parameters
    ----------
    data:
        g >= 0; N + K - 1 samples along each axis ("full") or N.
    signal_start, kernel_start:
        f_0 >= 0 and h_0 >= 0; their shapes are the supports, and what starts at zero stays there. A delta is a fixed
        point and no start for h.
    mode:
        As for `Convolution`; with "same" and "periodic" the kernel's middle leaves the signal in place.
    iterations:
        Outer iterations.
    inner:
        Steps on each of the two in one iteration; Fish et al. take about 10, the thesis 1.
    background:
        b >= 0, known light in every datum that does not come from f.

    Returns
    -------
    BlindEstimate with h of unit sum.

    Raises
    ------
    InputError
        For negative values, shapes that do not fit, or a start that cannot explain the data.
    UndeterminedError
        For data that are zero everywhere.

    Examples
    --------
    >>> f, h = np.array([0, 1.0, 0, 0, 0.5, 0, 0, 0]), np.array([0.2, 0.6, 0.2])
    >>> found = blind_richardson_lucy(np.convolve(f, h), signal_start=np.ones(8), kernel_start=np.ones(3))
    >>> bool(found.residual[-1] < 0.05)
    True
    """
    g = nonnegative_samples(data, "data")
    f = nonnegative_samples(signal_start, "signal_start", ndim=g.ndim)
    h = nonnegative_samples(kernel_start, "kernel_start", ndim=g.ndim)
    count(iterations, "iterations")
    count(inner, "inner")
    if not np.any(g):
        raise UndeterminedError("the data are zero everywhere, which any signal with a kernel of zero explains")
    g, unit = in_unit(g)
    background = background / unit
    size = float(np.linalg.norm(g))
    h = _unit_sum(in_unit(h)[0], "kernel_start")
    f = in_unit(f)[0]
    f = f * (g.sum() / _unit_total(f, "signal_start"))
    blur = Convolution(h, f.shape, mode=mode)
    if blur.data_shape != g.shape:
        raise InputError(f"has shape {g.shape} where the starts give {blur.data_shape}", field="data")
    if np.count_nonzero(h) == 1 and h.size > 1:
        raise InputError(
            "has one sample above zero and zeros stay zero, so the kernel could not change; start with a constant",
            field="kernel_start",
        )
    residual = []
    for iteration in range(iterations):
        h = _steps(blur.exchanged(f), g, h, inner, background, check=iteration == 0)
        h = _unit_sum(h, "kernel_start")
        blur = Convolution(h, f.shape, mode=mode)
        f = _steps(blur, g, f, inner, background, check=False)
        residual.append(float(np.linalg.norm(g - blur.apply(f) - background)) / size)
    return BlindEstimate(
        signal=rescaled(f, unit, field="data"), kernel=h, iterations=iterations, residual=np.array(residual)
    )


def _steps(operator: Convolution, data: Array, start: Array, count: int, background: float, *, check: bool) -> Array:
    step = RichardsonLucyStep(operator, data, background=background)
    x = step.checked_start(start) if check else start.ravel()
    for _ in range(count):
        x = step.update(x, step.predict(x))
    return x.reshape(start.shape)


def _unit_sum(values: Array, field: str) -> Array:
    return values / _unit_total(values, field)


def _unit_total(values: Array, field: str) -> float:
    total = float(values.sum())
    if total <= 0:
        raise InputError("is zero everywhere, and zeros stay zero", field=field)
    return total
