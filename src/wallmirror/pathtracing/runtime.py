"""Sets up Mitsuba: the LLVM that it computes with, the variant, our plugins, threads and log level.

Importing this module imports neither mitsuba nor drjit: the LLVM must be chosen before Dr.Jit is first imported, and
`activate` does that. Whoever imports mitsuba earlier gets whatever LLVM Dr.Jit meets, which may abort the process.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wallmirror.errors import InputError, MissingRuntimeError
from wallmirror.pathtracing import bsdf
from wallmirror.pathtracing.llvm import (
    NONE_VARIABLE,
    PATH_VARIABLE,
    Probe,
    advice,
    candidates,
    find_llvm,
    probe,
    survey,
)

__all__ = [
    "Probe",
    "Runtime",
    "activate",
    "available_cpus",
    "candidates",
    "choose_llvm",
    "find_llvm",
    "probe",
    "survey",
]

#: What runs without LLVM: the same answers, 500 to 1500 times slower with our plugins.
FALLBACK = "scalar_rgb"
_FEWEST_THREADS = 2  # the calling thread and one that serves Mitsuba's EXR writer, which would wait for it forever
_OLDEST_LLVM = 17  # 15 and 16 pass Dr.Jit's own check and abort on x86-64


@dataclass(frozen=True)
class Runtime:
    """What `activate` set up.

    Parameters
    ----------
    variant:
        The Mitsuba variant that is set.
    reduced:
        Whether it is not the one asked for, for want of an LLVM; `advice` then says why and what to install.
    llvm:
        The LLVM library, as far as it is known: None in variants that need none.
    llvm_version, mitsuba_version, drjit_version:
        Versions; that of LLVM is empty without one.
    threads:
        Threads that Dr.Jit computes with, the calling one included.
    """

    variant: str
    reduced: bool
    llvm: Path | None
    llvm_version: str
    mitsuba_version: str
    drjit_version: str
    threads: int
    advice: str = ""


def activate(variant: str = "llvm_ad_mono", *, threads: int | None = None) -> Runtime:
    """Make a Mitsuba variant current, with a fit LLVM and our plugins; may be called again and again.

    Parameters
    ----------
    variant:
        One of Mitsuba's variants. An LLVM variant gives way to `scalar_rgb` if no LLVM works.
    threads:
        Threads to compute with, the calling one included. By default all CPUs that this process may use, or whatever
        is set if Dr.Jit runs already. Never fewer than 2: without a worker Mitsuba waits forever when it writes EXR.

    Raises
    ------
    InputError
        For a variant that this Mitsuba does not have.
    MissingRuntimeError
        If Mitsuba cannot be imported, or CUDA is asked for and there is none.
    """
    wants_llvm = variant.startswith("llvm")
    first = "drjit" not in sys.modules
    # Once Dr.Jit is imported it is too late to choose: only see what was chosen.
    fault = _missing_llvm() if first else _loaded_llvm_fault() if wants_llvm else ""
    mi, dr = _import_mitsuba()
    if variant not in mi.variants():
        raise InputError(f'no Mitsuba variant is called "{variant}"; choose one of: {", ".join(mi.variants())}')
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise MissingRuntimeError(f"{variant} needs an NVIDIA GPU and its driver, and there is none; use llvm_ad_mono")
    reduced = wants_llvm and bool(fault)
    chosen = FALLBACK if reduced else variant
    wanted = threads or (available_cpus() if first else dr.thread_count())
    dr.set_thread_count(max(_FEWEST_THREADS, wanted))
    mi.set_variant(chosen)
    if first:
        mi.set_log_level(mi.LogLevel.Error)
    bsdf.register()
    uses_llvm = chosen.startswith("llvm")
    path = os.environ.get(PATH_VARIABLE)
    return Runtime(
        variant=chosen,
        reduced=reduced,
        llvm=Path(path) if uses_llvm and path else None,
        llvm_version=".".join(str(part) for part in dr.detail.llvm_version()) if uses_llvm else "",
        mitsuba_version=importlib.metadata.version("mitsuba"),
        drjit_version=importlib.metadata.version("drjit"),
        threads=dr.thread_count(),
        advice=f"{fault}; {variant} gives way to the far slower {FALLBACK}" if reduced else "",
    )


def choose_llvm() -> Probe | None:
    """Point Dr.Jit to an LLVM that works, by DRJIT_LIBLLVM_PATH; without effect once drjit is imported.

    `activate` does it; only a program that imports mitsuba or drjit itself before that needs to call it first.
    """
    found = find_llvm()
    if found is not None:
        os.environ[PATH_VARIABLE] = str(found.path)
    return found


def available_cpus() -> int:
    """CPUs that this process may use: by its affinity, and by its control group's quota on Linux."""
    cpus = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        return max(1, min(cpus, round(int(quota) / int(period))))
    except (OSError, ValueError):  # no control groups, or quota "max"
        return cpus


def _missing_llvm() -> str:
    """Choose an LLVM; what is wrong if there is none, else empty."""
    return f"no LLVM on this machine renders: {advice()}" if choose_llvm() is None else ""


def _loaded_llvm_fault() -> str:
    """What is wrong with the LLVM that Dr.Jit, already imported, holds; empty if nothing is."""
    if os.environ.get(NONE_VARIABLE) == "1":
        return f"{NONE_VARIABLE} is set"
    dr: Any = importlib.import_module("drjit")
    major = dr.detail.llvm_version()[0] if dr.has_backend(dr.JitBackend.LLVM) else None
    if major is not None and major >= _OLDEST_LLVM:
        return ""
    holds = "no LLVM" if major is None else f"LLVM {major}, which aborts Python"
    return (
        f"Dr.Jit was imported before wallmirror could choose its LLVM, and found {holds}: activate the runtime before "
        f"importing mitsuba, or set {PATH_VARIABLE}, or {advice()}"
    )


def _import_mitsuba() -> tuple[Any, Any]:
    try:
        return importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise MissingRuntimeError(f"Mitsuba cannot be imported ({error}); pip install wallmirror brings it") from error
