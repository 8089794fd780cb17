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
from numpy.typing import NDArray

from wallmirror.derendering.knots import Level
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import transport_of
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

# A share of borrowed information of a third makes bars a fifth too small. And bars below which none lies behind them, as noise
# in the few hundred numbers that r has makes bars of per cents, whatever its strength.
_THIRD, _TELLING = 1 / 3, 3e-3
# Steps of the power iteration towards the worst-known direction: it need not be found well, for all bad ones borrow.
_STEPS = 8
# Directions of the noise in r of which what other r and V make is taken off, where it may matter: few carry nearly all.
_CARRYING = 12
_MATTERS = 0.25
_BORROWED = (
    "a third or more of what the captures seem to tell of the worst-known side of the pattern is the noise in the BRDF that "
    "was found, so its error bars are too small; use views or a card whose reflections share more angles"
)


def doubts_of_borrowing(problem: Problem, level: Level, sigma: float) -> tuple[str, ...]:
    """What has to be said of a fit whose knowledge of some direction of V is in part the noise in r.

    Parameters
    ----------
    sigma:
        Standard deviation of the noise in units of the weights.

    Raises
    ------
    UndeterminedError
        If all that seems to be known of some direction of V is borrowed.
    """
    if sigma * level.bound.source_error <= _TELLING:
        return ()
    share = borrowed_share(problem, level, sigma)
    if share >= 1:
        raise UndeterminedError(
            "what the captures seem to tell of the pattern is the noise in the BRDF that was found: of a wall without that "
            "noise they would not tell it; use views or a card whose reflections share more angles"
        )
    return (_BORROWED,) if share > _THIRD else ()


def borrowed_share(problem: Problem, level: Level, sigma: float) -> float:
    """What noise of standard deviation sigma adds to the information along the worst-known direction of V, over all there."""
    known, covariance = level.information, level.bound.coefficients
    dr, variance = np.random.default_rng(0).standard_normal(len(covariance)), 0.0
    for _ in range(_STEPS):
        before = dr / max(float(np.linalg.norm(dr)), 1e-300)
        dr = covariance @ np.tensordot(_following(level, before).T, known.coupled, axes=2)
        variance = float(before @ dr)
    dv = _following(level, dr)
    if not (variance > 0 and np.any(dv)):
        return 0.0
    own = float(np.sum(dv * dv)) / variance
    beside = level.summed.gram_of_source(dv.T)[np.ix_(known.seen, known.seen)]
    unit = sigma**2 / own
    share = float(unit * np.sum(beside * covariance))
    if share < _MATTERS:
        return share
    # Noise in r by direction, the one that adds most first; of the first few what other r and V make of it is taken off.
    values, turned = np.linalg.eigh(covariance)
    root = turned * np.sqrt(np.maximum(values, 0.0))
    adds, mixed = np.linalg.eigh(root.T @ beside @ root)
    noises = (root @ mixed[:, ::-1])[:, :_CARRYING].T
    rest = float(np.sum(adds[: max(0, adds.size - _CARRYING)]))
    transport = transport_of(level.designs, level.fit.coefficients)
    return unit * (rest + sum(_beyond(problem, level, transport, noise, dv) for noise in noises))


def _following(level: Level, dr: Array) -> Array:
    """-dV (M, B), without the scales, by which the best V follows a change dr (K',) of the seen coefficients."""
    return level.groups.freed(np.tensordot(level.information.coupled, dr, axes=1).T, level.fit.source)


def _beyond(problem: Problem, level: Level, transport: Array, noise: Array, dv: Array) -> float:
    """The square of sum_i T_i dr dV_i for a noise dr in r, in units of the weights, that no change of r and V makes."""
    known, designs = level.information, level.designs
    whole = np.zeros(known.seen.size)
    whole[known.seen] = noise
    films = transport_of(designs, whole) @ dv
    weighted = problem.fit_weights * films
    by_v = transport.T @ weighted  # F^T W b of each realisation
    made = np.einsum("bij,jb->ib", known.inverse, by_v)
    by_r = sum(t.T @ (weighted @ v) for t, v in zip(designs, level.fit.source, strict=True))[known.seen]
    by_r -= np.einsum("bik,ib->k", known.coupled, by_v)
    return max(0.0, float(np.sum(weighted * films) - np.sum(by_v * made) - by_r @ level.bound.coefficients @ by_r))
