"""What a method of de-rendering hands to the judge: its estimate, before any gauge or verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.information import Information
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm
from wallmirror.errors import InputError

Array = NDArray[np.float64]

# A misfit beyond this many times the stated noise is no chance.
_TOO_MUCH = 1.2


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What one method found, in the solver's own scale and before it is judged.

    Parameters
    ----------
    closed:
        The closed form that it is or that it started from, with its certificates.
    coefficients, source, transport:
        r (K,), V (M, B), F (P, M) with F V = D / scale.
    peak_at:
        Angle sum in radians at which the well-seen part of the BRDF is largest: the gauge.
    source_std:
        Standard deviation of V, shape (M, B), in the gauge where the BRDF's peak is held fixed.
    shape_std:
        Standard deviation of V after the best global scale, shape (M, B).
    brdf_std:
        Standard deviation of rho at given angle sums.
    priors:
        What the answer rests on beside the captures, in words.
    groups:
        Elements that share a scale, each ascending, where there is more than the one global scale.
    designs:
        T_1 .. T_M over the grid, each sparse (P, K), where the method made them.
    information:
        The Fisher information at r and V with the problem's weights, where the method needed it.
    """

    method: str
    grid: SplineGrid
    closed: ClosedForm
    coefficients: Array
    source: Array
    transport: Array
    peak_at: float
    source_std: Array
    shape_std: Array
    brdf_std: Callable[[Array], Array]
    predicted_error: float
    chi_squared: float
    warnings: tuple[str, ...]
    priors: tuple[str, ...] = ()
    groups: tuple[tuple[int, ...], ...] = ()
    designs: list[sp.csr_array] | None = None
    information: Information | None = None


def doubts_of_fit(*, converged: bool, misfit: float | None) -> list[str]:
    """What a fit's end and its misfit, in units of the stated noise variance, say against it; None where none is stated."""
    doubts = []
    if not converged:
        doubts.append("the fit stopped before it converged, so the error bars may be too small")
    if misfit is not None and misfit > _TOO_MUCH:
        doubts.append(
            f"the misfit is {misfit:.2f} times the stated noise, so the model (one bounce, angle-sum BRDF, geometry) or "
            "the stated variances do not hold; the error bars were widened to match"
        )
    return doubts


def scale_free_error(estimate: Array, truth: Array, groups: tuple[tuple[int, ...], ...] = ()) -> float:
    """Relative Frobenius error after the best global scale of the estimate, or the best one of each group of its rows.

    It is inf where the truth is all 0.

    Raises
    ------
    InputError
        For arrays of different shapes, and values that are not finite.

    Examples
    --------
    >>> scale_free_error(np.array([2.0, 4.0]), np.array([1.0, 2.0]))
    0.0
    >>> scale_free_error(np.array([[2.0], [9.0]]), np.array([[1.0], [3.0]]), groups=((0,), (1,)))
    0.0
    """
    arrays = {"estimate": np.asarray(estimate, dtype=np.float64), "truth": np.asarray(truth, dtype=np.float64)}
    for name, values in arrays.items():
        if not np.all(np.isfinite(values)):
            raise InputError("holds a value that is not finite", field=name)
    if arrays["estimate"].shape != arrays["truth"].shape:
        raise InputError(f"has shape {arrays['estimate'].shape}; give {arrays['truth'].shape}", field="estimate")
    if not np.any(arrays["truth"]):
        return math.inf
    # In units of the largest entry each, so that squares neither overflow nor vanish.
    found, sought = (np.atleast_1d(values) / (float(np.max(np.abs(values))) or 1.0) for values in arrays.values())
    parts = [list(group) for group in groups] or [list(range(len(sought)))]
    missed = [_missed(found[part], sought[part]) for part in parts]
    return float(np.linalg.norm(missed) / np.linalg.norm(sought))


def _missed(found: Array, sought: Array) -> float:
    """Frobenius norm of what the best multiple of an array leaves of another."""
    power = float(np.sum(found * found))
    scale = float(np.sum(found * sought)) / power if power > 0 else 0.0
    return float(np.linalg.norm(scale * found - sought))
