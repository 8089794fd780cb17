"""How long a call takes: processor time of all threads, beside the wall clock, and a fixed workload to compare machines by."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True)
class Timing:
    """Median seconds of a call: on the processor, all threads together, and on the wall clock."""

    seconds: float
    wall_seconds: float
    repeats: int


def timed(work: Callable[[], T], *, repeats: int = 3, at_least: float = 0.02, warm_up: bool = True) -> tuple[T, Timing]:
    """The call's value and its median time.

    Parameters
    ----------
    repeats:
        Measurements, of which the median counts.
    at_least:
        Seconds of one measurement; quick calls are repeated within it.
    warm_up:
        Call it once before, uncounted.
    """
    started = time.process_time()
    value = work()
    once = max(time.process_time() - started, 1e-7)
    if not warm_up and repeats == 1:
        return value, Timing(once, once, 1)
    inner = max(1, round(at_least / once))
    cpu, wall = [], []
    for _ in range(repeats):
        a, b = time.process_time(), time.perf_counter()
        for _ in range(inner):
            value = work()
        cpu.append((time.process_time() - a) / inner)
        wall.append((time.perf_counter() - b) / inner)
    return value, Timing(float(np.median(cpu)), float(np.median(wall)), repeats)


def once(work: Callable[[], T]) -> tuple[T, Timing]:
    """The call's value and the time of this one call, for what takes long or must not be repeated."""
    a, b = time.process_time(), time.perf_counter()
    value = work()
    return value, Timing(time.process_time() - a, time.perf_counter() - b, 1)


def reference_seconds() -> float:
    """Processor seconds of a fixed workload: sines of a million numbers and the QR factorisation of 10,000 x 20."""
    numbers = np.random.default_rng(0).standard_normal(1_000_000)
    return timed(lambda: (np.sin(numbers), np.linalg.qr(numbers[:200_000].reshape(10_000, 20))))[1].seconds


def machine() -> str:
    """The machine in words: processor, cores, memory and load."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123
            model = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), model)
    except OSError:
        pass
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{model}, {os.cpu_count()} cores{load}"
