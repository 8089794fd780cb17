"""Which elements of a card are tied to each other: parts that share no angle of the BRDF have a scale of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from wallmirror.captures import CaptureSet
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points

Array = NDArray[np.float64]

# A BRDF below this share of its peak ties nothing together.
_DARK = 1e-3


def components(captures: CaptureSet, angle_sum: Array, brdf: Array) -> tuple[tuple[int, ...], ...]:
    """Groups of elements that see some angle sum in common at which the BRDF reflects, each ascending.

    A group's part of the BRDF may be scaled against its part of the pattern without a trace in the captures. That is
    necessary for a scale of its own, not sufficient for having none: the closed form's gap decides.

    Parameters
    ----------
    angle_sum, brdf:
        rho on ascending nodes, in radians and any unit, shape (L,).
    """
    wall = wall_points(captures.observer)[..., None]
    centres = np.asarray(captures.card.elements_x)
    sums = outgoing_angles(captures.observer, wall) + incident_angles(centres, captures.card.distance, wall)
    lit = np.abs(brdf) > _DARK * np.max(np.abs(brdf))
    edges = 0.5 * (angle_sum[1:] + angle_sum[:-1])
    seen = np.zeros((centres.size, angle_sum.size), dtype=bool)
    for element in range(centres.size):
        seen[element, np.searchsorted(edges, sums[..., element].ravel())] = True
    shared = (seen & lit).astype(np.float64)
    count, label = connected_components(csr_array(shared @ shared.T), directed=False)
    return tuple(tuple(int(i) for i in np.flatnonzero(label == group)) for group in range(count))
