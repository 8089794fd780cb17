"""A capture that is killed or interrupted goes on where it was, to the bit; with real renders and real signals."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from wallmirror import InputError, load_scene, read_captures
from wallmirror.captures.unfinished import unfinished_folder
from wallmirror.exr import read_exr
from wallmirror.jobs.capturing import capture_scene
from wallmirror.pathtracing.rendering import Renderer

SCENE = """
format = 1
title = "A wall"
[wall]
brdf = "gaussian_train"
centres_deg = [-15.0, 15.0]
sigma_deg = 1.0
[observer]
position = [0.0, -5.0]
fov_deg = 60.0
views = 2
scan_deg = 90.0
pixels = 40
[card]
elements_x = [-1.0, 1.0]
y = -1.0
element_width = 0.02
element_height = 0.02
[source]
patterns = [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]
[render]
spp = 256
"""

#: The command line, sent a signal at its n-th renaming of a finished file; each capture has two.
PROGRAM = """
import os, signal, sys
from pathlib import Path
left, genuine = [int(sys.argv[1])], Path.replace
def replace(self, target):
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), getattr(signal, sys.argv[2]))
    return genuine(self, target)
Path.replace = replace
from wallmirror.cli import main
main(["capture", *sys.argv[3:]])
"""


def capture(*arguments):
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_killed_capture_goes_on_where_it_was(mi, tmp_path, monkeypatch):
    toml, out = tmp_path / "scene.toml", tmp_path / "set"
    toml.write_text(SCENE)
    scene = load_scene(toml)
    whole = capture_scene(scene, tmp_path / "whole")

    # Killed while the second file of the third capture gets its name: two captures and a half.
    assert capture(6, "SIGKILL", toml, "-o", out).returncode == -signal.SIGKILL
    assert not out.exists()
    folder = unfinished_folder(out)
    complete = [path for path in folder.iterdir() if not path.name.endswith(".partial")]
    assert len(complete) == 5
    for path in complete:
        read_exr(path)

    # Interrupted during the fourth: exit code 130, one sentence, no file but complete ones.
    done = capture(3, "SIGINT", toml, "-o", out)
    assert done.returncode == 130
    assert "the same command goes on from there" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list(folder.iterdir())) in (6, 7)
    assert all(path.suffix == ".exr" and not path.name.startswith(".") for path in folder.iterdir())

    # Another command is refused, and takes nothing away.
    before = contents(folder)
    with pytest.raises(InputError, match=r"spp was '256' and is '512'; run that one again, or --restart"):
        capture_scene(scene, out, spp=512)
    with pytest.raises(InputError, match="seed was '0' and is '1'"):
        capture_scene(scene, out, seed=1)
    toml.write_text(SCENE.replace("sigma_deg = 1.0", "sigma_deg = 1.1"))
    with pytest.raises(InputError, match="scene_sha256"):
        capture_scene(load_scene(toml), out)
    assert contents(folder) == before

    rendered = []
    genuine = Renderer.render
    monkeypatch.setattr(
        Renderer, "render", lambda self, view, v, **o: rendered.append(view) or genuine(self, view, v, **o)
    )
    resumed = capture_scene(scene, out)
    assert rendered == [1, 1, 1]  # three of six were there
    assert contents(out) == contents(tmp_path / "whole")
    np.testing.assert_array_equal(resumed.radiance, whole.radiance)
    np.testing.assert_array_equal(resumed.variance, whole.variance)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.toml", "set", "whole"]

    # A later capture that stops early leaves the set as it is.
    def stop(self, *_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Renderer, "render", stop)
    with pytest.raises(KeyboardInterrupt):
        capture_scene(scene, out, seed=1)
    assert contents(out) == contents(tmp_path / "whole")
    assert not folder.exists()  # nothing was finished, so nothing is left behind
    np.testing.assert_array_equal(read_captures(out).radiance, whole.radiance)


def test_a_folder_that_is_not_ours_is_refused_before_anything_is_rendered(mi, tmp_path, monkeypatch):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "wall.exr").write_text("cannot be taken again")

    def render(self, *_, **__):
        raise AssertionError("it was rendered")

    monkeypatch.setattr(Renderer, "render", render)
    scene = load_scene(tmp_path / "scene.toml")
    with pytest.raises(InputError, match="did not write"):
        capture_scene(scene, tmp_path / "photographs")
    with pytest.raises(InputError, match="cannot be written"):
        capture_scene(scene, tmp_path / "scene.toml" / "set")
    with pytest.raises(AssertionError):
        capture_scene(scene, tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photographs", "scene.toml"]
