"""Where the card really stood: its offset, distance and width recovered from the captures together with pattern and BRDF.

A card that is not where the solver believes it leaves a mismatch 1 - lambda_1 in the closed form (`subspace`), so that
the geometry g = (offset, log distance, log width) which makes it least is the card's. With R_i = (I - U U^T) T_i(g) r
the residual of the closed form and D_j = d(T r)/dg_j, the Gauss-Newton step that keeps r at its optimum (variable
projection; Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973) solves

    [D^T P D - X^T (A - H^T H)^+ X] dg = -D^T (R - mismatch T r),      X_j = sum_i T_i^T (P - mismatch) D_ij,

with P = I - U U^T on each element's rows, and A, H as in `closed_form`. The valley of narrow lobes is as wide as the
lobes, so the search begins on films blurred along the pixels, over a lattice of geometries, and ends on the raw ones
(`calibration_search`).

Under noise the maximum of the joint likelihood of geometry, BRDF and pattern follows, and its Cramer-Rao bound gives the
error bars (`calibration_fit`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wallmirror.captures import CaptureSet
from wallmirror.derendering.calibration_films import Films, Found, Point, card_at, moved
from wallmirror.derendering.calibration_fit import likeliest
from wallmirror.derendering.calibration_search import search_card, settled
from wallmirror.derendering.pattern_space import NOISELESS
from wallmirror.derendering.preparing import prepare
from wallmirror.derendering.problem import Problem
from wallmirror.errors import InputError, UndeterminedError
from wallmirror.geometry import Card

__all__ = ["Calibration", "Parameter", "calibrate", "moved"]

Array = NDArray[np.float64]

Parameter = Literal["x", "y", "width"]

_NAMES: tuple[Parameter, ...] = get_args(Parameter)
_WORDS = {"x": "offset", "y": "distance", "width": "width"}
# A standard deviation of this share of the distance (or of the width) means that the captures know nothing of it.
_UNTOLD = 0.3


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Where the card stood.

    Parameters
    ----------
    card:
        The card moved to where the captures put it; goes into a solve.
    values:
        Centre "x", "y" and "width" (from the first element's centre to the last's) of that card in metres, for the
        parameters that were sought.
    std:
        Their standard deviations in metres: the Cramer-Rao bound with pattern and BRDF unknown too, times the noise.
        Where there is no noise, the largest shift that the remaining mismatch allows.
    aside:
        The card moved from there by one standard deviation along each principal axis of their joint covariance; `solve`
        widens its error bars by what these cards make of pattern and BRDF.
    position_std:
        Standard deviations of each element's x and y in metres, shape (M, 2).
    mismatch_before, mismatch_after:
        1 - lambda_1 of the closed form with the card as given and as found.
    iterations:
        Gauss-Newton steps taken on the raw films.
    method:
        "closed_form" or "maximum_likelihood".
    status:
        A sentence on what was found and what to do next.
    """

    card: Card
    values: Mapping[str, float]
    std: Mapping[str, float]
    aside: tuple[Card, ...] = field(repr=False)
    position_std: Array = field(repr=False)
    mismatch_before: float
    mismatch_after: float
    iterations: int
    method: str
    status: str


def calibrate(
    captures: CaptureSet,
    *,
    parameters: tuple[Parameter, ...] = _NAMES,
    search: float = 0.25,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Find the card's offset, distance and width from the captures alone.

    Parameters
    ----------
    captures:
        Radiance (A, N, B) with the observer's geometry and a rough card.
    parameters:
        What is not known: "x" moves the card along the wall, "y" changes its distance, "width" stretches the spread of
        its elements and their own width.
    search:
        How far off the rough card may be: offset and width relative to its width, distance relative to itself.
    progress:
        Called with a sentence at each stage.

    Raises
    ------
    InputError
        For unknown parameters or a search range outside (0, 0.9].
    UndeterminedError
        When the captures do not tell a parameter, or determine nothing at all.
    """
    free = _checked(captures.card, parameters)
    if not 0 < search <= 0.9:
        raise InputError(f"is {search:g}; give a share > 0 and at most 0.9", field="search")
    tell = progress or (lambda _: None)
    with threadpool_limits(limits=1, user_api="blas"):
        problem, _ = prepare(captures)
        nearest, reach = search_card(problem, free, search, tell)
        if problem.noise_is_stated or nearest.closed.mismatch > NOISELESS:
            result = likeliest(problem, free, nearest, reach, tell)
        else:
            result = settled(nearest, free)
        return _concluded(problem, free, result)


def _checked(card: Card, parameters: tuple[Parameter, ...]) -> tuple[int, ...]:
    unknown = [name for name in parameters if name not in _NAMES]
    if unknown or not parameters or len(set(parameters)) < len(parameters):
        raise InputError(f"is {parameters!r}; name each of x, y, width at most once", field="parameters")
    if card.elements < 2:
        raise UndeterminedError(
            "one element looks the same from everywhere to someone who does not know the BRDF; calibrate with a card "
            "of two or more elements"
        )
    return tuple(_NAMES.index(name) for name in parameters)


def _concluded(problem: Problem, free: tuple[int, ...], result: Found) -> Calibration:
    """From logarithms to metres, and the verdict."""
    card = problem.card
    found = card_at(card, result.g)
    spread = np.asarray(found.elements_x) - float(np.mean(found.elements_x))
    width = float(np.ptp(found.elements_x))
    std = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    untold = [_WORDS[_NAMES[j]] for j, s in zip(free, std) if not s < _UNTOLD]
    if untold:
        raise UndeterminedError(
            f"the captures do not tell the card's {' and '.join(untold)} from its pattern and the BRDF: every angle sum "
            "shifts by nearly as much whatever it is; measure it and leave it out of the parameters, or move the card "
            "nearer to the wall"
        )
    metres = {"x": card.distance, "y": found.distance, "width": width}
    everything = np.zeros((3, 3))
    everything[np.ix_(free, free)] = result.covariance
    along_x = np.stack([np.full(spread.size, card.distance), np.zeros(spread.size), spread], axis=1)
    x_variance = np.einsum("mj,jk,mk->m", along_x, everything, along_x)
    y_std = found.distance * math.sqrt(max(everything[1, 1], 0.0))
    variances, axes = np.linalg.eigh(everything)
    shifts = [math.sqrt(v) * axis for v, axis in zip(variances, axes.T, strict=True) if v > 0]
    values = {"x": float(np.mean(found.elements_x)), "y": found.y, "width": width}
    before, after = (_mismatch(problem, at, result.step_deg) for at in (card, found))
    return Calibration(
        card=found,
        values={_NAMES[j]: values[_NAMES[j]] for j in free},
        std={_NAMES[j]: metres[_NAMES[j]] * float(s) for j, s in zip(free, std)},
        aside=tuple(card_at(card, result.g + shift) for shift in shifts),
        position_std=np.stack([np.sqrt(np.maximum(x_variance, 0.0)), np.full(spread.size, y_std)], axis=1),
        mismatch_before=before,
        mismatch_after=after,
        iterations=result.steps,
        method=result.method,
        status=_status(result, before, after),
    )


def _mismatch(problem: Problem, card: Card, step_deg: float) -> float:
    """1 - lambda_1 of all rows with one card."""
    films = Films.at(problem, 0.0, step_deg, 7, None)
    there = replace(problem, captures=replace(problem.captures, card=card))
    return Point.at(replace(films, problem=there), np.zeros(3)).mismatch


def _status(result: Found, before: float, after: float) -> str:
    found = f"Moved the card: the closed form's mismatch falls from {before:.1g} to {after:.1g}."
    if result.excess > 1.2:
        return (
            f"{found} But the misfit is {result.excess:.2g} times the noise: the card is no scaled copy of the one given, "
            "lay further off than the search reached, or another hypothesis fails; the error bars are too small."
        )
    return f"{found} Solve with the returned card, and hand this calibration on for the error bars."
