"""Monte Carlo against analytic: a statistical statement with an effect size and the smallest bias it could see.

The renders come as S seeds, each an unbiased, independent estimate of the same picture, whatever sampler made
it; the seeds' scatter is the only estimate of noise used. Three kinds of evidence, none sufficient alone:

- per pixel, a t statistic over seeds, turned into a z score; the largest is judged by Sidak's bound, their
  distribution by Kolmogorov and Smirnov's test (per-tile tests after Jung, Hanika, Dachsbacher, JCGT 9(2), 2020);
- per named bias (gain, lobe shift, lobe loss), the least-squares amplitude of its template in each seed, whose
  mean over seeds sees effects far below one pixel's noise;
- for each such bias the equivalence bound: the smallest amplitude this run would have caught at 99 % power
  (two one-sided tests: Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15, 1987).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq

from wallmirror.errors import InputError

Array = NDArray[np.float64]

#: Chance of rejecting a true model, shared by all tests of one comparison.
SIGNIFICANCE = 1e-3
_POWER = 0.99
# Pixels darker than this share of the brightest are starved: too few samples reach them for a t statistic.
_STARVED = 1e-3
_TILE = 10
# Relative error that a renderer in float32 has in every sample alike, so that no number of samples averages it away.
_FLOAT32 = float(np.finfo(np.float32).eps)
_FOLDS = 4
# What renders and templates may hold over the largest value of the reference, so that no sum of squares overflows.
_LARGEST = 1e100
# Neighbours whose scatter steadies that of a pixel, and how many seeds their mean is worth.
_NEIGHBOURS = 5
_PRIOR_SEEDS = 10


@dataclass(frozen=True)
class BiasTest:
    """Amplitude of one named bias in units of its template.

    Parameters
    ----------
    name, unit:
        E.g. "gain" in parts of 1, "lobe shift" in degrees.
    estimate, standard_error, interval:
        Mean over seeds, its standard error and its 99 % confidence interval.
    p_value:
        Of the hypothesis that the amplitude is zero.
    detectable:
        Smallest amplitude that this run would have rejected with 99 % power.
    """

    name: str
    unit: str
    estimate: float
    standard_error: float
    interval: tuple[float, float]
    p_value: float
    detectable: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Verdict of a render against its analytic reference.

    Parameters
    ----------
    passed:
        Whether no test rejects the model at the significance level, shared over the tests (Bonferroni).
    biases:
        The template tests, the gain first.
    z:
        z score of each pixel, (A, N); nan where left out.
    z_mean, z_std:
        Of the kept pixels; (0, 1) is what noise alone makes.
    largest_z, largest_p:
        Largest |z| and its Sidak-corrected p-value.
    uniformity_p:
        Kolmogorov-Smirnov p-value of the tiles' p-values against the uniform distribution.
    tile_p:
        p-value of each tile of pixels, (A, tiles); nan for tiles left out.
    kept, starved, edges:
        Numbers of pixels compared, left out as starved, left out as edges.
    exact:
        Whether the seeds do not scatter at all (a mirror), so that only rounding is left to compare.
    """

    passed: bool
    biases: tuple[BiasTest, ...]
    z: Array = field(repr=False)
    z_mean: float
    z_std: float
    largest_z: float
    largest_p: float
    uniformity_p: float
    tile_p: Array = field(repr=False)
    relative_rms: float
    kept: int
    starved: int
    edges: int
    exact: bool

    @property
    def gain(self) -> BiasTest:
        """The overall factor between render and reference, minus one."""
        return self.biases[0]

    def summary(self) -> dict[str, Any]:
        """Everything but the maps, ready for JSON."""
        return {
            "passed": self.passed,
            "biases": [
                {
                    "name": b.name,
                    "unit": b.unit,
                    "estimate": b.estimate,
                    "standard_error": b.standard_error if math.isfinite(b.standard_error) else None,
                    "interval_99": [end if math.isfinite(end) else None for end in b.interval],
                    "p_value": b.p_value,
                    "detectable_99": b.detectable if math.isfinite(b.detectable) else None,
                }
                for b in self.biases
            ],
            "z_mean": self.z_mean,
            "z_std": self.z_std,
            "largest_z": self.largest_z,
            "largest_p_sidak": self.largest_p,
            "uniformity_p": self.uniformity_p,
            "relative_rms": self.relative_rms,
            "pixels": {"kept": self.kept, "starved": self.starved, "edges": self.edges},
            "exact": self.exact,
        }


def compare(
    seeds: Array,
    reference: Array,
    *,
    templates: dict[tuple[str, str], Array] | None = None,
    edges: NDArray[np.bool_] | None = None,
    weights: Array | None = None,
) -> Comparison:
    """Test whether S renders scatter about an analytic reference.

    Parameters
    ----------
    seeds:
        Independent unbiased renders, shape (S, A, N), S >= 8.
    reference:
        The analytic picture, shape (A, N).
    templates:
        For each further (name, unit) the change of the reference per unit of that bias, shape (A, N).
    edges:
        Pixels to leave out because the reference is discontinuous there, shape (A, N).
    weights:
        Of the pixels in the template tests, shape (A, N) or one set for each seed, (S, A, N). Those of a seed must not
        depend on that seed (`cross_weights`); by default they follow from the reference.

    Raises
    ------
    InputError
        For fewer than eight seeds, shapes that do not match, and values that are not finite, or so large beside the
        reference that squares leave the range of float64.
    """
    if seeds.ndim != 3 or seeds.shape[1:] != reference.shape:
        raise InputError(f"renders of shape {seeds.shape} do not match a reference of shape {reference.shape}")
    if seeds.shape[0] < 8:
        raise InputError(f"{seeds.shape[0]} seeds are too few to know their scatter; render at least 8", field="seeds")
    _require_comparable(seeds, reference, templates or {}, edges, weights)
    seeds, reference, *others = in_its_unit(reference, seeds, reference, *(templates or {}).values())
    for name, values in zip(("seeds", *(f"templates {name}" for name, _ in templates or {})), (seeds, *others)):
        if not np.all(np.abs(values) <= _LARGEST):
            raise InputError(f"holds more than {_LARGEST:g} times what the reference does", field=name)
    templates = dict(zip(templates or {}, others, strict=True))
    brightest = float(reference.max(initial=0.0))
    no_edges = np.ones(reference.shape, dtype=bool) if edges is None else ~edges
    bright = reference > _STARVED * brightest
    deviation = seeds - reference
    scatter = deviation.std(axis=0, ddof=1)
    exact = bool(np.all(scatter[no_edges] <= 1e-6 * brightest))
    keep = no_edges if exact else bright & no_edges  # where nothing scatters, darkness is evidence too
    lit = keep & (brightest > 0)
    if weights is None:
        weights = np.divide(1.0, (reference + 1e-2 * brightest) ** 2, out=np.zeros(reference.shape), where=lit)
    weights = np.broadcast_to(np.where(lit, weights, 0.0), seeds.shape)
    shapes = {("gain", "of 1"): reference, **templates}
    # One level for all tests of this comparison: the biases, the largest score and the tiles.
    level = SIGNIFICANCE / (len(shapes) + 2)
    slack = _FLOAT32 * reference
    biases = tuple(_bias(name, unit, deviation, shape, weights, slack, level) for (name, unit), shape in shapes.items())
    z = _z_scores(deviation, keep, slack, 1e-5 * brightest)
    tile_p = _tile_p(deviation, slack, keep)
    tiles = tile_p[np.isfinite(tile_p)]
    kept = z[keep]
    largest = float(np.max(np.abs(kept), initial=0.0))
    largest_p = float(-np.expm1(kept.size * np.log1p(-2 * stats.norm.sf(largest)))) if largest > 0 else 1.0
    uniformity = float(stats.kstest(tiles, "uniform").pvalue) if tiles.size else 1.0
    relative = deviation.mean(axis=0)[keep] / (brightest or 1.0)
    if not np.any(bright & keep):
        passed = False  # nothing was compared
    elif exact:
        # Without scatter there is nothing to test statistically: float32 rounding of a sum of samples remains.
        passed = bool(np.max(np.abs(relative)) < 1e-5)
    else:
        passed = min([largest_p, uniformity, *(b.p_value for b in biases)]) > level
    return Comparison(
        passed=passed,
        biases=biases,
        z=np.where(keep, z, np.nan),
        z_mean=float(kept.mean()) if kept.size else 0.0,
        z_std=float(kept.std()) if kept.size else 1.0,
        largest_z=largest,
        largest_p=largest_p,
        uniformity_p=uniformity,
        tile_p=tile_p,
        relative_rms=float(np.sqrt(np.mean(relative**2))) if kept.size else 0.0,
        kept=int(keep.sum()),
        starved=int((no_edges & ~keep).sum()),
        edges=int((~no_edges).sum()),
        exact=exact,
    )


def _require_comparable(
    seeds: Array,
    reference: Array,
    templates: dict[tuple[str, str], Array],
    edges: NDArray[np.bool_] | None,
    weights: Array | None,
) -> None:
    """Refuse shapes that do not match and values that are not finite, by the name of what holds them."""
    for (name, _), template in templates.items():
        if template.shape != reference.shape:
            raise InputError(f"has shape {template.shape}; give {reference.shape}", field=f"templates {name}")
    if edges is not None and (edges.shape != reference.shape or edges.dtype != np.bool_):
        raise InputError(f"holds {edges.dtype} of shape {edges.shape}; give bool of {reference.shape}", field="edges")
    if weights is not None and weights.shape not in (reference.shape, seeds.shape):
        raise InputError(f"has shape {weights.shape}; give {reference.shape} or {seeds.shape}", field="weights")
    given = {"seeds": seeds, "reference": reference, **{f"templates {name}": t for (name, _), t in templates.items()}}
    for name, values in given.items():
        if not np.all(np.isfinite(values)):
            raise InputError("holds a value that is not finite", field=name)
    if weights is not None and not (np.all(np.isfinite(weights)) and np.all(weights >= 0)):
        raise InputError("holds a weight that is negative or not finite", field="weights")


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
    keep = reference > _STARVED * float(reference.max(initial=0.0))
    if edges is not None:
        keep &= ~edges
    weights = np.where(keep, cross_weights(seeds, reference), 0.0)
    power = np.einsum("san,an->s", weights, reference**2)
    if not np.all(power > 0):
        return math.inf
    shares = weights * reference * (seeds - reference) / power[:, None, None]
    error = math.sqrt(float(np.mean(np.sum(shares**2, axis=(1, 2)))) / planned)
    return max(1e-5 if error < 1e-6 else 0.0, _units(SIGNIFICANCE / (templates + 3), planned) * error + _FLOAT32)


def _beyond(values: Array, slack: Array) -> Array:
    """What of the values lies beyond +-slack, with their signs."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - slack, 0.0), dtype=np.float64)


def _bias(name: str, unit: str, deviation: Array, shape: Array, weights: Array, slack: Array, level: float) -> BiasTest:
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
    detectable = _units(level, count) * error + allowed
    return BiasTest(name, unit, estimate, error, (estimate - half, estimate + half), p_value, detectable)


@functools.cache
def _units(level: float, count: int) -> float:
    """The bias, in standard errors, at which 99 % of the noncentral t lie beyond the two-sided threshold."""
    threshold = float(stats.t.isf(level / 2, count - 1))
    return float(brentq(lambda d: stats.nct.sf(threshold, count - 1, d) - _POWER, threshold, 10 * threshold + 10))


def _z_scores(deviation: Array, keep: NDArray[np.bool_], slack: Array, rounding: float) -> Array:
    """t over seeds in each pixel, mapped to the normal score of the same probability.

    A pixel that does not scatter at all scores 0 within `rounding`, and beyond it 38, the largest score that float64 knows.
    """
    count = deviation.shape[0]
    error = deviation.std(axis=0, ddof=1) / math.sqrt(count)
    good = keep & (error > 0)
    mean = deviation.mean(axis=0)
    t = np.where(np.abs(mean) > rounding, np.copysign(np.inf, mean), 0.0)
    np.divide(_beyond(mean, slack), error, out=t, where=good)
    # Through the nearer tail, where probabilities keep their precision.
    score = np.minimum(-stats.norm.ppf(stats.t.sf(np.abs(t), count - 1)), 38.0)
    return np.asarray(np.sign(t) * score, dtype=np.float64)


def _tile_p(deviation: Array, slack: Array, keep: NDArray[np.bool_]) -> Array:
    """Two-sided p-value of the t test on the mean of each run of pixels, (A, tiles)."""
    count, views, pixels = deviation.shape
    tiles = pixels // _TILE
    if tiles == 0:
        return np.full((views, 1), np.nan)
    masked = np.where(keep, deviation, 0.0)[:, :, : tiles * _TILE]
    sums = masked.reshape(count, views, tiles, _TILE).sum(axis=-1)
    used = keep[:, : tiles * _TILE].reshape(views, tiles, _TILE).any(axis=-1)
    error = sums.std(axis=0, ddof=1) / math.sqrt(count)
    used &= error > 0
    allowed = np.where(keep, slack, 0.0)[:, : tiles * _TILE].reshape(views, tiles, _TILE).sum(axis=-1)
    t = np.divide(_beyond(sums.mean(axis=0), allowed), error, out=np.zeros(error.shape), where=used)
    p = 2 * stats.t.sf(np.abs(t), count - 1)
    return np.where(used, p, np.nan)
