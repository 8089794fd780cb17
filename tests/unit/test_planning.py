"""Planning without a renderer: simplifications, the fewest nodes, samples from pilots; each with a twin that fails."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.helpers import lobes, refused

from wallmirror import Card, Diffuse, Mirror, Scene, Table, Wall, load_scene, radiance, transport_matrix
from wallmirror.comparison import compare, cross_weights, detectable_gain
from wallmirror.jobs.advising import advise, plan_capture
from wallmirror.jobs.piloting import truncations_of
from wallmirror.planning.forward import Quadrature, cheapest_quadrature, coarsest_knots, fewest_table_nodes
from wallmirror.planning.hypotheses import one_bounce_hypothesis, simplifications, table_error
from wallmirror.planning.plan import (
    CapturePlan,
    ForwardPlan,
    Plan,
    SolvePlan,
    Term,
    ValidatePlan,
    checked_tolerance,
    total_error,
)
from wallmirror.planning.sampling import LEAST_SEEDS, MOST_SPP, NoiseLevel, Sampling, cheapest_sampling
from wallmirror.planning.sketch import relative_error, sketch
from wallmirror.planning.words import hypothesis_rows, percent, plan_rows
from wallmirror.transport import build_kernel


def small(name="flat_wall_lobes", *, views=3, pixels=80, **card):
    scene = load_scene(name)
    angles = scene.observer.view_angles
    chosen = tuple(angles[round(i * (len(angles) - 1) / (views - 1))] for i in range(views))
    observer = replace(scene.observer, view_angles=chosen, pixels=pixels)
    return replace(scene, observer=observer, card=replace(scene.card, **card))


def errors(scene, tolerance=1e-3):
    return {h.key: h.error for h in simplifications(sketch(scene, tolerance=tolerance))}


def truth(scene):
    return radiance(transport_matrix(scene.observer, scene.card, scene.wall.brdf, tolerance=1e-10), scene.source)


# -- what each simplification costs, against direct computations by other means --------------------------------------


def films_by_hand(scene, *, strip_nodes=(0.0,), pixel_nodes=(0.0,), factor=None):
    """The physical films from plain sums over equally weighted places in strip and pixel; no code of `transport`.

    `factor` takes the place of the strip's solid angle per length: a function of (dx, z).
    """
    observer, card, half = scene.observer, scene.card, math.tan(scene.observer.fov / 2)
    t = (2 * (np.arange(observer.pixels) + 0.5) / observer.pixels - 1) * half
    total = np.zeros((observer.views, observer.pixels, card.elements))
    z, h = card.distance, card.element_height / 2
    for place in pixel_nodes:
        at = t + place * half / observer.pixels
        for a, view in enumerate(observer.view_angles):
            x = observer.position[0] - observer.distance * np.tan(view - np.arctan(at))
            for offset in strip_nodes:
                dx = np.asarray(card.elements_x) + offset * card.element_width / 2 - x[:, None]
                r2 = z * z + dx * dx
                tall = z * z * (h / (r2 * (r2 + h * h)) + np.arctan(h / np.sqrt(r2)) / r2**1.5)
                weight = tall if factor is None else factor(dx, z)
                u = np.arctan2(dx, z) + np.arctan2(observer.position[0] - x[:, None], observer.distance)
                total[a] += card.element_width * weight * scene.wall.brdf.of_sum(u)
    return (total / (len(strip_nodes) * len(pixel_nodes))) @ scene.source


MIDPOINTS = tuple((np.arange(32) + 0.5) / 16 - 1)


def test_thin_narrow_and_tall_strips_cost_what_plain_sums_say():
    scene = small(element_width=0.1, element_height=0.5, pixels=24, views=2)
    scene = replace(scene, observer=replace(scene.observer, fov=math.radians(12)))
    # 32 midpoints across a strip of 1.1 sigma and a pixel of 0.5 deg are off by less than 1 % of the deviations below;
    # the height of the pixel, 4 cm of wall, which the plain sums leave out, moves the weight by 2e-4.
    full = films_by_hand(scene, strip_nodes=MIDPOINTS, pixel_nodes=MIDPOINTS)
    found = errors(scene)
    z, height = scene.card.distance, scene.card.element_height

    def of(films):
        return np.linalg.norm(films - full) / np.linalg.norm(full)

    by_hand = {
        "narrow strips": of(films_by_hand(scene, pixel_nodes=MIDPOINTS)),
        "pixels as points": of(films_by_hand(scene, strip_nodes=MIDPOINTS)),
        "thin strips": of(
            films_by_hand(scene, pixel_nodes=MIDPOINTS, factor=lambda dx, z: height * z * z / (z * z + dx * dx) ** 2)
        ),
        "two dimensions": of(
            films_by_hand(
                scene,
                strip_nodes=MIDPOINTS,
                pixel_nodes=MIDPOINTS,
                factor=lambda dx, z: math.pi / 2 * z * z / np.hypot(z, dx) ** 3,
            )
        ),
        "far field": of(_common_weight(scene, z)),
    }
    for key, expected in by_hand.items():
        assert found[key] == pytest.approx(expected, rel=0.02), key
        assert expected > 0.02


def _common_weight(scene, z):
    """The far field by hand: the weight of the card's middle for each element."""
    h = scene.card.element_height / 2
    total = 0.0
    for element, x_i in enumerate(scene.card.elements_x):
        one = replace(scene, card=replace(scene.card, elements_x=(x_i,)), source=scene.source[element : element + 1])

        def shared(dx, z, x_i=x_i):
            d = dx - x_i + scene.card.middle
            r2 = z * z + d * d
            return z * z * (h / (r2 * (r2 + h * h)) + np.arctan(h / np.sqrt(r2)) / r2**1.5)

        total = total + films_by_hand(one, strip_nodes=MIDPOINTS, pixel_nodes=MIDPOINTS, factor=shared)
    return total


def test_the_error_of_points_falls_with_the_square_of_the_width():
    # The midpoint rule; strips of 0.3 to 1.2 lobes' sigma seen from the wall, averaged over pixels of 0.75 deg.
    sizes = [errors(small(element_width=w, element_height=1e-3))["narrow strips"] for w in (0.02, 0.01, 0.005)]
    assert sizes[0] / sizes[1] == pytest.approx(4, rel=0.1)
    assert sizes[1] / sizes[2] == pytest.approx(4, rel=0.03)


def test_far_and_endless_strips_are_what_they_are_taken_for():
    tall = errors(small(element_height=400.0))
    assert tall["two dimensions"] < 1e-5
    far = small(y=-2000.0)
    far = replace(far, observer=replace(far.observer, position=(0.0, -2004.0), fov=1e-3, view_angles=(0.0,)))
    assert errors(far)["far field"] < 0.01
    # One view straight ahead is parallel to the wall, so its points are evenly spaced; a turned one is not.
    assert errors(far)["parallel camera"] < 1e-9
    assert errors(small())["parallel camera"] > 0.1


def test_a_scene_far_away_is_a_convolution_and_a_near_one_is_not():
    def at(z):
        scene = small(pixels=200)
        elements = tuple(0.2 * x for x in scene.card.elements_x)
        card = replace(scene.card, y=-z, elements_x=elements)
        observer = replace(scene.observer, position=(0.0, -5.0), view_angles=(0.0,))
        wall = replace(scene.wall, brdf=lobes(-15.0, 15.0, sigma_deg=4.0))
        return errors(replace(scene, card=card, observer=observer, wall=wall))["convolution"]

    assert at(0.5) > 0.5
    assert at(5000.0) < 0.25  # theta_o is not linear in x, which no distance of the card mends


def test_a_brdf_of_both_angles_fails_hypothesis_8_by_what_it_varies_along_lines_of_equal_sum():
    scene = small("flat_wall_diffuse")
    theta = np.linspace(-math.pi / 2, math.pi / 2, 91)
    ramp = 1 + 0.3 * np.sign(theta)[:, None] * np.ones(91)  # depends on theta_s alone
    found = errors(replace(scene, wall=Wall(brdf=Table(values=ramp / math.pi))), tolerance=1e-1)
    assert 0.05 < found["angle sum"] < 0.4
    assert errors(scene)["angle sum"] == 0


def test_mirrors_points_and_sums_are_answered_too():
    assert set(errors(small("flat_wall_mirror"))) == {
        "passive wall",
        "uniform wall",
        "isotropic source",
        "one colour",
        "angle sum",
        "no weight",
    }
    points = errors(small(element_width=0.0, element_height=0.0))
    assert "thin strips" not in points
    assert points["no weight"] > 0.05


def test_scaled_errors_ignore_a_global_factor():
    films = np.random.default_rng(0).random((3, 4))
    assert relative_error(7 * films, films, scaled=True) < 1e-15
    assert relative_error(7 * films, films) == pytest.approx(6)
    assert relative_error(films, np.zeros((3, 4))) == math.inf
    assert relative_error(np.zeros((3, 4)), films, scaled=True) == 1


# -- the cheapest quadrature ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("width", [0.02, 0.3])
def test_the_planned_nodes_keep_the_tolerance_and_no_cheaper_ones_do(tolerance, width):
    scene = small(element_width=width, pixels=24, views=2)
    plan = cheapest_quadrature(sketch(scene, tolerance=tolerance), tolerance=tolerance, views=2)
    reached = relative_error(planned_films(scene, plan), truth(scene))
    # The sketch itself may be off by a fiftieth of the tolerance.
    assert reached <= 1.02 * tolerance
    assert plan.error == pytest.approx(reached, abs=0.02 * tolerance)
    # The twin: one node fewer across the strip breaks the promise, or costs no less for it.
    if plan.across_strip > 1:
        fewer = replace(plan, across_strip=max(1, plan.across_strip // 2))
        assert relative_error(planned_films(scene, fewer), truth(scene)) > tolerance


def planned_films(scene, plan):
    card, area = scene.card, 1.0
    if plan.strips == "points":
        area = card.element_width * card.element_height
        card = replace(card, element_width=0.0, element_height=0.0)
    kernel = build_kernel(scene.observer, card, orders=(plan.across_pixel, plan.across_strip))
    return area * radiance(kernel.apply(scene.wall.brdf), scene.source)


def test_a_plan_without_the_strips_width_is_seen_to_fail():
    scene = small(element_width=0.3)
    drawn = sketch(scene, tolerance=1e-2)
    without = drawn.error(drawn.with_kernel(orders=(drawn.orders[0], 1)))
    assert without > 0.5
    assert cheapest_quadrature(drawn, tolerance=1e-2, views=3).across_strip > 1
    wide = {h.key: h for h in simplifications(drawn)}["narrow strips"]
    assert not wide.holds(1e-2)
    assert wide.error == pytest.approx(without)
    # On a diffuse wall the same strips may go without.
    assert errors(replace(scene, wall=Wall(brdf=Diffuse(albedo=0.5))))["narrow strips"] < 1e-2


def test_scenes_that_seconds_do_not_suffice_for_are_refused():
    # Refused before anything of that size is allocated: its angles alone would take 60 GB.
    scene = small(pixels=1_000_000)
    many = Card(elements_x=tuple(np.linspace(-2.5, 2.5, 100)), y=-1.0, element_width=0.02, element_height=0.02)
    large = replace(scene, card=many, source=np.ones((100, 1)))
    assert "pixels" in str(refused(lambda: sketch(large, tolerance=1e-2)))
    dark = replace(small(), source=np.zeros((4, 1)))
    assert "no light" in str(refused(lambda: sketch(dark, tolerance=1e-2)))


def test_table_and_knots_are_as_fine_as_the_tolerance_needs():
    drawn = sketch(small(), tolerance=1e-3)
    nodes, error = fewest_table_nodes(drawn, tolerance=1e-3)
    assert error <= 1e-3 < table_error(drawn, nodes // 2)
    # Linear interpolation errs with the square of the nodes' distance.
    # The kinks move through pixels of 0.75 deg, which is not quite an average.
    assert table_error(drawn, 1801) / table_error(drawn, 7201) == pytest.approx(16, rel=0.15)
    step, error = coarsest_knots(drawn, tolerance=1e-3)
    assert error <= 1e-3
    assert coarsest_knots(drawn, tolerance=1e-6)[0] < step
    assert fewest_table_nodes(sketch(small("flat_wall_diffuse"), tolerance=1e-3), tolerance=1e-3) is None
    assert coarsest_knots(sketch(small("flat_wall_mirror"), tolerance=1e-3), tolerance=1e-3) is None


# -- samples from pilots ----------------------------------------------------------------------------------------------


def pilot(sampler, spp, noise, seconds):
    return NoiseLevel(sampler=sampler, spp=spp, noise=noise, seconds=seconds)


INDEPENDENT = [pilot("independent", 64, 0.2, 0.010), pilot("independent", 1024, 0.05, 0.040)]
STRATIFIED = [pilot("multijitter", 16, 0.1, 0.008), pilot("multijitter", 256, 0.01, 0.016)]


@pytest.mark.parametrize("noise", [0.5, 0.1, 0.03, 0.01, 1e-3, 1e-4])
@pytest.mark.parametrize("pilots", [INDEPENDENT, STRATIFIED, INDEPENDENT + STRATIFIED], ids=["i", "m", "both"])
def test_planned_samples_reach_the_noise_with_no_seed_to_spare(pilots, noise):
    found = cheapest_sampling(pilots, noise=noise)
    assert found.noise <= noise * (1 + 1e-9)
    assert found.spp <= MOST_SPP
    if found.sampler == "independent":
        assert found.noise == pytest.approx(0.05 * math.sqrt(1024 / found.total))
        assert found.seeds == 1 or found.spp == MOST_SPP
    else:
        level = next(p for p in pilots if p.sampler == "multijitter" and p.spp == found.spp)
        assert found.noise == pytest.approx(level.noise / math.sqrt(found.seeds))
        assert found.seeds >= LEAST_SEEDS
    if found.seeds > LEAST_SEEDS:
        assert found.noise * math.sqrt(found.seeds / (found.seeds - 1)) > noise


def test_the_cheaper_sampler_is_chosen_by_seconds():
    both = INDEPENDENT + STRATIFIED
    assert cheapest_sampling(both, noise=0.1).sampler == "independent"  # eight seeds would cost more than one
    assert cheapest_sampling(both, noise=1e-3).sampler == "multijitter"
    useless = [pilot("multijitter", 256, 0.09, 0.016)]  # stratifying gains nothing here but overhead
    assert cheapest_sampling(INDEPENDENT + useless, noise=1e-3).sampler == "independent"
    refused(lambda: cheapest_sampling(both, noise=0.0))
    refused(lambda: cheapest_sampling([], noise=0.1))


def test_what_depths_leave_out_is_told_from_noise():
    rng = np.random.default_rng(1)
    # One seed's noise of 0.05 a pixel would alone make an error of 0.05; the truth leaves out 1 %.
    shared = 1 + 0.5 * rng.standard_normal((6, 400))
    light = np.stack([shared - 0.01 + 0.02 * rng.standard_normal((6, 400)), shared, shared])
    one, two, deep = truncations_of((2, 4, 50), light)
    mean_square = 1.0  # of the radiance, noise taken out
    assert one.error == pytest.approx(0.01 / math.sqrt(mean_square), rel=0.15)
    assert one.upper > one.error
    assert (two.error, two.upper, deep.error) == (0, 0, 0)


def test_the_detectable_gain_is_foretold_from_eight_seeds_and_no_smaller_than_it_is():
    rng = np.random.default_rng(3)
    reference = 1 + np.sin(np.linspace(0, 20, 400)).reshape(2, 200) ** 2
    spread = 0.05 * reference * np.exp(rng.normal(0, 0.5, reference.shape))  # variances a decade apart

    def seeds(count):
        return reference + spread * rng.standard_normal((count, *reference.shape))

    pilot_seeds, whole = seeds(8), seeds(32)
    foretold = detectable_gain(pilot_seeds, reference, planned=32)
    found = compare(whole, reference, weights=cross_weights(whole, reference)).gain.detectable
    # Eight seeds weigh the pixels worse than thirty-two, which costs up to a third; 32 know their scatter to 13 %.
    assert 0.75 < foretold / found < 1.7
    # Twice the noise doubles it, four times the seeds halve it but for the t distribution's tails.
    louder = reference + 2 * (pilot_seeds - reference)
    assert detectable_gain(louder, reference, planned=32) == pytest.approx(2 * foretold, rel=0.02)
    assert 0.4 < detectable_gain(pilot_seeds, reference, planned=128) / foretold < 0.5
    assert detectable_gain(np.stack([reference] * 8), reference, planned=32) == pytest.approx(1e-5, rel=0.02)
    assert detectable_gain(pilot_seeds, reference, planned=32, edges=reference > 0) == math.inf


# -- the plan itself --------------------------------------------------------------------------------------------------


def a_plan(**changes):
    quadrature = Quadrature(strips="strips", across_pixel=2, across_strip=3, error=1e-3, seconds=0.01)
    sampling = Sampling(sampler="multijitter", spp=256, seeds=8, noise=6e-3, seconds=0.2)
    plan = Plan(
        scene="s",
        tolerance=1e-2,
        forward=ForwardPlan(
            route="analytic",
            quadrature=quadrature,
            terms=(Term(name="quadrature", error=1e-3, kind="bias"),),
            seconds=0.01,
        ),
        capture=CapturePlan(
            tolerance=1e-2,
            sampling=sampling,
            max_depth=2,
            rr_depth=1000,
            table_nodes=None,
            films=80,
            terms=(Term(name="noise", error=6e-3, kind="noise"),),
        ),
        validate=ValidatePlan(views=3, spp=64, detectable=2e-3, seconds=1.0),
        solve=SolvePlan(
            source_error=math.inf,
            samples_per_pixel=64,
            step_deg=0.5,
            knots_error=1e-4,
            quadrature_tolerance=1e-4,
            patterns=(4, 4),
        ),
        hypotheses=(one_bounce_hypothesis(math.nan, "why"),),
        notes=("a note",),
    )
    return replace(plan, **changes)


def test_a_plan_is_a_json_document_without_nan_or_infinity():
    document = json.loads(json.dumps(a_plan().summary(), allow_nan=False))
    assert document["reached"]
    assert document["capture"]["seconds"] == pytest.approx(16)
    assert document["capture"]["samples_per_pixel"] == 2048
    assert document["solve"]["source_error"] is None
    assert document["hypotheses"][0]["holds"] is None
    bare = a_plan(forward=None, capture=None, validate=None, solve=None).summary()
    assert bare["forward"] is None
    assert not bare["reached"]


def test_a_plan_beyond_its_tolerance_is_not_reached():
    too_much = (Term(name="bounces left out", error=0.02, kind="bias"),)
    assert not a_plan(forward=replace(a_plan().forward, terms=too_much)).reached
    assert total_error((*too_much, Term(name="more", error=0.02, kind="bias"))) == pytest.approx(0.04)


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-7, 0.9, math.nan, math.inf])
def test_tolerances_out_of_range_are_refused(value):
    assert "--tolerance" in str(refused(lambda: checked_tolerance(value)))


def test_what_people_read_is_short_and_says_what_to_do():
    rows = {row[0]: row for row in plan_rows(a_plan())}
    assert rows["predict the wall"][1:3] == ["analytic, one bounce; 3 nodes a strip, 2 nodes a pixel", "0.1 %"]
    assert rows["capture"][1:] == ["depth 2, 8 seeds x 256 multijitter samples a pixel", "0.6 %", "16 s"]
    assert rows["solve"][1:3] == ["not with those films: 64 samples a pixel; pattern off by noise", "unbounded"]
    limit = replace(a_plan().forward, terms=(Term(name="glow", error=1e-3, kind="bias", limit=True),))
    assert plan_rows(a_plan(forward=limit))[0][2] == "< 0.1 %"
    assert hypothesis_rows(a_plan())[0][2:] == ["-", "unknown"]
    assert [percent(e) for e in (1e-5, 0.0123, 0.5, 1.2, 83.0)] == ["0.001 %", "1.2 %", "50 %", "120 %", "83 times"]


def test_points_are_planned_for_without_a_renderer():
    scene = small(element_width=0.0, element_height=0.0)
    plan = advise(scene, 1e-2)
    assert (plan.capture, plan.validate, plan.solve) == (None, None, None)
    assert plan.forward.route == "analytic"
    assert plan.reached
    assert "points" in plan.notes[0]
    assert "points" in str(refused(lambda: plan_capture(scene, 1e-2)))
    # A white card before points: what one bounce leaves out cannot be rendered, and is not said to be nothing.
    white = replace(scene, card=replace(scene.card, albedo=0.8, board_width=5.1, board_height=2.0))
    unknown = advise(white, 1e-2)
    assert not unknown.reached
    assert math.isnan(unknown.hypothesis("one bounce").error)
    json.dumps(unknown.summary(), allow_nan=False)


def test_a_mirror_needs_no_nodes():
    scene = small("flat_wall_mirror")
    assert isinstance(scene, Scene)
    assert isinstance(scene.wall.brdf, Mirror)
    assert cheapest_quadrature(sketch(scene, tolerance=1e-3), tolerance=1e-3, views=3).strips == "exact"
