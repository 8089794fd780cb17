"""The nested grids of one problem, with the fits on each and what these need, made when first asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray

from wallmirror.derendering.finer import worth
from wallmirror.derendering.groups import Groups, closed_form_in_groups, groups_of
from wallmirror.derendering.likelihood import ROUGH, Fit, best_nonnegative, bounded, maximise
from wallmirror.derendering.moments import Moments
from wallmirror.derendering.nested import FINEST_QUADRATURE, Nested
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid, exposures, transport_of
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, banded_gram, closed_form, stack_of
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

#: Share of the data that finer knots must leave over.
SPARE = 0.25


@dataclass(frozen=True)
class Ladder:
    """What belongs to each of the grids by its index, coarsest first."""

    problem: Problem
    space: SignalSpace
    nested: Nested
    _summed: dict[int, Moments] = field(default_factory=dict)
    _bands: dict[int, Array] = field(default_factory=dict)
    _smooth_bands: dict[int, Array] = field(default_factory=dict)
    _groups: dict[int, Groups] = field(default_factory=dict)
    _closed: dict[int, ClosedForm] = field(default_factory=dict)
    _stacked: dict[int, Array] = field(default_factory=dict)
    _free: dict[int, Fit] = field(default_factory=dict)
    _begun: dict[int, Fit] = field(default_factory=dict)
    _bounded: dict[int, Fit] = field(default_factory=dict)

    @classmethod
    def of(cls, problem: Problem, space: SignalSpace, steps: tuple[float, ...], tolerance: float | None) -> Ladder:
        """Over the angle sums of a problem; one spacing in degrees, or several, each half of the one before."""
        return cls(problem, space, problem.nested(steps, _quadrature(problem, tolerance)))

    @property
    def grids(self) -> tuple[SplineGrid, ...]:
        """The grids."""
        return self.nested.grids

    @property
    def last(self) -> int:
        """Index of the finest grid."""
        return self.nested.last

    def designs(self, index: int) -> list[sp.csr_array]:
        """T_1 .. T_M, each sparse (P, K)."""
        return self.nested.designs(index)

    def summed(self, index: int) -> Moments:
        """What the likelihood needs of the data, and which coefficients have scales of their own."""
        if index not in self._summed:
            made, groups = self.nested.moments(index), self.groups(index)
            self._summed[index] = replace(made, apart=groups.cells) if len(groups) > 1 else made
        return self._summed[index]

    def holds(self, index: int) -> bool:
        """Whether `summed` takes no pass over the pixels any more."""
        return self.nested.holds(index)

    def exposure(self, index: int) -> Array:
        """How well each coefficient is seen, relative to the best-seen one, shape (K,)."""
        if index in self._summed or not self.holds(index + 1):
            return self.summed(index).exposure
        halved = self.grids[index].in_halved()
        seen = np.square(halved).T @ self.summed(index + 1).exposure
        return np.asarray(seen / seen.max())

    def closed(self, index: int) -> ClosedForm:
        """The closed form."""
        if index not in self._closed:
            problem, groups = self.problem, self.groups(index)
            if len(groups) > 1:
                weighted = problem.weighted(self.designs(index))
                made = closed_form_in_groups(problem.weighted_data, weighted, self.space, groups)
            else:
                at_hand = self.nested.designed(index) if self.holds(index) else index
                if at_hand not in self._stacked:
                    self._stacked[at_hand] = stack_of(self.designs(at_hand), self.space, problem.row_weights)
                made = closed_form(
                    problem.weighted_data,
                    self.designs(at_hand),
                    self.space,
                    row_weights=problem.row_weights,
                    band=self.band(index),
                    stacked=self._stacked[at_hand],
                    prolongation=self.nested.prolongation(index, at_hand) if at_hand > index else None,
                )
            self._closed[index] = made
        return self._closed[index]

    def groups(self, index: int) -> Groups:
        """The elements that share coefficients on these knots."""
        if index not in self._groups:
            finer = self.groups(index + 1) if index < self.last and self.nested.holds(index + 1) else None
            if finer is not None and len(finer) == 1:  # broader splines are shared by no fewer
                seen = self.grids[index].in_halved().T @ finer.cells.T.astype(np.float64) > 0
                self._groups[index] = Groups(finer.elements, seen.T)
            else:
                self._groups[index] = groups_of(self.designs(index))
        return self._groups[index]

    def band(self, index: int) -> Array:
        """Lower band of sum_i T_i^T W T_i."""
        if index not in self._bands:
            if index in self._summed and self.problem.fit_weights.shape[1] == 1:
                self._bands[index] = self._summed[index].pairs[0].band
            else:
                self._bands[index] = banded_gram(self.designs(index), self.problem.row_weights)
        return self._bands[index]

    def smooth_band(self, index: int) -> Array:
        """The same, if neighbouring angle sums were seen alike: its diagonal, and the overlaps of splines beside it."""
        if index in self._bands or index in self._summed:
            return self.band(index)
        if index not in self._smooth_bands:
            grid = self.grids[index]
            root = np.sqrt(np.sum(exposures(self.designs(index), np.square(self.problem.row_weights[:, 0])), axis=0))
            band = np.zeros((grid.degree + 1, grid.size))
            for d, overlap in enumerate(grid.overlaps()):
                band[d, : grid.size - d] = overlap * root[: grid.size - d] * root[d:]
            self._smooth_bands[index] = band
        return self._smooth_bands[index]

    def begun(self, index: int, source: Array) -> Fit:
        """The maximum within the bounds, from the best rho >= 0 for a pattern (M, B) that a start has.

        The bounds hold the coefficients that noise would throw about without them, so that it takes few steps.
        """
        if index not in self._begun:
            summed = self.summed(index)
            self._begun[index] = bounded(summed, best_nonnegative(summed, source))
        return self._begun[index]

    def bounded(self, index: int, free: Fit) -> Fit:
        """The maximum within the bounds, from the free one, or from coarser knots where that leads nowhere near it."""
        if index not in self._bounded:
            summed = self.summed(index)
            # Clipping a start can throw it into the valley of another maximum, so the first start is the best rho >= 0 for
            # the free maximum's pattern.
            starts: tuple[Callable[[], Array], ...] = (
                lambda: best_nonnegative(summed, free.source),
                lambda: free.coefficients,
                lambda: self._from_coarser(index),
            )
            best = self._begun.get(index)
            for start in starts:
                if best is not None and self.agrees(index, free, best):
                    break
                found = bounded(summed, start())
                best = found if best is None else min(best, found, key=lambda fit: fit.objective)
            assert best is not None
            self._bounded[index] = best
        return self._bounded[index]

    def agrees(self, index: int, free: Fit, bounded: Fit) -> bool:
        """Whether the bounds cost no more than noise makes of them where the truth keeps them.

        That is a mixture of chi-squared laws with as many degrees of freedom as bounds hold, at most all coefficients and
        patterns, for which it is taken here: four standard deviations above its mean.
        """
        bounds = self.seen(index) + bounded.source.size
        noise = free.objective / max(1, self.freedom(index))
        return bounded.objective <= free.objective + (bounds + 4 * math.sqrt(2 * bounds)) * noise

    def _from_coarser(self, index: int) -> Array:
        """The closed form's r on the coarsest knots, and on finer ones the maximum within the bounds of the coarser."""
        if index == 0:
            return self.closed(0).coefficients
        if index - 1 not in self._free:
            start = self.closed(index - 1).coefficients
            self._free[index - 1] = maximise(
                self.summed(index - 1), start, nonnegative=False, tolerance=ROUGH, held=True
            )
        return self.refined(index - 1, self.bounded(index - 1, self._free[index - 1]).coefficients, index)

    def as_fine_as_the_bounds_want(self, index: int, free: Fit) -> tuple[int, Fit]:
        """These knots, or the finer or coarser ones that bounded fits ask for.

        Finer ones, where free fits swing below zero around lobes that the knots are too coarse for: bounds allow no such
        swings. Coarser ones, where light that the model does not know is followed by free fits on fine knots with a rho below
        zero: bounds do not follow it, and then finer knots have nothing to say for themselves.
        """
        while (
            index < self.last
            and self.spare(index + 1) >= SPARE
            and not self.agrees(index, free, self.bounded(index, free))
        ):
            try:
                start = self.refined(index, free.coefficients, index + 1)
                finer = maximise(self.summed(index + 1), start, nonnegative=False, tolerance=ROUGH, held=True)
                gain = self.bounded(index, free).objective - self.bounded(index + 1, finer).objective
            except UndeterminedError:
                break
            if gain < self.price(index, index + 1, finer):
                break
            index, free = index + 1, finer
        while index > 0:
            fit = self.bounded(index, free)
            if self.agrees(index, free, fit):
                break
            self._from_coarser(index)
            coarser = self.bounded(index - 1, self._free[index - 1])
            if coarser.objective - fit.objective >= self.price(index - 1, index, fit):
                break
            index, free = index - 1, self._free[index - 1]
        return index, free

    def price(self, index: int, finer: int, fit: Fit) -> float:
        """What a fit on finer knots must gain on coarser ones, or noise alone may make the difference."""
        freedom = self.freedom(finer)
        return worth(self.seen(finer) - self.seen(index), freedom) * self.variance(fit.objective, freedom)

    def seen(self, index: int) -> int:
        """How many coefficients the captures see."""
        return int(np.count_nonzero(self.summed(index).seen))

    def freedom(self, index: int) -> int:
        """Data that are left over to tell the noise by."""
        summed = self.summed(index)
        return int(summed.observations - np.count_nonzero(summed.seen) - summed.cross.shape[0] * summed.elements)

    def spare(self, index: int) -> float:
        """Share of the data that as many coefficients as the grid has leave over; told before the grid's moments are made."""
        rows, realisations = self.problem.data.shape
        weights = self.problem.fit_weights
        observations = np.count_nonzero(weights) * (rows * realisations // weights.size)
        unknown = self.grids[index].size + realisations * self.problem.card.elements
        return float(1 - unknown / max(1, observations))

    def variance(self, objective: float, freedom: int) -> float:
        """Of the noise in units of the weights: 1 where it is stated, else what a misfit says."""
        return 1.0 if self.problem.noise_is_stated else objective / max(1, freedom)

    def refined(self, index: int, r: Array, to: int) -> Array:
        """Coefficients of one grid on a finer one."""
        return np.asarray(self.nested.prolongation(index, to) @ r, dtype=np.float64)

    def coarsened(self, index: int, r: Array) -> Array:
        """Coefficients on the next coarser grid that come nearest where the captures look."""
        return _nearest(self.grids[index - 1].in_halved(), r, self.summed(index).exposure)

    def detail(self, index: int) -> float:
        """The misfit of knots four times as far apart by the closed form: nearly all error of their splines, not noise."""
        closed, (coarse, fine) = self.closed(index), self.grids[index - 2 : index]
        prolongation = sp.csr_array(fine.in_halved() @ coarse.in_halved())
        r = closed.coefficients
        lost = r - prolongation @ _nearest(prolongation, r, closed.exposure)
        films = transport_of(self.designs(index), lost) @ closed.source
        return float(np.sum(self.problem.fit_weights * films**2))

    def foretold(self, index: int, detail: float) -> float:
        """The misfit of knots twice as far apart, from that of knots four times as far apart: as for a smooth rho.

        The error of its splines falls by 2^(degree + 1) with each halving of the knots.
        """
        return detail / 4.0 ** (self.grids[index].degree + 1)


def _nearest(prolongation: sp.csr_array, r: Array, exposure: Array) -> Array:
    """Coefficients r' of which the prolongation R r' comes nearest to r where the captures look."""
    weighted = sp.csr_array(prolongation.multiply(exposure[:, None]))
    gram = sp.csc_array(weighted.T @ prolongation)
    gram += 1e-9 * float(gram.diagonal().max()) * sp.eye_array(gram.shape[0])
    return np.asarray(spl.spsolve(gram, weighted.T @ r), dtype=np.float64)


def _quadrature(problem: Problem, tolerance: float | None) -> float:
    """Quadrature error, of a lobe's peak, that a tolerance of the pattern allows and the noise hides."""
    if tolerance is None or problem.inverse_variance is None or not problem.noise_is_stated:
        return FINEST_QUADRATURE
    weights = problem.inverse_variance[problem.inverse_variance > 0]
    hidden = 0.1 / math.sqrt(float(np.median(weights)))
    return min(1e-3, max(FINEST_QUADRATURE, min(1e-2 * tolerance, hidden)))
