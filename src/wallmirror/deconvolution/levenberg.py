"""Levenberg-Marquardt on normal equations, for least-squares problems whose J^T J has a closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Descent:
    """Where a descent ended: the point, its cost, the steps taken, and whether it came to rest there."""

    point: Array
    cost: float
    steps: int
    at_rest: bool


def descend(
    cost: Callable[[Array], float],
    normal_equations: Callable[[Array], tuple[Array, Array]],
    start: Array,
    *,
    target: float,
    steps: int = 100,
) -> Descent:
    """Minimise a sum of squares from a start.

    Parameters
    ----------
    cost:
        Half the sum of squares at a point (n,).
    normal_equations:
        J^T r (n,) and J^T J (n, n) at a point, up to one common factor.
    target:
        Cost at which nothing is left to gain.
    """
    point, value = start, cost(start)
    damping, rejected = 1e-3, 0
    for step in range(steps):
        if value <= target:
            return Descent(point, value, step, True)
        gradient, matrix = normal_equations(point)
        diagonal = np.diag(matrix).copy()
        diagonal = np.maximum(diagonal, 1e-12 * diagonal.max())
        for _ in range(12):
            damped = matrix + damping * np.diag(diagonal)
            try:
                trial = point - sl.solve(damped, gradient, assume_a="pos")
            except np.linalg.LinAlgError:
                damping *= 10
                continue
            trial_value = cost(trial)
            if trial_value < value:
                break
            damping *= 6
            rejected += 1
        else:
            return Descent(point, value, step, True)  # no direction leads down any more
        gained = (value - trial_value) / value
        point, value = trial, trial_value
        damping = max(damping / 8, 1e-15)
        if gained < 1e-9:
            return Descent(point, value, step + 1, True)
    return Descent(point, value, steps, False)
