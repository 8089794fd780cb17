"""The climb over knot spacings: from one on to finer ones while these pay, or down to coarser ones while these do.

Whether knots pay is told without a fit on them where a fit would be dear (`finer`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.finer import Films, Finer, loss, score, worth
from wallmirror.derendering.information import information
from wallmirror.derendering.ladder import SPARE, Ladder
from wallmirror.derendering.light import Lit, Missed, missed_in_the_light
from wallmirror.derendering.likelihood import ROUGH, Fit, maximise
from wallmirror.derendering.splines import transport_of
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


@dataclass(frozen=True)
class Other:
    """Pattern (M, B) and misfit on knots beside the chosen ones."""

    source: Array
    objective: float


@dataclass(frozen=True)
class Start:
    """Where a climb begins: index of the knots, and r (K,) on them with its V (M, B); the closed form's if left out."""

    index: int
    coefficients: Array | None = None
    source: Array | None = None


def climb(
    ladder: Ladder, start: Start, nonnegative: bool, tolerance: float | None, tell: Tell
) -> tuple[dict[int, Fit], Other | None]:
    """The free fits on the knots taken, by index, and what finer ones that were not would make of the last."""
    climber, begin = _Climber(ladder, nonnegative, tell), start.index
    ladder.summed(begin)  # of which the closed form makes use
    r, source = start.coefficients, start.source
    if r is None or source is None:
        r, source = ladder.closed(begin).coefficients, ladder.closed(begin).source
    first = None
    if nonnegative and ladder.space.rank == ladder.problem.card.elements:
        with suppress(UndeterminedError):  # where the bounds leave no light to tell the elements apart by
            first = climber.fit(begin, r, ladder.begun(begin, source).coefficients)
    first = climber.fit(begin, r) if first is None else first
    index, best, rival = climber.down(begin, first)
    if rival is not None:
        return {index: best}, rival
    return climber.up(index, best, tolerance)


@dataclass(frozen=True)
class _Climber:
    """The fits and tests of a climb, and what was missed in the light by the knots before those of an index."""

    ladder: Ladder
    nonnegative: bool
    tell: Tell
    missed: dict[int, Missed] = field(default_factory=dict)

    def fit(self, index: int, *starts: Array) -> Fit:
        """The free fit, as near to its maximum as knots are compared at."""
        found = maximise(self.ladder.summed(index), *starts, nonnegative=False, tolerance=ROUGH, held=True)
        self.tell(f"{self._knots(index)}: misfit {found.objective:.6g}")
        return found

    def down(self, index: int, best: Fit) -> tuple[int, Fit, Other | None]:
        """The coarsest knots that lose nothing, with their fit, and what finer ones would make of it."""
        ladder, rival = self.ladder, None
        finer_fits: dict[int, Fit] = {}
        while index > 0 and (foretold := self._coarser(index, best)) is not None:
            nearest, lost = foretold
            narrow = self.nonnegative and index >= ladder.last - 1
            pays = self._lit_pays(index, best, lost) if narrow else False
            if pays:
                break
            finer_fits[index] = best
            coarser = self.fit(index - 1, nearest, ladder.coarsened(index, best.coefficients))
            if coarser.objective - best.objective > _HOPELESS * ladder.price(index - 1, index, best):
                # So much was not foretold: what is nearest where the captures look led to another maximum.
                again = self.fit(index - 1, ladder.closed(index - 1).coefficients)
                coarser = min(coarser, again, key=lambda each: each.objective)
            # Against each of the finer ones: steps of which none loses much may lose much together.
            losses = ((finer, each, coarser.objective - each.objective) for finer, each in finer_fits.items())
            if any(loss >= ladder.price(index - 1, finer, each) for finer, each, loss in losses):
                break
            if pays is None and self._in_the_light(index - 1, coarser, index) is not None:
                break
            rival = Other(best.source, best.objective)
            index, best = index - 1, coarser
        return index, best, rival

    def up(self, index: int, best: Fit, tolerance: float | None) -> tuple[dict[int, Fit], Other | None]:
        """The fits on knots from these on that pay, and what finer ones that do not would make of the last."""
        ladder, fits, idle = self.ladder, {index: best}, 0
        rival: Other | None = None
        for finer in range(index + 1, ladder.last + 1):
            if ladder.spare(finer) < SPARE:
                break  # nearly as many coefficients as data follow whatever the model misses
            try:
                trial, other = self._finer(index, best, finer)
            except UndeterminedError:
                break  # so fine a grid has cells that nothing determines
            if trial is not None:
                moved = scale_free_error(best.source, trial.source)
                index, best, rival, idle = finer, trial, None, 0
                fits[index] = best
                if tolerance is not None and self._at_the_noise(index, best) and moved <= _SETTLED * tolerance:
                    self.tell(f"the pattern moved by {moved:.1e} only: knots are fine enough for {tolerance:g}")
                    break
                continue
            rival = rival or other
            # One idle halving ends the search, unless the noise is known and not yet reached.
            idle += 1
            if idle == 2 or not ladder.problem.noise_is_stated or self._at_the_noise(index, best):
                break
        return fits, rival

    def _coarser(self, index: int, fit: Fit) -> tuple[Array, float] | None:
        """The next coarser knots' r that is foretold to be their best, and its loss; None if that is too much for a fit."""
        ladder, summed = self.ladder, self.ladder.summed(index)
        halved = sp.csr_array(ladder.grids[index - 1].in_halved()[summed.seen])
        schur = information(summed, fit.coefficients, fit.source).schur if fit.schur is None else fit.schur
        pull = np.einsum("ib,bik->k", fit.source, summed.cross)[summed.seen]
        lost, nearest = loss(schur, fit.coefficients[summed.seen], pull, halved)
        freedom = ladder.freedom(index)
        saved = max(1, halved.shape[0] - int(np.count_nonzero(halved.sum(axis=0))))
        many = _POOR if lost < _SMALL * float(np.sum(summed.energy)) else _HOPELESS
        if lost < many * worth(saved, freedom) * ladder.variance(fit.objective, freedom):
            return nearest, lost
        self.tell(f"{self._knots(index - 1)} would raise it by about {lost:.4g}")
        return None

    def _finer(self, index: int, best: Fit, finer: int) -> tuple[Fit | None, Other]:
        """The fit on finer knots if these pay, and what they would make of the best one so far.

        Where rho >= 0 leaves most of the angles dark, it is enough if finer knots pay in the lit ones, where their error lies.
        """
        ladder = self.ladder
        start = ladder.refined(index, best.coefficients, finer)
        tried: Fit | None = None
        if finer < ladder.last - 1 or ladder.holds(finer):  # to try is no dearer than to tell
            tried = self.fit(finer, start)
            taken, other = self._paying(index, best, finer, tried)
            if taken is not None or finer < ladder.last - 1:
                return taken, other
        else:
            every = np.ones(start.size, dtype=bool)
            found, price = self._tested(index, best, finer, every, ladder.seen(index))
            if found.gain >= price:
                return self._paying(index, best, finer, self.fit(finer, start + found.step, start))
            other = self._stepped(finer, start + found.step)
        if not self.nonnegative:
            return None, other
        pays = None
        if tried is not None and finer == index + 1:
            pays = self._lit_pays(finer, tried, best.objective - tried.objective)
        if pays is None:
            lit = self._in_the_light(index, best, finer)
            taken = None if lit is None else tried or self.fit(finer, start + lit.step, start)
        else:
            taken = tried if pays else None
        return taken, other if taken is None else Other(taken.source, taken.objective)

    def _in_the_light(self, index: int, best: Fit, finer: int) -> Finer | None:
        """What finer knots gain where rho >= 0 is lit, if it leaves most of the angles dark and the gain is worth them."""
        within = self.ladder.bounded(index, best)
        lit = Lit.of(self.ladder, index, within.coefficients, finer)
        if lit is None:
            return None
        missed = self.missed.get(index) if finer == index + 1 else None
        if missed is not None and missed.foretells_nothing(int(np.count_nonzero(lit.fine)) - lit.used):
            return None
        found, price = self._tested(index, within, finer, lit.fine, lit.used)
        return found if found.gain >= price else None

    def _lit_pays(self, index: int, fit: Fit, lost: float) -> bool | None:
        """Whether the knots before those of a free fit miss more in the light than noise makes of it.

        None if that cannot be told, as no rho >= 0 was found on them that comes near: within the bounds they miss no more
        than without, which is `lost`.
        """
        ladder = self.ladder
        missed = missed_in_the_light(ladder, index, fit)
        if missed is None:
            return False
        if missed.rise * ladder.variance(fit.objective, missed.freedom) > lost:
            return None
        self.missed[index] = missed
        noise = f"of which noise makes up to {missed.price:.4g}"
        self.tell(f"{self._knots(index - 1)} miss {missed.loss:.4g} in the light, {noise}")
        return missed.loss >= missed.price

    def _paying(self, index: int, best: Fit, finer: int, trial: Fit) -> tuple[Fit | None, Other]:
        """The fit on finer knots if it explains more than noise would let it."""
        price = self.ladder.price(index, finer, trial)
        return (trial if best.objective - trial.objective >= price else None), Other(trial.source, trial.objective)

    def _tested(self, index: int, fit: Fit, finer: int, free: NDArray[np.bool_], used: int) -> tuple[Finer, float]:
        """What finer knots gain and what they must, for coefficients free to move where `used` of the coarser were."""
        ladder, problem = self.ladder, self.ladder.problem
        transport = transport_of(ladder.designs(index), fit.coefficients)
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
        lit = "" if np.all(free) else f" with {found.free} lit coefficients"
        self.tell(f"{self._knots(finer)} would lower it by {found.gain:.4g}{lit}, noise by up to {price:.4g}")
        return found, price

    def _stepped(self, index: int, r: Array) -> Other:
        """Pattern and misfit at given coefficients, without a fit."""
        problem = self.ladder.problem
        transport = transport_of(self.ladder.designs(index), r)
        films = Films(problem.data, problem.fit_weights, transport, np.zeros((transport.shape[1], 1)))
        source = films.solved(films.data)
        return Other(source, Films(films.data, films.weights, transport, source).objective())

    def _at_the_noise(self, index: int, fit: Fit) -> bool:
        """Whether the misfit is what the stated noise makes."""
        observations = self.ladder.summed(index).observations
        return self.ladder.problem.noise_is_stated and fit.objective < observations + 4 * math.sqrt(2 * observations)

    def _knots(self, index: int) -> str:
        return f"knots every {math.degrees(self.ladder.grids[index].step):g} deg"
