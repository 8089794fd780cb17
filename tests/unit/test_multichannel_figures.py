"""The quick ones of the figures of section 3.2.4 and of the conclusion: what they measure, and that their claims follow it."""

import numpy as np
import pytest

from wallmirror.thesis import interferometric_identity
from wallmirror.thesis.catalogue import make_figure


@pytest.fixture(scope="module")
def identity():
    return make_figure("3.2-fbd-identity")


def test_identity_is_exact_for_convolutions_and_converges_over_the_angle_alone(identity):
    assert identity.numbers["largest error for a convolution"] < 1e-13
    assert identity.numbers["smallest error along the wall"] > 0.1
    np.testing.assert_allclose(identity.numbers["slope of the error over the angle sum"], -1, atol=0.1)
    assert [claim.outcome for claim in identity.claims] == ["confirmed", "confirmed"]


def test_claims_follow_the_numbers(identity, monkeypatch):
    """The planted fault: renders that are convolutions along the wall after all."""
    monkeypatch.setattr(interferometric_identity, "_along_the_wall", lambda card, patterns: (1e-15, 1e-15))
    assert interferometric_identity.identity(0).claims[1].outcome == "refuted"


def test_spherical_convolution_is_solved_blindly():
    made = make_figure("3.1-blind-spherical")
    assert made.numbers["error of the pattern on the half circle, 1,000 directions"] < 1e-7
    assert made.numbers["error of the BRDF by solve on the spherical convolution's renders"] < 1e-6
    assert made.claims[0].outcome == "confirmed"
