"""The benchmark suite tells a planted slowdown and a planted leak, and nothing where there is nothing."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def suite() -> Any:
    path = Path(__file__).parents[2] / "benchmarks" / "suite.py"
    spec = importlib.util.spec_from_file_location("benchmark_suite", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["benchmark_suite"] = module
    spec.loader.exec_module(module)
    return module


def result(factor: float, *, scatter: float = 0.02, peak: int = 1_000_000) -> dict[str, Any]:
    rng = np.random.default_rng(int(1000 * factor))
    return {"ratios": list(factor * (1 + scatter * rng.standard_normal(15))), "peak": peak}


@pytest.mark.parametrize(
    ("after", "verdict", "good"),
    [
        (result(1.02), "alike", True),
        (result(1.5), "SLOWER", False),
        (result(0.5), "quicker", True),
        (result(1.02, peak=2_000_000), "HUNGRIER", False),
        (result(1.5, peak=2_000_000), "SLOWER and HUNGRIER", False),
        (result(1.4, scatter=0.6), "alike", True),  # not told from its own scatter
    ],
)
def test_a_change_is_told_if_it_is_one(suite: Any, after: dict[str, Any], verdict: str, good: bool) -> None:
    rows, passed = suite.compare({"case": result(1.0)}, {"case": after})
    assert rows[0][-1] == verdict
    assert passed is good


def test_a_case_that_one_commit_lacks_is_named_and_counts_for_nothing(suite: Any) -> None:
    rows, passed = suite.compare({"a": {"absent": "ImportError: no such thing"}}, {"a": result(1.0), "b": result(1.0)})
    assert passed
    assert [row[-1] for row in rows] == ["ImportError: no such thing", "not in the other result"]


def test_memory_is_measured_and_a_case_that_fails_says_why(suite: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Any:
        raise ImportError("no such thing")

    monkeypatch.setattr(suite, "LEAST", 1e-3)
    monkeypatch.setattr(suite, "CASES", {"array": lambda: lambda: np.ones(500_000), "broken": broken})
    found = suite.measure(["array", "broken"], 2)
    assert 4e6 <= found["array"]["peak"] < 4.1e6  # half a million numbers of 8 bytes
    assert len(found["array"]["ratios"]) == 2
    assert found["broken"] == {"absent": "ImportError: no such thing"}


@pytest.mark.parametrize("name", ["algorithm_1", "physical_transport", "closed_form", "capture_set_on_disk"])
def test_the_cases_of_the_library_run(suite: Any, name: str) -> None:
    assert suite.CASES[name]()() is not None
