"""Tikhonov regularisation where the operator is diagonal: every alpha at the price of one decomposition.

With H = U S V^*, eqs. 3.12 and 3.13 become filtering: component i of the estimate is

    v_i^* f_alpha = s_i / (s_i^2 + alpha)  u_i^* g.

U and V are the singular vectors of a dense matrix, or complex exponentials where convolution is periodic. The norms
that choose a parameter (residual, estimate, trace of the influence matrix) are sums over i.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from wallmirror.arithmetic import rescaled
from wallmirror.deconvolution.checking import Array, in_unit, positive, real_samples, require_squares
from wallmirror.deconvolution.operators import inverse, kernel_origin, transform
from wallmirror.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Spectrum:
    """Data g in the basis in which H is diagonal; from `matrix_spectrum` or `convolution_spectrum`.

    Parameters
    ----------
    power:
        |s_i|^2, any shape.
    coefficients:
        conj(s_i) u_i^* g, same shape; complex for a convolution.
    projections:
        u_i^* g / sqrt(projection_power), same shape.
    projection_power:
        What |projections|^2 has to be multiplied by; with `outside` the products then sum to |g|^2.
    multiplicity:
        How many components each entry stands for (2 for a pair of conjugate frequencies), broadcastable.
    outside:
        Squared norm of what no f reaches, |g - U U^* g|^2.
    unit:
        Power of two in units of which `coefficients`, `projections` and the root of `outside` are held, so that data of any
        size can be squared.
    samples:
        Number of samples of g.
    synthesis:
        From components of f to f itself.
    """

    power: Array = field(repr=False)
    coefficients: NDArray[np.complex128] | Array = field(repr=False)
    projections: NDArray[np.complex128] | Array = field(repr=False)
    projection_power: float
    multiplicity: Array = field(repr=False)
    outside: float
    samples: int
    synthesis: Callable[[NDArray[np.complex128] | Array], Array] = field(repr=False)
    unit: float = 1.0

    def solve(self, alpha: float) -> Array:
        """The estimate f_alpha of eq. 3.13."""
        return rescaled(
            self.synthesis(self.coefficients / (self.power + positive(alpha, "alpha"))), self.unit, field="data"
        )

    def residual_norm(self, alpha: float) -> float:
        """|g - H f_alpha|; grows with alpha."""
        inside = self._norm(positive(alpha, "alpha") / (self.power + alpha) * self._magnitudes)
        return math.hypot(math.sqrt(self.outside), inside) * self.unit

    def signal_norm(self, alpha: float) -> float:
        """|f_alpha|, of the whole estimate before any cropping; falls with alpha."""
        return self._norm(self.singular_values / (self.power + positive(alpha, "alpha")) * self._magnitudes) * self.unit

    def freedom(self, alpha: float) -> float:
        """Trace of I - H (H^T H + alpha I)^-1 H^T: how many of the data the estimate leaves free."""
        return self.samples - self._sum(self.power / (self.power + positive(alpha, "alpha")))

    @cached_property
    def energy(self) -> Array:
        """|u_i^* g|^2 in units of `unit` squared, shape of `power`."""
        return self.projection_power * _squared(self.projections)

    @cached_property
    def _magnitudes(self) -> Array:
        """|u_i^* g| in units of `unit`."""
        return np.sqrt(self.energy)

    @property
    def singular_values(self) -> Array:
        """|s_i|, shape of `power`."""
        return np.sqrt(self.power)

    @property
    def largest(self) -> float:
        """The largest singular value; InputError where all are zero."""
        value = math.sqrt(float(np.max(self.power)))
        if value == 0:
            raise InputError("is zero everywhere, so the data say nothing about the signal", field="kernel")
        return value

    def _sum(self, terms: Array) -> float:
        return float(np.sum(self.multiplicity * terms))

    def _norm(self, terms: Array) -> float:
        """Root of the sum of squares, which need not lie in float64's range themselves."""
        scaled, unit = in_unit(terms)
        return unit * math.sqrt(self._sum(scaled * scaled))


def matrix_spectrum(matrix: ArrayLike, data: ArrayLike) -> Spectrum:
    """Singular value decomposition of a dense H, shape (m, n), with data g, shape (m,).

    Examples
    --------
    >>> spectrum = matrix_spectrum([[2.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [4.0, 1.0, 0.5])
    >>> np.round(spectrum.solve(1.0), 3).tolist()
    [1.6, 0.5]
    """
    h = real_samples(matrix, "matrix", ndim=2)
    g = real_samples(data, "data", ndim=1)
    if h.shape[0] != g.size:
        raise InputError(f"has {g.size} samples where the matrix has {h.shape[0]} rows", field="data")
    require_squares(h, "matrix")
    g, unit = in_unit(g)
    u, s, vh = scipy.linalg.svd(h, full_matrices=False)
    inside = u.T @ g
    missed = g - u @ inside if h.shape[0] > s.size else np.zeros(1)
    return Spectrum(
        power=s**2,
        coefficients=s * inside,
        projections=inside,
        projection_power=1.0,
        multiplicity=np.ones(1),
        outside=float(missed @ missed),
        samples=g.size,
        synthesis=lambda components: np.asarray(vh.T @ components, dtype=np.float64),
        unit=unit,
    )


def convolution_spectrum(
    data: ArrayLike,
    kernel: ArrayLike,
    *,
    mode: Literal["full", "periodic"] = "full",
    origin: tuple[int, ...] | None = None,
) -> Spectrum:
    """Fourier transforms of data and kernel, in any number of dimensions.

    Parameters
    ----------
    data:
        g; for "full" the whole, uncropped convolution, shape N + K - 1 along each axis.
    kernel:
        h, shape K along each axis.
    mode:
        "periodic": data and signal repeat. "full": the signal is looked for on all N + K - 1 samples, where the
        convolution is periodic without wrapping round, and its first N are returned. What the estimate holds beyond
        them is cut off; `tikhonov_lsmr` keeps it at zero from the start.
    origin:
        For "periodic", as for `Convolution`.

    Raises
    ------
    InputError
        For values that are not real and finite, a kernel beyond 1e-120 to 1e120, whose square is no float64, or one with
        more samples than the data.
    """
    g = real_samples(data, "data")
    h = real_samples(kernel, "kernel", ndim=g.ndim)
    require_squares(h, "kernel")
    g, unit = in_unit(g)
    start = kernel_origin(h.shape, mode, origin)
    if mode not in ("full", "periodic"):
        raise InputError(f'is "{mode}"; choose "full" or "periodic", or use `tikhonov_lsmr`', field="mode")
    if any(k > n for n, k in zip(g.shape, h.shape, strict=True)):
        raise InputError(
            f"has shape {h.shape}, longer than the data {g.shape}: an uncropped convolution is never shorter than its "
            "kernel; use `tikhonov_lsmr` for cropped data",
            field="kernel",
        )
    if mode == "periodic":
        h = np.roll(
            np.pad(h, [(0, n - k) for n, k in zip(g.shape, h.shape, strict=True)]),
            [-o for o in start],
            tuple(range(h.ndim)),
        )
        kept = tuple(slice(None) for _ in g.shape)
    else:
        kept = tuple(slice(0, n - k + 1) for n, k in zip(g.shape, h.shape, strict=True))
    transfer, spectrum = transform(h, g.shape), transform(g, g.shape)
    power = _squared(transfer)
    coefficients = np.conjugate(transfer, out=transfer)
    coefficients *= spectrum
    # The last axis holds half of the frequencies: all but the first, and the last of an even length, come in pairs.
    pairs = np.full(spectrum.shape[-1], 2.0)
    pairs[0] = 1.0
    if g.shape[-1] % 2 == 0:
        pairs[-1] = 1.0
    return Spectrum(
        power=power,
        coefficients=coefficients,
        projections=spectrum,
        projection_power=1 / g.size,
        multiplicity=pairs,
        outside=0.0,
        samples=g.size,
        synthesis=lambda components: inverse(np.asarray(components, dtype=np.complex128), g.shape)[kept],
        unit=unit,
    )


def _squared(values: NDArray[np.complex128] | Array) -> Array:
    """|values|^2, without the square roots of |values|."""
    return np.asarray(values.real**2 + values.imag**2 if np.iscomplexobj(values) else values**2, dtype=np.float64)
