"""The thesis's conclusion gone on with: blind de-rendering in the far field and on the spherical convolution."""

import numpy as np
import pytest

import wallmirror as wm
from wallmirror.convolution import HalfCircle, spherical_convolution
from wallmirror.deconvolution.blind_spherical import solve_spherical, spherical_designs
from wallmirror.deconvolution.far_field import solve_far_field

LOBES = wm.GaussianTrain(centres=tuple(np.radians([-30, -15, 15, 30])), sigma=np.radians(1))
OBSERVER = wm.Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=1500, pixels_at="edges")


def even_card(distance, elements=5, step_deg=2.0):
    angles = np.radians(step_deg) * (np.arange(elements) - (elements - 1) / 2)
    return wm.Card(elements_x=tuple(distance * np.tan(angles)), y=-distance)


def captured(card, realisations, *, observer=OBSERVER, weights="thesis", seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    v = rng.random((card.elements, realisations))
    films = wm.radiance(wm.transport_matrix(observer, card, LOBES, weights=weights), v)
    films = films + noise * np.sqrt(np.mean(films**2)) * rng.standard_normal(films.shape)
    return wm.CaptureSet(observer=observer, card=card, radiance=films, transport=weights), v


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
@pytest.mark.parametrize("realisations", [2, 6])
def test_far_field_error_falls_with_distance(weights, realisations):
    errors = []
    for distance in (1e3, 1e5):
        captures, v = captured(even_card(distance), realisations, weights=weights)
        errors.append(wm.scale_free_error(solve_far_field(captures).source, v))
    # 1 / distance at a fixed angular width: two decades, within the spread that the next order leaves.
    assert errors[1] < 1e-5
    assert 50 < errors[0] / errors[1] < 200


def test_far_field_brdf_and_departure():
    captures, _ = captured(even_card(1e4), 4)
    found = solve_far_field(captures)
    assert wm.scale_free_error(found.brdf, LOBES.of_sum(found.angles)) < 1e-3
    # delta_i turns by x tan^2(delta) / y_s to first order, 5 tan^2(4 deg) / 1e4 at the ends.
    np.testing.assert_allclose(found.departure, 5 * np.tan(np.radians(4)) ** 2 / 1e4, rtol=0.1)


def test_each_element_keeps_its_cosine():
    """A card 40 deg wide: the cosines at its ends are .94 of the middle's, and must come off the pattern."""
    card = even_card(1e6, elements=11, step_deg=4.0)
    lobe_captures, v = captured(card, 4, weights="cosine")
    error = wm.scale_free_error(solve_far_field(lobe_captures).source, v)
    assert error < 1e-4
    bare = v * np.cos(np.radians(4.0 * (np.arange(11) - 5)))[:, None]  # the planted fault: left on it
    assert wm.scale_free_error(bare, v) > 100 * error


def test_far_field_takes_elements_in_any_order_and_several_views():
    card = even_card(1e4)
    order = [3, 0, 4, 1, 2]
    mixed = wm.Card(elements_x=tuple(card.elements_x[i] for i in order), y=card.y)
    views = wm.Observer(position=(0, -5), fov=np.radians(80), view_angles=(0.1, -0.1), pixels=1500, pixels_at="edges")
    captures, v = captured(mixed, 3, observer=views)
    assert wm.scale_free_error(solve_far_field(captures).source, v) < 1e-4


def test_far_field_with_noise_is_as_good_as_foretold_and_as_the_likelihood():
    captures, v = captured(even_card(1e5), 8, noise=1e-2)
    for method in ("cross_relation", "subspace"):
        found = solve_far_field(captures, method=method)
        error = wm.scale_free_error(found.source, v)
        assert 1 / 4 < error / found.identified.predicted_error < 4  # 39 errors make one number
        assert error < 3 * wm.scale_free_error(wm.solve(captures).source, v)


def test_far_field_refuses():
    near, _ = captured(even_card(1e4), 1)
    with pytest.raises(wm.UndeterminedError, match="one output"):
        solve_far_field(near)
    with pytest.raises(wm.UndeterminedError, match="room for"):
        solve_far_field(captured(even_card(1e4, elements=40, step_deg=2.0), 2)[0])
    with pytest.raises(wm.InputError, match="one element"):
        solve_far_field(captured(even_card(1e4, elements=1), 2)[0])
    uneven = wm.Card(elements_x=(-700.0, -100.0, 700.0), y=-1e4)
    with pytest.raises(wm.InputError, match="even places"):
        solve_far_field(captured(uneven, 3)[0])
    strips = wm.Card(elements_x=(-350.0, 0.0, 350.0), y=-1e4, element_width=1, element_height=1)
    physical = wm.CaptureSet(observer=OBSERVER, card=strips, radiance=np.ones((1, 1500, 3)), transport="physical")
    with pytest.raises(wm.InputError, match="physical"):
        solve_far_field(physical)
    # Nearly one direction: the patterns' elements are not told apart, and no answer is made up.
    merged = wm.Card(elements_x=(-5.0, -2.5, 0.0, 2.5, 5.0), y=-1e4)
    with pytest.raises(wm.UndeterminedError):
        solve_far_field(captured(merged, 8, noise=1e-3)[0])


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
def test_spherical_convolution_solved_blindly(weights):
    observer = wm.Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=500)
    card = wm.Card(elements_x=(-5.0, -1.7, 1.7, 5.0), y=-5)
    captures, v = captured(card, 8, observer=observer, weights=weights)
    errors = []
    for samples in (180, 350, 700):
        found = solve_spherical(captures, samples=samples, order=5)
        errors.append(wm.scale_free_error(found.source, v))
        assert wm.scale_free_error(found.brdf, LOBES.of_sum(found.angles)) < 0.05
    # Interpolation of order 5 gains 2^6 a halving; the pattern at least half of that.
    assert errors[1] < errors[0] / 32
    assert errors[2] < errors[1] / 32


def test_solve_takes_the_renders_of_the_spherical_convolution():
    observer = wm.Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=500)
    card = wm.Card(elements_x=(-5.0, -1.7, 1.7, 5.0), y=-5)
    v = np.random.default_rng(0).random((4, 8))
    films = spherical_convolution(observer, card, LOBES, v, samples=1000, order=5)
    captures = wm.CaptureSet(observer=observer, card=card, radiance=films, transport="thesis")
    assert wm.scale_free_error(wm.solve(captures, method="closed_form").source, v) < 1e-6


def test_turns_must_be_those_of_the_geometry():
    """The planted fault: every wall point's turn computed for a card that is a little wider than it is."""
    observer = wm.Observer(position=(0, -5), fov=np.radians(90), view_angles=(0,), pixels=500)
    card = wm.Card(elements_x=(-5.0, -1.7, 1.7, 5.0), y=-5)
    captures, v = captured(card, 8, observer=observer)

    def with_width(factor):
        wider = wm.Card(elements_x=tuple(x * factor for x in card.elements_x), y=-5)
        return wm.CaptureSet(observer=observer, card=wider, radiance=captures.radiance, transport="thesis")

    right, wrong = solve_spherical(captures, samples=500), solve_spherical(with_width(1.0005), samples=500)
    assert wrong.closed.mismatch > 1e3 * right.closed.mismatch
    assert wm.scale_free_error(wrong.source, v) > 1e3 * wm.scale_free_error(right.source, v)
    with pytest.raises(wm.UndeterminedError, match="single out"):
        solve_spherical(with_width(1.01), samples=500)


def test_spherical_designs_refuse():
    with pytest.raises(wm.InputError, match="physical"):
        spherical_designs(OBSERVER, even_card(5.0), HalfCircle(samples=100), weights="physical")
    narrow = wm.Card(elements_x=(0.0, 1.0), y=-5)
    films = np.random.default_rng(0).random((1, 1500, 1))
    with pytest.raises(wm.UndeterminedError):
        solve_spherical(wm.CaptureSet(observer=OBSERVER, card=narrow, radiance=films, transport="thesis"))


def test_error_bound_covers_a_card_that_is_too_near():
    """No noise, but a card at 10 to 1,000 m: the prediction for noise is too small, the bound is not."""
    for distance in (10.0, 100.0, 1000.0):
        captures, v = captured(even_card(distance), 6)
        found = solve_far_field(captures)
        error = wm.scale_free_error(found.source, v)
        assert found.identified.predicted_error < error < found.identified.error_bound
