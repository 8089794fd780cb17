"""Form factors of a box and its Neumann series: published values, sum rules, quadrature, and closed sums of the series."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wallmirror.radiosity import FACES, Box, neumann_series, transport_operator

from .helpers import refused

Array = NDArray[np.float64]
BOX = Box(size=(2.0, 3.0, 1.0), cells=3)


# -- form factors ---------------------------------------------------------------------------------------------


def test_the_faces_of_a_cube_see_each_other_as_published() -> None:
    # Siegel and Howell, Thermal Radiation Heat Transfer, give 0.1998 for the opposite face; the rest is four times 0.2000.
    factors = Box(size=(1.0, 1.0, 1.0), cells=1).form_factors()
    assert factors[0, 1] == pytest.approx(0.1998, abs=5e-5)
    np.testing.assert_allclose(factors[0, 2:], (1 - factors[0, 1]) / 4, rtol=1e-14)


def rules(factors: Array, areas: Array) -> tuple[float, float]:
    """How far rows are from a sum of 1, and A_i F_ij from A_j F_ji, the latter relative to the largest."""
    exchange = areas[:, None] * factors
    return float(np.abs(factors.sum(axis=1) - 1).max()), float(np.abs(exchange - exchange.T).max() / exchange.max())


@pytest.mark.parametrize("cells", [1, 3, 6])
@pytest.mark.parametrize("size", [(1.0, 1.0, 1.0), (2.0, 3.0, 1.0), (1.0, 100.0, 1.0)])
def test_a_closed_box_loses_no_light_and_is_reciprocal(cells: int, size: tuple[float, float, float]) -> None:
    box = Box(size=size, cells=cells)
    assert box.areas.sum() == pytest.approx(2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0]))
    factors = box.form_factors()
    assert factors.min() > -1e-9
    # Sixteen terms of up to size^2 log(size^2) cancel down to the exchange of one patch: eps times that quotient.
    closes, reciprocal = rules(factors, box.areas)
    terms = max(size) ** 2 * (1 + 2 * abs(math.log(max(size)))) / box.areas.min()
    assert closes < 40 * np.finfo(float).eps * terms * factors.shape[0]
    assert reciprocal < 1e-13


def test_a_wrong_form_factor_breaks_the_rules() -> None:
    factors, areas = BOX.form_factors(), BOX.areas
    wrong = factors.copy()
    wrong[0, 20] *= 1.001
    assert rules(wrong, areas)[0] > 1e-6
    assert rules(wrong, areas)[1] > 1e-6
    # Rows and columns mistaken for each other: reciprocal for equal areas only.
    assert rules(factors.T, areas)[0] > 0.1


def by_quadrature(box: Box, i: int, j: int, order: int = 14) -> float:
    """F_ij by Gauss and Legendre over both patches, from the definition."""
    nodes, shares = np.polynomial.legendre.leggauss(order)

    def points(patch: int) -> tuple[Array, Array, Array]:
        axis, end = divmod(int(box.face[patch]), 2)
        one, two = (a for a in range(3) if a != axis)
        low, high = box.low[patch], box.high[patch]
        u, v = (g.ravel() for g in np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2, indexing="ij"))
        place = np.tile(low, (u.size, 1))
        place[:, one] += u * (high - low)[one]
        place[:, two] += v * (high - low)[two]
        normal = np.zeros(3)
        normal[axis] = 1 - 2 * end
        return place, np.outer(shares, shares).ravel() / 4, normal

    (x, a, n), (y, b, m) = points(i), points(j)
    ray = y[None] - x[:, None]
    square = np.sum(ray**2, axis=-1)
    kernel = (ray @ n) * -(ray @ m) / (math.pi * square**2)
    return float(a @ kernel @ b * box.areas[j])


def test_form_factors_are_their_definition_integrated() -> None:
    """One pair of patches that do not touch for every pair of faces."""
    factors = BOX.form_factors()
    checked = set()
    for i, j in itertools.combinations(range(54), 2):
        apart = np.maximum(BOX.low[i] - BOX.high[j], BOX.low[j] - BOX.high[i]).max()
        kind = int(BOX.face[i]), int(BOX.face[j])
        if kind[0] == kind[1] or apart < 0.3 or kind in checked:
            continue
        checked.add(kind)
        assert factors[i, j] == pytest.approx(by_quadrature(BOX, i, j), rel=1e-7)
    assert len(checked) == 15


def test_halving_the_patches_adds_up() -> None:
    """What a face sends to another is the same however both are cut: also for pairs that share an edge."""
    coarse, fine = Box(size=(2.0, 3.0, 1.0), cells=1), Box(size=(2.0, 3.0, 1.0), cells=4)
    exchange = fine.areas[:, None] * fine.form_factors()
    for i, j in itertools.combinations(range(6), 2):
        sent = exchange[np.ix_(fine.face == i, fine.face == j)].sum() / coarse.areas[i]
        assert sent == pytest.approx(coarse.form_factors()[i, j], rel=1e-12)


# -- the series -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
def test_a_furnace_shines_with_the_geometric_sum(albedo: float) -> None:
    series = neumann_series(transport_operator(BOX.form_factors(), albedo), np.ones(54), 12)
    np.testing.assert_allclose(series.exact, 1 / (1 - albedo), rtol=1e-12)
    for k, partial in enumerate(series.partial_sums):
        np.testing.assert_allclose(partial, sum(albedo**n for n in range(k + 1)), rtol=1e-12)
    assert series.largest_factor == pytest.approx(albedo, abs=1e-13)
    assert series.spectral_radius == pytest.approx(albedo, abs=1e-12)


def test_the_error_falls_in_the_ratio_of_the_spectral_radius_and_no_slower_than_the_norm() -> None:
    albedo = BOX.on("z0", 0.9, 0.4)
    series = neumann_series(transport_operator(BOX.form_factors(), albedo), BOX.on("z1"), 60)
    assert series.spectral_radius < series.largest_factor == pytest.approx(0.9, rel=1e-12)
    # The next eigenvalue is a half of the first, so that five terms from the last it has left 2^-20 of its trace.
    assert series.ratio == pytest.approx(series.spectral_radius, rel=1e-4)
    bound = series.largest_factor ** np.arange(61) * series.errors[0] + 1e-15
    assert np.all(series.errors <= bound)
    # The twin: the smallest albedo, as if it were the norm, is no bound.
    assert np.any(series.errors > 0.4 ** np.arange(61) * series.errors[0] + 1e-15)


def test_a_room_that_absorbs_nothing_has_no_steady_state_unless_it_has_a_window() -> None:
    closed = transport_operator(BOX.form_factors(), 1.0)
    assert "spectral radius 1" in refused(lambda: neumann_series(closed, np.ones(54), 3)).message
    window = Box(size=(2.0, 3.0, 1.0), cells=3, open_faces=("y1",))
    series = neumann_series(transport_operator(window.form_factors(), 1.0), np.ones(45), 10)
    assert series.spectral_radius < series.largest_factor < 1
    assert np.all(series.exact > 1)


def test_a_room_of_walls_that_create_light_diverges_though_its_system_has_a_solution() -> None:
    series = neumann_series(transport_operator(BOX.form_factors(), 1.5), np.ones(54), 20)
    assert series.spectral_radius == pytest.approx(1.5, rel=1e-12)
    assert series.ratio == pytest.approx(1.5, rel=1e-6)
    assert np.all(series.exact < 0)  # 1 / (1 - 1.5): no radiance


def test_one_albedo_below_one_is_enough() -> None:
    albedo = BOX.on("z0", 0.5, 1.0)
    series = neumann_series(transport_operator(BOX.form_factors(), albedo), BOX.on("z1"), 30)
    assert series.largest_factor == pytest.approx(1.0, rel=1e-12)
    assert series.spectral_radius < 0.95


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Box(size=(1.0, 0.0, 1.0)), "size"),
        (lambda: Box(size=(1.0, math.nan, 1.0)), "size"),
        (lambda: Box(size=(1.0, 1.0, 1.0), cells=0), "cells"),
        (lambda: Box(size=(1.0, 1.0, 1.0), cells=100), "cells"),
        (lambda: Box(size=(1.0, 1.0, 1.0), open_faces=("w0",)), "open_faces"),  # type: ignore[arg-type]
        (lambda: transport_operator(np.eye(3), -0.1), "albedo"),
        (lambda: transport_operator(np.eye(3), math.nan), "albedo"),
        (lambda: neumann_series(np.eye(3), np.ones(2), 3), "operator"),
        (lambda: neumann_series(-np.eye(3), np.ones(3), 3), "operator"),
        (lambda: neumann_series(np.full((3, 3), math.nan), np.ones(3), 3), "operator"),
    ],
)
def test_faults_are_refused(make: Any, field: str) -> None:
    assert refused(make).field == field


def test_faces_are_where_their_names_say() -> None:
    for k, name in enumerate(FACES):
        mine = BOX.on(name) == 1
        assert mine.sum() == 9
        assert np.all(BOX.low[mine, k // 2] == (k % 2) * BOX.size[k // 2])
        assert np.all(BOX.high[mine, k // 2] == (k % 2) * BOX.size[k // 2])
