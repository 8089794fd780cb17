"""Where a search from random patterns ends: the different ends, what a finer grid makes of them, and whether they agree."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from wallmirror.derendering.elimination import Point, System, climb
from wallmirror.derendering.estimate import scale_free_error
from wallmirror.derendering.rivals import SAME

# Ends that are kept, for a flat valley has many.
_CARRIED = 24
#: Patterns within the noise of each other are one as well, but never those that differ by more than this.
APART = 0.2
#: A misfit below this is rounding.
ROUNDING = 1e-13
_HOPELESS = 10.0


@dataclass
class End:
    """A pattern that starts ended at, and how many of them did."""

    point: Point
    reached: int


def search(
    system: System,
    elements: int,
    found: list[End],
    rng: np.random.Generator,
    starts: int,
    *,
    nonnegative: bool,
) -> list[End]:
    """What is found already, and what some more random patterns lead to."""
    shape = (elements, system.data.shape[1])
    for n in range(starts):
        # Every other start is uneven: patterns of few bright elements lie in corners that even ones seldom reach.
        v = rng.random(shape) ** (1 + 3 * (n % 2)) if nonnegative else rng.standard_normal(shape)
        found = distinct([*found, End(climb(system, v, None, nonnegative=nonnegative), 1)])
    return found


def refined(system: System, coarse: System, candidate: End, *, nonnegative: bool) -> End:
    """The same pattern on a finer grid, from the coarse BRDF."""
    whole = np.zeros(coarse.grid.size)
    whole[coarse.cells] = candidate.point.r / coarse.scale
    r = system.grid.interpolate(lambda u: coarse.grid.evaluate(whole, u))[system.cells] * system.scale
    return End(climb(system, candidate.point.v, r, nonnegative=nonnegative), candidate.reached)


def distinct(candidates: Iterable[End]) -> list[End]:
    """Different patterns, best first, each with the number of starts that ended there."""
    kept: list[End] = []
    for candidate in sorted(candidates, key=lambda c: c.point.objective):
        twin = next((k for k in kept if scale_free_error(candidate.point.v, k.point.v) < SAME), None)
        if twin is None:
            kept.append(End(candidate.point, candidate.reached))
        else:
            twin.reached += candidate.reached
    return kept[:_CARRIED]


def in_question(candidates: list[End]) -> list[End]:
    """Those whose misfit a finer grid, or a wall of facets, might still bring down to the best's."""
    return [
        c for c in candidates if c.point.objective <= _HOPELESS**2 * max(candidates[0].point.objective, ROUNDING**2)
    ]


def disagree(candidates: list[End]) -> bool:
    """Whether some of those differ by more than noise makes one pattern differ."""
    best, *others = in_question(candidates)
    return any(scale_free_error(other.point.v, best.point.v) > APART for other in others)


def pays(coarse: Point, fine: Point, system: System) -> bool:
    """Whether the finer grid explains more than as many coefficients would of noise (Akaike 1974)."""
    added = max(1, fine.free.size - coarse.free.size)
    return coarse.objective - fine.objective > 2 * added * fine.objective / max(1, system.freedom)
