"""Is an answer that is called good ever wrong, and is what can be known found?

    python validation/false_confidence.py [--facets | --few] [--wall MODEL] [--quick] [--scenes N] [--jobs N] [--seed S]
        [--out FOLDER]

Draws random scenes (2 to 6 elements, 1 to 7 views, all three weights, four kinds of wall, from no noise down to 10 dB,
with and without stated variances), a third of them spoilt so that nothing can determine the answer, solves each, and
holds the answer against the truth. An answer is FALSE CONFIDENCE if the solver calls it good and its pattern is off by
more than five of its own error bars + 1e-6. With --facets the walls are rough facets, and the angle sum a wrong model;
with --wall angle_sum none are fitted to the films that ask for them, and doubt is all that can save an answer.
With --few there are fewer captures than elements (2 to 5 elements, 1 to M - 1 captures), every fifth wall one of facets,
and the solver is given none, one or both of the true priors: rho and V >= 0, and the angle beyond which rho is 0.
A scene counts as identifiable if the Cramer-Rao bound at the truth, which knows nothing of the solver (of the priors it
knows the support), lets the pattern be known to 5 %. Leaves results/false_confidence.json (with the options in its name)
in the folder and with 1 if there is false confidence or if fewer than 97 % of the identifiable scenes are solved (with
--few, where a bound at one pattern knows nothing of the others that explain the films, no share is asked for).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from wallmirror import (
    BRDF,
    AngleSumBRDF,
    CaptureSet,
    Card,
    CookTorrance,
    Diffuse,
    Fresnel,
    GaussianTrain,
    Observer,
    Phong,
    Sum,
    UndeterminedError,
    foresee,
    radiance,
    scale_free_error,
    scan_angles,
    solve,
    transport_matrix,
)
from wallmirror.derendering.bounds import cramer_rao
from wallmirror.derendering.elimination import restricted
from wallmirror.derendering.foresight import closest_spline
from wallmirror.derendering.moments import moments
from wallmirror.derendering.options import SolveOptions
from wallmirror.derendering.preparing import prepare
from wallmirror.files import write_atomically

WallModel = Literal["angle_sum", "microfacet", "auto"]

SCENES, QUICK_SCENES = 1000, 60
KNOWABLE = 0.05  # bound on the pattern's error up to which a scene counts as identifiable
NEARLY_NOISELESS = 100.0  # dB; the bound needs some noise to stand on
SPOILT = ("alike patterns", "a dark element", "mixed elements", "no parallax")
DECIBELS = (math.inf, 60.0, 40.0, 20.0, 10.0)
FACETS_AMONG_FEW = 0.2
LOBE_ENDS = 8  # widths from its centre at which a Gaussian lobe is below rounding


@dataclass(frozen=True)
class Trial:
    """One random scene, its data, and the truth."""

    captures: CaptureSet
    brdf: BRDF
    source: np.ndarray
    noise: float
    spoilt: str
    about: str
    priors: SolveOptions


@dataclass(frozen=True)
class Outcome:
    """What the solver said of one scene, and what the bound allows."""

    number: int
    about: str
    spoilt: str
    decibels: float | None
    bound: float | None
    answer: str
    reason: str
    error: float | None
    predicted: float | None
    method: str

    @property
    def identifiable(self) -> bool:
        return not self.spoilt and self.bound is not None and self.bound <= KNOWABLE

    @property
    def off(self) -> bool:
        """Whether there is an answer further off than five of its error bars."""
        return self.error is not None and self.predicted is not None and self.error > 5 * self.predicted + 1e-6


def draw(number: int, seed: int, facets: bool = False, few: bool = False) -> tuple[Trial, float]:
    """A random scene and its signal-to-noise ratio in dB, the same for the same numbers."""
    rng, rng_of_few = np.random.default_rng((seed, number)), np.random.default_rng((seed, number, 2))
    while True:
        elements = int(rng.integers(2, 6 if few else 7))
        width = 10 ** rng.uniform(-0.3, 0.9)
        places = np.sort(rng.uniform(-width / 2, width / 2, elements))
        if np.min(np.diff(places)) > 0.03 * width / elements:
            break
    patterns, views, pixels = (
        int(rng.integers(elements, elements + 6)),
        int(rng.integers(1, 8)),
        int(rng.integers(40, 200)),
    )
    spoilt = str(rng.choice(SPOILT)) if rng.random() < 1 / 3 else ""
    if few:
        patterns = int(rng_of_few.integers(1, elements))
        spoilt = spoilt if spoilt == "no parallax" else ""  # the others only leave fewer patterns
    distance = 10 ** rng.uniform(4, 5) if spoilt == "no parallax" else 10 ** rng.uniform(-0.3, 1.3)
    weights = ("thesis", "cosine", "physical")[rng.integers(3)]
    physical = weights == "physical"
    fov = math.radians(rng.uniform(30, 70))
    observer = Observer(
        position=(rng.uniform(-1, 1), -5.0),
        fov=fov,
        view_angles=scan_angles(views, scan=fov + math.radians(rng.uniform(0, 30)), fov=fov),
        pixels=pixels,
        pixels_at="centres" if physical else "edges",
    )
    size = min(0.02, 0.3 * float(np.min(np.diff(places)))) if physical else 0.0
    card = Card(elements_x=tuple(map(float, places)), y=-distance, element_width=size, element_height=size)
    lobes = GaussianTrain(
        centres=tuple(np.radians(rng.uniform(-40, 40, rng.integers(1, 5)))), sigma=math.radians(10 ** rng.uniform(0, 1))
    )
    kinds: tuple[AngleSumBRDF, ...] = (
        lobes,
        Sum(parts=(lobes, Diffuse(albedo=rng.uniform(0.1, 1)))),
        Phong(exponent=10 ** rng.uniform(0.5, 2.5)),
        Diffuse(albedo=0.5),
    )
    brdf: BRDF = kinds[rng.integers(3 if few else 4)]
    if facets or (few and rng_of_few.random() < FACETS_AMONG_FEW):
        brdf = rough(np.random.default_rng((seed, number, 1)))
    source = rng.random((elements, patterns))
    match spoilt:
        case "alike patterns":
            source = source[:, :1] * rng.uniform(0.2, 1, patterns)
        case "a dark element":
            source[rng.integers(elements)] = 0
        case "mixed elements":
            source[-1] = source[:-1].mean(axis=0)
    films = radiance(transport_matrix(observer, card, brdf, weights=weights, tolerance=1e-8), source)
    decibels = float(rng.choice(DECIBELS[:4] if few else DECIBELS))
    rms = float(np.sqrt(np.mean(films**2)))
    noise = 0.0 if math.isinf(decibels) else rms * 10 ** (-decibels / 20)
    filmed = films + noise * rng.standard_normal(films.shape)
    stated = None if noise == 0 or rng.random() < 0.5 else np.full(films.shape, noise**2)
    captures = CaptureSet(observer=observer, card=card, transport=weights, radiance=filmed, variance=stated)
    about = (
        f"{type(brdf).__name__}, {weights}, M {elements}, B {patterns}, A {views}, N {pixels}, z {distance:.3g}, "
        f"width {width:.2g}, variance {'stated' if stated is not None else 'not stated'}"
    )
    priors = true_priors(brdf, rng_of_few) if few else SolveOptions()
    about += "".join(f", {name} {told:.3g}" for name, told in priors.items())
    level = noise or rms * 10 ** (-NEARLY_NOISELESS / 20)
    return Trial(captures, brdf, source, level, spoilt, about, priors), decibels


def true_priors(brdf: BRDF, rng: np.random.Generator) -> SolveOptions:
    """What the solver of few captures is told of a scene: nothing, that rho and V are >= 0, where rho ends, or both."""
    priors = SolveOptions(nonnegative=bool(rng.random() < 0.7))
    told = bool(rng.random() < 0.5)
    if told and isinstance(brdf, GaussianTrain):
        priors["support_deg"] = math.degrees(max(abs(c) for c in brdf.centres) + LOBE_ENDS * brdf.sigma)
    elif told and isinstance(brdf, Phong):
        priors["support_deg"] = 90.0
    return priors


def rough(rng: np.random.Generator) -> CookTorrance:
    """A random wall of metal or glass facets, which is no function of the angle sum."""
    return CookTorrance(
        alpha=10 ** rng.uniform(-1.1, -0.3),
        distribution=("ggx", "beckmann")[rng.integers(2)],
        facets=("grooves", "isotropic")[rng.integers(2)],
        fresnel=(Fresnel(eta=1.1, k=6.6), Fresnel(eta=0.18, k=3.4), Fresnel(eta=1.5))[rng.integers(3)],
    )


def knowable_to(trial: Trial) -> float | None:
    """The Cramer-Rao bound at the truth, among the BRDFs within the support that the solver is told; None where it is inf."""
    captures, support = trial.captures, trial.priors.get("support_deg")
    if trial.spoilt or not isinstance(trial.brdf, AngleSumBRDF):
        return None
    try:
        forecast = foresee(
            captures.observer, captures.card, trial.brdf, trial.source, noise=trial.noise, weights=captures.transport
        )
        bound = forecast.source_error
        if support is not None:
            bound = bound_within(trial, trial.brdf, math.radians(support), forecast.step_deg)
    except (UndeterminedError, np.linalg.LinAlgError):
        return None
    return bound if math.isfinite(bound) else None


def bound_within(trial: Trial, brdf: AngleSumBRDF, support: float, step_deg: float) -> float:
    """The bound at the truth among BRDFs that end at a support in radians."""
    problem, _ = prepare(trial.captures, few_captures=True)
    grid, designs = problem.designs(step_deg, degree=3, tolerance=1e-5)
    summed = moments(problem.data, restricted(grid, designs, support), np.ones(problem.data.shape))
    coefficients = np.where(summed.seen, closest_spline(grid, brdf), 0.0)
    gauge = grid.row(grid.peak(coefficients, summed.exposure))
    return trial.noise * cramer_rao(summed, coefficients, trial.source, gauge=gauge).source_error


def judge(number: int, seed: int, facets: bool = False, wall: WallModel = "auto", few: bool = False) -> Outcome:
    """Solve one scene and hold the answer against the truth."""
    trial, decibels = draw(number, seed, facets, few)
    bound = knowable_to(trial)
    answer, reason, error, predicted, method = "refused", "", None, None, ""
    try:
        solution = solve(trial.captures, wall=wall, **trial.priors)
        answer, method = solution.verdict, solution.method
        reason = solution.warnings[0] if solution.warnings else ""
        error, predicted = scale_free_error(solution.source, trial.source), solution.predicted_error
    except UndeterminedError as refusal:
        reason = str(refusal)
    return Outcome(
        number, trial.about, trial.spoilt, None if math.isinf(decibels) else decibels, bound, answer, reason, error,
        predicted, method,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_SCENES} scenes instead of {SCENES}")
    parser.add_argument("--scenes", type=int, help="another number of scenes")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--seed", type=int, default=0, help="root of all random numbers")
    parser.add_argument("--out", type=Path, help="folder to write to")
    parser.add_argument(
        "--facets", action="store_true", help="walls of rough facets, for which Hypothesis 8 does not hold"
    )
    parser.add_argument("--few", action="store_true", help="fewer captures than elements, with and without priors")
    parser.add_argument("--wall", choices=["angle_sum", "microfacet", "auto"], default="auto", help="wall to solve for")
    arguments = parser.parse_args()
    out = arguments.out or (Path("out/false_confidence") if arguments.quick else Path(__file__).parent)
    asked = ["facets"] * arguments.facets + ["few"] * arguments.few + [arguments.wall] * (arguments.wall != "auto")
    name = "_".join(["false_confidence", *asked])
    count = arguments.scenes or (QUICK_SCENES if arguments.quick else SCENES)
    started = time.perf_counter()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        outcomes = list(
            pool.map(
                judge,
                range(count),
                *([x] * count for x in (arguments.seed, arguments.facets, arguments.wall, arguments.few)),
                chunksize=5,
            )
        )
    seconds = time.perf_counter() - started
    false = [o for o in outcomes if o.answer == "good" and o.off]
    doubted = [o for o in outcomes if o.answer == "doubtful" and o.off]
    knowable = [o for o in outcomes if o.identifiable]
    solved = [o for o in knowable if o.answer != "refused" and not o.off]
    spoilt = [o for o in outcomes if o.spoilt]
    for o in [*false, *(o for o in knowable if o not in solved)]:
        state = "FALSE CONFIDENCE" if o in false else f"not solved ({o.answer})"
        found = "" if o.error is None else f"; off {o.error:.2g}, predicted {o.predicted:.2g}"
        print(f"{o.number}: {state}: {o.about}, {o.decibels} dB; bound {o.bound}{found}; {o.reason}")
    answers = Counter(o.answer for o in outcomes)
    share = len(solved) / max(1, len(knowable))
    print(f"{count} scenes: {answers['good']} good, {answers['doubtful']} doubtful, {answers['refused']} refused")
    print(f"false confidence: {len(false)} (doubtful ones off: {len(doubted)})")
    print(f"identifiable to {100 * KNOWABLE:g} %: {len(knowable)}, of which solved {len(solved)} ({100 * share:.1f} %)")
    print(f"spoilt: {len(spoilt)}, of which refused {sum(o.answer == 'refused' for o in spoilt)}")
    # No bound is computed for facets, and one at a pattern knows nothing of the others.
    passed = not false and (share >= 0.97 or arguments.facets or arguments.few)
    document = {
        "scenes": count,
        "seed": arguments.seed,
        "false_confidence": len(false),
        "identifiable": len(knowable),
        "solved": len(solved),
        "answers": dict(answers),
        "spoilt": {s: dict(Counter(o.answer for o in spoilt if o.spoilt == s)) for s in SPOILT},
        "seconds": seconds,
        "outcomes": [asdict(o) for o in outcomes],
    }
    write_atomically(out / "results" / f"{name}.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
    print("PASSED" if passed else "FAILED")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
