"""The Neumann series by depth differences: exact zeros, a ratio known in closed form, and planted faults."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from wallmirror.errors import InputError
from wallmirror.interreflection import directional_albedo, from_card, from_room
from wallmirror.jobs import bouncing
from wallmirror.jobs.bouncing import (
    SETTINGS,
    TERMS,
    WALLS,
    bounces_scene,
    measure_bounces,
    price_of_one_bounce,
    series_of,
)
from wallmirror.scene import load_scene, scene_names
from wallmirror.transport import radiance, transport_matrix

pytestmark = pytest.mark.usefixtures("mi")


def analytic_share(scene, view, extra):
    """Light beyond one bounce over light of one bounce in one view, by quadrature."""
    observer = replace(scene.observer, pixels=128, view_angles=(scene.observer.view_angles[view],))
    one = radiance(transport_matrix(observer, scene.card, scene.wall.brdf, tolerance=1e-5), scene.source[:, :1])
    return float(extra(observer, scene.source[:, :1]).sum() / one.sum())


@pytest.mark.parametrize("wall", WALLS)
def test_black_card_in_the_open_gives_one_bounce_to_the_bit(wall):
    result = measure_bounces(bounces_scene(wall, "black"), views=1, seeds=4)
    assert result.exact
    assert result.beyond.value == 0
    assert [result.verdict(t) for t in bouncing.TOLERANCES] == ["holds"] * 3


def test_planted_grey_card_is_not_exact():
    scene = bounces_scene("diffuse", "card_far")
    result = measure_bounces(replace(scene, card=replace(scene.card, albedo=0.001)), views=1, seeds=4)
    assert not result.exact


def test_two_endless_parallel_planes_return_the_product_of_their_albedos():
    """All that leaves one plane meets the other, so each round trip keeps wall albedo times card albedo: 0.5 * 0.8.

    A card of 80 x 80 distances that glows all over stands for an endless one, seen 20 distances from its edge.
    """
    scene = bounces_scene("diffuse", "card_near")
    card = replace(
        scene.card, board_width=20.0, board_height=20.0, elements_x=(0.0,), element_width=20.0, element_height=20.0
    )
    endless = replace(scene, card=card, source=np.ones((1, 1)))
    found = measure_bounces(endless, views=1, seeds=4)
    assert [found.ratios[k].value for k in (0, 2, 4)] == pytest.approx([0.4, 0.4, 0.4], rel=0.02)
    assert [found.terms[k - 2].value for k in (2, 4, 6)] == pytest.approx([0, 0, 0], abs=1e-7)


def test_light_back_from_a_near_card_is_what_the_quadrature_says():
    scene = bounces_scene("diffuse", "card_near")
    found = measure_bounces(scene, views=1, seeds=8)
    expected = analytic_share(scene, 0, lambda o, v: from_card(o, scene.card, scene.wall.brdf, v))
    # Two per cent for the quadrature's nodes.
    assert abs(found.beyond.value - expected) < 4 * found.beyond.error + 0.02 * expected


def test_light_back_from_a_box_is_what_radiosity_says():
    scene = bounces_scene("diffuse", "box")
    found = measure_bounces(scene, views=1, seeds=8)
    expected = analytic_share(scene, 0, lambda o, v: from_room(o, scene.card, scene.room, scene.wall.brdf, v))
    # 5 % for patches of half a metre; light that meets the wall three times or more is 12 % here.
    assert abs(found.beyond.value - expected) < 2 * found.beyond.error + 0.05 * expected


def light_of(terms, scatter=1e-4, seeds=16):
    rng = np.random.default_rng(5)
    return np.cumsum(terms, axis=-1) * (1 + scatter * rng.standard_normal((seeds, 1)))


def test_geometric_series_is_bounded_by_its_own_ratio():
    q = 0.3
    terms = q ** np.arange(TERMS + 1.0)
    terms[-1] = q**TERMS / (1 - q)
    found = series_of("made up", light_of(terms), exact=False)
    assert all(r.value == pytest.approx(q * q) for r in found.ratios)
    assert found.tail_bound == pytest.approx(found.rest.value)
    assert found.beyond.value == pytest.approx(q / (1 - q))
    assert found.verdict(0.05) == "fails"
    assert found.verdict(0.5) == "holds"


def test_verdict_waits_where_the_interval_holds_the_tolerance():
    rng = np.random.default_rng(6)
    light = np.ones((16, TERMS + 1))
    light[:, 1:] += 0.01 * (1 + 0.1 * rng.standard_normal((16, 1)))
    assert series_of("made up", light, exact=False).verdict(0.01) == "undecided"


def test_dark_picture_and_few_seeds_are_refused():
    with pytest.raises(InputError, match="no light"):
        series_of("dark", np.zeros((8, TERMS + 1)), exact=True)
    with pytest.raises(InputError, match="too few"):
        series_of("lonely", np.ones((2, TERMS + 1)), exact=True)


def test_mirror_has_no_price():
    with pytest.raises(InputError, match="mirror"):
        price_of_one_bounce(bounces_scene("mirror", "card_far"))


def test_every_cell_is_a_scene_and_the_shipped_ones_are_the_tables_own():
    cells = {bounces_scene(wall, setting).name: bounces_scene(wall, setting) for wall in WALLS for setting in SETTINGS}
    assert len(cells) == len(WALLS) * len(SETTINGS)
    for name in set(cells) & set(scene_names()):
        shipped, cell = load_scene(name), cells[name]
        assert (shipped.wall, shipped.card, shipped.room, shipped.observer) == (
            cell.wall,
            cell.card,
            cell.room,
            cell.observer,
        )
        assert np.array_equal(shipped.source, cell.source)


def test_scale_of_the_check_is_the_walls_albedo():
    assert directional_albedo(bounces_scene("diffuse", "box").wall.brdf) == pytest.approx(0.5)
    assert math.isclose(bounces_scene("diffuse", "card_near").card.distance, 0.25)
