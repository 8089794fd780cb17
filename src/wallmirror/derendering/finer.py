"""What finer knots would gain and coarser ones lose, told from a fit without another one: the tests of Rao and Wald.

At the maximum of the likelihood on some knots the gradient g on knots twice as fine vanishes along the coarser splines.
Were these enough, g^T S^-1 g would be noise, as large as the number of coefficients that are new (Rao, Proc. Cambridge
Phil. Soc. 44(1), 1948); S is the information of r with V eliminated, as in `likelihood`. Conjugate gradients come near
that number from below in a dozen products S x, each of which goes through the pixels once,

    S x = sum_i T_i^T sum_b W_b (1 - F H_b^-1 F^T W_b) (sum_j V_jb T_j x) V_ib,

so that neither S nor the moments of the finer knots are formed. The other way round the fit has S, and what is lost by the
nearest r among the coarser splines, d^T S d, tells whether those can do at all (Wald, Trans. Amer. Math. Soc. 54(3), 1943).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.convex import solve_positive
from wallmirror.derendering.moments import LEAST_SEEN

Array = NDArray[np.float64]

_RIDGE = 1e-10
_STEPS = 24
# The search ends when a step adds less than this share of what was found, or when steps add less than half of what the ones
# before did and so many like the last would not be enough.
_SETTLED = 0.01
_MORE = 4


@dataclass(frozen=True)
class Finer:
    """One Newton step from a fit on finer knots.

    Parameters
    ----------
    gain:
        g^T S^-1 g, or what of it was found when it was clear that it is enough: the fall of sum w (D - F V)^2.
    step:
        S^-1 g, shape (K,).
    free:
        How many of the K coefficients took part.
    """

    gain: float
    step: Array
    free: int


@dataclass(frozen=True)
class Films:
    """The films with a fit to them.

    Parameters
    ----------
    data:
        D, shape (P, B).
    weights:
        w, shape (P, B) or (P, 1).
    transport, source:
        F (P, M) and V (M, B).
    """

    data: Array
    weights: Array
    transport: Array
    source: Array

    @cached_property
    def normal(self) -> Array:
        """H_b, shape (B, M, M), or (1, M, M) for weights of all realisations alike."""
        rows, elements = self.transport.shape
        if self.weights.shape[1] == 1:
            normal = (self.transport.T @ (self.weights * self.transport))[None]
            return np.asarray(normal + 1e-14 * np.trace(normal[0]) * np.eye(elements))
        squares = (self.transport[:, :, None] * self.transport[:, None, :]).reshape(rows, -1)
        normal = (self.weights.T @ squares).reshape(-1, elements, elements)
        normal += 1e-14 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(elements)
        return np.asarray(normal)

    def solved(self, films: Array) -> Array:
        """H_b^-1 F^T W_b of each column, shape (M, B): the V that explains the films best."""
        right = self.transport.T @ (self.weights * films)
        if self.weights.shape[1] == 1:
            return np.asarray(np.linalg.solve(self.normal[0], right))
        return np.asarray(np.linalg.solve(self.normal, right.T[..., None])[..., 0].T)

    def unexplained(self, films: Array) -> Array:
        """W_b (1 - F H_b^-1 F^T W_b) of each column, shape (P, B)."""
        return np.asarray(self.weights * (films - self.transport @ self.solved(films)))

    def condensed(self) -> Films:
        """Films of M columns with the same g and S, where all realisations share their weights: D Q and R^T for V^T = Q R."""
        if self.weights.shape[1] > 1 or self.source.shape[1] <= self.source.shape[0]:
            return self
        q, triangle = np.linalg.qr(self.source.T)
        return replace(self, data=self.data @ q, source=triangle.T)

    def objective(self) -> float:
        """sum w (D - F V)^2."""
        return float(np.sum(self.weights * (self.data - self.transport @ self.source) ** 2))


def score(
    films: Films,
    designs: list[sp.csr_array],
    band: Array,
    free: NDArray[np.bool_],
    *,
    enough: float,
    least: Callable[[int], float] | None = None,
) -> Finer:
    """The Newton step from a fit whose V is the best for its F, on the splines of other designs.

    Parameters
    ----------
    designs:
        T_1 .. T_M on the finer knots, (P, K).
    band:
        Lower band of sum_i T_i^T W T_i, as `banded_gram` makes it, or one alike with that diagonal: with the pattern's mean
        power it stands for S.
    free:
        Coefficients that may move, shape (K,); those among them that the captures do not see are left alone.
    enough:
        Gain at which the search may end.
    least:
        Gain that is asked of so many coefficients that take part: where it is out of reach the search may end as well. Not
        to be given for a V and r that are not the best on the coarser knots.
    """
    films = films.condensed()
    v = films.source
    moving = free & (band[0] > LEAST_SEEN * max(float(band[0].max()), 1e-300))
    asked = 0.0 if least is None else least(int(np.count_nonzero(moving)))
    band = band * float(np.mean(np.sum(v * v, axis=1)))
    band[0] += _RIDGE * float(band[0].max())
    factor = sl.cholesky_banded(band, lower=True, check_finite=False)

    transposed = [t.T for t in designs]

    def back(weighted: Array) -> Array:
        along = v @ weighted.T
        return np.where(moving, sum(t @ row for t, row in zip(transposed, along, strict=True)), 0.0)

    def apply(x: Array) -> Array:
        return back(films.unexplained(np.stack([t @ x for t in designs]).T @ v))

    x = np.zeros(designs[0].shape[1])
    residual = back(films.unexplained(films.data))
    along, before, gain, added = np.zeros_like(x), 1.0, 0.0, 0.0
    for _ in range(_STEPS):
        preconditioned = np.where(moving, sl.cho_solve_banded((factor, True), residual, check_finite=False), 0.0)
        now = float(residual @ preconditioned)
        if not now > 0:
            break
        along = preconditioned + (now / before) * along
        image = apply(along)
        curvature = float(along @ image)
        if not curvature > 0:
            break
        length = now / curvature
        x += length * along
        residual -= length * image
        gain += length * now
        before = now
        fading = length * now < added / 2
        added = length * now
        if gain >= enough or added < _SETTLED * gain or (fading and gain + _MORE * added < asked):
            break
    return Finer(gain, x, int(np.count_nonzero(moving)))


def loss(schur: Array, r: Array, pull: Array, prolongation: sp.csr_array) -> tuple[float, Array]:
    """The rise of the misfit that coarser knots make, as far as it is quadratic and not all of the films, and their r'.

    Parameters
    ----------
    schur, r, pull:
        S at a fit (K, K), whose null vector is r, the global scale; its coefficients (K,); and sum_b J_b^T W d_b (K,).
    prolongation:
        R of shape (K, K'): coefficients r' on the coarser knots are R r'.
    """
    # The films that r' makes along those of r: held, since at the scale 0 nothing would be missed.
    pinned = schur + np.outer(pull, pull) / max(float(pull @ r), 1e-300)
    half = prolongation.T @ pinned
    coarse = half @ prolongation
    coarse[np.diag_indices_from(coarse)] += _RIDGE * np.trace(coarse) / coarse.shape[0]
    nearest = solve_positive(coarse, half @ r)
    missed = r - prolongation @ nearest
    return float(missed @ pinned @ missed), nearest


def worth(added: int, freedom: int) -> float:
    """The fall of the misfit, in units of the noise, that noise alone lets so many more coefficients make in 1 % of cases.

    Akaike's 2 a coefficient would weigh the error that coarse splines make against the noise of finer ones. Error bars
    know of the noise alone, so that coarse knots are kept only while their own error does not show.

    Parameters
    ----------
    freedom:
        Data that are left over to tell the noise by, where it is not stated.
    """
    return added + 2.33 * math.sqrt(2 * added * (1 + added / max(1, freedom)))
