"""The Cramer-Rao bound of a scene before a single capture is taken: what the best possible solver would reach."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from wallmirror.brdf import AngleSumBRDF
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.information import information
from wallmirror.derendering.moments import moments
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.errors import InputError
from wallmirror.geometry import Card, Observer
from wallmirror.transport import Weights, build_kernel, radiance, transport_matrix

Array = NDArray[np.float64]

_DEGREE = 3
_FINEST_DEG, _COARSEST_DEG = 0.05, 4.0
# The least standard deviation over the largest that counts: the root of that of the variances in `problem`.
_FLOOR = 1e-2


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What noise lets a blind solver know, up to one global scale.

    Parameters
    ----------
    source_error, transport_error:
        Expected relative errors (Frobenius norm, after the best global scale) of V and of F; inf where the data would
        not determine them.
    shape_std:
        Standard deviation of each entry of V after the best global scale, shape (M, B).
    known_brdf_error:
        The same as source_error for somebody who knows the BRDF: the price of blindness is the ratio of the two.
    step_deg:
        Knot spacing in degrees of the splines that stand for the BRDF.
    """

    source_error: float
    transport_error: float
    shape_std: Array = field(repr=False)
    known_brdf_error: float
    step_deg: float


def foresee(
    observer: Observer,
    card: Card,
    brdf: AngleSumBRDF,
    source: ArrayLike,
    *,
    noise: ArrayLike,
    weights: Weights = "physical",
    step_deg: float | None = None,
) -> Forecast:
    """Bound the errors of any unbiased blind solution of a scene that is yet to be filmed.

    Parameters
    ----------
    brdf:
        The wall's BRDF, a function of the angle sum.
    source:
        V, shape (M, B).
    noise:
        Standard deviation of the radiance: a number, or an array that broadcasts to (A, N, B). None is taken to be below a
        hundredth of the largest, as by a solver, where those above the brightest radiance do not count.
    step_deg:
        Knot spacing of the splines among which the BRDF is sought; half of the BRDF's own angular scale if left out.
        A solver that must find finer features knows less.

    Raises
    ------
    InputError
        For noise that is not positive, a pattern of another shape, or a spacing out of range.

    Examples
    --------
    >>> import wallmirror as wm
    >>> scene = wm.load_scene("flat_wall_lobes")
    >>> found = foresee(scene.observer, scene.card, scene.wall.brdf, scene.source, noise=0.01)
    >>> 1 < found.source_error / found.known_brdf_error < 2
    True
    """
    source = np.asarray(source, dtype=np.float64)
    if source.ndim != 2 or source.shape[0] != card.elements:
        raise InputError(f"has shape {source.shape}; give one row for each of {card.elements} elements", field="source")
    if source.shape[1] == 0 or not np.all(np.isfinite(source)) or not np.any(source):
        raise InputError("needs at least one pattern, finite and not all dark", field="source")
    shape = (observer.views, observer.pixels, source.shape[1])
    try:
        spread = np.broadcast_to(np.asarray(noise, dtype=np.float64), shape)
    except ValueError:
        raise InputError(f"is no number, nor an array that fits captures of shape {shape}", field="noise") from None
    if not (np.all(np.isfinite(spread)) and np.all(spread > 0)):
        raise InputError("holds a standard deviation that is not positive and finite", field="noise")
    if step_deg is not None and not 0.001 <= step_deg <= 45:
        raise InputError(f"is {step_deg:g}; give a knot spacing from 0.001 to 45 degrees", field="step_deg")
    brightest = float(np.abs(source).max())
    source = source / brightest
    step = step_deg or min(_COARSEST_DEG, max(_FINEST_DEG, math.degrees(brdf.angular_scale) / 2))
    with threadpool_limits(limits=1, user_api="blas"):
        kernel = build_kernel(observer, card, weights=weights, resolution=2 * math.radians(step), tolerance=1e-5)
        grid = grid_for(kernel, step=math.radians(step), degree=_DEGREE)
        designs = design_matrices(kernel, grid)
        transport = transport_matrix(observer, card, brdf, weights=weights, tolerance=1e-6)
        films = radiance(transport, source).reshape(-1, source.shape[1])
        # The bound is proportional to the noise, so that it is found for patterns and noise of order one.
        with np.errstate(over="ignore"):
            over = spread / brightest
            level = float(spread.max(initial=0.0, where=over <= max(float(films.max()), float(np.median(over)))))
            ratio = float(np.float64(level) / brightest)
            inverse = np.maximum(spread / level, _FLOOR).reshape(films.shape) ** -2.0
        summed = moments(films, designs, inverse)
        coefficients = closest_spline(grid, brdf)
        peak_at = grid.peak(coefficients, summed.exposure)
        bound = cramer_rao(summed, coefficients, source, gauge=grid.row(peak_at))
        # F's own error: E |dF|^2 = sum_i tr(T_i Cov T_i^T), less what lies along F, which the scale absorbs.
        gram = sum((t.T @ t for t in designs[1:]), designs[0].T @ designs[0])
        seen = np.flatnonzero(bound.seen)
        gram = gram.toarray()[np.ix_(seen, seen)]
        along = gram @ coefficients[seen]
        power = float(along @ coefficients[seen])
        spilt = float(np.sum(gram * bound.coefficients)) - float(along @ bound.coefficients @ along) / power
        normal = information(summed, coefficients, source).inverse
        known = math.sqrt(float(np.einsum("bii->", normal)) / float(np.sum(source**2)))
    transport_error = ratio * math.sqrt(max(0.0, spilt) / power)
    return Forecast(
        source_error=ratio * bound.source_error,
        transport_error=transport_error if math.isfinite(bound.source_error) else math.inf,
        shape_std=level * bound.shape_std,
        known_brdf_error=ratio * known,
        step_deg=step,
    )


def closest_spline(grid: SplineGrid, brdf: AngleSumBRDF) -> Array:
    """Coefficients of the spline nearest to a BRDF in the mean square, from four samples a knot interval, shape (K,)."""
    u = np.linspace(grid.start, grid.stop, 4 * grid.size)
    first, values = grid.basis(u)
    rows = np.broadcast_to(np.arange(u.size), values.shape)
    columns = first + np.arange(grid.degree + 1)[:, None]
    basis = sp.csc_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(u.size, grid.size))
    return np.asarray(spl.spsolve(sp.csc_array(basis.T @ basis), basis.T @ brdf.of_sum(u)), dtype=np.float64)
