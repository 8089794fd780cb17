"""What runs of error against seconds say: the front that nothing beats, slopes, and the seconds to reach an error."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

from wallmirror.errors import InputError
from wallmirror.tradeoff.runs import Run

#: How the seconds to an error are known: by a run that got there, between two runs, or along a line beyond all runs.
How = Literal["measured", "interpolated", "extrapolated"]

_FEWEST = 3  # points of a line whose slope may be trusted


def pareto_front(runs: Sequence[Run]) -> tuple[Run, ...]:
    """The runs that no other beats in both seconds and error, by rising seconds; failures are none of them."""
    front: list[Run] = []
    for run in sorted((r for r in runs if math.isfinite(r.error)), key=lambda r: (r.seconds, r.error)):
        if not front or run.error < front[-1].error:
            front.append(run)
    return tuple(front)


@dataclass(frozen=True)
class Line:
    """y = factor * x^slope, fitted in the logarithms.

    Parameters
    ----------
    slope, standard_error:
        Exponent and its standard error, inf for two points.
    scatter:
        Root mean square of the residuals of log y (natural logarithm).
    low, high:
        Range of x in which it was measured.
    freedom:
        Points less two.
    """

    slope: float
    factor: float
    standard_error: float
    scatter: float
    low: float
    high: float
    freedom: int

    def at(self, x: float) -> float:
        """y at x."""
        return float(self.factor * x**self.slope)

    def where(self, y: float) -> float:
        """x at which the line takes the value y > 0, inf beyond float64; InputError for a level line or another y."""
        if self.slope == 0 or not 0 < y < math.inf:
            raise InputError(f"of slope {self.slope:g} takes the value {y:g} nowhere, or everywhere", field="line")
        power = (math.log(y) - math.log(self.factor)) / self.slope
        return math.exp(power) if power < math.log(sys.float_info.max) else math.inf

    def half_width(self, level: float = 0.95) -> float:
        """Half of the slope's confidence interval, by Student's t from the number of points behind the error."""
        return self.standard_error * float(student.ppf(0.5 + level / 2, self.freedom)) if self.freedom else math.inf


def fit_line(x: ArrayLike, y: ArrayLike) -> Line:
    """Least squares of log y over log x.

    Raises
    ------
    InputError
        For a value that is not positive and finite, and for fewer than two different x.

    Examples
    --------
    >>> round(fit_line([1, 10, 100], [5, 0.5, 0.05]).slope, 12)
    -1.0
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if x.shape != y.shape or np.unique(x).size < 2:
        raise InputError(f"has {x.size} places for {y.size} values; give two different ones at least", field="line")
    if not (np.all((x > 0) & (x < np.inf)) and np.all((y > 0) & (y < np.inf))):
        raise InputError("holds a value that is not positive and finite, which has no logarithm", field="line")
    log_x, log_y = np.log(x), np.log(y)
    centred = log_x - log_x.mean()
    spread = float(np.sum(centred**2))
    slope = float(np.sum(centred * log_y)) / spread
    residual = log_y - log_y.mean() - slope * centred
    freedom = log_x.size - 2
    variance = float(np.sum(residual**2)) / freedom if freedom > 0 else math.inf
    return Line(
        slope=slope,
        factor=math.exp(float(log_y.mean()) - slope * float(log_x.mean())),
        standard_error=math.sqrt(variance / spread),
        scatter=math.sqrt(float(np.mean(residual**2))),
        low=float(np.exp(log_x.min())),
        high=float(np.exp(log_x.max())),
        freedom=max(0, freedom),
    )


@dataclass(frozen=True)
class Reach:
    """Seconds that a method needs for an error, and how that is known.

    Parameters
    ----------
    factor:
        By how much the seconds lie beyond the slowest run, for an extrapolation; else 1.
    line:
        The line along which it was extrapolated.
    """

    seconds: float
    how: How
    factor: float = 1.0
    line: Line | None = None

    @property
    def words(self) -> str:
        """The seconds with their origin, for a sentence."""
        seconds = short_seconds(self.seconds)
        if self.line is not None:
            slope = f"{self.line.slope:.2f} ± {self.line.half_width():.2f}"
            return f"{seconds} (extrapolated {self.factor:,.3g} x beyond its slowest run, along its slope of {slope})"
        return seconds if self.how == "measured" else f"{seconds} (between two runs)"


def reach_by_run(runs: Sequence[Run], error: float) -> Reach | None:
    """Seconds of the quickest run that is at least as exact; None if no run is. Nothing is interpolated."""
    reached = [run.seconds for run in runs if not run.failure and run.error <= error]
    return Reach(min(reached), "measured") if reached else None


def reach_along_line(runs: Sequence[Run], error: float, *, floor: float = 0.0) -> Reach | None:
    """Seconds to an error for a method whose error falls as a power of its work, as Monte Carlo does.

    Between runs: on the straight line between the last run above the error and the next, in the logarithms. Beyond all: the
    work along the line of error over work, whose slope has been measured on the slower half of the runs, and its seconds
    at the price of the last piece of work that was measured.

    Parameters
    ----------
    floor:
        Error that the method cannot fall below; there is no extrapolation to it.

    Returns
    -------
    None if fewer than three runs stand, the line does not fall significantly, or the error is not above the floor.
    """
    good = sorted((run for run in runs if not run.failure), key=lambda r: r.work)
    if len(good) < _FEWEST:
        return None
    above = [i for i, run in enumerate(good) if run.error > error]
    if not above:
        return Reach(good[0].seconds, "measured")
    last = above[-1]
    if last + 1 < len(good):
        a, b = good[last], good[last + 1]
        if b.error == 0 or error == 0:  # no line leads there
            return Reach(b.seconds, "measured")
        share = math.log(a.error / error) / math.log(a.error / b.error)
        return Reach(a.seconds * (b.seconds / a.seconds) ** share, "interpolated")
    line = tail_line(good)
    if error <= floor or not falls(line):
        return None
    before, slowest = good[-2:]
    price = max(0.0, slowest.seconds - before.seconds) / (slowest.work - before.work)
    more = max(0.0, line.where(error) - slowest.work)
    seconds = slowest.seconds + price * more
    return Reach(seconds, "extrapolated", seconds / slowest.seconds, line)


def tail_line(runs: Sequence[Run]) -> Line:
    """Error over work, fitted to the slower half of the runs, but to four of them at least."""
    good = sorted((run for run in runs if not run.failure), key=lambda r: r.work)[-max(4, (len(runs) + 1) // 2) :]
    return fit_line([run.work for run in good], [run.error for run in good])


def falls(line: Line) -> bool:
    """Whether the line's slope lies below 0 by more than its own doubt."""
    return line.slope + line.half_width() < 0


def short_seconds(seconds: float) -> str:
    """Seconds for people: "3.1 ms", "12 s", "2.5 h"."""
    for unit, size in (("µs", 1e-6), ("ms", 1e-3), ("s", 1.0)):
        if seconds < 999.5 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 3600:.3g} h" if seconds >= 3600 else f"{seconds / 60:.3g} min"
