"""A run of a panel from what was timed: of a model, or of a solver that may refuse."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.derendering.estimate import scale_free_error
from wallmirror.errors import UndeterminedError
from wallmirror.tradeoff.clock import Timing, once
from wallmirror.tradeoff.runs import Run

Array = NDArray[np.float64]


def run_of(
    group: str,
    method: str,
    knobs: Mapping[str, Any],
    timing: Timing,
    error: float,
    *,
    failure: str = "",
    work: float = math.nan,
    **extra: float,
) -> Run:
    """A run of a method, with the time that it took."""
    return Run(
        group=group,
        method=method,
        knobs=knobs,
        seconds=timing.seconds,
        wall_seconds=timing.wall_seconds,
        error=error,
        failure=failure,
        work=work,
        extra=extra,
    )


def solved_run(
    group: str, method: str, knobs: Mapping[str, Any], solver: Callable[[], Array], truth: Array, **extra: float
) -> Run:
    """One call of a solver, with the error of its pattern (M, B) after the best scale, or its refusal."""
    failure = ""

    def attempt() -> Array | None:
        nonlocal failure
        try:
            return solver()
        except UndeterminedError as refusal:
            failure = str(refusal)
            return None

    found, timing = once(attempt)
    error = math.nan if found is None else scale_free_error(found, truth)
    return run_of(group, method, knobs, timing, error, failure=failure, **extra)
