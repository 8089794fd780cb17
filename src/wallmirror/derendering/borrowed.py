"""Is what seems to be known of the pattern made by the noise in the BRDF?

The information along a direction dV of the pattern, after the BRDF has made up for what it can, is the square of

    J = F dV + sum_i T_i dr dV_i,

taken at the r that was found. Noise in that r, of covariance Cov(r), adds on average

    E |sum_i T_i (r' - r) dV_i|^2 = tr(Cov(r) sum_ij (dV dV^T)_ij T_i^T W T_j)

to |J|^2, less what other r and V make of that change of the films. So a direction of which the true r tells nothing at all (a
wall that looks alike to all elements, an element that no lobe reaches) comes out with bars of some per cent, however little
noise there is. Where such borrowed information is as much as the own, the Cramer-Rao bound at the fit is no bound.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound
from wallmirror.derendering.groups import Groups
from wallmirror.derendering.information import Information
from wallmirror.derendering.moments import Moments
from wallmirror.derendering.problem import Problem

Array = NDArray[np.float64]

# Steps of the power iteration towards the worst-known direction: it need not be found well, for all bad ones borrow.
_STEPS = 8
# Directions of the noise in r of which what other r and V make is taken off, where it may matter: few carry nearly all.
_CARRYING = 12
_MATTERS = 0.25


def borrowed_share(
    problem: Problem,
    designs: list[sp.csr_array],
    summed: Moments,
    known: Information,
    bound: Bound,
    transport: Array,
    source: Array,
    *,
    sigma: float,
    groups: Groups,
) -> float:
    """What noise adds to the information along the worst-known direction of V, over all that is found there.

    Parameters
    ----------
    designs, summed:
        T_1 .. T_M (P, K), and the moments of the films on them.
    known, bound:
        The information at (r, V), and the bound that it gives.
    transport, source:
        F (P, M) and V (M, B).
    sigma:
        Standard deviation of the noise in units of the weights.
    """
    elements, realisations = source.shape
    coupled, covariance = known.coupled.reshape(realisations * elements, -1), bound.coefficients
    scales = groups.patterns(source).reshape(len(groups), -1)
    scales /= np.maximum(np.linalg.norm(scales, axis=1, keepdims=True), 1e-300)
    dr, variance = np.random.default_rng(0).standard_normal(coupled.shape[1]), 0.0
    for _ in range(_STEPS):
        before = dr / max(float(np.linalg.norm(dr)), 1e-300)
        dr = covariance @ (coupled.T @ _freed(coupled @ before, scales))
        variance = float(before @ dr)
    dv = _freed(coupled @ dr, scales)
    if not (variance > 0 and np.any(dv)):
        return 0.0
    own = float(dv @ dv) / variance
    dv = dv.reshape(realisations, elements)
    beside = summed.gram_of_source(dv)[np.ix_(known.seen, known.seen)]
    unit = sigma**2 / own
    share = float(unit * np.sum(beside * covariance))
    if share < _MATTERS:
        return share
    # Noise in r by direction, the one that adds most first; of the first few what other r and V make of it is taken off.
    level, turned = np.linalg.eigh(covariance)
    root = turned * np.sqrt(np.maximum(level, 0.0))
    adds, mixed = np.linalg.eigh(root.T @ beside @ root)
    noises = (root @ mixed[:, ::-1])[:, :_CARRYING].T
    rest = float(np.sum(adds[: max(0, adds.size - _CARRYING)]))
    return unit * (
        rest + sum(_beyond(problem, designs, known, covariance, transport, source, noise, dv) for noise in noises)
    )


def _freed(dv: Array, scales: Array) -> Array:
    """dV (B M,) without its parts along the scales, (G, B M) of unit length."""
    return np.asarray(dv - scales.T @ (scales @ dv))


def _beyond(
    problem: Problem,
    designs: list[sp.csr_array],
    known: Information,
    covariance: Array,
    transport: Array,
    source: Array,
    noise: Array,
    dv: Array,
) -> float:
    """The square of sum_i T_i dr dV_i for a noise dr in r, in units of the weights, that no change of r and V makes."""
    whole = np.zeros(known.seen.size)
    whole[known.seen] = noise
    films = np.stack([t @ whole for t in designs], axis=1) @ dv.T
    weighted = problem.fit_weights * films
    by_v = transport.T @ weighted  # F^T W b of each realisation
    made = np.einsum("bij,jb->ib", known.inverse, by_v)
    by_r = sum(t.T @ (weighted @ v) for t, v in zip(designs, source, strict=True))[known.seen]
    by_r -= np.einsum("bik,ib->k", known.coupled, by_v)
    return max(0.0, float(np.sum(weighted * films) - np.sum(by_v * made) - by_r @ covariance @ by_r))
