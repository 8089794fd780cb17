"""Hypothesis 8 where there is no noise: what walls with other factors leave of the closed form's mismatch, and do to V.

Without noise there is no likelihood, but the closed form can be taken at any exponents x of the factors (`facets`), as T_i(x)
= diag(f_i^x) T_i. With |F(x)| = 1 its mismatch is the square of what lies outside the data's space, which one
difference a factor makes linear in x,

    e(x) = stack_i (I - U U^T) T_i(x) r(x) = e + sum_k x_k e_k,      V(x) = V + sum_k x_k V_k,

differences over a whole unit of the exponent, as departures of that size are the ones in question. What is then left at the
best exponents, a spline's error or a wall that is neither, follows no statistics and averages out over no pixels: all
of it counts as a single observation. So exponents stay open until they add as much to the mismatch as is left of it, or
until their prior ends them (`facets.PRIOR_STD`), and the bars take in what the pattern does on the way. A wall of
the angle sum has nothing to gain from exponents, but films of facets lose most of their mismatch.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import beta

from wallmirror.derendering.angle_sum_check import AngleSumCheck
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.facets import FITTED, PRIOR_STD, Factor, logarithm
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import transport_of
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
# Mismatch below which there is nothing but rounding.
_ROUNDING = 1e-22
# Numbers that what is left by chance is made of, at least: a spline's error changes sign with every few knots.
_INDEPENDENT = 10
# Rounds in which what is left and the exponents that leave it settle.
_ROUNDS = 30


def check_angle_sum_quietly(
    problem: Problem, estimate: Estimate, factors: tuple[Factor, ...] = FITTED, *, space: SignalSpace
) -> AngleSumCheck:
    """Hold a closed form against walls with further factors, by a closed form at each.

    Parameters
    ----------
    estimate:
        Of `exact.solve_exactly`, with its designs.
    factors:
        Those whose exponents may differ from the ones that `problem` assumes.
    space:
        Of the data.
    """
    grid, designs = estimate.grid, estimate.designs
    if designs is None:
        _, designs = problem.designs(math.degrees(grid.step), degree=grid.degree, tolerance=_TOLERANCE)
    designs = problem.weighted(designs)
    here = estimate.closed
    power = float(np.sum(here.source**2))
    missed = _missed(here, designs, space)
    changes, bends, turns = [], [], []
    for factor in factors:
        values = np.exp(_logarithms(problem, factor))
        there, outside = _at(problem, _times(designs, values), space)
        if problem.exponents:
            # Facets that were fitted leave so little that what is no line in the exponents counts.
            opposite = _at(problem, _times(designs, 1 / values), space)[1]
            changes.append((outside - opposite) / 2)
            bends.append(float(np.sum(((outside + opposite) / 2 - missed) ** 2)))
        else:
            changes.append(outside - missed)
            bends.append(0.0)
        source = there.source * (float(np.sum(there.source * here.source)) / float(np.sum(there.source**2)))
        turns.append(source - here.source)
    gram = np.array([[np.sum(a * b) for b in changes] for a in changes])
    slope = np.array([np.sum(a * missed) for a in changes])
    whole = float(np.sum(missed**2))
    assumed = np.array([problem.exponents.get(k, 0.0) for k in factors])
    step, covariance, left = _exponents(gram, slope, whole, np.array(bends), assumed)
    together = np.array([[np.sum(a * b) for b in turns] for a in turns]) / power
    tested = len(factors) - len(problem.exponents)
    share = min(1.0, left / (whole + _ROUNDING))
    return AngleSumCheck(
        assumed={k: float(v) for k, v in problem.exponents.items()},
        exponents={k: float(v) for k, v in zip(factors, assumed + step, strict=True)},
        exponents_std={k: float(v) for k, v in zip(factors, np.sqrt(np.diag(covariance)), strict=True)},
        # The share of a random vector's square that its projection off so many directions leaves.
        significance=float(beta.cdf(share, (_INDEPENDENT - tested) / 2, tested / 2)) if tested > 0 else 1.0,
        bias=math.sqrt(max(0.0, float(step @ together @ step))),
        open=math.sqrt(max(0.0, float(np.sum(together * covariance)))),
    )


def _exponents(gram: Array, slope: Array, whole: float, bends: Array, assumed: Array) -> tuple[Array, Array, float]:
    """The step from the assumed exponents to the most likely ones, its covariance, and the mismatch that it leaves.

    What the lines miss of the mismatch over one standard deviation of the exponents is not known to be gone.
    """

    def after(step: Array) -> float:
        return max(0.0, whole + 2 * float(slope @ step) + float(step @ gram @ step)) + _ROUNDING

    left = after(-np.linalg.pinv(gram, hermitian=True) @ slope)
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(gram / left + np.eye(assumed.size) / PRIOR_STD**2)
        step = -covariance @ (slope / left + assumed / PRIOR_STD**2)
        before, left = left, after(step) + float(bends @ np.diag(covariance) ** 2)
        if abs(left - before) < 1e-3 * left:
            break
    return np.asarray(step, dtype=np.float64), np.asarray(covariance, dtype=np.float64), left


def _at(problem: Problem, designs: list[sp.csr_array], space: SignalSpace) -> tuple[ClosedForm, Array]:
    """The closed form of another wall, and what it leaves outside the data's space."""
    there = closed_form(problem.weighted_data, designs, space)
    return there, _missed(there, designs, space)


def _missed(closed: ClosedForm, designs: list[sp.csr_array], space: SignalSpace) -> Array:
    """What lies of F with |F| = 1 outside the data's space, (P, M)."""
    transport = transport_of(designs, closed.coefficients)
    outside = transport - space.basis @ (space.basis.T @ transport)
    return np.asarray(outside / max(float(np.linalg.norm(transport)), 1e-300))


def _logarithms(problem: Problem, factor: Factor) -> Array:
    """log f from the middle of each element to the middle of each pixel, (P, M)."""
    captures = problem.captures
    wall = wall_points(captures.observer)[..., None]
    theta_s = incident_angles(np.asarray(captures.card.elements_x), captures.card.distance, wall)
    logarithms = logarithm(factor, theta_s, outgoing_angles(captures.observer, wall))
    return logarithms.reshape(-1, captures.card.elements)


def _times(designs: list[sp.csr_array], factors: Array) -> list[sp.csr_array]:
    """T_i with its rows multiplied by column i of the factors."""
    return [
        sp.csr_array((t.data * np.repeat(factors[:, i], np.diff(t.indptr)), t.indices, t.indptr), t.shape)
        for i, t in enumerate(designs)
    ]
