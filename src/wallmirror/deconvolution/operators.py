"""Convolution with a kernel as a linear operator, its Toeplitz matrix, and the test of an adjoint.

    full:      g[n] = sum_m f[n - m] h[m],            n = 0 .. N + K - 2                        (eq. 3.8)
    same:      the N samples of it from n = origin on
    periodic:  g[n] = sum_m f[(n + origin - m) mod N] h[m]

"full" loses nothing and is what to record where one can choose. "same" is the full convolution cropped to the signal's
place: light that the kernel carries across the border is lost. "periodic" is what a plain product of Fourier transforms
computes. `origin` is the kernel's sample that leaves the signal in place, its middle K // 2 unless it is given.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import LinearOperator

from wallmirror.deconvolution.checking import in_unit, one_of, real_samples
from wallmirror.errors import InputError
from wallmirror.memory import require_memory

Array = NDArray[np.float64]

#: What becomes of the signal's border: see the module's text.
Mode = Literal["full", "same", "periodic"]

_WORTH_THREADS = 1 << 18  # samples of a transform
_WORTH_ASKING = 10**7  # samples from which on the memory might not do
_MATRIX_BYTES = 16.0  # an entry, and its copy
_GRID_BYTES = 48.0  # a sample: the transform, its conjugate, and those of signal and product


class Convolution(LinearOperator):  # type: ignore[misc]
    """Convolution of signals of one shape with one kernel, in any number of dimensions, by real FFTs.

    Forward g = H f is eq. 3.8; adjoint f = H^T g is the correlation with the kernel, f[m] = sum_n h[n - m] g[n].
    Everything is computed in float64. `matvec` and `rmatvec` take flat vectors, as SciPy's solvers do; `apply` and
    `adjoint` take and give arrays of `signal_shape` and `data_shape`.

    Parameters
    ----------
    kernel:
        h, shape (K_1, ..., K_d), real and finite.
    signal_shape:
        (N_1, ..., N_d), the shape of f.
    mode:
        "full", "same" or "periodic"; see the module's text.
    origin:
        The kernel's sample that leaves the signal in place, for "same" and "periodic"; K // 2 along each axis when left
        out.

    Raises
    ------
    InputError
        For a kernel that is not real and finite, axes that do not match, a kernel longer than the period, or an origin
        outside the kernel.

    Examples
    --------
    >>> blur = Convolution([1.0, 2.0, 1.0], (4,))
    >>> np.round(blur.apply([0.0, 1.0, 0.0, 0.0]), 12).tolist()
    [0.0, 1.0, 2.0, 1.0, 0.0, 0.0]
    >>> np.round(blur.adjoint([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 12).tolist()
    [2.0, 1.0, 0.0, 0.0]
    """

    def __init__(
        self,
        kernel: ArrayLike,
        signal_shape: Sequence[int],
        *,
        mode: Mode = "full",
        origin: Sequence[int] | None = None,
    ) -> None:
        h = real_samples(kernel, "kernel")
        self.mode: Mode = mode
        self.kernel_shape = h.shape
        self.signal_shape = checked_shape(signal_shape, h.ndim, "signal_shape")
        self.origin = kernel_origin(h.shape, mode, origin)
        full = tuple(n + k - 1 for n, k in zip(self.signal_shape, h.shape, strict=True))
        if mode == "periodic":
            self._grid = self.signal_shape
            if any(k > n for n, k in zip(self._grid, h.shape, strict=True)):
                raise InputError(
                    f'has shape {h.shape}, longer than the period {self._grid}; use mode "full" or "same"',
                    field="kernel",
                )
        else:
            self._grid = tuple(int(scipy.fft.next_fast_len(n, real=axis == h.ndim - 1)) for axis, n in enumerate(full))
        self.data_shape = full if mode == "full" else self.signal_shape
        if math.prod(self._grid) > _WORTH_ASKING:
            require_memory(_GRID_BYTES * math.prod(self._grid), f"a convolution on a grid of {self._grid} samples")
        self._place(h, self.signal_shape)

    def _place(self, given: Array, taken_shape: tuple[int, ...]) -> None:
        """Hold the transform of the factor that is given; the operator takes the other factor to the data."""
        super().__init__(np.float64, (math.prod(self.data_shape), math.prod(taken_shape)))
        self.nonnegative = bool(given.min() >= 0)
        periodic = self.mode == "periodic"
        if periodic:
            given = np.roll(_padded(given, self._grid), [-o for o in self.origin], tuple(range(given.ndim)))
        start = (0,) * given.ndim if periodic or self.mode == "full" else self.origin
        self._transfer = transform(given, self._grid)
        self._conjugate = self._transfer.conj()
        self._taken_shape = taken_shape
        self._taken = tuple(slice(0, n) for n in taken_shape)
        self._data = tuple(slice(o, o + n) for o, n in zip(start, self.data_shape, strict=True))

    def apply(self, signal: ArrayLike) -> Array:
        """H f, shape `data_shape`."""
        return _finite(self._forward, _shaped(signal, self.signal_shape, "signal"), "signal")

    def adjoint(self, data: ArrayLike) -> Array:
        """H^T g, shape `signal_shape`."""
        return _finite(self._backward, _shaped(data, self.data_shape, "data"), "data")

    def _forward(self, signal: Array) -> Array:
        spectrum = transform(signal, self._grid)
        spectrum *= self._transfer
        return inverse(spectrum, self._grid)[self._data]

    def _backward(self, data: Array) -> Array:
        if any(place.start for place in self._data):
            padded = np.zeros(self._grid)
            padded[self._data] = data
            data = padded
        spectrum = transform(data, self._grid)
        spectrum *= self._conjugate
        return inverse(spectrum, self._grid)[self._taken]

    def _matvec(self, x: Array) -> Array:
        return self._forward(np.asarray(x, dtype=np.float64).reshape(self._taken_shape)).ravel()

    def _rmatvec(self, x: Array) -> Array:
        return self._backward(np.asarray(x, dtype=np.float64).reshape(self.data_shape)).ravel()

    def exchanged(self, signal: ArrayLike) -> Convolution:
        """The operator that takes kernels h of `kernel_shape` to the same data g = f * h, for one fixed signal f.

        Parameters
        ----------
        signal:
            f, shape `signal_shape`.

        Examples
        --------
        >>> blur = Convolution([1.0, 2.0], (3,), mode="same")
        >>> f = [3.0, 0.0, 1.0]
        >>> bool(np.allclose(blur.apply(f), blur.exchanged(f).apply([1.0, 2.0])))
        True
        """
        f = _shaped(signal, self.signal_shape, "signal")
        other = copy.copy(self)
        other.signal_shape = self.kernel_shape  # what it takes now is the kernel
        other.kernel_shape = self.signal_shape
        other._place(f, self.kernel_shape)
        return other


def toeplitz_matrix(
    kernel: ArrayLike, samples: int, *, mode: Mode = "full", origin: int | None = None
) -> NDArray[np.float64]:
    """The matrix H of eq. 3.11 for a 1-D kernel: H[n, m] = h[n - m], a Toeplitz matrix.

    Parameters
    ----------
    kernel:
        h, shape (K,).
    samples:
        N, the number of samples of the signal; the matrix has N columns, and N + K - 1 rows ("full") or N.
    mode, origin:
        As for `Convolution`.

    Notes
    -----
    Its transpose correlates instead of convolving. Solving eq. 3.13 with H and H^T exchanged undoes a correlation; the
    answer is right only where the kernel is even about its origin.

    Examples
    --------
    >>> toeplitz_matrix([1.0, 2.0], 3)
    array([[1., 0., 0.],
           [2., 1., 0.],
           [0., 2., 1.],
           [0., 0., 2.]])
    """
    h = real_samples(kernel, "kernel", ndim=1)
    (n,) = checked_shape((samples,), 1, "samples")
    (start,) = kernel_origin(h.shape, mode, None if origin is None else (origin,))
    if mode == "periodic":
        if h.size > n:
            raise InputError(
                f'has {h.size} samples, longer than the period {n}; use mode "full" or "same"', field="kernel"
            )
        require_memory(_MATRIX_BYTES * n * n, f"a matrix of {n} rows and columns")
        return np.asarray(scipy.linalg.circulant(np.roll(_padded(h, (n,)), -start)), dtype=np.float64)
    rows = n + h.size - 1
    require_memory(_MATRIX_BYTES * n * rows, f"a matrix of {rows} rows and {n} columns")
    first_row = np.zeros(n)
    first_row[0] = h[0]
    matrix = np.asarray(scipy.linalg.toeplitz(_padded(h, (n + h.size - 1,)), first_row), dtype=np.float64)
    return matrix if mode == "full" else matrix[start : start + n]


def adjoint_mismatch(operator: LinearOperator, *, seed: int = 0) -> float:
    """|<H f, g> - <f, H^T g>| / (|H f| |g|) for random f and g: rounding for an adjoint, of order one otherwise.

    Examples
    --------
    >>> adjoint_mismatch(Convolution([1.0, 2.0, 0.5], (50,))) < 1e-13
    True
    """
    rng = np.random.default_rng(seed)
    f, g = (rng.standard_normal(n) for n in (operator.shape[1], operator.shape[0]))
    forward = operator.matvec(f)
    forward, unit = in_unit(np.asarray(forward, dtype=np.float64))
    scale = float(np.linalg.norm(forward) * np.linalg.norm(g))
    return abs(float(forward @ g - f @ (operator.rmatvec(g) / unit))) / scale if scale > 0 else 0.0


def transform(samples: Array, grid: tuple[int, ...]) -> NDArray[np.complex128]:
    """Fourier transform of real samples, zero-padded to the grid, over all axes; the last one is halved."""
    workers = _workers(grid)
    if 2 * samples.size >= math.prod(grid):
        return np.asarray(scipy.fft.rfftn(samples, s=grid, workers=workers))
    # A small kernel is padded one axis at a time, so that few rows of zeros are transformed.
    spectrum = scipy.fft.rfft(samples, n=grid[-1], axis=-1, workers=workers)
    for axis in range(samples.ndim - 1):
        spectrum = scipy.fft.fft(spectrum, n=grid[axis], axis=axis, workers=workers, overwrite_x=True)
    return np.asarray(spectrum)


def inverse(spectrum: NDArray[np.complex128], grid: tuple[int, ...]) -> Array:
    """What `transform` came from."""
    return np.asarray(scipy.fft.irfftn(spectrum, s=grid, workers=_workers(grid), overwrite_x=True))


def _workers(grid: tuple[int, ...]) -> int:
    """Threads pay where each has some milliseconds to do."""
    return (os.cpu_count() or 1) if math.prod(grid) >= _WORTH_THREADS else 1


def kernel_origin(shape: tuple[int, ...], mode: Mode, origin: Sequence[int] | None) -> tuple[int, ...]:
    """The kernel's sample that leaves a signal in place, checked."""
    one_of(mode, get_args(Mode), "mode")
    if origin is None:
        return tuple(k // 2 for k in shape)
    if len(origin) != len(shape) or any(
        not (isinstance(o, (int, np.integer)) and 0 <= o < k) for o, k in zip(origin, shape, strict=False)
    ):
        raise InputError(f"is {tuple(origin)}; give one sample inside the kernel of shape {shape}", field="origin")
    return tuple(int(o) for o in origin)


def checked_shape(shape: Sequence[int], ndim: int, field: str) -> tuple[int, ...]:
    """A shape of that many axes of at least one sample each."""
    if len(shape) != ndim or any(not isinstance(n, (int, np.integer)) or n < 1 for n in shape):
        raise InputError(
            f"is {tuple(shape)}; give {ndim} whole numbers >= 1, one for each axis of the kernel", field=field
        )
    return tuple(int(n) for n in shape)


def _padded(samples: Array, shape: tuple[int, ...]) -> Array:
    return np.pad(samples, [(0, n - k) for n, k in zip(shape, samples.shape, strict=True)])


def _shaped(values: ArrayLike, shape: tuple[int, ...], field: str) -> Array:
    samples = real_samples(values, field)
    if samples.shape != shape:
        raise InputError(f"has shape {samples.shape} where the operator takes {shape}", field=field)
    return samples


def _finite(product: Callable[[Array], Array], factor: Array, field: str) -> Array:
    """The product, refused where it is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = product(factor)
    if not np.all(np.isfinite(found)):
        raise InputError("convolved with the kernel leaves the range of float64; use other units", field=field)
    return found
