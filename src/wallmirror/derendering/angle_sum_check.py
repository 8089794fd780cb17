"""Hypothesis 8 after the fact: do the films want a wall that is no function of the angle sum, and what would it do to V?

The misfit as a whole does not tell: what such a wall changes in the films is mostly explained by another pattern and
another BRDF. What those leave unexplained is small but has a known shape, and a score test (Rao, Proc. Cambridge Phil. Soc.
44(1), 1948) looks for that shape alone. With m_k the change of the films per exponent of factor k (`facets`), freed of
all that r and V can make (residual m_k), and e the misfit of the fit,

    s_k = m_k^T W e,    A_kl = m_k^T W m_l,    estimated exponents A^-1 s,

each exponent turning the pattern by -dV_k, the part of V that stood in for m_k. The weights of the fit are no use here:
variances that were estimated from the same few samples as the films lie low where the films do, which alone makes scores
of eight standard deviations. W is the inverse of the variance averaged over realisations and neighbouring pixels, and the
scatter of s is taken from the films themselves, row by row (White, Econometrica 48(4), 1980). Exponents have a prior, as
what the captures cannot tell of them must not count as known: what is left of it is how far the pattern may turn unseen.
That is a standard deviation, as the bars are which it widens: five bars hold more than the largest departure that a test at
its level can miss (2.6 of them).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.stats import f as f_distribution

from wallmirror.derendering.convex import solve_positive
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.facets import FITTED, PRIOR_STD, Factor, logarithm
from wallmirror.derendering.groups import groups_of, one_group
from wallmirror.derendering.information import information
from wallmirror.derendering.moments import moments
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import design_matrices, transport_of

Array = NDArray[np.float64]

_TOLERANCE = 1e-5
_RIDGE = 1e-10
_ROUNDING = 1e-9
# Pixels over which a variance is averaged: its estimate from few samples must hardly know of the pixel's own noise.
_NEIGHBOURS = 31
#: Chance of a score so high at which the angle sum is rejected, if the pattern would turn by more than its error bars.
LEVEL = 0.01
#: A turn that the captures leave open beyond this many error bars is told.
UNTOLD = 3.0
#: A smaller one is in the bars and not worth a word.
SLIGHT = 1e-3
# Bars are widened to this share of the pattern at most: beyond it an answer counts as undetermined, and whether it is that
# is for noise and geometry to say, not for a hypothesis that they cannot test.
_WIDEST = 0.5
_FIT_FACETS = '; fit facets (wall "auto", no scale by an albedo), or use the general method'


@dataclass(frozen=True, kw_only=True)
class AngleSumCheck:
    """What a wall that is no function of the angle sum would do to a solution.

    Parameters
    ----------
    assumed:
        Exponents of the factors (`facets`) in the wall that the solution has; empty for an angle sum.
    exponents, exponents_std:
        The most likely ones and their standard deviations, after a prior of 0 +- 1 each.
    significance:
        Chance that the assumed wall makes scores as high as the films'.
    bias:
        Relative change of the pattern (after the best global scale) if the wall has the most likely exponents.
    open:
        Standard deviation of that change, from what the captures leave open of the exponents.
    """

    assumed: dict[str, float]
    exponents: dict[str, float]
    exponents_std: dict[str, float]
    significance: float
    bias: float
    open: float

    @property
    def turn(self) -> float:
        """How far the pattern may be off for the wall's sake, root mean square."""
        return math.hypot(self.bias, self.open)

    def rejects(self, predicted_error: float) -> bool:
        """Whether the films speak against the assumed wall, and to more than the error bars."""
        return self.significance < LEVEL and self.bias > predicted_error


def check_angle_sum(problem: Problem, estimate: Estimate, factors: tuple[Factor, ...] = FITTED) -> AngleSumCheck:
    """Hold an estimate against walls with further factors, by one Gauss-Newton step from it.

    Parameters
    ----------
    factors:
        Those whose exponents may differ from the ones that `problem` assumes.

    Raises
    ------
    UndeterminedError
        When the captures leave the pattern undetermined.
    """
    weights = _weights(problem)
    unexplained, turns = _derivatives(problem, estimate, factors, weights)
    full = np.broadcast_to(weights, problem.data.shape)
    missed = problem.data - estimate.transport @ estimate.source
    weighted = [weights * a for a in unexplained]
    gram = np.array([[np.vdot(a, b) for b in unexplained] for a in weighted])
    by_row = np.array([np.einsum("pb,pb->p", a, missed) for a in weighted])
    used = full > 0
    observations, rows = int(np.count_nonzero(used)), int(np.count_nonzero(np.any(used, axis=1)))
    freedom = max(1, observations - int(np.count_nonzero(estimate.coefficients)) - estimate.source.size)
    scatter = np.linalg.pinv(by_row @ by_row.T * (observations / freedom), hermitian=True)
    score = by_row.sum(axis=1)
    known = gram @ scatter @ gram
    assumed = np.array([problem.exponents.get(k, 0.0) for k in factors])
    covariance = np.linalg.inv(known + np.eye(len(factors)) / PRIOR_STD**2)
    step = covariance @ (gram @ scatter @ score - assumed / PRIOR_STD**2)
    power = float(np.sum(estimate.source**2))
    together = np.array([[np.sum(a * b) for b in turns] for a in turns]) / power
    return AngleSumCheck(
        assumed={k: float(v) for k, v in problem.exponents.items()},
        exponents={k: float(v) for k, v in zip(factors, assumed + step, strict=True)},
        exponents_std={k: float(v) for k, v in zip(factors, np.sqrt(np.diag(covariance)), strict=True)},
        significance=_significance(float(score @ scatter @ score), len(factors), len(problem.exponents), rows),
        bias=math.sqrt(max(0.0, float(step @ together @ step))),
        open=math.sqrt(max(0.0, float(np.sum(together * covariance)))),
    )


def _significance(statistic: float, factors: int, fitted: int, rows: int) -> float:
    """Hotelling's T^2, as the scatter of the scores is estimated from so many rows; fitted exponents have no score left."""
    tested = factors - fitted
    if tested <= 0 or rows <= factors:
        return 1.0
    return float(f_distribution.sf(statistic * (rows - factors) / (tested * (rows - 1)), tested, rows - factors))


def _weights(problem: Problem) -> Array:
    """Inverse variances that know nothing of a pixel's own noise, (P, 1), or (P, B) where some pixels are saturated."""
    views, pixels, realisations = problem.captures.radiance.shape
    if problem.inverse_variance is None:
        return np.ones((views * pixels, 1))
    inverse = problem.inverse_variance.reshape(views, pixels, realisations)
    used = inverse > 0
    variance = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=used)

    def around(values: Array) -> Array:
        return np.asarray(uniform_filter1d(values.sum(axis=2), _NEIGHBOURS, axis=1, mode="nearest"))

    total, count = around(variance), around(used.astype(np.float64))
    smooth = np.divide(count, total, out=np.zeros_like(total), where=total > 0)[..., None]
    weights = smooth if np.all(used) else np.where(used, smooth, 0.0)
    return np.asarray(weights.reshape(views * pixels, -1))


def _derivatives(
    problem: Problem, estimate: Estimate, factors: tuple[Factor, ...], weights: Array
) -> tuple[list[Array], list[Array]]:
    """For each factor the change of the films that no r and V make, (P, B), and how V then turns, (M, B), per exponent."""
    grid, r, source = estimate.grid, estimate.coefficients, estimate.source
    kernel = problem.kernel(math.degrees(grid.step), _TOLERANCE)
    designs = design_matrices(kernel, grid) if estimate.designs is None else estimate.designs
    known = estimate.information
    if known is None or not _alike(weights, problem.fit_weights):
        known = information(moments(problem.data, designs, weights), r, source)
    cells = np.flatnonzero(known.seen)
    level = float(np.trace(known.schur)) / max(1, cells.size)
    # The gauge keeps r off the null direction of each scale; the ridge is for barely seen cells.
    groups = groups_of(designs) if estimate.groups else one_group(designs)
    schur = known.schur.copy()
    for own in groups.parts(r):
        part = own[cells]
        schur += level * np.outer(part, part) / max(float(part @ part), 1e-300)
    schur[np.diag_indices_from(schur)] += _RIDGE * level
    if kernel.weight.shape[-1] == 1:  # what a pixel's only node sends is F
        lit = estimate.transport.reshape(kernel.weight.shape)
    else:
        lit = kernel.weight * grid.evaluate(r, kernel.angle_sum)
    changes = [
        np.sum(lit * logarithm(k, kernel.theta_s, kernel.theta_o), axis=-1).reshape(estimate.transport.shape)
        for k in factors
    ]
    along_v, right = [], []
    for change in changes:  # of F, (P, M): that of the films as V and r see them, F^T W m_b and sum_b J_b^T W m_b
        weighted = weights * (change @ source)
        along_v.append((estimate.transport.T @ weighted).T)
        along_r = sum(t.T @ column for t, column in zip(designs, source @ weighted.T, strict=True))
        right.append(along_r[cells] - np.einsum("bmk,bm->k", known.coupled, along_v[-1]))
    steps = np.zeros((len(factors), r.size))
    steps[:, cells] = solve_positive(schur, np.stack(right, axis=1)).T
    unexplained, turns = [], []
    for change, along, dr in zip(changes, along_v, steps, strict=True):
        dv = (np.einsum("bij,bj->bi", known.inverse, along) - np.einsum("bmk,k->bm", known.coupled, dr[cells])).T
        moved = transport_of(designs, dr)
        unexplained.append((change - moved) @ source - estimate.transport @ dv)
        turns.append(-groups.freed(dv, source))  # a change of scale is no turn
    return unexplained, turns


def _alike(weights: Array, others: Array) -> bool:
    """Whether two kinds of weights are the same but for the rounding of an average."""
    return weights.shape == others.shape and bool(np.all(np.abs(weights - others) <= _ROUNDING * others))


def in_words(exponents: Mapping[Any, float]) -> str:
    """The factors and their exponents."""
    return ", ".join(f"{factor} to the {exponent:.2f}" for factor, exponent in exponents.items())


def with_doubt(estimate: Estimate, check: AngleSumCheck) -> Estimate:
    """The estimate with its bars widened by what the wall may do to it, and what has to be said of that.

    The bars of an angle-sum wall stay as they are while the turn is within them.
    """
    predicted = estimate.predicted_error
    # Fitted exponents have error bars, whatever their size.
    whole = math.hypot(predicted, check.turn) if check.assumed or check.turn > predicted else predicted
    whole = min(whole, max(predicted, _WIDEST))
    known = math.hypot(predicted, check.open) if check.assumed else predicted
    warnings: tuple[str, ...] = ()
    # What is left beside fitted facets is a refinement of theirs: a slight turn is in the bars and says no more.
    if check.rejects(max(known, SLIGHT) if check.assumed else known):
        which = (
            "the wall of facets that was fitted does not explain the films either"
            if check.assumed
            else "Hypothesis 8 (angle sum) does not hold, or wrong geometry or light beyond one bounce looks like that"
        )
        remedy = "" if check.assumed or estimate.groups else _FIT_FACETS
        warnings = (
            f"{which}: a wall that depends on both angles fits better and turns the pattern by about "
            f"{100 * check.bias:.2g} %; the error bars were widened to match{remedy}",
        )
    elif not check.assumed and check.open > max(UNTOLD * predicted, SLIGHT):
        warnings = (
            "the captures cannot tell whether Hypothesis 8 (angle sum) holds: were the wall one of facets, the pattern "
            f"would be about {100 * check.open:.2g} % off, and the error bars were widened to that; use more pixels or "
            "views, or more light",
        )
    rests_on = (f"a wall of facets, {in_words(check.assumed)}",) if check.assumed else ()
    ratio = whole / predicted if predicted > 0 else 1.0
    return replace(
        estimate,
        predicted_error=whole,
        source_std=ratio * estimate.source_std,
        shape_std=ratio * estimate.shape_std,
        brdf_std=lambda u: ratio * estimate.brdf_std(u),
        warnings=(*warnings, *estimate.warnings),
        priors=(*estimate.priors, *rests_on),
    )
