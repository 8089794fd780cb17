"""Error bars of a pattern and a BRDF behind a card whose own place was found from the captures, and is not known exactly.

With V(g) the best pattern for a card at g, the joint bound is that of a known card and what its place adds (the inverse of
a matrix in blocks):

    Cov(V) = Cov(V | g) + (dV/dg) Cov(g) (dV/dg)^T.

With g_k one standard deviation aside along each principal axis of Cov(g), the second term is the sum of the squares of
V(g_k) - V(g), to first order; the same holds for rho.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.estimate import Estimate
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.solution import Solution

Array = NDArray[np.float64]


def widened(problem: Problem, estimate: Estimate, aside: Sequence[Solution]) -> Estimate:
    """The estimate with error bars that know of the card's place.

    Parameters
    ----------
    aside:
        Solutions for the card one standard deviation aside, on the same knots, in the gauge max rho = 1.
    """
    peak = float(estimate.grid.evaluate(estimate.coefficients, estimate.peak_at))
    v = estimate.source
    there = [other.source / (peak * problem.scale) for other in aside]
    shapes = [w * float(np.sum(w * v)) / float(np.sum(w * w)) - v for w in there]

    def brdf_std(u: Array) -> Array:
        here = estimate.grid.evaluate(estimate.coefficients, u)
        moved = [peak * np.interp(u, other.angle_sum, other.brdf, left=0.0, right=0.0) - here for other in aside]
        return np.asarray(np.sqrt(estimate.brdf_std(u) ** 2 + np.sum(np.square(moved), axis=0)))

    added = float(np.sum(np.square(shapes))) / float(np.sum(v * v))
    return replace(
        estimate,
        source_std=np.sqrt(estimate.source_std**2 + np.sum(np.square([w - v for w in there]), axis=0)),
        shape_std=np.sqrt(estimate.shape_std**2 + np.sum(np.square(shapes), axis=0)),
        brdf_std=brdf_std,
        predicted_error=float(np.sqrt(estimate.predicted_error**2 + added)),
    )
