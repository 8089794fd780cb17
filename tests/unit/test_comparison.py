"""The test bench's own test: what it says about noise alone, about planted faults, and about what it could see."""

from __future__ import annotations

import functools
import json
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from wallmirror.comparison import SIGNIFICANCE, BiasTest, Comparison, compare, detectable_gain
from wallmirror.errors import InputError

from .helpers import refused

Array = NDArray[np.float64]

SEEDS, VIEWS, PIXELS = 12, 2, 40
RUNS = 2000


def picture() -> Array:
    """A smooth lit wall, some pixels of it dark."""
    x = np.linspace(0, 6, PIXELS)
    return np.stack([1 + 0.5 * np.sin(x), 0.5 + 0.4 * np.cos(x)])


def shift() -> Array:
    """What one unit of another bias does: a lobe moved sideways."""
    return np.gradient(picture(), axis=1) * 10


TEMPLATES = {("lobe shift", "deg"): shift()}


def noisy(rng: np.random.Generator, seeds: int = SEEDS) -> Array:
    """Independent, normal, brighter where the picture is: what seeds of a Monte Carlo renderer add."""
    return 0.05 * (0.2 + picture()) * rng.standard_normal((seeds, VIEWS, PIXELS))


@functools.cache
def null() -> tuple[list[Comparison], list[Array]]:
    """Comparisons of a true model, and their seeds."""
    rng = np.random.default_rng(1)
    seeds = [picture() + noisy(rng) for _ in range(RUNS)]
    return [compare(s, picture(), templates=TEMPLATES) for s in seeds], seeds


def p_values(comparisons: list[Comparison]) -> dict[str, Array]:
    return {
        "gain": np.array([c.biases[0].p_value for c in comparisons]),
        "lobe shift": np.array([c.biases[1].p_value for c in comparisons]),
        "largest": np.array([c.largest_p for c in comparisons]),
        "uniformity": np.array([c.uniformity_p for c in comparisons]),
        "tiles": np.concatenate([c.tile_p.ravel() for c in comparisons]),
    }


# -- noise alone ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gain", "lobe shift", "largest", "uniformity", "tiles"])
def test_under_noise_alone_every_p_value_is_uniform(name: str) -> None:
    p = p_values(null()[0])[name]
    assert p.size >= RUNS
    # One draw of fixed seed: 1e-4 for each of five tests.
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    # And the tail that decides: as many below 5 % as a binomial count gives, four standard deviations at most.
    below = np.count_nonzero(p < 0.05)
    assert abs(below - 0.05 * p.size) < 4 * math.sqrt(0.05 * 0.95 * p.size)


def test_seeds_that_are_not_independent_are_seen_by_the_same_rule() -> None:
    # The twin: each seed counted twice, as two samplers with one seed would. The error is taken for sqrt(2) too small.
    doubled = [compare(np.concatenate([s, s]), picture(), templates=TEMPLATES) for s in null()[1][:200]]
    for name in ("gain", "lobe shift", "tiles"):
        p = p_values(doubled)[name]
        assert np.count_nonzero(p < 0.05) - 0.05 * p.size > 4 * math.sqrt(0.05 * 0.95 * p.size)


def test_a_true_model_is_rejected_as_often_as_stated() -> None:
    rejected = sum(not c.passed for c in null()[0])
    # Within the 99.9 % interval of a binomial count at the level stated: 0 to 8 of 2000.
    low, high = stats.binom.interval(0.999, RUNS, SIGNIFICANCE)
    assert low <= rejected <= high


@pytest.mark.parametrize("level", [0.2, 0.05, 0.01])
def test_at_larger_levels_too_the_tests_together_keep_what_they_share(level: float) -> None:
    # The verdict's rule at levels at which 2000 runs can tell more: any of the four p-values below a quarter.
    p = p_values(null()[0])
    smallest = np.min([p[name] for name in ("gain", "lobe shift", "largest", "uniformity")], axis=0)
    rejected = np.count_nonzero(smallest <= level / 4)
    # Bonferroni: never above the level. Were all four one test, a quarter of it; they are not, so more than that.
    assert rejected <= stats.binom.interval(0.999, RUNS, level)[1]
    assert rejected > stats.binom.interval(0.999, RUNS, level / 4)[1]
    # Of each alone, the share is its own level.
    for name in ("gain", "lobe shift", "largest", "uniformity"):
        low, high = stats.binom.interval(0.999, RUNS, level)
        assert low <= np.count_nonzero(p[name] <= level) <= high


@pytest.mark.parametrize("index", [0, 1], ids=["gain", "lobe shift"])
def test_a_bias_foretold_as_detectable_is_caught_with_the_power_foretold(index: int) -> None:
    # Foretold by other runs: `detectable` scales with the standard error, whose mean square over many runs is the truth.
    # Twelve seeds know their own error to 21 %, which the noncentral t accounts for.
    comparisons, _ = null()
    detectable = math.sqrt(np.mean([c.biases[index].detectable ** 2 for c in comparisons]))
    template = [picture(), shift()][index]
    rng = np.random.default_rng(18 + index)
    fresh = [noisy(rng) for _ in range(500)]
    level = SIGNIFICANCE / 4
    threshold = stats.t.isf(level / 2, SEEDS - 1)
    units = comparisons[0].biases[index].detectable / comparisons[0].biases[index].standard_error
    for share, runs in ((1.0, fresh), (0.6, fresh[:250])):
        found = [compare(picture() + n + share * detectable * template, picture(), templates=TEMPLATES) for n in runs]
        power = stats.nct.sf(threshold, SEEDS - 1, share * units)
        # 99.9 % interval: 97.2 to 100 % at the power of 99 %, and around 53 % at 0.6 of that bias: the twin,
        # which shows that the bound is no mere safety margin.
        low, high = stats.binom.interval(0.999, len(runs), power)
        assert low <= sum(c.biases[index].p_value <= level for c in found) <= high
        assert sum(not c.passed for c in found) >= low
        if share == 1.0:
            assert low >= 0.97 * len(runs)


def test_the_scores_of_noise_have_mean_zero_and_width_one() -> None:
    z = np.stack([c.z for c in null()[0]])
    count = z.size
    assert abs(z.mean()) < 4 / math.sqrt(count)
    assert abs(z.std() - 1) < 4 / math.sqrt(2 * count)
    # Student's t is made a normal score, tails and all: beyond 3 lie 0.27 %.
    beyond = np.count_nonzero(np.abs(z) > 3)
    expected = 2 * stats.norm.sf(3) * count
    assert abs(beyond - expected) < 4 * math.sqrt(expected)


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    for index in (0, 1):
        covered = sum(c.biases[index].interval[0] <= 0 <= c.biases[index].interval[1] for c in null()[0])
        assert abs(covered - 0.99 * RUNS) < 4 * math.sqrt(0.99 * 0.01 * RUNS)


def test_a_bias_is_scipys_t_test_of_least_squares_amplitudes() -> None:
    for comparison, seeds in zip(null()[0][:5], null()[1]):
        weight = 1 / (picture() + 1e-2 * picture().max())
        for bias, shape in zip(comparison.biases, (picture(), shift())):
            column = (weight * shape).reshape(-1, 1)
            amplitudes = [np.linalg.lstsq(column, (weight * (s - picture())).ravel())[0][0] for s in seeds]
            # The null is the nearest amplitude that float32's own relative error in every pixel could make.
            spacing = float(np.finfo(np.float32).eps)
            most = spacing * np.sum(weight**2 * picture() * np.abs(shape)) / np.sum((weight * shape) ** 2)
            expected = stats.ttest_1samp(amplitudes, math.copysign(most, np.mean(amplitudes)))
            assert bias.estimate == pytest.approx(np.mean(amplitudes), rel=1e-10)
            assert bias.standard_error == pytest.approx(stats.sem(amplitudes), rel=1e-10)
            assert bias.p_value == pytest.approx(expected.pvalue, rel=1e-8)
            np.testing.assert_allclose(bias.interval, expected.confidence_interval(0.99), rtol=1e-8)


# -- planted faults -------------------------------------------------------------------------------------------


def test_a_gain_four_times_the_detectable_one_is_always_caught() -> None:
    rng = np.random.default_rng(2)
    caught = 0
    for comparison in null()[0][:100]:
        bright = picture() * (1 + 4 * comparison.gain.detectable) + noisy(rng)  # of another run, with its own noise
        caught += not compare(bright, picture(), templates=TEMPLATES).passed
    assert caught == 100  # at a power of .99 one miss would be usual; four detectable units leave none


@pytest.mark.parametrize("index", [0, 1], ids=["gain", "lobe shift"])
def test_the_stated_detectable_bias_is_caught_in_the_run_that_stated_it(index: int) -> None:
    template = [picture(), shift()][index]
    caught = 0
    comparisons, seeds = null()
    for comparison, s in zip(comparisons[:400], seeds):
        found = compare(s + comparison.biases[index].detectable * template, picture(), templates=TEMPLATES)
        caught += not found.passed
    # At least 99 % of 400, less four standard deviations: 97 %.
    assert caught >= 400 * 0.99 - 4 * math.sqrt(0.99 * 0.01 * 400)


def test_a_third_of_the_detectable_bias_is_missed() -> None:
    # The twin: the bound is no mere safety margin. At a third of it a run of twelve seeds catches a few per cent.
    comparisons, seeds = null()
    caught = sum(
        not compare(s + c.gain.detectable / 3 * picture(), picture(), templates=TEMPLATES).passed
        for c, s in zip(comparisons[:100], seeds[:100])
    )
    assert caught < 20


@pytest.mark.parametrize("extra", [0, 2, 5])
@pytest.mark.parametrize("seeds", [8, 16, 64])
def test_the_detectable_bias_has_the_power_that_is_stated(seeds: int, extra: int) -> None:
    # The power of the two-sided t test at the level that `compare` uses, in closed form: noncentral t. The bound is in
    # units of the run's standard error; the bias planted is that many true standard errors.
    rng = np.random.default_rng(3)
    templates = {(f"bias {k}", "of 1"): rng.standard_normal((VIEWS, PIXELS)) for k in range(extra)}
    comparison = compare(picture() + noisy(rng, seeds), picture(), templates=templates)
    level = SIGNIFICANCE / (len(comparison.biases) + 2)
    threshold = stats.t.isf(level / 2, seeds - 1)
    for bias in comparison.biases:
        units = bias.detectable / bias.standard_error
        assert stats.nct.sf(threshold, seeds - 1, units) >= 0.99 - 1e-6
        assert units < 2 * (threshold + 2.4)  # and not by asking for far more than it takes


def test_amplitudes_are_measured_in_units_of_their_template() -> None:
    rng = np.random.default_rng(4)
    biased = 1.02 * picture() + 0.003 * shift() + noisy(rng, 64)
    found = compare(biased, picture(), templates=TEMPLATES)
    gain, moved = found.biases
    # Each template is fitted alone; what the other adds is their overlap, known from the templates.
    weights = 1 / (picture() + 1e-2 * picture().max()) ** 2
    overlap = np.sum(weights * picture() * shift())
    expected = 0.02 + 0.003 * overlap / np.sum(weights * picture() ** 2)
    assert abs(gain.estimate - expected) < 4.5 * gain.standard_error
    expected = 0.003 + 0.02 * overlap / np.sum(weights * shift() ** 2)
    assert abs(moved.estimate - expected) < 4.5 * moved.standard_error
    assert gain.estimate > 0
    assert not found.passed
    assert (gain.name, gain.unit) == ("gain", "of 1")
    assert (moved.name, moved.unit) == ("lobe shift", "deg")


def test_a_render_wrong_beyond_all_probability_is_rejected_in_numbers() -> None:
    # t of 1e5 with 63 degrees of freedom has a probability below the smallest float64; the scores stay finite.
    found = compare(2 * picture() + 1e-3 * noisy(np.random.default_rng(14), 64), picture())
    assert not found.passed
    assert np.all(np.isfinite(found.z))
    assert found.gain.estimate == pytest.approx(1.0, rel=1e-3)
    json.dumps(found.summary(), allow_nan=False)


def test_one_wrong_pixel_is_caught_by_the_largest_score() -> None:
    rng = np.random.default_rng(5)
    seeds = picture() + noisy(rng, 30)
    seeds[:, 1, 17] += 0.05 * (0.2 + picture()[1, 17]) * 3  # three times one seed's noise: z = 3 sqrt(30)
    found = compare(seeds, picture())
    assert not found.passed
    assert found.largest_p < 1e-6
    assert np.nanargmax(np.abs(found.z)) == PIXELS + 17
    assert found.gain.p_value > SIGNIFICANCE  # which the gain does not see


def test_a_wave_over_the_picture_is_caught_by_the_tiles() -> None:
    rng = np.random.default_rng(6)
    views, pixels = 8, 200
    flat = np.ones((views, pixels))
    noise = 0.05 * rng.standard_normal((16, views, pixels))
    wave = 0.015 * np.sign(np.sin(2 * np.pi * np.arange(pixels) / 40))  # up for two tiles, down for two: no gain
    found = compare(flat + noise + wave, flat)
    assert not found.passed
    assert found.uniformity_p < 1e-6
    assert found.gain.p_value > 1e-3
    assert compare(flat + noise, flat).passed


# -- what is left out -----------------------------------------------------------------------------------------


def test_edges_are_left_out_and_counted() -> None:
    rng = np.random.default_rng(7)
    seeds = picture() + noisy(rng)
    edges = np.zeros((VIEWS, PIXELS), dtype=bool)
    edges[0, [3, 30]] = edges[1, 9] = True
    seeds[:, edges] += 5.0  # as wrong as can be
    found = compare(seeds, picture(), edges=edges, templates=TEMPLATES)
    assert found.passed
    assert (found.kept, found.starved, found.edges) == (VIEWS * PIXELS - 3, 0, 3)
    assert np.all(np.isnan(found.z[edges]))
    assert np.all(np.isfinite(found.z[~edges]))
    assert not compare(seeds, picture(), templates=TEMPLATES).passed


def test_starved_pixels_are_left_out_and_counted() -> None:
    rng = np.random.default_rng(8)
    reference = picture()
    reference[0, :10] = 1e-4  # below a thousandth of the brightest
    reference[1, 5] = 0.0
    seeds = reference + noisy(rng)
    found = compare(seeds, reference)
    assert (found.kept, found.starved, found.edges) == (VIEWS * PIXELS - 11, 11, 0)
    assert np.all(np.isnan(found.z[0, :10]))
    assert np.isnan(found.tile_p[0, 0])  # a tile without a pixel
    assert np.isfinite(found.tile_p).sum() == VIEWS * 4 - 1
    # A pixel that is both is counted as an edge.
    edges = np.zeros((VIEWS, PIXELS), dtype=bool)
    edges[0, 0] = True
    found = compare(seeds, reference, edges=edges)
    assert (found.kept, found.starved, found.edges) == (VIEWS * PIXELS - 11, 10, 1)


def test_a_template_that_only_starved_pixels_know_is_said_to_be_out_of_sight() -> None:
    template = np.zeros((VIEWS, PIXELS))
    template[0, 0] = 1.0
    edges = template > 0
    rng = np.random.default_rng(9)
    found = compare(picture() + noisy(rng), picture(), templates={("corner", "of 1"): template}, edges=edges)
    assert found.biases[1].p_value == 1.0
    assert found.biases[1].detectable == math.inf
    assert found.passed


# -- no scatter: a mirror -------------------------------------------------------------------------------------


def test_without_scatter_only_rounding_is_left_to_compare() -> None:
    reference = picture()
    rounded = np.repeat(reference.astype(np.float32).astype(float)[None], 8, axis=0)
    found = compare(rounded, reference, templates=TEMPLATES)
    assert found.exact
    assert found.passed
    assert found.relative_rms < 1e-7
    # The twins: a gain of 1e-4, and one pixel by as much.
    assert not compare(rounded * (1 + 1e-4), reference, templates=TEMPLATES).passed
    rounded[:, 0, 3] += 1e-4
    assert not compare(rounded, reference, templates=TEMPLATES).passed


def test_noise_is_not_taken_for_a_mirror() -> None:
    assert not any(c.exact for c in null()[0])


def test_a_pixel_that_is_wrong_without_scattering_is_caught() -> None:
    # Among pixels that scatter, one that always comes out the same: no t statistic, but rounding is 1e-7 and not 0.03.
    rng = np.random.default_rng(13)
    seeds = picture() + noisy(rng)
    seeds[:, 0, 5] = picture()[0, 5]
    assert compare(seeds, picture(), templates=TEMPLATES).passed
    seeds[:, 0, 5] += 0.03
    assert not compare(seeds, picture(), templates=TEMPLATES).passed


def test_light_where_a_mirror_shows_none_is_caught() -> None:
    # Where nothing scatters, a dark pixel is no starved pixel: there should be nothing, exactly.
    reference = np.where(np.arange(PIXELS) % 8 == 0, picture(), 0.0)
    seeds = np.repeat(reference[None], 8, axis=0)
    assert compare(seeds, reference).passed
    seeds[:, 1, 5] = 1e-3
    assert not compare(seeds, reference).passed


def test_darkness_proves_nothing() -> None:
    # All dark, and dark it should be: a scene that shows nothing cannot fail, so it does not pass either.
    dark = np.zeros((VIEWS, PIXELS))
    assert not compare(np.zeros((8, VIEWS, PIXELS)), dark).passed
    assert not compare(np.full((8, VIEWS, PIXELS), 0.1), dark).passed


def test_a_comparison_of_no_pixel_does_not_pass() -> None:
    everywhere = np.ones((VIEWS, PIXELS), dtype=bool)
    found = compare(picture() + noisy(np.random.default_rng(15)), picture(), edges=everywhere)
    assert found.kept == 0
    assert not found.passed


# -- refusals and report --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seeds", [0, 1, 7])
def test_fewer_than_eight_seeds_are_refused(seeds: int) -> None:
    error = refused(lambda: compare(np.ones((seeds, VIEWS, PIXELS)), picture()))
    assert error.field == "seeds"
    assert "at least 8" in error.message
    assert compare(picture() + noisy(np.random.default_rng(10), 8), picture()).kept > 0


@pytest.mark.parametrize("shape", [(8, PIXELS), (8, VIEWS, PIXELS + 1), (8, VIEWS + 1, PIXELS)])
def test_shapes_that_do_not_match_are_refused(shape: tuple[int, ...]) -> None:
    assert "do not match" in refused(lambda: compare(np.ones(shape), picture())).message


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_render_that_is_not_finite_never_passes(bad: float) -> None:
    seeds = picture() + noisy(np.random.default_rng(11))
    seeds[3, 1, 20] = bad
    with np.errstate(invalid="ignore"):
        try:
            found = compare(seeds, picture(), templates=TEMPLATES)
        except InputError:  # as good
            return
    assert not found.passed


def test_the_summary_is_json_and_says_all_but_the_maps() -> None:
    found = null()[0][0]
    summary = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert summary["passed"] is found.passed
    assert [b["name"] for b in summary["biases"]] == ["gain", "lobe shift"]
    for told, bias in zip(summary["biases"], found.biases):
        assert isinstance(bias, BiasTest)
        assert told["detectable_99"] == bias.detectable
        assert told["interval_99"] == list(bias.interval)
    assert summary["pixels"] == {"kept": found.kept, "starved": 0, "edges": 0}


def test_an_unseen_template_can_be_told_in_json() -> None:
    template = np.zeros((VIEWS, PIXELS))
    found = compare(picture() + noisy(np.random.default_rng(12)), picture(), templates={("none", "of 1"): template})
    told = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert told["biases"][1]["detectable_99"] is None


@pytest.mark.parametrize(("relative", "passes"), [(1e-7, True), (1e-5, False)])
def test_what_float32_does_to_every_sample_is_no_bias_and_a_hundred_times_as_much_is(
    relative: float, passes: bool
) -> None:
    reference = np.ones((2, 40))
    noise = 1e-9 * np.random.default_rng(1).standard_normal((16, *reference.shape))
    # Scatter below float32's spacing, so that the common shift is what is judged; not so little that none is seen.
    assert compare(reference * (1 + relative) + 1e4 * noise, reference).passed is passes


@pytest.mark.parametrize("power", [-1000, 1000])
def test_the_verdict_knows_no_unit(power: int) -> None:
    rng = np.random.default_rng(2)
    reference = 1 + rng.random((2, 40))
    seeds = reference + 0.1 * rng.standard_normal((16, 2, 40))
    plain = compare(seeds, reference)
    scaled = compare(np.ldexp(seeds, power), np.ldexp(reference, power))
    assert scaled.summary() == plain.summary()
    foretold = [detectable_gain(np.ldexp(seeds, p), np.ldexp(reference, p), planned=32) for p in (0, power)]
    assert foretold[0] == foretold[1]
