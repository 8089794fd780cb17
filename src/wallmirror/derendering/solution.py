"""What a de-rendering returns: the estimates, and everything that says how far to trust them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumTable, directional_albedo
from wallmirror.derendering.angle_sum_check import AngleSumCheck
from wallmirror.derendering.components import components, in_words, named
from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.one_bounce import OneBounceCheck
from wallmirror.derendering.problem import ROUNDING, Problem, expected_mismatch
from wallmirror.derendering.subspace import SignalSpace
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

Verdict = Literal["good", "doubtful"]

#: What settles the global scale: max rho = 1, a known albedo of the wall, or a known mean level of the pattern.
Scale = Literal["peak", "albedo", "level"]

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


@dataclass(frozen=True, kw_only=True)
class Gauge:
    """The choice of the one scale that no capture can tell.

    Parameters
    ----------
    scale:
        "peak": max rho = 1; "albedo": the directional albedo at normal incidence is `wall_albedo`; "level": the mean of
        V is `source_level`.
    """

    scale: Scale = "peak"
    wall_albedo: float | None = None
    source_level: float | None = None

    def __post_init__(self) -> None:
        if self.scale not in get_args(Scale):
            raise InputError(f'is "{self.scale}"; choose one of {", ".join(get_args(Scale))}', field="scale")
        if self.wall_albedo is not None and not 0 < self.wall_albedo <= 1:
            raise InputError(f"is {self.wall_albedo:g}; an albedo lies between 0 and 1", field="wall_albedo")
        if self.source_level is not None and not 0 < self.source_level < math.inf:
            raise InputError(f"is {self.source_level:g}; give the pattern's mean radiance > 0", field="source_level")
        if self.scale == "albedo" and self.wall_albedo is None:
            raise InputError('the scale "albedo" needs the albedo; give it', field="wall_albedo")
        if self.scale == "level" and self.source_level is None:
            raise InputError('the scale "level" needs the mean radiance of the pattern; give it', field="source_level")

    @property
    def words(self) -> str:
        """The gauge in a few words."""
        match self.scale:
            case "albedo":
                return f"directional albedo of the wall = {self.wall_albedo:g}"
            case "level":
                return f"mean of the pattern = {self.source_level:g}"
            case _:
                return "max rho = 1"

    def factor(self, angle_sum: Array, brdf: Array, source: Array) -> float:
        """What a BRDF of peak 1 is to be multiplied with, and its pattern divided by."""
        match self.scale:
            case "albedo":
                assert self.wall_albedo is not None
                nodes = np.linspace(angle_sum[0], angle_sum[-1], angle_sum.size)
                values = np.maximum(np.interp(nodes, angle_sum, brdf), 0.0)
                table = AngleSumTable(start=float(nodes[0]), stop=float(nodes[-1]), values=values)
                return self.wall_albedo / directional_albedo(table)
            case "level":
                assert self.source_level is not None
                return float(np.mean(source)) / self.source_level
            case _:
                return 1.0


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A recovered pattern and BRDF with their doubts.

    Parameters
    ----------
    status:
        A sentence that says how far to trust the result and what to do next.
    verdict:
        "good", or "doubtful" when a warning stands.
    warnings:
        One sentence for each reason to doubt.
    method:
        "closed_form", "maximum_likelihood", "few_captures" or "poisson".
    gauge:
        What settles the global scale, in words.
    priors:
        What the answer rests on beside the captures, in words; empty where the captures alone decide.
    source, source_std:
        V and its standard deviations, shape (M, B), in the gauge that was chosen: by default the one where the
        well-seen part of the BRDF peaks at 1. They leave out what is not known of a scale that was given.
    shape_std:
        Standard deviation of V after the best global scale, which nobody can know, shape (M, B).
    angle_sum, brdf, brdf_std:
        rho on uniform nodes of u = theta_s + theta_o (radians), shape (L,); the standard deviation is inf where
        no capture saw that angle.
    transport:
        F, shape (A, N, M), in the same gauge.
    rank:
        Rank of the data that stands out of noise and rounding, out of M.
    mismatch, mismatch_expected:
        1 - lambda_1 of the closed form, and what the noise alone would make of it (nan where it is unknown).
    gap:
        1 - lambda_2: 0 means that a second BRDF explains the data as well.
    condition:
        Condition number of F.
    components:
        Number of parts with a scale of their own; 1 is the unavoidable global scale.
    groups:
        Elements (counted from 0) of each such part. With several, V, F and rho of each are in the scale in which its own
        well-seen part of the BRDF peaks at 1, errors hold up to one scale each, and `scale_free_error` takes the groups.
    predicted_error:
        Expected relative error of V after the best global scale, from the Cramer-Rao bound (or the closed form's own) and
        from what a wall of facets could do to V that the captures do not rule out.
    residual:
        |D - F V| / |D|.
    chi_squared:
        Residual in units of the noise variance per degree of freedom (nan where no variance is known).
    step_deg:
        Knot spacing of the BRDF's spline in degrees.
    one_bounce:
        What light beyond one bounce would do to this solution; None where nothing but the wall reflects.
    angle_sum_check:
        What a wall that is no function of the angle sum would do to this solution, and the factors that `brdf` is to be
        multiplied with where a wall of facets was fitted; None for a closed form of groups with a scale each.
    seconds:
        Time the solver took.
    history:
        What the solver did and why, a sentence for each stage.
    """

    status: str
    verdict: Verdict
    warnings: tuple[str, ...]
    method: str
    gauge: str
    priors: tuple[str, ...]
    source: Array = field(repr=False)
    source_std: Array = field(repr=False)
    shape_std: Array = field(repr=False)
    angle_sum: Array = field(repr=False)
    brdf: Array = field(repr=False)
    brdf_std: Array = field(repr=False)
    transport: Array = field(repr=False)
    rank: int
    mismatch: float
    mismatch_expected: float
    gap: float
    condition: float
    components: int
    groups: tuple[tuple[int, ...], ...]
    predicted_error: float
    residual: float
    chi_squared: float
    step_deg: float
    one_bounce: OneBounceCheck | None
    angle_sum_check: AngleSumCheck | None
    seconds: float
    history: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Everything but the large arrays, ready for JSON (infinities and nan become null)."""
        scalars = {
            name: getattr(self, name)
            for name in [
                "status",
                "verdict",
                "method",
                "rank",
                "mismatch",
                "mismatch_expected",
                "gap",
                "condition",
                "components",
                "predicted_error",
                "residual",
                "chi_squared",
                "step_deg",
                "seconds",
            ]
        }
        return {
            **{k: _finite(v) for k, v in scalars.items()},
            "warnings": list(self.warnings),
            "history": list(self.history),
            "one_bounce": None if self.one_bounce is None else asdict(self.one_bounce),
            "angle_sum_check": None if self.angle_sum_check is None else asdict(self.angle_sum_check),
            "gauge": self.gauge,
            "priors": list(self.priors),
            "groups": [list(group) for group in self.groups],
            "source": _finite(self.source.tolist()),
            "source_std": _finite(self.source_std.tolist()),
            "shape_std": _finite(self.shape_std.tolist()),
        }

    def to_json(self) -> str:
        """`summary` as a JSON document."""
        return json.dumps(self.summary(), indent=2, allow_nan=False)


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


def _finite(value: Any) -> Any:
    """Replace what JSON has no word for."""
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
