"""The commands' functions on real renders: film, write, read back, compare, solve; and each check's planted twin."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from wallmirror import Mirror, load_scene, read_captures, scale_free_error, scene_names
from wallmirror.brdf import GaussianTrain, Table
from wallmirror.interreflection import from_card, from_room
from wallmirror.jobs import validating, validating_one
from wallmirror.jobs.capturing import capture_scene
from wallmirror.jobs.expecting import expect
from wallmirror.jobs.solving import solve_directory
from wallmirror.jobs.validating import validate_scenes
from wallmirror.jobs.validating_one import validate_scene
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.transport import radiance, transport_matrix


def small(name, *, views=4, pixels=120, **observer):
    scene = load_scene(name)
    angles = scene.observer.view_angles
    picked = tuple(angles[round(i * (len(angles) - 1) / (views - 1))] for i in range(views))
    return replace(scene, observer=replace(scene.observer, view_angles=picked, pixels=pixels, **observer))


def test_films_written_read_back_and_solved_are_as_good_as_their_error_bars(mi, tmp_path):
    scene = small("flat_wall_lobes", views=8, pixels=250)
    filmed = capture_scene(scene, tmp_path / "set", spp=512, seed=3)
    read = read_captures(tmp_path / "set")
    np.testing.assert_array_equal(read.radiance, filmed.radiance.astype(np.float32))
    solved = solve_directory(tmp_path / "set", tmp_path / "out")
    # 12 free entries of V: the norm of their error scatters by 20 %; 2 is five such standard deviations.
    assert solved.judgement.source_error < 2 * solved.solution.predicted_error
    assert solved.solution.predicted_error < 0.02
    assert solved.solution.verdict == "good"
    stored = json.loads((tmp_path / "out" / "solution.json").read_text())
    estimate = np.array(stored["source"])
    assert scale_free_error(estimate, scene.source) == pytest.approx(solved.judgement.source_error)


@pytest.mark.parametrize("name", [name for name in scene_names() if name.startswith("flat_wall")])
def test_model_and_mitsuba_are_not_told_apart(mi, name):
    result = validate_scene(small(name), views=3, spp=64, seed=11)
    assert result.passed
    assert result.comparison.kept > 50
    # Scores of a true model have unit spread; with K kept pixels their standard deviation scatters by 1/sqrt(2K).
    if not result.comparison.exact:
        assert abs(result.comparison.z_std - 1) < 5 / np.sqrt(2 * result.comparison.kept)


@pytest.mark.parametrize("name", ["flat_wall_blinn", "flat_wall_cook_torrance"])
def test_interpolation_of_a_wall_in_a_table_is_told_apart_from_transport(mi, name):
    """The table is 1e-3 of its peak right, and on the wall, where pixels average, a hundredth of that."""
    scene = small(name)
    found = expect(scene, (0, 1)).interpolation
    assert 1e-9 < found < 1e-4
    # The twin: a table of a tenth of the nodes, as if it were the wall's.
    brdf = scene.wall.brdf
    theta = np.linspace(-np.pi / 2, np.pi / 2, 91)
    coarse = Table(values=brdf(theta[:, None], theta))
    fine = expect(scene, (0, 1)).reference
    rough = expect(replace(scene, wall=replace(scene.wall, brdf=coarse)), (0, 1)).reference
    assert np.max(np.abs(rough - fine)) > 1e-4 * fine.max()


def plant_rougher(scene):
    return replace(scene, wall=replace(scene.wall, brdf=replace(scene.wall.brdf, alpha=0.21)))


def plant_swapped(scene):
    """Light and camera mistaken for each other on a wall that is not reciprocal."""
    return replace(scene, wall=replace(scene.wall, brdf=Table(values=scene.wall.brdf.values.T)))


def test_a_wall_that_is_a_function_of_both_angles_is_judged(mi, monkeypatch):
    scene = small("flat_wall_cook_torrance", pixels=60)
    theta = np.linspace(-np.pi / 2, np.pi / 2, 181)
    lopsided = Table(values=scene.wall.brdf(theta[:, None], theta) * (1 + 0.5 * np.sin(theta)))
    measured = replace(scene, wall=replace(scene.wall, brdf=lopsided))
    assert validate_scene(measured, views=2, spp=64, seed=11).passed
    for case, plant in ((scene, plant_rougher), (measured, plant_swapped)):
        monkeypatch.setattr(validating_one, "Renderer", lambda s, plant=plant, **options: Renderer(plant(s), **options))
        assert not validate_scene(case, views=2, spp=64, seed=11).passed


def plant_gain(scene):
    return scene  # the pattern is handed over with each render: see the test


def plant_shift(scene):
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    shifted = replace(brdf, centres=tuple(c + np.radians(0.2) for c in brdf.centres))
    return replace(scene, wall=replace(scene.wall, brdf=shifted))


def plant_lost_lobe(scene):
    brdf = scene.wall.brdf
    return replace(scene, wall=replace(scene.wall, brdf=replace(brdf, centres=brdf.centres[1:])))


def plant_card_moved(scene, factor=1.01):
    return replace(scene, card=replace(scene.card, y=factor * scene.card.y))


@pytest.mark.parametrize(
    "plant", [plant_gain, plant_shift, plant_lost_lobe, plant_card_moved], ids=lambda f: f.__name__
)
def test_planted_faults_are_rejected(mi, monkeypatch, plant):
    """The render has the fault, the analytic side has not."""
    scene = small("flat_wall_lobes")
    monkeypatch.setattr(validating_one, "Renderer", lambda s, **options: Renderer(plant(s), **options))
    if plant is plant_gain:
        real = Renderer.render
        monkeypatch.setattr(Renderer, "render", lambda self, view, v, **o: real(self, view, 1.1 * np.asarray(v), **o))
    assert not validate_scene(scene, views=3, spp=64, seed=11).passed


def test_mirror_whose_card_moved_is_rejected(mi, monkeypatch):
    scene = small("flat_wall_mirror", pixels=500)
    assert isinstance(scene.wall.brdf, Mirror)
    # 10 % moves the strips' images by more than the pixels left out at their borders.
    monkeypatch.setattr(validating_one, "Renderer", lambda s, **options: Renderer(plant_card_moved(s, 1.1), **options))
    assert not validate_scene(scene, views=3, spp=64, seed=11).passed


def test_validation_leaves_results_and_a_page(mi, tmp_path):
    results = validate_scenes([small("flat_wall_diffuse", pixels=40)], tmp_path, views=2, spp=16)
    stored = json.loads((tmp_path / "results.json").read_text())
    assert stored[0]["scene"] == results[0].scene.name
    assert "A diffuse wall" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("name", "tolerance"),
    # The card's light closes analytically up to its 24 x 4 nodes; the room's is an estimate that leaves light out which
    # has met the wall three times.
    [("reflective_card", 0.03), ("cornell_lobes", 0.35)],
)
def test_light_beyond_one_bounce_is_what_mitsuba_adds(mi, name, tolerance):
    scene = small(name, views=3, pixels=60)
    renderer = Renderer(scene)
    pattern = scene.source[:, 0]
    added, one = [], []
    for view in range(scene.observer.views):
        options = {"spp": 1024, "seeds": spread_seeds(view, 8)}
        deep = renderer.render(view, pattern, max_depth=50, rr_depth=5, **options).mean
        shallow = renderer.render(view, pattern, max_depth=2, **options).mean
        added.append(deep - shallow)
        one.append(shallow)
    brdf, source = scene.wall.brdf, pattern[:, None]
    extra = from_card(scene.observer, scene.card, brdf, source)
    if scene.room is not None:
        extra = extra + from_room(scene.observer, scene.card, scene.room, brdf, source)
    share = extra.sum() / radiance(transport_matrix(scene.observer, scene.card, brdf, tolerance=1e-5), source).sum()
    assert share == pytest.approx(np.sum(added) / np.sum(one), rel=tolerance)


def test_without_llvm_the_demo_goes_on_with_a_smaller_job(tmp_path):
    environment = {**os.environ, "WALLMIRROR_NO_LLVM": "1", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "wallmirror", "demo", "-o", str(tmp_path / "demo"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=300)
    document = json.loads(done.stdout)
    assert document["variant"] == "scalar_rgb"
    assert "karellen-llvm-core" in done.stderr or "LLVM" in done.stderr
    assert done.returncode == (0 if document["passed"] else 1)
    assert (tmp_path / "demo" / "report.html").exists()


def test_scenes_that_one_bounce_cannot_tell_apart_are_rendered_once(mi, monkeypatch, tmp_path):
    calls = []
    original = validating.validate_scene
    monkeypatch.setattr(
        validating, "validate_scene", lambda scene, **k: calls.append(scene.name) or original(scene, **k)
    )
    scenes = [small(name) for name in ("flat_wall_diffuse", "bounces_diffuse_card_far", "bounces_diffuse_box")]
    results = validate_scenes(scenes, tmp_path, views=1, spp=16)
    assert calls == ["flat_wall_diffuse", "bounces_diffuse_box"]  # a box is met, a white card is not
    assert [r.same_as for r in results] == ["", "flat_wall_diffuse", ""]
    stored = json.loads((tmp_path / "results.json").read_text())
    assert [s["same_as"] for s in stored] == [None, "flat_wall_diffuse", None]
    # What is reused is what a render of its own would give, to the bit.
    own = original(scenes[1], views=1, spp=16)
    np.testing.assert_array_equal(own.mean, results[1].mean)


def test_a_wall_of_rough_metal_is_told_from_its_films_and_fitted(mi, tmp_path):
    scene = small("flat_wall_cook_torrance", views=10, pixels=250)
    capture_scene(scene, tmp_path / "set", spp=64, seed=5)
    plain = solve_directory(tmp_path / "set", tmp_path / "plain", wall="angle_sum")
    assert plain.solution.verdict == "doubtful"
    assert "Hypothesis 8" in plain.solution.status
    assert plain.judgement.source_error < 3 * plain.solution.predicted_error
    better = solve_directory(tmp_path / "set", tmp_path / "better")
    assert better.solution.verdict == "good"
    # As for the films of lobes above: 12 free entries of V.
    assert better.judgement.source_error < 2 * better.solution.predicted_error
    assert better.solution.predicted_error < plain.solution.predicted_error / 2
    assert "wall of facets" in (tmp_path / "better" / "report.html").read_text()
