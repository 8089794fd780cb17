"""The knots that the data choose: the fit on each spacing, and when a finer one pays.

The free maximum of the likelihood on nested grids (`ladder`) chooses (`climbing`). Bounds are imposed on the knots that were
chosen, and may send them back to coarser ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound, bound_of
from wallmirror.derendering.climbing import Other, Start, Tell, climb
from wallmirror.derendering.finer import worth
from wallmirror.derendering.groups import Groups
from wallmirror.derendering.information import Information, information
from wallmirror.derendering.ladder import SPARE, Ladder
from wallmirror.derendering.likelihood import Fit, finished
from wallmirror.derendering.moments import Moments
from wallmirror.derendering.pattern_space import expected_mismatch, too_few_patterns
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

# A mismatch in units of what noise makes of it, beyond which knots are too coarse to be fitted; the share of it below
# which the gap says that they are too fine; the share of it that finer knots leave if it is not for the knots; and the closed
# form's own error up to which it is a start.
_FAR_OFF = 2.0
_ALIKE = 0.9
_GAP = 1.0
_START = 1.0
# How many times what noise would pay for the next finer knots' coefficients must be foretold of them for the coarser ones not
# to be fitted first: those cost a quarter, and are the better start.
_SURELY = 3.0
# The same where rho >= 0 may leave all angles dark but for a few, in which finer knots need pay alone.
_PERHAPS = 0.1


@dataclass(frozen=True)
class Level:
    """A knot spacing with the best fit on it.

    Parameters
    ----------
    free, fit:
        The maxima of the likelihood without bounds and with those that were asked for.
    groups:
        Of elements that share no coefficient; the fit has each in a scale of its own.
    strained:
        Whether the bounds cost the fit more than noise explains.
    """

    grid: SplineGrid
    designs: list[sp.csr_array]
    summed: Moments
    closed: ClosedForm
    free: Fit
    fit: Fit
    groups: Groups
    strained: bool

    @property
    def parameters(self) -> int:
        """How many coefficients the fit uses."""
        return int(np.count_nonzero(self.fit.coefficients))

    @cached_property
    def peak_at(self) -> float:
        """Angle sum in radians at which the well-seen part of rho is largest."""
        return self.grid.peak(self.fit.coefficients, self.summed.exposure)

    @cached_property
    def information(self) -> Information:
        """The Fisher information at the fit, in units of the weights."""
        return information(self.summed, self.fit.coefficients, self.fit.source, self.fit.schur)

    @cached_property
    def bound(self) -> Bound:
        """The Cramer-Rao bound at the fit, for noise of unit variance in units of the weights."""
        return self._bound_of(self.information, self.fit.source)

    def bound_at(self, source: Array) -> Bound:
        """The bound at the fit's rho and another V, shape (M, B)."""
        return self._bound_of(information(self.summed, self.fit.coefficients, source), source)

    def _bound_of(self, known: Information, source: Array) -> Bound:
        if len(self.groups) == 1:
            gauge = self.grid.row(self.peak_at)
            return bound_of(known, coefficients=self.fit.coefficients, source=source, gauge=gauge)
        gauges = self.groups.gauges(self.grid, self.fit.coefficients, self.summed.exposure)
        return bound_of(known, coefficients=self.fit.coefficients, source=source, gauge=gauges, groups=self.groups)


@dataclass(frozen=True)
class Refined:
    """The level that the data chose, and what finer knots that did not pay and the coarser ones before would make of it."""

    level: Level
    rival: Other | None
    before: Other | None


def refine(
    problem: Problem,
    space: SignalSpace,
    steps: tuple[float, ...],
    *,
    nonnegative: bool,
    tolerance: float | None = None,
    tell: Tell,
) -> Refined:
    """Find the knot spacing that pays, and go back where the bound says that nothing determines so fine a one.

    Parameters
    ----------
    steps:
        Knot spacings in degrees, each half of the one before, or a single one.
    tolerance:
        Relative error of the pattern that is good enough, as in `solve_noisy`.

    Raises
    ------
    UndeterminedError
        If fewer patterns than elements stand out of the noise, or no knots are coarse enough to be determined.
    """
    ladder = Ladder.of(problem, space, steps, tolerance)
    start = _first_worth_a_fit(ladder, nonnegative)
    while True:
        begin = start.index
        try:
            fits, rival = climb(ladder, start, nonnegative, tolerance, tell)
        except UndeterminedError:
            if begin == 0 and space.rank < problem.card.elements:
                raise too_few_patterns(space.rank, problem.card.elements) from None
            if begin == 0:
                raise
            fits, rival = {}, None
        # Knots so fine that some cells are determined by nothing: those before them explain nearly as much.
        while fits:
            index = max(fits)
            free = fits.pop(index)
            if nonnegative:
                index, free = ladder.as_fine_as_the_bounds_want(index, free)
            level = _level(ladder, index, free, nonnegative)
            if level is not None:
                before = fits[max(fits)] if fits else None
                return Refined(level, rival, None if before is None else Other(before.source, before.objective))
            rival = None
        if begin == 0:
            break
        start = Start(begin - 1)
    if space.rank < problem.card.elements:
        raise too_few_patterns(space.rank, problem.card.elements)
    raise UndeterminedError(
        "the captures leave the pattern undetermined on the coarsest knots already; capture more light, views or patterns"
    )


def _level(ladder: Ladder, index: int, free: Fit, nonnegative: bool) -> Level | None:
    """The fit within the bounds asked for, or None where its error bars say that nothing determines it."""
    summed = ladder.summed(index)
    fit = ladder.bounded(index, free) if nonnegative else finished(summed, free)
    grid, groups = ladder.grids[index], ladder.groups(index)
    if len(groups) > 1:
        fit = groups.scaled(fit, grid, summed.exposure)
    strained = nonnegative and not ladder.agrees(index, free, fit)
    level = Level(grid, ladder.designs(index), summed, ladder.closed(index), free, fit, groups, strained)
    return level if math.isfinite(level.bound.source_error) else None


def _first_worth_a_fit(ladder: Ladder, nonnegative: bool) -> Start:
    """The knots whose closed form misses the data's space by about what noise makes it miss, and is a start.

    Coarser ones are far from explaining the films, and a fit on them would only be a start for the next. Where finer ones
    miss as much, it is not for the knots; where none comes near, or the noise is not known, the search begins with the
    coarsest. Mismatches as a whole do not show a spline's error that a fit would: that is foretold from the detail of rho.
    """
    if ladder.space.rank < ladder.problem.card.elements:
        return Start(0)
    index = max(0, ladder.last - 2)
    excess = _excess_of_detail(ladder, index + 1)
    if not math.isnan(excess):
        closed = ladder.closed(index + 1)
        if not closed.mismatch > _FAR_OFF * expected_mismatch(ladder.problem, ladder.space, closed) and _starts(closed):
            if excess > (_PERHAPS if nonnegative else _SURELY):
                return Start(index + 1)
            return Start(index, ladder.coarsened(index + 1, closed.coefficients), closed.source)
    ladder.summed(index)  # which nearly every search asks for, and of which the closed form makes use
    closed = ladder.closed(index)
    expected = expected_mismatch(ladder.problem, ladder.space, closed)
    if math.isnan(expected):
        return Start(0)
    if not closed.mismatch > _FAR_OFF * expected:
        return Start(index if _starts(closed) else 0)
    for finer in range(index + 1, ladder.last + 1):
        if closed.gap < _GAP * closed.mismatch:
            break
        coarser, closed = closed, ladder.closed(finer)
        if not closed.mismatch > _FAR_OFF * expected_mismatch(ladder.problem, ladder.space, closed):
            return Start(finer)
        if closed.mismatch > _ALIKE * coarser.mismatch:
            return Start(finer - 1 if coarser.error < _START else 0)
    return Start(0)


def _starts(closed: ClosedForm) -> bool:
    """Whether a closed form whose mismatch is noise is near enough to the answer for a fit to begin there."""
    return closed.gap > _GAP * closed.mismatch and closed.error < _START


def _excess_of_detail(ladder: Ladder, index: int) -> float:
    """The misfit of knots twice as far apart, for their splines' sake, over what noise would pay for these beyond the mean.

    NaN where the noise is not known, or drowns all detail without a look.
    """
    problem = ladder.problem
    if index < 2 or index == ladder.last or not problem.noise_is_stated or ladder.spare(index) < SPARE:
        return math.nan
    grid, coarser = ladder.grids[index], ladder.grids[index - 1]

    def excess(added: int) -> float:
        return worth(added, problem.data.size) - added

    # No more than all of the films can be detail. Where rho >= 0 leaves all angles dark but for one lobe, it need pay there
    # alone.
    if ladder.foretold(index, float(np.sum(problem.fit_weights * problem.data**2))) < excess(grid.degree + 1):
        return math.nan
    try:
        ladder.summed(index)  # from which those of coarser knots follow, whichever the search begins with
    except InputError:  # the memory does not hold them
        return math.nan
    return ladder.foretold(index, ladder.detail(index)) / excess(grid.size - coarser.size)
