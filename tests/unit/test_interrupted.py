"""Kills, interrupts and full disks: what was there before is whole afterwards, and what was finished is not lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wallmirror import (
    CaptureSet,
    exr,
    load_scene,
    radiance,
    read_captures,
    read_truth,
    solve,
    transport_matrix,
    write_captures,
)
from wallmirror.captures.unfinished import UnfinishedSet, unfinished_folder
from wallmirror.errors import InputError
from wallmirror.exr import read_exr
from wallmirror.files import write_together
from wallmirror.jobs.capturing import fingerprint, planned_before, truth_of
from wallmirror.jobs.solved import Solved
from wallmirror.jobs.solving import write_solution
from wallmirror.planning import CapturePlan, Sampling, Term
from wallmirror.scene import Scene

from .helpers import refused

SETTINGS = {"scene": "flat_wall_lobes", "spp": "16", "seed": "0"}
OLD = {"a.csv": "old a", "b.html": "old b", "c.json": "old c"}
NEW = {"a.csv": "new a", "b.html": "new b", "c.json": "new c"}

#: Loops over the renames of `write_together`: a child process is killed at the n-th, then the folder is looked at
#: before and after another process goes on. Prints a list of (files at the kill, files after a failing call).
KILLS = """
import json, os, signal, sys
from pathlib import Path
from wallmirror.files import write_together
from wallmirror.errors import InputError

OLD, NEW, root = json.loads(sys.argv[1]), json.loads(sys.argv[2]), Path(sys.argv[3])

def files(folder):
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file()}

def killed_at(n, folder):
    left = [n]
    def planted(genuine):
        def rename(self, target):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return genuine(self, target)
        return rename
    Path.rename, Path.replace = planted(Path.rename), planted(Path.replace)
    write_together(folder, NEW)

seen = []
for n in range(1, 20):
    folder = root / str(n)
    write_together(folder, OLD)
    (folder / "mine.txt").write_text("not yours")
    child = os.fork()
    if child == 0:
        killed_at(n, folder)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    at_kill = files(folder)
    # A call that fails at once still puts things right first.
    try:
        write_together(folder, {"a.csv": "x", "no/such/folder": "y", "c.json": "z"})
    except InputError:
        pass
    seen.append([os.WIFSIGNALED(status), at_kill, files(folder), sorted(p.name for p in folder.iterdir())])
print(json.dumps(seen))
"""


def python(program: str, *arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, **options)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# -- several files together -------------------------------------------------------------------------------------


def test_a_kill_at_any_rename_leaves_the_old_files_or_the_new_ones(tmp_path: Path) -> None:
    done = python(KILLS, json.dumps(OLD), json.dumps(NEW), tmp_path)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    mine = {"mine.txt": "not yours"}
    killed = [row for row in seen if row[0]]
    assert len(killed) == 6  # three old files out, three new ones in
    for _, at_kill, after, names in killed:
        # With the last file there, the others are of its kind; without it nobody takes the rest for a result.
        assert at_kill == OLD | mine or "c.json" not in at_kill
        assert after == OLD | mine
        assert names == ["a.csv", "b.html", "c.json", "mine.txt"]
    for _, at_kill, after, _ in seen[6:]:
        assert at_kill == after == NEW | mine


def test_files_written_one_after_the_other_would_be_mixed(tmp_path: Path) -> None:
    """The twin: the same kill between plain replacements leaves new numbers beside an old document."""
    program = (
        "import json, os, signal, sys; from pathlib import Path; from wallmirror.files import write_atomically\n"
        "for n, (name, text) in enumerate(json.loads(sys.argv[1]).items()):\n"
        "    if n == 1: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    write_atomically(Path(sys.argv[2]) / name, text)"
    )
    write_together(tmp_path, OLD)
    assert python(program, json.dumps(NEW), tmp_path).returncode == -signal.SIGKILL
    texts = {(tmp_path / name).read_text() for name in OLD}
    assert texts == {"new a", "old b", "old c"}


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("at", range(1, 7))
def test_a_failure_at_any_rename_is_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, at: int
) -> None:
    write_together(tmp_path, OLD)
    genuine, calls = Path.rename, []

    def rename(self: Path, target: Path) -> Path:
        calls.append(target)
        if len(calls) == at:
            raise failure
        return genuine(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises((InputError, KeyboardInterrupt)):
        write_together(tmp_path, NEW)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == OLD


def test_a_full_disk_leaves_the_earlier_files(tmp_path: Path) -> None:
    """For real: the process may write no file beyond 1000 bytes."""
    program = (
        "import resource, sys; from pathlib import Path; from wallmirror.files import write_together\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write_together(Path(sys.argv[1]), {'a.csv': 'new', 'b.html': 'x' * 5000, 'c.json': 'new'})\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    write_together(tmp_path, OLD)
    done = python(program, tmp_path)
    assert done.stdout == f"InputError {tmp_path}: cannot be written (File too large)\n"
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == OLD


# -- solve ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = load_scene("flat_wall_lobes")
    observer = replace(scene.observer, view_angles=scene.observer.view_angles[::5], pixels=60)
    model = transport_matrix(observer, scene.card, scene.wall.brdf)
    folder = tmp_path_factory.mktemp("films") / "set"
    write_captures(folder, CaptureSet(observer=observer, card=scene.card, radiance=radiance(model, scene.source)))
    return folder


SOLVE = """
import os, signal, sys
from pathlib import Path
what, arguments = sys.argv[1], sys.argv[2:]
genuine, calls = Path.rename, []
def rename(self, target):
    calls.append(target)
    if len(calls) == 3:
        os.kill(os.getpid(), getattr(signal, what))
    return genuine(self, target)
Path.rename = rename
from wallmirror.cli import main
from wallmirror.jobs import solving
for figure in ("scene_plan", "recovered_source", "recovered_brdf", "source_deviations"):
    setattr(solving, figure, lambda *_, **__: None)  # drawing them is most of the time, and not the question
solving.page_html = lambda **_: "a page"
main(["solve", *arguments])
"""


def test_an_interrupted_solve_leaves_the_earlier_result(films: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_solution(out, Solved(read_captures(films), solve(read_captures(films), method="closed_form"), None, None))
    before = contents(out)
    assert set(before) == {"source.csv", "brdf.csv", "report.html", "solution.json"}
    options = (films, "-o", out, "--method", "closed_form")

    done = python(SOLVE, "SIGINT", *options)
    assert done.returncode == 130
    assert done.stderr.splitlines()[-1] == "wallmirror: interrupted; earlier results are untouched"
    assert contents(out) == before

    assert python(SOLVE, "SIGKILL", *options).returncode == -signal.SIGKILL
    assert not (out / "solution.json").exists()  # so that nobody takes the rest for a result
    earlier = contents(out / ".solution.earlier")
    assert earlier | {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before
    write_together(
        out, dict.fromkeys(sorted(before, key="solution.json".__eq__), "new")
    )  # what the next solve does with its files
    assert set(contents(out)) == set(before)


# -- capture, without a renderer --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed() -> tuple[Scene, CaptureSet]:
    scene = load_scene("flat_wall_diffuse")
    shape = (scene.observer.views, scene.observer.pixels, scene.source.shape[1])
    rng = np.random.default_rng(5)
    films, noise = rng.random((2, *shape)).astype(np.float32)
    return scene, CaptureSet(
        observer=scene.observer, card=scene.card, radiance=films, variance=noise, provenance={"spp": "16"}
    )


def fill(store: UnfinishedSet, captures: CaptureSet, count: int | None = None) -> int:
    """Save what is missing, up to a number of captures; how many were saved."""
    assert captures.variance is not None
    saved = 0
    for view in range(captures.observer.views):
        for b in range(captures.realisations):
            if store.load(view, b) is None and saved != count:
                kept = store.save(view, b, captures.radiance[view, :, b], captures.variance[view, :, b])
                np.testing.assert_array_equal(kept[0], captures.radiance[view, :, b])
                saved += 1
    return saved


def test_a_set_taken_up_again_is_the_same_to_the_bit(filmed: tuple[Scene, CaptureSet], tmp_path: Path) -> None:
    scene, captures = filmed
    total = captures.observer.views * captures.realisations
    whole = UnfinishedSet(tmp_path / "whole", SETTINGS)
    assert fill(whole, captures) == total
    whole.finish(captures, truth_of(scene))

    fill(UnfinishedSet(tmp_path / "halved", SETTINGS), captures, 5)
    assert not (tmp_path / "halved").exists()
    again = UnfinishedSet(tmp_path / "halved", SETTINGS)
    assert again.finished == 5
    assert fill(again, captures) == total - 5
    again.finish(captures, truth_of(scene))
    assert contents(tmp_path / "halved") == contents(tmp_path / "whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["halved", "whole"]
    # And it is what `write_captures` writes.
    write_captures(tmp_path / "direct", captures, settings=SETTINGS, truth=truth_of(scene))
    assert contents(tmp_path / "direct") == contents(tmp_path / "whole")
    np.testing.assert_array_equal(read_captures(tmp_path / "whole").radiance, captures.radiance)
    assert read_truth(tmp_path / "whole") is not None


def test_what_was_just_written_or_damaged_is_made_again(filmed: tuple[Scene, CaptureSet], tmp_path: Path) -> None:
    _, captures = filmed
    fill(UnfinishedSet(tmp_path / "set", SETTINGS), captures, 4)
    folder = unfinished_folder(tmp_path / "set")
    (folder / ".view09_real00.exr.0a1b2c3d.partial").write_bytes(b"half a file")
    (folder / "captures.toml").write_text("of a run killed in its last step")
    (folder / "view00_real01_variance.exr").unlink()  # killed between the two files of a capture
    spoiled = bytearray((folder / "view00_real02.exr").read_bytes())
    spoiled[-10] ^= 0x40
    (folder / "view00_real02.exr").write_bytes(spoiled)
    again = UnfinishedSet(tmp_path / "set", SETTINGS)
    assert again.finished == 2
    assert again.load(0, 1) is again.load(0, 2) is None
    assert {p.suffix for p in folder.iterdir()} == {".exr"}
    for path in folder.iterdir():
        read_exr(path)


def test_it_is_the_checksum_that_finds_the_damage(
    filmed: tuple[Scene, CaptureSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, captures = filmed
    fill(UnfinishedSet(tmp_path / "set", SETTINGS), captures, 1)
    path = unfinished_folder(tmp_path / "set") / "view00_real00.exr"
    spoiled = bytearray(path.read_bytes())
    spoiled[-10] ^= 0x40
    path.write_bytes(spoiled)
    unchecked = lambda path, header, channels: json.loads(header.attributes[b"wallmirror"][1])["settings"]  # noqa: E731
    monkeypatch.setattr(exr, "_verified_settings", unchecked)
    kept = UnfinishedSet(tmp_path / "set", SETTINGS).load(0, 0)
    assert kept is not None
    assert not np.array_equal(kept[0], captures.radiance[0, :, 0])


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"spp": "32"}, "spp was '16' and is '32'"), ({"scene": "box"}, "scene was"), ({"depth": "3"}, "depth was None")],
)
def test_another_run_is_not_mixed_in(
    filmed: tuple[Scene, CaptureSet], tmp_path: Path, changed: dict[str, str], words: str
) -> None:
    _, captures = filmed
    fill(UnfinishedSet(tmp_path / "set", SETTINGS), captures, 3)
    before = contents(unfinished_folder(tmp_path / "set"))
    error = refused(lambda: UnfinishedSet(tmp_path / "set", {**SETTINGS, **changed}))
    assert words in error.message
    assert "--restart" in error.message
    assert contents(unfinished_folder(tmp_path / "set")) == before
    assert UnfinishedSet(tmp_path / "set", {**SETTINGS, **changed}, restart=True).finished == 0


def test_without_the_comparison_runs_would_be_mixed(
    filmed: tuple[Scene, CaptureSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, captures = filmed
    fill(UnfinishedSet(tmp_path / "set", SETTINGS), captures, 3)
    monkeypatch.setattr(UnfinishedSet, "_require_same", lambda *_: None)
    assert UnfinishedSet(tmp_path / "set", {**SETTINGS, "spp": "32"}).finished == 3


def test_files_of_others_are_left_alone(filmed: tuple[Scene, CaptureSet], tmp_path: Path) -> None:
    folder = unfinished_folder(tmp_path / "set")
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    for restart in (False, True):
        error = refused(lambda restart=restart: UnfinishedSet(tmp_path / "set", SETTINGS, restart=restart))
        assert "thesis.tex" in error.message
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "a.exr").write_text("cannot be taken again")
    assert "did not write" in refused(lambda: UnfinishedSet(tmp_path / "photographs", SETTINGS)).message
    assert not unfinished_folder(tmp_path / "photographs").exists()
    (tmp_path / "file").write_text("a file")
    assert "cannot be written" in refused(lambda: UnfinishedSet(tmp_path / "file" / "set", SETTINGS)).message


@pytest.mark.parametrize("killed_after", ["first", "second"])
def test_a_swap_cut_in_two_is_mended_by_the_next_run(
    filmed: tuple[Scene, CaptureSet], tmp_path: Path, killed_after: str
) -> None:
    scene, captures = filmed
    write_captures(tmp_path / "set", captures)
    earlier = contents(tmp_path / "set")
    fill(UnfinishedSet(tmp_path / "set", SETTINGS), captures)
    (tmp_path / "set").rename(tmp_path / ".set.earlier")  # what a kill between the renames leaves
    if killed_after == "second":
        unfinished_folder(tmp_path / "set").rename(tmp_path / "set")
        write_captures(tmp_path / "set2", captures)
        (tmp_path / "set" / "captures.toml").write_bytes((tmp_path / "set2" / "captures.toml").read_bytes())
    again = UnfinishedSet(tmp_path / "set", SETTINGS)
    assert not (tmp_path / ".set.earlier").exists()
    if killed_after == "first":
        assert contents(tmp_path / "set") == earlier
        assert again.finished == captures.observer.views * captures.realisations
    fill(again, captures)
    again.finish(captures, truth_of(scene))
    assert read_captures(tmp_path / "set").realisations == captures.realisations


def test_a_full_disk_keeps_what_is_finished(filmed: tuple[Scene, CaptureSet], tmp_path: Path) -> None:
    """For real: the process may write no more than half an EXR file."""
    program = (
        "import resource, sys; import numpy as np; from wallmirror.captures.unfinished import UnfinishedSet\n"
        f"store = UnfinishedSet(sys.argv[1], {SETTINGS!r})\n"
        "store.save(0, 0, np.ones(500), np.ones(500))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: store.save(0, 1, np.random.default_rng(0).random(500), np.ones(500))\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    done = python(program, tmp_path / "set")
    assert done.stdout.startswith("InputError")
    assert "view00_real01.exr: cannot be written" in done.stdout
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""
    names = sorted(p.name for p in unfinished_folder(tmp_path / "set").iterdir())
    assert names == ["view00_real00.exr", "view00_real00_variance.exr"]


def test_folders_that_cannot_be_written_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert "Permission denied" in refused(lambda: UnfinishedSet(tmp_path / "set", SETTINGS)).message
    assert "Permission denied" in refused(lambda: write_together(tmp_path / "out", NEW)).message


def test_read_only_files_and_folders_are_told(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("nothing is read-only for root")
    write_together(tmp_path / "out", OLD)
    (tmp_path / "out").chmod(0o500)
    try:
        assert "Permission denied" in refused(lambda: write_together(tmp_path / "out", NEW)).message
        assert "Permission denied" in refused(lambda: UnfinishedSet(tmp_path / "out" / "x", SETTINGS)).message
    finally:
        (tmp_path / "out").chmod(0o700)
    assert contents(tmp_path / "out") == {name: text.encode() for name, text in OLD.items()}


def test_a_plan_is_kept_with_its_captures(filmed: tuple[Scene, CaptureSet], tmp_path: Path) -> None:
    """Plans rest on timings: made anew they would differ, and the captures could not be taken up."""
    scene, captures = filmed
    sampling = Sampling(sampler="multijitter", spp=64, seeds=5, noise=1 / 300, seconds=0.1 + 0.2)
    terms = (Term(name="noise", error=1e-3, kind="noise"), Term(name="depth", error=1 / 3, kind="bias", limit=True))
    plan = CapturePlan(
        tolerance=0.01, sampling=sampling, max_depth=4, rr_depth=5, table_nodes=None, films=8, terms=terms
    )
    settings = {**SETTINGS, "scene_sha256": fingerprint(scene), "plan": json.loads(json.dumps(asdict(plan)))}
    assert planned_before(scene, tmp_path / "set", 0.01) is None
    fill(UnfinishedSet(tmp_path / "set", settings), captures, 2)
    assert planned_before(scene, tmp_path / "set", 0.01) == plan
    assert UnfinishedSet(tmp_path / "set", settings).finished == 2
    # The twins: another tolerance or scene has another plan, and captures without one have none.
    assert planned_before(scene, tmp_path / "set", 0.02) is None
    assert (
        planned_before(replace(scene, room=None, wall=replace(scene.wall, half_width=99.0)), tmp_path / "set", 0.01)
        is None
    )
    for number, other in enumerate(({}, {"plan": None}, {"plan": {"sampling": {}}}, {"plan": {"terms": 3}})):
        fill(UnfinishedSet(tmp_path / str(number), {**SETTINGS, **other}), captures, 1)
        assert planned_before(scene, tmp_path / str(number), 0.01) is None


def test_fingerprints_tell_scenes_apart() -> None:
    """Any number that a film depends on changes it; texts do not."""
    scene = load_scene("cornell_lobes")
    same = fingerprint(replace(load_scene("cornell_lobes"), title="x", about="y"))
    assert fingerprint(scene) == same
    source = scene.source.copy()
    source[0, 0] = np.nextafter(source[0, 0], 2)
    assert scene.room is not None
    others = [
        replace(scene, source=source),
        replace(scene, card=replace(scene.card, y=np.nextafter(scene.card.y, -9))),
        replace(scene, room=replace(scene.room, albedo=0.5)),
        replace(scene, room=None),
        replace(scene, observer=replace(scene.observer, pixels=499)),
        replace(scene, wall=replace(scene.wall, half_width=99.0)),
        replace(scene, render=replace(scene.render, rr_depth=7)),
    ]
    assert len({same, *map(fingerprint, others)}) == 1 + len(others)
