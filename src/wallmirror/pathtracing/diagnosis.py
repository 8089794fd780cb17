"""What `wallmirror doctor` tells: each thing that rendering needs, whether it is there, and what to do if not."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wallmirror.errors import MissingRuntimeError
from wallmirror.pathtracing import llvm, probe_render
from wallmirror.pathtracing.runtime import Runtime, activate, available_cpus

_OLDEST_PYTHON = (3, 11)
_SPP = 64


@dataclass(frozen=True)
class Finding:
    """One thing looked at: its name, whether it is good, what was seen, and what to do if it is not."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""


def diagnose() -> list[Finding]:
    """Look at all that rendering needs, LLVM libraries anew; nothing is printed and nothing raised for a fault."""
    findings = [_python(), _package("mitsuba"), _package("drjit"), *_llvm()]
    try:
        runtime = activate()
    except MissingRuntimeError as error:
        return [*findings, Finding("runtime", False, str(error), "mend the faults above, then look again")]
    return [*findings, _threads(runtime), _precision(runtime), _exr()]


def _python() -> Finding:
    good = sys.version_info >= _OLDEST_PYTHON
    wanted = ".".join(str(part) for part in _OLDEST_PYTHON)
    return Finding("Python", good, platform.python_version(), "" if good else f"use Python {wanted} or newer")


def _package(name: str) -> Finding:
    """Whether a package is installed in the version that wallmirror pins."""
    pinned = _pins().get(name)
    remedy = f"pip install {name}=={pinned}" if pinned else f"pip install {name}"
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "not installed", remedy)
    if pinned and version != pinned:
        return Finding(name, False, f"{version}, but wallmirror is tested with {pinned}", remedy)
    return Finding(name, True, version)


def _pins() -> dict[str, str]:
    """Versions that wallmirror's own metadata pins with ==."""
    try:
        requirements = importlib.metadata.requires("wallmirror") or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    matches = (re.match(r"([\w.-]+)\s*==\s*([\w.]+)", requirement) for requirement in requirements)
    return {match[1].lower(): match[2] for match in matches if match}


def _llvm() -> list[Finding]:
    """One finding on LLVM with the verdict on each candidate tried, and one if the user's own choice failed."""
    verdicts = llvm.survey(refresh=True)
    good = bool(verdicts) and verdicts[-1].ok
    detail = "; ".join(f"{verdict.path}: {verdict.reason}" for verdict in verdicts) or "no LLVM library was found"
    remedy = llvm.advice()
    if os.environ.get(llvm.NONE_VARIABLE) == "1":
        detail, remedy = f"none is looked for, as {llvm.NONE_VARIABLE} is 1", f"unset {llvm.NONE_VARIABLE}"
    findings = [Finding("LLVM", good, detail, "" if good else remedy)]
    asked = os.environ.get(llvm.PATH_VARIABLE)
    if asked and verdicts and str(verdicts[0].path) == asked and not verdicts[0].ok:
        remedy = "unset it, or set it to an LLVM library that works"
        findings.append(Finding(llvm.PATH_VARIABLE, False, f"{asked}: {verdicts[0].reason}", remedy))
    return findings


def _threads(runtime: Runtime) -> Finding:
    return Finding("threads", True, f"{runtime.threads} of {available_cpus()} usable CPUs")


def _precision(runtime: Runtime) -> Finding:
    """Whether a diffuse wall of albedo 0.5 under a sky of radiance 1 shows 0.5."""
    mi: Any = importlib.import_module("mitsuba")
    radiance = probe_render.wall_radiance(mi, _SPP)
    worst = float(np.abs(radiance / probe_render.ALBEDO - 1).max())
    # Each sample is right to a few roundings; the film adds _SPP of them, and as many weights, in float32.
    tolerance = (2 * _SPP + 8) * 2.0**-24
    detail = f"{runtime.variant} is within {worst:.1e} of the exact answer (float32 allows {tolerance:.1e})"
    good = worst <= tolerance
    return Finding("precision", good, detail, "" if good else "reinstall mitsuba and drjit, or try another LLVM")


def _exr() -> Finding:
    """Whether float32 pixels survive Mitsuba's EXR writer and OpenEXR's reader bit for bit."""
    mi: Any = importlib.import_module("mitsuba")
    # Full 24-bit significands, the extremes of the range, and a number that half floats would round.
    pixels = np.array([[1 / 3, 1e-38, 3e38], [65504.25, 2**-24, 0.0]], dtype=np.float32)
    remedy = "pip install --force-reinstall OpenEXR"
    with tempfile.TemporaryDirectory(prefix="wallmirror-exr-") as folder:
        file = str(Path(folder, "pixels.exr"))
        try:
            mi.Bitmap(pixels[..., None]).write(file)
            openexr: Any = importlib.import_module("OpenEXR")
            with openexr.File(file) as stream:
                back = stream.channels()["Y"].pixels
        except (ImportError, KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
            return Finding("EXR", False, f"a float32 file cannot be written and read back: {error}", remedy)
    good = back.dtype == np.float32 and back.tobytes() == pixels.tobytes()
    detail = "float32 pixels survive bit for bit" if good else "float32 pixels come back changed"
    return Finding("EXR", good, detail, "" if good else remedy)
