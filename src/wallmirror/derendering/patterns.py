"""Do all patterns stand out of the noise? Where one may be noise, the error bars do without it, or there is no answer.

Were there only k - 1 patterns, what a fit shows as the k-th would be noise. To first order it is the noise between the
directions that are left: with U and W the complements of the k - 1 patterns within the span of F and among the
realisations, of sizes M - k + 1 and B - k + 1, the film F V moves there by

    U^T d(F V) W = U^T (F dV + dF V) W = U^T N W,

as V W = 0, and F dV is N - dF V projected onto the span of F. So an error of the BRDF lends the false pattern nothing, but
where it is no small one: coefficients of rho that no other element shows are free to follow the noise together with the
pattern, and each adds a row. The false pattern's strength is the largest singular value of a normal matrix of that size.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound
from wallmirror.derendering.knots import Level
from wallmirror.derendering.pattern_space import too_few_patterns
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import exposures, transport_of
from wallmirror.derendering.subspace import CERTAIN, LIKELY, POSSIBLE, noise_edge

Array = NDArray[np.float64]

# Standard deviation of a coefficient that the other elements leave it, as a share of that of the worst-known one, from which it
# is free: beside a false pattern, which is faint, coefficients of its own grow large. And how well one must be seen to count as
# the worst-known.
_FREE, _SHOWN = 0.3, 1e-8
_DOUBT = (
    "the faintest of the patterns is one that noise alone makes once in ten to a hundred times, so that one element fewer may "
    "be lit; the error bars do without it, and more light or more different patterns would tell"
)


def trusted_bound(
    problem: Problem,
    level: Level,
    transport: Array,
    source: Array,
    *,
    sigma: float,
    bound: Bound,
    bound_at: Callable[[Array], Bound],
) -> tuple[Bound, tuple[str, ...]]:
    """The Cramer-Rao bound of a fit, at those of its patterns that are certainly no noise, and what has to be said of the rest.

    A pattern that noise makes once in ten times is no answer. One that it makes more seldom, but not as seldom as once in
    ten thousand, is taken for real, with error bars that do not count on it: with those patterns alone that are certain
    the films must tell the BRDF as well. If noise makes it once in a hundred times, that is a doubt.

    Parameters
    ----------
    transport, source:
        F (P, M) and V (M, B) that were fitted.
    sigma:
        Standard deviation of the noise in units of the weights.
    bound, bound_at:
        The bound at V, and for another.

    Raises
    ------
    UndeterminedError
        If a pattern is likely noise, or nothing is determined without one that may be.
    """
    elements = source.shape[0]
    triangle = np.linalg.qr(problem.row_weights * transport, mode="r")
    left, strength, right = np.linalg.svd(triangle @ source, full_matrices=False)
    size = (transport.shape[0], source.shape[1], free_coefficients(problem, level, source))
    certain = standing_out(strength / sigma, *size)
    if certain == elements:
        return bound, ()
    # Bounds weaken patterns, false ones and true ones. What noise makes of one is known without them alone.
    films = transport_of(level.designs, level.free.coefficients)
    unbounded = np.linalg.svd(np.linalg.qr(problem.row_weights * films, mode="r") @ level.free.source, compute_uv=False)
    certain = max(certain, standing_out(unbounded / sigma, *size))
    possible = standing_out(unbounded / sigma, *size, units=POSSIBLE)
    if possible < elements:
        raise too_few_patterns(possible, elements)
    if certain == elements:
        return bound, ()
    likely = standing_out(unbounded / sigma, *size, units=LIKELY)
    kept = np.linalg.lstsq(triangle, (left[:, :certain] * strength[:certain]) @ right[:certain], rcond=None)[0]
    wide = max(bound, bound_at(kept), key=lambda each: each.source_error)
    if not math.isfinite(wide.source_error):
        raise too_few_patterns(certain, elements)
    return wide, (_DOUBT,) if likely < elements else ()


def standing_out(strength: Array, rows: int, realisations: int, free: int, units: float = CERTAIN) -> int:
    """How many patterns, from the strongest on, noise of unit variance would not have made beside those before them.

    Parameters
    ----------
    strength:
        Singular values of F V, falling, shape (M,).
    rows, realisations:
        P and B.
    free:
        Coefficients that follow a false pattern, see `free_coefficients`.
    """
    elements = strength.size
    edges = [noise_edge(min(elements + free, rows) - k, realisations - k, units) for k in range(elements)]
    below = np.flatnonzero(strength <= np.array(edges))
    return int(below[0]) if below.size else elements


def free_coefficients(problem: Problem, level: Level, source: Array) -> int:
    """Most coefficients of rho that would be free, were one element dark: those that the others hardly show."""
    pairs, seen = level.summed.pairs, level.summed.seen
    alone = pairs[0].exposures if len(pairs) == 1 else exposures(level.designs, np.square(problem.row_weights[:, 0]))
    shown = alone * np.sum(source * source, axis=1)[:, None]
    by_others = (np.sum(shown, axis=0) - shown)[:, seen]
    variances = np.diag(level.bound.coefficients)
    worst = float(np.max(variances, where=level.summed.exposure[seen] > _SHOWN, initial=0.0))
    return int(np.max(np.count_nonzero(by_others * worst * _FREE**2 < 1, axis=1)))
