"""The performance analysis: it goes on where it stopped, workers change nothing, and refusals are told."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("joblib")

_VALIDATION = Path(__file__).parents[2] / "validation"
FEW = {"exact": 3, "alpha 0.1": 3, "alpha 10": 2, "few captures": 1}


@pytest.fixture(scope="module")
def analysis():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(_VALIDATION))
        yield importlib.import_module("performance_runs")


@pytest.fixture(scope="module")
def places(analysis):
    """Cells of small captures: two that are solved, one that is refused, and one of an option."""
    first = analysis.Scene(N=60, A=4, M=2, B=3, sigma=4.0)
    return {
        "N": {"60": (first, {}), "100": (analysis.Scene(N=100, A=2, M=2, B=4, sigma=3.0), {})},
        "B": {"1": (analysis.Scene(N=60, A=4, M=2, B=1, sigma=4.0), {})},
        "alpha": {"1.67": (first, {"alpha": 1.0})},
    }


@pytest.fixture(scope="module")
def reference(analysis, places, tmp_path_factory):
    """All in one go, in this process."""
    return analysis.analyse(places, tmp_path_factory.mktemp("reference"), FEW)


def without_times(document):
    """What must not hang on who did the work when; means of times do."""
    text = re.sub(r'"(processor_|median_)?seconds": (\{[^}]*\}|[^,}]*)', '"time": 0', json.dumps(document["sweeps"]))
    return json.loads(text)


def test_both_methods_are_measured(reference):
    row = reference["sweeps"]["N"]["60"]
    assert {m: row[m]["runs"] for m in row} == {k: n for k, n in FEW.items() if k != "few captures"}
    # Without noise the one is exact to rounding (5e-14 measured), the other pays for chaining pixels that do not coincide.
    assert row["exact"]["source_error"]["max"] < 1e-9
    assert row["alpha 0.1"]["source_mse"]["median"] > 1e-3
    assert row["alpha 0.1"]["source_mse"]["median"] <= row["alpha 0.1"]["source_mse_its_order"]["median"]
    # Shared places are one cell: N = 60 and alpha = 1.67 have one exact cell.
    assert reference["cost"]["exact"] | {"processor_seconds": 0, "median_seconds": 0} == {
        "cells": 3,
        "runs": 9,
        "processor_seconds": 0,
        "median_seconds": 0,
    }


def test_the_measures_are_the_thesis_s(analysis):
    truth = np.array([[0.1, 0.2], [0.8, 0.9]])
    model = np.ones((1, 3, 2))
    found = analysis.errors(2 * truth[::-1], 0.5 * model, (0, 1), truth, model)
    # Swapped and doubled: the best order leaves the truth itself as the error, the other does not.
    assert found["source_mse"] == pytest.approx(np.mean(truth**2))
    assert found["source_mse_its_order"] == pytest.approx(np.mean((2 * truth[::-1] - truth) ** 2))
    assert found["brdf_mse"] == pytest.approx(0.25)
    assert found["source_error"] == pytest.approx(0, abs=1e-15)
    assert found["brdf_error"] == pytest.approx(0, abs=1e-15)


def test_refused_cells_are_recorded(reference):
    row = reference["sweeps"]["B"]["1"]["exact"]
    assert row["runs"] == row["refused"] == 3
    assert "1 realisation(s)" in row["reason"]
    assert "source_mse" not in row
    # The thesis's algorithm refuses nothing.
    assert reference["sweeps"]["B"]["1"]["alpha 0.1"]["refused"] == 0


def test_the_exact_solver_has_no_alpha(reference):
    sweeps = reference["sweeps"]
    assert sweeps["alpha"]["1.67"]["exact"] == sweeps["N"]["60"]["exact"]
    assert "alpha 10" not in sweeps["alpha"]["1.67"]


def test_a_run_that_was_stopped_goes_on_where_it_stopped(analysis, places, reference, tmp_path, monkeypatch):
    measured = []
    measure = analysis.measure

    def stopping(cell, repetitions):
        if len(measured) == 4:
            raise KeyboardInterrupt
        measured.append((cell.name, tuple(repetitions)))
        return measure(cell, repetitions)

    monkeypatch.setattr(analysis, "measure", stopping)
    monkeypatch.setattr(analysis, "_PIECE", dict.fromkeys(FEW, 2))
    with pytest.raises(KeyboardInterrupt):
        analysis.analyse(places, tmp_path, FEW)
    assert not list(tmp_path.glob("*.part"))
    done = list(measured)
    assert len(done) == 4

    def counting(cell, repetitions):
        measured.append((cell.name, tuple(repetitions)))
        return measure(cell, repetitions)

    monkeypatch.setattr(analysis, "measure", counting)
    whole = analysis.analyse(places, tmp_path, FEW)
    assert without_times(whole) == without_times(reference)
    # No piece twice, and nothing at all the second time.
    assert len(set(measured)) == len(measured)
    assert analysis.analyse(places, tmp_path, FEW)["last_call"] == {}
    # More repetitions only add those.
    more = analysis.analyse(places, tmp_path, {**FEW, "exact": 4})
    assert more["last_call"]["exact"]["runs"] == 3


def test_results_of_other_code_do_not_count(analysis, places, tmp_path, monkeypatch):
    cell = analysis.Cell.of("N", "exact", *places["N"]["60"])
    analysis.store(cell, tmp_path, {"0": {"refused": "", "seconds": 0.0}})
    assert len(analysis.load(cell, tmp_path)) == 1
    monkeypatch.setattr(analysis, "code_of", lambda method: "another")
    assert analysis.load(cell, tmp_path) == {}


def test_the_number_of_workers_changes_nothing(analysis, places, reference, tmp_path):
    assert without_times(analysis.analyse(places, tmp_path, FEW, jobs=2)) == without_times(reference)


def test_a_dask_cluster_gives_the_same(analysis, places, reference, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, protocol="tcp"
    ) as cluster:
        document = analysis.analyse(places, tmp_path, FEW, dask=cluster.scheduler_address)
    assert without_times(document) == without_times(reference)


def test_verdicts_follow_from_the_numbers(analysis):
    page = importlib.import_module("performance_page")

    def row(theirs, ours):
        numbers = {"mean": theirs, "std": 0.1 * theirs, "median": theirs}
        exact = {"source_error": {"median": ours, "max": ours}, "runs": 16, "refused": 0}
        return {"alpha 0.1": {"source_mse": numbers, "brdf_mse": numbers, "runs": 16, "refused": 0}, "exact": exact}

    def verdict(theirs, ours):
        (line,) = page.CLAIMS["N"]({n: row(*pair) for n, pair in zip(("50", "500", "2000"), zip(theirs, ours))})
        return line[3].split(":")[0]

    assert verdict((0.3, 0.1, 0.1), (1e-10, 1e-13, 1e-13)) == "corrected"
    assert verdict((0.3, 0.1, 0.1), (0.1, 1e-13, 1e-13)) == "confirmed"
    # One percent less beyond 500 is within three standard errors (7.5 % of a mean here).
    assert verdict((0.3, 0.1, 0.099), (1e-10, 1e-13, 1e-13)) == "corrected"
    # Not level beyond 500, and no fall before it: whatever the exact solver does.
    assert verdict((0.3, 0.1, 0.05), (1e-10, 1e-13, 1e-13)) == "refuted"
    assert verdict((0.1, 0.1, 0.1), (1e-10, 1e-13, 1e-13)) == "refuted"
    assert verdict((0.1, 0.1, 0.1), (0.1, 1e-13, 1e-13)) == "refuted"


def test_the_page_quotes_the_results(analysis, reference, tmp_path):
    page = importlib.import_module("performance_page")
    assert page.write({**reference, "sweeps": {"alpha": reference["sweeps"]["alpha"]}}, tmp_path).exists()
    text = (tmp_path / "PERFORMANCE_ANALYSIS.md").read_text()
    assert f"{reference['sweeps']['alpha']['1.67']['alpha 0.1']['source_mse']['mean']:.4f}" in text
    assert "was not run again" in text
    assert (tmp_path / "figures" / "performance_alpha.png").stat().st_size > 10_000
