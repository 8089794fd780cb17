"""What would `wallmirror validate` catch, and at what cost? Planted faults against honest renders.

    python validation/planted_biases.py [--roots 3] [--out validation/results]

Every fault is planted on the analytic or on the rendered side of a comparison and judged as `validate` judges, on a
ladder of samplings (views x samples per pixel, always 32 seeds) and for several root seeds. Two statements are made:
how many of the roots rejected the fault, and, where a template sees it, its power from the noncentral t distribution,
the smallest over the roots. A fault counts as caught from the cheapest sampling on at which all roots reject it there
and higher up, and where there is a template, with power >= 0.99. The same renders without a fault must never be
rejected. Leaves planted_biases.json and .csv, prints the table, and exits with 1 unless all of this holds and the
default settings catch a gain of 0.1 % and a shift of 0.2 deg within 60 s.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from wallmirror.brdf import BRDF, GaussianTrain
from wallmirror.comparison import SIGNIFICANCE, Comparison, cross_weights
from wallmirror.geometry import Card, Observer
from wallmirror.jobs.expecting import Expectation, Transport, expect, physical_transport
from wallmirror.jobs.validating_one import QUICK_SPP, QUICK_VIEWS, SEEDS, SPP, VIEWS, Sample, judge, render_seeds
from wallmirror.scene import Scene, load_scene
from wallmirror.transport import build_kernel

#: Views and samples per pixel, in the order of their cost; `validate --quick` and `validate` are among them.
LADDER = ((1, 16), (1, 64), (QUICK_VIEWS, QUICK_SPP), (VIEWS, SPP))
POWER = 0.99


def narrow_lobes() -> Scene:
    """Four lobes of sigma 0.1 deg lit by strips of 2 mm, 0.1 deg wide: wider ones would blur what pixels resolve."""
    scene = load_scene("flat_wall_lobes")
    assert isinstance(scene.wall.brdf, GaussianTrain)
    brdf = replace(scene.wall.brdf, sigma=math.radians(0.1))
    card = replace(scene.card, element_width=0.002)
    return replace(scene, name="lobes of 0.1 deg", card=card, wall=replace(scene.wall, brdf=brdf))


SCENES: dict[str, Callable[[], Scene]] = {
    "diffuse": lambda: load_scene("flat_wall_diffuse"),
    "lobes": lambda: load_scene("flat_wall_lobes"),
    "narrow lobes": narrow_lobes,
}


def reweighted(factor: Callable[[np.ndarray, float], np.ndarray]) -> Transport:
    """Physical transport whose kernel is multiplied by a function of theta_s and the card's distance.

    The strips are 0.02 m high, 1 m away: in-plane angles stand for those in space to 1e-4.
    """

    def transport(observer: Observer, card: Card, brdf: BRDF) -> np.ndarray:
        kernel = build_kernel(observer, card, resolution=brdf.angular_scale / 8, tolerance=1e-9)
        return replace(kernel, weight=kernel.weight * factor(kernel.theta_s, card.distance)).apply(brdf)

    return transport


def over_footprints(observer: Observer, card: Card, brdf: BRDF) -> np.ndarray:
    """Physical transport to 1e-6 of the lobes' peak: what narrow lobes need, at a fraction of `validate`'s cost."""
    return build_kernel(observer, card, resolution=brdf.angular_scale / 2, tolerance=1e-6).apply(brdf)


def at_pixel_centres(observer: Observer, card: Card, brdf: BRDF) -> np.ndarray:
    """Physical transport to the centres of the pixels: points from edge to edge of a field that ends there."""
    half = math.atan(math.tan(observer.fov / 2) * (1 - 1 / observer.pixels))
    return physical_transport(replace(observer, fov=2 * half, pixels_at="edges"), card, brdf)


def changed_lobes(scene: Scene, change: Callable[[tuple[float, ...]], tuple[float, ...]]) -> Scene:
    """The scene with other lobe centres."""
    brdf = scene.wall.brdf
    assert isinstance(brdf, GaussianTrain)
    return replace(scene, wall=replace(scene.wall, brdf=replace(brdf, centres=change(brdf.centres))))


@dataclass(frozen=True)
class Twin:
    """A fault and where it is planted.

    Parameters
    ----------
    scenes:
        Names of the scenes to plant it in.
    scene, transport:
        What the analytic side takes for the scene and for the transport; a change of either is the fault.
    seeds:
        What becomes of the renders, (S, A, N).
    """

    name: str
    side: str
    scenes: tuple[str, ...] = ("diffuse", "lobes")
    scene: Callable[[Scene], Scene] = lambda scene: scene
    transport: Transport = physical_transport
    seeds: Callable[[np.ndarray], np.ndarray] = lambda seeds: seeds

    def expectation(self, scene: Scene, views: tuple[int, ...]) -> Expectation:
        """The analytic side, faulty if the fault is planted there."""
        honest_narrow = self.transport is physical_transport and scene.wall.brdf.angular_scale < math.radians(0.5)
        return expect(self.scene(scene), views, transport=over_footprints if honest_narrow else self.transport)

    def comparison(self, sample: Sample, expectation: Expectation) -> tuple[Comparison, Sample]:
        """The verdict, and the rendered side, faulty if the fault is planted there."""
        faulty = replace(sample, seeds=self.seeds(sample.seeds))
        return judge(faulty, expectation), faulty


def half_float(seeds: np.ndarray) -> np.ndarray:
    """Renders whose mean is what an EXR of half floats would hold."""
    mean = seeds.mean(axis=0)
    return seeds + (mean.astype(np.float16).astype(np.float64) - mean)


CLEAN = Twin("nothing (the unbiased twin)", "none", scenes=("diffuse", "lobes", "narrow lobes"))
TWINS = (
    Twin("gain +0.1 %", "rendered", seeds=lambda seeds: 1.001 * seeds),
    Twin(
        "lobes shifted by 0.2 deg",
        "analytic",
        ("lobes",),
        scene=lambda s: changed_lobes(s, lambda c: tuple(x + math.radians(0.2) for x in c)),
    ),
    Twin("one lobe of four missing", "analytic", ("lobes",), scene=lambda s: changed_lobes(s, lambda c: c[:-1])),
    Twin("wall's cosine omitted", "analytic", transport=reweighted(lambda theta, z: 1 / np.cos(theta))),
    Twin("emitter's cosine omitted", "analytic", transport=reweighted(lambda theta, z: 1 / np.cos(theta))),
    Twin("1/r instead of 1/r^2", "analytic", transport=reweighted(lambda theta, z: z / np.cos(theta))),
    Twin("pixel centre for footprint", "analytic", ("narrow lobes",), transport=at_pixel_centres),
    Twin("half-float EXR", "rendered", seeds=half_float),
)


@dataclass(frozen=True)
class Row:
    """One twin in one scene at one sampling and root; `power` is nan where no template sees the fault."""

    twin: str
    side: str
    scene: str
    views: int
    spp: int
    root: int
    rejected: bool
    power: float
    caught_by: str
    gain_detectable: float
    seconds: float


def judge_all(names: list[str], ladder: tuple[tuple[int, int], ...], roots: int, twins: tuple[Twin, ...]) -> list[Row]:
    """Render each scene once per sampling and root, and judge all twins on it; the clean one comes with each."""
    rows = []
    for name in names:
        scene = SCENES[name]()
        # The analytic side does not know of roots: computed once, its seconds counted in every row.
        analytic: dict[tuple[str, int], tuple[Expectation, float]] = {}
        for root in range(roots):
            for views, spp in ladder:
                if name == "narrow lobes" and views > QUICK_VIEWS:
                    continue  # minutes of quadrature, for a fault that is caught long before
                started = time.perf_counter()
                sample = render_seeds(scene, views=views, spp=spp, seed=1000 + root)
                rendering = time.perf_counter() - started
                for twin in (CLEAN, *twins):
                    if name not in twin.scenes:
                        continue
                    key = (CLEAN.name if twin.side == "rendered" else twin.name, views)
                    if key not in analytic:
                        started = time.perf_counter()
                        analytic[key] = twin.expectation(scene, sample.views), time.perf_counter() - started
                    wrong, expecting = analytic[key]
                    clean, _ = analytic[CLEAN.name, views]
                    started = time.perf_counter()
                    comparison, faulty = twin.comparison(sample, wrong)
                    seconds = rendering + expecting + time.perf_counter() - started
                    shift = expected_deviation(sample, clean, faulty, wrong)
                    rows.append(
                        Row(
                            twin.name,
                            twin.side,
                            name,
                            views,
                            spp,
                            root,
                            not comparison.passed,
                            template_power(comparison, shift, faulty, wrong),
                            strongest(comparison),
                            comparison.gain.detectable,
                            seconds,
                        )
                    )
    return rows


def expected_deviation(sample: Sample, clean: Expectation, faulty: Sample, wrong: Expectation) -> np.ndarray:
    """What the fault adds to (render - reference) on average, shape (A, N)."""
    return (faulty.seeds - sample.seeds).mean(axis=0) + clean.reference - wrong.reference


def template_power(comparison: Comparison, shift: np.ndarray, sample: Sample, side: Expectation) -> float:
    """Power of the best template test against a deviation, from the noncentral t and the scatter of this run."""
    weights = cross_weights(sample.seeds, side.reference).mean(axis=0)
    weights = np.where(np.isfinite(comparison.z), weights, 0.0)
    level = SIGNIFICANCE / (len(comparison.biases) + 2)
    threshold = float(stats.t.isf(level / 2, SEEDS - 1))
    best = 0.0
    for bias, shape in zip(comparison.biases, (side.reference, *side.templates.values()), strict=True):
        squared = float(np.sum(weights * shape**2))
        if squared == 0 or bias.standard_error == 0 or not math.isfinite(bias.standard_error):
            continue
        distance = abs(float(np.sum(weights * shape * shift))) / squared / bias.standard_error
        # SciPy's noncentral t fails far out, where the normal tail already says 1.
        power = 1.0 if distance > threshold + 10 else float(stats.nct.sf(threshold, SEEDS - 1, distance))
        best = max(best, power)
    return best


def strongest(comparison: Comparison) -> str:
    """The test with the smallest p-value of a rejected comparison."""
    if comparison.passed:
        return ""
    tests = {bias.name: bias.p_value for bias in comparison.biases}
    tests |= {"largest score": comparison.largest_p, "tiles": comparison.uniformity_p}
    return min(tests, key=lambda name: tests[name])


def thresholds(rows: list[Row], ladder: tuple[tuple[int, int], ...]) -> list[dict[str, object]]:
    """For each twin and scene the cheapest sampling from which on it is caught."""
    table: list[dict[str, object]] = []
    for twin, scene in dict.fromkeys((r.twin, r.scene) for r in rows):
        mine = [r for r in rows if (r.twin, r.scene) == (twin, scene)]
        levels = []
        for views, spp in ladder:
            runs = [r for r in mine if (r.views, r.spp) == (views, spp)]
            if not runs:
                continue
            power = min(r.power for r in runs)
            levels.append(
                {
                    "views": views,
                    "spp": spp,
                    "rejected": sum(r.rejected for r in runs),
                    "roots": len(runs),
                    "power": power,
                    "seconds": float(np.median([r.seconds for r in runs])),
                    "gain_detectable": max(r.gain_detectable for r in runs),
                    "caught_by": sorted({r.caught_by for r in runs} - {""}),
                }
            )
        first = len(levels)
        while first > 0 and levels[first - 1]["rejected"] == levels[first - 1]["roots"]:
            first -= 1
        claim = ""
        if first < len(levels):
            certain = [k for k in range(first, len(levels)) if float(levels[k]["power"]) >= POWER]  # type: ignore[arg-type]
            # Where a template can see the fault, the first sampling at which that is certain and not luck.
            first, claim = (certain[0], "noncentral t") if certain else (first, "measured")
        table.append(
            {
                "twin": twin,
                "side": mine[0].side,
                "scene": scene,
                "caught_from": levels[first] if first < len(levels) else None,
                "claim": claim,
                "levels": levels,
            }
        )
    return table


def report(table: list[dict[str, object]]) -> list[str]:
    """The table in Markdown."""
    lines = [
        "| fault | planted | scene | caught from (views x spp) | seconds | claim | rejected at each sampling |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in table:
        levels: list[dict[str, float]] = row["levels"]  # type: ignore[assignment]
        first: dict[str, object] | None = row["caught_from"]  # type: ignore[assignment]
        counts = ", ".join(f"{x['rejected']}/{x['roots']}" for x in levels)
        at = f"{first['views']} x {first['spp']}" if first else "never"
        seconds = f"{first['seconds']:.1f}" if first else ""
        lines.append(
            f"| {row['twin']} | {row['side']} | {row['scene']} | {at} | {seconds} | {row['claim']} | {counts} |"
        )
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--roots", type=int, default=3, help="root seeds, each with renders of its own")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    started = time.perf_counter()
    rows = judge_all(list(SCENES), LADDER, arguments.roots, TWINS)
    table = thresholds(rows, LADDER)
    clean = [r for r in rows if r.twin == CLEAN.name]
    default = [r for r in rows if (r.scene, r.views, r.spp) == ("lobes", VIEWS, SPP)]
    wanted = [r for r in default if r.twin in (TWINS[0].name, TWINS[1].name)]
    caught = {
        twin: any(row["twin"] == twin and row["caught_from"] is not None for row in table)
        for twin in (t.name for t in TWINS)
    }
    result = {
        "seeds": SEEDS,
        "roots": arguments.roots,
        "significance": SIGNIFICANCE,
        "clean": {"comparisons": len(clean), "rejected": sum(r.rejected for r in clean)},
        "every_fault_caught": all(caught.values()),
        "default_settings_on_lobes": {
            "power": min(r.power for r in wanted),
            "rejected": sum(r.rejected for r in wanted),
            "of": len(wanted),
            "seconds": max(r.seconds for r in wanted),
            "gain_detectable": max(r.gain_detectable for r in wanted if r.twin == TWINS[0].name),
        },
        "seconds": time.perf_counter() - started,
        "table": table,
    }
    passed = (
        not any(r.rejected for r in clean)
        and all(caught.values())
        and all(r.rejected and r.power >= POWER and r.seconds <= 60 for r in wanted)
    )
    result["passed"] = passed
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "planted_biases.json").write_text(json.dumps(result, indent=2) + "\n")
    with (arguments.out / "planted_biases.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in dataclasses.fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(dataclasses.asdict(r) for r in rows)
    print("\n".join(report(table)))
    print(json.dumps({k: v for k, v in result.items() if k != "table"}, indent=2))
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
