"""The closed form: BRDF and pattern from one small eigenproblem, exact where there is no noise.

The columns of F = [T_1 r .. T_M r] span the same space as the data D = F V, and each T_i is known, so that r
is the vector that keeps every T_i r in that space. This is the subspace method of blind channel
identification (Moulines, Duhamel, Cardoso, Mayrargue, IEEE Trans. Signal Processing 43(2), 1995; Xu, Liu,
Tong, Kailath, ibid. 43(12), 1995), as used for blind gain calibration by Balzano and Nowak (IPSN 2007) and,
nearest to this field, for Lambertian inverse rendering by Nguyen and Do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Above this many elements the M^2 x M^2 matrix is not formed; Lanczos finds its two leading pairs.
_DENSE_ELEMENTS = 16
_RIDGE = 1e-13
_NO_RIVAL = 0.01


#: Quantiles of the law of Tracy and Widom for real matrices: passed once in ten thousand, a hundred and ten times.
CERTAIN, LIKELY, POSSIBLE = 4.4, 2.02, 0.45


@dataclass(frozen=True)
class SignalSpace:
    """The leading left singular space of the data.

    Parameters
    ----------
    basis:
        U, shape (P, M), orthonormal.
    singular_values:
        All singular values of the data, descending, shape (min(P, B),).
    rank:
        How many of them stand out of rounding and noise, at most M.
    dimensions:
        Of the space that the noise fills: P, or less where the data were projected first.
    """

    basis: Array
    singular_values: Array
    rank: int
    dimensions: int


@dataclass(frozen=True)
class ClosedForm:
    """Result of `closed_form`, in the scale in which the rms of F over all entries is that of T r with |T r| = 1.

    Parameters
    ----------
    coefficients:
        r, shape (K,), with the sign that makes the pattern's sum positive.
    transport:
        F = U W, shape (P, M).
    source:
        V = W^-1 U^T D, shape (M, B).
    mismatch:
        1 - lambda_1, the share of T r outside the data's space: wrong geometry, too coarse a grid,
        Hypothesis 8 violated, or noise.
    gap:
        1 - lambda_2: how far the second-best BRDF is from explaining the data; 0 means undetermined.
    near_solutions:
        Number of orthogonal BRDFs that explain the data as well as the best within a factor of 100, and to 1 %.
    exposure:
        How well each coefficient is seen, 1 for the best-seen, shape (K,).
    family:
        Those near solutions, each with |T r| = 1 and orthogonal to the others over all entries of F, shape (K, n).
    beyond:
        1 - lambda_(n+1): how far the best BRDF outside the family is from explaining the data.
    """

    coefficients: Array
    transport: Array
    source: Array
    mismatch: float
    gap: float
    near_solutions: int
    exposure: Array
    family: Array
    beyond: float

    @property
    def error(self) -> float:
        """Bound on the relative error of r: the eigenvector turns by at most sqrt(mismatch) / gap (Davis, Kahan 1970)."""
        if self.near_solutions > 1:
            return math.inf
        return math.sqrt(self.mismatch) / max(self.gap, 1e-300) + 1e-15


def signal_space(data: Array, elements: int, *, noise_floor: float = 0.0) -> SignalSpace:
    """U and the rank of the data, both from one QR and one small SVD.

    Parameters
    ----------
    data:
        D, shape (P, B), of order one (normalised by the caller).
    elements:
        M, the rank that D has when all elements can be told apart.
    noise_floor:
        Singular value that noise alone would reach; the rank counts those above it and above rounding.
    """
    q, triangle = np.linalg.qr(data)
    left, values, _ = np.linalg.svd(triangle)
    rounding = values[0] * np.finfo(np.float64).eps * max(data.shape) if values.size else 0.0
    rank = int(np.count_nonzero(values[:elements] > max(rounding, noise_floor)))
    return SignalSpace(q @ left[:, :elements], values, rank, data.shape[0])


def noise_edge(rows: int, columns: int, units: float = CERTAIN) -> float:
    """Singular value that noise of unit variance in a matrix of this size exceeds in one case of ten thousand.

    The edge sqrt(rows) + sqrt(columns) of Marchenko and Pastur (1967), and beyond it some units of the scale on which the
    largest eigenvalue scatters by the law of Tracy and Widom (Johnstone, Annals of Statistics 29(2), 2001): `CERTAIN`, or
    `LIKELY` for one case of a hundred, or `POSSIBLE` for one of ten.
    """
    edge = math.sqrt(rows) + math.sqrt(columns)
    scale = edge * (1 / math.sqrt(rows) + 1 / math.sqrt(columns)) ** (1 / 3)
    return math.sqrt(edge**2 + units * scale)


def closed_form(
    data: Array,
    designs: list[sp.csr_array],
    space: SignalSpace,
    *,
    row_weights: Array | None = None,
    band: Array | None = None,
    stacked: Array | None = None,
    prolongation: sp.csr_array | None = None,
) -> ClosedForm:
    """Recover r, F and V from data whose rank is M: minimise sum_i |(I - U U^T) T_i r|^2.

    Parameters
    ----------
    data:
        D, shape (P, B).
    designs:
        T_1 .. T_M, each (P, K).
    space:
        `signal_space(data, M)` with rank M.
    row_weights:
        Of shape (P, 1), where the data's rows are weighted and the designs' are not yet.
    band:
        `banded_gram(designs, row_weights)` where it is known already; that of the coarser knots with a prolongation.
    stacked:
        `stack_of(designs, space, row_weights)` where it is known already.
    prolongation:
        R of shape (K, K'), where r' on coarser knots is sought, R r' being r; K' takes the place of K in the result.

    Notes
    -----
    With H = stack(U^T T_i) (`stack_of`) and A = sum T_i^T T_i the minimiser under sum |T_i r|^2 = 1 is r = A^-1 H^T q, where
    q is the leading eigenvector of H A^-1 H^T, whose eigenvalues lie in [0, 1].
    """
    u = space.basis
    weights = np.ones((u.shape[0], 1)) if row_weights is None else row_weights
    stacked = stack_of(designs, space, weights) if stacked is None else stacked
    stacked = stacked if prolongation is None else stacked @ prolongation
    size = stacked.shape[1]
    band = banded_gram(designs, row_weights) if band is None else band
    factor = _banded_cholesky(band)
    values, vectors = _leading_pairs(stacked, factor, len(designs))
    r = sl.cho_solve_banded((factor, True), stacked.T @ vectors[:, 0])
    projected = (stacked @ r).reshape(len(designs), -1).T  # W, (M, M): column i is U^T T_i r
    norm, missed = 0.0, 0.0
    whole = r if prolongation is None else prolongation @ r
    for i, t in enumerate(designs):
        column = weights[:, 0] * (t @ whole)
        # The residual itself: 1 - lambda_1 from the eigenvalue would end at 1e-16, this goes on to its square.
        missed += float(np.sum((column - u @ projected[:, i]) ** 2))
        norm += float(column @ column)
    mismatch = missed / norm if norm > 0 else 1.0
    scale = 1 / math.sqrt(norm) if norm > 0 else 1.0
    # W is singular where an element has no part in r.
    source = np.linalg.lstsq(projected * scale, u.T @ data)[0]
    if source.sum() < 0:  # the light is positive; r itself may be ruled by cells that hardly anybody saw
        scale, source = -scale, -source
    lost = 1 - values
    # A rival explains the data nearly as well; one that misses more than a hundredth of them is none, however noisy they are.
    near = max(1, int(np.count_nonzero(lost < min(100 * max(mismatch, 1e-15 * size), _NO_RIVAL))))
    family = sl.cho_solve_banded((factor, True), stacked.T @ vectors[:, :near]) if near > 1 else r[:, None] * scale
    return ClosedForm(
        coefficients=r * scale,
        transport=(u @ projected) * scale,
        source=source,
        mismatch=mismatch,
        gap=float(lost[1]) if lost.size > 1 else 1.0,
        near_solutions=near,
        exposure=band[0] / max(float(band[0].max()), 1e-300),
        family=family,
        beyond=float(lost[near]) if lost.size > near else 1.0,
    )


def stack_of(designs: list[sp.csr_array], space: SignalSpace, row_weights: Array) -> Array:
    """H = stack(U^T T_i), (M^2, K), of rows weighted first, (P, 1): rows i M .. i M + M - 1 belong to T_i."""
    weighted = row_weights * space.basis
    return np.concatenate([(t.T @ weighted).T for t in designs])


def banded_gram(designs: list[sp.csr_array], row_weights: Array | None = None) -> Array:
    """Lower band of A = sum_i T_i^T T_i, shape (w, K), of rows weighted first if need be: entry [d, k] is A[k + d, k].

    Rows that are runs of neighbouring columns, of equal length within each T_i, as `design_matrices` makes them, sum up
    without a sparse product.
    """
    size = designs[0].shape[1]
    widths = [run_length(t) for t in designs]
    if 0 in widths:
        if row_weights is not None:
            designs = [sp.csr_array(t.multiply(row_weights)) for t in designs]
        return _band_of(sp.csr_array(sum(t.T @ t for t in designs)))
    by_row = 1.0 if row_weights is None else row_weights[:, 0]
    band = np.zeros((max(widths), size))
    for t, width in zip(designs, widths, strict=True):
        columns = by_row * np.ascontiguousarray(t.data.reshape(-1, width).T)
        first = t.indices[::width].astype(np.intp)
        for d in range(width):
            for k in range(width - d):
                sums = np.bincount(first, weights=columns[k] * columns[k + d], minlength=size)
                band[d, k:] += sums[: size - k]
    return band


def run_length(design: sp.csr_array) -> int:
    """Number of columns in each row where all rows are runs of neighbouring columns of equal length, and 0 elsewhere."""
    width = int(design.nnz // design.shape[0])
    if width == 0 or np.any(np.diff(design.indptr) != width):
        return 0
    # First and last column alone would pass for a run where columns stand out of order.
    columns = design.indices.reshape(-1, width)
    return width if np.array_equal(columns, columns[:, :1] + np.arange(width, dtype=columns.dtype)) else 0


def _band_of(gram: sp.csr_array) -> Array:
    coo = gram.tocoo()
    row, column = coo.coords
    band = np.zeros((int(np.max(np.abs(row - column), initial=0)) + 1, gram.shape[0]))
    lower = row >= column
    band[(row - column)[lower], column[lower]] = coo.data[lower]
    return band


def _banded_cholesky(band: Array) -> Array:
    """Lower banded Cholesky factor of A plus a ridge that only cells without data feel."""
    band = band.copy()
    band[0] += _RIDGE * band[0].max()
    return np.asarray(sl.cholesky_banded(band, lower=True), dtype=np.float64)


def _leading_pairs(stacked: Array, factor: Array, elements: int) -> tuple[Array, Array]:
    """Eigenvalues of H A^-1 H^T, descending, and their eigenvectors: all of them, or the first four."""

    def apply(x: Any) -> Array:
        return np.asarray(stacked @ sl.cho_solve_banded((factor, True), stacked.T @ x), dtype=np.float64)

    n = stacked.shape[0]
    if elements <= _DENSE_ELEMENTS:
        matrix = apply(np.eye(n))
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
        return values[::-1], vectors[:, ::-1]
    operator = spl.LinearOperator((n, n), matvec=apply, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(n)
    values, vectors = spl.eigsh(operator, k=4, which="LA", v0=start, tol=1e-14)
    order = np.argsort(values)[::-1]
    return values[order], vectors[:, order]
