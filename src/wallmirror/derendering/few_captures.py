"""Fewer captures than elements: the pattern by a search over its M B numbers, the BRDF eliminated.

With rank(V) < M the data's space no longer holds every T_i r, and the closed form has nothing to stand on. But the BRDF can
be eliminated (`elimination`), and what is left is climbed from random patterns. One capture leaves rho undetermined even
for a known pattern, for it may be chosen at will on some interval and continued by the data; what is known of it (rho >= 0,
rho = 0 beyond some angle) decides. Nothing here is convex, so an answer counts only if no other pattern that a start
reached explains the data as well, and if no small change of it goes unseen; otherwise the search refuses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.elimination import (
    Point,
    System,
    build_system,
    eliminated,
    normal_of_pattern,
    reciprocal_condition,
    restricted,
)
from wallmirror.derendering.ends import APART, ROUNDING, End, disagree, distinct, in_question, pays, refined, search
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.rivals import BARS, SAME, better_by_chance
from wallmirror.derendering.splines import SplineGrid, transport_of
from wallmirror.derendering.subspace import ClosedForm
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

#: Knot spacings in degrees: the search runs on the first, the rest refine what it found.
STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)
_DEGREE = 7
# The largest order of the matrix that a step may factor, and the largest number of sparse entries that make it up.
_MOST_CELLS = 2200
_MOST_ENTRIES = 60_000_000
# With its ridge a singular G has a reciprocal condition near 1e-14; two captures leave 1e-8 and more.
_SINGULAR = 1e-12
# S is a difference that ends at rounding, so that its singular values, roots of it, end near 1e-8.
_FLAT = 1e-7
# Misfits that differ by less than this share do not tell patterns apart, however many pixels they are summed over.
_DECISIVE_SHARE = 5e-3
# Below this residual what is left is the spline's own error, which follows no statistics.
_SYSTEMATIC = 1e-6
# Ends that a finer grid is tried on.
_REFINED = 6
_UNDETERMINED = 0.5


@dataclass(frozen=True, kw_only=True)
class FewCaptures:
    """A pattern and BRDF that explain the captures, and how alone they are in that.

    Parameters
    ----------
    grid, designs:
        The spline grid and T_1 .. T_M on it, without row weights, columns outside the support empty.
    coefficients, source, transport:
        r (K,), V (M, B), F (P, M), with F V = D / problem.scale.
    residual:
        |D - F V| / |D|, rows weighted.
    gap:
        Smallest singular value of dF V / dV with r eliminated, the global scale left out, over the largest.
    error:
        Bound on the relative error of V that the residual could hide: residual over that singular value.
    starts, agreeing:
        Random starts tried, and how many of them ended at this pattern.
    exposure:
        How well each coefficient is seen, 1 for the best-seen, shape (K,).
    others:
        r and V of the other patterns that starts ended at and that explain the films not much worse, the best first.
    rise:
        Rise of the misfit where the pattern is off by five error bars along what is seen least, over that of the parabola
        which the bars stand for, the less of both ways: 1 where they hold; inf where no pattern lies there.
    """

    grid: SplineGrid
    designs: list[sp.csr_array]
    coefficients: Array
    source: Array
    transport: Array
    residual: float
    gap: float
    error: float
    starts: int
    agreeing: int
    exposure: Array
    others: tuple[tuple[Array, Array], ...]
    rise: float

    @property
    def closed(self) -> ClosedForm:
        """The same in the form of the closed form's result: mismatch is the squared residual."""
        gap = self.residual / self.error if self.error > 0 else 1.0
        return ClosedForm(
            coefficients=self.coefficients,
            transport=self.transport,
            source=self.source,
            mismatch=self.residual**2,
            gap=min(gap, 1.0),
            near_solutions=1,
            exposure=self.exposure,
            family=self.coefficients[:, None],
            beyond=min(gap, 1.0),
        )


def few_captures(
    problem: Problem,
    *,
    nonnegative: bool = True,
    support: float | None = None,
    starts: int = 24,
    seed: int = 0,
    steps: Sequence[float] = STEPS,
    degree: int = _DEGREE,
) -> FewCaptures:
    """Recover V and r from captures of any rank, or refuse because they do not decide.

    Parameters
    ----------
    nonnegative:
        V >= 0 and r >= 0.
    support:
        rho(u) = 0 for |u| > support, in radians.
    starts:
        Random patterns to start from; twice as many when they end at patterns far apart of similar misfits, up to four
        times as many when fewer than three end at the best.
    seed:
        Of the random patterns.
    steps:
        Knot spacings in degrees, coarse to fine.

    Raises
    ------
    InputError
        For a support or a number of starts that makes no sense.
    UndeterminedError
        When another pattern explains the captures as well, or a change of the pattern leaves no trace in them.
    """
    if support is not None and not 0 < support <= math.pi:
        raise InputError(
            f"is {support:g}; give the largest angle sum of the BRDF, from 0 to pi radians", field="support"
        )
    if starts < 1:
        raise InputError(f"is {starts}; the search needs at least one start", field="starts")
    help_from = _help(nonnegative=nonnegative, support=support)
    system = build_system(problem, steps[0], degree=degree, support=support)
    if system.freedom <= 0:
        raise UndeterminedError(
            f"{system.observations} pixel values cannot determine {system.observations - system.freedom} unknowns; use more "
            "pixels, views or captures"
        )
    rng = np.random.default_rng(seed)
    candidates = search(system, problem.card.elements, [], rng, starts, nonnegative=nonnegative)
    tried = starts
    if reciprocal_condition(candidates[0].point) < _SINGULAR:
        raise UndeterminedError(
            f"the captures leave the BRDF undetermined even where the pattern is known; {help_from}"
        )
    _slopes(system, candidates[0].point, help_from)
    while tried < 4 * starts and (candidates[0].reached < 3 or (tried < 2 * starts and disagree(candidates))):
        candidates = search(system, problem.card.elements, candidates, rng, starts, nonnegative=nonnegative)
        tried += starts
    for step in steps[1:]:
        best = candidates[0].point
        if math.sqrt(best.objective) < ROUNDING:
            break
        ratio = system.grid.step / math.radians(step)
        if system.cells.size * ratio > _MOST_CELLS or system.values.size * ratio**2 > _MOST_ENTRIES:
            break
        finer = build_system(problem, step, degree=degree, support=support)
        if finer.freedom <= 0:
            break
        finest = distinct(
            refined(finer, system, c, nonnegative=nonnegative) for c in in_question(candidates)[:_REFINED]
        )
        if not pays(best, finest[0].point, finer) or reciprocal_condition(finest[0].point) < _SINGULAR:
            break  # noise, or cells finer than the pixels
        system, candidates = finer, finest
    return _judged(
        problem, system, candidates, tried, help_from, degree=degree, support=support, nonnegative=nonnegative
    )


def _judged(
    problem: Problem,
    system: System,
    candidates: list[End],
    tried: int,
    help_from: str,
    *,
    degree: int,
    support: float | None,
    nonnegative: bool,
) -> FewCaptures:
    """The best candidate, if the others and its own neighbourhood leave it alone."""
    best = candidates[0].point
    steepest, flat = _slopes(system, best, help_from)
    residual = math.sqrt(best.objective)
    bars, normal, least = _bars(system, best)
    apart = min(max(SAME, BARS * bars), APART)
    for other in candidates[1:]:
        if scale_free_error(other.point.v, best.v) > apart and _as_good(other.point, best, system):
            raise UndeterminedError(
                f"patterns that differ by {100 * scale_free_error(other.point.v, best.v):.2g} % explain the captures "
                f"equally well (residuals {residual:.2g} and {math.sqrt(other.point.objective):.2g}); {help_from}"
            )
    r, source = _unscaled(problem, system, best)
    grid, designs = problem.designs(math.degrees(system.grid.step), degree=degree, tolerance=1e-9)
    designs = restricted(grid, designs, support)
    exposure = np.zeros(grid.size)
    exposure[system.cells] = system.exposure
    return FewCaptures(
        grid=grid,
        designs=designs,
        coefficients=r,
        source=source,
        transport=transport_of(designs, r),
        residual=residual,
        gap=flat / steepest,
        error=residual / flat,
        starts=tried,
        agreeing=candidates[0].reached,
        exposure=exposure,
        others=tuple(_unscaled(problem, system, c.point) for c in in_question(candidates)[1:]),
        rise=_rise(system, best, normal, least, BARS * bars, nonnegative=nonnegative),
    )


def _unscaled(problem: Problem, system: System, point: Point) -> tuple[Array, Array]:
    """r (K,) and V (M, B) of a point in the scale of the problem's data, the light positive."""
    r = np.zeros(system.grid.size)
    r[system.cells] = point.r / system.scale
    source = point.v * float(np.linalg.norm(problem.weighted_data))
    sign = -1.0 if source.sum() < 0 else 1.0
    return sign * r, sign * source


def _bars(system: System, point: Point) -> tuple[float, Array, Array]:
    """The relative error of V that noise as large as the misfit makes, S, and the direction that is seen least, (M, B)."""
    normal, _ = normal_of_pattern(system, point, np.ones_like(point.v, dtype=bool))
    values, vectors = np.linalg.eigh(normal)
    variance = point.objective / max(1, system.freedom)
    bars = math.sqrt(variance * float(np.sum(1 / np.maximum(values[1:], 1e-300))))
    return bars, normal, vectors[:, min(1, values.size - 1)].reshape(point.v.shape, order="F")


def _rise(system: System, point: Point, normal: Array, least: Array, off: float, *, nonnegative: bool) -> float:
    """What the misfit rises by where V is that far off, over what the parabola with the curvature S does."""
    if off >= 1 or point.objective == 0:
        return math.inf  # no pattern is as far off as that
    step = least * off / math.sqrt(1 - off * off)
    rises = [math.inf]
    for there in (point.v + step, point.v - step):
        v = np.maximum(there, 0.0) if nonnegative else there
        moved = (v - point.v).ravel(order="F")
        foretold = float(moved @ normal @ moved)
        if foretold > 0:
            risen = eliminated(system, v / np.linalg.norm(v), point.r, nonnegative=nonnegative)
            rises.append((risen.objective - point.objective) / foretold)
    return min(rises)


def _slopes(system: System, point: Point, help_from: str) -> tuple[float, float]:
    """Largest and smallest singular value of dF V / dV with r eliminated, the global scale left out.

    Raises
    ------
    UndeterminedError
        When rounding or the misfit leaves nothing of the smallest.
    """
    _, values = normal_of_pattern(system, point, np.ones_like(point.v, dtype=bool))
    steepest = math.sqrt(max(float(values[-1]), 0.0))
    flat = math.sqrt(max(float(values[1]), 0.0)) if values.size > 1 else steepest  # values[0] is the scale's
    # Noise moves V along its least-seen direction by about its standard deviation over the slope.
    noise = math.sqrt(point.objective / max(1, system.freedom))
    if flat <= _FLAT * steepest or noise > _UNDETERMINED * flat:
        raise UndeterminedError(f"the pattern can change without a trace in the captures; {help_from}")
    return steepest, flat


def _as_good(other: Point, best: Point, system: System) -> bool:
    """Whether the misfits leave it open which of two patterns is the true one."""
    if math.sqrt(best.objective) < _SYSTEMATIC:
        return math.sqrt(other.objective) < 10 * max(math.sqrt(best.objective), ROUNDING)
    # Were the other one true, the best might be better by what its free numbers take up of the noise (`rivals`).
    decisive = better_by_chance(best.free.size + best.v.size - 1) / max(1, system.freedom)
    return other.objective < best.objective * (1 + max(decisive, _DECISIVE_SHARE))


def _help(*, nonnegative: bool, support: float | None) -> str:
    ways = ["capture more different patterns"]
    if not nonnegative:
        ways.append("allow only non-negative patterns and BRDFs")
    if support is None:
        ways.append("give the angle beyond which the BRDF is zero (support)")
    return " or ".join(ways)
