"""Maximum likelihood for photon counts: Fisher scoring, and the Cramer-Rao bound of counting.

Counts D_pb are Poisson with mean m = F(r) V + background, so that up to a constant the log-likelihood is
sum D log m - m. Its expected curvature is that of weighted least squares with w = 1/m, the inverse variance of a count
(McCullagh and Nelder, Generalized Linear Models, 1989, section 2.5). With s = D/m - 1 a step of scoring solves

    S dr = sum_b J_b^T s_b - C_b^T H_b^-1 F^T s_b,          dv_b = H_b^-1 (F^T s_b - C_b dr),

where J_b = sum_i V_ib T_i, H_b = F^T W_b F, C_b = F^T W_b J_b and S = sum_b J_b^T W_b J_b - C_b^T H_b^-1 C_b.
(`poisson_information`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from wallmirror.derendering.bounds import Bound, bound_of, require_order_one
from wallmirror.derendering.convex import minimise_above, solve_positive
from wallmirror.derendering.information import Information
from wallmirror.derendering.poisson_information import Products, information_of_counts, seen_cells
from wallmirror.derendering.splines import transport_of
from wallmirror.errors import InputError

Array = NDArray[np.float64]

_RIDGE = 1e-12
# Where the mean is this far below the largest the bound counts no more information than there.
_DARK = 1e-6
# A start must give every count a chance: r and V are raised to this share of their largest entry.
_START_FLOOR = 1e-6


@dataclass(frozen=True)
class PoissonFit:
    """A maximum of the Poisson likelihood.

    Parameters
    ----------
    coefficients:
        r, shape (K,).
    source:
        V in counts, shape (M, B).
    gain:
        Log-likelihood above that of the start, in nats.
    chi_squared:
        Pearson's sum (D - m)^2 / m per degree of freedom: 1 where the model and the counting are right.
    iterations:
        Scoring steps taken.
    converged:
        Whether the last step promised less than the tolerance, or a tenth of a nat where the steps had come to an end.
    """

    coefficients: Array
    source: Array
    gain: float
    chi_squared: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Counts:
    counts: Array  # (P, B)
    background: Array  # (P, B)
    used: NDArray[np.bool_]  # (P, B)
    designs: list[sp.csr_array]

    def mean(self, r: Array, v: Array) -> Array:
        return transport_of(self.designs, r) @ v + self.background

    def score(self, mean: Array, least: float) -> Array:
        """Slope of the log-likelihood in the mean."""
        return np.where(self.used, (self.counts - mean) / np.maximum(mean, least), 0.0)

    def weights(self, mean: Array, least: float) -> Array:
        """Its expected curvature."""
        return np.where(self.used, 1 / np.maximum(mean, least), 0.0)

    def gained(self, before: Array, after: Array, least: float) -> float:
        """Difference of two log-likelihoods, summed entry by entry so that near the maximum it is not all rounding."""
        low, high = np.maximum(before, least), np.maximum(after, least)
        poisson = self.counts * np.log(high / low) - (high - low)
        # Below the least mean: -((D - m)^2 - (D - least)^2) / (2 least), which is zero where m is above it.
        normal = (
            (2 * self.counts - after - high) * (after - high) - (2 * self.counts - before - low) * (before - low)
        ) / 2
        return float(np.sum(poisson + normal / least, where=self.used))


def maximise_poisson(
    counts: Array,
    designs: list[sp.csr_array],
    start: Array,
    *,
    source: Array | None = None,
    background: ArrayLike = 0.0,
    used: NDArray[np.bool_] | None = None,
    nonnegative: bool = False,
    least_mean: float = 0.1,
    tolerance: float = 1e-4,
    max_iterations: int = 60,
) -> PoissonFit:
    """Climb to the maximum of the Poisson likelihood by Fisher scoring.

    Parameters
    ----------
    counts:
        D, shape (P, B), photons or any unit in which the variance is the mean.
    start:
        r to start from, shape (K,), such as the Gaussian fit's or the closed form's.
    source:
        V to start from in counts, shape (M, B); by least squares from r when left out.
    background:
        Known mean of the counts without the card, broadcast to (P, B).
    used:
        Which entries count, shape (P, B); saturated ones do not.
    nonnegative:
        Keep r >= 0 and V >= 0.
    least_mean:
        Counts; where the model's mean falls below, as without bounds it may anywhere and even below zero, the count is
        taken as normal with this variance, which continues the likelihood smoothly.
    tolerance:
        Stop when a full step promises less than this many nats.

    Raises
    ------
    InputError
        For counts or a background below zero, or a least mean that is not above.
    """
    if not least_mean > 0:
        raise InputError(f"is {least_mean:g}; give a small number of counts above zero", field="least_mean")
    data = _checked(counts, designs, background, used)
    seen = seen_cells(designs)
    r = np.where(seen, start, 0.0)
    v = np.asarray(_least_squares(data, r) if source is None else source, dtype=np.float64)
    if nonnegative:
        # Off zero, where a mean of 0 could never explain a count.
        r = np.where(seen, np.maximum(r, _START_FLOOR * float(np.max(r))), 0.0)
        v = np.maximum(v, _START_FLOOR * float(np.max(v)))
    mean = data.mean(r, v)
    products = Products(designs)
    total = 0.0
    for iteration in range(1, max_iterations + 1):
        dr, dv, slope = _scoring_step(data, products, r, v, mean, seen, least_mean, nonnegative=nonnegative)
        if slope <= tolerance:
            return _fit(data, r, v, mean, least_mean, total, iteration, converged=True)
        length = 1.0
        while True:
            near_r, near_v = r + length * dr, v + length * dv
            if nonnegative:
                near_r, near_v = np.maximum(near_r, 0.0), np.maximum(near_v, 0.0)
            trial = data.mean(near_r, near_v)
            gained = data.gained(mean, trial, least_mean)
            if gained >= 1e-4 * length * slope:
                break
            length /= 2
            if length < 1e-10:
                return _fit(data, r, v, mean, least_mean, total, iteration, converged=slope <= 1e3 * tolerance)
        r, v, mean = near_r, near_v, trial
        total += gained
    return _fit(data, r, v, mean, least_mean, total, max_iterations, converged=slope <= 1e3 * tolerance)


def poisson_bound(
    designs: list[sp.csr_array],
    coefficients: Array,
    source: Array,
    *,
    gauge: Array,
    background: ArrayLike = 0.0,
    used: NDArray[np.bool_] | None = None,
) -> Bound:
    """The Cramer-Rao bound of counting at (r, V), in the gauge that holds c r fixed; see `bounds.cramer_rao`.

    Parameters
    ----------
    coefficients:
        r, shape (K,).
    source:
        V in counts, shape (M, B).
    gauge:
        c, shape (K,): the values of the basis functions at the peak of rho.
    background:
        Known mean of the counts without the card, broadcast to (P, B).

    Raises
    ------
    InputError
        For a background below zero, or a pattern whose powers leave the range of float64.
    """
    require_order_one(source)
    shape = (designs[0].shape[0], source.shape[1])
    data = _checked(np.zeros(shape), designs, background, used)
    seen = seen_cells(designs)
    mean = data.mean(coefficients, source)
    weights = data.weights(mean, _DARK * float(mean.max()))
    free = np.ones(source.shape, dtype=bool)
    schur, inverse, coupled = information_of_counts(
        Products(designs), coefficients, source, weights, np.flatnonzero(seen), free
    )
    known = Information(schur, inverse, coupled, seen)
    return bound_of(known, coefficients=coefficients, source=source, gauge=gauge)


def _checked(
    counts: Array, designs: list[sp.csr_array], background: ArrayLike, used: NDArray[np.bool_] | None
) -> _Counts:
    level = np.broadcast_to(np.asarray(background, dtype=np.float64), counts.shape)
    mask = np.ones(counts.shape, dtype=bool) if used is None else used
    if np.any((counts < 0) & mask):
        raise InputError("has entries below zero, which no count is", field="counts")
    if np.any(level < 0):
        raise InputError("has entries below zero; give the mean count without the card", field="background")
    return _Counts(np.asarray(counts, dtype=np.float64), level, mask, designs)


def _least_squares(data: _Counts, r: Array) -> Array:
    """V for a given r with equal weights, shape (M, B)."""
    transport = transport_of(data.designs, r)
    light = data.counts - data.background
    columns = zip(light.T, data.used.T)
    return np.stack([np.linalg.lstsq(transport[used], column[used])[0] for column, used in columns], axis=1)


def _fit(
    data: _Counts, r: Array, v: Array, mean: Array, least: float, gain: float, iterations: int, *, converged: bool
) -> PoissonFit:
    weights = data.weights(mean, least)
    pearson = float(np.sum((data.counts - mean) ** 2 * weights))
    # A pixel in which hardly any light is expected adds hardly anything to the sum, and frees no more.
    expected = float(np.sum(np.maximum(mean, 0.0) * weights))
    freedom = expected - int(np.count_nonzero(r)) - int(np.count_nonzero(v)) + 1
    return PoissonFit(r, v, gain, pearson / max(1.0, freedom), iterations, converged)


def _scoring_step(
    data: _Counts,
    products: Products,
    r: Array,
    v: Array,
    mean: Array,
    seen: NDArray[np.bool_],
    least: float,
    *,
    nonnegative: bool,
) -> tuple[Array, Array, float]:
    """The step in r and V, and the gain of log-likelihood that its slope promises."""
    score = data.score(mean, least)
    transport = transport_of(data.designs, r)
    grad_r = np.sum([t.T @ (score @ v[i]) for i, t in enumerate(data.designs)], axis=0)
    grad_v = transport.T @ score  # (M, B)
    free = (v > 0) | (grad_v > 0) if nonnegative else np.ones(v.shape, dtype=bool)
    grad_v = np.where(free, grad_v, 0.0)
    cells = np.flatnonzero(seen)
    schur, inverse, coupled = information_of_counts(products, r, v, data.weights(mean, least), cells, free)
    right = grad_r[cells] - np.einsum("bmk,mb->k", coupled, grad_v)
    level = float(np.trace(schur)) / max(1, cells.size)
    here = r[cells]
    # The gauge r r^T keeps the step off the scale's null direction; the ridge is for barely seen cells.
    schur += level * np.outer(here, here) / max(float(here @ here), 1e-300)
    schur[np.diag_indices_from(schur)] += _RIDGE * level
    dr = np.zeros_like(r)
    dr[cells] = minimise_above(-here, schur, right) if nonnegative else solve_positive(schur, right)
    dv = np.einsum("bij,jb->ib", inverse, grad_v) - np.einsum("bik,k->ib", coupled, dr[cells])
    if nonnegative:
        dv = np.maximum(dv, -v)
    return dr, dv, float(grad_r @ dr + np.sum(grad_v * dv))
