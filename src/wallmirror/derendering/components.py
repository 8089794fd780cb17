"""Which elements of a card are tied to each other: parts that share no angle of the BRDF have a scale of their own.

The graph of shared angles says which groups there are at least. Whether a scale each is all that is free, the BRDFs say
that explain the captures (`separate`): with one lobe that is seen through one element only, V[0] - c V[1] fits as well as
V[0], and more is free than the number of groups.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from wallmirror.captures import CaptureSet
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points

Array = NDArray[np.float64]

# A BRDF below this share of its peak ties nothing together.
_DARK = 1e-3
# Share of a group's BRDF that may be seen by elements of others, or be of another shape than its best, and count as none.
_APART = 1e-6
_NODES = 2401


@dataclass(frozen=True)
class Separated:
    """A solution that consists of groups with a scale each.

    Parameters
    ----------
    groups:
        Elements of each group, ascending.
    coefficients, transport, source:
        r (K,), F (P, M) and V (M, B), each group in the scale in which its well-seen part of rho peaks at 1.
    """

    groups: tuple[tuple[int, ...], ...]
    coefficients: Array
    transport: Array
    source: Array


def separate(
    captures: CaptureSet, data: Array, designs: list[sp.csr_array], grid: SplineGrid, closed: ClosedForm
) -> Separated | None:
    """The answer up to one scale a group, or None where more than that is free.

    Each group must own one BRDF of the family that explains the captures, up to scale: one that its own elements see and
    no others do.

    Parameters
    ----------
    data, designs:
        D (P, B) and T_1 .. T_M (P, K) with the rows weighted alike.
    closed:
        The closed form on them, with its family.
    """
    u = np.linspace(grid.start, grid.stop, _NODES)
    curves = np.stack([grid.evaluate(r, u) for r in closed.family.T])
    groups = components(captures, u, np.sqrt(np.sum(curves**2, axis=0)))
    if len(groups) != closed.family.shape[1]:
        return None
    images = np.stack([t @ closed.family for t in designs])  # (M, P, n)
    seen = np.einsum("ipa,ipb->iab", images, images)
    coefficients = np.zeros(grid.size)
    transport = np.zeros(images.shape[:2]).T
    for group in groups:
        values, vectors = np.linalg.eigh(seen[list(group)].sum(axis=0))
        if values[-1] < 1 - _APART or np.any(values[:-1] > _APART):
            return None
        own = closed.family @ vectors[:, -1]
        image = images[list(group)] @ vectors[:, -1]  # (of the group, P)
        # The well-seen part of the group's own; its sign follows from that of its pattern below.
        exposure = np.sum([designs[i].multiply(designs[i]).sum(axis=0) for i in group], axis=0)
        at = grid.peak(own * np.sign(image.sum()), exposure / exposure.max())
        height = float(grid.evaluate(own, at))
        coefficients += own / height
        transport[:, list(group)] = image.T / height
    source = np.asarray(np.linalg.lstsq(transport, data)[0], dtype=np.float64)
    return Separated(groups, coefficients, transport, source)


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


def named(groups: tuple[tuple[int, ...], ...]) -> str:
    """The groups in words, elements counted from 1."""
    return "; ".join(
        "element" + ("s " if len(group) > 1 else " ") + ", ".join(str(i + 1) for i in group) for group in groups
    )


def in_words(groups: tuple[tuple[int, ...], ...]) -> str:
    """The warning that goes with an answer of several scales."""
    return (
        f"the captures leave {len(groups)} scales open ({named(groups)} share no angle of the BRDF), so brightness compares "
        "within a group alone; use a card or views whose reflections share more angles"
    )
