"""Is what seems to be known of the pattern made by the noise in the BRDF?

The information along a direction dV of the pattern, after the BRDF has made up for what it can, is the square of

    J = F dV + sum_i T_i dr dV_i,

taken at the r that was found. Noise in that r, of covariance Cov(r), adds on average

    E |sum_i T_i (r' - r) dV_i|^2 = tr(Cov(r) sum_ij (dV dV^T)_ij T_i^T W T_j)

to |F dV|^2, so that a direction of which the true r tells nothing at all (a wall that looks alike to all elements, an element
that no lobe reaches) comes out with bars of some per cent, however little noise there is. Where such borrowed information is
as much as the own, the Cramer-Rao bound at the fit is no bound.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.bounds import Bound
from wallmirror.derendering.groups import Groups
from wallmirror.derendering.information import Information
from wallmirror.derendering.moments import Moments

Array = NDArray[np.float64]

# Steps of the power iteration towards the worst-known direction: it need not be found well, for all bad ones borrow.
_STEPS = 8


def borrowed_share(
    summed: Moments, known: Information, bound: Bound, source: Array, *, sigma: float, groups: Groups
) -> float:
    """What noise adds to the information along the worst-known direction of V, over all that is found there.

    Parameters
    ----------
    summed, known, bound:
        The moments of the films, the information at (r, V), and the bound that it gives.
    source:
        V, shape (M, B).
    sigma:
        Standard deviation of the noise in units of the weights.
    """
    elements, realisations = source.shape
    coupled = known.coupled.reshape(realisations * elements, -1)
    parts = np.zeros((len(groups), realisations, elements))
    for part, mine in zip(parts, map(list, groups.elements), strict=True):
        part[:, mine] = source[mine].T
    scales = parts.reshape(len(groups), -1)
    scales /= np.maximum(np.linalg.norm(scales, axis=1, keepdims=True), 1e-300)

    def turn(dr: Array) -> Array:
        """-dV of a change of r, freed of the scales."""
        dv = coupled @ dr
        return np.asarray(dv - scales.T @ (scales @ dv))

    dr = np.random.default_rng(0).standard_normal(coupled.shape[1])
    variance = 0.0
    for _ in range(_STEPS):
        before = dr / max(float(np.linalg.norm(dr)), 1e-300)
        dr = bound.coefficients @ (coupled.T @ turn(before))
        variance = float(before @ dr)
    if not variance > 0:
        return 0.0
    dv = turn(dr)
    own = float(dv @ dv) / variance
    beside = summed.gram_of_source((coupled @ dr).reshape(realisations, elements))[np.ix_(known.seen, known.seen)]
    return float(sigma**2 * np.sum(beside * bound.coefficients) / own) if own > 0 else 0.0
