"""A capture set made ready for the solvers: normalised data, weights, and the rank that it carries."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.facets import Factor, weighted
from wallmirror.derendering.nested import FINEST_QUADRATURE, NOISY_STEPS, Nested
from wallmirror.derendering.span import Projected, Span
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, noise_edge, signal_space
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Card
from wallmirror.memory import require_memory, solution_bytes
from wallmirror.transport import Kernel, build_kernel, quadrature_orders

Array = NDArray[np.float64]

# Variances below this share of the largest are raised to it: a pixel that saw no noise by luck must not outweigh
# all others, and no spline follows a lobe's tail to better than about a hundredth of the noise at its peak.
_VARIANCE_FLOOR = 1e-4
#: Noise that would make no larger mismatch than this is rounding.
ROUNDING = 1e-20
# Variances in units of the brightest pixel's square: below the first there is only rounding, beyond the second no light.
_SILENT, _DROWNED = 1e-32, 1e60
# Standard deviations above which a radiance stands out of its noise; those that, over the brightest such, say as much as
# infinite ones.
_CLEAR, _DEAF = 5.0, 1e6
# The finest knots of a BRDF into whose span noisy captures are projected, among those of the fit.
_FINEST_SPAN = NOISY_STEPS.index(1.0)
# Noise below this share of the films is none that a projection could be sure of taking away.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Problem:
    """A capture set normalised to order one.

    Parameters
    ----------
    data:
        D / scale, shape (P, B).
    inverse_variance:
        Weights, shape (P, B), 0 for saturated pixels; None for equal weights.
    noisy:
        Pixels whose stated variance is their noise, (P, B): neither saturated nor raised to the floor.
    noise_is_stated:
        Whether the weights are inverse variances of all noise, and not only tell which pixels count.
    exponents:
        Of the factors that the wall has beside a function of the angle sum (`facets`).
    """

    captures: CaptureSet
    data: Array
    inverse_variance: Array | None
    noisy: NDArray[np.bool_]
    noise_is_stated: bool
    scale: float
    exponents: dict[Factor, float] = field(default_factory=dict)
    _kernels: dict[tuple[int, int], Kernel] = field(default_factory=dict, init=False, repr=False, compare=False)
    _nested: dict[tuple[tuple[float, ...], float], Nested] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def card(self) -> Card:
        """The card whose pattern is sought."""
        return self.captures.card

    @cached_property
    def row_weights(self) -> Array:
        """One over the root of each row's mean variance, shape (P, 1): makes the noise of the rows alike.

        A row in which one realisation is saturated would break the rank of the data, so it weighs nothing here, as
        long as half of the rows are left.
        """
        if self.inverse_variance is None:
            return np.ones((self.data.shape[0], 1))
        used = self.inverse_variance > 0
        variance = np.divide(1.0, self.inverse_variance, out=np.zeros_like(self.inverse_variance), where=used)
        count = np.sum(used, axis=1, keepdims=True)
        mean = np.sum(variance, axis=1, keepdims=True) / np.maximum(count, 1)
        whole = count == used.shape[1] if 2 * np.count_nonzero(count == used.shape[1]) >= count.size else count > 0
        weights: Array = np.divide(1.0, np.sqrt(mean), out=np.zeros_like(mean), where=whole & (mean > 0))
        return weights

    @cached_property
    def weighted_data(self) -> Array:
        """D with weighted rows, shape (P, B)."""
        return self.row_weights * self.data

    def weighted(self, designs: list[sp.csr_array]) -> list[sp.csr_array]:
        """T_1 .. T_M with weighted rows."""
        if self.inverse_variance is None:
            return designs
        weights = self.row_weights[:, 0]
        return [
            sp.csr_array((t.data * np.repeat(weights, np.diff(t.indptr)), t.indices, t.indptr), t.shape)
            for t in designs
        ]

    @cached_property
    def fit_weights(self) -> Array:
        """w of the misfit sum w (D - F V)^2: shape (P, B), or (P, 1) where all realisations share them."""
        if self.inverse_variance is None:
            return np.ones((self.data.shape[0], 1))
        first = self.inverse_variance[:, :1]
        return first if np.all(self.inverse_variance == first) else self.inverse_variance

    def kernel(self, step_deg: float, tolerance: float) -> Kernel:
        """The transport's kernel with a quadrature to match one knot spacing; the last one is kept for others like it."""
        observer, card, weights = self.captures.observer, self.captures.card, self.captures.transport
        orders = quadrature_orders(
            observer, card, weights=weights, resolution=2 * math.radians(step_deg), tolerance=tolerance
        )
        if orders not in self._kernels:
            self._kernels.clear()
            self._kernels[orders] = build_kernel(observer, card, weights=weights, orders=orders)
        return weighted(self._kernels[orders], self.exponents)

    def nested(self, steps: tuple[float, ...], quadrature: float, *, keep: bool = False) -> Nested:
        """Nested grids of these knot spacings in degrees; kept ones are handed over to whom asks for the same next."""
        found = self._nested.pop((steps, quadrature), None)
        if found is None:
            found = Nested.of(self.data, self.inverse_variance, self.kernel, steps, quadrature)
        if keep:
            self._nested[steps, quadrature] = found
        return found

    def designs(self, step_deg: float, *, degree: int, tolerance: float) -> tuple[SplineGrid, list[sp.csr_array]]:
        """The spline grid of one knot spacing and the transport over it, with quadrature to match."""
        kernel = self.kernel(step_deg, tolerance)
        grid = grid_for(kernel, step=math.radians(step_deg), degree=degree)
        return grid, design_matrices(kernel, grid)


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
    return problem, _signal_space(problem, weak_patterns=weak_patterns)


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


def _signal_space(problem: Problem, *, weak_patterns: bool) -> SignalSpace:
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


def reduced_misfit(problem: Problem, transport: Array, source: Array, parameters: int) -> float:
    """Weighted squares of D - F V over the noisy pixels, per degree of freedom: 1 where model and stated noise are right.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B).
    parameters:
        Free numbers of the fit.
    """
    weights = problem.inverse_variance if problem.inverse_variance is not None else np.ones(1)
    counted = np.where(problem.noisy, weights * (problem.data - transport @ source) ** 2, 0.0)
    return float(np.sum(counted)) / max(1, int(np.count_nonzero(problem.noisy)) - parameters)


def smoothness(problem: Problem, transport: Array, source: Array) -> float:
    """Correlation of neighbouring pixels in D - F V: near 0 where it is noise, near 1 where the model misses the films.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B).
    """
    missed = (problem.row_weights * (problem.data - transport @ source)).reshape(problem.captures.radiance.shape)
    return float(np.sum(missed[:, 1:] * missed[:, :-1]) / max(float(np.sum(missed**2)), 1e-300))
