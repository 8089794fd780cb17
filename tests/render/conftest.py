"""Mitsuba for the tests that render."""

from __future__ import annotations

import importlib
import os
from typing import Any

import pytest

from wallmirror.pathtracing.runtime import activate, available_cpus, choose_llvm

# Test modules may import drjit at their top, and its LLVM must be chosen before that.
choose_llvm()


@pytest.fixture(scope="session")
def mi() -> Any:
    """The module mitsuba in llvm_ad_mono, with our plugins; tests that need it are skipped where no LLVM works."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    runtime = activate("llvm_ad_mono", threads=max(1, available_cpus() // workers))
    if runtime.reduced:
        pytest.skip(f"Mitsuba cannot render here: {runtime.advice}")
    return importlib.import_module("mitsuba")
