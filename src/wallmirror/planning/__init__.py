"""Modelling only what a scene requires: how much each simplification costs here, and the cheapest settings that suffice."""

from wallmirror.planning.hypotheses import Hypothesis
from wallmirror.planning.plan import CapturePlan, ForwardPlan, Plan, SolvePlan, Term, ValidatePlan
from wallmirror.planning.sampling import Sampling

__all__ = ["CapturePlan", "ForwardPlan", "Hypothesis", "Plan", "Sampling", "SolvePlan", "Term", "ValidatePlan"]
