"""Elements that share no coefficient of the BRDF: groups with a scale each, under noise.

Where no angle sum is seen by elements of two groups, rho falls into parts, and each may be scaled against its group's
patterns without a trace in the captures. That is certain from the geometry alone, before anything is fitted; groups that only
a dark stretch of rho keeps apart are not told under noise, and where more than a scale each is free, the bound says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from wallmirror.derendering.likelihood import Fit
from wallmirror.derendering.splines import SplineGrid, transport_of
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Groups:
    """Groups of elements and of coefficients that belong together.

    Parameters
    ----------
    elements:
        Elements of each group, ascending.
    cells:
        Which coefficients its elements see, shape (G, K); none belongs to two.
    """

    elements: tuple[tuple[int, ...], ...]
    cells: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.elements)

    def patterns(self, source: Array) -> Array:
        """V (M, B) of each group alone, (G, B, M): the directions in which a scale of the group moves it."""
        parts = np.zeros((len(self), *source.T.shape))
        for part, mine in zip(parts, map(list, self.elements), strict=True):
            part[:, mine] = source[mine].T
        return parts

    def freed(self, change: Array, source: Array) -> Array:
        """dV (M, B) without what a scale of each group makes of V (M, B): its part along the group's pattern."""
        free = np.copy(change)
        for mine in map(list, self.elements):
            own = source[mine]
            free[mine] -= own * (np.sum(free[mine] * own) / max(float(np.sum(own**2)), 1e-300))
        return free

    def parts(self, coefficients: Array) -> Array:
        """r (K,), or what goes with it, of each group alone, (G, K); those of r are the null directions of S."""
        return np.where(self.cells, coefficients, 0.0)

    def gauges(self, grid: SplineGrid, coefficients: Array, exposure: Array) -> Array:
        """c of each group, (G, K): the basis functions where the well-seen part of its rho is largest."""
        each = zip(self.parts(coefficients), self.parts(exposure), strict=True)
        return np.stack([grid.row(grid.peak(part, seen / np.max(seen))) for part, seen in each])

    def scaled(self, fit: Fit, grid: SplineGrid, exposure: Array) -> Fit:
        """The same fit with every group's pattern positive in sum and its rho 1 at its gauge."""
        r, v = fit.coefficients.copy(), fit.source.copy()
        for elements, mine in zip(self.elements, self.cells, strict=True):
            if np.sum(v[list(elements)]) < 0:
                r[mine], v[list(elements)] = -r[mine], -v[list(elements)]
        for elements, mine, gauge in zip(self.elements, self.cells, self.gauges(grid, r, exposure), strict=True):
            height = float(gauge @ np.where(mine, r, 0.0))
            if height > 0:
                r[mine] /= height
                v[list(elements)] *= height
        return replace(fit, coefficients=r, source=v, schur=None)


def groups_of(designs: list[sp.csr_array]) -> Groups:
    """The groups that share no coefficient of T_1 .. T_M, each (P, K); a single one in most scenes."""
    sees = np.stack([np.bincount(t.indices, minlength=t.shape[1]) > 0 for t in designs])
    shared = sees.astype(np.float64)
    count, label = connected_components(sp.csr_array(shared @ shared.T), directed=False)
    elements = tuple(tuple(int(i) for i in np.flatnonzero(label == group)) for group in range(count))
    return Groups(elements, np.stack([sees[list(group)].any(axis=0) for group in elements]))


def one_group(designs: list[sp.csr_array]) -> Groups:
    """All elements together, whatever they share."""
    return Groups((tuple(range(len(designs))),), np.ones((1, designs[0].shape[1]), dtype=bool))


def closed_form_in_groups(data: Array, designs: list[sp.csr_array], space: SignalSpace, groups: Groups) -> ClosedForm:
    """The closed form of each group's part of rho, put together; mismatch and gap are those of the worst group.

    U spans the patterns of all groups, and |(I - U U^T) T_i r| falls into a sum over them. Parameters as for
    `subspace.closed_form`.
    """
    forms = [closed_form(data, [designs[i] for i in group], space) for group in groups.elements]
    coefficients = np.zeros(designs[0].shape[1])
    for form, mine in zip(forms, groups.cells, strict=True):
        r = np.where(mine, form.coefficients, 0.0)
        coefficients += r if form.exposure @ r > 0 else -r
    transport = transport_of(designs, coefficients)
    worst = max(forms, key=lambda form: form.mismatch)
    return ClosedForm(
        coefficients=coefficients,
        transport=space.basis @ (space.basis.T @ transport),
        source=np.asarray(np.linalg.lstsq(transport, data)[0]),
        mismatch=worst.mismatch,
        gap=min(form.gap for form in forms),
        near_solutions=max(form.near_solutions for form in forms),
        exposure=np.sum([form.exposure for form in forms], axis=0),
        family=coefficients[:, None],
        beyond=min(form.beyond for form in forms),
    )
