"""The runtime: which LLVM is chosen, what is remembered, and what happens without any."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from wallmirror.errors import InputError
from wallmirror.pathtracing import diagnosis, llvm, probe_render, runtime

ABORTING = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")
TOO_OLD = Path("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(llvm.NONE_VARIABLE, raising=False)
    monkeypatch.delenv(llvm.PATH_VARIABLE, raising=False)


def child(code: str) -> list[str]:
    """A command that stands in for the rendering child."""
    return [sys.executable, "-c", code]


def reporting(**report: object) -> list[str]:
    return child(f"print({json.dumps(report)!r})")


def python(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter, since this one may have imported mitsuba already."""
    return subprocess.run(
        [*child(code), *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


# --------------------------------------------------------------------------------------------------------- probing


def test_a_right_report_is_good() -> None:
    verdict = llvm.probe(Path("x"), command=reporting(llvm="19.1.0", clamped=[0.0, 0.25, 1.0], radiance=0.5))
    assert verdict == llvm.Probe(Path("x"), True, "LLVM 19.1.0 renders correctly")


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_an_abort_is_a_verdict() -> None:
    verdict = llvm.probe(Path("x"), command=child("import os; os.abort()"))
    assert not verdict.ok
    assert signal.SIGABRT.name in verdict.reason


def test_a_hang_is_a_verdict() -> None:
    verdict = llvm.probe(Path("x"), timeout=0.2, command=child("import time; time.sleep(60)"))
    assert not verdict.ok
    assert "0.2 s" in verdict.reason


@pytest.mark.parametrize(
    ("report", "told"),
    [
        ({"llvm": "19", "clamped": [0.0, 0.25, 1.0], "radiance": 0.49999}, "renders 0.49999"),
        ({"llvm": "19", "clamped": [0.0, 0.25, 1.0], "radiance": float("nan")}, "renders nan"),
        ({"llvm": "19", "clamped": [-1.0, 0.25, 1.0], "radiance": 0.5}, "clamps"),
        ({"llvm": "19"}, "no pixels"),
    ],
)
def test_wrong_pixels_are_a_verdict(report: dict[str, object], told: str) -> None:
    verdict = llvm.probe(Path("x"), command=reporting(**report))
    assert not verdict.ok
    assert told in verdict.reason


def test_noise_is_captured_and_its_telling_line_kept(capfd: pytest.CaptureFixture[str]) -> None:
    noise = (
        "import sys; print('jit_x(): the located LLVM version (9) is too old..\\nmore', file=sys.stderr); sys.exit(1)"
    )
    verdict = llvm.probe(Path("x"), command=child(noise))
    assert verdict.reason == "the located LLVM version (9) is too old"
    assert capfd.readouterr() == ("", "")


def test_a_missing_interpreter_is_a_verdict(tmp_path: Path) -> None:
    assert "could not be started" in llvm.probe(Path("x"), command=[str(tmp_path / "none")]).reason


def test_a_file_that_is_no_library_is_rejected_by_the_real_probe(tmp_path: Path) -> None:
    fake = tmp_path / "libLLVM.so"
    fake.write_text("no library")
    verdict = llvm.probe(fake)
    assert not verdict.ok
    assert "Unable to load" in verdict.reason


@pytest.mark.skipif(not ABORTING.exists(), reason="needs Debian's LLVM 15")
def test_llvm_15_is_rejected_by_the_real_probe() -> None:
    verdict = llvm.probe(ABORTING)
    assert not verdict.ok
    assert "SIGABRT" in verdict.reason
    assert "fminimum" in verdict.reason or "fmaximum" in verdict.reason


@pytest.mark.skipif(not TOO_OLD.exists(), reason="needs Debian's LLVM 14")
def test_llvm_14_is_rejected_by_the_real_probe() -> None:
    verdict = llvm.probe(TOO_OLD)
    assert not verdict.ok
    assert "too old" in verdict.reason


# ------------------------------------------------------------------------------------------------------ candidates


def touch(folder: Path, *names: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text(name)


def test_candidates_are_in_order_and_each_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path / "env", "libLLVM.so.23.1", "libLTO.so.23.1", "libLLVMCore.so")
    touch(tmp_path / "sys", "libLLVM-14.so.1", "libLLVM-9.so.1", "libLLVM.so.18.1", "libLLVM-17.so.1", "libLLVM.a")
    touch(tmp_path / "sys" / "llvm-16" / "lib", "libLLVM.so.1")
    (tmp_path / "sys" / "libLLVM-18.so").symlink_to("libLLVM.so.18.1")
    monkeypatch.setattr(llvm, "_in_environment", lambda: iter((tmp_path / "env").iterdir()))
    monkeypatch.setattr(llvm, "_SYSTEM", (f"{tmp_path}/sys/libLLVM*", f"{tmp_path}/sys/llvm-*/lib/libLLVM*"))
    order = ["libLLVM.so.23.1", "libLLVM-18.so", "libLLVM-17.so.1", "libLLVM.so.1", "libLLVM-14.so.1", "libLLVM-9.so.1"]
    assert [path.name for path in llvm.candidates()] == order

    # What the user names comes first, even if it does not exist, and is not tried twice.
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(tmp_path / "sys" / "libLLVM.so.18.1"))
    assert [path.name for path in llvm.candidates()] == ["libLLVM.so.18.1", order[0], *order[2:]]
    monkeypatch.setenv(llvm.PATH_VARIABLE, "/nowhere/libLLVM.so")
    assert [path.name for path in llvm.candidates()] == ["libLLVM.so", *order]


def test_none_are_candidates_when_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(llvm.NONE_VARIABLE, "1")
    assert llvm.candidates() == ()
    assert llvm.survey() == ()
    assert llvm.find_llvm() is None


# ----------------------------------------------------------------------------------------------- survey and its cache


@pytest.fixture
def libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Two stand-ins for libraries, `old` and `new`, tried in this order; the dictionary says which one works."""
    touch(tmp_path / "lib", "old", "new")
    works = {"old": False, "new": True}
    calls: list[str] = []

    def probe(path: Path) -> llvm.Probe:
        calls.append(path.name)
        return llvm.Probe(path, works[path.name], "it was asked")

    monkeypatch.setattr(llvm, "candidates", lambda: (tmp_path / "lib" / "old", tmp_path / "lib" / "new"))
    monkeypatch.setattr(llvm, "probe", probe)
    monkeypatch.setattr(llvm, "calls", calls, raising=False)
    return works


def calls() -> list[str]:
    made: list[str] = list(vars(llvm)["calls"])
    vars(llvm)["calls"].clear()
    return made


def test_failures_are_kept_with_the_first_that_works(libraries: dict[str, bool]) -> None:
    assert [(verdict.path.name, verdict.ok) for verdict in llvm.survey()] == [("old", False), ("new", True)]
    found = llvm.find_llvm()
    assert found is not None
    assert found.path.name == "new"


def test_a_survey_is_remembered_until_something_changes(libraries: dict[str, bool], tmp_path: Path) -> None:
    first = llvm.survey()
    assert calls() == ["old", "new"]
    assert llvm.survey() == first
    assert calls() == []
    llvm.survey(refresh=True)
    assert calls() == ["old", "new"]
    (tmp_path / "lib" / "old").write_text("another version")
    llvm.survey()
    assert calls() == ["old", "new"]


def test_a_survey_that_finds_nothing_is_not_remembered(libraries: dict[str, bool]) -> None:
    libraries["new"] = False
    assert llvm.find_llvm() is None
    libraries["new"] = True
    assert llvm.find_llvm() is not None


@pytest.mark.parametrize(
    "damage",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b'{"KEY": 3}',
        b'{"KEY": [{"path": "/bin/sh", "ok": true, "reason": ""}]}',
    ],
)
def test_a_damaged_or_forged_cache_costs_a_probe_only(libraries: dict[str, bool], damage: bytes) -> None:
    first = llvm.survey()
    file = llvm.cache_file()
    assert file is not None
    key = next(iter(json.loads(file.read_text())))
    file.write_bytes(damage.replace(b"KEY", key.encode()))
    calls()
    assert llvm.survey() == first
    assert calls() == ["old", "new"]
    assert llvm.survey() == first
    assert calls() == []


def test_an_unwritable_cache_does_not_hurt(
    libraries: dict[str, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "a file where a folder should be"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert llvm.find_llvm() is not None
    assert blocked.read_text() == ""


def test_no_temporary_files_stay_behind(libraries: dict[str, bool]) -> None:
    llvm.survey()
    file = llvm.cache_file()
    assert file is not None
    assert [path.name for path in file.parent.iterdir()] == ["llvm.json"]


# ------------------------------------------------------------------------------------------------------- activation


def test_importing_does_not_import_mitsuba() -> None:
    code = (
        "import sys; from wallmirror.pathtracing import bsdf, diagnosis, llvm, runtime, tables\n"
        "sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    )
    assert python(code).returncode == 0


def test_without_llvm_the_runtime_is_reduced_and_says_what_to_install() -> None:
    code = (
        "from wallmirror.pathtracing import runtime; import mitsuba as mi\n"
        "r = runtime.activate(); assert r.reduced and r.llvm is None\n"
        "assert r.variant == mi.variant() == 'scalar_rgb'\n"
        "print(r.advice)"
    )
    # mitsuba is imported first: the late way into the runtime must respect the variable as well.
    done = python(code, WALLMIRROR_NO_LLVM="1")
    assert done.returncode == 0, done.stderr
    assert "scalar_rgb" in done.stdout
    early = python(
        code.replace("; import mitsuba as mi\n", "\n").replace("mi.variant() ==", ""), WALLMIRROR_NO_LLVM="1"
    )
    assert early.returncode == 0, early.stderr
    assert llvm.advice() in early.stdout


def test_a_bad_choice_of_the_user_falls_on_to_the_next(tmp_path: Path, mi: object) -> None:
    fake = tmp_path / "libLLVM.so"
    fake.write_text("no library")
    code = (
        "from wallmirror.pathtracing import runtime, diagnosis\n"
        "findings = {f.name: f for f in diagnosis.diagnose()}\n"
        "assert findings['LLVM'].ok and not findings['DRJIT_LIBLLVM_PATH'].ok, findings\n"
        "assert 'Unable to load' in findings['DRJIT_LIBLLVM_PATH'].detail\n"
        "assert all(f.ok for name, f in findings.items() if name != 'DRJIT_LIBLLVM_PATH'), findings\n"
        "r = runtime.activate(); assert not r.reduced and r.variant == 'llvm_ad_mono'"
    )
    done = python(code, DRJIT_LIBLLVM_PATH=str(fake))
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not ABORTING.exists(), reason="needs Debian's LLVM 15")
def test_an_aborting_llvm_that_is_loaded_already_is_not_used() -> None:
    code = (
        "import mitsuba as mi; from wallmirror.pathtracing import runtime\n"
        "r = runtime.activate(); assert r.reduced and mi.variant() == 'scalar_rgb'; print(r.advice)"
    )
    done = python(code, DRJIT_LIBLLVM_PATH=str(ABORTING))
    assert done.returncode == 0, done.stderr
    assert "LLVM 15" in done.stdout


def test_activation_may_be_repeated_and_switched(mi: object) -> None:
    first = runtime.activate()
    try:
        assert runtime.activate("scalar_rgb").variant == "scalar_rgb"
    finally:
        assert runtime.activate() == first
    assert not first.reduced
    assert first.llvm_version


def test_writing_exr_does_not_hang_on_a_single_thread(mi: object, tmp_path: Path) -> None:
    # Mitsuba's Bitmap.write waits forever in a pool without workers; `python` kills what takes too long.
    code = (
        "from wallmirror.pathtracing import runtime; import sys\n"
        "r = runtime.activate(threads=1); assert r.threads == 2, r\n"
        "import mitsuba as mi, numpy as np, drjit as dr\n"
        "mi.Bitmap(np.ones((8, 8, 1), dtype=np.float32)).write(sys.argv[1])\n"
        "dr.set_thread_count(1); assert runtime.activate().threads == 2"
    )
    done = python(code, str(tmp_path / "x.exr"))
    assert done.returncode == 0, done.stderr


def test_an_unknown_variant_is_bad_input(mi: object) -> None:
    with pytest.raises(InputError, match="llvm_ad_nomo"):
        runtime.activate("llvm_ad_nomo")


# -------------------------------------------------------------------------------------------------------- diagnosis


def test_a_good_machine_gets_good_findings(mi: object, capfd: pytest.CaptureFixture[str]) -> None:
    findings = diagnosis.diagnose()
    assert [finding for finding in findings if not finding.ok] == []
    assert [finding.name for finding in findings] == [
        "Python", "mitsuba", "drjit", "LLVM", "threads", "precision", "EXR",
    ]  # fmt: skip
    assert capfd.readouterr() == ("", "")


def test_a_wrong_pin_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: "3.0.0")
    finding = diagnosis._package("mitsuba")
    assert not finding.ok
    assert finding.remedy.startswith("pip install mitsuba==")


def test_a_render_that_is_off_by_a_ten_thousandth_is_found(mi: object, monkeypatch: pytest.MonkeyPatch) -> None:
    right = probe_render.wall_radiance
    monkeypatch.setattr(probe_render, "wall_radiance", lambda mi, spp: right(mi, spp) * np.float32(1.0001))
    finding = diagnosis._precision(runtime.activate())
    assert not finding.ok
