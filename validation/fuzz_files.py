"""Can a hostile file crash wallmirror, hang it, eat the memory, or put a wrong pixel into a result unnoticed?

    python validation/fuzz_files.py [--seconds 500] [--workers 2] [--out validation/results]

Makes EXR files, capture sets, scenes, pictures, truths, MATLAB files and tables of BRDFs hostile (bytes flipped, lost,
spliced; headers, tables, tags, fields and checksums changed one by one), and hands each to its public reader in a
process of its own with a limit of memory and of time. An input is refused well if the reader raises an InputError that
names the file in one short sentence. It is accepted well if what comes out is what the sound file held, or what the
damaged one holds by an independent reading: a decoder written from EXR's specification, the standard library's TOML
and JSON, SciPy's loadmat, and plain Python for tables. Compressed EXR pixels that this decoder cannot unpack and that
no checksum protects are counted as unjudged. Anything else is a fault. Inputs follow from their number alone.

A run that --seconds cut short goes on where it stopped when started again. Leaves fuzz_files.json, and leaves with 1 if
there is a fault, 3 if inputs remain.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import queue
import resource
import selectors
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import fuzz_exr
import fuzz_mat
import fuzz_tables
import fuzz_toml

from wallmirror import load_scene, read_captures, read_truth
from wallmirror.captures.recorded import read_recorded_run
from wallmirror.errors import InputError
from wallmirror.exr import read_exr
from wallmirror.files import write_atomically
from wallmirror.picture_reading import load_picture

#: How many inputs of each kind the recorded run tries.
INPUTS = {
    "exr": 12_000,
    "captures": 4_000,
    "scene": 3_000,
    "picture": 1_500,
    "truth": 1_500,
    "mat": 3_000,
    "table": 3_000,
}
GOOD = ("refused", "same", "another", "unjudged")
#: What one input may take: seconds, and bytes on top of what the process has before it.
SECONDS, MEMORY = 20.0, 2**30
_LONGEST_SENTENCE = 700


# -- one input --------------------------------------------------------------------------------------------------


def try_input(kind: str, number: int, folder: Path) -> tuple[str, str, str]:
    """Make an input, read it, and judge the reading: (outcome, what was done to the file, detail)."""
    if kind == "exr":
        path = folder / "input.exr"
        exr_sound, mutation, content = fuzz_exr.hostile(number)
        return judged(path, mutation, content, read_exr, lambda im: fuzz_exr.verdict(exr_sound, content, im.channels))
    if kind == "mat":
        path = folder / "input.mat"
        mat_sound, mutation, content = fuzz_mat.hostile(number)
        return judged(path, mutation, content, read_recorded_run, lambda r: fuzz_mat.verdict(mat_sound, content, r))
    if kind == "table":
        suffix, mutation, content = fuzz_tables.hostile(number)
        path = fuzz_tables.lay_out(folder, suffix, content)
        return judged(
            path, mutation, path.read_bytes(), load_scene,
            lambda scene: "another" if fuzz_tables.judge(suffix, content, scene) else "silent",
        )  # fmt: skip
    if kind == "truth":
        mutation, content = fuzz_toml.hostile_truth(number)
        (folder / "truth").mkdir(exist_ok=True)
        path = folder / "truth" / "truth.json"
        return judged(
            path, mutation, content, lambda p: read_truth(p.parent),
            lambda truth: "another" if fuzz_toml.judge_truth(content, truth) else "silent",
        )  # fmt: skip
    mutation, content = fuzz_toml.hostile(kind, number)
    if kind == "captures":
        home = folder / "set"
        if not home.is_dir():
            home.mkdir()
            fuzz_toml.lay_out(home)
        return judged(
            home / "captures.toml", mutation, content, lambda p: read_captures(p.parent),
            lambda read: "another" if fuzz_toml.judge_captures(content, read) else "silent",
        )  # fmt: skip
    load: Callable[[Path], Any] = load_scene if kind == "scene" else load_picture
    judge: Callable[[bytes, Any], bool] = fuzz_toml.judge_scene if kind == "scene" else fuzz_toml.judge_picture
    path = folder / f"{kind}.toml"
    return judged(path, mutation, content, load, lambda read: "another" if judge(content, read) else "silent")


def judged(
    path: Path, mutation: str, content: bytes, read: Callable[[Path], Any], judge: Callable[[Any], str]
) -> tuple[str, str, str]:
    path.write_bytes(content)
    _forget_peak()
    try:
        result = read(path)
    except InputError as error:
        sentence = str(error)
        if error.file != str(path) or not sentence.isprintable() or len(sentence) > _LONGEST_SENTENCE:
            return "unclear", mutation, sentence[:300]
        return "refused", mutation, ""
    except MemoryError:
        return "memory", mutation, "MemoryError"
    except Exception as error:  # noqa: BLE001  # any other error is what this script looks for
        return "traceback", mutation, f"{type(error).__name__}: {error}"[:300]
    return judge(result), mutation, ""


def _forget_peak() -> None:
    """Start the count of peak memory anew, so that it tells of the reader and not of making its input."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """Largest resident memory of this process since the last `_forget_peak`."""
    try:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


# -- processes --------------------------------------------------------------------------------------------------


def work() -> None:
    """A worker: reads "kind number" lines, answers each with a line of JSON."""
    fuzz_exr.corpus(), fuzz_mat.corpus()
    with tempfile.TemporaryDirectory() as folder:
        # Once without a limit, so that what is loaded late is there.
        for kind in INPUTS:
            try_input(kind, 0, Path(folder))
        try:
            taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        except OSError:
            taken = 2**32
        resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        for line in sys.stdin:
            kind, number = line.split()
            started = time.monotonic()
            outcome, mutation, detail = try_input(kind, int(number), Path(folder))
            answer = [outcome, mutation, detail, round(time.monotonic() - started, 3), peak_bytes()]
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


class Worker:
    """A process that tries inputs one by one; a new one takes its place when it dies or is silent for too long."""

    def __init__(self, command: list[str], *, seconds: float = SECONDS) -> None:
        self._command = command
        self._seconds = seconds
        self._process: subprocess.Popen[str] | None = None

    def __call__(self, kind: str, number: int) -> dict[str, Any]:
        """The outcome of one input, with its time and peak memory."""
        process = self._running()
        assert process.stdin is not None
        process.stdin.write(f"{kind} {number}\n")
        process.stdin.flush()
        row: dict[str, Any] = {"kind": kind, "number": number}
        line = self._line(self._seconds)
        if line:
            outcome, mutation, detail, seconds, peak = json.loads(line)
            return {**row, "outcome": outcome, "mutation": mutation, "detail": detail, "seconds": seconds, "peak": peak}
        hung = process.poll() is None and line is None
        self.close()
        outcome = "hang" if hung else "crash"
        detail = f"no answer in {self._seconds:g} s" if hung else f"exit code {process.returncode}"
        return {**row, "outcome": outcome, "mutation": "", "detail": detail, "seconds": self._seconds, "peak": 0}

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            if self._line(300.0) != "ready\n":
                raise RuntimeError(f"{self._command} does not start")
        return self._process

    def _line(self, seconds: float) -> str | None:
        """A line of the worker; empty at its end, None where it is silent. Lines come one at a time, so none is buffered."""
        assert self._process is not None
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            return self._process.stdout.readline() if selector.select(seconds) else None

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            self._process.stdin.close()
            self._process.stdout.close()
            self._process = None


def run(todo: list[tuple[str, int]], keep: Callable[[dict[str, Any]], None], *, workers: int, until: float) -> None:
    """Try inputs in several processes until all are done or the time is up."""
    waiting: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
    for item in todo:
        waiting.put(item)
    lock = threading.Lock()

    def serve() -> None:
        worker = Worker([sys.executable, "-W", "ignore", str(Path(__file__).resolve()), "--work"])
        try:
            while time.monotonic() < until:
                try:
                    item = waiting.get_nowait()
                except queue.Empty:
                    return
                row = worker(*item)
                with lock:
                    keep(row)
        finally:
            worker.close()

    threads = [threading.Thread(target=serve) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


# -- the record -------------------------------------------------------------------------------------------------


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts by kind and outcome, the faults one by one, and the extremes of time and memory."""
    faults = [row for row in rows if row["outcome"] not in GOOD]
    outcomes = {kind: dict(Counter(r["outcome"] for r in rows if r["kind"] == kind).most_common()) for kind in INPUTS}
    mutations = {
        kind: dict(Counter(r["mutation"].split("+")[0] for r in rows if r["kind"] == kind).most_common())
        for kind in INPUTS
    }
    counts = Counter(row["outcome"] for row in rows)
    return {
        "inputs": len(rows),
        "crashes": counts["crash"],
        "hangs": counts["hang"],
        "silently_wrong": counts["silent"],
        "other_faults": len(faults) - counts["crash"] - counts["hang"] - counts["silent"],
        "peak_bytes": max((row["peak"] for row in rows), default=0),
        "slowest_seconds": max((row["seconds"] for row in rows), default=0.0),
        "outcomes": outcomes,
        "mutations": mutations,
        "faults": faults[:100],
        "limits": {"seconds": SECONDS, "bytes": MEMORY},
        "versions": {"python": platform.python_version(), **{n: version(n) for n in ("OpenEXR", "numpy", "scipy")}},
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--state", type=Path, default=Path("out/fuzz_files.jsonl"), help="what is done already")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this long")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work()
        return 0
    arguments.state.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in arguments.state.read_text().splitlines()] if arguments.state.exists() else []
    done = {(row["kind"], row["number"]) for row in rows}
    todo = [(kind, n) for kind, count in INPUTS.items() for n in range(count) if (kind, n) not in done]
    with arguments.state.open("a") as state:

        def keep(row: dict[str, Any]) -> None:
            rows.append(row)
            state.write(json.dumps(row) + "\n")
            if row["outcome"] not in GOOD:
                print(f"FAULT {row}", flush=True)

        run(todo, keep, workers=arguments.workers, until=time.monotonic() + arguments.seconds)
    result = summary(rows)
    print(json.dumps({k: v for k, v in result.items() if k not in ("faults", "mutations")}, indent=1))
    if len(rows) < sum(INPUTS.values()):
        print(f"{sum(INPUTS.values()) - len(rows)} inputs remain; start again to go on")
        return 3
    write_atomically(arguments.out / "fuzz_files.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    passed = not result["faults"] and result["peak_bytes"] < 1e9
    print("PASSED" if passed else "FAILED")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
