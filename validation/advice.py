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
import io
import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

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
from wallmirror.jobs.validating_one import validate_scene
from wallmirror.pathtracing.building import wall_as_rendered
from wallmirror.pathtracing.rendering import FILM_ROUNDING, Renderer, spread_seeds
from wallmirror.report.style import CYCLE, FAINT, INK, clean, new_figure
from wallmirror.transport import build_kernel

TOLERANCES = (1e-1, 3e-2, 1e-2, 3e-3)
VARIATIONS = 12
VIEWS, PIXELS = 4, 96
#: Samples in all beyond which films are not made.
LIMIT = 200_000_000
#: Seeds of 1024 samples of each half of a reference, of one bounce and of all.
REFERENCE_SEEDS = (16, 8)
WITHIN, KEPT = 2.0, 0.95
#: A reference whose own noise could feign more than this share of a tolerance does not judge it.
RESOLVED = 0.5
#: A gain error below which a comparison has no scatter, as before a mirror.
EXACT = 1.1e-5
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
        row["forward"] = {"predicted": plan.forward.error, "limit": plan.forward.is_limit, **truth.measure(wall)}
    capture = plan.capture
    assert capture is not None
    samples = capture.films * PIXELS * capture.sampling.total
    if samples > LIMIT:
        row["samples"], row["skipped"] = samples, f"{samples:.1e} samples"
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
    # What an earlier run with a lower limit left out is asked again.
    document["pairs"] = [r for r in document["pairs"] if r.get("samples", math.inf) > LIMIT or "skipped" not in r]
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


def time_advice(out: Path) -> None:
    """What `advise` itself takes on the shipped scenes as they are: processor and wall seconds."""
    path = out / "results" / "advice.json"
    document = json.loads(path.read_text())
    rows = document.setdefault("timings", [])
    for name in scene_names():
        if any(row["scene"] == name for row in rows):
            continue
        scene = load_scene(name)
        started, cpu = time.perf_counter(), time.process_time()
        advise(scene, 1e-2, seed=PLAN_SEED)
        rows.append({"scene": name, "cpu": time.process_time() - cpu, "wall": time.perf_counter() - started})
        write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")
        print(f"{name:<28}advice took {rows[-1]['cpu']:.1f} s of processor time, {rows[-1]['wall']:.1f} s", flush=True)


@dataclass(frozen=True)
class Tally:
    """How many of how many promises were kept."""

    good: int
    of: int

    @property
    def share(self) -> float:
        """Of the promises, those kept."""
        return self.good / self.of if self.of else 0.0

    def __str__(self) -> str:
        return f"{self.good} of {self.of}"


def judge(document: dict) -> dict:
    """The figures asked for, computed from the pairs."""
    filmed = [row for row in document["pairs"] if "capture" in row]
    pairs = [row for row in filmed if resolved(row["capture"], row["tolerance"])]
    films = [row["capture"] for row in pairs]
    walls = [row for row, tolerance in walls_with_tolerance(document) if resolved(row, tolerance)]
    solved = [row["solve"] for row in filmed if "measured" in row.get("solve", {})]
    validated = [row for row in filmed if "validate" in row]
    kept = [
        row
        for row in pairs
        if all(
            row[k]["measured"] <= row["tolerance"]
            for k in ("capture", "forward")
            if k in row and resolved(row[k], row["tolerance"])
        )
    ]

    def foretold(rows: list[dict]) -> Tally:
        return Tally(sum(abs(math.log(ratio(row))) <= math.log(WITHIN) for row in rows), len(rows))

    limits = [row for row in walls if row["limit"]]
    # What no reference can tell: its noise, and the rounding of its film.
    foretells = [row for row in walls if not row["limit"] and row["predicted"] > 0]
    floored = [{**row, "blur": max(row["blur"], FILM_ROUNDING)} for row in foretells]
    told = [row for row in floored if max(row["measured"], row["predicted"]) > row["blur"]]
    unblurred = [{**row, "measured": max(row["measured"], row["blur"])} for row in told]
    return {
        "kept": Tally(len(kept), len(pairs)),
        "film_kept": Tally(sum(row["capture"]["measured"] <= row["tolerance"] for row in pairs), len(pairs)),
        "films": foretold(films),
        "walls": foretold(unblurred),
        "wall_kept": Tally(
            sum(w["measured"] <= t for w, t in walls_with_tolerance(document) if resolved(w, t)), len(walls)
        ),
        "exact": max((row["measured"] for row in walls if row["predicted"] == 0), default=0.0),
        "limits": Tally(sum(row["measured"] <= max(row["predicted"], row["blur"]) for row in limits), len(limits)),
        "solved": foretold([{**row, "measured": row["bars"]} for row in solved]),
        "solved_rms": math.sqrt(sum(1 / ratio(row) ** 2 for row in solved) / max(1, len(solved))),
        "validated": Tally(sum(r["validate"]["measured"] <= r["tolerance"] for r in validated), len(validated)),
        "gains": foretold([r["validate"] for r in validated if r["validate"]["measured"] > EXACT]),
        "film_ratios": (min(map(ratio, films)), max(map(ratio, films))),
        "unresolved": len(filmed) - len(pairs),
        "skipped": sum("skipped" in row for row in document["pairs"]),
        "slowest": max(document.get("timings", [{"cpu": math.nan}]), key=lambda row: row["cpu"]),
    }


def walls_with_tolerance(document: dict) -> list[tuple[dict, float]]:
    """The predicted walls, each with the tolerance it was planned for."""
    return [(row["forward"], row["tolerance"]) for row in document["pairs"] if "forward" in row]


def resolved(row: dict, tolerance: float) -> bool:
    """Whether the reference is good enough to say that films or a wall keep a tolerance."""
    return row["blur"] <= RESOLVED * tolerance


def ratio(row: dict) -> float:
    """Predicted over measured."""
    return row["predicted"] / max(row["measured"], 1e-300)


def reached(found: dict) -> bool:
    """Whether all figures asked for are: 60 pairs, 95 % kept, and as many foretold within a factor of two."""
    shares = [found[name].share for name in ("kept", "films", "walls", "validated")]
    if found["limits"].of:
        shares.append(found["limits"].share)
    return found["kept"].of >= 60 and min(shares) >= KEPT and found["slowest"]["cpu"] <= 10.0


def page(document: dict) -> str:
    """ADVICE.md."""
    found = judge(document)
    low, high = found["film_ratios"]
    lines = [
        "# Does `wallmirror advise` keep its promises?",
        "",
        "    python validation/advice.py",
        "",
        f"{'Yes' if reached(found) else 'No'}: of {found['kept'].of} pairs of a scene and a tolerance, "
        f"{found['kept'].good} keep it, wall and films alike; the films' error is foretold within a factor of {WITHIN:g} in "
        f"{found['films']} (predicted over measured: {low:.2f} to {high:.2f}).",
        "",
        "An error is the rms of the difference from the converged radiance, over all views, pixels and patterns, in units "
        "of its rms. The reference is a path tracer at all depths that the plan never saw, in two independent halves whose "
        "own noise cancels; the scenes are the shipped ones and random variations, cut to "
        f"{VIEWS} views of {PIXELS} pixels.",
        "",
        "| promise | kept | foretold within a factor of two |",
        "| --- | --- | --- |",
        f"| films with the planned samples, seeds and depth (`capture --tolerance`) | {found['film_kept']} | "
        f"{found['films']} |",
        f"| the wall by the planned analytic route, where one is | {found['wall_kept']} | {found['walls']} |",
        f"| the smallest gain error that the planned validation sees (`validate --tolerance`) | {found['validated']} | "
        f"{found['gains']} |",
        "| the pattern's error from the planned films, from the Cramer-Rao bound, against the error bars that `solve` then "
        f"finds (one bounce) | - | {found['solved']} |",
        "",
        "A wall's error below what the reference's noise could feign is judged against that. Where the pilot's own noise "
        f"hid what the card's glow leaves out, the plan states a limit, which held in {found['limits']}. A mirror before a "
        f"black card is computed exactly; the {100 * found['exact']:.2g} % measured there are the path tracer's own, which "
        "displaces rays at the strips' borders, and have no ratio. "
        f"The true errors of the patterns are {found['solved_rms']:.2f} times the foretold in the rms over all pairs; one by "
        "one they scatter, as errors of sixteen numbers do. Where the error bars are more than twice the foretold, they hold "
        "what few samples tell of their own noise and of Hypothesis 8, which the bound takes as known. "
        f"{found['unresolved']} pairs were filmed but are not judged, since the reference's noise could feign half of their "
        f"tolerance. {found['skipped']} pairs need more than {LIMIT:.0e} samples: their films were planned but not made, and "
        "only the wall is judged.",
        "",
        "![Predicted against measured](figures/advice.png)",
        "",
        *timing_lines(document),
        "## Pair by pair",
        "",
        "Predicted / measured, in percent.",
        "",
        "| scene | tolerance | films | how | wall | route | gain seen | pattern |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in document["pairs"]:
        plan = row["plan"]
        capture = plan["capture"]
        how = f"depth {capture['max_depth']}, {capture['seeds']} x {capture['spp']} {capture['sampler']}"
        cells = [cell(row.get(name)) for name in ("capture", "forward", "validate", "solve")]
        if "skipped" in row:
            cells[0] = f"{row['skipped']}"
        lines.append(
            f"| `{row['scene']}` | {100 * row['tolerance']:g} % | {cells[0]} | {how} | {cells[1]} | "
            f"{plan['forward']['route']} | {cells[2]} | {cells[3]} |"
        )
    return "\n".join(lines) + "\n"


def timing_lines(document: dict) -> list[str]:
    """What advice itself takes."""
    rows = document.get("timings", [])
    if not rows:
        return []
    cpu, wall = (sorted(row[k] for row in rows) for k in ("cpu", "wall"))
    return [
        f"Advice on the {len(rows)} shipped scenes as they are (500 pixels, 20 views, 4 patterns) takes {cpu[0]:.1f} to "
        f"{cpu[-1]:.1f} s of processor time (median {cpu[len(cpu) // 2]:.1f} s) and {wall[0]:.1f} to {wall[-1]:.1f} s by the "
        "clock of a machine of two cores that others used as well.",
        "",
    ]


def cell(row: dict | None) -> str:
    """Predicted / measured in percent."""
    if row is None:
        return "-"
    if "refused" in row:
        return "refused"
    return f"{100 * row['predicted']:.2g} / {100 * row['measured']:.2g}"


def figure(document: dict) -> bytes:
    """Predicted against measured, one panel for each promise."""
    chart = new_figure(11.0, 3.4)
    titles = {
        "capture": "films",
        "forward": "the wall, analytic",
        "validate": "gain that validation sees",
        "solve": "recovered pattern",
    }
    for axes, (name, title) in zip(chart.subplots(1, 4), titles.items(), strict=True):
        # What is exact (a mirror) has no place on such a scale.
        rows = [
            (r[name], r["tolerance"])
            for r in document["pairs"]
            if r.get(name, {}).get("measured", 0.0) > EXACT and r[name]["predicted"] > 0
        ]
        axes.set_title(title)
        if not rows:
            continue
        x = np.array([max(row["measured"], row.get("blur", 0.0)) for row, _ in rows])
        y = np.array([row["predicted"] for row, _ in rows])
        ends = np.array([min(x.min(), y.min()) / 2, max(x.max(), y.max()) * 2])
        axes.fill_between(ends, ends / WITHIN, ends * WITHIN, color=FAINT, alpha=0.2, linewidth=0)
        axes.plot(ends, ends, color=INK, linewidth=0.8)
        blurred = np.array([row["measured"] <= row.get("blur", 0.0) for row, _ in rows])
        limit = np.array([row.get("limit", False) for row, _ in rows])
        for tolerance, colour in zip(TOLERANCES, CYCLE, strict=False):
            mine = np.array([t == tolerance for _, t in rows])
            for hollow in (False, True):
                for shape, kind in (("o", ~limit), ("v", limit)):
                    some = mine & kind & (blurred == hollow)
                    label = f"to {100 * tolerance:g} %" if shape == "o" and not hollow else None
                    style = "none" if hollow else "full"
                    axes.plot(x[some], y[some], shape, color=colour, markersize=4.5, fillstyle=style, label=label)
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, xlabel="measured")
        axes.set_aspect("equal")
        clean(axes)
    chart.axes[0].set_ylabel("predicted relative error")
    chart.axes[0].legend(fontsize=8, frameon=False, loc="lower right")
    chart.axes[1].text(
        0.98,
        0.04,
        "hollow: measured is below\nthis noise; triangle: only\na limit was foretold",
        transform=chart.axes[1].transAxes,
        ha="right",
        fontsize=8,
    )
    image = io.BytesIO()
    FigureCanvasAgg(chart).print_png(image)
    return image.getvalue()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so long; run again to go on")
    parser.add_argument("--page", action="store_true", help="only rewrite page and figure from the results there")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder to write to")
    arguments = parser.parse_args()
    out = arguments.out
    if not arguments.page:
        if not run(out, arguments.minutes):
            print("to be continued: run again")
            return 0
        time_advice(out)
    document = json.loads((out / "results" / "advice.json").read_text())
    write_atomically(out / "figures" / "advice.png", figure(document))
    write_atomically(out / "ADVICE.md", page(document))
    found = judge(document)
    print({name: str(value) for name, value in found.items()})
    print("PASSED" if reached(found) else "FAILED")
    return 0 if reached(found) else 1


if __name__ == "__main__":
    sys.exit(main())
