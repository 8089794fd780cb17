"""Scaling: seconds and memory over every size, up to the largest that memory holds, and what happens beyond it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

from wallmirror.memory import LIMIT_VARIABLE
from wallmirror.tradeoff.growth import MACHINE_GB, MODEL, SOLVER, TRACER, Sweep, conclude, laws_of, table_of
from wallmirror.tradeoff.runs import Omission, Panel, Run, Statement
from wallmirror.tradeoff.transcendental import of_ratio, transcendental_ratio
from wallmirror.tradeoff.worker import BASE

Advance = Callable[[int, int], None]

# Where a size is beyond the memory, these shares of it are tried: the first that fits is the largest measured.
_SHARES = (0.85, 0.7, 0.55, 0.4)

SWEEPS = (
    Sweep(MODEL, "pixels N", "transport", "pixels", BASE["pixels"], 10**9, "pixels"),
    Sweep(MODEL, "elements M", "transport", "elements", BASE["elements"], 10**9, "elements"),
    Sweep(MODEL, "views A", "transport", "views", BASE["views"], 10**6, "views"),
    Sweep(MODEL, "quadrature nodes Q", "transport", "strip nodes", BASE["strip nodes"], 256, "nodes a strip", False),
    Sweep(SOLVER, "pixels N", "solve", "pixels", BASE["pixels"], 10**9, "pixels"),
    Sweep(SOLVER, "elements M", "solve", "elements", BASE["elements"], 4096, "elements"),
    Sweep(SOLVER, "views A", "solve", "views", BASE["views"], 10**6, "views"),
    Sweep(SOLVER, "realisations B", "solve", "realisations", BASE["realisations"], 10**8, "realisations"),
    Sweep(TRACER, "picture width", "picture", "width", 64, 2**20, "pixels wide"),
)
#: What is asked for at the limit: (what, specification, limit in GB or None for the memory that there is).
_BEYOND: tuple[tuple[str, dict[str, Any], float | None], ...] = (
    ("physical model", {"kind": "transport", "pixels": 10**6, "views": 1000, "elements": 64}, None),
    ("solve", {"kind": "solve"}, 0.005),
    ("capture", {"kind": "capture", "pixels": 10**6, "views": 10**4}, None),
)


def scaling(*, quick: bool = False, full: bool = False, seed: int = 0, progress: Advance | None = None) -> Panel:
    """Measure the panel.

    Parameters
    ----------
    quick:
        Three sweeps and few sizes.
    full:
        Every sweep goes on until its memory passes 16 GB and is refused, which takes half an hour.
    seed:
        Without effect: nothing in the panel is random.
    """
    del seed
    chosen = [s for s in SWEEPS if s.group == MODEL and s.knob != "views"] if quick else list(SWEEPS)
    # Seconds of processor time of one sweep's last point: the next, twice as large, would take about twice as long.
    longest = 0.35 if quick else 6.0
    total = len(chosen) + 2
    runs: list[Run] = []

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    for number, sweep in enumerate(chosen, 1):
        mine = _swept(sweep, longest, factor=4 if quick else 2)
        runs += mine + (_filled(sweep, mine) if full else [])
        tell(number)
    ratio, spread, nodes = transcendental_ratio(repeats=3 if quick else 9)
    tell(total - 1)
    refusals = [(what, ask(spec, limit_gb=limit)) for what, spec, limit in (_BEYOND[:1] if quick else _BEYOND)]
    tell(total)
    laws = laws_of(runs, SWEEPS)
    until = f"until the next run would take more than {longest:g} s of processor time"
    if full:
        until += f", then fourfold until {MACHINE_GB:g} GB are passed, and a last time at the largest size that fits"
    return Panel(
        name="scaling",
        title="Scaling: seconds and memory against size",
        question="What do more pixels, elements, views, realisations and nodes cost, and what happens at the limit?",
        setting=(
            f"One knob at a time is {'raised fourfold' if quick else 'doubled'} from the thesis's size (N 500, A 20, M 4, "
            f"B 20, for the model 2 x 4 nodes) {until}. Every run has a process of its own, and its memory is the peak of "
            "that process beyond what stood before the call."
        ),
        runs=tuple(runs),
        conclusions=(
            *conclude(laws),
            *([_of_the_largest(runs)] if full else []),
            of_ratio(ratio, spread, nodes),
            *(_of_refusal(*r) for r in refusals),
        ),
        omissions=_left_out(quick=quick, full=full),
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
        tables=(table_of(laws),),
    )


def ask(spec: dict[str, Any], *, limit_gb: float | None = None) -> dict[str, Any]:
    """What the worker says of one point: "seconds", "wall", "bytes", "failure", and "exit" where it died.

    Parameters
    ----------
    limit_gb:
        Gigabytes that the worker may take. Should the library's own refusal fail, the system ends its allocations a
        quarter and 2 GB beyond, which the compiler of a path tracer may need.
    """
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    limit = {} if limit_gb is None else {LIMIT_VARIABLE: f"{limit_gb:g}"}
    beyond = [] if limit_gb is None else [f"{round(1.25e9 * limit_gb + 2e9)}"]
    done = subprocess.run(
        [sys.executable, "-m", "wallmirror.tradeoff.worker", json.dumps(spec), *beyond],
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


def _swept(sweep: Sweep, longest: float, *, factor: int) -> list[Run]:
    """The runs of a sweep until its seconds run out."""
    runs: list[Run] = []
    value = sweep.start
    while value <= sweep.most:
        runs.append(_run(sweep, value))
        if runs[-1].failure or runs[-1].seconds > longest / factor:
            break
        value *= factor
    return runs


def _filled(sweep: Sweep, before: Sequence[Run]) -> list[Run]:
    """The runs that go on from there to the largest size that `MACHINE_GB` hold; the refusal beyond it is among them."""
    runs: list[Run] = []
    value = before[-1].knobs[sweep.knob]
    if before[-1].failure or value >= sweep.most:
        return runs
    while value < sweep.most:
        value = min(4 * value, sweep.most)
        runs.append(_run(sweep, value, limit_gb=MACHINE_GB))
        if runs[-1].failure:
            break
    if _is_refusal(runs[-1].failure):
        for share in _SHARES:
            runs.append(_run(sweep, round(share * value), limit_gb=MACHINE_GB))
            if not runs[-1].failure:
                break
    return runs


def _run(sweep: Sweep, value: int, *, limit_gb: float | None = None) -> Run:
    spec = {"kind": sweep.kind, sweep.knob: value}
    if sweep.kind == "solve" and sweep.knob == "elements":
        spec["realisations"] = max(BASE["realisations"], 2 * value)
    answer = ask(spec, limit_gb=limit_gb)
    return Run(
        group=sweep.group,
        method=sweep.method,
        knobs={sweep.knob: value},
        seconds=answer["seconds"],
        wall_seconds=answer["wall"],
        failure=answer["failure"],
        work=value / sweep.start if sweep.kind != "picture" else (value / sweep.start) ** 2,
        extra={"bytes": answer["bytes"]},
    )


# -- what follows -----------------------------------------------------------------------------------------------------


def _of_the_largest(runs: Sequence[Run]) -> Statement:
    """What the largest run of each sweep took, and whether it stayed within the memory that it was given."""
    parts, met = [], True
    for sweep in SWEEPS:
        mine = [run for run in runs if (run.group, run.method) == (sweep.group, sweep.method) and not run.failure]
        if mine and sweep.fills_memory:
            largest = max(mine, key=lambda run: run.work)
            taken = largest.extra["bytes"] / 1e9
            met &= taken <= MACHINE_GB
            size = f"{largest.knobs[sweep.knob]:,} {sweep.unit} ({sweep.group})"
            parts.append(f"{size}: {taken:.1f} GB in {largest.wall_seconds:.0f} s")
    return Statement(
        f"The largest that {MACHINE_GB:g} GB hold, one knob at a time, as measured: {'; '.join(parts)}.", met
    )


def _of_refusal(what: str, answer: dict[str, Any]) -> Statement:
    """Whether what does not fit was refused with its size, by a process that took next to nothing."""
    refused = "exit" not in answer and _is_refusal(answer["failure"]) and answer["bytes"] < 100e6
    if refused:
        return Statement(
            f"Beyond the limit, {what}: refused after {answer['bytes'] / 1e6:.0f} MB: “{answer['failure']}”.", True
        )
    how = f"the process died with {answer['exit']}" if "exit" in answer else answer["failure"] or "it was done"
    return Statement(f"Beyond the limit, {what}: NOT refused; {how}.", False)


def _is_refusal(failure: str) -> bool:
    """Whether `require_memory` said this."""
    return " of memory and " in failure


def _left_out(*, quick: bool, full: bool) -> tuple[Omission, ...]:
    left = []
    if not full:
        left.append(
            Omission(f"runs that fill {MACHINE_GB:g} GB", "half an hour, with --full; foretold by the laws here")
        )
    if quick:
        left.append(Omission("views, solver and Mitsuba", "left to the run without --quick"))
    return tuple(left)
