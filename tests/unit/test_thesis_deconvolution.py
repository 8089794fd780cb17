"""Figures of section 3.2: the numbers behind them, and that every verdict can turn out otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from wallmirror.convolution.angle import mirror_points
from wallmirror.convolution.wall import wall_kernel
from wallmirror.deconvolution import Convolution, tikhonov_lsmr
from wallmirror.thesis import make_figure, setting
from wallmirror.thesis.blind_deconvolution import _exchanged, _left, _slightly_worse
from wallmirror.thesis.blind_success import KNOWLEDGE, interval, judge, random_case
from wallmirror.thesis.picture_deconvolution import _cropping, _worse
from wallmirror.thesis.picture_restoration import blurred_picture, psnr, sharpness, ssim
from wallmirror.thesis.wall_deconvolution import (
    _over_the_angle_sum,
    _recovered,
    far_wall,
    find_peaks,
    kernel_with_holes,
)

OBSERVER, CARD = setting.observer(1000), setting.card(50.0)
BRDF = setting.lobes(*setting.LOBES["text"])
PLACES = mirror_points(OBSERVER, CARD, CARD.elements_x)


def estimate(kernel, data):
    return tikhonov_lsmr(Convolution(kernel, (1000,), mode="same"), data, 1.0)


def test_the_published_success_is_reproduced_and_rests_on_its_holes_and_on_its_own_model():
    wall, holes, whole = far_wall(BRDF), kernel_with_holes(OBSERVER, BRDF), wall_kernel(OBSERVER, CARD, BRDF)
    own = estimate(holes, Convolution(holes, (1000,), mode="same").apply(wall.mirror))
    near = [float(np.max(own[np.abs(wall.x - place) < 0.1])) for place in PLACES]
    # Published numbers are .279 and .557 at -.455 and .455, relative L2 .466; where exactly its holes fall moves them by
    # 1 %, the nearest-point rule for them by 20 %.
    assert near == pytest.approx([0.279, 0.557], rel=0.03)
    assert np.linalg.norm(own - wall.mirror) / np.linalg.norm(wall.mirror) == pytest.approx(0.466, rel=0.03)
    assert find_peaks(wall.x, own, PLACES).good
    smooth = estimate(whole, Convolution(whole, (1000,), mode="same").apply(wall.mirror))
    assert smooth.max() < 0.2 * max(near)
    for kernel in (holes, whole):
        assert not find_peaks(wall.x, estimate(kernel, wall.render), PLACES).good


def test_over_the_angle_sum_the_real_render_is_undone():
    render = far_wall(BRDF).render
    undone = _over_the_angle_sum(render, BRDF)
    for method in ("Tikhonov", "Richardson-Lucy"):
        assert find_peaks(undone["degrees"], undone[method], undone["places"], near=1.0).good
    # The planted twin: another wall's lobes, by 1 deg.
    other = _over_the_angle_sum(render, setting.lobes(-31.0, -15.0, 15.0, 30.0))
    assert not find_peaks(other["degrees"], other["Tikhonov"], other["places"], near=0.2).good


def test_holes_are_where_the_angles_are_further_apart_than_the_bins():
    flat = setting.lobes(0.0, sigma_deg=1000.0)  # above zero everywhere
    empty = np.flatnonzero(kernel_with_holes(OBSERVER, flat) == 0)
    x = np.abs(-5 + 10 * empty / 999)
    # pi / 2 / 1000 rad at angle t spans (1 + tan^2 t) 7.85e-3 m, more than a bin of 10 / 999 m beyond tan t = .525.
    assert empty.size > 50
    assert x.min() > 5 * 0.525 - 0.1


@pytest.mark.parametrize(
    ("left", "right", "place", "good"),
    [(0.5, 1.0, 0.455, True), (0.9, 1.0, 0.455, False), (0.5, 1.0, 0.9, False), (0.0, 1.0, 0.455, False)],
)
def test_peaks_are_judged_by_place_and_ratio(left, right, place, good):
    x = np.linspace(-5, 5, 1000)
    curve = left * np.exp(-0.5 * ((x + place) / 0.05) ** 2) + right * np.exp(-0.5 * ((x - place) / 0.05) ** 2)
    found = find_peaks(x, curve, PLACES)
    assert found.good is good
    if good:
        assert found.width == pytest.approx(2.355 * 0.05, abs=0.02)
        assert found.artefacts < 0.01
        assert find_peaks(x, curve - 0.1 * (np.abs(x) > 3), PLACES).artefacts == pytest.approx(0.1, abs=0.01)


def test_verdicts_can_turn_out_otherwise():
    assert [_recovered(*case) for case in (([True], [True]), ([True], [False]), ([False], [False]))] == [
        "confirmed", "corrected", "refuted",
    ]  # fmt: skip
    assert [_worse(e, 1.0) for e in (2.0, 1.1)] == ["confirmed", "refuted"]
    names = ("uncropped", "cropped, taken as periodic", "cropped, with a model that knows it")
    outcomes = [_cropping(dict(zip(names, e, strict=True))) for e in ((1, 2, 2), (1, 2, 1), (1, 1, 1))]
    assert outcomes == ["confirmed", "corrected", "refuted"]
    assert [_slightly_worse(e, 1.0) for e in (1.2, 3.0, 0.9)] == ["confirmed", "corrected", "refuted"]
    assert [_left(shift, 25) for shift in (-2, -8, 0, 3)] == ["confirmed", "corrected", "refuted", "refuted"]
    assert [_exchanged(*case) for case in ((True, True), (True, False), (False, False))] == [
        "confirmed", "corrected", "refuted",
    ]  # fmt: skip
    assert [judge(rate, 12) for rate in (1 / 12, 0.5, 1.0)] == ["confirmed", "undecided", "refuted"]


def test_interval_of_a_rate_is_wilsons():
    # Its ends solve (p - rate)^2 = z^2 p (1 - p) / n.
    for rate in (0.0, 0.25, 1.0):
        for end in interval(rate, 12):
            assert (end - rate) ** 2 == pytest.approx(1.96**2 * end * (1 - end) / 12, abs=1e-12)


def test_similarity_is_that_of_scikit_image():
    b = blurred_picture(64)
    theirs = structural_similarity(
        b.cropped, b.picture, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(b.cropped, b.picture) == pytest.approx(theirs, abs=1e-12)
    assert ssim(b.picture, b.picture) == pytest.approx(1)
    assert psnr(b.picture + 0.1, b.picture) == pytest.approx(20)
    assert sharpness(b.cropped, b.picture) < 0.5
    assert sharpness(3 * b.picture, b.picture) == pytest.approx(1)


def test_supports_hold_the_truth_and_share_out_the_data():
    case = random_case(np.random.default_rng(0))
    for knowledge in KNOWLEDGE:
        signal, kernel = case.supports(knowledge)
        assert signal.size + kernel.size - 1 == case.data.size
    assert np.array_equal(case.supports(KNOWLEDGE[3])[0], case.signal > 0)


@pytest.mark.parametrize("figure_id", ["3.6", "3.8", "3.12", "3.13", "3.14"])
def test_figures_are_drawn_from_their_run(figure_id):
    figure = make_figure(figure_id)
    assert figure.id == figure_id
    assert figure.to_csv().count("\n") > 20
    assert figure.to_png().startswith(b"\x89PNG")
