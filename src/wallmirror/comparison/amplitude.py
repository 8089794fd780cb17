"""The least-squares amplitude of a named bias: how pixels are weighed, what it is, and how small a one would be caught."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq

from wallmirror.comparison.verdict import BiasTest

Array = NDArray[np.float64]

#: Chance of rejecting a true model, shared by all tests of one comparison.
SIGNIFICANCE = 1e-3
#: Pixels darker than this share of the brightest are starved: too few samples reach them for a t statistic.
STARVED = 1e-3
#: Relative error that a renderer in float32 has in every sample alike, so that no number of samples averages it away.
FLOAT32 = float(np.finfo(np.float32).eps)
_POWER = 0.99
_FOLDS = 4
# Neighbours whose scatter steadies that of a pixel, and how many seeds their mean is worth.
_NEIGHBOURS = 5
_PRIOR_SEEDS = 10


def in_its_unit(reference: Array, *arrays: Array) -> list[Array]:
    """The arrays over a power of two near the reference's largest value, so that squares stay in range; nothing is rounded."""
    exponent = math.frexp(float(np.max(reference, initial=0.0)))[1]
    with np.errstate(over="ignore"):
        return [np.asarray(np.ldexp(array, -exponent), dtype=np.float64) for array in arrays]


def cross_weights(seeds: Array, reference: Array) -> Array:
    """Inverse variances of the pixels for each seed, as the seeds of the other folds scatter, shape (S, A, N).

    Parameters
    ----------
    seeds, reference:
        As for `compare`.

    Notes
    -----
    Stratified samples leave pixels of one brightness with variances orders of magnitude apart, which no function of
    the reference foretells. A seed's own scatter may not weigh it, since where noise is skewed, mean and scatter go
    together and the amplitude would be biased; the seeds of three other folds may. Their variance in a pixel is drawn
    towards the mean of its neighbours, for 24 seeds know it to 30 % only.
    """
    seeds, reference = in_its_unit(reference, seeds, reference)
    fold = np.arange(seeds.shape[0]) % _FOLDS
    weights = np.empty(seeds.shape)
    for mine in range(_FOLDS):
        others = seeds[fold != mine]
        variance = others.var(axis=0, ddof=1)
        light = float(reference.sum())
        if not (variance.any() and light > 0):
            weights[fold == mine] = 1.0
            continue
        # A floor, so that a pixel in which no path has landed yet is not taken for one without noise.
        floor = 1e-3 * variance.sum() / light * (reference + 1e-3 * reference.max())
        wide = np.pad(variance, ((0, 0), (_NEIGHBOURS // 2, _NEIGHBOURS // 2)), mode="edge")
        prior = np.lib.stride_tricks.sliding_window_view(wide, _NEIGHBOURS, axis=1).mean(axis=-1) + floor
        freedom = others.shape[0] - 1
        shrunk = (freedom * variance + _PRIOR_SEEDS * prior) / (freedom + _PRIOR_SEEDS)
        weights[fold == mine] = shrunk.max() / shrunk
    return weights


def detectable_gain(
    seeds: Array,
    reference: Array,
    *,
    planned: int,
    templates: int = 0,
    edges: NDArray[np.bool_] | None = None,
) -> float:
    """Smallest gain error that `compare` would reject with 99 % power, foretold from fewer seeds than it will have.

    Parameters
    ----------
    seeds, reference, edges:
        As for `compare`, with the pixels' weights that `cross_weights` gives; S >= 8.
    planned:
        Seeds that the comparison will have.
    templates:
        Biases that it will test beside the gain, which share its level.

    Notes
    -----
    A gain's scatter over S seeds is known to 1 / sqrt(2 S - 2) only. Pixels scatter on their own, so that the sum of
    their squared shares knows it far better.
    """
    seeds, reference = in_its_unit(reference, seeds, reference)
    keep = reference > STARVED * float(reference.max(initial=0.0))
    if edges is not None:
        keep &= ~edges
    weights = np.where(keep, cross_weights(seeds, reference), 0.0)
    power = np.einsum("san,an->s", weights, reference**2)
    if not np.all(power > 0):
        return math.inf
    shares = weights * reference * (seeds - reference) / power[:, None, None]
    error = math.sqrt(float(np.mean(np.sum(shares**2, axis=(1, 2)))) / planned)
    return max(
        1e-5 if error < 1e-6 else 0.0, detectable_units(SIGNIFICANCE / (templates + 3), planned) * error + FLOAT32
    )


def bias_test(
    name: str, unit: str, deviation: Array, shape: Array, weights: Array, slack: Array, level: float
) -> BiasTest:
    """Least-squares amplitude of a template in each seed; no seed has a say in its own weights, (S, A, N).

    What deviations of `slack` (A, N), float32's own, can make of the amplitude at most is no bias.
    """
    power = np.einsum("san,an->s", weights, shape * shape)
    if not np.all(power > 0):
        return BiasTest(name, unit, 0.0, math.inf, (-math.inf, math.inf), 1.0, math.inf)
    amplitudes = np.einsum("san,san,an->s", deviation, weights, shape) / power
    count = amplitudes.size
    estimate = float(amplitudes.mean())
    error = float(amplitudes.std(ddof=1)) / math.sqrt(count)
    if error == 0:
        return BiasTest(name, unit, estimate, 0.0, (estimate, estimate), 1.0 if abs(estimate) < 1e-5 else 0.0, 1e-5)
    half = float(stats.t.ppf(0.995, count - 1)) * error
    allowed = float(np.max(np.einsum("an,san,an->s", slack, weights, np.abs(shape)) / power))
    p_value = float(2 * stats.t.sf(max(abs(estimate) - allowed, 0.0) / error, count - 1))
    detectable = detectable_units(level, count) * error + allowed
    return BiasTest(name, unit, estimate, error, (estimate - half, estimate + half), p_value, detectable)


@functools.cache
def detectable_units(level: float, count: int) -> float:
    """The bias, in standard errors, at which 99 % of the noncentral t lie beyond the two-sided threshold."""
    threshold = float(stats.t.isf(level / 2, count - 1))
    return float(brentq(lambda d: stats.nct.sf(threshold, count - 1, d) - _POWER, threshold, 10 * threshold + 10))
