"""Fewer captures than elements: the pattern by a search over its M B numbers, the BRDF eliminated.

With rank(V) < M the data's space no longer holds every T_i r, and the closed form has nothing to stand on. But the BRDF can
be eliminated (`elimination`), and what is left is climbed from random patterns. One capture leaves rho undetermined even
for a known pattern, for it may be chosen at will on some interval and continued by the data; what is known of it (rho >= 0,
rho = 0 beyond some angle) decides. Nothing here is convex, so an answer counts only if no other pattern that a start
reached explains the data as well, and if no small change of it goes unseen; otherwise the search refuses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.elimination import (
    Point,
    System,
    build_system,
    climb,
    normal_of_pattern,
    reciprocal_condition,
    restricted,
)
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
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
_ROUNDING = 1e-13
# Two patterns nearer to each other than this are one.
_SAME = 1e-3
# Misfits that differ by less than this many units of the noise's variance (or this share) do not tell patterns apart.
_DECISIVE = 50.0
_DECISIVE_SHARE = 5e-3
# Below this residual what is left is the spline's own error, which follows no statistics.
_SYSTEMATIC = 1e-6
# Patterns within the noise of each other are one as well, but never those that differ by more than this.
_APART = 0.2
_CARRIED = 6
_HOPELESS = 10.0
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


@dataclass
class _Candidate:
    point: Point
    reached: int


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
        Random patterns to start from; up to four times as many when fewer than three end at the best.
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
    candidates = _search(system, problem.card.elements, [], rng, starts, nonnegative=nonnegative)
    tried = starts
    if reciprocal_condition(candidates[0].point) < _SINGULAR:
        raise UndeterminedError(
            f"the captures leave the BRDF undetermined even where the pattern is known; {help_from}"
        )
    _slopes(system, candidates[0].point, help_from)
    while candidates[0].reached < 3 and tried < 4 * starts:
        candidates = _search(system, problem.card.elements, candidates, rng, starts, nonnegative=nonnegative)
        tried += starts
    for step in steps[1:]:
        best = candidates[0].point
        if math.sqrt(best.objective) < _ROUNDING:
            break
        ratio = system.grid.step / math.radians(step)
        if system.cells.size * ratio > _MOST_CELLS or system.values.size * ratio**2 > _MOST_ENTRIES:
            break
        finer = build_system(problem, step, degree=degree, support=support)
        if finer.freedom <= 0:
            break
        refined = _distinct(_refine(finer, system, c, nonnegative=nonnegative) for c in _in_question(candidates))
        if not _pays(best, refined[0].point, finer) or reciprocal_condition(refined[0].point) < _SINGULAR:
            break  # noise, or cells finer than the pixels
        system, candidates = finer, refined
    return _judged(problem, system, candidates, tried, help_from, degree=degree, support=support)


def _search(
    system: System,
    elements: int,
    found: list[_Candidate],
    rng: np.random.Generator,
    starts: int,
    *,
    nonnegative: bool,
) -> list[_Candidate]:
    """What is found already, and what some more random patterns lead to."""
    shape = (elements, system.data.shape[1])
    for n in range(starts):
        # Every other start is uneven: patterns of few bright elements lie in corners that even ones seldom reach.
        v = rng.random(shape) ** (1 + 3 * (n % 2)) if nonnegative else rng.standard_normal(shape)
        found = _distinct([*found, _Candidate(climb(system, v, None, nonnegative=nonnegative), 1)])
    return found


def _refine(system: System, coarse: System, candidate: _Candidate, *, nonnegative: bool) -> _Candidate:
    """The same pattern on a finer grid, from the coarse BRDF."""
    whole = np.zeros(coarse.grid.size)
    whole[coarse.cells] = candidate.point.r / coarse.scale
    r = system.grid.interpolate(lambda u: coarse.grid.evaluate(whole, u))[system.cells] * system.scale
    return _Candidate(climb(system, candidate.point.v, r, nonnegative=nonnegative), candidate.reached)


def _distinct(candidates: Iterable[_Candidate]) -> list[_Candidate]:
    """Different patterns, best first, each with the number of starts that ended there."""
    kept: list[_Candidate] = []
    for candidate in sorted(candidates, key=lambda c: c.point.objective):
        twin = next((k for k in kept if scale_free_error(candidate.point.v, k.point.v) < _SAME), None)
        if twin is None:
            kept.append(_Candidate(candidate.point, candidate.reached))
        else:
            twin.reached += candidate.reached
    return kept[:_CARRIED]


def _in_question(candidates: list[_Candidate]) -> list[_Candidate]:
    """Those whose misfit a finer grid might still bring down to the best's."""
    return [
        c for c in candidates if c.point.objective <= _HOPELESS**2 * max(candidates[0].point.objective, _ROUNDING**2)
    ]


def _pays(coarse: Point, fine: Point, system: System) -> bool:
    """Whether the finer grid explains more than as many coefficients would of noise (Akaike 1974)."""
    added = max(1, fine.free.size - coarse.free.size)
    return coarse.objective - fine.objective > 2 * added * fine.objective / max(1, system.freedom)


def _judged(
    problem: Problem,
    system: System,
    candidates: list[_Candidate],
    tried: int,
    help_from: str,
    *,
    degree: int,
    support: float | None,
) -> FewCaptures:
    """The best candidate, if the others and its own neighbourhood leave it alone."""
    best = candidates[0].point
    steepest, flat = _slopes(system, best, help_from)
    residual = math.sqrt(best.objective)
    noise = residual / math.sqrt(max(1, system.freedom))
    apart = min(max(_SAME, 3 * noise / flat), _APART)
    for other in candidates[1:]:
        if scale_free_error(other.point.v, best.v) > apart and _as_good(other.point.objective, best.objective, system):
            raise UndeterminedError(
                f"patterns that differ by {100 * scale_free_error(other.point.v, best.v):.2g} % explain the captures "
                f"equally well (residuals {residual:.2g} and {math.sqrt(other.point.objective):.2g}); {help_from}"
            )
    r = np.zeros(system.grid.size)
    r[system.cells] = best.r / system.scale
    source = best.v * float(np.linalg.norm(problem.weighted_data))
    sign = -1.0 if source.sum() < 0 else 1.0
    grid, designs = problem.designs(math.degrees(system.grid.step), degree=degree, tolerance=1e-9)
    designs = restricted(grid, designs, support)
    exposure = np.zeros(grid.size)
    exposure[system.cells] = system.exposure
    return FewCaptures(
        grid=grid,
        designs=designs,
        coefficients=sign * r,
        source=sign * source,
        transport=np.stack([t @ (sign * r) for t in designs], axis=1),
        residual=residual,
        gap=flat / steepest,
        error=residual / flat,
        starts=tried,
        agreeing=candidates[0].reached,
        exposure=exposure,
    )


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


def _as_good(other: float, best: float, system: System) -> bool:
    """Whether the misfits leave it open which of two patterns is the true one."""
    if math.sqrt(best) < _SYSTEMATIC:
        return math.sqrt(other) < 10 * max(math.sqrt(best), _ROUNDING)
    # A wrong pattern may leave more coefficients above their bounds, and each of them takes up a unit of noise.
    decisive = (_DECISIVE + 2 * system.cells.size) / max(1, system.freedom)
    return other < best * (1 + max(decisive, _DECISIVE_SHARE))


def _help(*, nonnegative: bool, support: float | None) -> str:
    ways = ["capture more different patterns"]
    if not nonnegative:
        ways.append("allow only non-negative patterns and BRDFs")
    if support is None:
        ways.append("give the angle beyond which the BRDF is zero (support)")
    return " or ".join(ways)
