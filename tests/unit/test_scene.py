"""One TOML file, one Scene: what loads, and the one sentence for every fault."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from wallmirror.brdf import GaussianTrain, Mirror, Phong, Sum
from wallmirror.scene import Scene, load_scene, scene_names

from .helpers import refused

GOOD = """\
format = 1
title = "A wall"

[wall]
brdf = "gaussian_train"
centres_deg = [-15.0, 15.0]
sigma_deg = 1.0
half_width = 20.0

[observer]
position = [0.0, -5.0]
fov_deg = 60.0
views = 3
scan_deg = 90.0
pixels = 50

[card]
elements_x = [-1.0, 1.0]
y = -1.0
element_width = 0.02
element_height = 0.02

[source]
patterns = [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]
"""

ROOM = """
[room]
half_width = 6.0
half_height = 3.0
depth = 8.0
albedo = 0.8
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def edited(old: str, new: str) -> str:
    assert GOOD.count(old) == 1, f"the edit must hit one place: {old!r}"
    return GOOD.replace(old, new)


# -- what loads -----------------------------------------------------------------------------------------------


def test_the_scenes_of_the_package_are_there() -> None:
    assert {"flat_wall_diffuse", "flat_wall_lobes", "flat_wall_mirror", "flat_wall_phong"} <= set(scene_names())
    assert list(scene_names()) == sorted(scene_names())


@pytest.mark.parametrize("name", scene_names())
def test_every_scene_of_the_package_loads(name: str) -> None:
    scene = load_scene(name)
    assert scene.name == name
    assert scene.title
    assert scene.about
    assert scene.source.shape[0] == scene.card.elements
    assert np.all(np.isfinite(scene.source))
    assert np.all(scene.source >= 0)
    # One bounce is all there is exactly where neither card nor room sends light back.
    assert scene.is_one_bounce == (scene.room is None and scene.card.albedo == 0.0)
    assert scene.is_one_bounce == name.startswith("flat_wall")


def test_degrees_of_the_file_are_radians_of_the_scene(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path, GOOD))
    assert scene.observer.fov == math.radians(60)
    np.testing.assert_allclose(np.degrees(scene.observer.view_angles), [15, 0, -15], rtol=1e-15, atol=1e-15)
    assert isinstance(scene.wall.brdf, GaussianTrain)
    assert scene.wall.brdf.sigma == math.radians(1)
    assert scene.wall.brdf.centres == (math.radians(-15), math.radians(15))


def test_a_pattern_is_a_column_of_the_source(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path, GOOD.replace("[source]", "[source]\nlevel = 10.0")))
    np.testing.assert_array_equal(scene.source, 10 * np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]]))


def test_random_patterns_follow_their_seed(tmp_path: Path) -> None:
    def source(seed: int) -> np.ndarray:
        text = edited("patterns = [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]", f"realisations = 7\nseed = {seed}")
        return load_scene(written(tmp_path, text)).source

    assert source(3).shape == (2, 7)
    np.testing.assert_array_equal(source(3), source(3))
    assert np.all(source(3) != source(4))


def test_views_may_be_listed(tmp_path: Path) -> None:
    text = edited("views = 3\nscan_deg = 90.0", "view_angles_deg = [20.0, -5]")
    np.testing.assert_allclose(np.degrees(load_scene(written(tmp_path, text)).observer.view_angles), [20, -5])


def test_other_walls_are_what_they_say(tmp_path: Path) -> None:
    lobes = 'brdf = "gaussian_train"\ncentres_deg = [-15.0, 15.0]\nsigma_deg = 1.0'
    mirror = load_scene(written(tmp_path, edited(lobes, 'brdf = "mirror"\nreflectance = 0.5'))).wall.brdf
    assert mirror == Mirror(reflectance=0.5)
    phong = load_scene(written(tmp_path, edited(lobes, 'brdf = "phong"\nexponent = 3'))).wall.brdf
    assert phong == Phong(exponent=3.0, reflectance=0.5)
    coated = load_scene(written(tmp_path, edited(lobes, lobes + "\ndiffuse_albedo = 0.3"))).wall.brdf
    assert isinstance(coated, Sum)
    assert coated.of_sum(1.0) == pytest.approx(0.3 / math.pi, rel=1e-15)


def test_the_source_cannot_be_changed_afterwards(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path, GOOD))
    with pytest.raises(ValueError, match="read-only"):
        scene.source[0, 0] = -1.0


def test_names_and_paths_both_load(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD)
    by_text, by_path = load_scene(str(path)), load_scene(path)
    assert by_text.name == by_path.name == "scene"


# -- refusals -------------------------------------------------------------------------------------------------

PATTERNS = "patterns = [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]"

FAULTS = {
    # name: (old, new, field, words)
    "no format": ("format = 1\n", "", "format", "is missing"),
    "format of the future": ("format = 1", "format = 2", "format", "is not 1"),
    "format as text": ("format = 1", 'format = "1"', "format", "whole number"),
    "format as flag": ("format = 1", "format = true", "format", "whole number"),
    "no title": ('title = "A wall"\n', "", "title", "is missing"),
    "title as number": ('title = "A wall"', "title = 3", "title", "text in quotes"),
    "no wall": ("[wall]", "[wal]", "wall", "is missing"),
    "wall as number": ("[wall]", "[wall.inner]", "wall.brdf", "is missing"),
    "misspelt table": (PATTERNS, PATTERNS + "\n[rooms]\na = 1", "rooms", 'did you mean "room"?'),
    "misspelt field": ("fov_deg", "fov_degs", "observer.fov_deg", "is missing"),
    "misspelt optional field": ("half_width = 20.0", "half_widht = 20.0", "wall.half_widht", 'mean "half_width"?'),
    "field of another model": ("half_width = 20.0", "exponent = 5.0", "wall.exponent", "is not a known field"),
    "strange field": ("pixels = 50", "pixels = 50\nzzz = 1", "observer.zzz", "known here: "),
    "unknown model": ('"gaussian_train"', '"ggx"', "wall.brdf", 'choose "diffuse"'),
    "model as list": ('"gaussian_train"', '["diffuse"]', "wall.brdf", "text in quotes"),
    "no lobes": ("[-15.0, 15.0]", "[]", "wall.centres_deg", "names no lobe"),
    "lobe as text": ("[-15.0, 15.0]", '[-15.0, "15"]', "wall.centres_deg", "finite numbers"),
    "lobe beyond the half turn": ("[-15.0, 15.0]", "[-15.0, 181.0]", "wall.centres_deg", "from -180 to 180"),
    "sigma zero": ("sigma_deg = 1.0", "sigma_deg = 0", "wall.sigma_deg", "width > 0"),
    "sigma not a number": ("sigma_deg = 1.0", "sigma_deg = nan", "wall.sigma_deg", "finite"),
    "sigma infinite": ("sigma_deg = 1.0", "sigma_deg = inf", "wall.sigma_deg", "finite"),
    "sigma as flag": ("sigma_deg = 1.0", "sigma_deg = true", "wall.sigma_deg", "finite numbers"),
    "scale negative": ("half_width = 20.0", "scale = -1.0", "wall.scale", "from 0"),
    "height unknown": ("half_width = 20.0", 'height = "area"', "wall.height", '"per_degree"'),
    "coat beyond one": ("half_width = 20.0", "diffuse_albedo = 1.5", "wall.diffuse_albedo", "from 0 to 1"),
    "wall too narrow": ("half_width = 20.0", "half_width = 4.9", "wall.half_width", "reach 5 m"),
    "wall without width": ("half_width = 20.0", "half_width = 0", "wall.half_width", "from 0.001"),
    "observer on the wall": ("[0.0, -5.0]", "[0.0, 0.0]", "observer.position", "on or behind the wall"),
    "observer behind the wall": ("[0.0, -5.0]", "[0.0, 5.0]", "observer.position", "on or behind the wall"),
    "observer in space": ("[0.0, -5.0]", "[0.0, -5.0, 0.0]", "observer.position", "has 3 entries; give 2"),
    "observer nowhere": ("[0.0, -5.0]", "[nan, -5.0]", "observer.position", "finite"),
    "observer infinitely far": ("[0.0, -5.0]", "[0.0, -inf]", "observer.position", "finite"),
    "observer as number": ("[0.0, -5.0]", "-5.0", "observer.position", "list of numbers"),
    "field of 180": ("fov_deg = 60.0", "fov_deg = 180.0", "observer.fov_deg", "not between 0 and 180"),
    "field of 400": ("fov_deg = 60.0", "fov_deg = 400", "observer.fov_deg", "not between 0 and 180"),
    "field of 0": ("fov_deg = 60.0", "fov_deg = 0", "observer.fov_deg", "not between 0 and 180"),
    "field as text": ("fov_deg = 60.0", 'fov_deg = "60"', "observer.fov_deg", "finite numbers"),
    "field as date": ("fov_deg = 60.0", "fov_deg = 2020-01-01", "observer.fov_deg", "finite numbers"),
    "field of too many digits": ("fov_deg = 60.0", "fov_deg = 1" + "0" * 400, "observer.fov_deg", "huge"),
    "no views": ("views = 3", "views = 0", "observer.views", "from 1"),
    "views as fraction": ("views = 3", "views = 3.5", "observer.views", "whole number"),
    "views missing": ("views = 3\n", "", "observer.views", "is missing"),
    "scan too narrow": ("scan_deg = 90.0", "scan_deg = 50.0", "observer.scan_deg", "narrower"),
    "scan past the horizon": ("scan_deg = 90.0", "scan_deg = 181.0", "observer.scan_deg", "horizon"),
    "listed view past the horizon": (
        "views = 3\nscan_deg = 90.0",
        "view_angles_deg = [0, 60.5]",
        "observer.view_angles_deg",
        "view at 60.5 deg",
    ),
    "listed views empty": (
        "views = 3\nscan_deg = 90.0",
        "view_angles_deg = []",
        "observer.view_angles_deg",
        "names no view",
    ),
    "views listed and counted": ("views = 3", "views = 3\nview_angles_deg = [0]", "observer.views", "is not a known"),
    "no pixels": ("pixels = 50", "pixels = 0", "observer.pixels", "from 1"),
    "more pixels than memory": ("pixels = 50", "pixels = 9999999999", "observer.pixels", "from 1"),
    "one pixel at the edges": ("pixels = 50", 'pixels = 1\npixels_at = "edges"', "observer.pixels", "at least two"),
    "pixels elsewhere": ("pixels = 50", 'pixels = 50\npixels_at = "corners"', "observer.pixels_at", '"centres"'),
    "card on the wall": ("y = -1.0", "y = 0.0", "card.y", "on or behind the wall"),
    "card behind the wall": ("y = -1.0", "y = 1.0", "card.y", "on or behind the wall"),
    "card nowhere": ("y = -1.0", "y = nan", "card.y", "finite"),
    "no elements": ("elements_x = [-1.0, 1.0]", "elements_x = []", "card.elements_x", "names no element"),
    "elements as text": ("elements_x = [-1.0, 1.0]", 'elements_x = "-1, 1"', "card.elements_x", "list of numbers"),
    "elements nested": ("elements_x = [-1.0, 1.0]", "elements_x = [[-1.0], [1.0]]", "card.elements_x", "finite numb"),
    "elements overlap": ("elements_x = [-1.0, 1.0]", "elements_x = [1.0, 1.01]", "card.elements_x", "overlap"),
    "elements coincide": ("elements_x = [-1.0, 1.0]", "elements_x = [1.0, 1.0]", "card.elements_x", "overlap"),
    "width without height": ("element_height = 0.02\n", "", "card.element_height", "both a width and a height"),
    "width negative": ("element_width = 0.02", "element_width = -0.02", "card.element_width", "length >= 0"),
    "card too bright to be true": ("y = -1.0", "y = -1.0\nalbedo = 1.0", "card.albedo", "[0, 1)"),
    "no source": ("[source]", "[sources]", "source", "is missing"),
    "no patterns": (PATTERNS, "", "source.realisations", "is missing"),
    "no realisations": (PATTERNS, "realisations = 0", "source.realisations", "from 1"),
    "seed negative": (PATTERNS, "realisations = 2\nseed = -1", "source.seed", "from 0"),
    "patterns too short": (PATTERNS, "patterns = [[1.0], [1.0]]", "source.patterns", "each of the 2 elements"),
    "patterns ragged": (PATTERNS, "patterns = [[1.0, 2.0], [1.0]]", "source.patterns", "different lengths"),
    "patterns flat": (PATTERNS, "patterns = [1.0, 2.0]", "source.patterns", "list of lists"),
    "patterns empty": (PATTERNS, "patterns = []", "source.patterns", "give"),
    "pattern empty": (PATTERNS, "patterns = [[]]", "source.patterns", "each of the 2 elements"),
    "pattern negative": (PATTERNS, "patterns = [[1.0, -2.0]]", "source.patterns", "negative"),
    "pattern not a number": (PATTERNS, "patterns = [[1.0, nan]]", "source.patterns", "finite"),
    "patterns and realisations": (PATTERNS, PATTERNS + "\nrealisations = 2", "source.realisations", "is not a known"),
    "level negative": (PATTERNS, PATTERNS + "\nlevel = -1", "source.level", "from 0"),
    "level that overflows": (PATTERNS, "patterns = [[1e200, 1.0]]\nlevel = 1e200", "source.patterns", "not finite"),
    "room too shallow for the observer": (PATTERNS, PATTERNS + ROOM.replace("8.0", "5.0"), "room.depth", "deeper"),
    "room too shallow for the card": (PATTERNS, PATTERNS + ROOM.replace("8.0", "0.5"), "room.depth", "deeper"),
    "room narrower than the card": (
        PATTERNS,
        PATTERNS + ROOM.replace("half_width = 6.0", "half_width = 1.0"),
        "room.half_width",
        "widen",
    ),
    "room lower than the card": (
        PATTERNS,
        PATTERNS + ROOM.replace("half_height = 3.0", "half_height = 0.005"),
        "room.half_height",
        "raise",
    ),
    "room all white": (PATTERNS, PATTERNS + ROOM.replace("0.8", "1.0"), "room.albedo", "from 0 to 0.999"),
    "room without a height": (PATTERNS, PATTERNS + ROOM.replace("half_height = 3.0\n", ""), "room.half_height", "miss"),
    "room as list": ("format = 1", "format = 1\nroom = [1]", "room", "give a table [room]"),
    "one bounce too few": (PATTERNS, PATTERNS + "\n[render]\nmax_depth = 1", "render.max_depth", "from 2"),
    "too many samples": (PATTERNS, PATTERNS + "\n[render]\nspp = 1e9", "render.spp", "whole number"),
    "render misspelt": (PATTERNS, PATTERNS + "\n[render]\nsp = 4", "render.sp", 'did you mean "spp"?'),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_sentence_with_file_and_field(fault: str, tmp_path: Path) -> None:
    old, new, field, words = FAULTS[fault]
    path = written(tmp_path, edited(old, new))
    error = refused(lambda: load_scene(path))
    assert error.file == str(path)
    assert error.field == field
    assert words in error.message
    assert str(error) == f"{path}: {field}: {error.message}"


def test_the_scene_that_the_faults_are_made_from_is_good(tmp_path: Path) -> None:
    # The twin of the table above: it is the fault that is refused, not the scene.
    load_scene(written(tmp_path, GOOD))
    assert load_scene(written(tmp_path, GOOD + ROOM)).room is not None
    assert load_scene(written(tmp_path, edited("half_width = 20.0", "half_width = 5.0001"))).wall.half_width == 5.0001


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"format = ", "is not valid TOML"),
        (b"format = 1\nformat = 1", "is not valid TOML"),
        (b"[wall\nx = 1", "is not valid TOML"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "is not valid TOML"),
        (b"a = 1" + b"0" * 5000, "is not valid TOML"),
        (b'title = "\xff\xfe"', "UTF-8"),
        (b"\x00\x01\x02", "is not valid TOML"),
    ],
    ids=["no value", "doubled", "open bracket", "nested 5000 deep", "5000 digits", "not UTF-8", "binary"],
)
def test_what_is_not_toml_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    error = refused(lambda: load_scene(path))
    assert error.file == str(path)
    assert words in error.message


def test_an_absent_file_is_refused(tmp_path: Path) -> None:
    error = refused(lambda: load_scene(tmp_path / "none.toml"))
    assert error.file == str(tmp_path / "none.toml")
    assert "no such file" in error.message


def test_a_folder_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    assert refused(lambda: load_scene(tmp_path / "folder.toml")).file == str(tmp_path / "folder.toml")


@pytest.mark.parametrize("name", ["flat_wall_lobe", "", "../scene", "FLAT_WALL_LOBES"])
def test_an_unknown_name_is_answered_with_the_known_ones(name: str) -> None:
    error = refused(lambda: load_scene(name))
    assert f'no scene is called "{name}"' in error.message
    for known in scene_names():
        assert known in error.message


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (np.ones(2), "one row for each of the 2 elements"),
        (np.ones((3, 4)), "one row for each of the 2 elements"),
        (np.array([[1.0], [-1.0]]), "negative"),
        (np.array([[1.0], [math.inf]]), "not finite"),
        (np.array([[1.0], [math.nan]]), "not finite"),
    ],
)
def test_a_scene_made_in_python_is_checked_alike(source: np.ndarray, words: str, tmp_path: Path) -> None:
    good = load_scene(written(tmp_path, GOOD))
    error = refused(
        lambda: Scene(
            name="x", title="x", about="", observer=good.observer, card=good.card, wall=good.wall, source=source
        )
    )
    assert error.field == "source.patterns"
    assert words in error.message
