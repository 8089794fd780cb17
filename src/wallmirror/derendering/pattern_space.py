"""The space of the films' patterns: how many stand out of the noise, in the films or in what a BRDF could make of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.nested import FINEST_QUADRATURE, NOISY_STEPS, Nested
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.span import Projected, Span
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, noise_edge, signal_space
from wallmirror.errors import UndeterminedError

Array = NDArray[np.float64]

#: Noise that would make no larger mismatch than this is rounding.
ROUNDING = 1e-20
#: Where nothing tells the noise, films with a smaller mismatch count as free of it: float64 renders end near 1e-24, float32
#: files near 1e-13.
NOISELESS = 1e-15
# The finest knots of a BRDF into whose span noisy captures are projected, among those of the fit.
_FINEST_SPAN = NOISY_STEPS.index(1.0)
# Noise below this share of the films is none that a projection could be sure of taking away.
_ROUNDING = 1e-6


def too_few_patterns(found: int, elements: int) -> UndeterminedError:
    """The refusal of captures whose patterns do not stand out of the noise."""
    return UndeterminedError(
        f"the captures span only {found} independent pattern(s) above the noise, but the card has "
        f"{elements} elements; capture more different patterns, or more light"
    )


def patterns_space(problem: Problem) -> tuple[SignalSpace, float]:
    """The leading M directions, with the rank counted above the noise's largest singular value, and that value."""
    rows, realisations = problem.data.shape
    elements = problem.card.elements
    floor = noise_edge(rows, realisations) if problem.noise_is_stated else 0.0
    space = signal_space(problem.weighted_data, elements, noise_floor=floor)
    if not problem.noise_is_stated and realisations > elements:
        # The singular values beyond M are noise, those at the lower edge of its spectrum if nothing better is known.
        tail = float(np.sqrt(np.mean(space.singular_values[elements:] ** 2)))
        floor = tail / max(0.5, 1 - math.sqrt(realisations / rows)) / math.sqrt(rows) * noise_edge(rows, realisations)
        rank = int(np.count_nonzero(space.singular_values[:elements] > floor))
        space = replace(space, rank=min(rank, space.rank))
    return space, floor


def space_of_patterns(problem: Problem, *, weak_patterns: bool) -> SignalSpace:
    """The space of the patterns, of the films projected where they do not stand out of them as they are."""
    elements = problem.card.elements
    space, floor = patterns_space(problem)
    if space.rank == elements:
        return space
    certain = floor < _ROUNDING * space.singular_values[0]
    if not certain:
        nested = _nested_for_spans(problem)
        index, within = _within_a_span(problem, nested)
        if within.rank > space.rank:
            prolongation = nested.prolongation(index, _FINEST_SPAN)
            space = within.space(nested.designs(_FINEST_SPAN), problem.row_weights, prolongation)
        if space.rank == elements:
            return space
    if certain or not weak_patterns:
        raise too_few_patterns(space.rank, elements)
    return space


def _within_a_span(problem: Problem, nested: Nested) -> tuple[int, Projected]:
    """The films' projection onto the span of the finest knots on which no pattern drowns, or on which fewest do; their index.

    The coarser the knots, the less noise is left: where patterns drown on the coarsest as well, those between are not tried.
    """
    elements, noise = problem.card.elements, 1.0 if problem.noise_is_stated else None

    def on(index: int) -> tuple[int, Projected]:
        span = Span.of(nested.moments(index), problem.data.shape[0])
        return index, span.projected(elements, noise=noise)

    finest = on(_FINEST_SPAN)
    if finest[1].rank == elements:
        return finest
    coarsest = on(0)
    if coarsest[1].rank < elements:
        return max(finest, coarsest, key=lambda found: found[1].rank)
    between = (on(index) for index in range(_FINEST_SPAN - 1, 0, -1))
    return next((found for found in between if found[1].rank == elements), coarsest)


def _nested_for_spans(problem: Problem) -> Nested:
    """Nested grids whose moments have one weight for all realisations: those of the fit, where these share theirs."""
    if problem.fit_weights.shape[1] == 1:
        return problem.nested(NOISY_STEPS, FINEST_QUADRATURE, keep=True)
    return Nested.of(problem.data, np.square(problem.row_weights), problem.kernel, NOISY_STEPS, FINEST_QUADRATURE)


def expected_mismatch(problem: Problem, space: SignalSpace, closed: ClosedForm) -> float:
    """1 - lambda_1 that noise alone makes in P dimensions: s^2 (P - M) |V^+|^2 / |F|^2, from first-order perturbation of U.

    s^2 is 1 where the rows are whitened by stated variances, else the mean square of the singular values beyond M.
    """
    dimensions, realisations = space.dimensions, problem.data.shape[1]
    elements = problem.card.elements
    if problem.noise_is_stated:
        noise = 1.0
    elif realisations > elements:
        noise = float(np.sum(space.singular_values[elements:] ** 2)) / (dimensions * (realisations - elements))
    else:
        return math.nan
    inverse = np.linalg.pinv(closed.source)
    return float(noise * (dimensions - elements) * np.sum(inverse**2) / np.sum(closed.transport**2))
