"""What a scene needs to be predicted, filmed, validated and solved to a tolerance: the answer of `wallmirror advise`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from wallmirror.errors import InputError
from wallmirror.planning.forward import Quadrature
from wallmirror.planning.hypotheses import Hypothesis
from wallmirror.planning.sampling import Sampling

#: Tolerances that can be asked for: below, the film's float32 and the reference's own error would be met.
SMALLEST, LARGEST = 1e-5, 0.5

#: Share of the tolerance that a plan aims at, so that its own uncertainty does not break the promise.
AIM = 0.8

Kind = Literal["bias", "noise"]
#: How the wall's radiance may be predicted.
Route = Literal["analytic", "analytic with glow", "path tracing"]


@dataclass(frozen=True, kw_only=True)
class Term:
    """One part of a predicted error, relative to the rms radiance.

    Parameters
    ----------
    kind:
        "bias" parts may all point the same way and add; "noise" adds to them in the mean square.
    limit:
        Whether the error is but a limit, below which the pilot's own noise hid the truth.
    """

    name: str
    error: float
    kind: Kind
    limit: bool = False


def total_error(terms: tuple[Term, ...]) -> float:
    """Root of (sum of biases)^2 + sum of noises^2.

    Examples
    --------
    >>> bias, noise = Term(name="a", error=0.3, kind="bias"), Term(name="b", error=0.4, kind="noise")
    >>> total_error((bias, noise))
    0.5
    """
    bias = sum(t.error for t in terms if t.kind == "bias")
    return math.hypot(bias, *(t.error for t in terms if t.kind == "noise"))


@dataclass(frozen=True, kw_only=True)
class ForwardPlan:
    """How to predict the wall's radiance: the analytic model, where that is enough, else the path tracer.

    Parameters
    ----------
    route:
        "analytic" (one bounce), "analytic with glow" (and `interreflection.from_card`), or "path tracing" with the
        settings of the capture.
    quadrature:
        Of the analytic model, the cheapest that keeps what the missing bounces leave of the tolerance.
    terms:
        The predicted error by its parts.
    seconds:
        Predicted for all films.
    """

    route: Route
    quadrature: Quadrature
    terms: tuple[Term, ...]
    seconds: float

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the films."""
        return total_error(self.terms)

    @property
    def is_limit(self) -> bool:
        """Whether the error is but an upper limit (see `Term`)."""
        return any(term.limit for term in self.terms)


@dataclass(frozen=True, kw_only=True)
class CapturePlan:
    """How to film the scene with the path tracer.

    Parameters
    ----------
    tolerance:
        That was asked for.
    sampling:
        Sampler, samples per pixel of a seed, and seeds.
    max_depth, rr_depth:
        2 is one bounce; where Russian roulette begins.
    table_nodes:
        Of the BRDF over angle sums from -pi to pi; None for what `wall_as_rendered` takes by itself.
    films:
        Their number, views x patterns.
    terms:
        The predicted error by its parts.
    """

    tolerance: float
    sampling: Sampling
    max_depth: int
    rr_depth: int
    table_nodes: int | None
    films: int
    terms: tuple[Term, ...]

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the films."""
        return total_error(self.terms)

    @property
    def seconds(self) -> float:
        """Predicted for all films."""
        return self.films * self.sampling.seconds


@dataclass(frozen=True, kw_only=True)
class ValidatePlan:
    """How to validate so that a gain error of the tolerance would show.

    Parameters
    ----------
    views, spp:
        Views compared, and samples per pixel of each of the 32 seeds.
    detectable:
        Smallest gain error that this would reject with 99 % power, as predicted.
    """

    views: int
    spp: int
    detectable: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class SolvePlan:
    """What a blind solution of the planned captures will reach.

    Parameters
    ----------
    source_error:
        Relative error of the pattern after the best global scale that the noise of the planned captures allows
        (Cramer-Rao).
    samples_per_pixel:
        Of the same sampler, that would bring it to the tolerance.
    step_deg:
        Widest knot spacing of the BRDF's spline that the films allow at this tolerance.
    knots_error:
        What that spline leaves out of the films.
    quadrature_tolerance:
        For the solver's kernels.
    patterns:
        Realisations with independent patterns, and how many the card needs.
    """

    source_error: float
    samples_per_pixel: int
    step_deg: float
    knots_error: float
    quadrature_tolerance: float
    patterns: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The cheapest way to a tolerance for one scene, with its predicted error by term.

    Parameters
    ----------
    scene:
        Its name.
    tolerance:
        Relative L2 error of the films, over all views, pixels and patterns: rms of the difference from the converged
        radiance in units of its rms. For `solve` it is the relative error of the pattern, for `validate` that of the gain.
    forward, capture, validate, solve:
        What each asks for; None where it was not asked for, or where the scene has no such thing, with the reason in
        `notes`.
    hypotheses:
        The thesis's, and the formula's simplifications, with the error of each alone.
    notes:
        Sentences on what is left out and why.
    seconds:
        What the measuring took.
    """

    scene: str
    tolerance: float
    forward: ForwardPlan | None
    capture: CapturePlan | None
    validate: ValidatePlan | None
    solve: SolvePlan | None
    hypotheses: tuple[Hypothesis, ...]
    notes: tuple[str, ...] = ()
    seconds: float = field(default=0.0, compare=False)

    @property
    def reached(self) -> bool:
        """Whether the forward plan is predicted to keep the tolerance."""
        return self.forward is not None and self.forward.error <= self.tolerance

    def hypothesis(self, key: str) -> Hypothesis:
        """The hypothesis of that key."""
        return next(h for h in self.hypotheses if h.key == key)

    def summary(self) -> dict[str, Any]:
        """The plan as a JSON document."""
        return {
            "scene": self.scene,
            "tolerance": self.tolerance,
            "error_is": "rms over views, pixels and patterns of the difference, over the rms radiance",
            "reached": self.reached,
            "forward": None if self.forward is None else _forward(self.forward),
            "capture": None if self.capture is None else _capture(self.capture),
            "validate": None if self.validate is None else dict(vars(self.validate)),
            "solve": None if self.solve is None else _solve(self.solve),
            "hypotheses": [h.summary(self.tolerance) for h in self.hypotheses],
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


def checked_tolerance(tolerance: float) -> float:
    """A tolerance that a plan can be made for.

    Raises
    ------
    InputError
        Outside SMALLEST to LARGEST.
    """
    if not SMALLEST <= tolerance <= LARGEST:
        raise InputError(
            f"is {tolerance:g}; give a relative error from {SMALLEST:g} to {LARGEST:g}", field="--tolerance"
        )
    return tolerance


def _budget(terms: tuple[Term, ...], seconds: float) -> dict[str, Any]:
    parts = [{**vars(term), "error": _known(term.error)} for term in terms]
    return {"error": _known(total_error(terms)), "terms": parts, "seconds": seconds}


def _known(value: float) -> float | None:
    """A number for JSON; None where it is not finite."""
    return value if math.isfinite(value) else None


def _forward(plan: ForwardPlan) -> dict[str, Any]:
    budget = _budget(plan.terms, plan.seconds)
    return {"route": plan.route, "quadrature": plan.quadrature.summary(), **budget}


def _capture(plan: CapturePlan) -> dict[str, Any]:
    return {
        **{k: v for k, v in plan.sampling.summary().items() if k != "seconds"},
        "max_depth": plan.max_depth,
        "rr_depth": plan.rr_depth,
        "table_nodes": plan.table_nodes,
        "films": plan.films,
        **_budget(plan.terms, plan.seconds),
    }


def _solve(plan: SolvePlan) -> dict[str, Any]:
    document = dict(vars(plan))
    document["source_error"] = _known(plan.source_error)
    document["patterns"] = {"independent": plan.patterns[0], "needed": plan.patterns[1]}
    return document
