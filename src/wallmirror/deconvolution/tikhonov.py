"""Tikhonov regularisation: argmin_f |g - H f|^2 + alpha |f|^2 (eqs. 3.12, 3.13).

Three ways to the same estimate: a dense matrix (1-D signals), Fourier transforms (convolution, images) and LSMR (any
linear operator). alpha has the units of |H|^2: it damps components whose squared singular value lies below it.

References
----------
A. N. Tikhonov, "Solution of incorrectly formulated problems and the regularization method", Soviet Math. Dokl. 4,
1035-1038 (1963). D. C.-L. Fong, M. Saunders, "LSMR: an iterative algorithm for sparse least-squares problems", SIAM J.
Sci. Comput. 33, 2950-2971 (2011), doi:10.1137/10079687X.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.linalg import aslinearoperator, lsmr

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.checking import Array, count, in_unit, positive, real_samples, require_squares
from wallmirror.deconvolution.spectrum import convolution_spectrum, matrix_spectrum
from wallmirror.errors import InputError, UndeterminedError


def tikhonov_dense(matrix: ArrayLike, data: ArrayLike, alpha: float) -> Array:
    """Eq. 3.13 for a dense matrix, by its singular values.

    Parameters
    ----------
    matrix:
        H, shape (m, n), such as `toeplitz_matrix`.
    data:
        g, shape (m,).
    alpha:
        Weight of |f|^2, > 0, in units of |H|^2. `matrix_spectrum` gives estimates for many alphas at one price.

    Returns
    -------
    f, shape (n,).

    Examples
    --------
    >>> from wallmirror.deconvolution import toeplitz_matrix
    >>> blurred = [0.25, 0.75, 0.75, 0.25]
    >>> np.round(tikhonov_dense(toeplitz_matrix([0.25, 0.5, 0.25], 2), blurred, 1e-9), 6).tolist()
    [1.0, 1.0]
    """
    return matrix_spectrum(matrix, data).solve(alpha)


def tikhonov_fft(
    data: ArrayLike,
    kernel: ArrayLike,
    alpha: float,
    *,
    mode: Literal["full", "periodic"] = "full",
    origin: tuple[int, ...] | None = None,
) -> Array:
    """Eq. 3.13 for a convolution in any number of dimensions, by three Fourier transforms.

    Parameters
    ----------
    data:
        g; for "full" the whole, uncropped convolution, N + K - 1 samples along each axis.
    kernel:
        h, K samples along each axis.
    alpha:
        Weight of |f|^2, > 0, in units of h squared times samples squared (|H|^2).
    mode, origin:
        "full" or "periodic", as for `convolution_spectrum`, which gives estimates for many alphas at one price.

    Returns
    -------
    f, shape N along each axis ("full") or that of the data ("periodic").

    Notes
    -----
    In periodic mode this is the Wiener-Hunt filter of scikit-image, `wiener(image, psf, balance=alpha, reg=delta)`.

    Examples
    --------
    >>> np.round(tikhonov_fft([0.25, 0.75, 0.75, 0.25], [0.25, 0.5, 0.25], 1e-9), 6).tolist()
    [1.0, 1.0]
    """
    return convolution_spectrum(data, kernel, mode=mode, origin=origin).solve(alpha)


def tikhonov_lsmr(
    operator: Any, data: ArrayLike, alpha: float, *, tolerance: float = 1e-10, max_iterations: int | None = None
) -> Array:
    """Eq. 3.13 for any linear operator, by LSMR.

    Parameters
    ----------
    operator:
        H, shape (m, n): a `Convolution`, or what SciPy's `aslinearoperator` takes, with an adjoint.
    data:
        g, m samples of any shape.
    alpha:
        Weight of |f|^2, > 0, in units of |H|^2.
    tolerance:
        When to stop: the normal equations' residual, relative to their terms.
    max_iterations:
        At most so many; the larger dimension of H, and at least 1,000, when left out.

    Returns
    -------
    f, of the operator's `signal_shape` where it has one, otherwise shape (n,).

    Raises
    ------
    InputError
        Where data do not match the operator, or H^T g has a square that float64 cannot hold.
    UndeterminedError
        If that many iterations do not reach the tolerance.

    Examples
    --------
    >>> from wallmirror.deconvolution import Convolution
    >>> blur = Convolution([0.25, 0.5, 0.25], (2,))
    >>> np.round(tikhonov_lsmr(blur, [0.25, 0.75, 0.75, 0.25], 1e-9), 6).tolist()
    [1.0, 1.0]
    """
    linear = aslinearoperator(operator)
    g, unit = in_unit(real_samples(data, "data").ravel())
    positive(tolerance, "tolerance")
    if linear.shape[0] != g.size:
        raise InputError(f"has {g.size} samples where the operator gives {linear.shape[0]}", field="data")
    limit = max(1000, *linear.shape) if max_iterations is None else count(max_iterations, "max_iterations")
    require_squares(np.asarray(linear.rmatvec(g)), "operator")
    f, istop, iterations, *_ = lsmr(
        linear, g, damp=math.sqrt(positive(alpha, "alpha")), atol=tolerance, btol=tolerance, conlim=0, maxiter=limit
    )
    if istop == 7:
        raise UndeterminedError(
            f"LSMR has not converged in {iterations} iterations at alpha {alpha:g}; allow more, or a larger alpha or "
            "tolerance"
        )
    return rescaled(f, unit, field="data").reshape(getattr(operator, "signal_shape", (-1,)))
