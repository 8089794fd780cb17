"""The closed form: exact without noise, indifferent to what must not matter, and silent about nothing it cannot know."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from wallmirror.brdf import AngleSumBRDF, Diffuse, GaussianTrain, Sum
from wallmirror.captures import CaptureSet
from wallmirror.derendering.options import Method
from wallmirror.derendering.solve import solve
from wallmirror.derendering.splines import SplineGrid, design_matrices, grid_for
from wallmirror.derendering.subspace import ClosedForm, banded_gram, closed_form, signal_space
from wallmirror.errors import UndeterminedError
from wallmirror.geometry import Card, Observer
from wallmirror.transport import Weights, build_kernel, radiance, transport_matrix

from .helpers import assert_undetermined, far_apart, lobes, refused, thesis_card, thesis_observer, up_to_scale

Array = NDArray[np.float64]


def patterns(elements: int = 4, realisations: int = 20, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((elements, realisations))


def recover(
    observer: Observer, card: Card, weights: Weights, data: Array, step_deg: float, *, degree: int = 7
) -> tuple[ClosedForm, SplineGrid]:
    """Kernel, grid, design and closed form in a row, without the choices of `solve`."""
    step = math.radians(step_deg)
    kernel = build_kernel(observer, card, weights=weights, resolution=2 * step, tolerance=1e-12)
    grid = grid_for(kernel, step=step, degree=degree)
    rows = data.reshape(-1, data.shape[-1]) / np.max(np.abs(data))
    return closed_form(rows, design_matrices(kernel, grid), signal_space(rows, card.elements)), grid


def render(
    observer: Observer, card: Card, brdf: AngleSumBRDF, source: Array, weights: Weights = "thesis"
) -> CaptureSet:
    data = radiance(transport_matrix(observer, card, brdf, weights=weights, tolerance=1e-12), source)
    return CaptureSet(observer=observer, card=card, transport=weights, radiance=data)


# -- exact without noise --------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", ["thesis", "cosine"])
def test_the_thesis_defaults_are_recovered_exactly(weights: Weights) -> None:
    # N 500, A 20, B 20, M 4 at y = -1 and the four lobes of 1 deg; a spline of degree 7 and step sigma/10 follows them to
    # (sigma/10)^8 / 8! of an 8th derivative, below rounding. Measured: 1e-14; asked: 1e-12.
    observer, card, source = thesis_observer(), thesis_card(), patterns()
    transport = transport_matrix(observer, card, lobes(), weights=weights)
    found, grid = recover(observer, card, weights, radiance(transport, source), 0.1)
    assert up_to_scale(found.source, source) < 1e-12
    assert up_to_scale(found.transport, transport.reshape(-1, 4)) < 1e-12
    assert found.mismatch < 1e-20
    assert 0.1 < found.gap < 1
    assert found.near_solutions == 1
    # The BRDF itself, where the captures saw it.
    u = np.radians(np.linspace(-60, 60, 1201))
    assert up_to_scale(grid.evaluate(found.coefficients, u), lobes().of_sum(u)) < 1e-11


def test_strips_and_footprints_are_recovered_as_exactly_as_points() -> None:
    # F stays linear in rho, whatever is integrated: 1e-14 at the defaults too. It is held back by quadrature alone: data
    # and design use different orders, each right to 1e-12 of a lobe, and the subspace turns by that over the root of the
    # gap (0.6). Fewer views and broader lobes here, for speed.
    observer = thesis_observer(pixels=200, views=5, pixels_at="centres")
    card, source, brdf = thesis_card(width=0.02), patterns(), lobes(sigma_deg=4.0)
    transport = transport_matrix(observer, card, brdf, tolerance=1e-12)
    found, _ = recover(observer, card, "physical", radiance(transport, source), 0.4)
    assert up_to_scale(found.source, source) < 1e-12
    assert up_to_scale(found.transport, transport.reshape(-1, 4)) < 1e-12
    # The twin: read as points, the same captures are of no such wall, and the certificate says so.
    points, _ = recover(observer, card, "cosine", radiance(transport, source), 0.4)
    assert points.mismatch > 1e8 * max(found.mismatch, 1e-24)
    assert up_to_scale(points.source, source) > 1e-6


@pytest.mark.parametrize("elements", [1, 2, 6])
def test_any_number_of_elements_is_recovered(elements: int) -> None:
    observer, card, source = thesis_observer(200, 10), thesis_card(elements), patterns(elements)
    transport = transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis")
    found, _ = recover(observer, card, "thesis", radiance(transport, source), 0.3)
    assert up_to_scale(found.source, source) < 1e-11


def test_many_elements_are_found_by_lanczos_as_by_the_dense_way() -> None:
    # Above 16 elements the M^2 x M^2 matrix is never formed. 17 elements on one side of that line, 16 on the other.
    for elements in (16, 17):
        observer, card, source = thesis_observer(300, 10), thesis_card(elements), patterns(elements, elements + 3)
        transport = transport_matrix(observer, card, lobes(sigma_deg=2.0), weights="thesis")
        found, _ = recover(observer, card, "thesis", radiance(transport, source), 0.25)
        assert up_to_scale(found.source, source) < 1e-9
        assert 0 < found.gap < 1


def test_as_many_realisations_as_elements_are_enough() -> None:
    observer, card, source = thesis_observer(200, 10), thesis_card(), patterns(4, 4)
    transport = transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis")
    found, _ = recover(observer, card, "thesis", radiance(transport, source), 0.3)
    assert up_to_scale(found.source, source) < 1e-11


# -- what must not matter -------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [-300, 40, 900])
def test_intensities_scaled_by_a_power_of_two_change_nothing_but_the_scale(power: int) -> None:
    captures = render(thesis_observer(150, 5), thesis_card(), lobes(sigma_deg=3.0), patterns())
    base = solve(captures, step_deg=0.5)
    # Multiplication by 2^power is exact (the faintest pixels, 1e-200, stay above the denormal numbers), and D / max |D|
    # then the same to the last bit.
    scaled = solve(dataclasses.replace(captures, radiance=np.ldexp(captures.radiance, power)), step_deg=0.5)
    np.testing.assert_array_equal(scaled.source, np.ldexp(base.source, power))
    np.testing.assert_array_equal(scaled.brdf, base.brdf)
    assert scaled.mismatch == base.mismatch
    assert scaled.predicted_error == base.predicted_error


def test_radiance_near_the_smallest_numbers_is_no_smaller_a_problem() -> None:
    # Here the lobes' tails vanish among the denormal numbers, 1e-36 of the brightest pixel: below rounding.
    captures = render(thesis_observer(150, 5), thesis_card(), lobes(sigma_deg=3.0), patterns())
    faint = solve(dataclasses.replace(captures, radiance=np.ldexp(captures.radiance, -950)), step_deg=0.3)
    assert up_to_scale(faint.source, patterns()) < 1e-11


def test_the_order_of_elements_only_orders_the_answer() -> None:
    observer, card, source = thesis_observer(200, 10), thesis_card(), patterns()
    transport = transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis")
    data = radiance(transport, source)
    straight, _ = recover(observer, card, "thesis", data, 0.3)
    order = [2, 0, 3, 1]
    shuffled = dataclasses.replace(card, elements_x=tuple(card.elements_x[i] for i in order))
    found, _ = recover(observer, shuffled, "thesis", data, 0.3)
    # Another order of sums, magnified by the condition of the problem (1 / gap, cond F < 100).
    np.testing.assert_allclose(found.source, straight.source[order], rtol=0, atol=1e-11 * np.max(straight.source))
    # The twin: positions in another order than the truth's are another card, and the mismatch tells.
    assert up_to_scale(found.source, source) > 0.1
    assert up_to_scale(found.source, source[order]) < 1e-11


def test_the_order_of_views_does_not_matter() -> None:
    observer, card, source = thesis_observer(200, 10), thesis_card(), patterns()
    data = radiance(transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis"), source)
    straight, _ = recover(observer, card, "thesis", data, 0.3)
    order = np.random.default_rng(1).permutation(10)
    turned = dataclasses.replace(observer, view_angles=tuple(observer.view_angles[a] for a in order))
    found, _ = recover(turned, card, "thesis", data[order], 0.3)
    np.testing.assert_allclose(found.source, straight.source, rtol=0, atol=1e-11 * np.max(straight.source))
    # The twin: views in an order that is not the data's.
    mixed, _ = recover(turned, card, "thesis", data, 0.3)
    assert mixed.mismatch > 1e-3


# -- certificates ---------------------------------------------------------------------------------------------


def test_rank_loss_is_reported() -> None:
    observer, card = thesis_observer(200, 5), thesis_card()
    three = patterns(4, 3) @ np.random.default_rng(1).random((3, 20))  # twenty mixtures of three patterns
    data = radiance(transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis"), three).reshape(-1, 20)
    assert signal_space(data, 4).rank == 3
    assert signal_space(data[:, :2], 4).rank == 2
    assert signal_space(data, 3).rank == 3
    # The twin: four patterns have rank four, and noise above the fourth singular value takes it away again.
    full = radiance(transport_matrix(observer, card, lobes(sigma_deg=3.0), weights="thesis"), patterns())
    space = signal_space(full.reshape(-1, 20), 4)
    assert space.rank == 4
    assert signal_space(full.reshape(-1, 20), 4, noise_floor=1.01 * space.singular_values[3]).rank == 3


def test_the_signal_space_is_that_of_a_singular_value_decomposition() -> None:
    rng = np.random.default_rng(2)
    data = rng.standard_normal((60, 7))
    space = signal_space(data, 3)
    left, values, _ = np.linalg.svd(data, full_matrices=False)
    np.testing.assert_allclose(space.singular_values, values, rtol=1e-13)
    np.testing.assert_allclose(space.basis @ space.basis.T, left[:, :3] @ left[:, :3].T, rtol=0, atol=1e-13)


def test_mismatch_and_gap_are_eigenvalues_of_the_dense_problem() -> None:
    # sum |(I - U U^T) T_i r|^2 against sum |T_i r|^2, as one generalised eigenproblem without the module's shortcuts.
    import scipy.linalg as sl

    observer, card, source = thesis_observer(60, 4), thesis_card(3), patterns(3, 6)
    data = radiance(transport_matrix(observer, card, lobes(sigma_deg=6.0), weights="thesis"), source)
    data = data + 1e-3 * np.random.default_rng(3).standard_normal(data.shape)
    found, grid = recover(observer, card, "thesis", data, 4.0, degree=3)
    kernel = build_kernel(observer, card, weights="thesis")
    designs = [t.toarray() for t in design_matrices(kernel, grid)]
    rows = data.reshape(-1, 6)
    u = np.linalg.svd(rows, full_matrices=False)[0][:, :3]
    gram = sum(t.T @ t for t in designs)
    missed = sum(t.T @ (t - u @ (u.T @ t)) for t in designs)
    seen = np.diag(gram) > 1e-9 * np.diag(gram).max()
    values, vectors = sl.eigh(missed[np.ix_(seen, seen)], gram[np.ix_(seen, seen)])
    # Relative ridge 1e-13 and a condition of the Gram matrix of some 1e6.
    assert found.mismatch == pytest.approx(values[0], rel=1e-5)
    assert found.gap == pytest.approx(values[1], rel=1e-5)
    assert up_to_scale(found.coefficients[seen], vectors[:, 0]) < 1e-5


def rows_at(columns: list[list[int]], size: int, seed: int) -> sp.csr_array:
    """A design matrix with random entries at these columns of each row."""
    lengths = [len(row) for row in columns]
    values = np.random.default_rng(seed).standard_normal(sum(lengths))
    return sp.csr_array((values, np.concatenate(columns), np.cumsum([0, *lengths])), shape=(len(columns), size))


RUNS = [[0, 1, 2], [2, 3, 4], [3, 4, 5], [0, 1, 2]]
ROWS = {
    "runs": RUNS,
    "gaps": [[0, 1, 4], [2, 3, 5], [0, 4, 5], [0, 1, 2]],
    "gaps in one row": [*RUNS[:3], [1, 2, 5]],
    # First and last column are as far apart as in a run.
    "out of order": [[0, 1, 2], [2, 5, 4], [3, 4, 5], [0, 4, 2]],
    "unequal lengths": [[0, 1], [2, 3, 4, 5], [3, 4, 5], [0, 1, 2]],
    "an empty row": [*RUNS[:3], []],
}


@pytest.mark.parametrize("columns", ROWS.values(), ids=ROWS)
def test_the_band_is_that_of_the_dense_gram_matrix(columns: list[list[int]]) -> None:
    # Planted fault: taking every matrix with rows of equal length for runs of columns, without a look at where they are,
    # fails for both kinds of gaps and for columns out of order. The second matrix of the pair has runs of another length.
    designs = [rows_at(columns, 6, 1), rows_at([[0, 1], [4, 5], [2, 3], [1, 2]], 6, 2)]
    for weights in (None, np.random.default_rng(3).random((4, 1))):
        gram = sum(np.square(1.0 if weights is None else weights).T * t.toarray().T @ t.toarray() for t in designs)
        band = banded_gram(designs, weights)
        for d in range(6):
            found = band[d, : 6 - d] if d < band.shape[0] else np.zeros(6 - d)
            np.testing.assert_allclose(found, np.diagonal(gram, -d), rtol=0, atol=1e-14)  # ten products of order one


def test_rows_weighted_on_the_way_are_rows_weighted_before() -> None:
    observer, card, source = thesis_observer(), thesis_card(), patterns()
    kernel = build_kernel(observer, card, weights="thesis")
    designs = design_matrices(kernel, grid_for(kernel, step=np.radians(1), degree=7))
    data = radiance(transport_matrix(observer, card, lobes(), weights="thesis"), source).reshape(-1, source.shape[1])
    weights = np.random.default_rng(0).uniform(0.5, 2, (data.shape[0], 1))
    space = signal_space(weights * data, card.elements)
    before = closed_form(weights * data, [sp.csr_array(t.multiply(weights)) for t in designs], space)
    within = closed_form(weights * data, designs, space, row_weights=weights)
    # To the rounding of the eigenproblem, relative to the gap.
    assert up_to_scale(within.source, before.source) < 1e-9
    assert within.mismatch == pytest.approx(before.mismatch, rel=1e-6)
    # The planted fault: weights that the designs do not get.
    assert up_to_scale(closed_form(weights * data, designs, space).source, before.source) > 1e-3


def test_coarser_knots_through_the_designs_of_finer_ones_are_those_through_their_own() -> None:
    observer, card = thesis_observer(), thesis_card()
    kernel = build_kernel(observer, card, weights="cosine", resolution=0.1, tolerance=1e-9)
    rows = radiance(kernel.apply(lobes(sigma_deg=6)), patterns()).reshape(-1, 20)
    space, coarse = signal_space(rows, 4), grid_for(kernel, step=math.radians(6), degree=5)
    own, finer = design_matrices(kernel, coarse), design_matrices(kernel, coarse.halved())
    band, weights = banded_gram(own), np.ones((rows.shape[0], 1))
    expected = closed_form(rows, own, space, row_weights=weights, band=band)
    halved = coarse.in_halved()
    through = closed_form(rows, finer, space, row_weights=weights, band=band, prolongation=halved)
    assert through.mismatch == pytest.approx(expected.mismatch, rel=1e-6)
    np.testing.assert_allclose(through.source, expected.source, rtol=1e-9)
    assert through.coefficients.shape == (coarse.size,)
    # The planted fault: coefficients of coarser knots that are put one knot aside.
    aside = sp.csr_array(np.roll(halved.toarray(), 1, axis=0))
    wrong = closed_form(rows, finer, space, row_weights=weights, band=band, prolongation=aside)
    assert wrong.mismatch > 2 * expected.mismatch


@pytest.mark.parametrize("factor", [1.01, 0.99])
def test_a_wrong_distance_of_the_card_shows_in_the_mismatch(factor: float) -> None:
    observer, card, source = thesis_observer(), thesis_card(), patterns()
    data = radiance(transport_matrix(observer, card, lobes(), weights="thesis"), source)
    right, _ = recover(observer, card, "thesis", data, 0.25)
    wrong, _ = recover(observer, dataclasses.replace(card, y=factor * card.y), "thesis", data, 0.25)
    # One per cent of a metre turns theta_s by up to 0.29 deg, a third of a lobe: some per cent of the light is misplaced.
    assert right.mismatch < 1e-15
    assert wrong.mismatch > 1e-3
    assert up_to_scale(wrong.source, source) > 1e-3


def test_a_grid_too_coarse_for_the_lobes_shows_in_the_mismatch() -> None:
    observer, card, source = thesis_observer(), thesis_card(), patterns()
    data = radiance(transport_matrix(observer, card, lobes(), weights="thesis"), source)
    mismatches = [recover(observer, card, "thesis", data, step)[0].mismatch for step in (2.0, 1.0, 0.5, 0.25)]
    assert mismatches[0] > 1e-3
    # A degree-7 spline gains about 2^8 in amplitude, 2^16 in the mismatch, for each halving once it resolves the lobes.
    assert mismatches[2] / mismatches[3] > 2**12


# -- what the data do not determine ---------------------------------------------------------------------------

METHODS: tuple[Method, ...] = ("auto", "closed_form", "maximum_likelihood")


@pytest.mark.parametrize("method", METHODS)
def test_a_wall_that_sends_the_same_everywhere_is_refused(method: Method) -> None:
    # Constant rho, G = 1: every pixel sees the plain sum of the pattern.
    captures = render(thesis_observer(100, 4), thesis_card(), Diffuse(albedo=0.5), patterns())
    message = assert_undetermined(lambda: solve(captures, method=method))
    assert "only 1 independent pattern" in message
    assert "4 elements" in message


def test_the_same_wall_is_no_riddle_once_the_cosine_is_known() -> None:
    # The twin: with cos(theta_s) in front, parallax tells the elements apart.
    captures = render(thesis_observer(100, 4), thesis_card(), Diffuse(albedo=0.5), patterns(), "cosine")
    assert up_to_scale(solve(captures).source, patterns()) < 1e-9


@pytest.mark.parametrize("method", ["closed_form", "maximum_likelihood"])
def test_fewer_realisations_than_elements_are_refused(method: Method) -> None:
    # "auto" hands them to the search for few captures, which needs no space of rank M.
    captures = render(thesis_observer(100, 4), thesis_card(), lobes(sigma_deg=3.0), patterns(4, 3))
    message = assert_undetermined(lambda: solve(captures, method=method))
    assert "3 realisation(s)" in message
    assert "at least 4" in message


def test_alike_patterns_are_refused_with_their_number() -> None:
    source = np.repeat(patterns(4, 2), 10, axis=1)
    captures = render(thesis_observer(100, 4), thesis_card(), lobes(sigma_deg=3.0), source)
    assert "only 2 independent pattern" in assert_undetermined(lambda: solve(captures))


def test_an_element_that_never_glows_is_refused() -> None:
    source = patterns()
    source[2] = 0.0
    captures = render(thesis_observer(100, 4), thesis_card(), lobes(sigma_deg=3.0), source)
    assert "only 3 independent pattern" in assert_undetermined(lambda: solve(captures))


def test_one_dark_capture_among_others_is_recovered_as_dark() -> None:
    source = patterns()
    source[:, 7] = 0.0
    captures = render(thesis_observer(100, 10), thesis_card(), lobes(sigma_deg=3.0), source)
    found = solve(captures)
    assert up_to_scale(found.source, source) < 1e-10
    np.testing.assert_array_equal(found.source[:, 7], 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_darkness_is_refused(method: Method) -> None:
    captures = render(thesis_observer(100, 4), thesis_card(), lobes(sigma_deg=3.0), 0 * patterns())
    assert "dark" in assert_undetermined(lambda: solve(captures, method=method))


def test_elements_at_the_same_place_are_refused() -> None:
    card = Card(elements_x=(-1.0, 0.5, 0.5), y=-1.0)
    captures = render(thesis_observer(100, 4), card, lobes(sigma_deg=3.0), patterns(3))
    assert "same place" in assert_undetermined(lambda: solve(captures))


def test_saturation_everywhere_is_refused() -> None:
    captures = render(thesis_observer(100, 4), thesis_card(), lobes(sigma_deg=3.0), patterns())
    blind = dataclasses.replace(captures, variance=np.full(captures.radiance.shape, math.inf))
    assert "saturated" in assert_undetermined(lambda: solve(blind))


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("method", METHODS)
def test_elements_that_share_no_angle_are_refused(method: Method, noise: float) -> None:
    # Each half of the BRDF belongs to one element and has a scale of its own: no relation between the two elements can be
    # known. One more or less noisy answer would be a confident wrong one.
    observer, card = far_apart()
    captures = render(observer, card, lobes(), patterns(2))
    data = captures.radiance + noise * np.random.default_rng(4).standard_normal(captures.radiance.shape)
    assert_undetermined(lambda: solve(dataclasses.replace(captures, radiance=data), method=method))


@pytest.mark.parametrize(("pixels", "views", "elements"), [(2, 2, 2), (10, 1, 4), (3, 1, 2)])
def test_fewer_pixels_than_unknowns_are_refused(pixels: int, views: int, elements: int) -> None:
    captures = render(
        thesis_observer(pixels, views), thesis_card(elements), lobes(sigma_deg=5.0), patterns(elements, elements)
    )
    assert_undetermined(lambda: solve(captures))


class Ripple(AngleSumBRDF):
    """1 + cos(2u)/2: in the far field its shifts span three dimensions, but many reflectances fit."""

    def of_sum(self, u: object) -> Array:
        return 1 + 0.5 * np.cos(2 * np.asarray(u, dtype=np.float64))


@pytest.mark.parametrize(
    ("distance", "noise"), [(1000.0, 0.0), (300.0, 0.0), (300.0, 1e-6), (300.0, 1e-7), (1000.0, 1e-7)]
)
@pytest.mark.parametrize("method", ["auto", "maximum_likelihood"])
def test_parallax_lost_in_rounding_or_noise_is_not_answered_with_confidence(
    distance: float, noise: float, method: Method
) -> None:
    # Either refused, or with error bars that cover what is wrong (three of them, for one draw).
    source = patterns(3)
    captures = render(thesis_observer(200, 10), thesis_card(3, y=-distance), Ripple(), source)
    grain = noise * np.max(captures.radiance) * np.random.default_rng(0).standard_normal(captures.radiance.shape)
    captures = dataclasses.replace(captures, radiance=captures.radiance + grain)
    try:
        found = solve(captures, method=method)
    except UndeterminedError:
        return
    assert up_to_scale(found.source, source) < 3 * found.predicted_error


def test_an_unknown_method_is_refused() -> None:
    captures = render(thesis_observer(20, 2), thesis_card(), lobes(sigma_deg=3.0), patterns())
    assert refused(lambda: solve(captures, method="magic")).field == "method"  # type: ignore[arg-type]
    for step in (0.0, -1.0, 46.0, math.nan):
        assert refused(lambda step=step: solve(captures, step_deg=step)).field == "step_deg"


@pytest.mark.parametrize("method", ["auto", "closed_form"])
@pytest.mark.parametrize("seed", range(3))
def test_a_pattern_fainter_than_what_is_missed_is_not_answered_with_confidence(
    seed: int, method: Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of a wall that is diffuse but for the far tail of a lobe two elements look alike to a part in 1e8, which no knots follow.
    observer = Observer(position=(0.0, -5.0), fov=0.58, view_angles=(0.13, 0.0, -0.13), pixels=199)
    card = Card(elements_x=(-3.28, -3.17), y=-0.79)
    brdf = Sum(parts=(GaussianTrain(centres=(-0.1,), sigma=0.06), Diffuse(albedo=0.6)))
    source = patterns(2, 4, seed)
    films = radiance(transport_matrix(observer, card, brdf, weights="thesis"), source)
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=films)
    assert "faintest of their patterns" in assert_undetermined(lambda: solve(captures, method=method))
    # The planted fault: that other knots agree is believed, though all make a pattern of what they miss.
    monkeypatch.setattr("wallmirror.derendering.conclusion.faintest_missed", lambda *_: 0.0)
    believed = solve(captures, method=method)
    assert believed.verdict == "good"
    assert up_to_scale(believed.source, source) > 50 * believed.predicted_error
