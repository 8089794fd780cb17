"""Channels in closed form: the cross-relation and the subspace method, and the conditions on which they stand."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from wallmirror.deconvolution.channels import aligned_error, convolve_channels
from wallmirror.deconvolution.cross_relation import identify_channels
from wallmirror.errors import InputError, UndeterminedError

METHODS = ("cross_relation", "subspace")


def made(channels, taps, length, seed=0):
    rng = np.random.default_rng(seed)
    f, h = rng.standard_normal(length - taps + 1), rng.standard_normal((channels, taps))
    return f, h, convolve_channels(f, h)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("channels", "taps", "length"), [(2, 5, 60), (3, 5, 40), (8, 12, 200)])
def test_true_convolutions(method, channels, taps, length):
    f, h, g = made(channels, taps, length)
    found = identify_channels(g, taps, method=method)
    assert aligned_error(found.channels, h) < 1e-10
    # The record is longer than the source by n - 1 at each end, where the source within it is zero.
    assert aligned_error(found.sources[0], np.pad(f, taps - 1)) < 1e-9


def test_null_vector_of_dense_algebra():
    """The same equations written out as one matrix, by another route: convolution matrices and an SVD."""
    _, _, g = made(3, 4, 30)
    y = [toeplitz(row, np.zeros(4))[3:] for row in g]
    zero = np.zeros_like(y[0])
    rows = [np.hstack([-y[1], y[0], zero]), np.hstack([-y[2], zero, y[0]]), np.hstack([zero, -y[2], y[1]])]
    _, values, right = np.linalg.svd(np.vstack(rows))
    found = identify_channels(g, 4)
    assert aligned_error(found.channels.ravel(), right[-1]) < 1e-13
    np.testing.assert_allclose(found.gap, values[-2] / values[0], rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_windows_of_records_and_several_sources(method):
    """Ends cut off, and two short records that only together have equations enough."""
    rng = np.random.default_rng(1)
    h = rng.standard_normal((3, 6))
    records = [convolve_channels(rng.standard_normal(40), h)[:, 10:30] for _ in range(3)]
    found = identify_channels(np.array(records), 6, method=method)
    assert aligned_error(found.channels, h) < 1e-10
    assert found.sources.shape == (3, 25)


@pytest.mark.parametrize("method", METHODS)
def test_noise_is_foretold(method):
    """Twenty seeds: the mean square error against its prediction, which drops terms and correlations (a factor of 3)."""
    ratio = []
    for seed in range(20):
        _, h, g = made(4, 6, 150, seed)
        noisy = g + 1e-4 * g.std() * np.random.default_rng(100 + seed).standard_normal(g.shape)
        found = identify_channels(noisy, 6, method=method)
        ratio.append(aligned_error(found.channels, h) / found.predicted_error)
    rms = np.sqrt(np.mean(np.square(ratio)))
    assert 1 / 3 < rms < 3


@pytest.mark.parametrize("method", METHODS)
def test_conditions_that_are_violated_are_told(method):
    f, h, g = made(4, 6, 150)
    for taps in (7, 9):  # the channels are shorter: any factor of 2 or 4 taps could be theirs
        with pytest.raises(UndeterminedError, match="family"):
            identify_channels(g, taps, method=method)
    for taps in (5, 3):  # they are longer
        with pytest.raises(UndeterminedError):
            identify_channels(g, taps, method=method)
    shared = np.array([np.convolve(row, [1, -0.5]) for row in h[:, :5]])  # a zero at 0.5 in all
    with pytest.raises(UndeterminedError, match="zero"):
        identify_channels(convolve_channels(f, shared), 6, method=method)
    with pytest.raises(UndeterminedError):  # a source of one frequency
        identify_channels(convolve_channels(np.cos(0.3 * np.arange(145)), h)[:, 5:145], 6, method=method)
    with pytest.raises(UndeterminedError):  # nothing in common
        identify_channels(np.random.default_rng(0).standard_normal((4, 150)), 6, method=method)


def test_another_source_in_one_channel_is_no_answer():
    """The planted fault: four channels of which one heard something else."""
    f, h, g = made(4, 6, 150)
    g[3] = np.convolve(np.random.default_rng(9).standard_normal(f.size), h[3])
    with pytest.raises(UndeterminedError, match="no source"):
        identify_channels(g, 6)


def test_scale_and_float32():
    _, h, g = made(3, 5, 60)
    for scale in (1e-200, 1e200):
        assert aligned_error(identify_channels(g * scale, 5).channels, h) < 1e-10
    # float32 rounds to 6e-8; the gap of 0.07 amplifies that some ten times.
    assert aligned_error(identify_channels(g.astype(np.float32), 5).channels, h) < 1e-5


@pytest.mark.parametrize(
    ("outputs", "options", "error"),
    [
        (np.ones((1, 50)), {}, UndeterminedError),
        (np.zeros((3, 50)), {}, UndeterminedError),
        (np.zeros((2, 3, 50)), {}, UndeterminedError),
        (np.full((3, 50), np.nan), {}, InputError),
        (np.full((2, 3, 50), np.nan), {}, InputError),
        ([[1.0, 2.0], [1.0]], {}, InputError),
        (np.eye(3, 4), {}, InputError),
        (np.random.default_rng(0).random((2, 3, 4)), {}, InputError),
        (np.eye(3, 8), {}, UndeterminedError),
        (np.eye(3, 50), {"method": "magic"}, InputError),
        (np.eye(3, 50), {"window": 7}, InputError),
        (np.random.default_rng(0).random((3, 50)), {"method": "subspace", "window": 2}, InputError),
    ],
)
def test_bad_input_is_refused(outputs, options, error):
    with pytest.raises(error):
        identify_channels(outputs, 5, **options)
