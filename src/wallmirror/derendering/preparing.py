"""A capture set made ready for the solvers: normalised data and weights, and the space of its patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.pattern_space import space_of_patterns
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.subspace import SignalSpace, signal_space
from wallmirror.errors import UndeterminedError
from wallmirror.memory import require_memory, solution_bytes

Array = NDArray[np.float64]

# Variances below this share of the largest are raised to it: a pixel that saw no noise by luck must not outweigh
# all others, and no spline follows a lobe's tail to better than about a hundredth of the noise at its peak.
_VARIANCE_FLOOR = 1e-4
# Variances in units of the brightest pixel's square: below the first there is only rounding, beyond the second no light.
_SILENT, _DROWNED = 1e-32, 1e60
# Standard deviations above which a radiance stands out of its noise; those that, over the brightest such, say as much as
# infinite ones.
_CLEAR, _DEAF = 5.0, 1e6


def prepare(
    captures: CaptureSet, *, few_captures: bool = False, weak_patterns: bool = False
) -> tuple[Problem, SignalSpace]:
    """Normalise a capture set and find the space of its patterns.

    Parameters
    ----------
    few_captures:
        Let captures of any number and rank pass, for a solver that does not stand on their space.
    weak_patterns:
        Let a rank below M pass where noise, not rounding, hides the rest: a fit of the whole model may find them still.

    Raises
    ------
    UndeterminedError
        When no solver could succeed: coincident elements, too few or too similar patterns, darkness, saturation.
    InputError
        If the memory does not hold the captures and what is made of them.
    """
    views, pixels, realisations = captures.radiance.shape
    elements = captures.card.elements
    require_memory(
        solution_bytes(views, pixels, elements, realisations),
        f"a solution from {views} views x {pixels} pixels x {realisations} realisations",
    )
    if len(set(captures.card.elements_x)) < elements:
        raise UndeterminedError(
            "two elements of the card stand at the same place, so their light cannot be told apart; give each its "
            "own position"
        )
    if not few_captures:
        require_realisations(realisations, elements)
    if views * pixels <= elements:
        raise UndeterminedError(
            f"{views * pixels} pixel(s) cannot determine {elements} elements and a BRDF; use more pixels or views"
        )
    data = captures.radiance.reshape(views * pixels, realisations)
    scale, counts = _brightest(data, captures.variance)
    inverse, noisy, silent = None, np.ones(data.shape, dtype=bool), False
    if captures.variance is not None:
        inverse, noisy, silent = _inverse_variance(captures.variance.reshape(data.shape), scale, counts)
        if not few_captures:
            require_pixels(inverse, elements)
        if captures.variance_is_floor or silent:
            # Rounding is known, the noise above it is not: all pixels alike, the saturated ones out.
            inverse = None if np.all(inverse > 0) else (inverse > 0).astype(np.float64)
    stated = inverse is not None and not captures.variance_is_floor and not silent
    data = np.where(counts, data, np.clip(data, -scale, scale)) / scale
    problem = Problem(captures, data, inverse, noisy, stated, scale)
    if few_captures:
        return problem, signal_space(problem.weighted_data, elements)
    return problem, space_of_patterns(problem, weak_patterns=weak_patterns)


def require_realisations(realisations: int, elements: int) -> None:
    """Refuse fewer patterns than elements, for a solver that stands on their space."""
    if realisations < elements:
        raise UndeterminedError(
            f"{realisations} realisation(s) of the pattern cannot determine {elements} elements; capture at least "
            f"{elements} different patterns, or use the method for few captures"
        )


def require_pixels(weights: Array, elements: int) -> None:
    """Refuse films of which saturation and noise leave fewer pixels than elements, whose patterns nothing determines.

    Parameters
    ----------
    weights:
        Shape (P, B), 0 for pixels that do not count.
    """
    left = np.count_nonzero(weights, axis=0)
    b = int(np.argmin(left))
    if left[b] < elements:
        raise UndeterminedError(
            f"realisation {b} has {left[b]} pixel(s) that are neither saturated nor drowned in noise, which cannot determine "
            f"a pattern of {elements} elements; leave it out, or capture it again"
        )


def _brightest(data: Array, variance: Array | None) -> tuple[float, NDArray[np.bool_]]:
    """The largest radiance that stands out of its noise, and which pixels count, shape (P, B).

    What a saturated pixel holds tells nothing, of the scale neither; no more does one whose noise is so large that it would
    make the scale.
    """
    counts = np.ones(data.shape, dtype=bool) if variance is None else np.isfinite(variance.reshape(data.shape))
    if not np.any(counts):
        raise UndeterminedError("every pixel is saturated; expose for less time and capture again")
    bright = np.abs(data)
    if variance is not None:
        spread = np.sqrt(np.where(counts, variance.reshape(data.shape), 0.0))
        clear = counts & (bright > _CLEAR * spread)
        if np.any(clear):
            scale = float(bright.max(initial=0.0, where=clear))
            return scale, counts & (spread <= _DEAF * scale)
    scale = float(bright.max(initial=0.0, where=counts))
    if scale == 0:
        raise UndeterminedError("every capture is dark; light the card and capture again")
    return scale, counts


def _inverse_variance(
    variance: Array, scale: float, counts: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], bool]:
    """Weights of the pixels in units of the scale, which of them stated their noise, and whether that is but rounding."""
    with np.errstate(over="ignore"):
        variance = np.minimum(variance / scale / scale, _DROWNED)
    largest = float(variance.max(initial=0.0, where=counts))
    if largest > 1:  # a pixel whose noise outshines the brightest sets no floor for the others, unless most are like it
        usual = max(1.0, float(np.median(variance[counts])))
        largest = float(variance.max(initial=0.0, where=counts & (variance <= usual)))
    if largest <= _SILENT:
        return counts.astype(np.float64), counts, True
    floor = _VARIANCE_FLOOR * largest
    return np.where(counts, 1.0 / np.maximum(variance, floor), 0.0), counts & (variance > floor), False
