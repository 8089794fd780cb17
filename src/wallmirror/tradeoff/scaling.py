"""Scaling: seconds and memory over every size, the exponents, the largest that memory holds, and what happens beyond it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wallmirror.brdf import GaussianTrain
from wallmirror.geometry import incident_angles, outgoing_angles, wall_points
from wallmirror.memory import LIMIT_VARIABLE
from wallmirror.scene import load_scene
from wallmirror.tradeoff.pareto import Line, fit_line, short_seconds
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement, by_method
from wallmirror.tradeoff.worker import BASE
from wallmirror.transport import transport_matrix

Advance = Callable[[int, int], None]

#: Exponent that the physical model's cost was asked to have in N, M and the quadrature nodes, and how far off it may be.
ASKED_EXPONENT, ASKED_WITHIN = 1.0, 0.1
#: Times the seconds of the needed transcendental functions alone that the physical model may take.
ASKED_TRANSCENDENTAL = 3.0
#: Gigabytes of the machine for which the largest sizes are foretold.
MACHINE_GB = 16.0

MODEL, SOLVER, TRACER = "physical model", "solve (maximum likelihood)", "Mitsuba picture"
_SMALL = 20e6  # bytes: below it a process's memory is its allocator's business more than ours
_TAIL = 4
_CLEAR = 0.8  # exponent below which memory is still what does not grow


@dataclass(frozen=True)
class _Sweep:
    """One knob of one kind of work, doubled until its seconds run out."""

    group: str
    method: str
    kind: str
    knob: str
    start: int
    most: int
    unit: str


_SWEEPS = (
    _Sweep(MODEL, "pixels N", "transport", "pixels", BASE["pixels"], 10**6, "pixels"),
    _Sweep(MODEL, "elements M", "transport", "elements", BASE["elements"], 10**6, "elements"),
    _Sweep(MODEL, "views A", "transport", "views", BASE["views"], 10**5, "views"),
    _Sweep(MODEL, "quadrature nodes Q", "transport", "strip nodes", BASE["strip nodes"], 256, "nodes a strip"),
    _Sweep(SOLVER, "pixels N", "solve", "pixels", BASE["pixels"], 10**6, "pixels"),
    _Sweep(SOLVER, "elements M", "solve", "elements", BASE["elements"], 64, "elements"),
    _Sweep(SOLVER, "views A", "solve", "views", BASE["views"], 10**5, "views"),
    _Sweep(SOLVER, "realisations B", "solve", "realisations", BASE["realisations"], 10**5, "realisations"),
    _Sweep(TRACER, "picture width", "picture", "width", 64, 8192, "pixels wide"),
)
#: What is asked for at the limit: (what, specification, limit in GB or None for the memory that there is).
_BEYOND: tuple[tuple[str, dict[str, Any], float | None], ...] = (
    ("physical model", {"kind": "transport", "pixels": 10**6, "views": 1000, "elements": 64}, None),
    ("solve", {"kind": "solve"}, 0.005),
    ("capture", {"kind": "capture", "pixels": 10**6, "views": 10**4}, None),
)


def scaling(*, quick: bool = False, seed: int = 0, progress: Advance | None = None) -> Panel:
    """Measure the panel; nothing in it is random, so the seed has no effect. `quick` takes three sweeps and few sizes."""
    del seed
    chosen = [s for s in _SWEEPS if s.group == MODEL and s.knob != "views"] if quick else list(_SWEEPS)
    # Seconds of processor time of one sweep's last point: the next, twice as large, would take about twice as long.
    longest = 0.35 if quick else 6.0
    total = len(chosen) + 2
    runs: list[Run] = []

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    for number, sweep in enumerate(chosen, 1):
        runs += _swept(sweep, longest, factor=4 if quick else 2)
        tell(number)
    ratio, spread, nodes = transcendental_ratio(repeats=3 if quick else 9)
    tell(total - 1)
    refusals = [(what, ask(spec, limit_gb=limit)) for what, spec, limit in (_BEYOND[:1] if quick else _BEYOND)]
    tell(total)
    laws = _laws(runs)
    return Panel(
        name="scaling",
        title="Scaling: seconds and memory against size",
        question="What do more pixels, elements, views, realisations and nodes cost, and what happens at the limit?",
        setting=(
            f"One knob at a time is {'raised fourfold' if quick else 'doubled'} from the thesis's size (N 500, A 20, M 4, "
            f"B 20, for the model 2 x 4 nodes) until the next run would take more than {longest:g} s of processor time. Every "
            "run has a process of its own, and its memory is the peak of that process beyond what stood before the call."
        ),
        runs=tuple(runs),
        conclusions=(*conclude(laws), of_ratio(ratio, spread, nodes), *(_of_refusal(*r) for r in refusals)),
        omissions=(
            Omission(f"runs that fill {MACHINE_GB:g} GB", "hours at these speeds; foretold by the fitted laws instead"),
            *(
                (Omission("views, solver and Mitsuba", "left to the full run"),)
                if quick
                else (Omission("more than 64 elements in solve", "its captures would need as many patterns"),)
            ),
        ),
        numbers={
            "exponents": {
                f"{law.sweep.group}, {law.sweep.method}": {
                    "seconds": [law.seconds.slope, law.seconds.half_width()] if law.seconds else None,
                    "bytes": [law.memory.slope, law.memory.half_width()] if law.memory else None,
                }
                for law in laws
            },
            "over_transcendental": ratio,
            "over_transcendental_spread": spread,
        },
        tables=(_table(laws),),
    )


# -- measuring --------------------------------------------------------------------------------------------------------


def ask(spec: dict[str, Any], *, limit_gb: float | None = None) -> dict[str, Any]:
    """What the worker says of one point: "seconds", "wall", "bytes", "failure", and "exit" where it died.

    Parameters
    ----------
    limit_gb:
        Gigabytes that the worker may take.
    """
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    limit = {} if limit_gb is None else {LIMIT_VARIABLE: f"{limit_gb:g}"}
    done = subprocess.run(
        [sys.executable, "-m", "wallmirror.tradeoff.worker", json.dumps(spec)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **threads, **limit},
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"seconds": math.nan, "wall": math.nan, "bytes": math.nan, "failure": last, "exit": done.returncode}
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def _swept(sweep: _Sweep, longest: float, *, factor: int) -> list[Run]:
    runs = []
    value = sweep.start
    while value <= sweep.most:
        spec = {"kind": sweep.kind, sweep.knob: value}
        if sweep.kind == "solve" and sweep.knob == "elements":
            spec["realisations"] = max(BASE["realisations"], 2 * value)
        answer = ask(spec)
        runs.append(
            Run(
                group=sweep.group,
                method=sweep.method,
                knobs={sweep.knob: value},
                seconds=answer["seconds"],
                wall_seconds=answer["wall"],
                failure=answer["failure"],
                work=value / sweep.start if sweep.kind != "picture" else (value / sweep.start) ** 2,
                extra={"bytes": answer["bytes"]},
            )
        )
        if answer["failure"] or answer["seconds"] > longest / factor:
            break
        value *= factor
    return runs


def transcendental_ratio(*, repeats: int = 9) -> tuple[float, float, int]:
    """Seconds of the physical model over those of its transcendental functions alone, in pairs.

    The functions are those that its formulas name, once a node: an exp for each lobe, arctan of theta_s, and of the strip's
    mean a square root, two arctan and one arctan2; on the arguments that they have there, in place, and in blocks of the
    same size.

    Returns
    -------
    Median ratio, half the distance of its quartiles, and the number of nodes.
    """
    scene = load_scene("flat_wall_lobes")
    observer, card = scene.observer, scene.card
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    orders = (2, 6)
    nodes = observer.views * observer.pixels * card.elements * orders[0] * orders[1]
    # One block: as many pixels as `transport_matrix` takes at a time.
    some = replace(observer, view_angles=observer.view_angles[:8])
    wall_x = wall_points(some)
    slope = (np.asarray(card.elements_x)[:, None, None] - wall_x) / card.distance
    u = incident_angles(np.asarray(card.elements_x)[:, None, None], card.distance, wall_x) + outgoing_angles(
        some, wall_x
    )
    square = 1 + slope * slope
    small = 0.01 / np.sqrt(square)
    exponents = [np.maximum(-0.5 * ((u - centre) / brdf.sigma) ** 2, -703.0) for centre in brdf.centres]
    out = np.empty_like(slope)
    blocks = nodes / slope.size

    def functions() -> None:
        np.arctan(slope, out=out)
        np.sqrt(square, out=out)
        np.arctan(small, out=out)
        np.arctan(small, out=out)
        np.arctan2(small, square, out=out)
        for exponent in exponents:
            np.exp(exponent, out=out)

    def seconds(work: Callable[[], object], times: int) -> float:
        started = time.process_time()
        for _ in range(times):
            work()
        return (time.process_time() - started) / times

    ratios = []
    for _ in range(repeats + 1):
        model = seconds(lambda: transport_matrix(observer, card, brdf, orders=orders), 3)
        ratios.append(model / (blocks * seconds(functions, max(3, round(2 * blocks)))))
    low, middle, high = np.quantile(ratios[1:], [0.25, 0.5, 0.75])
    return float(middle), float(high - low) / 2, nodes


# -- what follows -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Law:
    """How seconds and memory of one sweep grow, from its four largest sizes; None where too little was measured."""

    sweep: _Sweep
    seconds: Line | None
    memory: Line | None
    largest: float

    @property
    def room(self) -> float | None:
        """Size, in that of the thesis, at which the memory of `MACHINE_GB` is full; None where it grows with no clear law."""
        return None if self.memory is None or self.memory.slope < _CLEAR else self.memory.where(MACHINE_GB * 1e9)


def _laws(runs: Sequence[Run]) -> list[Law]:
    laws = []
    for sweep in _SWEEPS:
        mine = [run for run in runs if run.group == sweep.group and not run.failure]
        line = sorted(by_method(mine).get(sweep.method, ()), key=lambda r: r.work)[-_TAIL:]
        if not line:
            continue
        heavy = [run for run in line if run.extra["bytes"] > _SMALL]
        laws.append(
            Law(
                sweep,
                fit_line([r.work for r in line], [r.seconds for r in line]) if len(line) > 2 else None,
                fit_line([r.work for r in heavy], [r.extra["bytes"] for r in heavy]) if len(heavy) > 2 else None,
                line[-1].work,
            )
        )
    return laws


def conclude(laws: Sequence[Law]) -> list[Statement]:
    """Whether the model's cost is linear where that was asked for, and how everything else grows."""
    statements = []
    asked = [law for law in laws if law.sweep.group == MODEL and law.seconds is not None]
    if asked:
        parts, met = [], True
        for law in asked:
            assert law.seconds is not None
            parts.append(f"{law.sweep.method} {law.seconds.slope:.2f} ± {law.seconds.half_width():.2f}")
            met &= abs(law.seconds.slope - ASKED_EXPONENT) <= ASKED_WITHIN
        statements.append(
            Statement(
                f"The physical model's seconds grow with the exponents {', '.join(parts)} (asked: {ASKED_EXPONENT:g} ± "
                f"{ASKED_WITHIN:g}).",
                met,
            )
        )
    others = [law for law in laws if law.sweep.group != MODEL and law.seconds is not None]
    if others:
        parts = [f"{law.sweep.group}, {law.sweep.method}: {law.seconds.slope:.2f}" for law in others if law.seconds]
        statements.append(Statement(f"Seconds of the others grow with {'; '.join(parts)}."))
    rooms = [
        f"{law.room * law.sweep.start:,.2g} {law.sweep.unit} ({law.sweep.group})"
        for law in laws
        if law.room is not None
    ]
    if rooms:
        statements.append(
            Statement(
                f"By the laws fitted to memory, {MACHINE_GB:g} GB would hold, one knob at a time, others at the thesis's "
                f"size: {'; '.join(rooms)}."
            )
        )
    return statements


def of_ratio(ratio: float, spread: float, nodes: int) -> Statement:
    """Whether the model is as quick as its transcendental functions let it be."""
    return Statement(
        f"The physical model takes {ratio:.2f} ± {spread:.2f} times as long as its transcendental functions alone would in "
        f"NumPy, over {nodes:,} nodes (asked: {ASKED_TRANSCENDENTAL:g} times).",
        ratio <= ASKED_TRANSCENDENTAL,
    )


def _of_refusal(what: str, answer: dict[str, Any]) -> Statement:
    """Whether what does not fit was refused with its size, by a process that took next to nothing."""
    refused = "exit" not in answer and " of memory and " in answer["failure"] and answer["bytes"] < 100e6
    if refused:
        return Statement(
            f"Beyond the limit, {what}: refused after {answer['bytes'] / 1e6:.0f} MB: “{answer['failure']}”.", True
        )
    how = f"the process died with {answer['exit']}" if "exit" in answer else answer["failure"] or "it was done"
    return Statement(f"Beyond the limit, {what}: NOT refused; {how}.", False)


def _table(laws: Sequence[Law]) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    rows = []
    for law in laws:
        room = law.room
        rows.append(
            (
                law.sweep.group,
                law.sweep.method,
                f"{law.largest:g} x",
                _slope(law.seconds),
                short_seconds(law.seconds.at(law.largest)) if law.seconds else "-",
                _slope(law.memory) if law.memory else f"below {_SMALL / 1e6:g} MB",
                "-" if room is None else f"{room:,.2g} x",
            )
        )
    columns = ("work", "knob", "measured up to", "exponent of seconds", "there", "of memory", f"{MACHINE_GB:g} GB hold")
    return "Fitted laws; sizes in those of the thesis, exponents with their 95 % interval", columns, tuple(rows)


def _slope(line: Line | None) -> str:
    return "too few sizes" if line is None else f"{line.slope:.2f} ± {line.half_width():.2f}"
