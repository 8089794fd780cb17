"""Nested spline grids over the angle sums of some films, with the transport and the films' moments on each.

Every grid halves the knot spacing of the one before, so that the splines of each lie among those of the next, and the moments
of coarser knots follow from those of finer ones without a look at the pixels. Whatever it is, it is made when first asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.moments import Moments, moments
from wallmirror.derendering.splines import SplineGrid, design_matrices
from wallmirror.transport import Kernel

Array = NDArray[np.float64]

#: Knot spacings in degrees that a fit to noise chooses from, each half of the one before.
NOISY_STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
#: Quadrature of the fit, of a lobe's peak, if nothing allows a coarser one.
FINEST_QUADRATURE = 1e-5
# That of the closed form: splines of degree 3 need knots half as far apart for lobes of the same width.
_DEGREE = 7


@dataclass(frozen=True)
class Nested:
    """The grids, coarsest first, and what belongs to each by its index.

    Parameters
    ----------
    data, inverse_variance:
        D (P, B) and its weights, (P, B) or (P, 1), or None for equal ones.
    kernel:
        The transport's kernel with a quadrature for a knot spacing in degrees and an error of a lobe's peak.
    quadrature:
        That error.
    """

    data: Array
    inverse_variance: Array | None
    kernel: Callable[[float, float], Kernel]
    grids: tuple[SplineGrid, ...]
    quadrature: float
    _designs: dict[int, list[sp.csr_array]] = field(default_factory=dict)
    _moments: dict[int, Moments] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        data: Array,
        inverse_variance: Array | None,
        kernel: Callable[[float, float], Kernel],
        steps: tuple[float, ...],
        quadrature: float,
    ) -> Nested:
        """Over all angle sums; one spacing in degrees, or several, each half of the one before."""
        u = kernel(steps[-1], quadrature).angle_sum
        room = math.radians(steps[-1]) if len(steps) > 1 else 0.0  # other quadratures reach a little further
        low, high = float(u.min()) - room, float(u.max()) + room
        grids = [SplineGrid.covering(low, high, step=math.radians(steps[0]), degree=_DEGREE)]
        for _ in steps[1:]:
            grids.append(grids[-1].halved())
        return cls(data, inverse_variance, kernel, tuple(grids), quadrature)

    @property
    def last(self) -> int:
        """Index of the finest grid."""
        return len(self.grids) - 1

    def designs(self, index: int) -> list[sp.csr_array]:
        """T_1 .. T_M, each sparse (P, K)."""
        if index not in self._designs:
            # One quadrature for all knots but the finest, so that their misfits differ for the knots' sake alone.
            step = math.degrees(self.grids[max(index, self.last - 1)].step)
            self._designs[index] = design_matrices(self.kernel(step, self.quadrature), self.grids[index])
        return self._designs[index]

    def designed(self, index: int) -> int:
        """The coarsest knots, from these on, whose designs are made; these if none are."""
        return min((finer for finer in self._designs if finer >= index), default=index)

    def prolongation(self, index: int, finer: int) -> sp.csr_array:
        """R of shape (K, K'): coefficients r' of one grid are R r' on a finer one."""
        product = sp.eye_array(self.grids[index].size, format="csr")
        for grid in self.grids[index:finer]:
            product = sp.csr_array(grid.in_halved() @ product)
        return product

    def moments(self, index: int) -> Moments:
        """What the likelihood needs of the data."""
        if index not in self._moments:
            if index + 1 < self.last and (self.holds(index + 1) or index + 2 < self.last):
                # Every search that comes to the coarsest knots tries the next ones, of which theirs follow at once.
                made = self.moments(index + 1).coarser(self.grids[index].in_halved())
            else:
                made = moments(self.data, self.designs(index), self.inverse_variance)
            self._moments[index] = made
        return self._moments[index]

    def holds(self, index: int) -> bool:
        """Whether the moments are made already."""
        return index in self._moments
