"""Focused blind deconvolution: its two stages, the least-squares fit that it repairs, and what each refuses."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from wallmirror.deconvolution.channels import aligned_error, convolve_channels
from wallmirror.deconvolution.cross_relation import identify_channels
from wallmirror.deconvolution.focused_blind import focused_blind
from wallmirror.deconvolution.interferometric_fit import fit_interferometric
from wallmirror.deconvolution.interferometry import cross_correlations, identity_error
from wallmirror.deconvolution.least_squares_blind import _Problem as LeastSquares
from wallmirror.deconvolution.least_squares_blind import least_squares_blind
from wallmirror.deconvolution.phase_retrieval import _Problem as PhaseRetrieval
from wallmirror.deconvolution.phase_retrieval import retrieve_channels
from wallmirror.errors import InputError, UndeterminedError


def arrivals(channels, taps):
    """Two arrivals, one late by the distance and one by its square; the first channel's come first and span all taps."""
    h = np.zeros((channels, taps))
    offset = np.arange(channels) / (channels - 1)
    h[np.arange(channels), np.round(offset * taps / 4).astype(int)] += 1
    h[np.arange(channels), np.round(taps / 7 + offset**2 * (taps - 1 - taps / 7)).astype(int)] -= 0.6
    return h


@pytest.fixture(scope="module")
def small():
    rng = np.random.default_rng(1)
    h = arrivals(8, 12)
    f = rng.standard_normal(12 * 20 - 11)
    return f, h, convolve_channels(f, h)


def test_outputs_are_numpys_convolutions():
    rng = np.random.default_rng(0)
    for samples, taps in ((5, 3), (300, 40)):
        f, h = rng.standard_normal(samples), rng.standard_normal((3, taps))
        expected = [np.convolve(f, channel) for channel in h]
        # An FFT of length n is right to some eps log2 n of the largest value.
        np.testing.assert_allclose(convolve_channels(f, h), expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_correlations_are_numpys():
    h = np.random.default_rng(0).standard_normal((3, 6))
    i, j = np.triu_indices(3)
    expected = [np.correlate(h[a], h[b], mode="full") for a, b in zip(i, j, strict=True)]
    np.testing.assert_allclose(cross_correlations(h), expected, rtol=0, atol=1e-13)


def test_identity_holds_for_convolutions_alone(small):
    f, h, g = small
    assert identity_error(g, f, h) < 1e-13
    bent = g * (1 + 1e-3 * np.linspace(-1, 1, g.shape[1]))  # a gain that drifts by a thousandth is no convolution
    assert identity_error(bent, f, h) > 1e-4


def test_published_kind_of_demonstration():
    """30 taps, 20 channels, records 40 times longer, an arbitrary source."""
    rng = np.random.default_rng(3)
    h = arrivals(20, 30)
    f = np.convolve(rng.standard_normal(40 * 30 - 29), [1, 0.5])[: 40 * 30 - 29]  # coloured
    found = focused_blind(convolve_channels(f, h), 30)
    assert found.is_determined
    assert aligned_error(found.channels, h) < 1e-3
    assert aligned_error(found.source, f) < 1e-3


def test_both_stages_meet_their_quantities(small):
    f, h, g = small
    first = fit_interferometric(g, 12)
    # The fit stops at a misfit of 1e-11, and the outputs amplify it some hundred times at most here.
    assert aligned_error(first.correlations, cross_correlations(h)) < 1e-7
    f_a = np.correlate(f, f, mode="full")[f.size - 1 :]
    np.testing.assert_allclose(first.autocorrelation, f_a / f_a[0], atol=1e-7)
    assert aligned_error(retrieve_channels(cross_correlations(h), 8).channels, h) < 1e-8


def test_least_squares_alone_takes_a_wrong_answer_that_fits(small):
    """With more taps than the channels have, zeros of the source can move into them: no fit tells, the rivals do."""
    _, h, g = small
    start = np.random.default_rng(0).standard_normal((8, 14))
    fit = least_squares_blind(g, 14, start=start, steps=300)
    padded = np.pad(h, ((0, 0), (0, 2)))
    wrong = aligned_error(fit.channels, padded, shifts=2)
    assert fit.misfit < 1e-9
    assert wrong > 0.3
    focused = focused_blind(g, 14)
    assert aligned_error(focused.channels, padded, shifts=2) < 0.5 * wrong
    assert focused.rivals == 3
    assert not focused.is_determined
    assert "give 12 taps" in focused.status


def test_patterns_of_light_are_not_white_and_no_wrong_answer_is_claimed():
    """Positive channels: focusing fails on some of eight, and says so on each of these; the closed form needs no whiteness."""
    wrong = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        h = rng.random((8, 5))
        outputs = convolve_channels(rng.standard_normal(100), h)
        found = focused_blind(outputs, 5)
        if aligned_error(found.channels, h) > 0.05:
            wrong += 1
            assert not found.is_determined
            assert "no answer" in found.status
        assert aligned_error(identify_channels(outputs, 5).channels, h) < 1e-10
    assert wrong >= 2


def test_predicted_error_covers_the_noise(small):
    _, h, g = small
    noisy = g + 1e-4 * g.std() * np.random.default_rng(4).standard_normal(g.shape)
    fit = least_squares_blind(noisy, 12, start=h)
    error = aligned_error(fit.channels, h)
    assert error < fit.predicted_error  # the worst direction's
    assert error > 1e-6  # the noise did something


def test_normal_equations_of_phase_retrieval():
    """Gradient and J^T J against a Jacobian by central differences, whose error is of order 1e-8."""
    rng = np.random.default_rng(0)
    h, other = rng.standard_normal((3, 4)), rng.standard_normal((3, 4))
    problem = PhaseRetrieval(cross_correlations(other), 3)
    problem.focus_on(1, 0.3)
    x = h.ravel()

    def residual(x):
        h = x.reshape(3, 4)
        return np.concatenate([problem._residual(h).ravel(), -(np.sqrt(problem.penalty) * h).ravel()])

    jacobian = np.array([(residual(x + e) - residual(x - e)) / 2e-6 for e in 1e-6 * np.eye(12)]).T
    gradient, matrix = problem.normal_equations(x)
    np.testing.assert_allclose(gradient, jacobian.T @ residual(x), atol=1e-6)
    np.testing.assert_allclose(matrix, jacobian.T @ jacobian, atol=1e-6)


def test_normal_equations_of_least_squares():
    """f eliminated by dense linear algebra: J^T J = D^T (I - H H^+) D with D = d(f * h)/dh (Kaufman)."""
    rng = np.random.default_rng(0)
    g, h = rng.standard_normal((3, 20)), rng.standard_normal((3, 4))
    problem = LeastSquares(g, 4)
    stacked = np.vstack([toeplitz(np.r_[row, np.zeros(16)], np.r_[row[0], np.zeros(16)]) for row in h])
    f = np.linalg.lstsq(stacked, g.ravel(), rcond=None)[0]
    np.testing.assert_allclose(problem.source(h), f, atol=1e-11)
    d = np.kron(np.eye(3), toeplitz(np.r_[f, np.zeros(3)], np.r_[f[0], np.zeros(3)]))
    outside = d - stacked @ np.linalg.lstsq(stacked, d, rcond=None)[0]
    np.testing.assert_allclose(problem.reduced(h, f), outside.T @ outside, atol=1e-10)
    gradient, _ = problem.normal_equations(h.ravel())
    np.testing.assert_allclose(gradient, -d.T @ (g.ravel() - stacked @ f), atol=1e-11)


def test_float32_and_extreme_scales(small):
    _, h, g = small
    assert aligned_error(focused_blind(g.astype(np.float32), 12).channels, h) < 1e-3
    for scale in (1e-150, 1e150):
        found = focused_blind(g * scale, 12)
        assert aligned_error(found.channels, h) < 1e-6
        np.testing.assert_allclose(
            convolve_channels(found.source, found.channels), g * scale, atol=1e-6 * scale * g.max()
        )


@pytest.mark.parametrize(
    ("outputs", "taps", "error"),
    [
        (np.ones((1, 50)), 5, UndeterminedError),
        (np.zeros((3, 50)), 5, UndeterminedError),
        (np.outer([1, 2, 3], np.arange(50.0)), 5, UndeterminedError),
        (np.full((3, 50), np.nan), 5, InputError),
        (np.full((3, 50), np.inf), 5, InputError),
        ([[1.0, 2.0, 3.0], [1.0, 2.0]], 2, InputError),
        (np.ones(50), 5, InputError),
        (np.ones((0, 50)), 5, InputError),
        ("no numbers", 5, InputError),
        (np.eye(3, 50), 51, InputError),
        (np.eye(3, 50), 0, InputError),
        (np.eye(3, 50), 2.5, InputError),
        (np.eye(3, 50), True, InputError),
    ],
)
def test_bad_outputs_are_refused(outputs, taps, error):
    with pytest.raises(error):
        focused_blind(outputs, taps)


def test_bad_options_are_refused(small):
    _, h, g = small
    with pytest.raises(InputError, match="weights"):
        fit_interferometric(g, 12, weights=(0.0, 1.0))
    with pytest.raises(InputError, match="start"):
        least_squares_blind(g, 12, start=h[:, :5])
    with pytest.raises(InputError, match="nearest"):
        retrieve_channels(cross_correlations(h), 8, nearest=8)
    with pytest.raises(InputError, match="pairs"):
        retrieve_channels(cross_correlations(h), 7)
    with pytest.raises(InputError, match="make"):
        identity_error(g, np.ones(5), h)
