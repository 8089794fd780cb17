"""The valley that the card lies in: a lattice of geometries on blurred films, then descents on ever sharper ones.

The valley of the mismatch is as wide as the lobes, and blurring the films along the pixels widens it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.calibration_films import Films, Found, Point
from wallmirror.derendering.problem import Problem
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

# Blur and knot spacing in degrees, rows wanted, points kept and steps taken of the stages that lead into the valley.
_SEARCH = ((2.0, 2.0, 500, 6, 3), (1.0, 1.0, 1000, 3, 5), (0.5, 0.5, 2000, 2, 6))
_EXACT_STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)
_EXACT_ROWS = 10_000
# Spacing of the lattice in radians of theta_s: a blur of 2 deg makes valleys of about twice that.
_LATTICE = 0.2
_MAX_LATTICE = 12
# A mismatch that calls for another search, unless the noise makes it.
_UNEXPLAINED = 0.01
# As in `exact`: at this mismatch rounding is all that is left.
_ROUNDING = 3e-23
_LOST = 1e-13


def search_card(
    problem: Problem, free: tuple[int, ...], search: float, tell: Callable[[str], None]
) -> tuple[Point, Array]:
    """The geometry of least mismatch, from a coarse search or, where that fails, from a finer one.

    Parameters
    ----------
    free:
        Which of offset, distance and width are sought: any of 0, 1 and 2.
    search:
        How far off the card may be, as in `calibrate`.

    Returns
    -------
    The closed form on the raw films, and the largest |g| that counts as within the search, shape (3,).

    Raises
    ------
    UndeterminedError
        When no geometry within reach explains the captures, or another does so nearly as well.
    """
    card = problem.card
    extent = float(np.ptp(card.elements_x)) / card.distance
    share = np.array([search * extent, search, search]) * np.isin(np.arange(3), free)
    reach = 1.25 * np.array([share[0], -math.log1p(-share[1]), -math.log1p(-share[2])])
    noise = _noise_mismatch(problem)
    pitch = math.degrees(problem.captures.observer.fov) / problem.captures.observer.pixels
    best = None
    for spacing, stages in ((_LATTICE, _SEARCH), (_LATTICE / 2, _SEARCH[1:])):
        starts = _lattice(share, extent, spacing)
        for blur, step, rows, kept, steps in stages:
            films = Films.at(problem, blur, max(step, 2 * pitch), 3, rows)
            points = sorted((Point.at(films, g) for g in starts), key=lambda point: point.merit)[:kept]
            points = [_descended(point, free, reach, steps) for point in points]
            starts = [point.g for point in points]
            tell(f"blur {blur:g} deg: mismatch {min(point.mismatch for point in points):.2g}")
        point = _exact(problem, free, reach, starts, tell)
        best = point if best is None or point.merit < best.merit else best
        inside = np.all(np.abs(best.g) <= 0.999 * reach)
        if inside and best.merit < 0.1 and best.mismatch < max(_UNEXPLAINED, 30 * noise):
            return best, reach
    raise UndeterminedError(
        f"no card within {100 * search:.0f} % of the one given explains the captures and alone does so (mismatch "
        f"{best.mismatch if best else 1.0:.2g} at best); give a better guess, search further, or doubt the other hypotheses"
    )


def _lattice(share: Array, extent: float, spacing: float) -> list[Array]:
    """Geometries over the search's reach, no further apart than the spacing in radians of theta_s."""
    axes = []
    # The distance moves theta_s by half as much as the outermost element's offset, at most.
    for j, turn in enumerate((share[0], share[1] / 4, share[2] * extent / 2)):
        steps = 0 if share[j] == 0 else min(_MAX_LATTICE, max(1, math.ceil(turn / spacing)))
        nodes = share[j] * np.linspace(-1, 1, 2 * steps + 1)
        axes.append(nodes if j == 0 else np.log1p(nodes))
    return [np.array(g) for g in itertools.product(*axes)]


def _exact(
    problem: Problem, free: tuple[int, ...], reach: Array, starts: list[Array], tell: Callable[[str], None]
) -> Point:
    """The descent on the raw films, with knots halved while that lowers the mismatch."""
    best, steps = None, 0
    for step in _EXACT_STEPS:
        films = Films.at(problem, 0.0, step, 7, min(_EXACT_ROWS, int(1500 / step)))
        points = [_descended(Point.at(films, g, steps), free, reach, 20) for g in starts]
        point = min(points, key=lambda point: point.merit)
        tell(f"knots every {step:g} deg: mismatch {point.mismatch:.2g}")
        # Not the mismatch alone: knots closer than the pixels explain anything, and the gap says so.
        if best is not None and point.closed.error > best.closed.error / 2:
            break
        best, starts, steps = point, [point.g], point.steps
        if best.mismatch < _ROUNDING:
            break
    assert best is not None
    return best


def _noise_mismatch(problem: Problem) -> float:
    """1 - lambda_1 that noise makes, about: its power over that of the patterns, from the singular values beyond M."""
    realisations, elements = problem.data.shape[1], problem.card.elements
    values = np.asarray(np.linalg.svd(np.linalg.qr(problem.weighted_data)[1], compute_uv=False), dtype=np.float64)
    if realisations == elements:
        return 0.0
    noise = float(np.sum(values[elements:] ** 2)) / (realisations - elements)
    faintest = max(float(values[elements - 1]), 1e-150)
    return float(noise / (faintest * faintest))


def _descended(point: Point, free: tuple[int, ...], reach: Array, most: int) -> Point:
    """Levenberg and Marquardt's descent within the reach, until a step gains less than a part in a thousand."""
    damping = 1e-3
    columns = list(free)
    for _ in range(most):
        gradient, hessian, _ = point.curvature(free)
        diagonal = np.maximum(np.abs(np.diag(hessian)), 1e-30)
        better = None
        while better is None and damping < 1e6:
            g = point.g.copy()
            g[columns] -= np.linalg.solve(hessian + damping * np.diag(diagonal), gradient)
            if np.all(np.abs(g) <= reach):
                trial = Point.at(point.films, g, point.steps + 1)
                better = trial if trial.merit < point.merit else None
            damping *= 0.1 if better is not None else 10
        if better is None:
            break
        gain, point = better.merit / point.merit, better
        if gain > 0.999:
            break
    return point


def settled(point: Point, free: tuple[int, ...]) -> Found:
    """Without noise: a residual of this norm shifts g by no more than that over the root of the curvature."""
    _, hessian, power = point.curvature(free, central=True)
    values, vectors = np.linalg.eigh(hessian)
    # A slope of which BRDF and pattern take up all but this share is lost in the rounding of the differences.
    told = values > _LOST * float(np.sum(power))
    variance = np.where(told, max(point.mismatch, _ROUNDING) / np.where(told, values, 1.0), 1e6)
    covariance = (vectors * variance) @ vectors.T
    return Found(point.g, covariance, math.degrees(point.films.step), point.steps, "closed_form")
