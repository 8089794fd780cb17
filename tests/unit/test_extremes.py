"""The table of extremes: its quick cells are right or refused, it would catch a fault, and what must not change does not."""

from __future__ import annotations

import importlib
import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import wallmirror as wm

from .helpers import same_examples

_VALIDATION = Path(__file__).parents[2] / "validation"


def _topics() -> tuple[ModuleType, ...]:
    sys.path.insert(0, str(_VALIDATION))
    try:
        names = ("harness", "scenes", "geometry", "brdfs", "transport", "solving", "invariances")
        return tuple(importlib.import_module(f"extreme_cases.{name}") for name in names)
    finally:
        sys.path.remove(str(_VALIDATION))


harness, scenes, geometry, brdfs, transport, solving, invariances = _topics()
QUICK = [*geometry.cases(), *brdfs.cases(), *transport.strip_cases(), *invariances.cases()]


@pytest.mark.parametrize("case", QUICK, ids=lambda c: f"{c.entry}, {c.quantity}, {c.value}")
def test_no_quick_cell_is_a_fault(case):
    cell = harness.run(case)
    assert cell.outcome in ("right", "refused"), cell.words


@pytest.mark.parametrize("intensity", ["1e-300", "1e+300", "denormal (1e-310)"])
def test_extreme_intensities_are_solved(intensity):
    (case,) = [c for c in solving.cases() if (c.entry, c.quantity, c.value) == ("solve", "intensity", intensity)]
    assert harness.run(case).outcome == "right"


@pytest.mark.parametrize(
    "check",
    [
        lambda: (1e-3, 1e-6),
        lambda: (math.nan, 1.0),
        lambda: (float(np.float64(1e300) * np.float64(1e300)), 1.0),
        lambda: (float(np.linalg.inv(np.zeros((2, 2)))[0, 0]), 1.0),
        lambda: (0.0, math.nan),
    ],
    ids=["wrong", "NaN", "overflow warned of", "another exception", "no tolerance"],
)
def test_the_table_catches(check):
    assert harness.run(harness.Case("f", "x", "1", check)).outcome == "fault"


def test_the_reference_would_show_a_wrong_sign_and_a_missing_cosine():
    eye, strips, brdf = scenes.observer(), scenes.card(), scenes.lobes(30.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        error, allowed = transport.transport_check("cosine", eye, strips, brdf)()
        assert error <= allowed
        lopsided = replace(brdf, centres=(math.radians(-15),))
        flipped = replace(brdf, centres=(math.radians(15),))
        exact = transport.exact_transport(eye, strips, lopsided, "cosine", 1, 20, 0)
        assert abs(exact - transport.exact_transport(eye, strips, flipped, "cosine", 1, 20, 0)) > 1e3 * allowed
        assert abs(exact - transport.exact_transport(eye, strips, lopsided, "thesis", 1, 20, 0)) > 1e3 * allowed


@same_examples
@given(power=st.integers(-900, 900))
def test_radiance_is_exact_under_powers_of_two(power):
    transport = np.random.default_rng(1).random((2, 5, 3))
    source = np.random.default_rng(2).random((3, 4))
    scaled = wm.radiance(transport, np.ldexp(source, power))
    assert np.array_equal(scaled, np.ldexp(wm.radiance(transport, source), power))


@same_examples
@given(scale=st.floats(1e-280, 1e280), factor=st.floats(1e-20, 1e20))
def test_the_error_up_to_scale_knows_no_scale(scale, factor):
    truth = np.array([1.0, 2.0, 3.0])
    estimate = np.array([1.0, 2.0, 3.3])
    plain = wm.scale_free_error(estimate, truth)
    assert wm.scale_free_error(scale * estimate, factor * truth) == pytest.approx(plain, rel=1e-12)


@same_examples
@given(x=st.floats(-3, 3), angle=st.floats(-0.5, 0.5), sigma=st.floats(0.02, 1.5))
def test_the_mirror_image_of_a_scene_has_the_mirror_image_of_its_transport(x, angle, sigma):
    eye = wm.Observer(position=(0.3, -2.0), fov=1.0, view_angles=(angle,), pixels=9)
    strips = wm.Card(elements_x=(x, x + 1.0), y=-1.0, element_width=0.1, element_height=0.2)
    brdf = wm.GaussianTrain(centres=(0.2,), sigma=sigma)
    other_eye = replace(eye, position=(-0.3, -2.0), view_angles=(-angle,))
    other_strips = replace(strips, elements_x=(-x, -x - 1.0))
    other = wm.transport_matrix(other_eye, other_strips, replace(brdf, centres=(-0.2,)))
    plain = wm.transport_matrix(eye, strips, brdf)
    # Rounding of the angles over the lobe's width, and sums in another order.
    assert np.allclose(other[:, ::-1], plain, rtol=0, atol=1e-13 * float(plain.max()))
    assert not np.allclose(other, plain, rtol=1e-6, atol=0)  # the twin: without the turn they differ


def test_forecasts_are_proportional_to_the_noise_at_any_level():
    eye, strips = scenes.observer(), scenes.card(element_width=0.0, element_height=0.0)
    forecasts = [
        wm.foresee(eye, strips, scenes.lobes(), s * np.eye(3), noise=s * n, weights="cosine")
        for s, n in ((1.0, 1e-3), (1.0, 2e-3), (1e200, 1e-3), (1e-200, 1e-3))
    ]
    first = forecasts[0]
    assert forecasts[1].source_error == pytest.approx(2 * first.source_error, rel=1e-9)
    for other in forecasts[2:]:
        assert other.source_error == pytest.approx(first.source_error, rel=1e-9)


def test_what_a_saturated_pixel_holds_does_not_set_the_scale():
    captures, source = scenes.films(noise=1e-3)
    spread = 1e-3 * float(captures.radiance.max())
    variance = np.full(captures.radiance.shape, spread**2)
    variance[0, 3] = np.inf
    garbage = captures.radiance.copy()
    garbage[0, 3] = 1e40
    solutions = [
        wm.solve(replace(captures, radiance=films, variance=variance)) for films in (captures.radiance, garbage)
    ]
    assert wm.scale_free_error(solutions[1].source, solutions[0].source) < 1e-9
    assert wm.scale_free_error(solutions[1].source, source) < 5 * solutions[1].predicted_error + 1e-6
