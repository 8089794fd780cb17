"""The table of extremes: its quick cells are right or refused, it would catch a fault, and what must not change does not."""

from __future__ import annotations

import importlib
import math
import sys
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import wallmirror as wm
from wallmirror.deconvolution import Convolution

from .helpers import same_examples

_VALIDATION = Path(__file__).parents[2] / "validation"


def _topics(*names: str) -> tuple[ModuleType, ...]:
    sys.path.insert(0, str(_VALIDATION))
    try:
        return tuple(importlib.import_module(f"extreme_cases.{name}") for name in names)
    finally:
        sys.path.remove(str(_VALIDATION))


harness, scenes, geometry, brdfs, tables, transport = _topics(
    "harness", "scenes", "geometry", "brdfs", "tables", "transport"
)
kernels, bounces, convolutions, half_circle = _topics("kernels", "bounces", "convolutions", "half_circle")
operators, regularising, richardson_lucy = _topics("operators", "regularising", "richardson_lucy")
channels, blind, solving, invariances = _topics("channels", "blind", "solving", "invariances")

#: The groups of cells that take at most a second or two.
QUICK = (
    geometry.cases,
    brdfs.cases,
    tables.cases,
    transport.strip_cases,
    kernels.two_angle_cases,
    kernels.option_cases,
    kernels.mirror_cases,
    kernels.product_cases,
    bounces.factor_cases,
    bounces.series_cases,
    bounces.card_cases,
    convolutions.cases,
    half_circle.cases,
    operators.cases,
    regularising.cases,
    richardson_lucy.cases,
    channels.cases,
    blind.cases,
    invariances.cases,
)


def _faults(cases: Iterable[Any], entry: str = "", quantity: str = "", value: str = "") -> list[str]:
    """The faults among cells whose names begin so; at least one cell has to."""
    asked = [
        c for c in cases if c.entry.startswith(entry) and c.quantity.startswith(quantity) and c.value.startswith(value)
    ]
    assert asked
    cells = [harness.run(case) for case in asked]
    return [f"{c.entry}, {c.quantity}, {c.value}: {c.words}" for c in cells if c.outcome not in ("right", "refused")]


@pytest.mark.parametrize("cases", QUICK, ids=lambda c: f"{c.__module__.rsplit('.', 1)[-1]}.{c.__name__}")
def test_no_quick_cell_is_a_fault(cases):
    assert _faults(cases()) == []


def _lgamma_quotient(a: float) -> float:
    return math.exp(math.lgamma(a) + math.lgamma(0.5) - math.lgamma(a + 0.5))


def _no_unit(*_: Any) -> float:
    return 1.0


def _unchanged(values: Any, *_: Any, **__: Any) -> Any:
    return values


#: A fault planted in a function, and the cells that must show it.
PLANTED = {
    "log gammas of a large exponent": (
        "brdf.lobes._beta_half", _lgamma_quotient,
        brdfs.lobe_cases, "Phong", "exponent", "1e+08"),
    "a rounded cosine to the power of n": (
        "brdf.lobes._power_of_cosine", lambda u, n: np.cos(u) ** n,
        brdfs.lobe_cases, "Blinn", "exponent", "1e+08"),
    "a difference that cancels near index 1": (
        "brdf.microfacet._contrast", lambda a, b, _: (a - b) / (a + b),
        brdfs.fresnel_cases, "Fresnel", "eta, k", "1.000000001, 0"),
    "slopes of a table at 1e300": (
        "brdf.tables.power_of_two", _no_unit,
        tables.table_cases, "AngleSumTable", "value", "1e+300, 0"),
    "a peak below a near card": (
        "transport.nodes._fastest", lambda one, *_: np.zeros_like(one),
        kernels.kernel_cases, "build_kernel, physical", "card's", "0.01"),
    "lengths in metres to the fourth power": (
        "interreflection.card.power_of_two", _no_unit,
        bounces.card_cases, "glow_in_mirror", "scene x 2^k", "k = -300"),
    "places rounded to 1e-12 m": (
        "interreflection.card.power_of_two", _no_unit,
        bounces.card_cases, "from_card", "scene x 2^k", "k = -20"),
    "renders of 1e300": (
        "convolution.spherical.power_of_two", _no_unit,
        convolutions.scaling_cases, "wall_convolution", "V, rho"),
    "squares of a render": (
        "convolution.hypotheses.power_of_two", _no_unit,
        half_circle.hypothesis_cases, "relative_error", "both", "k = -900"),
    "squares of the data": (
        "deconvolution.checking.power_of_two", _no_unit,
        richardson_lucy.richardson_lucy_cases, "richardson_lucy", "one", "1e+300"),
    "squares of the truth": (
        "deconvolution.checking.power_of_two", _no_unit,
        richardson_lucy.align_cases, "align", "estimate x", "-900, 0"),
    "norms that underflow": (
        "deconvolution.checking.power_of_two", _no_unit,
        regularising.choice_cases, "Spectrum norms", "alpha", "1, 1e-300"),
    "sources in a unit of their own": (
        "deconvolution.cross_relation.rescaled", _unchanged,
        channels.multichannel_cases, "identify_channels", "g x", "k = 900"),
    "a source in a unit of its own": (
        "deconvolution.least_squares_blind.rescaled", _unchanged,
        channels.multichannel_cases, "least_squares_blind", "g x", "k = 900"),
}  # fmt: skip


@pytest.mark.parametrize("fault", PLANTED)
def test_the_table_shows_a_planted_fault(fault, monkeypatch):
    name, wrong, cases, *cells = PLANTED[fault]
    assert _faults(cases(), *cells) == []
    module, function = name.rsplit(".", 1)
    monkeypatch.setattr(importlib.import_module(f"wallmirror.{module}"), function, wrong)
    assert _faults(cases(), *cells)


def test_the_table_shows_an_adjoint_that_convolves(monkeypatch):
    def forward_again(self, data):
        return np.resize(self._forward(data[: self._taken_shape[0]]), self._taken_shape)

    monkeypatch.setattr(Convolution, "_backward", forward_again)
    assert _faults(operators.operator_cases(), "toeplitz_matrix, Convolution.adjoint", "same")
    assert _faults(operators.operator_cases(), "adjoint_mismatch", "same", "(1000,)")


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
        lambda: (0.0, math.inf),
    ],
    ids=["wrong", "NaN", "overflow warned of", "another exception", "no tolerance", "any tolerance"],
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
