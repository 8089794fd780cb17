"""Does `wallmirror advise` keep its promises? Its plans against expensive reference renders that it never saw.

    python validation/advice.py [--minutes 9] [--page] [--out FOLDER]

Every shipped scene and random variations of them (lobe width and places, distance, strips, albedo, with fixed seeds),
cut to 4 views of 96 pixels so that the references can be afforded, are planned for several tolerances. Then what was
planned is done: the wall is predicted by the planned route, films are rendered with the planned samples, the planned
validation is run, and the films are solved. The reference is a path tracer at all depths with a BRDF table 16 times
as fine, in two independent halves A and B, so that its own noise adds nothing to a measured error:

    error^2 = <film - A, film - B> / <A, B>.

Asked: is the tolerance kept in at least 95 % of the pairs, and is the error foretold within a factor of two? A plan that
needs more than LIMIT samples is only counted. Results are kept pair by pair: run again to go on where it stopped.

Leaves results/advice.json, figures/advice.png and the page ADVICE.md, and leaves with 1 unless the figures are reached.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wallmirror import (
    Card,
    Diffuse,
    GaussianTrain,
    Phong,
    Plan,
    Scene,
    Sum,
    UndeterminedError,
    Wall,
    load_scene,
    mirror_matrix,
    radiance,
    scale_free_error,
    scene_names,
    solve,
    tabulate,
)
from wallmirror.brdf import AngleSumBRDF, Mirror
from wallmirror.files import write_atomically
from wallmirror.interreflection import from_card
from wallmirror.jobs.advising import advise
from wallmirror.jobs.bouncing import DEEP, RR_DEPTH
from wallmirror.jobs.capturing import film_as_planned
from wallmirror.jobs.validating import validate_scene
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.pathtracing.rendering import Renderer, spread_seeds
from wallmirror.transport import build_kernel

TOLERANCES = (1e-1, 3e-2, 1e-2)
VARIATIONS = 14
VIEWS, PIXELS = 4, 96
#: Samples in all beyond which films are not made.
LIMIT = 40_000_000
#: Seeds of 1024 samples of each half of a reference, of one bounce and of all.
REFERENCE_SEEDS = (16, 8)
WITHIN, KEPT = 2.0, 0.95
#: Root seeds of plan, film, reference and validation: never shared.
PLAN_SEED, FILM_SEED, REFERENCE_SEED, VALIDATE_SEED = 11, 22_000, 33_000, 44_000


def cut(scene: Scene) -> Scene:
    """The scene with a few of its views and wider pixels."""
    angles = scene.observer.view_angles
    chosen = np.linspace(0, len(angles) - 1, VIEWS).round().astype(int)
    observer = replace(scene.observer, view_angles=tuple(angles[v] for v in chosen), pixels=PIXELS)
    return replace(scene, observer=observer)


def variation(index: int) -> Scene:
    """A random scene: walls of lobes, Phong or diffuse, strips and card of any size, a third of the cards white."""
    rng = np.random.default_rng([2024, index])

    def between(low: float, high: float) -> float:
        return float(math.exp(rng.uniform(math.log(low), math.log(high))))

    base = load_scene("flat_wall_lobes")
    sigma = math.radians(between(0.5, 8.0))
    centres = tuple(np.sort(rng.uniform(-40, 40, size=int(rng.integers(1, 5)))))
    lobes = GaussianTrain(centres=tuple(map(math.radians, centres)), sigma=sigma, scale=between(0.2, 1.0))
    coat = Diffuse(albedo=float(rng.uniform(0.1, 0.6)))
    walls = (lobes, Sum(parts=(lobes, coat)), Phong(exponent=between(5, 500), reflectance=0.5), coat)
    distance = between(0.3, 3.0)
    white = rng.random() < 0.4
    card = Card(
        elements_x=base.card.elements_x,
        y=-distance,
        element_width=between(0.01, 0.4),
        element_height=between(0.01, 1.0),
        albedo=float(rng.uniform(0.1, 0.8)) if white else 0.0,
        board_width=5.5 if white else 0.0,
        board_height=float(rng.uniform(1.0, 2.0)) if white else 0.0,
    )
    observer = replace(base.observer, position=(0.0, -between(3.5, 8.0)))
    wall = Wall(brdf=walls[index % 4], half_width=40.0, half_height=40.0)
    name = f"variation {index:02d}"
    return replace(base, name=name, title=name, about="", observer=observer, card=card, wall=wall)


def cases() -> dict[str, Scene]:
    """All scenes by name."""
    scenes = [cut(load_scene(name)) for name in scene_names()] + [cut(variation(i)) for i in range(VARIATIONS)]
    return {scene.name: scene for scene in scenes}


@dataclass(frozen=True)
class Reference:
    """Two independent renders of everything that reaches the camera and the variance of either, all (A, N, B)."""

    halves: np.ndarray
    variance: np.ndarray

    def measure(self, films: np.ndarray) -> dict[str, float]:
        """Relative L2 error of films, free of the reference's noise, and the error that noise could feign (3 sigma)."""
        a, b = self.halves
        square = (films - a) * (films - b)
        whole = float(np.sum(a * b))
        # Var sum (d - n_a)(d - n_b), with n_a, n_b of variance v: sum v^2 + 2 d^2 v.
        scatter = math.sqrt(float(np.sum(self.variance**2 + 2 * np.maximum(square, 0.0) * self.variance)))
        return {
            "measured": math.sqrt(max(0.0, float(square.sum())) / whole),
            "blur": math.sqrt(3 * scatter / whole),
        }


def reference(scene: Scene) -> Reference:
    """Render a scene at all depths, with a table of the BRDF far finer than any plan's."""
    brdf = scene.wall.brdf
    if isinstance(brdf, AngleSumBRDF) and not isinstance(brdf, Diffuse):
        nodes = 1 + 4 * (np.size(wall_as_rendered(scene).values) - 1)
        scene = replace(scene, wall=replace(scene.wall, brdf=tabulate(brdf, nodes)))
    renderer = Renderer(scene)
    views, patterns = scene.observer.views, scene.source.shape[1]
    depth, rr_depth = (2, 1000) if scene.is_one_bounce else (DEEP, RR_DEPTH)
    seeds = 2 * REFERENCE_SEEDS[0 if scene.is_one_bounce else 1]
    roots = spread_seeds(REFERENCE_SEED, views * patterns * seeds)
    halves = np.empty((2, views, PIXELS, patterns))
    variance = np.empty((views, PIXELS, patterns))
    for view in range(views):
        for b in range(patterns):
            first = (view * patterns + b) * seeds
            made = renderer.render(
                view,
                scene.source[:, b],
                spp=1024,
                seeds=roots[first : first + seeds],
                max_depth=depth,
                rr_depth=rr_depth,
                sampler="multijitter",
            )
            for half in range(2):
                halves[half, view, :, b] = made.per_seed[half::2].mean(axis=0)
            variance[view, :, b] = 2 * made.variance
    return Reference(halves, variance)


def predicted_wall(scene: Scene, plan: Plan) -> np.ndarray | None:
    """The wall's radiance by the planned analytic route; None where it is the path tracer's."""
    forward = plan.forward
    assert forward is not None
    q, brdf, card, area = forward.quadrature, scene.wall.brdf, scene.card, 1.0
    if forward.route == "path tracing":
        return None
    if isinstance(brdf, Mirror):
        return radiance(mirror_matrix(scene.observer, card, brdf), scene.source)
    if q.strips == "points":
        area = card.element_width * card.element_height
        card = replace(card, element_width=0.0, element_height=0.0)
    kernel = build_kernel(scene.observer, card, orders=(q.across_pixel, q.across_strip))
    films = area * radiance(kernel.apply(brdf), scene.source)
    if forward.route == "analytic with glow":
        films = films + from_card(scene.observer, scene.card, brdf, scene.source)
    return films


def keep_promise(scene: Scene, tolerance: float, truth: Reference) -> dict:
    """Plan one pair, do what was planned, and measure."""
    started, cpu = time.perf_counter(), time.process_time()
    plan = advise(scene, tolerance, seed=PLAN_SEED)
    row: dict = {
        "scene": scene.name,
        "tolerance": tolerance,
        "advise_seconds": time.perf_counter() - started,
        "advise_cpu_seconds": time.process_time() - cpu,
        "plan": {k: v for k, v in plan.summary().items() if k not in ("hypotheses", "error_is", "scene", "tolerance")},
    }
    wall = predicted_wall(scene, plan)
    if wall is not None:
        row["forward"] = {"predicted": plan.forward.error, **truth.measure(wall)}
    capture = plan.capture
    assert capture is not None
    samples = capture.films * PIXELS * capture.sampling.total
    if samples > LIMIT:
        row["skipped"] = f"{samples:.1e} samples"
        return row
    started = time.perf_counter()
    films = film_as_planned(scene, capture, seed=FILM_SEED + round(1 / tolerance))
    row["capture"] = {
        "predicted": capture.error,
        **truth.measure(films.radiance),
        "predicted_seconds": capture.seconds,
        "seconds": time.perf_counter() - started,
    }
    if plan.solve is not None and scene.is_one_bounce:
        try:
            solution = solve(films, tolerance=tolerance)
            row["solve"] = {
                "predicted": plan.solve.source_error,
                "bars": solution.predicted_error,
                "measured": scale_free_error(solution.source, scene.source),
                "verdict": solution.verdict,
            }
        except UndeterminedError as error:
            row["solve"] = {"predicted": plan.solve.source_error, "refused": str(error)}
    if plan.validate is not None and plan.validate.detectable <= tolerance:
        found = validate_scene(scene, views=plan.validate.views, spp=plan.validate.spp, seed=VALIDATE_SEED)
        row["validate"] = {
            "predicted": plan.validate.detectable,
            "measured": found.comparison.gain.detectable,
            "passed": found.comparison.passed,
        }
    return row


def run(out: Path, minutes: float) -> bool:
    """Do the pairs that are missing until the time is up; whether all are there."""
    path = out / "results" / "advice.json"
    document = json.loads(path.read_text()) if path.exists() else {"pairs": []}
    done = {(r["scene"], r["tolerance"]) for r in document["pairs"]}
    end = time.monotonic() + 60 * minutes
    for name, scene in cases().items():
        missing = [t for t in TOLERANCES if (name, t) not in done]
        if not missing:
            continue
        truth = reference(scene)
        for tolerance in missing:
            if time.monotonic() > end:
                return False
            row = keep_promise(scene, tolerance, truth)
            document["pairs"].append(row)
            write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")
            parts = {k: f"{v['predicted']:.1e}/{v.get('measured', math.nan):.1e}" for k, v in row.items() if k in PARTS}
            print(f"{name:<28}{tolerance:<7g}{row.get('skipped', '')} {parts}", flush=True)
    return True


PARTS = ("forward", "capture", "validate", "solve")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so long; run again to go on")
    parser.add_argument("--page", action="store_true", help="only rewrite page and figure from the results there")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder to write to")
    arguments = parser.parse_args()
    if not arguments.page and not run(arguments.out, arguments.minutes):
        print("to be continued: run again")
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
