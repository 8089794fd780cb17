"""Pictures against plain vector geometry: the card through the lobes, a sky, an image's four turns, and bounces."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from wallmirror.errors import InputError
from wallmirror.jobs.picturing import WHOLE, measure_picture_bounces
from wallmirror.pathtracing.picture_building import lobes_as_rendered
from wallmirror.pathtracing.picturing import PictureRenderer
from wallmirror.picture_reading import load_picture
from wallmirror.picture_scene import (
    Background,
    Disk,
    Glass,
    Metal,
    Paint,
    PictureCamera,
    PictureScene,
    PictureSettings,
    Rectangle,
    Region,
    Shape,
    Sphere,
    TiltedMirrors,
)

pytestmark = pytest.mark.usefixtures("mi")

BLACK = Paint(colour=(0.0, 0.0, 0.0))


def looking_north(*shapes, fov_deg=20.0, background=None, regions=(), **settings):
    """A camera at (0, -5, 0) that looks along +y, z up."""
    return PictureScene(
        name="made up",
        title="",
        about="",
        camera=PictureCamera(
            position=(0.0, -5.0, 0.0), target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), fov=math.radians(fov_deg)
        ),
        shapes=shapes,
        background=background,
        regions=regions,
        render=PictureSettings(**{"width": 8, "height": 8, "spp": 4, **settings}),
    )


# -- one bounce off the lobes, by quadrature --------------------------------------------------------------------

WIDTH, HEIGHT = 32, 18
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


def wall_points(scene):
    """Quadrature points of every pixel on the wall y = 0, shape (height, width, 6, 2), and the weights of the six."""
    eye = np.array(scene.camera.position)
    half_height = math.tan(scene.camera.fov / 2)
    half_width = half_height * WIDTH / HEIGHT
    across = (np.arange(WIDTH)[:, None] + (1 + NODES) / 2) / WIDTH
    down = (np.arange(HEIGHT)[:, None] + (1 + np.array([-1, 1]) / math.sqrt(3)) / 2) / HEIGHT
    x = eye[0] - eye[1] * half_width * (2 * across - 1)
    z = eye[2] - eye[1] * half_height * (1 - 2 * down)
    return x[None, :, :, None], z[:, None, None, :]


def radiance_by_quadrature(scene, *, mirrored=False, lobes_off=0.0):
    """Sum over the card of V rho(theta_s + theta_o) cos_s cos_l / r^2 dA, averaged over pixels, (height, width, 3).

    The image's cells are cut into 4 x 2. `mirrored` and `lobes_off` (radians) plant faults.
    """
    wall, card = scene.shape("wall"), scene.shape("card")
    rho = lobes_as_rendered(wall.material.brdf)
    image = card.image[:, ::-1] if mirrored else card.image
    cells = np.repeat(np.repeat(image * card.emission, 2, axis=0), 4, axis=1)
    rows, columns = cells.shape[:2]
    s = (np.arange(columns) + 0.5) / columns * 2 - 1
    t = 1 - (np.arange(rows) + 0.5) / rows * 2
    centre, right, up = (np.array(v) for v in (card.geometry.centre, card.geometry.right, card.geometry.up))
    x_card, z_card = centre[0] + right[0] * s, centre[2] + up[2] * t  # the card stands along x and z
    area = 4 * np.linalg.norm(right) * np.linalg.norm(up) / (rows * columns)
    distance = -centre[1]
    x, z = wall_points(scene)
    eye = np.array(scene.camera.position)
    theta_o = np.arctan2(eye[0] - x, -eye[1])
    # Along z only r counts: shape (height, width, 6, 2, columns) at a time, one row of the card after the other.
    total = np.zeros((HEIGHT, WIDTH, 3))
    dx = x_card - x[..., None]
    lobes = rho.of_sum(np.arctan2(dx, distance) + theta_o[..., None] + lobes_off)
    for row in range(rows):
        r2 = dx**2 + distance**2 + (z_card[row] - z[..., None]) ** 2
        kernel = lobes * (distance / r2) ** 2 * area  # cos_s = cos_l = distance / r
        total += np.einsum("hwijc,cq,i->hwq", kernel, cells[row], WEIGHTS / 4)  # 2 equal weights of z, and sum 2
    return total


def agreement(render, expected):
    """Pooled z of the gain, and rms of the pixels' deviations in their own standard errors."""
    per_seed, seeds = render.per_seed, len(render.seeds)
    gains = np.array([np.sum(image * expected) / np.sum(expected**2) for image in per_seed])
    z = (gains.mean() - 1) / (gains.std(ddof=1) / math.sqrt(seeds))
    error = per_seed.std(axis=0, ddof=1) / math.sqrt(seeds)
    lit = expected > 0.02 * expected.max()
    return abs(z), float(np.sqrt(np.mean(((render.mean - expected)[lit] / error[lit]) ** 2)))


@pytest.fixture(scope="module")
def wall_films(mi):
    scene = load_picture("thesis_test_wall")
    renderer = PictureRenderer(scene, width=WIDTH, height=HEIGHT, sampler="independent")
    return scene, renderer.render(2, spp=256, seeds=range(32))


# Student's t with 31 degrees of freedom stays below 4 in 99.96 % of the runs, and its square has the mean 31/29; over
# the 1000 lit pixels and colours, whose deviations the seeds alone tell, the rms scatters by a few per cent about 1.03.
Z_LIMIT, RMS_LIMIT = 4.0, 1.15


def test_the_card_through_the_lobes_is_the_sum_over_its_image(wall_films):
    scene, render = wall_films
    z, rms = agreement(render, radiance_by_quadrature(scene))
    assert z < Z_LIMIT
    assert 0.85 < rms < RMS_LIMIT


@pytest.mark.parametrize("fault", [{"mirrored": True}, {"lobes_off": math.radians(0.5)}], ids=["mirrored", "turned"])
def test_a_planted_fault_is_found(wall_films, fault):
    scene, render = wall_films
    assert agreement(render, radiance_by_quadrature(scene, **fault))[1] > 2 * RMS_LIMIT


def test_nothing_but_the_wall_reflects_so_that_one_bounce_is_all():
    renderer = PictureRenderer(load_picture("thesis_test_wall"), width=WIDTH, height=HEIGHT)
    np.testing.assert_array_equal(renderer.render(2, spp=256).mean, renderer.render(50, spp=256).mean)


# -- what shines ------------------------------------------------------------------------------------------------

CORNERS = np.array([[[1, 0, 0], [0, 2, 0]], [[0, 0, 3], [4, 4, 0]]], dtype=float)


def card(right, up):
    return Shape(
        name="card",
        geometry=Rectangle(centre=(0.0, 0.0, 0.0), right=right, up=up),
        material=BLACK,
        emission=(2.0, 2.0, 2.0),
        image=CORNERS,
    )


def seen(scene, depth=1, **options):
    return PictureRenderer(scene).render(depth, **options).mean


def quarters(image):
    """The pixels amid the four quarters, (2, 2, 3)."""
    return image[np.ix_([1, 6], [1, 6])]


def test_an_image_is_seen_the_right_way_round_and_turns_with_its_card():
    straight = quarters(seen(looking_north(card((2.0, 0.0, 0.0), (0.0, 0.0, 2.0)))))
    np.testing.assert_allclose(straight, 2 * CORNERS, rtol=1e-6)
    turned = quarters(seen(looking_north(card((-2.0, 0.0, 0.0), (0.0, 0.0, -2.0)))))
    np.testing.assert_allclose(turned, 2 * CORNERS[::-1, ::-1], rtol=1e-6)
    # right x up points away from the camera here: a back gives off nothing.
    assert not seen(looking_north(card((-2.0, 0.0, 0.0), (0.0, 0.0, 2.0)))).any()


def test_the_first_row_of_a_bitmap_is_its_lower_edge(mi):
    """Mitsuba's own convention, on which the flip of images rests: row 0 is v = 0."""
    texture = mi.load_dict(
        {"type": "bitmap", "data": mi.TensorXf([[[1.0], [1.0]], [[5.0], [5.0]]]), "raw": True, "filter_type": "nearest"}
    )
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f(0.5, 0.1)
    assert float(np.ravel(texture.eval_1(si))[0]) == 1.0


def test_a_hidden_emitter_lights_but_is_not_seen():
    lamp = card((2.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    shown = looking_north(lamp, hide_emitters=True)
    assert not seen(shown).any()


def test_a_sky_is_linear_in_the_height():
    """Camera along +y is the zenith here: rays at an angle a from it have the height cos a."""
    sky = Background(nadir=(1.0, 0.5, 0.0), zenith=(0.0, 1.0, 3.0))
    image = seen(looking_north(background=sky, fov_deg=90.0, width=16, height=16), spp=256)
    middle = (np.arange(16) + 0.5) / 8 - 1
    height = 1 / np.sqrt(1 + middle[:, None] ** 2 + middle**2)[..., None]
    expected = (1 - height) / 2 * np.array(sky.nadir) + (1 + height) / 2 * np.array(sky.zenith)
    # Pixels are averages, 1/8 wide: second derivatives below 1 leave 1/8^2 / 24 < 1e-3 to their centres.
    np.testing.assert_allclose(image, expected, atol=3e-3)


# -- materials --------------------------------------------------------------------------------------------------

WHITE = Background(nadir=(1.0, 1.0, 1.0), zenith=(1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("material", "depth", "expected"),
    [
        (Paint(colour=(0.2, 0.5, 0.8)), 2, (0.2, 0.5, 0.8)),
        (Metal(colour=(0.2, 0.5, 0.8)), 2, (0.2, 0.5, 0.8)),
        (Glass(index=1.5), 50, (1.0, 1.0, 1.0)),
    ],
    ids=["paint", "metal", "glass"],
)
def test_a_sphere_alone_in_a_white_furnace_shows_its_albedo(material, depth, expected):
    ball = Shape(name="ball", geometry=Sphere(centre=(0.0, 0.0, 0.0), radius=2.0), material=material)
    image = seen(looking_north(ball, background=WHITE), depth, spp=1024)
    # Paint: a hit or a miss of the sky never varies here; the rest is float32. Glass: a path may end by roulette.
    np.testing.assert_allclose(image[3:5, 3:5], np.broadcast_to(expected, (2, 2, 3)), rtol=0.02)


def test_glass_shows_only_its_reflection_at_one_bounce():
    """At the centre the Fresnel reflectance of 1.5 is 4 %, and the sphere's inside needs two bounces at least."""
    ball = Shape(name="ball", geometry=Sphere(centre=(0.0, 0.0, 0.0), radius=2.0), material=Glass(index=1.5))
    image = seen(looking_north(ball, background=WHITE, fov_deg=4.0, width=1, height=1), 2, spp=1024)
    # 4 % of 1024 samples: 0.04 +- 0.006, and stratified better than that.
    np.testing.assert_allclose(image[0, 0], 0.04, atol=0.02)


@pytest.mark.parametrize("tilt_deg", [10.0, -10.0])
def test_a_tilted_mirror_turns_the_view_by_twice_its_tilt(tilt_deg):
    """A normal tilted towards `right` (+x) by a sends the camera's ray to x = 5 tan(2 a) beside the camera."""
    mirror = Shape(
        name="mirror",
        geometry=Rectangle(centre=(0.0, 0.0, 0.0), right=(9.0, 0.0, 0.0), up=(0.0, 0.0, 9.0)),
        material=TiltedMirrors(tilts=(math.radians(tilt_deg),), reflectance=0.5),
    )

    def lamp(x):
        place = Disk(centre=(x, -5.0, 0.0), normal=(0.0, 1.0, 0.0), radius=0.1)
        return Shape(name="lamp", geometry=place, material=BLACK, emission=(1.0, 1.0, 1.0))

    turned = 5 * math.tan(2 * math.radians(tilt_deg))
    for x, expected in ((turned, 0.5), (-turned, 0.0), (turned / 2, 0.0)):
        scene = looking_north(mirror, lamp(x), fov_deg=0.1, hide_emitters=True, width=1, height=1)
        np.testing.assert_allclose(seen(scene, 2)[0, 0], expected, rtol=1e-5)


# -- depths, seeds and regions ----------------------------------------------------------------------------------


def test_renders_follow_their_seed_on_any_object():
    scene = load_picture("thesis_box_diffuse")
    first, second = (PictureRenderer(scene, width=16, height=9).render(3, spp=256, seeds=(5, 6)) for _ in range(2))
    np.testing.assert_array_equal(first.per_seed, second.per_seed)
    assert np.any(first.per_seed[0] != first.per_seed[1])


def test_depth_one_is_what_shines_and_two_adds_one_bounce():
    lamp = Shape(
        name="lamp",
        geometry=Disk(centre=(0.0, -1.0, 3.0), normal=(0.0, 0.0, -1.0), radius=0.5),
        material=BLACK,
        emission=(1.0, 1.0, 1.0),
    )
    wall = Shape(
        name="wall",
        geometry=Rectangle(centre=(0.0, 0.0, 0.0), right=(9.0, 0.0, 0.0), up=(0.0, 0.0, 9.0)),
        material=Paint(colour=(0.5, 0.5, 0.5)),
    )
    renderer = PictureRenderer(looking_north(wall, lamp))
    one, two, three = (renderer.render(depth, spp=256).mean for depth in (1, 2, 3))
    assert not one.any()
    assert two.min() > 0
    np.testing.assert_array_equal(two, three)  # a plane cannot light itself, and the lamp is black


def test_bounces_of_the_box_are_seen_over_what_shines_directly():
    """The uniform background fills part of the picture: adding to what shines directly must change no share.

    Planted: without taking depth 1 off, the share over the whole picture would fall.
    """
    scene = load_picture("thesis_box_diffuse")
    found = measure_picture_bounces(scene, width=48, spp=16, seeds=4)
    renderer = PictureRenderer(scene, width=48, height=27)
    one, two, deep = (renderer.render(depth, spp=16, seeds=range(4)).mean.mean() for depth in (1, 2, 50))
    missing = found[WHOLE].missing
    assert missing.value == pytest.approx((deep - two) / (deep - one), abs=5 * missing.error)
    assert missing.value - (deep - two) / deep > 5 * missing.error
    assert found["floor"].missing.low < found["floor"].missing.value < found["floor"].missing.high


def test_a_mirror_shows_all_of_a_source_at_one_bounce_and_a_dark_region_misses_everything():
    scene = load_picture("thesis_box_mirror")
    alone = replace(scene, background=None, regions=tuple(r for r in scene.regions if r.name != "ceiling"))
    found = measure_picture_bounces(alone, width=160, spp=4, seeds=4)
    assert found["sources in the mirror"].exact
    assert found["floor"].series is None  # the sources face the wall
    assert found["floor"].missing.value == 1


def test_regions_show_their_shape_inside_their_box():
    ball = Shape(
        name="ball", geometry=Sphere(centre=(0.0, 0.0, 0.0), radius=0.5), material=Paint(colour=(0.5, 0.5, 0.5))
    )
    left = Region(name="left", shape="ball", box=(0.0, 0.0, 0.5, 1.0))
    scene = looking_north(
        ball, background=WHITE, regions=(Region(name="ball", shape="ball"), left), width=64, height=64
    )
    masks = PictureRenderer(scene).regions()
    # The tangent cone of sin(a) = 0.1 covers a circle of the radius tan(a) / tan(10 deg) of the half picture. A pixel on
    # its rim does not count: one ring of pixels may be missing.
    radius = 32 * math.tan(math.asin(0.1)) / math.tan(math.radians(10))
    assert math.pi * (radius - 1.5) ** 2 < masks["ball"].sum() < math.pi * radius**2
    np.testing.assert_array_equal(masks["left"], masks["ball"] & (np.arange(64) < 32))
    nowhere = PictureRenderer(replace(scene, regions=(Region(name="x", shape="ball", box=(0.0, 0.0, 0.1, 0.1)),)))
    with pytest.raises(InputError, match="shows in no pixel"):
        nowhere.regions()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_depth": 0}, "at least 1"),
        ({"spp": 0}, "at least one sample"),
        ({"seeds": ()}, "distinct integers"),
        ({"seeds": (1, 1)}, "distinct integers"),
        ({"spp": 7}, "cannot be 7 for this sampler"),
    ],
)
def test_what_cannot_be_rendered_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        PictureRenderer(looking_north(background=WHITE)).render(**{"max_depth": 1, **options})


def test_a_variant_without_colour_is_refused():
    with pytest.raises(InputError, match="llvm_ad_rgb"):
        PictureRenderer(looking_north(background=WHITE), variant="llvm_ad_mono")
