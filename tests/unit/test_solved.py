"""A solution beside the truth: the errors that are told know nothing of the scale that was chosen."""

from __future__ import annotations

import numpy as np
import pytest

import wallmirror as wm
from wallmirror.captures import Truth
from wallmirror.jobs import solved

from .helpers import thesis_card, thesis_observer


def test_the_true_error_of_the_brdf_is_that_of_any_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    observer, card, brdf = thesis_observer(120, 8), thesis_card(), wm.Phong(exponent=20)
    source = np.random.default_rng(2).random((card.elements, 8))
    films = wm.radiance(wm.transport_matrix(observer, card, brdf, weights="cosine"), source)
    films += 3e-3 * films.max() * np.random.default_rng(3).standard_normal(films.shape)
    captures = wm.CaptureSet(
        observer=observer,
        card=card,
        transport="cosine",
        radiance=films,
        variance=np.full(films.shape, (3e-3 * films.max()) ** 2),
    )
    u = np.linspace(-3, 3, 2001)
    truth = Truth(source=source, theta_s=u / 2, theta_o=u / 2, brdf=brdf.of_sum(u))
    peak = wm.solve(captures)
    dim = wm.solve(captures, scale="level", source_level=100 * float(np.mean(peak.source)))
    judged, same = solved.judge(peak, truth), solved.judge(dim, truth)
    assert judged is not None
    assert same is not None
    assert np.any(solved.well_seen(peak))
    assert not np.all(solved.well_seen(peak))
    np.testing.assert_array_equal(solved.well_seen(peak), solved.well_seen(dim))
    assert same.brdf_error == pytest.approx(judged.brdf_error, rel=1e-9)
    # The planted fault: held against 1 instead of the peak, every node of the dim BRDF counts as known.
    assert np.all(dim.brdf_std < 0.05)
