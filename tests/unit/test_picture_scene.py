"""Pictures in TOML: what loads, the field of small spheres, and the one sentence for every fault."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from wallmirror.brdf import GaussianTrain
from wallmirror.picture_reading import load_picture, picture_names
from wallmirror.picture_scene import (
    Background,
    Glass,
    Lobes,
    Metal,
    Paint,
    Rectangle,
    Sphere,
    TiltedMirrors,
)
from wallmirror.scene import scene_names

from .helpers import refused

GOOD = """\
format = 1
kind = "picture"
title = "A lamp and a ball"

[camera]
position = [0.0, -5.0, 0.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 0.0, 1.0]
fov_deg = 20.0

[background]
radiance = [1.0, 1.0, 1.0]

[[shape]]
name = "ball"
shape = "sphere"
centre = [1.0, 2.0, 3.0]
radius = 0.5
material = { kind = "diffuse", colour = [0.1, 0.2, 0.3] }

[[shape]]
name = "card"
shape = "rectangle"
centre = [0.0, 0.0, 0.0]
right = [2.0, 0.0, 0.0]
up = [0.0, 0.0, 1.0]
emission = [1.0, 1.0, 2.0]
image = \"\"\"
ab
bb
ba
\"\"\"
palette = { a = [1.0, 0.0, 0.0], b = [0.0, 0.5, 1.0] }

[[region]]
name = "top"
shape = "ball"
box = [0.0, 0.0, 1.0, 0.5]
"""

FIELD = """
[sphere_field]
seed = 3
columns = 10
rows = 12
radius = 0.2
diffuse = 0.8
metal = 0.15
roughness = 0.25
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "picture.toml"
    path.write_text(text, encoding="utf-8")
    return path


def edited(old: str, new: str) -> str:
    assert GOOD.count(old) == 1, f"the edit must hit one place: {old!r}"
    return GOOD.replace(old, new)


def assert_refuses(name: str | Path, words: str, *, field: str | None = None) -> None:
    error = refused(lambda: load_picture(name))
    assert words in error.message
    assert error.field == field
    assert error.file == (str(name) if isinstance(name, Path) else None)


# -- what loads -------------------------------------------------------------------------------------------------


def test_the_pictures_of_the_package_are_no_scenes_of_a_wall() -> None:
    assert len(picture_names()) >= 5
    assert not set(picture_names()) & set(scene_names())


@pytest.mark.parametrize("name", picture_names())
def test_every_picture_of_the_package_loads(name: str) -> None:
    picture = load_picture(name)
    assert picture.name == name
    assert picture.title
    assert picture.about
    assert picture.regions


def test_a_file_says_what_its_picture_is(tmp_path: Path) -> None:
    picture = load_picture(written(tmp_path, GOOD))
    assert picture.camera.fov == math.radians(20)
    assert picture.background == Background(nadir=(1.0, 1.0, 1.0), zenith=(1.0, 1.0, 1.0))
    ball, card = picture.shapes
    assert ball.geometry == Sphere(centre=(1.0, 2.0, 3.0), radius=0.5)
    assert ball.material == Paint(colour=(0.1, 0.2, 0.3))
    assert not ball.shines
    assert card.geometry == Rectangle(centre=(0.0, 0.0, 0.0), right=(2.0, 0.0, 0.0), up=(0.0, 0.0, 1.0))
    assert card.material == Paint(colour=(0.0, 0.0, 0.0))
    assert card.shines
    red, blue = (1.0, 0.0, 0.0), (0.0, 0.5, 1.0)
    np.testing.assert_array_equal(card.image, [[red, blue], [blue, blue], [blue, red]])
    assert picture.regions[0].box == (0.0, 0.0, 1.0, 0.5)


def test_materials_are_what_they_say(tmp_path: Path) -> None:
    def material(text: str, shape: str = "ball") -> object:
        old = 'material = { kind = "diffuse", colour = [0.1, 0.2, 0.3] }'
        if shape == "card":
            return (
                load_picture(written(tmp_path, edited("emission =", f"material = {text}\nemission =")))
                .shapes[1]
                .material
            )
        return load_picture(written(tmp_path, edited(old, f"material = {text}"))).shapes[0].material

    assert material('{ kind = "glass" }') == Glass(index=1.5)
    assert material('{ kind = "mirror", colour = [1, 1, 0], roughness = 0.1 }') == Metal(
        colour=(1.0, 1.0, 0.0), roughness=0.1
    )
    lobes = material(
        '{ kind = "gaussian_train", centres_deg = [15.0], sigma_deg = 1.0, height = "per_degree" }', "card"
    )
    expected = GaussianTrain(centres=(math.radians(15),), sigma=math.radians(1), height="per_degree")
    assert lobes == Lobes(brdf=expected)
    tilted = material('{ kind = "tilted_mirrors", tilts_deg = [-15.0, 15.0] }', "card")
    assert tilted == TiltedMirrors(tilts=(math.radians(-15), math.radians(15)))


def test_the_walls_of_the_thesis_carry_the_lobes_of_its_text() -> None:
    material = load_picture("thesis_test_wall").shape("wall").material
    assert isinstance(material, Lobes)
    assert material.brdf == GaussianTrain.of_the_text()


# -- the field of small spheres ---------------------------------------------------------------------------------


def test_a_field_follows_its_seed(tmp_path: Path) -> None:
    one, same = (load_picture(written(tmp_path, GOOD + FIELD)).shapes for _ in range(2))
    other = load_picture(written(tmp_path, GOOD + FIELD.replace("seed = 3", "seed = 4"))).shapes
    assert [s.geometry for s in one] == [s.geometry for s in same]
    assert one[-1].geometry != other[-1].geometry


def test_small_spheres_lie_on_the_ground_and_touch_nothing() -> None:
    picture = load_picture("thesis_field")
    balls = [s.geometry for s in picture.shapes if isinstance(s.geometry, Sphere)]
    centres, radii = np.array([b.centre for b in balls]), np.array([b.radius for b in balls])
    np.testing.assert_allclose(centres[:, 1], radii)
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1) + 9 * np.eye(len(balls))
    assert np.all(distance > radii[:, None] + radii)
    assert np.all(np.abs(centres[3:, [0, 2]]) <= 11)


def test_kinds_come_in_the_shares_that_were_asked_for() -> None:
    materials = [type(s.material) for s in load_picture("thesis_field").shapes if s.name.startswith("small")]
    count = len(materials)
    assert 400 < count <= 484
    for kind, share in ((Paint, 0.8), (Metal, 0.15), (Glass, 0.05)):
        # Four standard deviations of a binomial count.
        assert abs(materials.count(kind) - share * count) < 4 * math.sqrt(count * share * (1 - share))


# -- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "field", "words"),
    [
        ("format = 1", "format = 2", "format", "the only format"),
        ('kind = "picture"', 'kind = "film"', "kind", 'choose "picture"'),
        ("fov_deg = 20.0", "fov_deg = 180.0", "camera.fov_deg", "give a number from"),
        ("fov_deg = 20.0", "fov_deg = 20.0\nfocus = 1.0", "camera.focus", "not a known field"),
        ("up = [0.0, 0.0, 1.0]\nfov", "up = [0.0, 1.0, 0.0]\nfov", "camera.up", "lies along the view"),
        ("radius = 0.5", "radius = -0.5", "shape[0].radius", "give a number from"),
        ("radius = 0.5", "radius = nan", "shape[0].radius", "finite"),
        ('shape = "sphere"', 'shape = "cube"', "shape[0].shape", 'choose "sphere", "rectangle" or "disk"'),
        ("colour = [0.1, 0.2, 0.3]", "colour = [0.1, 0.2, 1.3]", "shape[0].material.colour", "from 0 to 1"),
        ("colour = [0.1, 0.2, 0.3]", "colour = [0.1, 0.2]", "shape[0].material.colour", "give 3"),
        ("colour = [0.1, 0.2, 0.3]", "color = [0.1, 0.2, 0.3]", "shape[0].material.colour", "is missing"),
        ('{ kind = "diffuse", colour', '{ kind = "velvet", colour', "shape[0].material.kind", "choose"),
        (
            '{ kind = "diffuse", colour = [0.1, 0.2, 0.3] }',
            '{ kind = "tilted_mirrors", tilts_deg = [1.0] }',
            "shape[0].material",
            "give it to a rectangle",
        ),
        ("emission = [1.0, 1.0, 2.0]", "emission = [1.0, 1.0, -2.0]", "shape[1].emission", "from 0 to"),
        ("emission = [1.0, 1.0, 2.0]", "", "shape[1].material", "is missing"),
        ("right = [2.0, 0.0, 0.0]", "right = [2.0, 0.0, 0.1]", "shape[1].up", "not perpendicular"),
        ("right = [2.0, 0.0, 0.0]", "right = [0.0, 0.0, 0.0]", "shape[1].right", "no length"),
        ("ab\nbb", "ab\nb", "shape[1].image", "different lengths"),
        ("ab\nbb", "ab\nbx", "shape[1].palette.x", "is missing"),
        ("a = [1.0, 0.0, 0.0],", "a = [1.0, 0.0, 0.0], c = [0.0, 0.0, 0.0],", "shape[1].palette.c", "known"),
        ('name = "card"', 'name = "ball"', "shape.name", "two are called"),
        ('shape = "ball"', 'shape = "bell"', "region.shape", 'no shape is called "bell"'),
        ("box = [0.0, 0.0, 1.0, 0.5]", "box = [0.0, 0.6, 1.0, 0.5]", "region[0].box", "no part of the picture"),
        ("[background]", "[sky]", "sky", "not a known field"),
    ],
)
def test_a_fault_is_one_sentence_with_its_field(tmp_path: Path, old: str, new: str, field: str, words: str) -> None:
    path = written(tmp_path, edited(old, new))
    assert_refuses(path, words, field=field)


def test_an_image_belongs_on_a_rectangle_that_shines(tmp_path: Path) -> None:
    path = written(tmp_path, edited("radius = 0.5", 'radius = 0.5\nimage = "a"\npalette = { a = [1.0, 1.0, 1.0] }'))
    assert_refuses(path, "needs a rectangle with an emission", field="shape[0].image")


def test_a_picture_without_light_is_refused(tmp_path: Path) -> None:
    dark = GOOD[: GOOD.index('[[shape]]\nname = "card"')].replace("radiance = [1.0, 1.0, 1.0]", "radiance = [0, 0, 0]")
    assert_refuses(written(tmp_path, dark), "nothing shines", field="shape.emission")


@pytest.mark.parametrize(
    ("old", "new", "field", "words"),
    [
        ("metal = 0.15", "metal = 0.25", "sphere_field.metal", "more than 1"),
        ("radius = 0.2", "radius = 0.7", "sphere_field.radius", "give a number from"),
        ("seed = 3\n", "", "sphere_field.seed", "is missing"),
        ("rows = 12", "rows = 12\nrow = 1", "sphere_field.row", 'did you mean "rows"'),
    ],
)
def test_a_fault_of_the_field_is_told(tmp_path: Path, old: str, new: str, field: str, words: str) -> None:
    assert_refuses(written(tmp_path, GOOD + FIELD.replace(old, new)), words, field=field)


def test_tilted_mirrors_come_in_powers_of_two(tmp_path: Path) -> None:
    def path(tilts: str) -> Path:
        material = f'material = {{ kind = "tilted_mirrors", tilts_deg = {tilts} }}\nemission ='
        return written(tmp_path, edited("emission =", material))

    assert_refuses(path("[1.0, 2.0, 3.0]"), "power of two", field="shape[1].material.tilts_deg")
    assert_refuses(path("[90.0]"), "turns a mirror away", field="shape[1].material.tilts_deg")


def test_an_unknown_name_lists_the_known_ones() -> None:
    assert_refuses("thesis_nothing", "thesis_field")
