"""Hypothesis 2 before the fact: would light beyond one bounce bias this solution, and by how much?

The residual of a one-bounce fit cannot tell: interreflection is nearly tangent to the one-bounce model, so that
another pattern explains it. What can tell is the known geometry: the light that card and room send back is computed
from the recovered BRDF (`interreflection`), taken from the films, and the rest is solved again; the change of the
pattern is the bias. It is a forecast and no correction: the light taken away hangs on the wall's albedo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumTable, directional_albedo
from wallmirror.captures import CaptureSet
from wallmirror.derendering.estimate import Estimate, scale_free_error
from wallmirror.derendering.likelihood import maximise, moments
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
from wallmirror.interreflection import from_card, from_room

Array = NDArray[np.float64]

# A bias needs no finer spline than this, in degrees.
_FINEST_DEG = 0.25
_ROUNDS = 3
# A forecast that moves by less than this is good enough for one that is to hold within a factor of two.
_SETTLED = 0.1

#: Wall albedo that is assumed where none is given: a painted wall.
ASSUMED_ALBEDO = 0.5


@dataclass(frozen=True)
class OneBounceCheck:
    """What light beyond one bounce would do to a solution.

    Parameters
    ----------
    share:
        Light beyond one bounce over light of one bounce, in the camera.
    bias:
        Relative change of the pattern (after the best global scale) that it causes.
    wall_albedo, assumed:
        Directional albedo of the wall that sets the BRDF's absolute scale, and whether it was assumed.
    """

    share: float
    bias: float
    wall_albedo: float
    assumed: bool


def beyond_one_bounce(
    captures: CaptureSet, angle_sum: Array, brdf: Array, source: Array, *, wall_albedo: float
) -> Array | None:
    """Radiance beyond one bounce that a recovered BRDF and pattern imply, (A, N, B); None if nothing sends light back.

    Parameters
    ----------
    angle_sum, brdf:
        rho in any scale on nodes in radians, shape (L,).
    source:
        V in the scale that makes F V the captures, shape (M, B).
    wall_albedo:
        Directional albedo of the wall at normal incidence.
    """
    card, room = captures.card, captures.room
    if not _sends_back(captures):
        return None
    nodes = np.linspace(angle_sum[0], angle_sum[-1], angle_sum.size)
    values = np.maximum(np.interp(nodes, angle_sum, brdf), 0.0)
    table = AngleSumTable(start=float(nodes[0]), stop=float(nodes[-1]), values=values)
    scale = wall_albedo / max(directional_albedo(table), 1e-300)
    absolute = AngleSumTable(start=table.start, stop=table.stop, values=scale * table.values)
    level = source / scale
    extra = np.zeros(captures.radiance.shape)
    if card.albedo > 0 and not card.is_points:
        extra += from_card(captures.observer, card, absolute, level)
    if room is not None:
        extra += from_room(captures.observer, card, room, absolute, level)
    return extra


def _sends_back(captures: CaptureSet) -> bool:
    card, room = captures.card, captures.room
    return (card.albedo > 0 and not card.is_points) or (room is not None and room.albedo > 0)


def check_one_bounce(
    problem: Problem, estimate: Estimate, *, wall_albedo: float | None = None
) -> OneBounceCheck | None:
    """Predict the bias of a one-bounce estimate; None where nothing but the wall reflects.

    Parameters
    ----------
    wall_albedo:
        Directional albedo of the wall at normal incidence, which sets the scale of the BRDF; 0.5 is assumed when it
        is left out.
    """
    assumed = wall_albedo is None
    albedo = ASSUMED_ALBEDO if wall_albedo is None else wall_albedo
    grid = estimate.grid
    extra = _further_light(problem, grid, estimate.coefficients, estimate.source, albedo)
    if extra is None:
        return None
    coarse, designs = problem.designs(max(math.degrees(grid.step), _FINEST_DEG), degree=3, tolerance=1e-4)
    start = coarse.interpolate(lambda u: grid.evaluate(estimate.coefficients, u))
    believed = maximise(moments(problem.data, designs, problem.inverse_variance), start)
    # The first forecast comes from a BRDF that is biased itself, so it is made anew from the films freed of it.
    for _ in range(_ROUNDS):
        freed = maximise(moments(problem.data - extra, designs, problem.inverse_variance), start)
        again = _further_light(problem, coarse, freed.coefficients, freed.source, albedo)
        assert again is not None
        change = np.linalg.norm(again - extra) / np.linalg.norm(again)
        extra = again
        if change < _SETTLED:
            break
    return OneBounceCheck(
        share=float(np.sum(extra) / max(float(np.sum(problem.data - extra)), 1e-300)),
        bias=scale_free_error(believed.source, freed.source),
        wall_albedo=albedo,
        assumed=assumed,
    )


def _further_light(
    problem: Problem, grid: SplineGrid, coefficients: Array, source: Array, wall_albedo: float
) -> Array | None:
    """`beyond_one_bounce` of an estimate in the problem's normalised data, (P, B)."""
    if not _sends_back(problem.captures):
        return None
    u = np.linspace(grid.start, grid.stop, 8 * grid.intervals + 1)
    extra = beyond_one_bounce(
        problem.captures, u, grid.evaluate(coefficients, u), source * problem.scale, wall_albedo=wall_albedo
    )
    return None if extra is None else extra.reshape(problem.data.shape) / problem.scale
