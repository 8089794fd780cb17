"""The runs of the performance analysis: which cells there are, what is measured in each, and how the work is spread."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cloudpickle
import joblib
import numpy as np
import thesis_algorithm
from scipy.optimize import linear_sum_assignment
from thesis_algorithm import ANALYSIS, Scene
from threadpoolctl import threadpool_limits

import wallmirror
from wallmirror import CaptureSet, WallmirrorError, radiance, scale_free_error, solve
from wallmirror.derendering.unstructured import de_render_unstructured

#: The methods, and how often each is run in a cell.
EXACT, TEXT, RECORDED, FEW = "exact", "alpha 0.1", "alpha 10", "few captures"
REPETITIONS = {EXACT: 96, TEXT: 32, RECORDED: 16, FEW: 4}
#: The closed form; the settings of the thesis's analysis (its alpha and tolerance, whole rows of B_diff) and of its
#: recorded run; and what `solve` does by itself where the closed form refuses.
OPTIONS: dict[str, dict[str, Any]] = {
    EXACT: {"method": "closed_form"},
    TEXT: {**ANALYSIS, "support": "rows"},
    RECORDED: {},
    FEW: {"method": "few_captures"},
}
#: Sweeps of options that only the thesis's algorithm has.
WITHOUT_EXACT = ("alpha", "proportion")
#: mse: in the thesis's unit, lobes of height 1; error: relative, after the best global scale.
MEASURES = ("source_mse", "source_mse_its_order", "brdf_mse", "source_error", "brdf_error", "seconds")
#: Repetitions that a worker does at once: about a second or two of work.
_PIECE = {EXACT: 24, TEXT: 24, RECORDED: 24, FEW: 1}
_FORWARD = ("brdf/base", "brdf/lobes", "geometry", "transport")
_ALTERNATION = ("unstructured", "alternation", "box_qp", "chaining")
_ELSEWHERE = (*_ALTERNATION, "calibration", "foresight", "general")


def sweeps() -> dict[str, dict[str, tuple[Scene, dict[str, Any]]]]:
    """Scene and options of each value of each sweep: those of the thesis's code."""
    even = range(2, 40, 4)
    few = range(2, 21, 2)
    spaced = np.logspace(math.log10(50), math.log10(2000), 10)
    return {
        "N": {str(round(n)): (Scene(N=round(n)), {}) for n in spaced},
        "A": {str(a): (Scene(A=a), {}) for a in even},
        "B": {str(b): (Scene(B=b), {}) for b in even},
        "A x B": {f"{a} x {b}": (Scene(A=a, B=b), {}) for b in few for a in few},
        "M": {str(m): (Scene(M=m), {}) for m in range(1, 11)},
        "sigma": {f"{s:.1f}": (Scene(sigma=round(s, 1)), {}) for s in np.linspace(0.1, 1, 10)},
        "fov": {f"{f:.4g}": (Scene(fov=float(f"{f:.4g}")), {}) for f in np.linspace(15, 85, 10)},
        "alpha": {f"{a:.3g}": (Scene(), {"alpha": float(f"{a:.3g}")}) for a in np.logspace(-2, 2, 10)},
        "proportion": {f"{p:.2f}": (Scene(), {"proportion": round(p, 2)}) for p in np.linspace(0.01, 0.1, 10)},
    }


@dataclass(frozen=True)
class Cell:
    """One method at one place of a sweep; places that sweeps share are one cell."""

    method: str
    scene: Scene
    options: tuple[tuple[str, Any], ...]

    @classmethod
    def of(cls, sweep: str, method: str, scene: Scene, options: dict[str, Any]) -> Cell | None:
        """The cell, or None where the method has no part in the sweep."""
        if sweep in WITHOUT_EXACT and method == EXACT:
            options = {}  # a horizontal line: the same captures whatever the option
        if (sweep == "alpha" and method == RECORDED) or (method == FEW and scene.B >= scene.M):
            return None
        return cls(method, scene, tuple(sorted((OPTIONS[method] | options).items())))

    @property
    def name(self) -> str:
        """Of its file."""
        values = {**asdict(self.scene), **dict(self.options)}
        shown = "_".join(f"{k}-{v:g}" if isinstance(v, (int, float)) else f"{k}-{v}" for k, v in values.items())
        return f"{'thesis' if self.method in (TEXT, RECORDED) else 'solve'}_{shown}"


@functools.cache
def code_of(method: str) -> str:
    """Digest of the modules that a method's numbers come from, as they are when it is first asked for."""
    package = Path(wallmirror.__file__).parent
    files = [path for name in _FORWARD for path in sorted([*package.glob(f"{name}.py"), *package.glob(f"{name}/*.py")])]
    if method in (TEXT, RECORDED):
        files += [package / "derendering" / f"{name}.py" for name in _ALTERNATION]
    else:
        files += [
            path for path in sorted((package / "derendering").glob("*.py")) if not path.stem.startswith(_ELSEWHERE)
        ]
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def measure(cell: Cell, repetitions: Iterable[int]) -> dict[str, dict[str, Any]]:
    """Errors of one method in some repetitions, by repetition; a refusal is its sentence."""
    results: dict[str, dict[str, Any]] = {}
    # One thread a worker: the matrices are small, and results must not hang on how many threads add them up.
    with threadpool_limits(limits=1):
        observer, card, model = cell.scene.observer(), cell.scene.card(), cell.scene.model()
        for repetition in repetitions:
            rng = np.random.default_rng(repetition)
            truth = rng.random((cell.scene.M, cell.scene.B))
            captures = CaptureSet(observer=observer, card=card, transport="thesis", radiance=radiance(model, truth))
            # The thread's own time, since other workers may share the processor.
            started = time.thread_time()
            try:
                if cell.method in (EXACT, FEW):
                    exact = solve(captures, **dict(cell.options))
                    source, brdf, order = exact.source, exact.transport, tuple(range(cell.scene.M))
                else:
                    found = de_render_unstructured(captures, rng=rng, **dict(cell.options))
                    source, brdf, order = found.source, found.brdf, found.order
            except WallmirrorError as refusal:
                results[str(repetition)] = {"refused": str(refusal), "seconds": time.thread_time() - started}
                continue
            seconds = time.thread_time() - started
            results[str(repetition)] = {**errors(source, brdf, order, truth, model), "seconds": seconds}
    return results


def best_order(source: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The row of an estimate for each source point that suits the truth best."""
    mine, theirs = linear_sum_assignment(np.mean((source[:, None] - truth[None]) ** 2, axis=2))
    order: np.ndarray = mine[np.argsort(theirs)]
    return order


def errors(
    source: np.ndarray, brdf: np.ndarray, order: tuple[int, ...], truth: np.ndarray, model: np.ndarray
) -> dict[str, float]:
    """Errors of the pattern in its best order and in that of the thesis's code, and of the BRDF as it was returned."""
    best = source[best_order(source, truth)]
    return {
        "source_mse": float(np.mean((best - truth) ** 2)),
        "source_mse_its_order": thesis_algorithm.source_errors(source, order, truth)[0],
        "brdf_mse": float(np.mean((brdf - model) ** 2)),
        "source_error": scale_free_error(best, truth),
        "brdf_error": scale_free_error(brdf, model),
    }


def run(
    cells: Iterable[Cell], work: Path, repetitions: dict[str, int], *, jobs: int = 1, dask: str | None = None
) -> int:
    """Do what is still missing of the cells and leave it in `work`, piece by piece; returns how many runs that took."""
    work.mkdir(parents=True, exist_ok=True)
    pieces: list[tuple[Cell, list[int]]] = []
    for cell in cells:
        done = load(cell, work)
        missing = [r for r in range(repetitions[cell.method]) if str(r) not in done]
        size = _PIECE[cell.method]
        pieces += [(cell, missing[k : k + size]) for k in range(0, len(missing), size)]
    count = sum(len(piece) for _, piece in pieces)
    started, finished = time.perf_counter(), 0
    for place, results in _spread(pieces, jobs, dask):
        cell = pieces[place][0]
        store(cell, work, load(cell, work) | results)
        finished += len(results)
        print(
            f"\r{finished} of {count} runs, {time.perf_counter() - started:.0f} s", end="", file=sys.stderr, flush=True
        )
    if count:
        print(file=sys.stderr)
    return count


def _task(place: int, cell: Cell, repetitions: list[int]) -> tuple[int, dict[str, dict[str, Any]]]:
    return place, measure(cell, repetitions)


def _spread(
    pieces: list[tuple[Cell, list[int]]], jobs: int, dask: str | None
) -> Iterator[tuple[int, dict[str, dict[str, Any]]]]:
    """Results of the pieces in the order in which they come, from processes of this machine or of a Dask cluster."""
    tasks = [joblib.delayed(_task)(place, *piece) for place, piece in enumerate(pieces)]
    if not tasks:
        return
    # These scripts are no package that a worker could import: they travel with the tasks.
    for module in (sys.modules[__name__], thesis_algorithm):
        cloudpickle.register_pickle_by_value(module)
    with contextlib.ExitStack() as stack:
        if dask is not None:
            from distributed import Client

            client = stack.enter_context(Client(dask, set_as_default=False))
            stack.enter_context(joblib.parallel_config("dask", client=client))
        workers = {"n_jobs": jobs} if dask is None else {}
        # A piece takes about a second, so there is no need to send several at once.
        yield from joblib.Parallel(**workers, batch_size=1, return_as="generator_unordered")(tasks)


def load(cell: Cell, work: Path) -> dict[str, dict[str, Any]]:
    """The repetitions of a cell that are done; none if the code has changed since."""
    path = work / f"{cell.name}.json"
    if not path.exists():
        return {}
    document = json.loads(path.read_text())
    runs: dict[str, dict[str, Any]] = document["runs"] if document["code"] == code_of(cell.method) else {}
    return runs


def store(cell: Cell, work: Path, runs: dict[str, dict[str, Any]]) -> None:
    """Replace a cell's file at once, so that one who stops the run finds the old one or the new one whole."""
    ordered = dict(sorted(runs.items(), key=lambda item: int(item[0])))
    path = work / f"{cell.name}.json"
    unfinished = path.with_suffix(f".{os.getpid()}.part")
    unfinished.write_text(json.dumps({"code": code_of(cell.method), "runs": ordered}) + "\n")
    unfinished.replace(path)


def summary(cell: Cell, work: Path, repetitions: int) -> dict[str, Any]:
    """Mean, standard deviation and quartiles of the errors over the first repetitions of a cell."""
    runs = {name: run for name, run in load(cell, work).items() if int(name) < repetitions}
    solved = [r for r in runs.values() if "refused" not in r]
    row: dict[str, Any] = {"runs": len(runs), "refused": len(runs) - len(solved)}
    if row["refused"]:
        row["reason"] = next(r["refused"] for r in runs.values() if "refused" in r)
    for name in MEASURES if solved else ():
        values = np.array([r[name] for r in solved])
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
        numbers = {
            "mean": values.mean(),
            "std": values.std(),
            "q1": low,
            "median": middle,
            "q3": high,
            "max": values.max(),
        }
        row[name] = {k: float(f"{v:.5g}") for k, v in numbers.items()}
    if solved:
        row["luckiest"] = min((r["source_mse"], int(name)) for name, r in runs.items() if "refused" not in r)[1]
    # All runs, refusals as well: the price of the cell.
    row["processor_seconds"] = round(sum(r["seconds"] for r in runs.values()), 4)
    return row


def chosen(names: list[str] | None, *, quick: bool) -> dict[str, dict[str, tuple[Scene, dict[str, Any]]]]:
    """The sweeps asked for; a quick one has 4 of the 10 values of each."""
    few = (0, 3, 6, 9)
    result = {}
    for name, places in sweeps().items():
        if names and name not in names:
            continue
        kept = list(places)
        if quick:
            kept = [k for i, k in enumerate(kept) if (i % 10 in few and (i // 10 in few or name != "A x B"))]
        result[name] = {k: places[k] for k in kept}
    return result


def merged(before: dict[str, Any], document: dict[str, Any], *, whole: bool) -> dict[str, Any]:
    """A later call's results over an earlier one's: its sweeps, and the time of what it ran itself."""
    if not whole:
        return {**before, "sweeps": {**before["sweeps"], **document["sweeps"]}}
    return {**document, "last_call": {**before["last_call"], **document["last_call"]}}


def analyse(
    places: dict[str, dict[str, tuple[Scene, dict[str, Any]]]],
    work: Path,
    repetitions: dict[str, int],
    *,
    jobs: int = 1,
    dask: str | None = None,
) -> dict[str, Any]:
    """Run what is missing, and sum all up by sweep, value and method."""
    table = {
        sweep: {
            value: {m: cell for m in REPETITIONS if (cell := Cell.of(sweep, m, scene, options)) is not None}
            for value, (scene, options) in values.items()
        }
        for sweep, values in places.items()
    }
    cells = list(dict.fromkeys(cell for values in table.values() for row in values.values() for cell in row.values()))
    calls: dict[str, Any] = {}
    for method in REPETITIONS:
        load_before, started = os.getloadavg()[0], time.perf_counter()
        count = run([c for c in cells if c.method == method], work, repetitions, jobs=jobs, dask=dask)
        if count:
            calls[method] = {
                "runs": count,
                "wall_seconds": round(time.perf_counter() - started, 1),
                "workers": dask or joblib.effective_n_jobs(jobs),
                "processors": os.cpu_count(),
                "load": [round(load_before, 1), round(os.getloadavg()[0], 1)],
            }
    rows = {cell: summary(cell, work, repetitions[cell.method]) for cell in cells}
    return {
        "repetitions": repetitions,
        "cost": {method: _cost([row for cell, row in rows.items() if cell.method == method]) for method in REPETITIONS},
        "last_call": calls,
        "sweeps": {
            sweep: {value: {m: rows[cell] for m, cell in row.items()} for value, row in values.items()}
            for sweep, values in table.items()
        },
    }


def _cost(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Of one method: processor time of all its cells, each counted once, and the usual run's."""
    usual = [row["seconds"]["median"] for row in rows if "seconds" in row]
    return {
        "cells": len(rows),
        "runs": sum(row["runs"] for row in rows),
        "processor_seconds": round(sum(row["processor_seconds"] for row in rows), 1),
        "median_seconds": float(np.median(usual)) if usual else math.nan,
    }
