"""Every planted fault of validation/planted_biases.py is rejected at small cost, and its unbiased twin is not."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from wallmirror.comparison import compare, cross_weights

_PATH = Path(__file__).parents[2] / "validation" / "planted_biases.py"
_SPEC = importlib.util.spec_from_file_location("planted_biases", _PATH)
planted = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = planted
_SPEC.loader.exec_module(planted)

# One view; the scene that shows the fault at the least cost. Half floats need pixels whose noise is below 5e-4.
SAMPLING = {"diffuse": (1, 256), "lobes": (1, 16), "narrow lobes": (1, 16)}


@pytest.fixture(scope="module")
def samples(mi):
    return {
        name: planted.render_seeds(planted.SCENES[name](), views=views, spp=spp, seed=5)
        for name, (views, spp) in SAMPLING.items()
    }


@pytest.mark.parametrize("twin", planted.TWINS, ids=lambda t: t.name)
def test_a_planted_fault_is_rejected(samples, twin):
    name = twin.scenes[0]
    comparison, _ = twin.comparison(samples[name], twin.expectation(planted.SCENES[name](), samples[name].views))
    assert not comparison.passed


@pytest.mark.parametrize("name", SAMPLING)
def test_the_unbiased_twin_is_not_rejected(samples, name):
    expectation = planted.CLEAN.expectation(planted.SCENES[name](), samples[name].views)
    comparison, _ = planted.CLEAN.comparison(samples[name], expectation)
    assert comparison.passed
    assert comparison.kept > 20


def test_cross_weights_see_smaller_gains_and_stay_honest():
    rng = np.random.default_rng(3)
    reference = 1 + np.sin(np.linspace(0, 9, 60))[None] ** 2
    noise = 10 ** rng.uniform(-3, -1, reference.shape)
    p_values, sharper = [], []
    for _ in range(400):
        seeds = reference + noise * rng.normal(size=(32, *reference.shape))
        crossed = compare(seeds, reference, weights=cross_weights(seeds, reference)).gain
        p_values.append(crossed.p_value)
        sharper.append(compare(seeds, reference).gain.detectable / crossed.detectable)
    assert np.median(sharper) > 2
    # Between the 0.01 % and the 99.99 % point of the binomial distribution at level 0.05.
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], len(p_values), 0.05)
    assert low <= np.sum(np.array(p_values) < 0.05) <= high
