"""The tests of one comparison, all at one level: biases, the largest score of a pixel, and the tiles' uniformity."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from wallmirror.comparison.amplitude import FLOAT32, SIGNIFICANCE, STARVED, bias_test, in_its_unit
from wallmirror.comparison.verdict import Comparison
from wallmirror.errors import InputError

Array = NDArray[np.float64]

_TILE = 10
# What renders and templates may hold over the largest value of the reference, so that no sum of squares overflows.
_LARGEST = 1e100


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
    bright = reference > STARVED * brightest
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
    slack = FLOAT32 * reference
    biases = tuple(
        bias_test(name, unit, deviation, shape, weights, slack, level) for (name, unit), shape in shapes.items()
    )
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


def _beyond(values: Array, slack: Array) -> Array:
    """What of the values lies beyond +-slack, with their signs."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - slack, 0.0), dtype=np.float64)


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
