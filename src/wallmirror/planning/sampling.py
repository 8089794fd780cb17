"""From the noise of a small pilot render to the samples that reach a tolerance, and what they cost.

Seeds are independent, so that S of them divide the noise by sqrt(S) whatever sampler drew them; the samples of one
seed do so only if they are independent as well. Stratified samples are therefore never extrapolated in the samples
per pixel of a seed, only in the number of seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from wallmirror.errors import InputError

#: How samples of one pixel are drawn.
Sampler = Literal["independent", "multijitter"]

#: Most samples per pixel of one seed: the film adds them in float32.
MOST_SPP = 1024
#: Seeds of stratified samples from whose scatter a film's variance is known well enough for a solver to weigh with.
LEAST_SEEDS = 8
_LEAST_SPP = 16


# Noise falls as one over the root of the samples, of which nobody takes more than the square of this.
_MOST_RATIO = 1e9


@dataclass(frozen=True, kw_only=True)
class NoiseLevel:
    """What one seed of a pilot render cost and how noisy it was.

    Parameters
    ----------
    sampler, spp:
        How it was drawn.
    noise:
        Rms of one seed's noise over the rms radiance.
    seconds:
        Of one seed of one film.
    """

    sampler: Sampler
    spp: int
    noise: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How a film is to be rendered.

    Parameters
    ----------
    sampler, spp, seeds:
        Samples per pixel of each seed, and how many seeds are averaged.
    noise:
        Predicted rms noise of the mean over the rms radiance.
    seconds:
        Predicted, for one film.
    """

    sampler: Sampler
    spp: int
    seeds: int
    noise: float
    seconds: float

    @property
    def total(self) -> int:
        """Samples per pixel in all."""
        return self.spp * self.seeds

    def summary(self) -> dict[str, Any]:
        """As part of a JSON document."""
        return {**vars(self), "samples_per_pixel": self.total}


def cheapest_sampling(levels: Sequence[NoiseLevel], *, noise: float) -> Sampling:
    """The cheapest sampling whose predicted noise is at most `noise`.

    Parameters
    ----------
    levels:
        Pilots. Of independent samples two are needed, or one, whose cost is then taken as proportional to the samples.

    Raises
    ------
    InputError
        If the noise wanted is not positive and finite, or so small that no number of samples gives it, and for no pilot or
        one whose noise or seconds are negative or not finite.

    Examples
    --------
    >>> pilot = NoiseLevel(sampler="multijitter", spp=64, noise=0.04, seconds=0.01)
    >>> cheapest_sampling([pilot], noise=0.01).seeds
    16
    """
    if not (0 < noise < math.inf and levels):
        raise InputError(f"is {noise:g}; give a noise > 0 and a pilot render", field="noise")
    for pilot in levels:
        if not (0 <= pilot.noise < math.inf and 0 <= pilot.seconds < math.inf):
            raise InputError(f"has a noise of {pilot.noise:g} in {pilot.seconds:g} s; give numbers >= 0", field="pilot")
        if pilot.noise > _MOST_RATIO * noise:
            raise InputError(
                f"is {noise:g}, {pilot.noise / noise:.0e} times less than a pilot's; no number of samples gives that",
                field="noise",
            )
    candidates = [*_independent([p for p in levels if p.sampler == "independent"], noise)]
    for pilot in levels:
        if pilot.sampler == "multijitter":
            seeds = max(LEAST_SEEDS, _seeds(pilot.noise, noise))
            candidates.append(_of(pilot.sampler, pilot.spp, seeds, pilot.noise, pilot.seconds))
    return min(candidates, key=lambda c: (c.seconds, c.total))


def _independent(pilots: Sequence[NoiseLevel], noise: float) -> list[Sampling]:
    """One seed of a power of two, or as many of the most as are needed."""
    if not pilots:
        return []
    least, most = min(pilots, key=lambda p: p.spp), max(pilots, key=lambda p: p.spp)
    # One sample's noise: the pilots agree up to their own scatter, and the one of more samples knows it better.
    one = most.noise * math.sqrt(most.spp)
    each = max(0.0, (most.seconds - least.seconds) / (most.spp - least.spp)) if most.spp > least.spp else 0.0
    each = each or most.seconds / most.spp
    start = max(0.0, most.seconds - each * most.spp)
    wanted = (one / noise) ** 2
    spp = min(MOST_SPP, max(_LEAST_SPP, 2 ** math.ceil(math.log2(max(wanted, 1.0)))))
    level = one / math.sqrt(spp)
    return [_of("independent", spp, _seeds(level, noise), level, start + each * spp)]


def _seeds(level: float, noise: float) -> int:
    # A ratio that is a whole number up to rounding is one.
    return max(1, math.ceil((level / noise) ** 2 * (1 - 1e-12)))


def _of(sampler: Sampler, spp: int, seeds: int, noise: float, seconds: float) -> Sampling:
    return Sampling(sampler=sampler, spp=spp, seeds=seeds, noise=noise / math.sqrt(seeds), seconds=seconds * seeds)
