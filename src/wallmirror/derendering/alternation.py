"""The two halves of the thesis's Algorithm 3 on the rows of B_diff that are estimated, and when it stops.

    source:  minimise over 0 <= V <= 1       sum_a |L_a - B_a V|^2                            (4.17)
    BRDF:    minimise over 0 <= B_diff <= 1  sum_a |L_a - B_a V|^2 + alpha |B_diff|_1         (4.16)

with B = U^-1(B_diff). U^-1 repeats rows, so the pixels that share a row may be replaced by their mean with their
number n as its weight: sum |L - B V|^2 = sum n |mean - b V|^2 + what no b and V explain. A half then is one small
quadratic program for each column of V or row of B_diff, all with one Hessian, and is solved exactly (`box_qp`); the
thesis hands it to a general solver (SQP).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.derendering.box_qp import optimality, solve_box_qps
from wallmirror.derendering.chaining import Chain

Array = NDArray[np.float64]

#: Which decrease must fall to the tolerance: see `alternate`.
Stopping = Literal["code", "text"]


@dataclass(frozen=True)
class Grouped:
    """The pixels of each estimated row of B_diff as one.

    Parameters
    ----------
    rows:
        The estimated rows of B_diff, shape (R,).
    upper:
        Upper bounds of their entries: 1, or 0 off the support; shape (R, M).
    weights:
        n, how many pixels share each row, shape (R,).
    mean:
        Their mean radiance, shape (R, B).
    remainder:
        Misfit that no B_diff and V can take away: pixels off the support, and differences within a row.
    """

    rows: NDArray[np.intp]
    upper: Array = field(repr=False)
    weights: Array = field(repr=False)
    mean: Array = field(repr=False)
    remainder: float

    def misfit(self, brdf: Array, source: Array) -> float:
        """sum_a |L_a - B_a V|^2 for b of shape (R, M), without the cancellation of its expanded form."""
        missed = np.sum((self.mean - brdf @ source) ** 2, axis=1)
        return self.remainder + float(self.weights @ missed)


@dataclass(frozen=True)
class Alternation:
    """Where the alternation ended: b (R, M), V (M, B), and how it got there (see `UnstructuredSolution`)."""

    brdf: Array
    source: Array
    objective: Array
    misfit: Array
    decrease: float
    stopped_by: Literal["tolerance", "cap"]
    kkt: float


def group(chain: Chain, radiance: Array, support: NDArray[np.bool_]) -> Grouped:
    """Sum up what the estimated rows have to explain.

    Parameters
    ----------
    radiance:
        Shape (A, N, B).
    support:
        Entries of B_diff that are estimated, shape (rows, M).
    """
    pixels, given = radiance.reshape(-1, radiance.shape[2]), chain.given.ravel()
    rows = np.flatnonzero(np.any(support, axis=1))
    place = np.full(chain.rows, -1)
    place[rows] = np.arange(rows.size)
    label = place[given]
    used = np.flatnonzero(label >= 0)
    members = sp.csr_array((np.ones(used.size), (label[used], used)), shape=(rows.size, given.size))
    weights = np.bincount(label[used], minlength=rows.size).astype(np.float64)
    mean = (members @ pixels) / weights[:, None]
    within = pixels[used] - mean[label[used]]
    outside = pixels[label < 0]
    remainder = float(np.sum(within * within) + np.sum(outside * outside))
    return Grouped(rows, support[rows].astype(np.float64), weights, mean, remainder)


def alternate(
    grouped: Grouped,
    brdf: Array,
    source: Array,
    *,
    alpha: float,
    tolerance: float,
    cap: int,
    stopping: Stopping,
) -> Alternation:
    """Source and BRDF in turn until the decrease falls to the tolerance or the cap is reached (Algorithm 3).

    Parameters
    ----------
    brdf, source:
        b, shape (R, M), and V, shape (M, B), at the start; b need not lie in its box.
    stopping:
        "code": the larger of the decreases of both halves, L1 term included, since the alternation before. "text":
        D2 - D1 as printed, the misfit after the BRDF's half less that after the source's.
    """
    ones = np.ones(source.T.shape)
    weighted = grouped.weights[:, None] * grouped.mean
    # The Hessian of a row is 2 n V V^T; divided by that, what is left of alpha is this.
    shrinkage = alpha / (2 * grouped.weights[:, None])
    history: list[tuple[float, float]] = []
    misfits: list[tuple[float, float]] = []
    kkt, decrease = 0.0, math.inf
    last = (math.inf, math.inf)
    stopped_by: Literal["tolerance", "cap"] = "cap"
    while len(history) < cap:
        hessian, linear = brdf.T @ (grouped.weights[:, None] * brdf), weighted.T @ brdf
        patterns = solve_box_qps(hessian, linear, ones, source.T)
        kkt = max(kkt, optimality(hessian, linear, ones, patterns))
        source = patterns.T
        misfit, sparsity = grouped.misfit(brdf, source), alpha * float(np.sum(np.abs(brdf)))

        hessian, linear = source @ source.T, grouped.mean @ source.T - shrinkage
        brdf = solve_box_qps(hessian, linear, grouped.upper, brdf)
        kkt = max(kkt, optimality(hessian, linear, grouped.upper, brdf))
        misfits.append((misfit, grouped.misfit(brdf, source)))
        history.append((misfit + sparsity, misfits[-1][1] + alpha * float(np.sum(brdf))))

        now = history[-1]
        decrease = misfits[-1][1] - misfit if stopping == "text" else max(last[0] - now[0], last[1] - now[1])
        last = now
        if decrease <= tolerance:
            stopped_by = "tolerance"
            break
    return Alternation(brdf, source, np.array(history), np.array(misfits), decrease, stopped_by, kkt)
