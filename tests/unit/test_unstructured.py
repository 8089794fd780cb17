"""The thesis's own algorithm: its operator U, its two halves done exactly, and its faults where it has them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from wallmirror.brdf import GaussianTrain
from wallmirror.captures import CaptureSet
from wallmirror.derendering import alternation
from wallmirror.derendering.box_qp import optimality, solve_box_qps
from wallmirror.derendering.chaining import Chain, Start, chain_views
from wallmirror.derendering.unstructured import UnstructuredSolution, de_render_unstructured
from wallmirror.geometry import Observer, scan_angles, wall_points
from wallmirror.transport import radiance, transport_matrix

from .helpers import assert_undetermined, lobes, refused, thesis_card, thesis_observer

Array = NDArray[np.float64]


def chain_error(pixels: int, chain: Chain | None = None) -> float:
    """MSE(B, U^-1 U B) of the thesis's scene."""
    observer = thesis_observer(pixels)
    brdf = transport_matrix(observer, thesis_card(), GaussianTrain.of_the_code(), weights="thesis")
    chain = chain or chain_views(observer)
    return float(np.mean((chain.spread(chain.structured(brdf)) - brdf) ** 2))


def render(pixels: int = 300, views: int = 6, elements: int = 4, realisations: int = 10, seed: int = 0) -> CaptureSet:
    observer, card = thesis_observer(pixels, views), thesis_card(elements)
    source = np.random.default_rng(seed).random((elements, realisations))
    model = transport_matrix(observer, card, lobes(sigma_deg=2.0), weights="thesis")
    return CaptureSet(observer=observer, card=card, transport="thesis", radiance=radiance(model, source))


def consistent(pixels: int = 60, views: int = 4, elements: int = 1, seed: int = 0) -> tuple[CaptureSet, Array, Array]:
    """Captures of a BRDF that is constant along the chain, with that BRDF and the pattern."""
    observer, card = thesis_observer(pixels, views), thesis_card(elements)
    chain = chain_views(observer)
    rng = np.random.default_rng(seed)
    brdf = chain.spread(rng.uniform(0.1, 0.9, (chain.rows, elements)))
    source = rng.uniform(0.1, 0.9, (elements, 5))
    captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=radiance(brdf, source))
    return captures, brdf, source


# -- the operator U -------------------------------------------------------------------------------------------


def test_b_diff_of_the_defaults_has_805_rows() -> None:
    # 804 wall points seen for the first time and the row of zeros that Algorithm 2's truncation leaves: what the thesis's
    # code makes of N = 500, A = 20. Every further view of its equal steps adds 16.
    for start in ("middle", "first"):
        chain = chain_views(thesis_observer(), start=start)
        assert chain.rows == 805
        assert chain.picked.size == 500 + 19 * 16
        assert not np.any(chain.structured(np.ones((20, 500, 3)))[-1])
    # One view has nothing to truncate.
    assert chain_views(thesis_observer(views=1)).rows == 500


@pytest.mark.parametrize("start", ["middle", "first"])
@pytest.mark.parametrize("views", [1, 2, 5, 6])
def test_u_and_its_inverse_follow_algorithm_2_step_by_step(start: Start, views: int) -> None:
    # The same operator written down as the thesis does: matrix by matrix, with its distances in full.
    observer = thesis_observer(40, views)
    matrices = np.random.default_rng(0).random((views, 40, 3))
    points = wall_points(observer)
    first = math.floor(views / 2 + 0.5) - 1 if start == "middle" else 0
    blocks, rebuilt = [matrices[first]], {}
    for sequence, side in ((range(first, views), 1), (range(first, -1, -1), -1)):
        last, kept = first, matrices[first]
        for a in sequence:
            edge = points[last].max() if side > 0 else points[last].min()
            new = side * points[a] > side * edge
            if a != first:
                blocks.append(matrices[a][new])
                nearest = np.argmin(np.abs(points[last][:, None] - points[a]), axis=0)
                kept = np.where(new[:, None], matrices[a], kept[nearest])
            rebuilt[a], last = kept, a
    chain = chain_views(observer, start=start)
    structured = np.vstack(blocks)
    np.testing.assert_array_equal(chain.structured(matrices)[: len(structured)], structured)
    np.testing.assert_array_equal(
        chain.spread(chain.structured(matrices)), np.stack([rebuilt[a] for a in range(views)])
    )


def test_what_is_constant_along_the_chain_survives_u_exactly() -> None:
    chain = chain_views(thesis_observer(80, 7))
    structured = np.random.default_rng(1).random((chain.rows, 4))
    structured[-1] = 0
    matrices = chain.spread(structured)
    np.testing.assert_array_equal(chain.structured(matrices), structured)
    np.testing.assert_array_equal(chain.spread(chain.structured(matrices)), matrices)
    # The fault: neighbours one pixel off. What they make is no longer constant along the chain that U reads.
    shifted = dataclasses.replace(chain, given=np.roll(chain.given, 1, axis=1))
    assert not np.array_equal(chain.spread(chain.structured(shifted.spread(structured))), shifted.spread(structured))


@pytest.mark.parametrize(("pixels", "error"), [(50, 0.0390), (258, 0.0087), (500, 0.00082), (2000, 0.00008)])
def test_u_costs_what_it_costs_the_thesis(pixels: int, error: float) -> None:
    # The errors of the thesis's own code on its own scene, as printed: right to half a unit of the last digit.
    unit = 1e-4 if error > 1e-3 else 1e-5
    assert abs(chain_error(pixels) - error) <= unit / 2
    # The fault: neighbours one pixel off. At N = 50 the lobes are narrower than a pixel and next to nothing matches anyhow.
    chain = chain_views(thesis_observer(pixels))
    shifted = dataclasses.replace(chain, given=np.roll(chain.given, 1, axis=1))
    assert abs(chain_error(pixels, shifted) - error) > unit / 2


def test_views_far_apart_are_all_new() -> None:
    observer = Observer(position=(0.0, -5.0), fov=0.2, view_angles=(0.6, 0.0, -0.6), pixels=10)
    chain = chain_views(observer)
    assert chain.rows == 31
    matrices = np.random.default_rng(0).random((3, 10, 2))
    np.testing.assert_array_equal(chain.spread(chain.structured(matrices)), matrices)


def test_views_with_one_pixel_are_chained() -> None:
    observer = Observer(position=(0.0, -5.0), fov=0.2, view_angles=(0.1, 0.1, 0.0), pixels=1)
    chain = chain_views(observer)
    # The second view looks at the same point as the first, the third at a new one.
    np.testing.assert_array_equal(chain.given[:2], [[0], [0]])
    assert chain.rows == 3


# -- the two halves -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("elements", [1, 2, 4, 8])
@pytest.mark.parametrize("rank", ["full", "deficient"])
def test_box_programs_are_solved_as_scipy_solves_them(elements: int, rank: str) -> None:
    # |A x - b|^2 with A^T A = H and A^T b = c, for K right-hand sides, each an own call of lsq_linear.
    rng = np.random.default_rng(elements)
    rows = 12 if rank == "full" else max(1, elements - 2)
    a, b = rng.standard_normal((rows, elements)), rng.standard_normal((30, rows))
    upper = np.where(rng.random((30, elements)) < 0.2, 0.0, 1.0)
    x = solve_box_qps(a.T @ a, b @ a, upper, rng.random((30, elements)))
    assert np.all((x >= 0) & (x <= upper))
    assert optimality(a.T @ a, b @ a, upper, x) < 1e-12
    for k in range(30):
        free = upper[k] > 0
        if not free.any():
            continue
        reference = lsq_linear(a[:, free], b[k], (0, 1), method="bvls", tol=1e-14).x
        ours, theirs = (np.sum((a[:, free] @ y - b[k]) ** 2) for y in (x[k, free], reference))
        # bvls stops within 1e-14 of the optimum, relative; the sums round at 1e-15.
        assert abs(ours - theirs) <= 1e-12 * np.sum(b[k] ** 2)
        if rank == "full":
            np.testing.assert_allclose(x[k, free], reference, rtol=0, atol=1e-10)


def test_box_programs_agree_with_every_set_of_active_bounds() -> None:
    # Brute force: of all 27 guesses which bounds hold, the best feasible point.
    rng = np.random.default_rng(5)
    factor = rng.standard_normal((3, 3))
    hessian, linear = factor @ factor.T + 0.1 * np.eye(3), 2 * rng.standard_normal((50, 3))
    x = solve_box_qps(hessian, linear, np.ones((50, 3)), np.zeros((50, 3)))

    def value(c: Array, y: Array) -> float:
        return float(0.5 * y @ hessian @ y - c @ y)

    for c, found in zip(linear, x, strict=True):
        best = math.inf
        for bounds in itertools.product((0.0, 1.0, None), repeat=3):
            free = np.array([b is None for b in bounds])
            y = np.array([0.0 if b is None else b for b in bounds])
            y[free] = np.linalg.solve(hessian[np.ix_(free, free)], (c - hessian @ y)[free])
            if np.all((y >= -1e-12) & (y <= 1 + 1e-12)):
                best = min(best, value(c, y))
        assert abs(value(c, found) - best) < 1e-12
    # The fault: the unbounded solution, clipped, is feasible but not optimal, and the certificate tells.
    clipped = np.clip(np.linalg.solve(hessian, linear.T).T, 0, 1)
    assert optimality(hessian, linear, np.ones((50, 3)), clipped) > 1e-2


def test_of_many_solutions_the_one_next_to_the_start_is_taken() -> None:
    # H = 1 1^T: all x with the same sum are as good; the projection of the start moves all entries alike.
    start = np.array([[0.2, 0.3, 0.4]])
    x = solve_box_qps(np.ones((3, 3)), np.full((1, 3), 1.2), np.ones((1, 3)), start)
    np.testing.assert_allclose(x, start + 0.1, rtol=0, atol=1e-6)


def test_a_hessian_of_zeros_leaves_only_the_linear_term() -> None:
    start = np.array([[0.5, 0.5, 0.5]])
    x = solve_box_qps(np.zeros((3, 3)), np.array([[1.0, -1.0, 0.0]]), np.ones((1, 3)), start)
    np.testing.assert_array_equal(x, [[1.0, 0.0, 0.5]])


def test_a_thousand_badly_conditioned_programs_all_end() -> None:
    # Columns that are alike to 1e-4, as those of B_diff are at the start: a condition of 1e8.
    rng = np.random.default_rng(9)
    a = 1 + 1e-4 * rng.standard_normal((20, 6))
    linear = (a @ rng.random((6, 1000)) + 1e-2 * rng.standard_normal((20, 1000))).T @ a
    x = solve_box_qps(a.T @ a, linear, np.ones((1000, 6)), np.full((1000, 6), 0.5))
    assert optimality(a.T @ a, linear, np.ones((1000, 6)), x) < 1e-12


def test_programs_whose_solution_lies_on_its_bounds_by_a_hair_end_too() -> None:
    # Small integers: gradients at the bounds that are exactly zero, and Hessians that are exactly singular.
    rng = np.random.default_rng(11)
    for elements in (2, 3, 5):
        for _ in range(50):
            a = rng.integers(-1, 2, (elements, elements)).astype(np.float64)
            x0 = rng.integers(0, 2, (20, elements)).astype(np.float64)
            upper = np.ones((20, elements))
            x = solve_box_qps(a.T @ a, x0 @ a.T @ a, upper, rng.random((20, elements)))
            assert optimality(a.T @ a, x0 @ a.T @ a, upper, x) < 1e-12


# -- the alternation ------------------------------------------------------------------------------------------


def rising(solution: UnstructuredSolution) -> float:
    """Largest rise of the objective from one half to the next, relative to its first value."""
    values = solution.objective.ravel()
    return float(np.max(np.diff(values)) / values[0])


def test_the_objective_never_rises(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(3):
        solution = de_render_unstructured(render(seed=seed), tolerance=0, rng=seed)
        # The start's B need not lie in its box, but it does here; sums of 1e4 squares round at 1e-14.
        assert rising(solution) <= 1e-13
        assert solution.kkt < 1e-10
        assert solution.objective.shape == (solution.alternations, 2)

    # The fault: halves solved without their bounds and clipped.
    def clipped(hessian: Array, linear: Array, upper: Array, start: Array) -> Array:
        ridge = 1e-9 * np.trace(hessian) * np.eye(len(hessian))
        return np.clip(np.linalg.solve(hessian + ridge, linear.T + ridge @ start.T).T, 0, upper)

    monkeypatch.setattr(alternation, "solve_box_qps", clipped)
    worse = de_render_unstructured(render(), tolerance=0)
    assert rising(worse) > 1e-6
    assert worse.kkt > 1e-3


def test_the_objective_is_the_misfit_of_what_is_returned() -> None:
    # Both terms again, from the full matrices instead of grouped rows.
    captures = render()
    solution = de_render_unstructured(captures, alpha=0.7, cap=4)
    misfit = np.sum((captures.radiance - solution.brdf @ solution.source) ** 2)
    np.testing.assert_allclose(solution.misfit[-1, 1], misfit, rtol=1e-12)
    np.testing.assert_allclose(solution.objective[-1, 1], misfit + 0.7 * np.sum(solution.structured), rtol=1e-12)
    np.testing.assert_allclose(solution.residual, math.sqrt(misfit / np.sum(captures.radiance**2)), rtol=1e-12)
    np.testing.assert_array_equal(chain_views(captures.observer).spread(solution.structured), solution.brdf)


def test_what_u_keeps_is_explained_completely_and_nothing_else_is() -> None:
    # One element, a BRDF that is constant along the chain, no L1 term, all coefficients: rank one in a box, and the
    # alternation ends where it is matched to rounding, up to the scale that it cannot know.
    options: dict[str, Any] = {"alpha": 0.0, "proportion": 1.0, "tolerance": 0.0, "cap": 300}
    captures, brdf, source = consistent()
    solution = de_render_unstructured(captures, **options)
    assert solution.residual < 1e-12
    np.testing.assert_allclose(solution.brdf @ solution.source, brdf @ source, rtol=0, atol=1e-12)
    # The twin: a BRDF that is not constant along the chain keeps the residual that nearest neighbours leave.
    observer = captures.observer
    model = transport_matrix(observer, captures.card, lobes(sigma_deg=2.0), weights="thesis")
    captures = dataclasses.replace(captures, radiance=radiance(model, source))
    assert de_render_unstructured(captures, **options).residual > 1e-2


def test_both_rules_of_stopping_stop_where_they_say() -> None:
    captures, tolerance = render(), 1.0
    code = de_render_unstructured(captures, tolerance=tolerance, cap=200)
    decreases = -np.diff(code.objective, axis=0)
    assert code.stopped_by == "tolerance"
    assert np.all(decreases[-1] <= tolerance)
    assert np.all(np.max(decreases[:-1], axis=1) > tolerance)
    # Here one half is done an alternation before the other: the smaller of the decreases would have stopped there.
    assert np.min(decreases[-2]) <= tolerance
    text = de_render_unstructured(captures, tolerance=tolerance, cap=200, stopping="text")
    change = text.misfit[:, 1] - text.misfit[:, 0]
    assert text.stopped_by == "tolerance"
    assert change[-1] <= tolerance
    assert np.all(change[:-1] > tolerance)
    # The BRDF's half lowers the misfit sooner or later, and the rule as printed ends it there; the code's goes on.
    assert text.alternations < code.alternations
    capped = de_render_unstructured(captures, tolerance=tolerance, cap=code.alternations - 1)
    assert (capped.stopped_by, capped.alternations) == ("cap", code.alternations - 1)
    assert "cap" in capped.status
    assert "tolerance after" in code.status


def test_only_the_brightest_coefficients_are_estimated() -> None:
    captures = render()
    chain = chain_views(captures.observer)
    mean = chain.structured(captures.radiance.mean(axis=2, keepdims=True))[:, 0]
    brightest = np.argsort(-mean, kind="stable")
    count = round(0.05 * 4 * chain.rows)
    assert count % 4 > 0
    entries = de_render_unstructured(captures, alpha=0.0)
    rows = de_render_unstructured(captures, alpha=0.0, support="rows")
    assert entries.support == count
    assert rows.support == count - count % 4
    assert not np.any(rows.structured[brightest[count // 4 :]])
    assert not np.any(entries.structured[brightest[count // 4 + 1 :]])
    # The row that is cut short: only the alternation's first columns may use it.
    used = entries.structured[brightest[count // 4]] > 0
    assert np.all(np.array(entries.order)[used] < count % 4)
    # The twin: with all coefficients in use, those rows are not dark.
    assert np.any(de_render_unstructured(captures, alpha=0.0, proportion=1.0).structured[brightest[count // 4 + 1 :]])


# -- order ----------------------------------------------------------------------------------------------------


def test_the_original_order_is_right_for_10_permutations_of_24() -> None:
    # Sorting permutes the BRDF; the thesis's code permutes the source by the inverse. A permutation equals its inverse
    # for the involutions, of which the symmetric group of four elements has 10. The card's positions run through them.
    captures = render(pixels=100, views=4)
    agreed, residuals = 0, []
    places = np.array(captures.card.elements_x)
    found = set()
    for shuffle in itertools.permutations(range(4)):
        card = dataclasses.replace(captures.card, elements_x=tuple(places[list(shuffle)]))
        pair = [
            de_render_unstructured(dataclasses.replace(captures, card=card), cap=2, ordering=ordering)
            for ordering in ("mended", "original")
        ]
        np.testing.assert_array_equal(pair[0].brdf, pair[1].brdf)
        agreed += np.array_equal(pair[0].source, pair[1].source)
        found.add(pair[0].order)
        # Mended, BRDF and pattern belong together; with the fault they need not even explain the data.
        np.testing.assert_allclose(
            np.sum((captures.radiance - pair[0].brdf @ pair[0].source) ** 2), pair[0].misfit[-1, 1], rtol=1e-12
        )
        residuals.append(np.sum((captures.radiance - pair[1].brdf @ pair[1].source) ** 2) / pair[1].misfit[-1, 1])
    assert len(found) == 24
    assert agreed == 10
    assert np.count_nonzero(np.array(residuals) > 1.01) == 14


def test_columns_are_ordered_by_the_row_of_their_peak() -> None:
    captures = render(pixels=500, views=20)
    solution = de_render_unstructured(captures)
    # 20 views, 4 elements: the first five, which look furthest to the left.
    peaks = np.mean(np.argmax(solution.brdf[:5], axis=1), axis=0)
    assert np.all(np.diff(peaks) >= 0)


def test_the_order_of_the_views_does_not_matter() -> None:
    captures = render()
    observer = dataclasses.replace(captures.observer, view_angles=captures.observer.view_angles[::-1])
    turned = dataclasses.replace(captures, observer=observer, radiance=captures.radiance[::-1])
    straight, backwards = de_render_unstructured(captures), de_render_unstructured(turned)
    # The same sums in another order, through 30 alternations of a problem that is not ill conditioned.
    np.testing.assert_allclose(backwards.source, straight.source, rtol=0, atol=1e-9)
    np.testing.assert_allclose(backwards.brdf[::-1], straight.brdf, rtol=0, atol=1e-9)
    # The twin: the views of the wrong order are other captures.
    wrong = de_render_unstructured(dataclasses.replace(captures, radiance=captures.radiance[::-1]))
    assert np.max(np.abs(wrong.source - straight.source)) > 1e-2


# -- the start, and what is refused ---------------------------------------------------------------------------


def test_the_start_is_random_and_can_be_repeated() -> None:
    captures = render()
    first = de_render_unstructured(captures, rng=3)
    np.testing.assert_array_equal(first.source, de_render_unstructured(captures, rng=np.random.default_rng(3)).source)
    assert np.max(np.abs(first.source - de_render_unstructured(captures, rng=4).source)) > 1e-6


def test_captures_are_not_changed() -> None:
    captures = render(pixels=60, views=2)
    before = captures.radiance.copy()
    de_render_unstructured(captures)
    np.testing.assert_array_equal(captures.radiance, before)


@pytest.mark.parametrize("elements", [1, 2, 7])
def test_any_number_of_elements_and_realisations_is_taken(elements: int) -> None:
    for realisations in (1, 3):
        captures = render(100, 3, elements, realisations)
        solution = de_render_unstructured(captures, proportion=0.2)
        assert solution.source.shape == (elements, realisations)
        assert solution.brdf.shape == (3, 100, elements)
        # Fewer patterns than elements make the BRDF's half singular: solved all the same.
        assert solution.kkt < 1e-10
        assert np.all((solution.source >= 0) & (solution.source <= 1))
        assert np.all((solution.brdf >= 0) & (solution.brdf <= 1))


def test_an_l1_term_that_kills_everything_is_told() -> None:
    solution = de_render_unstructured(render(), alpha=1e6)
    assert not np.any(solution.brdf)
    assert "lower alpha" in solution.status
    assert "lower alpha" not in de_render_unstructured(render()).status


def test_captures_without_light_or_beyond_numbers_are_refused() -> None:
    captures = render(pixels=20, views=2)
    dark = dataclasses.replace(captures, radiance=np.zeros_like(captures.radiance))
    assert "dark" in assert_undetermined(lambda: de_render_unstructured(dark))
    for power in (-600, 600):
        far = dataclasses.replace(captures, radiance=np.ldexp(captures.radiance, power))
        assert refused(lambda far=far: de_render_unstructured(far)).field == "radiance"


@pytest.mark.parametrize(
    "option",
    [
        {"alpha": -1.0},
        {"alpha": math.nan},
        {"tolerance": -1e-3},
        {"tolerance": math.inf},
        {"proportion": 0.0},
        {"proportion": 1.5},
        {"proportion": 1e-6},
        {"cap": 0},
        {"start": "last"},
        {"support": "columns"},
        {"stopping": "never"},
        {"ordering": "random"},
    ],
)
def test_options_out_of_range_are_refused(option: dict[str, Any]) -> None:
    captures = render(pixels=20, views=2)
    assert refused(lambda: de_render_unstructured(captures, **option)).field == next(iter(option))


def test_the_scan_of_the_thesis_is_the_one_meant() -> None:
    # The first view covers x in [-5, 1.3397], the last the mirrored range: tan(45 deg) and tan(-15 deg) times 5.
    points = wall_points(thesis_observer())
    np.testing.assert_allclose(points[0, [0, -1]], [-5, 5 * math.tan(math.radians(15))], rtol=1e-14)
    np.testing.assert_allclose(points[-1], -points[0, ::-1], rtol=0, atol=1e-14)
    assert len(scan_angles(20, scan=math.radians(90), fov=math.radians(60))) == 20
