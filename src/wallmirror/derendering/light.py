"""Where rho >= 0 is lit: whether finer knots pay there, if the bounds leave most of the angles dark.

Noise pays for every coefficient that finer knots add, but dark ones have nothing to add: it is enough if the lit ones pay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.convex import solve_positive
from wallmirror.derendering.finer import worth
from wallmirror.derendering.information import point_at, score_of
from wallmirror.derendering.ladder import Ladder
from wallmirror.derendering.likelihood import Fit, best_nonnegative

Array = NDArray[np.float64]

# Share of the BRDF's largest coefficient above which one is lit, of the best-seen one's information above which that one
# counts, and of lit coefficients up to which rho is sparse.
_LIT = 0.01
_WELL_SEEN = 1e-3
_SPARSE = 0.5
# Share of the squared error of splines that halving their knots leaves at most, where rho has kinks but no jumps.
_KINK = 1 / 8
_RIDGE = 1e-10


@dataclass(frozen=True)
class Lit:
    """The lit coefficients of a rho >= 0, and those of the next finer knots (or the ones after) that have a part in them.

    Parameters
    ----------
    coarse, fine:
        Shapes (K,) and (K',).
    """

    coarse: NDArray[np.bool_]
    fine: NDArray[np.bool_]

    @classmethod
    def of(cls, ladder: Ladder, index: int, r: Array, finer: int) -> Lit | None:
        """Of r (K,) on one of the ladder's knots; None where they are not sparse."""
        coarse = r > _LIT * float(np.max(r[ladder.exposure(index) > _WELL_SEEN]))
        fine = ladder.refined(index, coarse.astype(np.float64), finer) > 0
        return None if np.count_nonzero(fine) >= _SPARSE * fine.size else cls(coarse, fine)

    @property
    def used(self) -> int:
        """How many coarse ones there are."""
        return int(np.count_nonzero(self.coarse))


@dataclass(frozen=True)
class Missed:
    """What coarser knots miss in the light, where the next finer ones are fitted.

    Parameters
    ----------
    loss:
        What the finer ones would gain there, in units of the noise, but no more than at all angles.
    rise:
        By how much the misfit is higher on the coarser knots at all angles, at most.
    added:
        How many coefficients the finer knots have more.
    freedom:
        Data that are left over to tell the noise by.
    """

    loss: float
    rise: float
    added: int
    freedom: int

    @property
    def price(self) -> float:
        """What noise alone lets the loss be in 1 % of cases."""
        return worth(self.added, self.freedom)

    def foretells_nothing(self, added: int) -> bool:
        """Whether so many coefficients of knots twice as fine again can hardly gain more than noise lets them.

        What is missed beyond the noise is the splines' own error, which falls with each halving; they may miss more than they
        seem to by as much as noise makes of it.
        """
        own = max(0.0, self.loss - self.added) + (self.price - self.added)
        return _KINK * own < worth(added, self.freedom) - added


def missed_in_the_light(ladder: Ladder, finer: int, fit: Fit) -> Missed | None:
    """What the next coarser knots miss of the films where rho >= 0 is lit, and finer ones would gain.

    The score test of `finer` in the space of coefficients, from a rho >= 0 on the coarser knots that comes next to their
    maximum within the bounds: the best one for the V of that on the finer knots. None where most of the angles are lit.

    Parameters
    ----------
    finer, fit:
        Index of the finer knots, and the free fit on them.
    """
    summed, halved = ladder.summed(finer), ladder.grids[finer - 1].in_halved()
    if Lit.of(ladder, finer - 1, best_nonnegative(summed, fit.source, halved), finer) is None:
        return None  # told before a fit within the bounds
    within = ladder.bounded(finer, fit)
    coarse = best_nonnegative(summed, within.source, halved)
    lit = Lit.of(ladder, finer - 1, coarse, finer)
    if lit is None:
        return None
    point = point_at(summed, halved @ coarse, nonnegative=True)
    cells = np.flatnonzero(lit.fine & summed.seen)
    schur, pull = score_of(summed, point, cells)
    schur[np.diag_indices_from(schur)] += _RIDGE * np.trace(schur) / max(1, cells.size)
    own = halved[cells][:, lit.coarse]
    # Less what is left to gain on the coarser knots themselves.
    gain = _gain(schur, pull) - _gain(own.T @ schur @ own, own.T @ pull)
    freedom = ladder.freedom(finer)
    unit = ladder.variance(fit.objective, freedom)
    rise = (point.objective - within.objective) / unit
    return Missed(min(gain / unit, rise), rise, max(1, cells.size - lit.used), freedom)


def _gain(curvature: Array, pull: Array) -> float:
    """The fall of the misfit that a Newton step promises."""
    return float(pull @ solve_positive(curvature, pull))
