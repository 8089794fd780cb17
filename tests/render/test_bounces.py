"""The Neumann series by depth differences: exact zeros, a ratio known in closed form, and planted faults."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from wallmirror.brdf import Table, directional_albedo
from wallmirror.errors import InputError
from wallmirror.interreflection import from_card, from_room
from wallmirror.jobs import bouncing
from wallmirror.jobs.bouncing import (
    SETTINGS,
    TERMS,
    WALLS,
    bounces_scene,
    measure_bounces,
    series_of,
)
from wallmirror.jobs.counting_bounces import count_bounces
from wallmirror.jobs.pricing import price_of_one_bounce
from wallmirror.scene import Wall, scene_names
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


def test_price_needs_something_to_solve_for():
    table = replace(bounces_scene("diffuse", "card_far"), wall=Wall(brdf=Table(values=np.ones((3, 3)))))
    with pytest.raises(InputError, match="angle sum"):
        price_of_one_bounce(table)
    with pytest.raises(InputError, match="from 2"):
        price_of_one_bounce(bounces_scene("diffuse", "card_far"), depths=(3, 50))


@pytest.mark.parametrize("setting", ["card_far", "card_near"])
def test_mirrors_bias_is_foretold(mi, setting):
    # Glow and gauge are nearly all of the bias of a mirror; 3 sets of few samples know it to a few per cent.
    price = price_of_one_bounce(bounces_scene("mirror", setting), views=4, spp=64, sets=3, depths=(2, 50))
    assert 0.8 < price.foretold < 1.25
    assert price.depths[0].source_error < 0.01


def test_every_cell_is_a_scene_of_its_own():
    cells = {bounces_scene(wall, setting).name for wall in WALLS for setting in SETTINGS}
    assert len(cells) == len(WALLS) * len(SETTINGS)
    assert cells <= set(scene_names())


def test_scale_of_the_check_is_the_walls_albedo():
    assert directional_albedo(bounces_scene("diffuse", "box").wall.brdf) == pytest.approx(0.5)
    assert math.isclose(bounces_scene("diffuse", "card_near").card.distance, 0.25)


def test_board_of_a_card_beside_the_middle_is_where_the_quadrature_has_it():
    scene = bounces_scene("diffuse", "card_near")
    elements = tuple(x + 1.5 for x in scene.card.elements_x)
    aside = replace(scene, card=replace(scene.card, elements_x=elements, board_width=5.1))
    found = measure_bounces(aside, views=1, seeds=8)
    expected = analytic_share(aside, 0, lambda o, v: from_card(o, aside.card, aside.wall.brdf, v))
    assert abs(found.beyond.value - expected) < 4 * found.beyond.error + 0.02 * expected


def test_page_and_verdicts_of_bounces(mi, tmp_path):
    scenes = [bounces_scene("lobes", "black"), bounces_scene("diffuse", "card_near")]
    small = [replace(s, observer=replace(s.observer, pixels=64)) for s in scenes]
    told = count_bounces(small, tmp_path, quick=True)
    assert all(r.passed for r in told)  # nothing was asked
    asked = count_bounces(small, tmp_path, quick=True, tolerance=0.05)
    assert [r.passed for r in asked] == [True, False]
    assert "to the bit" in asked[0].text
    assert "is not enough" in asked[1].text
    stored = json.loads((tmp_path / "bounces.json").read_text())
    assert [s["passed"] for s in stored] == [True, False]
    assert stored[1]["beyond"]["value"] == pytest.approx(asked[1].bounces.beyond.value)
    assert "A white card close to a diffuse wall" in (tmp_path / "bounces.html").read_text()


def test_light_left_after_the_deepest_render_is_bounded_by_what_card_and_room_send_back():
    """Ratios so noisy that their limit exceeds 1 leave the sum unbounded, unless the albedos are known."""
    rng = np.random.default_rng(7)
    terms = 0.01 * 0.95 ** np.arange(TERMS + 1.0) * (1 + rng.standard_normal((16, TERMS + 1)))
    terms[:, 0] = 1
    light = np.cumsum(terms, axis=-1)
    assert math.isinf(series_of("made up", light, exact=False).tail_bound)
    known = series_of("made up", light, exact=False, sent_back=0.8)
    assert known.largest_ratio == 0.8
    assert known.verdict(0.5) == "holds"
