"""The climb over knot spacings: from one on to finer ones while these pay, or down to coarser ones while these do.

Whether knots pay is told without a fit on them where a fit would be dear (`finer`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.finer import Films, Finer, loss, score, worth
from wallmirror.derendering.information import information, schur_on
from wallmirror.derendering.ladder import SPARE, Ladder
from wallmirror.derendering.likelihood import Fit, best_nonnegative, maximise
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]
Tell = Callable[[str], None]

# Share of a tolerance below which a move of the pattern is none.
_SETTLED = 0.25
# So many times more than noise explains must coarser knots lose by a quadratic guess for no fit to be tried on them: of a
# change of the films that is no small share of their power, and of a smaller one, for which the guess is good: of 1500 such
# losses of random scenes none was guessed by more than 8 % too high, nor by more than 3 % near what noise explains.
_HOPELESS, _POOR = 20.0, 1.1
_SMALL = 1e-4
# Share of the BRDF's largest coefficient above which one is lit, of the best-seen one's information above which that one
# counts, and of lit coefficients up to which rho is sparse.
_LIT = 0.01
_WELL_SEEN = 1e-3
_SPARSE = 0.5


@dataclass(frozen=True)
class Other:
    """Pattern (M, B) and misfit on knots beside the chosen ones."""

    source: Array
    objective: float


def climb(
    ladder: Ladder, begin: int, start: Array | None, nonnegative: bool, tolerance: float | None, tell: Tell
) -> tuple[dict[int, Fit], Other | None]:
    """The free fits on the knots taken, by index, and what finer ones that were not would make of the last.

    Parameters
    ----------
    begin, start:
        Index of the first knots to be fitted, and the r to start from, shape (K,), if not the closed form's.
    """

    def fit(index: int, *starts: Array) -> Fit:
        found = maximise(ladder.summed(index), *starts, nonnegative=False, rough=True)
        tell(f"knots every {math.degrees(ladder.grids[index].step):g} deg: misfit {found.objective:.6g}")
        return found

    index = begin
    ladder.summed(index)  # of which the closed form makes use
    best = fit(index, ladder.closed(index).coefficients if start is None else start)
    rival: Other | None = None
    finer_fits: dict[int, Fit] = {}
    while index > 0 and (foretold := _coarser(ladder, index, best, tell)) is not None:
        finer_fits[index] = best
        coarser = fit(index - 1, foretold, ladder.coarsened(index, best.coefficients))
        if coarser.objective - best.objective > _HOPELESS * ladder.price(index - 1, index, best):
            # So much was not foretold: what is nearest where the captures look led to another maximum.
            again = fit(index - 1, ladder.closed(index - 1).coefficients)
            coarser = min(coarser, again, key=lambda each: each.objective)
        # Against each of the finer ones: steps of which none loses much may lose much together.
        losses = ((finer, each, coarser.objective - each.objective) for finer, each in finer_fits.items())
        if any(loss >= ladder.price(index - 1, finer, each) for finer, each, loss in losses):
            break
        if nonnegative and index >= ladder.last - 1 and _missed_in_the_light(ladder, index - 1, coarser, best, tell):
            break
        rival = Other(best.source, best.objective)
        index, best = index - 1, coarser
    fits = {index: best}
    if rival is not None:
        return fits, rival
    idle = 0
    for finer in range(index + 1, ladder.last + 1):
        if ladder.spare(finer) < SPARE:
            break  # nearly as many coefficients as data follow whatever the model misses
        try:
            trial, other = _finer(ladder, index, best, finer, nonnegative, fit, tell)
        except UndeterminedError:
            break  # so fine a grid has cells that nothing determines
        if trial is not None:
            moved = scale_free_error(best.source, trial.source)
            index, best, rival, idle = finer, trial, None, 0
            fits[index] = best
            if tolerance is not None and _at_the_noise(ladder, index, best) and moved <= _SETTLED * tolerance:
                tell(f"the pattern moved by {moved:.1e} only: knots are fine enough for {tolerance:g}")
                break
            continue
        rival = rival or other
        # One idle halving ends the search, unless the noise is known and not yet reached.
        idle += 1
        if idle == 2 or not ladder.problem.noise_is_stated or _at_the_noise(ladder, index, best):
            break
    return fits, rival


def _coarser(ladder: Ladder, index: int, fit: Fit, tell: Tell) -> Array | None:
    """The next coarser knots' r that is foretold to be their best; None if it misses so much that no fit is called for."""
    summed = ladder.summed(index)
    halved = sp.csr_array(ladder.grids[index - 1].in_halved()[summed.seen])
    schur = information(summed, fit.coefficients, fit.source).schur if fit.schur is None else fit.schur
    pull = np.einsum("ib,bik->k", fit.source, summed.cross)[summed.seen]
    lost, nearest = loss(schur, fit.coefficients[summed.seen], pull, halved)
    freedom = ladder.freedom(index)
    saved = max(1, halved.shape[0] - int(np.count_nonzero(halved.sum(axis=0))))
    many = _POOR if lost < _SMALL * float(np.sum(summed.energy)) else _HOPELESS
    if lost < many * worth(saved, freedom) * ladder.variance(fit.objective, freedom):
        return nearest
    tell(f"knots every {math.degrees(ladder.grids[index - 1].step):g} deg would raise it by about {lost:.4g}")
    return None


def _at_the_noise(ladder: Ladder, index: int, fit: Fit) -> bool:
    """Whether the misfit is what the stated noise makes."""
    observations = ladder.summed(index).observations
    return ladder.problem.noise_is_stated and fit.objective < observations + 4 * math.sqrt(2 * observations)


def _finer(
    ladder: Ladder, index: int, best: Fit, finer: int, nonnegative: bool, fit: Callable[..., Fit], tell: Tell
) -> tuple[Fit | None, Other]:
    """The fit on finer knots if these pay, and what they would make of the best one so far.

    Where rho >= 0 leaves most of the angles dark, it is enough if finer knots pay in the lit ones, where their error lies.
    """
    start = ladder.refined(index, best.coefficients, finer)
    tried: Fit | None = None
    if finer < ladder.last - 1 or ladder.holds(finer):  # to try is no dearer than to tell
        tried = fit(finer, start)
        taken, other = _paying(ladder, index, best, finer, tried)
        if taken is not None or finer < ladder.last - 1:
            return taken, other
    else:
        every = np.ones(start.size, dtype=bool)
        found, price = _tested(ladder, index, best, finer, every, ladder.seen(index), tell)
        if found.gain >= price:
            return _paying(ladder, index, best, finer, fit(finer, start + found.step, start))
        other = _stepped(ladder, finer, start + found.step)
    if not nonnegative:
        return None, other
    if tried is None and (lit := _in_the_light(ladder, index, best, finer, tell)) is not None:
        tried = fit(finer, start + lit.step, start)
    elif tried is not None and not _missed_in_the_light(ladder, index, best, tried, tell):
        tried = None
    return tried, other if tried is None else Other(tried.source, tried.objective)


def _in_the_light(ladder: Ladder, index: int, best: Fit, finer: int, tell: Tell) -> Finer | None:
    """What finer knots gain where rho >= 0 is lit, if it leaves most of the angles dark and the gain is worth them."""
    within = ladder.bounded(index, best)
    lit = _lit(ladder, index, within.coefficients)
    free = ladder.refined(index, lit.astype(np.float64), finer) > 0
    if np.count_nonzero(free) >= _SPARSE * free.size:
        return None
    found, price = _tested(ladder, index, within, finer, free, int(np.count_nonzero(lit)), tell)
    return found if found.gain >= price else None


def _missed_in_the_light(ladder: Ladder, index: int, best: Fit, finer: Fit, tell: Tell) -> bool:
    """The same, told from the free fit on the next finer knots: whether the coarser ones miss too much of it in the light."""
    lit = _lit(ladder, index, best_nonnegative(ladder.summed(index), best.source))
    halved = ladder.grids[index].in_halved()
    free = halved @ lit.astype(np.float64) > 0
    if np.count_nonzero(free) >= _SPARSE * free.size:
        return False
    within, summed = ladder.bounded(index + 1, finer), ladder.summed(index + 1)
    cells = np.flatnonzero(free & summed.seen)
    schur = schur_on(summed, within.coefficients, within.source, cells)
    pull = np.einsum("ib,bik->k", within.source, summed.cross)[cells]
    missed, _ = loss(schur, within.coefficients[cells], pull, sp.csr_array(halved[cells][:, lit]))
    freedom = ladder.freedom(index + 1)
    price = worth(max(1, cells.size - int(np.count_nonzero(lit))), freedom) * ladder.variance(finer.objective, freedom)
    tell(
        f"knots every {math.degrees(ladder.grids[index].step):g} deg would raise it by {missed:.4g} in the light, noise by up "
        f"to {price:.4g}"
    )
    return missed >= price


def _lit(ladder: Ladder, index: int, r: Array) -> NDArray[np.bool_]:
    """Which coefficients of a rho >= 0 are lit, shape (K,)."""
    return np.asarray(r > _LIT * float(np.max(r[ladder.summed(index).exposure > _WELL_SEEN])))


def _paying(ladder: Ladder, index: int, best: Fit, finer: int, trial: Fit) -> tuple[Fit | None, Other]:
    """The fit on finer knots if it explains more than noise would let it."""
    price = ladder.price(index, finer, trial)
    return (trial if best.objective - trial.objective >= price else None), Other(trial.source, trial.objective)


def _tested(
    ladder: Ladder, index: int, fit: Fit, finer: int, free: NDArray[np.bool_], used: int, tell: Tell
) -> tuple[Finer, float]:
    """What finer knots gain and what they must, for coefficients that are free to move where `used` of the coarser were."""
    problem = ladder.problem
    transport = np.stack([t @ fit.coefficients for t in ladder.designs(index)], axis=1)
    films = Films(problem.data, problem.fit_weights, transport, fit.source)
    freedom = ladder.freedom(index) - used
    enough = worth(int(np.count_nonzero(free)), freedom) * ladder.variance(fit.objective, freedom)

    def price_of(moving: int, gain: float) -> float:
        return worth(max(1, moving - used), freedom) * ladder.variance(fit.objective - gain, freedom)

    found = score(
        films,
        ladder.designs(finer),
        ladder.smooth_band(finer),
        free,
        enough=enough,
        # From the maximum a search finds less with each step; from a fit that bounds hold elsewhere it may find most late.
        least=(lambda moving: price_of(moving, enough)) if np.all(free) else None,
    )
    price = price_of(found.free, found.gain)
    tell(
        f"knots every {math.degrees(ladder.grids[finer].step):g} deg would lower it by {found.gain:.4g}"
        + ("" if np.all(free) else f" with {found.free} lit coefficients")
        + f", noise by up to {price:.4g}"
    )
    return found, price


def _stepped(ladder: Ladder, index: int, r: Array) -> Other:
    """Pattern and misfit at given coefficients, without a fit."""
    transport = np.stack([t @ r for t in ladder.designs(index)], axis=1)
    films = Films(ladder.problem.data, ladder.problem.fit_weights, transport, np.zeros((transport.shape[1], 1)))
    source = films.solved(films.data)
    return Other(source, Films(films.data, films.weights, transport, source).objective())
