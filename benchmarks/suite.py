"""Has a change made wallmirror slower, or hungrier? Times as ratios to a fixed workload of the same run, and peak memory.

    python benchmarks/suite.py [CASE ...] [-o RESULT.json]
    python benchmarks/suite.py --against RESULT.json        a result of an earlier commit, of the same machine
    python benchmarks/suite.py --against ../before/src      the sources of another commit, run in turns with these

See COMPARING.md. Nothing here knows how many seconds anything should take: machines differ, and so does their load.
"""

from __future__ import annotations

import argparse
import atexit
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

Work = Callable[[], object]

ROUNDS = 7
LEAST = 0.05  # seconds of one measurement; quick calls are repeated within it
SLOWER, HUNGRIER = 1.25, 1.25  # factors from which a change is told


# -- the cases: each makes what it needs and returns the call that is measured ----------------------------------------


def _thesis(*, physical: bool = False, pixels: int = 500) -> Any:
    from wallmirror import Card, GaussianTrain, Observer, scan_angles

    fov, width = math.radians(60), 0.02 if physical else 0.0
    observer = Observer(
        position=(0.0, -5.0),
        fov=fov,
        view_angles=scan_angles(20, scan=math.radians(90), fov=fov),
        pixels=pixels,
        pixels_at="centres" if physical else "edges",
    )
    card = Card(
        elements_x=tuple(map(float, np.linspace(-2.5, 2.5, 4))), y=-1.0, element_width=width, element_height=width
    )
    return observer, card, GaussianTrain.of_the_code()


def _captures(realisations: int = 20, decibels: float = math.inf) -> Any:
    from wallmirror import CaptureSet, radiance, transport_matrix

    observer, card, brdf = _thesis()
    rng = np.random.default_rng(0)
    films = radiance(transport_matrix(observer, card, brdf, weights="cosine"), rng.random((4, realisations)))
    if math.isinf(decibels):
        return CaptureSet(observer=observer, card=card, transport="cosine", radiance=films)
    sigma = float(np.sqrt(np.mean(films**2))) * 10 ** (-decibels / 20)
    noisy = films + sigma * rng.standard_normal(films.shape)
    variance = np.full(films.shape, sigma**2)
    return CaptureSet(observer=observer, card=card, transport="cosine", radiance=noisy, variance=variance)


def physical_transport() -> Work:
    from wallmirror import transport_matrix

    parts = _thesis(physical=True)
    return lambda: transport_matrix(*parts, tolerance=1e-6)


def algorithm_1() -> Work:
    from wallmirror import transport_matrix

    parts = _thesis()
    return lambda: transport_matrix(*parts, weights="thesis")


def spline_designs() -> Work:
    from wallmirror.derendering.preparing import prepare

    problem, _ = prepare(_captures())
    return lambda: problem.designs(0.25, degree=3, tolerance=1e-6)


def closed_form() -> Work:
    from wallmirror import solve

    captures = _captures()
    return lambda: solve(captures, method="closed_form")


def maximum_likelihood() -> Work:
    from wallmirror import solve

    captures = _captures(decibels=20)
    return lambda: solve(captures)


def few_captures() -> Work:
    from wallmirror import solve

    captures = _captures(realisations=3)
    return lambda: solve(captures)


def photon_counts() -> Work:
    from wallmirror import CaptureSet, solve

    films = _captures()
    counts = np.random.default_rng(1).poisson(1000 * films.radiance + 1)
    captures = CaptureSet(observer=films.observer, card=films.card, transport="cosine", radiance=(counts - 1) / 1000)
    return lambda: solve(captures, method="poisson", counts_per_radiance=1000.0, background=1.0, step_deg=1.0)


def bound() -> Work:
    from wallmirror import foresee

    observer, card, brdf = _thesis(physical=True, pixels=200)
    source = np.random.default_rng(0).random((4, 20))
    return lambda: foresee(observer, card, brdf, source, noise=0.01)


def thesis_alternation() -> Work:
    from wallmirror.derendering.unstructured import de_render_unstructured

    captures = _captures(decibels=40)
    return lambda: de_render_unstructured(captures, cap=10, tolerance=0.0)


def capture_set_on_disk() -> Work:
    from wallmirror import read_captures, write_captures

    captures = _captures(realisations=4)
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)

    def there_and_back() -> object:
        write_captures(Path(folder) / "set", captures)
        return read_captures(Path(folder) / "set")

    return there_and_back


def path_traced_view() -> Work:
    from wallmirror import load_scene
    from wallmirror.pathtracing.rendering import Renderer

    scene = load_scene("flat_wall_lobes")
    renderer = Renderer(replace(scene, render=replace(scene.render, spp=256)))
    return lambda: renderer.render(0, scene.source[:, 0])


CASES: dict[str, Callable[[], Work]] = {
    case.__name__: case
    for case in (
        physical_transport, algorithm_1, spline_designs, closed_form, maximum_likelihood, few_captures, photon_counts,
        bound, thesis_alternation, capture_set_on_disk, path_traced_view,
    )
}  # fmt: skip


# -- measuring --------------------------------------------------------------------------------------------------------


def reference() -> Work:
    """The fixed workload: transcendental functions, sorting, and small dense algebra, as the library mixes them."""
    numbers = np.random.default_rng(0).standard_normal(200_000)
    return lambda: (np.sin(numbers), np.exp(-(numbers**2)), np.sort(numbers), np.linalg.qr(numbers.reshape(10_000, 20)))


def seconds(work: Work, times: int) -> float:
    """Processor seconds of a call, the mean of several."""
    started = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - started) / times


def peak(work: Work) -> int:
    """Bytes that Python and NumPy held at most during a call; what Mitsuba holds is not seen."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def measure(names: list[str], rounds: int) -> dict[str, dict[str, Any]]:
    """For each case the ratios to the workload, round by round in pairs, and the peak; or why there is none."""
    yardstick = reference()
    yardstick()
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        try:
            work = CASES[name]()
            work()  # what is done for the first time only
            once = seconds(work, 1)
        except Exception as error:  # noqa: BLE001  an older commit may lack what a case needs
            found[name] = {"absent": f"{type(error).__name__}: {error}"}
            continue
        times = max(1, round(LEAST / max(once, 1e-6)))
        beside = max(1, round(LEAST / seconds(yardstick, 1)))
        ratios = [seconds(work, times) / seconds(yardstick, beside) for _ in range(rounds)]
        found[name] = {"ratios": [float(f"{r:.4g}") for r in ratios], "peak": peak(work)}
    return found


def in_process(source: Path, names: list[str], rounds: int) -> dict[str, dict[str, Any]]:
    """`measure` over the sources of another commit, with this very script, in a process of its own."""
    script = Path(__file__).resolve()
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        command = [sys.executable, str(script), *names, "--rounds", str(rounds), "-o", str(result)]
        environment = {**os.environ, "PYTHONPATH": str(source.resolve())}
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        document: dict[str, Any] = json.loads(result.read_text())
    cases: dict[str, dict[str, Any]] = document["cases"]
    return cases


def in_turns(sources: tuple[Path, Path], names: list[str], rounds: int) -> list[dict[str, dict[str, Any]]]:
    """Both commits, round after round in turns, so that a machine that slows down slows both."""
    both: list[dict[str, dict[str, Any]]] = [{}, {}]
    for turn in range(rounds):
        for side, source in enumerate(sources):
            for name, case in in_process(source, names, 2).items():
                mine = both[side].setdefault(name, case)
                if turn and "ratios" in mine and "ratios" in case:
                    mine["ratios"] += case["ratios"]
    return both


# -- comparing --------------------------------------------------------------------------------------------------------


def spread(ratios: list[float]) -> tuple[float, float]:
    """Median, and the distance of the quartiles over it."""
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    return float(middle), float((high - low) / middle)


def compare(before: dict[str, dict[str, Any]], after: dict[str, dict[str, Any]]) -> tuple[list[list[str]], bool]:
    """A row for each case, and whether none became slower or hungrier beyond the thresholds and its own scatter."""
    rows, good = [], True
    for name, new in after.items():
        old = before.get(name, {"absent": "not in the other result"})
        if "absent" in new or "absent" in old:
            rows.append([name, "-", "-", "-", "-", str(new.get("absent") or old.get("absent"))])
            continue
        (was, was_doubt), (is_now, is_doubt) = spread(old["ratios"]), spread(new["ratios"])
        factor, doubt = is_now / was, math.hypot(was_doubt, is_doubt)
        memory = new["peak"] / max(1, old["peak"])
        changed = abs(math.log(factor)) > max(math.log(SLOWER), 2 * doubt)
        slower, hungrier = changed and factor > 1, memory > HUNGRIER
        good &= not (slower or hungrier)
        verdict = " and ".join(w for w, true in (("SLOWER", slower), ("HUNGRIER", hungrier)) if true)
        rows.append(
            [
                name,
                f"{was:.3g}",
                f"{is_now:.3g}",
                f"{factor:.2f} ± {100 * doubt:.0f} %",
                f"{memory:.2f}",
                verdict or ("quicker" if changed else "alike"),
            ]
        )
    return rows, good


def print_table(columns: list[str], rows: list[list[str]]) -> None:
    widths = [max(len(row[i]) for row in [columns, *rows]) for i in range(len(columns))]
    for row in [columns, *rows]:
        sys.stdout.write("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"all if left out: {', '.join(CASES)}")
    parser.add_argument("-o", "--out", type=Path, help="where to leave the result as JSON")
    parser.add_argument("--against", type=Path, help="an earlier RESULT.json, or the src folder of another commit")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    arguments = parser.parse_args()
    names = arguments.cases or list(CASES)
    if unknown := sorted(set(names) - set(CASES)):
        parser.error(f"no case is called {', '.join(unknown)}; choose among {', '.join(CASES)}")
    before: dict[str, dict[str, Any]] | None = None
    if arguments.against is not None and arguments.against.is_dir():
        import wallmirror

        here = Path(wallmirror.__file__).parent.parent
        before, cases = in_turns((arguments.against, here), names, max(2, arguments.rounds // 2))
    else:
        cases = measure(names, arguments.rounds)
        if arguments.against is not None:
            before = json.loads(arguments.against.read_text())["cases"]
    if arguments.out is not None:
        load = list(os.getloadavg()) if hasattr(os, "getloadavg") else []
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"load": load, "cases": cases}, indent=1) + "\n")
    if before is not None:
        rows, good = compare(before, cases)
        print_table(["case", "before", "now", "now / before", "memory", ""], rows)
        return 0 if good else 1
    rows = []
    for name, case in cases.items():
        if "absent" in case:
            rows.append([name, "-", "-", case["absent"]])
        else:
            middle, doubt = spread(case["ratios"])
            rows.append([name, f"{middle:.3g} ± {100 * doubt:.0f} %", f"{case['peak'] / 1e6:.1f}", ""])
    print_table(["case", "over the workload", "peak MB", ""], rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
