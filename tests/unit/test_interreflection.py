"""Light beyond one bounce, against quadrature and a Monte Carlo of our own that shares no formula with the code."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from wallmirror import CaptureSet, Card, Diffuse, GaussianTrain, Observer, Room, Sum, radiance, solve, transport_matrix
from wallmirror.brdf import directional_albedo
from wallmirror.interreflection import from_card, from_room
from wallmirror.interreflection.card import _through_wall

OBSERVER = Observer(position=(0.0, -5.0), fov=math.radians(60), view_angles=(0.25, 0.08, -0.08, -0.25), pixels=100)
SATIN = Sum(
    parts=(
        GaussianTrain(centres=(-0.4, 0.0, 0.5), sigma=math.radians(5), scale=0.3),
        Diffuse(albedo=0.3),
    )
)


def white_card(**changes):
    fields = {
        "elements_x": (-0.8, 0.1, 0.9),
        "y": -1.0,
        "element_width": 0.02,
        "element_height": 0.02,
        "albedo": 0.8,
        "board_width": 2.0,
        "board_height": 1.0,
    }
    return Card(**{**fields, **changes})


def test_albedo_of_a_diffuse_wall_is_its_albedo_at_any_incidence():
    # Midpoint rule on 7200 cells: error below (pi/7200)^2/24 ~ 1e-8.
    for incidence in (0.0, 0.7, -1.2):
        assert directional_albedo(Diffuse(albedo=0.37), incidence) == pytest.approx(0.37, rel=1e-7)


def height_integral(z, a, b, d):
    """int z^2/(A^2+h^2)^2 z^2/(B^2+(h-d)^2)^2 dh by adaptive quadrature."""
    value, _ = quad(
        lambda h: z**4 / (a * a + h * h) ** 2 / (b * b + (h - d) ** 2) ** 2, -np.inf, np.inf, epsabs=0, epsrel=1e-11
    )
    return value


@pytest.mark.parametrize(
    ("x_q", "h_q", "x_s", "h_s"), [(0.0, 0.0, 0.0, 0.0), (0.5, 0.3, -0.7, -0.2), (1.5, -0.4, 1.4, 0.4)]
)
def test_exchange_through_the_wall_matches_adaptive_quadrature(x_q, h_q, x_s, h_s):
    z = 0.7

    def over_wall(phi):
        x = x_q + z * math.tan(phi)
        u = math.atan((x_q - x) / z) + math.atan((x_s - x) / z)
        step = z / math.cos(phi) ** 2
        return (
            float(SATIN.of_sum(u))
            * step
            * height_integral(z, math.hypot(z, x_q - x), math.hypot(z, x_s - x), h_q - h_s)
        )

    expected, _ = quad(over_wall, -math.pi / 2, math.pi / 2, limit=400, epsrel=1e-8)
    found = _through_wall(np.array([x_q]), np.array([h_q]), np.array([x_s]), np.array([h_s]), z, SATIN)[0, 0]
    # 1500 midpoints over 180 deg: 0.12 deg against lobes of 5 deg, where the midpoint rule has converged to ~1e-6.
    assert found == pytest.approx(expected, rel=1e-5)


def test_wrong_height_difference_is_seen():
    right = _through_wall(np.array([0.2]), np.array([0.3]), np.array([-0.4]), np.array([-0.2]), 0.7, SATIN)
    wrong = _through_wall(np.array([0.2]), np.array([0.3]), np.array([-0.4]), np.array([+0.2]), 0.7, SATIN)
    assert abs(right / wrong - 1).item() > 0.1


def test_light_back_from_the_card_matches_a_random_walk():
    """One wall - card - wall path per sample, cosine-sampled from the strip; albedo so low that one return is all."""
    card = white_card(albedo=0.05)
    wall = Diffuse(albedo=0.5)
    source = np.array([[3.0], [1.0], [2.0]])
    rng = np.random.default_rng(7)
    count = 400_000

    def cosine_hemisphere(n):
        r, phi = np.sqrt(rng.random(n)), 2 * math.pi * rng.random(n)
        return r * np.cos(phi), np.sqrt(1 - r * r), r * np.sin(phi)

    x = np.repeat(card.elements_x, count)
    flux = np.repeat(math.pi * source[:, 0] * card.element_width * card.element_height / count, count)
    dx, dy, dz = cosine_hemisphere(x.size)
    wall_x, wall_z = x + dx / dy * card.distance, dz / dy * card.distance
    dx, dy, dz = cosine_hemisphere(x.size)  # reflected by the diffuse wall, carrying its albedo
    board_x, board_z = wall_x + dx / dy * card.distance, wall_z + dz / dy * card.distance
    hit = (np.abs(board_x) <= card.board_width / 2) & (np.abs(board_z) <= card.board_height / 2)
    weight = np.where(hit, flux * wall.albedo * card.albedo, 0.0)
    # Radiance at the wall point straight ahead: sum over board points of flux / pi cos cos / r^2 times the BRDF.
    square = board_x**2 + card.distance**2 + board_z**2
    samples = weight / math.pi * card.distance**2 / square**2 * wall.albedo / math.pi
    expected = samples.sum()
    error = samples.std() * math.sqrt(samples.size)
    looking = Observer(position=(0.0, -5.0), fov=1e-3, view_angles=(0.0,), pixels=1)
    found = from_card(looking, card, wall, source)[0, 0, 0]
    # Four standard errors, and 2 % for the 24 x 4 nodes and the second return (albedo product 0.025).
    assert abs(found - expected) < 4 * error + 0.02 * expected
    assert error < 0.02 * expected


def test_light_over_a_room_matches_a_random_walk_that_meets_the_wall_again():
    """Paths through a box with a diffuse wall; every meeting with the room is connected to the wall point looked at."""
    room = Room(half_width=2.0, half_height=1.5, depth=4.0, albedo=0.8)
    card, wall = white_card(albedo=0.0), Diffuse(albedo=0.8)
    rng = np.random.default_rng(11)
    count = 200_000
    place = np.zeros((count, 3))
    place[:, 0] = rng.choice(card.elements_x, count)
    place[:, 1] = card.y
    normal = np.tile([0.0, 1.0, 0.0], (count, 1))
    flux = np.full(count, math.pi * card.element_width * card.element_height * 3 / count)
    low, high = np.array([-2.0, -4.0, -1.5]), np.array([2.0, 0.0, 1.5])
    sums = {"all": np.zeros(count), "wall met once at most": np.zeros(count)}
    met = np.zeros(count, dtype=int)
    alive = np.ones(count, dtype=bool)
    for _ in range(12):
        # Cosine-distributed about the normal: a unit normal plus a uniform unit vector.
        ball = rng.standard_normal((count, 3))
        way = normal + ball / np.linalg.norm(ball, axis=1, keepdims=True)
        with np.errstate(divide="ignore"):
            steps = np.where(way > 0, (high - place) / way, (low - place) / way)
        steps[normal != 0] = np.where(steps[normal != 0] < 1e-9, np.inf, steps[normal != 0])
        axis = np.argmin(steps, axis=1)
        side = np.sign(way[np.arange(count), axis])
        place = place + steps.min(axis=1, keepdims=True) * way
        normal = np.zeros((count, 3))
        normal[np.arange(count), axis] = -side
        at_wall = (axis == 1) & (side > 0)
        alive &= ~((axis == 1) & (side < 0))  # out through the open end
        flux = flux * np.where(at_wall, wall.albedo, room.albedo)
        square = np.sum(place**2, axis=1)
        facing = np.maximum(np.sum(-place * normal, axis=1), 0.0)
        seen = alive & ~at_wall
        sample = np.where(seen, flux / math.pi * facing * -place[:, 1] / square**2 * wall.albedo / math.pi, 0.0)
        sums["all"] += sample
        sums["wall met once at most"] += np.where(met <= 1, sample, 0.0)
        met += at_wall
    expected, error = sums["all"].sum(), sums["all"].std() * math.sqrt(count)
    looking = Observer(position=(0.0, -3.0), fov=1e-3, view_angles=(0.0,), pixels=2)
    found = from_room(looking, card, room, wall, np.ones((3, 1)))[0, 0, 0]
    # Ten per cent: patches exchange light from centre to centre, which is too much in the corners of so small a box.
    assert error < 0.01 * expected
    assert abs(found - expected) < 4 * error + 0.1 * expected
    assert sums["wall met once at most"].sum() < 0.85 * expected  # the walk does tell


def test_nothing_comes_back_from_a_black_card_and_a_black_room():
    source = np.ones((3, 2))
    assert not from_card(OBSERVER, white_card(albedo=0.0), SATIN, source).any()
    dark = Room(half_width=6, half_height=3, depth=8, albedo=0.0)
    assert not from_room(OBSERVER, white_card(), dark, SATIN, source).any()


def captures_of(card, extra, *, room=None):
    rng = np.random.default_rng(3)
    source = 0.1 + rng.random((3, 4))
    one = radiance(transport_matrix(OBSERVER, card, SATIN, tolerance=1e-6), source)
    total = one + (extra(source) if extra else 0.0)
    sigma = 2e-3 * one.max()
    noisy = total + sigma * rng.standard_normal(total.shape)
    variance = np.full(total.shape, sigma**2)
    return CaptureSet(observer=OBSERVER, card=card, radiance=noisy, variance=variance, room=room), source


def test_bias_is_foretold_and_told_where_the_card_reflects():
    card = white_card(y=-0.5)
    captures, source = captures_of(card, lambda v: from_card(OBSERVER, card, SATIN, v))
    control, _ = captures_of(card, None)
    albedo = directional_albedo(SATIN)
    biased, clean = solve(captures, wall_albedo=albedo), solve(control, wall_albedo=albedo)

    def off(solution):
        scale = np.sum(solution.source * source) / np.sum(solution.source**2)
        return np.linalg.norm(scale * solution.source - source) / np.linalg.norm(source)

    assert off(clean) < 2 * clean.predicted_error
    assert off(biased) > 5 * off(clean)  # the card's light did turn the pattern,
    assert 0.5 < biased.one_bounce.bias / off(biased) < 2  # the check foretells by how much,
    assert biased.verdict == "doubtful"  # and the status says so.
    assert "Hypothesis 2" in biased.status


def test_no_check_where_nothing_reflects():
    captures, _ = captures_of(white_card(albedo=0.0), None)
    solution = solve(captures)
    assert solution.one_bounce is None
    assert solution.verdict == "good"
