"""Does a render converge to the analytic model as Monte Carlo must, how close does it come, and what would it catch?

    python validation/convergence.py [--quick | --page] [--out FOLDER]

One-bounce renders of three flat walls against the physical model, over samples per pixel: the slope of the error with
independent samples (-1/2 if, and only if, the model is what the samples average to), what stratified samples gain, how
many samples bring the picture within 0.1 %, and the gain found there. Beside it, what must hold exactly (each with a
twin that must not), and the power of `validate` at its defaults against a gain of 0.1 % and a shift of 0.2 deg.

Leaves results/convergence.json, figures/convergence.png and the page CONVERGENCE.md in the folder (this one; with
--quick, out/convergence), and leaves with 1 unless every figure is reached.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from wallmirror import GaussianTrain, load_scene, read_captures, write_captures
from wallmirror.comparison import SIGNIFICANCE
from wallmirror.files import write_atomically
from wallmirror.jobs.expecting import Expectation, expect
from wallmirror.jobs.validating_one import SEEDS, SPP, VIEWS, judge, render_seeds
from wallmirror.pathtracing.cameras import Sampler
from wallmirror.pathtracing.filming import render_captures, render_one_hot
from wallmirror.pathtracing.rendering import Renderer, spread_seeds

WALLS = ("flat_wall_diffuse", "flat_wall_phong", "flat_wall_lobes")
SAMPLERS: tuple[Sampler, Sampler] = ("independent", "multijitter")
#: Views, seeds and samples per pixel for the slopes; for the mean over `validate`'s 32 stratified seeds, the views and
#: samples of each wall and how close that mean and its gain must come; runs for the power.
FULL = {
    "views": 3,
    "seeds": 8,
    "levels": [4, 16, 64, 256, 1024, 4096],
    "means": {"flat_wall_diffuse": [3, 1024], "flat_wall_phong": [3, 1024], "flat_wall_lobes": [6, 4096]},
    "rms": 1e-3,
    "gain": 1e-4,
    "runs": 8,
}
QUICK = {
    "views": 1,
    "seeds": 8,
    "levels": [4, 16, 64, 256, 1024],
    "means": {"flat_wall_diffuse": [1, 256], "flat_wall_phong": [1, 256], "flat_wall_lobes": [1, 1024]},
    "rms": 2e-3,
    "gain": 6e-4,
    "runs": 1,
}
WANTED_SLOPE = 0.03
#: The multijitter slope is fitted from here on: below, its cells are coarser than what they resolve.
ASYMPTOTIC = 64
#: A model this much too bright must spoil the slope.
PLANTED_MODEL = 0.05
GAIN, SHIFT_DEG = 1e-3, 0.2
POWER, SECONDS = 0.99, 60.0
# Relative errors mean something where the wall is lit.
_LIT = 1e-2


@dataclass(frozen=True)
class Slope:
    """Slope of log error over log samples, with its standard error by the jackknife over seeds."""

    value: float
    error: float

    @property
    def reached(self) -> bool:
        """Whether the 99 % interval lies within the figure wanted."""
        return abs(self.value + 0.5) + float(stats.norm.ppf(0.995)) * self.error <= WANTED_SLOPE


def slope(levels: np.ndarray, squares: np.ndarray) -> Slope:
    """Least-squares slope over the levels, from mean squared errors of shape (S, levels)."""
    x = np.log(levels) - np.log(levels).mean()

    def fit(mean: np.ndarray) -> float:
        return float(x @ (0.5 * np.log(mean)) / (x @ x))

    count = squares.shape[0]
    left_out = np.array([fit(np.delete(squares, s, axis=0).mean(axis=0)) for s in range(count)])
    error = math.sqrt((count - 1) / count * float(np.sum((left_out - left_out.mean()) ** 2)))
    return Slope(fit(squares.mean(axis=0)), error)


def converge(name: str, settings: dict) -> dict:
    """Errors of one scene over the levels with both samplers, their slopes, and the picture at the most samples."""
    scene = load_scene(name)
    many, spp = settings["means"][name]
    sample = render_seeds(scene, views=many, spp=spp, seed=90)
    whole = expect(scene, sample.views)
    # The slopes need fewer views.
    some = slice(None, None, many // settings["views"])
    views, reference, kept = sample.views[some], whole.reference[some], ~whole.edges[some]
    lit = (reference > _LIT * reference.max()) & kept
    scale = math.sqrt(np.mean(reference[kept] ** 2))
    levels = np.array(settings["levels"])
    renderer = Renderer(scene)
    relative = np.empty((2, settings["seeds"], levels.size))  # mean squares of error / model over the lit pixels
    planted = np.empty((settings["seeds"], levels.size))
    absolute = np.empty((2, levels.size))  # rms of the error of one seed over the rms radiance
    for k, sampler in enumerate(SAMPLERS):
        for j, level in enumerate(settings["levels"]):
            seeds = spread_seeds(1000 * (k + 1) + j, len(views) * settings["seeds"])
            pictures = np.empty((settings["seeds"], *reference.shape))
            for a, view in enumerate(views):
                mine = seeds[a * settings["seeds"] : (a + 1) * settings["seeds"]]
                render = renderer.render(
                    view, scene.source[:, 0], spp=level, seeds=mine, max_depth=2, sampler=sampler, method="seeds"
                )
                pictures[:, a] = render.per_seed
            ratio = pictures[:, lit] / reference[lit]
            relative[k, :, j] = np.mean((ratio - 1) ** 2, axis=1)
            absolute[k, j] = math.sqrt(np.mean((pictures - reference)[:, kept] ** 2)) / scale
            if k == 0:
                planted[:, j] = np.mean((ratio / (1 + PLANTED_MODEL) - 1) ** 2, axis=1)
    means = {n: rms_of_mean(sample.seeds[:n], whole) for n in (1, 2, 4, 8, 16, SEEDS)}
    found = judge(sample, whole)
    late = levels >= ASYMPTOTIC
    return {
        "scene": name,
        "views": list(views),
        "lit_pixels": int(lit.sum()),
        "relative_error": {s: np.sqrt(relative[k].mean(axis=0)).tolist() for k, s in enumerate(SAMPLERS)},
        "planted_error": np.sqrt(planted.mean(axis=0)).tolist(),
        "rms_of_one_seed": {s: absolute[k].tolist() for k, s in enumerate(SAMPLERS)},
        "slope": as_dict(slope(levels, relative[0])),
        "slope_planted": as_dict(slope(levels, planted)),
        "slope_multijitter": as_dict(slope(levels[late], relative[1][:, late])),
        "error_ratio": float(np.sqrt(np.mean(relative[0, :, -1]) / np.mean(relative[1, :, -1]))),
        "rms": {
            "views": list(sample.views),
            "spp_per_seed": spp,
            "seeds": SEEDS,
            "of_mean": {str(n): value for n, value in means.items()},
        },
        "samples_wanted": {
            "multijitter": samples_to(settings, absolute[1], spp, means),
            # By the law just measured, since no run here is that long.
            "independent_foretold": float(levels[-1] * (absolute[0, -1] / settings["rms"]) ** 2),
        },
        "gain": {
            "estimate": found.gain.estimate,
            "standard_error": found.gain.standard_error,
            "interval_99": list(found.gain.interval),
        },
        "passed_as_validate_judges": found.passed,
    }


def as_dict(found: Slope) -> dict:
    return {"value": found.value, "error": found.error, "reached": found.reached}


def rms_of_mean(seeds: np.ndarray, side: Expectation) -> float:
    """Rms over the pixels of the difference between the seeds' mean and the model, in units of the rms radiance."""
    kept = ~side.edges
    off = (seeds.mean(axis=0) - side.reference)[kept]
    return math.sqrt(np.mean(off**2) / np.mean(side.reference[kept] ** 2))


def samples_to(settings: dict, of_one_seed: np.ndarray, spp: int, means: dict[int, float]) -> int | None:
    """Fewest samples per pixel, among those tried, that bring the stratified picture as close as wanted."""
    tried = dict(zip(settings["levels"], of_one_seed.tolist(), strict=True))
    tried |= {n * spp: value for n, value in means.items() if n > 1}
    return min((samples for samples, value in tried.items() if value <= settings["rms"]), default=None)


def invariants(name: str) -> list[dict]:
    """What must hold exactly or to float32 rounding, each beside a twin that must not."""
    scene = load_scene(name)
    observer = replace(scene.observer, view_angles=scene.observer.view_angles[5:15:9])
    scene = replace(scene, observer=observer)
    pattern, seeds = scene.source[:, 0], spread_seeds(7, observer.views + 1)
    rows = []

    def picture(renderer: Renderer, depth: int, seed: int) -> np.ndarray:
        return renderer.render(0, pattern, spp=256, seeds=[seed], max_depth=depth).mean

    def row(what: str, value: float, bound: float, twin: str, planted: float) -> None:
        good = value <= bound < planted
        rows.append({"what": what, "value": value, "bound": bound, "twin": twin, "planted": planted, "good": good})

    light = []
    for albedo in (0.0, 0.8):
        card = replace(scene.card, albedo=albedo, board_width=5.2, board_height=1.0)
        renderer = Renderer(replace(scene, card=card))
        two, fifty = (picture(renderer, depth, seeds[0]) for depth in (2, 50))
        light.append(float(np.max(np.abs(fifty - two)) / np.max(two)))
    row("black card: L_50 - L_2", light[0], 0.0, "card of albedo 0.8", light[1])

    columns = render_one_hot(scene, spp=256, seed=7, max_depth=2)
    renderer = Renderer(scene)
    off = []
    for places in (range(observer.views), range(1, observer.views + 1)):  # the same seeds, and each its neighbour's
        mixed = np.stack(
            [
                renderer.render(view, pattern, spp=256, seeds=[seeds[place]], max_depth=2).mean
                for view, place in enumerate(places)
            ]
        )
        off.append(float(np.max(np.abs(columns @ pattern - mixed)) / np.max(mixed)))
    row("one strip at a time, mixed: difference", off[0], 1e-6, "another seed", off[1])

    first = picture(renderer, 2, seeds[0])
    again, other = picture(renderer, 2, seeds[0]), picture(renderer, 2, seeds[1])
    differs = [float(np.mean(p != first)) for p in (again, other)]
    row("same object and seed: share of pixels that differ", differs[0], 0.0, "another seed", differs[1])

    captures = render_captures(scene, spp=256, seed=7, max_depth=2)
    with tempfile.TemporaryDirectory() as folder:
        write_captures(Path(folder) / "captures", captures)
        back = read_captures(Path(folder) / "captures").radiance
    half = captures.radiance.astype(np.float16).astype(np.float64)
    differs = [float(np.mean(p != captures.radiance)) for p in (back, half)]
    row("EXR files written and read: share that differs", differs[0], 0.0, "half floats", differs[1])
    return [{"scene": name, **r} for r in rows]


def power(count: int) -> dict:
    """What `validate` at its defaults sees on the four-lobed wall: two faults planted in each of several runs."""
    scene = load_scene("flat_wall_lobes")
    train = scene.wall.brdf
    assert isinstance(train, GaussianTrain)
    moved = replace(train, centres=tuple(c + math.radians(SHIFT_DEG) for c in train.centres))
    faulty = replace(scene, wall=replace(scene.wall, brdf=moved))
    runs = []
    wrong: Expectation | None = None
    for root in range(count):
        # Processor seconds of all threads: other jobs on the machine do not lengthen them.
        started, began = time.perf_counter(), time.process_time()
        sample = render_seeds(scene, views=VIEWS, spp=SPP, seed=3000 + root)
        side = expect(scene, sample.views)
        honest = judge(sample, side)
        seconds, processor = time.perf_counter() - started, time.process_time() - began
        wrong = wrong or expect(faulty, sample.views)
        brighter = judge(replace(sample, seeds=(1 + GAIN) * sample.seeds), side)
        shift = next(b for b in honest.biases if b.name == "lobe shift")
        runs.append(
            {
                "root": root,
                "seconds": seconds,
                "processor_seconds": processor,
                "rejected": not honest.passed,
                "gain_caught": not brighter.passed,
                "shift_caught": not judge(sample, wrong).passed,
                "gain_error": honest.gain.standard_error,
                "gain_detectable": honest.gain.detectable,
                "shift_error": shift.standard_error,
                "shift_detectable": shift.detectable,
            }
        )
    # The standard error itself is known from 31 degrees of freedom a run: power at its upper 99 % limit.
    level = SIGNIFICANCE / (len(honest.biases) + 2)
    threshold = float(stats.t.isf(level / 2, SEEDS - 1))
    freedom = count * (SEEDS - 1)
    unlucky = math.sqrt(freedom / stats.chi2.ppf(0.01, freedom))
    powers = {}
    for name, fault in (("gain", GAIN), ("shift", SHIFT_DEG)):
        error = math.sqrt(np.mean([r[f"{name}_error"] ** 2 for r in runs])) * unlucky
        distance = fault / error
        # SciPy's noncentral t fails far out, where the normal tail already says 1.
        powers[name] = 1.0 if distance > threshold + 10 else float(stats.nct.sf(threshold, SEEDS - 1, distance))
    return {
        "scene": scene.name,
        "views": VIEWS,
        "spp": SPP,
        "seeds": SEEDS,
        "gain": GAIN,
        "shift_deg": SHIFT_DEG,
        "power_at_upper_error": powers,
        "runs": runs,
    }


def judge_all(document: dict) -> dict[str, bool]:
    """The figures wanted, and whether each is reached."""
    scenes, found, settings = document["scenes"], document["power"], document["settings"]
    runs = found["runs"]
    return {
        "slope_independent": all(s["slope"]["reached"] for s in scenes),
        "slope_of_planted_model_is_spoilt": not any(s["slope_planted"]["reached"] for s in scenes),
        "rms": all(s["rms"]["of_mean"][str(SEEDS)] <= settings["rms"] for s in scenes),
        "gain": all(max(map(abs, s["gain"]["interval_99"])) <= settings["gain"] for s in scenes),
        "model_not_rejected": all(s["passed_as_validate_judges"] for s in scenes),
        "invariants": all(r["good"] for r in document["invariants"]),
        "power": min(found["power_at_upper_error"].values()) >= POWER
        and all(r["gain_detectable"] <= GAIN and r["shift_detectable"] <= SHIFT_DEG for r in runs)
        and all(r["gain_caught"] and r["shift_caught"] and not r["rejected"] for r in runs),
        "power_in_time": max(r["processor_seconds"] for r in runs) <= SECONDS,
    }


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def page(document: dict) -> str:
    """CONVERGENCE.md, every number of it from the results."""
    scenes, found, settings = document["scenes"], document["power"], document["settings"]
    runs = found["runs"]
    verdicts = document["reached"]
    missed = ", ".join(name for name, good in verdicts.items() if not good)
    slopes = [s["slope"]["value"] for s in scenes]
    last = settings["levels"][-1]
    rows = []
    for s in scenes:
        mean = s["rms"]
        wanted = s["samples_wanted"]
        rows.append(
            [
                f"`{s['scene']}`",
                f"{s['slope']['value']:.4f} ± {s['slope']['error']:.4f}",
                f"{s['slope_planted']['value']:.3f}",
                f"{s['slope_multijitter']['value']:.3f} ± {s['slope_multijitter']['error']:.3f}",
                f"{s['error_ratio']:.3g}",
                f"{wanted['multijitter']:,}" if wanted["multijitter"] else "not reached",
                f"{wanted['independent_foretold']:.1e}",
                f"{mean['of_mean'][str(SEEDS)]:.1e} at {mean['seeds']} x {mean['spp_per_seed']:,}",
                f"{s['gain']['estimate']:+.1e} ± {s['gain']['standard_error']:.0e}",
            ]
        )
    header = [
        "scene",
        "slope, independent",
        f"model {100 * PLANTED_MODEL:g} % too bright",
        f"slope, multijitter from {ASYMPTOTIC}",
        f"error ratio at {last:,}",
        f"spp to rms {settings['rms']:g}, multijitter",
        "independent (by the law)",
        "rms of the mean over seeds",
        "gain - 1",
    ]
    exact = [
        [
            r["what"],
            f"`{r['scene'].removeprefix('flat_wall_')}`",
            "0 exactly" if r["value"] == 0 else f"{r['value']:.1e}",
            "0" if r["bound"] == 0 else f"{r['bound']:.0e}",
            f"{r['planted']:.2g} ({r['twin']})",
        ]
        for r in sorted(document["invariants"], key=lambda r: str(r["what"]))
    ]
    caught = [
        [
            f"gain +{100 * GAIN:g} %",
            f"{max(r['gain_detectable'] for r in runs):.1e}",
            f"{sum(r['gain_caught'] for r in runs)} of {len(runs)}",
            f"{found['power_at_upper_error']['gain']:.6f}",
        ],
        [
            f"lobes shifted by {SHIFT_DEG:g} deg",
            f"{max(r['shift_detectable'] for r in runs):.1e} deg",
            f"{sum(r['shift_caught'] for r in runs)} of {len(runs)}",
            f"{found['power_at_upper_error']['shift']:.6f}",
        ],
    ]
    closest = max(s["rms"]["of_mean"][str(SEEDS)] for s in scenes)
    gains = max(max(map(abs, s["gain"]["interval_99"])) for s in scenes)
    answer = (
        f"Yes: with independent samples the slopes are {min(slopes):.3f} to {max(slopes):.3f}, the mean over seeds comes "
        f"within\n{closest:.1e} (rms) of the model, and its gain within {gains:.0e} (99 %)."
        if not missed
        else f"Not in everything; missed: {missed}."
    )
    first, count, slowest = settings["levels"][0], len(runs), max(r["processor_seconds"] for r in runs)
    proven, freedom = 0.05 ** (1 / count), count * (found["seeds"] - 1)
    rms, gain, rejected = settings["rms"], settings["gain"], sum(r["rejected"] for r in runs)
    sampling = f"{found['views']} views x {found['spp']} spp x {found['seeds']} seeds"
    return f"""# Does a render converge to the analytic model, and as fast as Monte Carlo must?

    python validation/convergence.py

{answer}

{table(header, rows)}

The error is the rms over lit pixels (brighter than {100 * _LIT:g} % of the brightest) and {settings["seeds"]} seeds of
render / model - 1, over {first} to {last:,} samples per pixel (spp), in {settings["views"]} views; its standard error
is that of the jackknife over seeds. Independent samples have slope -1/2 if the model is their expectation; with a wrong
one the error ends on a floor, as the third column shows. Wanted: -0.50 ± {WANTED_SLOPE:g}, 99 % interval included.
Stratified samples (multijitter) fall no faster in the end: what they gain is a factor, the larger the smoother the wall.
"Rms" is that of the difference from the model over all pixels, in units of the rms radiance, at seeds x spp; wanted:
{rms:g}. The samples that reach it are the fewest among those tried; for independent ones they follow from the last
level. Of the gain, the whole 99 % interval must lie within {gain:g}.

![Error over samples per pixel](figures/convergence.png)

## What must hold exactly

{table(["invariant", "wall", "measured", "bound", "its twin gives"], exact)}

Differences are relative to the brightest pixel; 256 samples per pixel. The black card has a board of 5.2 x 1 m.

## What `validate` would have caught

{table(["planted", "detectable with power 0.99, worst run", "caught", "power, upper 99 % limit of the noise"], caught)}

`{found["scene"]}` at the default settings ({sampling}), runs with different seeds, each within {slowest:.0f} s of
processor time (so {SECONDS:g} s are kept even by one core alone). The true model was rejected in {rejected} of {count}.
That {count} of {count} were caught would alone prove a power of {proven:.2f} only (95 %). The statement of power is the
noncentral t's: the scatter between seeds is pooled over the runs ({freedom} degrees of freedom) and taken at its upper
99 % limit, and the level is the test's own, {SIGNIFICANCE:g} shared over its tests.

Made in {document["processor_seconds"] / 60:.1f} min of processor time; numbers in `results/convergence.json` (`--page`
rewrites this page and the figure from them).
"""


def figure(document: dict) -> bytes:
    """Error over samples per pixel, one wall beside the other, as a PNG file."""
    chart = Figure(figsize=(10, 3.4), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(chart)
    levels = np.array(document["settings"]["levels"], dtype=float)
    styles = {"independent": ("o", "tab:blue"), "multijitter": ("s", "tab:orange")}
    axes = chart.subplots(1, len(document["scenes"]), sharey=True, squeeze=False)[0]
    for axis, s in zip(axes, document["scenes"], strict=True):
        for sampler, (marker, colour) in styles.items():
            error = np.array(s["relative_error"][sampler])
            found = s["slope"] if sampler == "independent" else s["slope_multijitter"]
            label = f"{sampler}: slope {found['value']:.3f}"
            axis.loglog(levels, error, marker, color=colour, label=label, markersize=4)
            axis.loglog(levels, error[-1] * np.sqrt(levels[-1] / levels), "-", color=colour, linewidth=0.8)
        axis.loglog(
            levels,
            s["planted_error"],
            "x:",
            color="tab:red",
            linewidth=0.8,
            markersize=4,
            label=f"independent, model {100 * PLANTED_MODEL:g} % too bright: {s['slope_planted']['value']:.2f}",
        )
        axis.set_title(s["scene"].removeprefix("flat_wall_"), fontsize=10)
        axis.set_xlabel("samples per pixel")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=6.5, loc="lower left")
    axes[0].set_ylim(bottom=5e-6)
    axes[0].set_ylabel("relative error of a pixel (rms)")
    chart.suptitle("One-bounce render against the analytic model; lines have slope -1/2", fontsize=10)
    canvas.draw()
    stream = io.BytesIO()
    chart.savefig(stream, format="png")
    return stream.getvalue()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one view, fewer samples, one run for the power")
    parser.add_argument("--page", action="store_true", help="only rewrite page and figure from the results there")
    parser.add_argument("--out", type=Path, help="folder to write to")
    arguments = parser.parse_args()
    out = arguments.out or (Path("out/convergence") if arguments.quick else Path(__file__).parent)
    if arguments.page:
        document = json.loads((out / "results" / "convergence.json").read_text())
    else:
        settings = QUICK if arguments.quick else FULL
        started, began = time.perf_counter(), time.process_time()
        scenes = []
        for name in WALLS:
            s = converge(name, settings)
            scenes.append(s)
            print(
                f"{name:<20} slope {s['slope']['value']:.4f} ± {s['slope']['error']:.4f}, "
                f"rms {s['rms']['of_mean'][str(SEEDS)]:.1e}, gain - 1 = {s['gain']['estimate']:+.1e}",
                flush=True,
            )
        exact = [row for name in WALLS for row in invariants(name)]
        document = {"settings": settings, "scenes": scenes, "invariants": exact, "power": power(settings["runs"])}
        document["seconds"] = time.perf_counter() - started
        document["processor_seconds"] = time.process_time() - began
        document["reached"] = judge_all(document)
        document["passed"] = all(document["reached"].values())
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        write_atomically(out / "results" / "convergence.json", text)
    write_atomically(out / "CONVERGENCE.md", page(document))
    write_atomically(out / "figures" / "convergence.png", figure(document))
    if not arguments.page:
        print(page(document))
    for name, good in document["reached"].items():
        print(f"{name:<34} {'reached' if good else 'MISSED'}")
    return 0 if document["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
