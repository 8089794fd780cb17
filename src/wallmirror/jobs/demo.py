"""`wallmirror demo`: the main job end to end, and what happens to it when light bounces more than once."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wallmirror.brdf import AngleSumBRDF, directional_albedo
from wallmirror.files import write_atomically
from wallmirror.jobs.capturing import capture_scene
from wallmirror.jobs.solution_report import solution_sections
from wallmirror.jobs.solution_report import verdicts as solution_verdicts
from wallmirror.jobs.solved import Solved
from wallmirror.jobs.solving import solve_directory
from wallmirror.jobs.validating_one import Validation, validate_scene
from wallmirror.jobs.validation_report import numbers
from wallmirror.jobs.validation_report import verdict as validation_verdict
from wallmirror.pathtracing.rendering import picture
from wallmirror.pathtracing.runtime import Runtime, activate
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.figures import error_bars, photograph, radiance_maps, scene_plan, score_histogram
from wallmirror.scene import Scene, load_scene

#: Opens a progress display for one stage and yields the callback to advance it.
Stage = Callable[[str], Any]


@dataclass(frozen=True)
class Size:
    """How much the demo renders: views of the main scene and of the others, pixels, samples, pictures."""

    views: int
    other_views: int
    pixels: int
    spp: int
    validation_spp: int
    picture_width: int
    picture_spp: int
    others: tuple[str, ...]


FULL = Size(20, 10, 500, 1024, 256, 640, 64, ("cornell_lobes", "reflective_card"))
#: Without LLVM one sample costs about a thousand times more.
REDUCED = Size(4, 0, 48, 512, 4, 64, 2, ())


@dataclass(frozen=True)
class Run:
    """One capture set of the demo, solved: its scene, the depth of its paths, and what came out."""

    scene: Scene
    depth: int
    solved: Solved


@dataclass(frozen=True)
class Demo:
    """What the demo found."""

    runtime: Runtime
    validation: Validation
    runs: tuple[Run, ...]
    report: Path
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether model and solver did what they promise: the model holds, and no wrong answer came without a warning."""
        return self.validation.passed and all(_is_honest(run.solved) for run in self.runs)

    def summary(self) -> dict[str, Any]:
        """The JSON document of the command."""
        return {
            "passed": self.passed,
            "seconds": self.seconds,
            "variant": self.runtime.variant,
            "report": str(self.report),
            "validation": self.validation.summary(),
            "runs": [
                {"scene": run.scene.name, "max_depth": run.depth, "solution": run.solved.summary()} for run in self.runs
            ],
        }


def run_demo(out: Path, *, seed: int = 0, stage: Stage, tell: Callable[[str], None]) -> Demo:
    """Render, write, read back, compare and solve three scenes; leaves report.html, results.json and the captures.

    Parameters
    ----------
    out:
        Folder for everything.
    stage:
        Context manager that shows the progress of one stage.
    tell:
        Receives remarks.
    """
    started = time.perf_counter()
    runtime = activate()
    size = REDUCED if runtime.reduced else FULL
    if runtime.reduced:
        tell(f"{runtime.advice}; going on with a much smaller job")
    main = _sized(load_scene("flat_wall_lobes"), size, size.views)
    runs = [_run(main, 2, out, size, seed, runtime, stage)]
    with stage("comparing with the analytic model") as advance:
        validation = validate_scene(
            main,
            views=min(5, size.views),
            spp=size.validation_spp,
            seed=seed,
            variant=runtime.variant,
            progress=advance,
        )
    for name in size.others:
        scene = _sized(load_scene(name), size, size.other_views)
        runs.extend(_run(scene, depth, out, size, seed, runtime, stage) for depth in (2, scene.render.max_depth))
    with stage("picturing the scenes") as advance:
        pictures = {}
        scenes = {run.scene.name: run.scene for run in runs}
        for number, (name, scene) in enumerate(scenes.items(), 1):
            width = size.picture_width
            pictures[name] = picture(scene, width, width * 9 // 16, spp=size.picture_spp, variant=runtime.variant)
            advance(number, len(scenes))
    report = out / "report.html"
    demo = Demo(runtime, validation, tuple(runs), report, time.perf_counter() - started)
    _write_report(demo, pictures)
    write_atomically(out / "results.json", json.dumps(demo.summary(), indent=2, allow_nan=False) + "\n")
    return demo


def _sized(scene: Scene, size: Size, views: int) -> Scene:
    angles = scene.observer.view_angles
    picked = tuple(angles[round(i * (len(angles) - 1) / max(1, views - 1))] for i in range(views))
    return replace(scene, observer=replace(scene.observer, view_angles=picked, pixels=size.pixels))


def _run(scene: Scene, depth: int, out: Path, size: Size, seed: int, runtime: Runtime, stage: Stage) -> Run:
    folder = out / f"{scene.name}_depth{depth}"
    with stage(f"filming {scene.name}, {_bounces(depth)}") as advance:
        capture_scene(
            scene,
            folder / "captures",
            spp=size.spp,
            seed=seed,
            max_depth=depth,
            variant=runtime.variant,
            restart=True,
            progress=advance,
        )
    with stage(f"solving {scene.name}, {_bounces(depth)}"):
        albedo = directional_albedo(scene.wall.brdf) if isinstance(scene.wall.brdf, AngleSumBRDF) else None
        solved = solve_directory(folder / "captures", folder / "solution", wall_albedo=albedo)
    return Run(scene, depth, solved)


def _bounces(depth: int) -> str:
    return "one bounce" if depth == 2 else f"up to {depth - 1} bounces"


def _is_honest(solved: Solved) -> bool:
    """Error within twice the error bars, or a warning that says otherwise."""
    judgement, solution = solved.judgement, solved.solution
    assert judgement is not None
    return judgement.source_error <= 2 * solution.predicted_error or solution.verdict == "doubtful"


def _write_report(demo: Demo, pictures: dict[str, Any]) -> None:
    main, others = demo.runs[0], demo.runs[1:]
    c = demo.validation.comparison
    sections = [
        Section(
            "The question",
            (
                "A camera looks at a flat wall. Out of its sight a small card glows with a pattern that nobody knows. The "
                "wall is no mirror: it sends light into four blurred directions, and how it does so (its BRDF) is not "
                "known either. From the light on the wall alone, both are recovered together.",
                f"For this page Mitsuba 3, a path tracer that knows nothing of our model, filmed the wall: "
                f"{main.scene.observer.views} views of {main.scene.observer.pixels} pixels, with "
                f"{main.scene.source.shape[1]} different patterns on the card. The {main.scene.observer.views} × "
                f"{main.scene.source.shape[1]} films were written as EXR files and read back; the solver saw only those "
                "and the geometry.",
            ),
        ),
        Section(
            "The scene",
            (
                FigureBlock(
                    scene_plan(main.scene.observer, main.scene.card, half_width=main.scene.wall.half_width),
                    "From above, to scale. The camera turns about its place and sees the wall in the blue fields of view; "
                    "the card's elements (orange) face the wall and stay out of its sight.",
                ),
                FigureBlock(
                    photograph(pictures[main.scene.name]),
                    "The wall as a visitor would see it, rendered by Mitsuba: each element of the card leaves four streaks.",
                ),
            ),
        ),
        *solution_sections(main.solved),
        Section(
            "Does the model hold?",
            (
                "The solver is as good as its model of light. So the same views were rendered by Mitsuba with 32 "
                "independent seeds and held against our analytic transport, which shares no code with it.",
                validation_verdict(demo.validation),
                FigureBlock(
                    radiance_maps(demo.validation.reference, demo.validation.mean, c),
                    f"{len(demo.validation.views)} of the views: analytic and path-traced radiance on one scale, and "
                    "their difference in standard errors. Noise alone leaves no structure.",
                ),
                *(
                    ()
                    if c.exact
                    else (FigureBlock(score_histogram(c), "The same differences against the normal curve."),)
                ),
                numbers(demo.validation),
            ),
        ),
    ]
    if others:
        sections.append(_bounces_section(demo, pictures))
    write_page(
        demo.report,
        title="A wall turned into a mirror",
        lead=main.solved.solution.status,
        verdicts=[
            *solution_verdicts(main.solved),
            validation_verdict(demo.validation),
            *(_honesty(run) for run in others if run.depth > 2),
        ],
        sections=sections,
    )


def _honesty(run: Run) -> Verdict:
    judgement, solution = run.solved.judgement, run.solved.solution
    assert judgement is not None
    warned = "and warned of it" if solution.verdict == "doubtful" else "and did not warn"
    return Verdict(
        _is_honest(run.solved),
        f"{run.scene.title}, {_bounces(run.depth)}: the one-bounce solver is {100 * judgement.source_error:.2g} % off, "
        f"its error bars said {100 * solution.predicted_error:.2g} %, {warned}.",
    )


def _bounces_section(demo: Demo, pictures: dict[str, Any]) -> Section:
    rows, bars = [], []
    for run in demo.runs:
        solution, judgement = run.solved.solution, run.solved.judgement
        assert judgement is not None
        check = solution.one_bounce
        rows.append(
            (
                run.scene.title,
                _bounces(run.depth),
                f"{100 * judgement.source_error:.2g} %",
                f"{100 * solution.predicted_error:.2g} %",
                "nothing reflects" if check is None else f"{100 * check.share:.2g} %",
                "-" if check is None else f"{100 * check.bias:.2g} %",
                solution.verdict,
            )
        )
        bars.append((f"{run.scene.name}, {_bounces(run.depth)}", judgement.source_error, solution.predicted_error))
    table = TableBlock(
        (
            "scene",
            "filmed with",
            "error of the pattern",
            "its error bars",
            "further light, foretold",
            "bias, foretold",
            "solver's verdict",
        ),
        tuple(rows),
    )
    scenes = {run.scene.name: run.scene for run in demo.runs[1:]}
    return Section(
        "When light bounces more than once",
        (
            "The model knows one bounce on the wall (Hypothesis 2 of the thesis). A white card or the walls of a room "
            "send light back, and another pattern explains that light almost as well: the misfit hardly shows it. So the "
            "solver asks the known geometry instead: it computes the light that card and room would send back, takes it "
            "from the films, solves once more, and warns when the pattern turns by more than half its error bars. The "
            "films cut off after one bounce are controls that only a computer can make.",
            table,
            FigureBlock(error_bars(bars), "Measured error of the pattern beside what the solver's error bars claim."),
            *(
                FigureBlock(photograph(pictures[name]), f"{scene.title}. {scene.about}")
                for name, scene in scenes.items()
            ),
        ),
    )
