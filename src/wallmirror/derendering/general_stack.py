"""Captures from several positions as one problem over one table, and what they say of each value of the table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.pattern_space import patterns_space, too_few_patterns
from wallmirror.derendering.preparing import prepare, require_pixels, require_realisations
from wallmirror.derendering.problem import Problem
from wallmirror.derendering.splines import SplineGrid
from wallmirror.derendering.subspace import ClosedForm, SignalSpace, closed_form
from wallmirror.derendering.tables import TableGrid
from wallmirror.errors import UndeterminedError
from wallmirror.transport import Kernel, build_kernel

Array = NDArray[np.float64]

# Ridge of the resolution without noise, as a share of the best-seen cell's information; spacing of the nodes that tell.
_QUIET_RIDGE = 1e-9
_NODES_DEG = 2.0
_CHUNK = 500


@dataclass(frozen=True)
class Stack:
    """The capture sets as one problem: rows of all positions under each other.

    Parameters
    ----------
    problem, space:
        The data of all positions at one scale, and the space of their patterns.
    captures:
        One set for each position.
    reciprocal:
        Whether the table is mirrored at its diagonal.
    """

    problem: Problem
    space: SignalSpace
    captures: tuple[CaptureSet, ...]
    reciprocal: bool

    @classmethod
    def of(cls, captures: Sequence[CaptureSet], reciprocal: bool) -> Stack:
        """Each set prepared by itself, then brought to one scale.

        Raises
        ------
        UndeterminedError
            When the positions together do not show as many patterns as the card has elements; one alone need not.
        """
        require_realisations(captures[0].realisations, captures[0].card.elements)
        parts = [_part_of(c, f"capture set {n} of {len(captures)}") for n, c in enumerate(captures, 1)]
        scale = max(p.scale for p in parts)
        ratios = [p.scale / scale for p in parts]
        data = np.concatenate([p.data * ratio for p, ratio in zip(parts, ratios, strict=True)])
        stated = all(p.noise_is_stated for p in parts)
        inverse = None
        if any(p.inverse_variance is not None for p in parts):
            inverse = np.concatenate([_weights(p, ratio, stated) for p, ratio in zip(parts, ratios, strict=True)])
            require_pixels(inverse, captures[0].card.elements)
        noisy = np.concatenate([p.noisy for p in parts])
        problem = Problem(captures[0], data, inverse, noisy, stated, scale)
        space, _ = patterns_space(problem)
        if space.rank < problem.card.elements:
            raise too_few_patterns(space.rank, problem.card.elements)
        return cls(problem, space, tuple(captures), reciprocal)

    def designs(self, step_deg: float, degree: int) -> tuple[TableGrid, list[sp.csr_array]]:
        """The table of one knot spacing and T_1 .. T_M over it."""
        step = math.radians(step_deg)
        kernels = [
            build_kernel(c.observer, c.card, weights=c.transport, resolution=2 * step, tolerance=1e-9)
            for c in self.captures
        ]
        ends = [[f(getattr(k, name)) for name in ("theta_s", "theta_o") for f in (np.min, np.max)] for k in kernels]
        low_s, high_s, low_o, high_o = (float(f(e)) for f, e in zip((min, max, min, max), zip(*ends), strict=True))
        if self.reciprocal:
            low_s, high_s = low_o, high_o = min(low_s, low_o), max(high_s, high_o)
        across = SplineGrid.covering(low_s, high_s, step=step, degree=degree)
        along = SplineGrid.covering(low_o, high_o, step=step, degree=degree)
        grid = TableGrid(across, along, self.reciprocal)
        return grid, [sp.csr_array(sp.vstack([_part(grid, k, i) for k in kernels])) for i in range(self.elements)]

    @property
    def elements(self) -> int:
        """M."""
        return self.problem.card.elements

    @property
    def places(self) -> int:
        """Number of positions that the captures were taken from."""
        return len({c.observer.position for c in self.captures})

    def closed(self, designs: list[sp.csr_array]) -> ClosedForm:
        """The closed form over the table."""
        return closed_form(self.problem.weighted_data, self.problem.weighted(designs), self.space)

    def peak(self, grid: TableGrid, r: Array) -> Array:
        """The basis functions' values, shape (size,), where the captures saw the largest value of the table."""
        best, row = -math.inf, np.zeros(grid.size)
        for c in self.captures:
            kernel = build_kernel(c.observer, c.card, weights="thesis")
            for i in range(self.elements):
                rows = _part(grid, Kernel(kernel.theta_s, kernel.theta_o, np.ones(kernel.weight.shape)), i)
                values = rows @ r
                p = int(np.argmax(values))
                if values[p] > best:
                    best, row = float(values[p]), rows[[p]].toarray()[0]
        return row


def _part_of(captures: CaptureSet, name: str) -> Problem:
    try:
        return prepare(captures, few_captures=True)[0]
    except UndeterminedError as refusal:
        raise UndeterminedError(f"{name}: {refusal}") from None


def _weights(part: Problem, ratio: float, stated: bool) -> Array:
    weights = np.ones(part.data.shape) if part.inverse_variance is None else part.inverse_variance
    return np.asarray(weights / ratio**2 if stated else weights > 0, dtype=np.float64)


def _part(grid: TableGrid, kernel: Kernel, element: int) -> sp.csr_array:
    shape = kernel.weight.shape
    angles = (np.broadcast_to(a, shape)[:, :, element] for a in (kernel.theta_s, kernel.theta_o, kernel.weight))
    return grid.rows(*(a.reshape(-1, shape[3]) for a in angles))


def exposure(designs: list[sp.csr_array]) -> Array:
    """How well each coefficient is seen, 1 for the best-seen, shape (K,)."""
    total = np.sum([np.asarray(t.multiply(t).sum(axis=0)).ravel() for t in designs], axis=0)
    return np.asarray(total / max(float(total.max()), 1e-300), dtype=np.float64)


def resolution(stack: Stack, grid: TableGrid, designs: list[sp.csr_array], source: Array, ridge: float) -> Array:
    """How far the captures, and not the ridge, decide the table's value at uniform nodes, from 0 to 1, shape (n_s, n_o).

    It is 1 - ridge phi (A + ridge)^-1 phi / |phi|^2, with A the information on r when the patterns are known: the share
    that the captures take of the variance which the value had before them.
    """
    power = np.sum(source**2, axis=1)
    weighted = stack.problem.weighted(designs)
    information = sp.csr_array(sum(v * (t.T @ t) for v, t in zip(power, weighted, strict=True))).toarray()
    ridge = max(ridge, _QUIET_RIDGE * float(np.max(np.diag(information))))
    information[np.diag_indices_from(information)] += ridge
    factor = sl.cho_factor(information, lower=True, overwrite_a=True, check_finite=False)
    inverse = sl.cho_solve(factor, np.eye(information.shape[0]), overwrite_b=True, check_finite=False)
    nodes = []
    for line in (grid.theta_s, grid.theta_o):
        count = 1 + math.ceil((line.stop - line.start) / math.radians(_NODES_DEG))
        nodes.append(np.linspace(line.start, line.stop, count))
    s, o = (a.reshape(-1, 1) for a in np.meshgrid(*nodes, indexing="ij"))
    rows = grid.rows(s, o, np.ones(s.shape))
    left = np.concatenate(
        [np.asarray(part.multiply(part @ inverse).sum(axis=1)).ravel() for part in _slices(rows, _CHUNK)]
    )
    before = np.asarray(rows.multiply(rows).sum(axis=1)).ravel()
    return np.asarray(np.clip(1 - ridge * left / before, 0.0, 1.0).reshape(nodes[0].size, nodes[1].size))


def _slices(rows: sp.csr_array, size: int) -> list[sp.csr_array]:
    return [rows[start : start + size] for start in range(0, rows.shape[0], size)]
