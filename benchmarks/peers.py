"""Other ways to solve the same problem: error of pattern and BRDF against seconds, all on the same data in one run.

    python benchmarks/peers.py [--quick | --page] [--out FOLDER]

The thesis's defaults (N 500, A 20, B 20, M 4, four lobes of sigma 1 deg, its weight 1), without noise and with noise
40 and 20 dB below the rms radiance, and one physical scene small enough for a differentiable path tracer. Peers: the
thesis's algorithm, alternating least squares, non-negative matrix factorisation (scikit-learn), L-BFGS-B, gradient
descent through Mitsuba; beside them the Cramer-Rao bound and whoever knows the BRDF. Each run has one thread and a
limit of seconds, each method several random starts, all of which are kept.

Leaves results/peers.json, figures/peers.png and the page PEERS.md in the folder (this one; with --quick, out/peers).
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from peer_methods import (
    NEARLY_EXACT,
    Bilinear,
    Recorder,
    alternate,
    descend,
    factor_errors,
    factorise,
    permuted_errors,
    record,
    structured_errors,
    thesis,
)
from peers_page import figure, page
from threadpoolctl import threadpool_limits

from wallmirror import (
    CaptureSet,
    Card,
    GaussianTrain,
    Observer,
    Scene,
    load_scene,
    radiance,
    scale_free_error,
    scan_angles,
    solve,
    transport_matrix,
)
from wallmirror.derendering.foresight import foresee
from wallmirror.errors import UndeterminedError
from wallmirror.files import write_atomically

Array = np.ndarray
Judge = Callable[[Array, Array, tuple[Array, Array]], tuple[float, float]]

#: Random truths and noises; random starts of each method on each; seconds of a run, and of the first of each method;
#: seconds and number of the renderer's runs.
FULL: dict[str, Any] = {
    "seeds": 3,
    "starts": 3,
    "budget": {"no noise": 3.0, "40 dB": 1.5, "20 dB": 1.5, "40 dB, rendered": 1.5},
    "patience": 5.0,
    "rendering": 40.0,
    "renders": 2,
}
QUICK: dict[str, Any] = {
    "seeds": 1,
    "starts": 1,
    "budget": dict.fromkeys(FULL["budget"], 1.0),
    "patience": 1.0,
    "rendering": 10.0,
    "renders": 1,
}
LEVELS = (None, 40, 20)
#: Knots in degrees and degree of the splines that structured peers are given: those on which ours ends by itself, but for
#: the alternation without noise, which would take seconds a step on knots as fine as that.
NOISELESS_KNOTS, ALTERNATION_KNOTS, NOISELESS_DEGREE = 0.125, 0.25, 7
NOISY_KNOTS, NOISY_DEGREE = 0.5, 3
#: The thesis's alpha is 0.1 in its analysis and 10 in its single run; the best of its own grid is 4.64.
ALPHA, CAPS = 4.64, (1, 3, 10, 30, 100, 300)
SMALL_PIXELS = 100
RENDER_NODES, RENDER_SPP, RENDER_RATE = 1441, 8, 0.2


@dataclass(frozen=True)
class Instance:
    """Films of one truth, and what can be known about them beforehand."""

    captures: CaptureSet
    truth: tuple[Array, Array]  # V (M, B), F (A N, M)
    decibels: int | None
    lines: dict[str, float]


def thesis_scene() -> tuple[Observer, Card]:
    """Table 4.3 of the thesis."""
    fov = math.radians(60)
    views = scan_angles(20, scan=math.radians(90), fov=fov)
    observer = Observer(position=(0.0, -5.0), fov=fov, view_angles=views, pixels=500, pixels_at="edges")
    return observer, Card(elements_x=tuple(map(float, np.linspace(-2.5, 2.5, 4))), y=-1.0)


def small_scene() -> Scene:
    """The shipped scene of four lobes with fewer pixels, as the path tracer is to see it."""
    scene = load_scene("flat_wall_lobes")
    return replace(scene, observer=replace(scene.observer, pixels=SMALL_PIXELS))


def film(observer: Observer, card: Card, weights: Any, decibels: int | None, seed: int) -> Instance:
    """A random V in [0, 1], its films and their noise; equal seeds have equal V and, scaled, equal noise."""
    rng = np.random.default_rng(seed)
    brdf = GaussianTrain.of_the_code()
    source = rng.random((card.elements, 20))
    transport = transport_matrix(observer, card, brdf, weights=weights)
    clean = radiance(transport, source)
    noise = 0.0 if decibels is None else math.sqrt(np.mean(clean**2)) * 10 ** (-decibels / 20)
    films = clean + noise * rng.standard_normal(clean.shape)
    flat = transport.reshape(-1, card.elements)
    known = np.linalg.lstsq(flat, films.reshape(len(flat), -1), rcond=None)[0]
    lines = {"oracle": scale_free_error(known, source), "guess": scale_free_error(np.ones_like(source), source)}
    if noise > 0:
        bound = foresee(observer, card, brdf, source, noise=noise, weights=weights, step_deg=NOISY_KNOTS)
        lines |= {"bound": bound.source_error, "bound_transport": bound.transport_error}
    captures = CaptureSet(observer=observer, card=card, transport=weights, radiance=films)
    return Instance(captures, (source, flat), decibels, lines)


def reference_seconds() -> float:
    """Median wall time of the QR factorisation of a 10,000 x 20 matrix."""
    matrix = np.random.default_rng(0).standard_normal((10_000, 20))
    seconds = []
    for _ in range(9):
        started = time.perf_counter()
        np.linalg.qr(matrix)
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))


class Study:
    """All runs of one panel."""

    def __init__(self, panel: str, settings: dict[str, Any]) -> None:
        self.panel, self.settings = panel, settings
        self.runs: list[dict[str, Any]] = []

    def run(
        self,
        method: str,
        instance: Instance,
        seed: int,
        start: int,
        work: Callable[[Recorder], str],
        *,
        judge: Judge = structured_errors,
        budget: float | None = None,
        offset: float = 0.0,
    ) -> None:
        """One run of one method, with its trace; a refusal is a result too."""
        first = seed == start == 0
        limit = budget or (self.settings["patience"] if first else self.settings["budget"][self.panel])
        recorder = Recorder(lambda v, f: judge(v, f, instance.truth), budget=limit, offset=offset)
        started, began = time.perf_counter(), time.process_time()
        try:
            ended = record(recorder, work)
        except UndeterminedError as error:
            ended = f"refused: {error}"
        self.runs.append(
            {
                "panel": self.panel,
                "method": method,
                "seed": seed,
                "start": start,
                "ended": ended,
                "iterations": recorder.iterations,
                "residual": None if recorder.residual is None else rounded(recorder.residual),
                # Of the whole run, judging included: how much of the time the processor was ours.
                "seconds": rounded(time.perf_counter() - started),
                "processor_seconds": rounded(time.process_time() - began),
                "trace": [[rounded(x) for x in point] for point in recorder.points],
            }
        )

    def ours(self, instance: Instance, seed: int, start: int) -> None:
        """The closed form and maximum likelihood, and the method that `solve` chooses told the knots."""
        exact = instance.decibels is None
        step = NOISELESS_KNOTS if exact else NOISY_KNOTS
        variants: dict[str, dict[str, Any]] = {
            "ours: closed form": {"method": "closed_form"},
            **({} if exact else {"ours: likelihood": {"method": "maximum_likelihood"}}),
            "ours: knots given": {"method": "closed_form" if exact else "maximum_likelihood", "step_deg": step},
        }
        for method, options in variants.items():

            def work(recorder: Recorder, options: dict[str, Any] = options) -> str:
                found = solve(instance.captures, **options)
                recorder(found.source, lambda: found.transport.reshape(instance.truth[1].shape))
                return f"{found.method}, knots every {found.step_deg:.4g} deg, {found.verdict}"

            self.run(method, instance, seed, start, work, budget=math.inf)

    def structured(self, instance: Instance, seed: int) -> None:
        """Peers that know D = [T_1 r .. T_M r] V."""
        exact = instance.decibels is None
        degree = NOISELESS_DEGREE if exact else NOISY_DEGREE
        fine = Bilinear.of(instance.captures, step_deg=NOISELESS_KNOTS if exact else NOISY_KNOTS, degree=degree)
        coarse = Bilinear.of(instance.captures, step_deg=ALTERNATION_KNOTS, degree=degree) if exact else fine
        for start in range(self.settings["starts"]):
            for nonnegative in (False, True):
                name = ", >= 0" if nonnegative else ""
                rng = [np.random.default_rng(start_seed(seed, start)) for _ in range(2)]
                self.run(
                    f"ALS{name}",
                    instance,
                    seed,
                    start,
                    lambda r, k=nonnegative, g=rng[0]: alternate(coarse, g, r, nonnegative=k),
                    offset=coarse.preparation,
                )
                self.run(
                    f"L-BFGS{name}",
                    instance,
                    seed,
                    start,
                    lambda r, k=nonnegative, g=rng[1]: descend(fine, g, r, nonnegative=k),
                    offset=fine.preparation,
                )

    def unstructured(self, instance: Instance, seed: int, *, nmf: bool) -> None:
        """Peers that look for F itself."""
        films = instance.captures
        for start in range(self.settings["starts"]):
            self.run(
                "thesis",
                instance,
                seed,
                start,
                lambda r, s=start: thesis(films, start_seed(seed, s), r, alpha=ALPHA, caps=CAPS),
                judge=permuted_errors,
            )
            if nmf:
                self.run(
                    "NMF",
                    instance,
                    seed,
                    start,
                    lambda r, s=start: factorise(films, start_seed(seed, s), r),
                    judge=factor_errors,
                )

    def rendering(self, scene: Scene, instance: Instance) -> None:
        """The peer that renders."""
        from peer_renderer import descend_by_rendering

        budget = self.settings["rendering"]
        for start in range(self.settings["renders"]):
            self.run(
                "Mitsuba, Adam",
                instance,
                0,
                start,
                lambda r, s=start: descend_by_rendering(
                    scene,
                    instance.captures,
                    np.random.default_rng(start_seed(0, s)),
                    r,
                    nodes=RENDER_NODES,
                    spp=RENDER_SPP,
                    rate=RENDER_RATE,
                ),
                budget=budget,
            )


def start_seed(seed: int, start: int) -> int:
    """Far from the seeds of the truths: an equal seed would begin with the true V itself."""
    return 1_000_003 + 1000 * seed + start


def rounded(value: float) -> float:
    """Four digits: a trace says no more."""
    return float(f"{value:.4g}")


def warm_up(nmf: bool) -> None:
    """What a method does for the first time only (imports, first calls of LAPACK) belongs to none of them."""
    quick = Study("40 dB", {**QUICK, "patience": 0.05})
    observer, card = thesis_scene()
    instance = film(replace(observer, pixels=60), card, "thesis", 40, 0)
    quick.ours(instance, 0, 0)
    quick.structured(instance, 0)
    quick.unstructured(instance, 0, nmf=nmf)


def measure(settings: dict[str, Any], nmf: bool) -> dict[str, Any]:
    """All panels; the reference workload is timed before, between and after them."""
    began = time.perf_counter()
    load = [os.getloadavg()]
    warm_up(nmf)
    reference = [reference_seconds()]
    runs: list[dict[str, Any]] = []
    lines: dict[str, list[dict[str, float]]] = {}

    def done(study: Study, instances: list[Instance]) -> None:
        runs.extend(study.runs)
        lines[study.panel] = [{k: rounded(v) for k, v in instance.lines.items()} for instance in instances]
        reference.append(reference_seconds())
        load.append(os.getloadavg())
        print(f"{study.panel}: {len(study.runs)} runs, {time.perf_counter() - began:.0f} s so far", flush=True)

    for level in LEVELS:
        study = Study("no noise" if level is None else f"{level} dB", settings)
        instances = [film(*thesis_scene(), "thesis", level, seed) for seed in range(settings["seeds"])]
        for seed, instance in enumerate(instances):
            for start in range(settings["starts"]):
                study.ours(instance, seed, start)
            study.structured(instance, seed)
            study.unstructured(instance, seed, nmf=nmf)
        done(study, instances)
    study = Study("40 dB, rendered", settings)
    scene = small_scene()
    small = film(scene.observer, scene.card, "physical", 40, 0)
    for start in range(settings["starts"]):
        study.ours(small, 0, start)
    study.structured(small, 0)
    # Last: Dr.Jit's thread pool is none of the others' business.
    study.rendering(scene, small)
    done(study, [small])
    return {
        "settings": settings,
        "given": {
            "noiseless_knots_deg": NOISELESS_KNOTS,
            "alternation_knots_deg": ALTERNATION_KNOTS,
            "noiseless_degree": NOISELESS_DEGREE,
            "noisy_knots_deg": NOISY_KNOTS,
            "noisy_degree": NOISY_DEGREE,
            "residual_below": NEARLY_EXACT,
            "alpha": ALPHA,
            "render_pixels": SMALL_PIXELS,
            "render_nodes": RENDER_NODES,
            "render_spp": RENDER_SPP,
            "render_rate": RENDER_RATE,
        },
        "nmf": nmf,
        "reference_seconds": [rounded(s) for s in reference],
        "load": [[rounded(x) for x in loads] for loads in load],
        "cores": os.cpu_count(),
        "versions": versions(),
        "seconds": rounded(time.perf_counter() - began),
        "lines": lines,
        "runs": runs,
    }


def versions() -> dict[str, str]:
    """What the figures were measured with."""
    names = ["numpy", "scipy", "scikit-learn", "mitsuba", "drjit"]
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def document_text(document: dict[str, Any]) -> str:
    """JSON with one line for each run."""
    head = json.dumps({k: v for k, v in document.items() if k != "runs"}, indent=1, allow_nan=False)
    runs = ",\n  ".join(json.dumps(run, allow_nan=False) for run in document["runs"])
    return f'{head[:-2]},\n "runs": [\n  {runs}\n ]\n}}\n'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one truth, one start, a second for each run")
    parser.add_argument("--page", action="store_true", help="only rewrite page and figure from the results there")
    parser.add_argument("--out", type=Path, help="folder to write to")
    arguments = parser.parse_args()
    out = arguments.out or (Path("out/peers") if arguments.quick else Path(__file__).parent)
    if arguments.page:
        document = json.loads((out / "results" / "peers.json").read_text())
    else:
        nmf = importlib.util.find_spec("sklearn") is not None
        if not nmf:
            print(
                "scikit-learn is missing, so its matrix factorisation is left out; pip install -e '.[bench]' adds it.",
                file=sys.stderr,
            )
        with threadpool_limits(limits=1):
            document = measure(QUICK if arguments.quick else FULL, nmf)
        write_atomically(out / "results" / "peers.json", document_text(document))
    text = page(document)
    write_atomically(out / "PEERS.md", text)
    write_atomically(out / "figures" / "peers.png", figure(document))
    if not arguments.page:
        print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
