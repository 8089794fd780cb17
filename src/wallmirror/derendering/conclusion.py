"""From an estimate to a solution: its gauge, its certificates, and how far to trust it, in words."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.angle_sum_check import AngleSumCheck
from wallmirror.derendering.components import components, in_words, named
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.gauge import Gauge
from wallmirror.derendering.one_bounce import OneBounceCheck
from wallmirror.derendering.pattern_space import ROUNDING, expected_mismatch
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.solution import Solution
from wallmirror.derendering.subspace import ClosedForm, SignalSpace
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

_HOW = {
    "closed_form": "in closed form",
    "maximum_likelihood": "by maximum likelihood",
    "few_captures": "from few captures",
    "poisson": "by the likelihood of counts",
}
#: Methods that fit a likelihood.
FITS = ("maximum_likelihood", "poisson")
#: Error bars beyond this share of the pattern mean that the data do not determine it.
UNDETERMINED = 0.5
_CURVE_NODES = 2401
# A bias beyond this share of the error bars is told.
_BIAS_TOLD = 0.5
# A gap below this many mismatches means that another BRDF, far from the one found, misses the captures hardly more: no
# bound at the fit knows of it. In 200 random scenes right answers have 2.9 and more, wrong ones were seen at 1.9 and 2.1.
# Where noise alone makes a mismatch beyond the second number, every gap is of its size and error bars are told by it.
_RIVAL, _NOISE_RULES = 2.5, 1e-2
# Below this the closed form's gap is as good as none.
_NO_GAP = 1e-9


def conclude(
    problem: Problem,
    space: SignalSpace,
    estimate: Estimate,
    one_bounce: OneBounceCheck | None,
    angle_sum: AngleSumCheck | None,
    *,
    gauge: Gauge,
    quiet: bool,
    seconds: Callable[[], float],
) -> Solution:
    """Put an estimate into the gauge that was chosen, attach its certificates and say in words how far to trust it.

    Parameters
    ----------
    quiet:
        Whether the captures show themselves that they have no noise.

    Raises
    ------
    UndeterminedError
        When several BRDFs explain the data alike, or the error bars are as large as the pattern.
    """
    closed, grid = estimate.closed, estimate.grid
    u = np.unique(np.append(np.linspace(grid.start, grid.stop, _CURVE_NODES), estimate.peak_at))
    curve = grid.evaluate(estimate.coefficients, u)
    groups = estimate.groups or (tuple(range(problem.card.elements)),)
    if len(groups) > 1 and gauge.scale != "peak":
        raise UndeterminedError(f"one known scale does not settle {len(groups)}: {in_words(groups)}")
    # A gap of rounding's size leaves the fit nothing to choose by, and its error bars no way to know.
    if len(groups) == 1 and closed.near_solutions > 1 and (estimate.method == "closed_form" or closed.gap < _NO_GAP):
        apart = components(problem.captures, u, curve)
        tied = (
            f" ({named(apart)} share no angle of the BRDF, and more than a scale each is free)"
            if len(apart) > 1
            else ""
        )
        raise UndeterminedError(
            f"{closed.near_solutions} different BRDFs explain the captures equally well{tied}, gap {closed.gap:.1e}; use a "
            "card or views whose reflections share more angles"
        )
    expected = expected_mismatch(problem, space, closed)
    if len(groups) > 1 and estimate.method in FITS and not problem.noise_is_stated and expected < ROUNDING:
        raise UndeterminedError(
            f"{named(groups)} share no angle of the BRDF, and a fit to captures without noise cannot tell whether more than a "
            "scale each is free; leave the method out, or use a card or views whose reflections share more angles"
        )
    if not estimate.predicted_error <= UNDETERMINED:
        raise UndeterminedError(
            f"the captures leave the pattern undetermined (its error bars come to {100 * estimate.predicted_error:.0f} "
            "% of it); capture more light, more views or more patterns"
        )
    if estimate.method == "closed_form" and faintest_missed(space, closed) > 1:
        raise UndeterminedError(
            "the closed form misses more of the captures than the faintest of their patterns is, so that this one may be made "
            "of what is missed; use finer knots if they were given, or a card or views that tell the elements better apart"
        )
    peak = float(grid.evaluate(estimate.coefficients, estimate.peak_at))
    views, pixels, _ = problem.captures.radiance.shape
    missed = np.linalg.norm(problem.data - estimate.transport @ estimate.source)
    warnings = list(estimate.warnings)
    if estimate.method in FITS and closed.mismatch > 10 * expected and closed.mismatch > 1e-6:
        warnings.append(
            f"the closed form misses the data's space by {closed.mismatch:.1e} where noise explains {expected:.1e}, so "
            "the geometry, Hypothesis 2 (one bounce) or Hypothesis 8 (angle sum) does not hold"
        )
    if estimate.method in FITS and closed.gap < _RIVAL * closed.mismatch < _RIVAL * _NOISE_RULES:
        warnings.append(
            f"another BRDF misses the captures' space hardly more than the one found ({closed.gap:.1e} against "
            f"{closed.mismatch:.1e}), so the pattern may be a wholly different one; use views or a card whose reflections "
            "share more angles"
        )
    if quiet and estimate.method in FITS:
        warnings.append(
            "the captures are free of noise, so what the fit leaves of them is none, and its error bars, which take it for "
            "noise, are too small by a factor that nothing tells; use more views or pixels, for which the closed form has a "
            "bound"
        )
    if one_bounce is not None and one_bounce.bias > _BIAS_TOLD * estimate.predicted_error:
        basis = "assumed" if one_bounce.assumed else "given"
        warnings.insert(
            0,
            f"Hypothesis 2 (one bounce) does not hold: card or room send back {100 * one_bounce.share:.2g} % more light, "
            f"which turns the pattern by about {100 * one_bounce.bias:.2g} % (at the {basis} wall albedo of "
            f"{one_bounce.wall_albedo:.2g}) and does not show in the residual",
        )
    source = estimate.source * peak * problem.scale
    factor = gauge.factor(u, curve / peak, source)
    per = peak / factor  # what the estimate's BRDF is divided by
    return Solution(
        status=_status(problem, estimate, warnings),
        verdict="doubtful" if warnings else "good",
        warnings=tuple(warnings),
        method=estimate.method,
        gauge=gauge.words + (" in each group" if len(groups) > 1 else ""),
        priors=estimate.priors,
        source=estimate.source * per * problem.scale,
        source_std=estimate.source_std * per * problem.scale,
        shape_std=estimate.shape_std * per * problem.scale,
        angle_sum=u,
        brdf=curve / per,
        brdf_std=estimate.brdf_std(u) / per,
        transport=(estimate.transport / per).reshape(views, pixels, -1),
        rank=space.rank if estimate.method == "few_captures" else problem.card.elements,
        mismatch=closed.mismatch,
        mismatch_expected=expected,
        gap=closed.gap,
        condition=float(np.linalg.cond(estimate.transport)),
        components=len(groups),
        groups=groups,
        predicted_error=estimate.predicted_error,
        residual=float(missed / np.linalg.norm(problem.data)),
        chi_squared=estimate.chi_squared,
        step_deg=math.degrees(grid.step),
        one_bounce=one_bounce,
        angle_sum_check=angle_sum,
        seconds=seconds(),
    )


def faintest_missed(space: SignalSpace, closed: ClosedForm) -> float:
    """What a closed form misses of the films over the faintest of their patterns, both root mean squares.

    Knots of all spacings may agree on a pattern that is made of what they all miss.
    """
    faintest = float(space.singular_values[closed.source.shape[0] - 1])
    return math.sqrt(closed.mismatch) * float(np.linalg.norm(space.singular_values)) / max(faintest, 1e-300)


def _status(problem: Problem, estimate: Estimate, warnings: list[str]) -> str:
    how = _HOW[estimate.method]
    if estimate.priors:
        how += f" (given {' and '.join(estimate.priors)})"
    plural = "" if problem.data.shape[1] == 1 else "s"
    found = (
        f"Recovered {problem.card.elements} elements in {problem.data.shape[1]} pattern{plural} {how}; expect the pattern "
        f"to be {100 * estimate.predicted_error:.2g} % off, up to "
        + (f"one scale for each of {len(estimate.groups)} groups." if len(estimate.groups) > 1 else "one global scale.")
    )
    if not warnings:
        return f"{found} No certificate objects."
    more = f" ({len(warnings) - 1} more warning{'s' if len(warnings) > 2 else ''}.)" if len(warnings) > 1 else ""
    return f"{found} But {warnings[0]}.{more}"
