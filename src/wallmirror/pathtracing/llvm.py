"""Finds an LLVM library that Dr.Jit can really render with, without trusting any of them.

Mitsuba's wheels bring no LLVM. Dr.Jit takes the library that DRJIT_LIBLLVM_PATH names when it is first imported, else
the last one that it meets, and never tries a second. Some versions are accepted and then abort the process (15 and 16
on x86-64). So each candidate renders in a process of its own until one gets it right; the verdicts are kept on disk.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wallmirror.pathtracing import probe_render

#: Where Dr.Jit looks for its LLVM; a user may set it, and it is always tried first.
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
#: Set to 1 to pretend that no LLVM exists.
NONE_VARIABLE = "WALLMIRROR_NO_LLVM"

_LIBRARY = re.compile(r"libLLVM(-\d[\d.]*)?(\.so(\.\d+)*|(\.\d+)*\.dylib)")
_WHEEL = "karellen-llvm-core"
_SYSTEM = (
    "/usr/lib/*/libLLVM*",
    "/usr/lib/llvm*/lib/libLLVM*",
    "/usr/lib64/libLLVM*",
    "/usr/lib64/llvm*/lib/libLLVM*",
    "/usr/lib/libLLVM*",
    "/usr/local/lib/libLLVM*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*",
    "/usr/local/opt/llvm*/lib/libLLVM*",
)
_CACHE_FORMAT = 1
_CACHE_ENTRIES = 16  # one for each environment and setting of PATH_VARIABLE in use
_SPP = 16
_TOLERANCE = 2 * _SPP * 2.0**-24  # 16 rounded additions of samples and as many of weights


@dataclass(frozen=True)
class Probe:
    """The verdict on one LLVM library: whether it renders, and one sentence why or why not."""

    path: Path
    ok: bool
    reason: str


def candidates() -> tuple[Path, ...]:
    """LLVM libraries worth trying, best first, each file once.

    In order: what DRJIT_LIBLLVM_PATH names (even if it does not exist, for the verdict), the environment's own
    (package karellen-llvm-core, or conda), the system's in descending version. Empty if WALLMIRROR_NO_LLVM is 1.
    """
    if os.environ.get(NONE_VARIABLE) == "1":
        return ()
    asked = os.environ.get(PATH_VARIABLE)
    found = [
        *([Path(asked)] if asked else []),
        *_by_version(_in_environment()),
        *_by_version(path for pattern in _SYSTEM for path in Path("/").glob(pattern.removeprefix("/"))),
    ]
    unique: dict[str, Path] = {}
    for path in found:
        unique.setdefault(os.path.realpath(path), path)
    return tuple(unique.values())


def probe(path: Path, *, timeout: float = 60.0, command: Sequence[str] | None = None) -> Probe:
    """Let a child process render a few pixels with one LLVM library, and judge what comes back.

    Parameters
    ----------
    path:
        The library.
    timeout:
        Seconds until the child is killed.
    command:
        What to run instead of the rendering child; it finds `path` in DRJIT_LIBLLVM_PATH.

    Returns
    -------
    A verdict in every case: a child that aborts, hangs, fails or renders wrong pixels is one with ok = False.
    """
    # By file and with -P: neither the working directory nor our modules' names may shadow a package.
    command = command or [sys.executable, "-P", str(Path(probe_render.__file__))]
    with tempfile.TemporaryDirectory(prefix="wallmirror-probe-") as kernels:
        # An empty kernel cache, or a kernel that another LLVM compiled would be taken for this one's work.
        environment = {**os.environ, PATH_VARIABLE: str(path), "DRJIT_CACHE_DIR": kernels}
        try:
            child = subprocess.run(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Probe(path, False, f"it did not finish a 4 x 4 pixel render within {timeout:g} s")
        except OSError as error:
            return Probe(path, False, f"the probing process could not be started: {error}")
    return _verdict(path, child)


def survey(*, refresh: bool = False) -> tuple[Probe, ...]:
    """Verdicts on the candidates in order, up to and including the first that works.

    They come from the cache on disk if every candidate, Dr.Jit, Mitsuba and the Python executable are unchanged;
    `refresh` probes anew. Only a survey that ends well is kept: a failure may have been the machine's bad moment.
    """
    paths = candidates()
    key = _fingerprint(paths)
    cache = _read_cache()
    if not refresh and (known := _from_cache(cache.get(key), paths)):
        return known
    verdicts = tuple(_until_one_works(paths))
    if verdicts and verdicts[-1].ok:
        cache.pop(key, None)
        cache[key] = [{**asdict(verdict), "path": str(verdict.path)} for verdict in verdicts]
        _write_cache(dict(list(cache.items())[-_CACHE_ENTRIES:]))
    return verdicts


def find_llvm(*, refresh: bool = False) -> Probe | None:
    """The first candidate that renders correctly, or None; see `survey` for what was rejected before it."""
    verdicts = survey(refresh=refresh)
    return verdicts[-1] if verdicts and verdicts[-1].ok else None


def advice() -> str:
    """What to install on this machine so that there is a fit LLVM."""
    if platform.system() == "Darwin":
        return "brew install llvm"
    if platform.system() == "Linux":
        system = "apt install libllvm19 (Debian, Ubuntu) or your distribution's LLVM 17 or newer"
        wheel = platform.machine() == "x86_64"
        return f"pip install {_WHEEL}, or {system}" if wheel else system
    return f"install LLVM 17 or newer and set {PATH_VARIABLE} to its LLVM-C library"


def _in_environment() -> Iterator[Path]:
    """LLVM libraries that belong to this Python environment, wherever its installer put them."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        for file in importlib.metadata.distribution(_WHEEL).files or ():
            if file.name.startswith("libLLVM"):
                yield Path(str(file.locate()))
    schemes = (sysconfig.get_path("data", scheme) for scheme in sysconfig.get_scheme_names() if "user" in scheme)
    roots = dict.fromkeys([sys.prefix, sysconfig.get_path("data"), *schemes])
    for root in roots:
        for folder in ("lib", "lib64"):
            yield from Path(root, folder).glob("libLLVM*")


def _by_version(paths: Iterable[Path]) -> list[Path]:
    """The shared libraries of LLVM proper among the paths, newest first, with the shortest name where several fit."""
    libraries = {path for path in paths if _LIBRARY.fullmatch(path.name) and path.is_file()}
    return sorted(libraries, key=lambda path: (*(-part for part in _version(path)), len(str(path)), str(path)))


def _version(path: Path) -> tuple[int, int, int]:
    """LLVM's version as far as file or folder name tell it, zeros otherwise."""
    real = path.resolve()
    name = re.search(r"libLLVM-(\d[\d.]*)|\.so\.(\d[\d.]*)|libLLVM\.(\d[\d.]*)\.dylib", real.name)
    folder = re.search(r"llvm[-@]?(\d[\d.]*)", str(real.parent))
    texts = [group for match in (name, folder) if match for group in match.groups() if group]
    # Debian 12's libLLVM-15.so.1 and llvm-16/lib/libLLVM.so.1: the largest number is the version, 1 is the ABI's.
    versions = [tuple(int(part) for part in text.strip(".").split(".")) for text in texts]
    major, minor, patch, *_ = (*max(versions, default=(0,)), 0, 0, 0)
    return major, minor, patch


def _until_one_works(paths: Iterable[Path]) -> Iterator[Probe]:
    for path in paths:
        verdict = probe(path)
        yield verdict
        if verdict.ok:
            return


def _verdict(path: Path, child: subprocess.CompletedProcess[str]) -> Probe:
    complaint = _complaint(child.stderr)
    if child.returncode < 0:
        try:
            name = signal.Signals(-child.returncode).name
        except ValueError:
            name = f"signal {-child.returncode}"
        return Probe(path, False, f"it ends the process with {name} at the first render ({complaint})")
    if child.returncode > 0:
        return Probe(path, False, complaint)
    try:
        report = json.loads(child.stdout.strip().rpartition("\n")[2])
        version, clamped, radiance = str(report["llvm"]), report["clamped"], float(report["radiance"])
    except (ValueError, KeyError, TypeError):
        return Probe(path, False, "the probing process reported no pixels")
    if clamped != [0.0, 0.25, 1.0]:
        return Probe(path, False, f"LLVM {version} clamps -1, 0.25, 2 to {clamped} instead of 0, 0.25, 1")
    if not abs(radiance / probe_render.ALBEDO - 1) <= _TOLERANCE:
        return Probe(path, False, f"LLVM {version} renders {radiance:.7g} where {probe_render.ALBEDO} is right")
    return Probe(path, True, f"LLVM {version} renders correctly")


def _complaint(stderr: str) -> str:
    """The line of a child's error output that tells most: Dr.Jit's or LLVM's own, else the last."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    telling = re.compile(r"too old|LLVM ERROR|Unable to load|No module named")
    line = next((line for line in lines if telling.search(line)), lines[-1] if lines else "no message")
    # Function names and addresses tell a user nothing.
    line = re.sub(r"^jitc?_\w+\(\): |\b0x[0-9a-f]+:? ?", "", line).rstrip(" .!,")
    return line if len(line) <= 200 else f"{line[:200]}..."


def _fingerprint(paths: Iterable[Path]) -> str:
    """Digest of all that a survey's outcome depends on."""
    versions = []
    for package in ("drjit", "mitsuba"):
        try:
            versions.append(importlib.metadata.version(package))
        except importlib.metadata.PackageNotFoundError:
            versions.append("absent")
    files: list[list[str | int]] = []
    for path in paths:
        try:
            status = path.stat()
        except OSError:
            files.append([str(path)])
        else:
            files.append([str(path), status.st_mtime_ns, status.st_size])
    known = json.dumps([_CACHE_FORMAT, sys.executable, sys.version, versions, files])
    return hashlib.sha256(known.encode()).hexdigest()


def cache_file() -> Path | None:
    """Where verdicts are kept: wallmirror/llvm.json in XDG_CACHE_HOME or ~/.cache; None without a home."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(root) if Path(root).is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        return None
    return folder / "wallmirror" / "llvm.json"


def _read_cache() -> dict[str, Any]:
    """The cache's entries; none if it is missing or damaged, which costs a probe and nothing else."""
    file = cache_file()
    if file is None:
        return {}
    try:
        entries = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return entries if isinstance(entries, dict) else {}


def _from_cache(entry: Any, paths: tuple[Path, ...]) -> tuple[Probe, ...]:
    """The verdicts of an entry, or none unless they are what a survey of these paths can have found."""
    try:
        verdicts = tuple(Probe(Path(item["path"]), item["ok"], str(item["reason"])) for item in entry)
    except (TypeError, KeyError):
        return ()
    expected = [*([False] * (len(verdicts) - 1)), True]
    fits = tuple(v.path for v in verdicts) == paths[: len(verdicts)] and [v.ok for v in verdicts] == expected
    return verdicts if verdicts and fits else ()


def _write_cache(entries: dict[str, Any]) -> None:
    """Replace the cache in one step; where that is not possible there is none."""
    file = cache_file()
    if file is None:
        return
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=file.name)
        temporary = Path(name)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                json.dump(entries, stream, indent=1)
            temporary.replace(file)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
