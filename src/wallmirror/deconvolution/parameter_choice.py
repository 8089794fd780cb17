"""Choosing Tikhonov's alpha from the data instead of by trial.

- discrepancy principle (Morozov 1966): the residual is as large as the noise, which must be known;
- generalised cross-validation (Golub, Heath, Wahba 1979): predicts each datum from the others; white noise of unknown
  level;
- L-curve (Hansen 1992): the corner of log |f_alpha| against log |g - H f_alpha|; noise unknown.

References
----------
V. A. Morozov, "On the solution of functional equations by the method of regularization", Soviet Math. Dokl. 7, 414-417
(1966). G. H. Golub, M. Heath, G. Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
Technometrics 21, 215-223 (1979), doi:10.1080/00401706.1979.10489751. P. C. Hansen, "Analysis of discrete ill-posed
problems by means of the L-curve", SIAM Review 34, 561-580 (1992), doi:10.1137/1034115.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from wallmirror.deconvolution.checking import positive
from wallmirror.deconvolution.spectrum import Spectrum
from wallmirror.errors import InputError, UndeterminedError

# alpha is looked for from the smallest squared singular value, or what rounding leaves of it, below which it changes
# nothing, up to this multiple of the largest, above which the estimate is zero but for a factor.
_ROUNDING = 16 * float(np.finfo(np.float64).eps)
_HIGHEST = 1e6
_PER_DECADE = 8


def discrepancy_alpha(
    residual_norm: Spectrum | Callable[[float], float],
    noise_norm: float,
    *,
    low: float | None = None,
    high: float | None = None,
    factor: float = 1.0,
) -> float:
    """The alpha at which |g - H f_alpha| = factor noise_norm (Morozov's discrepancy principle).

    Parameters
    ----------
    residual_norm:
        A `Spectrum`; or, for any operator, the function from alpha to |g - H f_alpha|, with `low` and `high`.
    noise_norm:
        Expected |noise| = sigma sqrt(samples), > 0, in the units of the data.
    low, high:
        Between which alpha is looked for.
    factor:
        Safety factor; a little above 1 where the noise is not known well.

    Raises
    ------
    UndeterminedError
        If no alpha in the range leaves that residual, with the residuals at its ends.

    Examples
    --------
    >>> from wallmirror.deconvolution import matrix_spectrum
    >>> spectrum = matrix_spectrum([[1.0]], [1.0])  # the residual is alpha / (1 + alpha)
    >>> round(discrepancy_alpha(spectrum, 0.5), 9)
    1.0
    """
    target = positive(factor, "factor") * positive(noise_norm, "noise_norm")
    residual: Callable[[float], float]
    unit = 1.0
    if isinstance(residual_norm, Spectrum):
        lowest, highest = _range(residual_norm)
        low = lowest * _ROUNDING**2 if low is None else low
        high = highest if high is None else high
        # In the spectrum's own unit, where the residual at the lowest alpha is no zero.
        residual, unit = replace(residual_norm, unit=1.0).residual_norm, residual_norm.unit
        target /= unit
    elif low is None or high is None:
        raise InputError("a function of alpha needs `low` and `high`", field="residual_norm")
    else:
        residual = residual_norm
    at_low, at_high = residual(positive(low, "low")), residual(positive(high, "high"))
    if not at_low < target < at_high:
        raise UndeterminedError(
            f"no alpha from {low:.2g} to {high:.2g} leaves a residual of {target * unit:.4g}: it runs from "
            f"{at_low * unit:.4g} to {at_high * unit:.4g}; check the noise's size"
        )
    root = brentq(lambda t: math.log(residual(math.exp(t)) / target), math.log(low), math.log(high), xtol=1e-12)
    return math.exp(root)


def gcv(spectrum: Spectrum, alpha: float) -> float:
    """m |g - H f_alpha|^2 / trace(I - H (H^T H + alpha I)^-1 H^T)^2, the expected squared error of prediction."""
    freedom = spectrum.freedom(alpha)
    # No freedom is left where the estimate fits every datum: no prediction, so nothing to prefer.
    if freedom <= spectrum.samples * np.finfo(np.float64).eps:
        return math.inf
    root = spectrum.residual_norm(alpha) / freedom
    return spectrum.samples * root * root


def gcv_alpha(spectrum: Spectrum) -> float:
    """The alpha that minimises generalised cross-validation.

    Raises
    ------
    UndeterminedError
        If there is no minimum inside the range: nothing in the data then tells noise from signal.

    Examples
    --------
    >>> from wallmirror.deconvolution import toeplitz_matrix, matrix_spectrum
    >>> H = toeplitz_matrix([1.0, 2.0, 1.0], 40)
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal(42)
    >>> spectrum = matrix_spectrum(H, H @ np.sin(np.arange(40) / 5) + noise)
    >>> 1e-6 < gcv_alpha(spectrum) < 1.0
    True
    """
    scaled = replace(spectrum, unit=1.0)  # its square may leave the range of float64
    return _minimum(spectrum, lambda alpha: gcv(scaled, alpha), "generalised cross-validation has no minimum")


def l_curve_curvature(spectrum: Spectrum, alpha: float) -> float:
    """Curvature of (log |g - H f_alpha|, log |f_alpha|) along log alpha; positive at a corner (Hansen 1992)."""
    # With w = alpha / (s^2 + alpha) and R = |g - H f|^2, E = |f|^2, alpha E and the derivatives of R and alpha E in t = log
    # alpha are sums of |u_i^* g|^2 (1 - w) w^n, which know no scale.
    w = positive(alpha, "alpha") / (spectrum.power + alpha)
    share = spectrum.multiplicity * spectrum.energy * (spectrum.power / (spectrum.power + alpha))
    first, second, third = (float(np.sum(share * w**n)) for n in (1, 2, 3))
    residual = spectrum.outside + float(np.sum(spectrum.multiplicity * spectrum.energy * w * w))
    if residual == 0 or first == 0:
        return 0.0
    r_t, e_t = 2 * second, -2 * second
    r_tt, e_tt = 4 * second - 6 * third, -2 * second + 6 * third
    # Derivatives of u = log sqrt R and v = log sqrt E.
    u_t, v_t = 0.5 * r_t / residual, 0.5 * e_t / first
    u_tt = 0.5 * (r_tt / residual - (r_t / residual) ** 2)
    v_tt = 0.5 * (e_tt / first - (e_t / first) ** 2)
    speed = u_t**2 + v_t**2
    return (u_t * v_tt - v_t * u_tt) / speed**1.5 if speed > 0 else 0.0


def l_curve_alpha(spectrum: Spectrum) -> float:
    """The alpha at the L-curve's corner, where its curvature is largest.

    Raises
    ------
    UndeterminedError
        If the curve has no corner inside the range.

    Examples
    --------
    >>> from wallmirror.deconvolution import toeplitz_matrix, matrix_spectrum
    >>> H = toeplitz_matrix(np.exp(-0.5 * (np.arange(-12, 13) / 3) ** 2), 40)
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal(64)
    >>> spectrum = matrix_spectrum(H, H @ np.sin(np.arange(40) / 5) + noise)
    >>> 1e-4 < l_curve_alpha(spectrum) < 1e-3
    True
    """
    return _minimum(spectrum, lambda alpha: -l_curve_curvature(spectrum, alpha), "the L-curve has no corner")


def _minimum(spectrum: Spectrum, function: Callable[[float], float], lacking: str) -> float:
    """The least value on a grid of log alpha, refined; the ends of the grid are no answer."""
    low, high = _range(spectrum)
    grid = np.linspace(math.log(low), math.log(high), 2 + math.ceil(_PER_DECADE * math.log10(high / low)))
    values = np.array([function(math.exp(t)) for t in grid])
    best = int(np.argmin(values))
    flat = float(np.ptp(values[np.isfinite(values)])) <= 1e-12 * abs(float(values[best]))
    if flat or best in (0, grid.size - 1) or not np.isfinite(values[best]):
        raise UndeterminedError(
            f"{lacking} for alpha from {math.exp(grid[0]):.2g} to {math.exp(grid[-1]):.2g}: the data do not "
            "tell noise from signal; choose alpha by the discrepancy principle or by trial"
        )
    found = minimize_scalar(
        lambda t: function(math.exp(t)),
        bounds=(grid[best - 1], grid[best + 1]),
        method="bounded",
        options={"xatol": 1e-8},
    )
    return math.exp(float(found.x))


def _range(spectrum: Spectrum) -> tuple[float, float]:
    largest = spectrum.largest
    return max(float(np.min(spectrum.power)), (_ROUNDING * largest) ** 2), _HIGHEST * largest**2
