"""What a scene needs, its films, and whether the model holds there: `validate`, `advise` and `capture`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wallmirror.cli.options import AsJson, Out, Seed, app
from wallmirror.console import Terminal
from wallmirror.errors import InputError


@app.command(epilog="Example: wallmirror validate flat_wall_lobes -o out/validate")
def validate(
    scenes: Annotated[
        list[str] | None, typer.Argument(help="Scene names or .toml files; all of ours if left out.")
    ] = None,
    out: Out = Path("out/validate"),
    views: Annotated[int | None, typer.Option(min=1, help="Views of each scene to compare: 8, or 3 if quick.")] = None,
    spp: Annotated[
        int | None,
        typer.Option(min=4, max=1024, help="Samples per pixel of each of the 32 seeds: 256, or 64 if quick."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer views and samples: sees only larger faults.")] = False,
    bounces: Annotated[
        bool, typer.Option("--bounces", help="Measure each bounce instead: is one enough (Hypothesis 2)?")
    ] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Gain error that must show, e.g. 0.001: views and samples follow. With --bounces: share of the light "
            "that one bounce may leave out."
        ),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Test the analytic one-bounce model against Mitsuba, scene by scene, and say what bias would have shown."""
    from wallmirror.jobs.validating import validate_scenes
    from wallmirror.jobs.validating_one import QUICK_SPP, QUICK_VIEWS, SPP, VIEWS
    from wallmirror.jobs.validation_report import verdict
    from wallmirror.scene import Scene, load_scene, scene_names

    terminal = Terminal(as_json=as_json)
    if tolerance is not None and not 0 < tolerance < 1:
        raise InputError(f"is {tolerance:g}; give a share between 0 and 1", field="--tolerance")
    if bounces:
        from wallmirror.jobs.counting_bounces import count_bounces

        asked = [load_scene(name) for name in (scenes or scene_names())]
        with terminal.progress("counting bounces") as advance:
            counted = count_bounces(
                asked, out, tolerance=tolerance, quick=quick, views=views, spp=spp, seed=seed, progress=advance
            )
        for one in counted:
            terminal.say(("" if tolerance is None else "ok    " if one.passed else "FAIL  ") + one.text)
        enough = all(r.passed for r in counted)
        verdict_word = "" if tolerance is None else "PASSED; " if enough else "FAILED; "
        terminal.say(f"{verdict_word}open {out / 'bounces.html'}")
        terminal.document({"passed": enough, "scenes": [r.summary() for r in counted]})
        raise typer.Exit(0 if enough else 1)
    loaded = [load_scene(name) for name in (scenes or scene_names())]

    def effort(scene: Scene) -> tuple[int, int]:
        if tolerance is None:
            return (QUICK_VIEWS, QUICK_SPP) if quick else (VIEWS, SPP)
        from wallmirror.jobs.advising import advise as plan_for

        plan = plan_for(scene, tolerance, parts=("validate",), seed=seed).validate
        if plan is None:
            raise InputError("has points for strips or pixels, which paths never meet", field=scene.name)
        terminal.note(f"{scene.name}: planned {plan.views} views, 32 seeds of {plan.spp} samples")
        return plan.views, plan.spp

    with terminal.progress("validating") as advance:
        results = validate_scenes(
            loaded, out, views=views, spp=spp, tolerance=tolerance, effort=effort, seed=seed, progress=advance
        )
    for result in results:
        terminal.say(("ok    " if result.passed else "FAIL  ") + verdict(result).text)
    passed = all(r.passed for r in results)
    terminal.say(f"{'PASSED' if passed else 'FAILED'}; open {out / 'report.html'}")
    terminal.document({"passed": passed, "scenes": [r.summary() for r in results]})
    raise typer.Exit(0 if passed else 1)


@app.command(epilog="Example: wallmirror advise flat_wall_lobes --tolerance 0.01")
def advise(
    scene: Annotated[str, typer.Argument(help="A scene's name, or a .toml file.")],
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Error wanted: rms over all films in units of their rms radiance.")
    ] = 0.01,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure what a scene needs to reach an accuracy: which simplifications hold, and the cheapest settings."""
    from wallmirror.jobs.advising import advise as plan_for
    from wallmirror.planning.words import hypothesis_rows, percent, plan_rows
    from wallmirror.scene import load_scene

    terminal = Terminal(as_json=as_json)
    plan = plan_for(load_scene(scene), tolerance, seed=seed, progress=terminal.note)
    terminal.say(f"{plan.scene}: the cheapest ways to an error of {percent(tolerance)}")
    terminal.say()
    terminal.table(["to", "do", "error", "time here"], plan_rows(plan), words=2)
    terminal.say()
    terminal.table(["", "simplification", "", "error alone"], hypothesis_rows(plan), words=3)
    terminal.say("* after the best global scale, as the formula has none of its own")
    for note in plan.notes:
        terminal.say(f"note: {note}")
    terminal.document(plan.summary())
    raise typer.Exit(0 if plan.reached else 1)


@app.command(epilog="Example: wallmirror capture cornell_lobes -o out/box --max-depth 50")
def capture(
    scene: Annotated[str, typer.Argument(help="A scene's name, or a .toml file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the capture set.")],
    spp: Annotated[
        int | None, typer.Option(min=1, max=2**24, help="Samples per pixel; the plan's or the scene's own if left out.")
    ] = None,
    max_depth: Annotated[
        int | None, typer.Option(min=2, max=1000, help="2 is one bounce; the scene's own if left out.")
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Error wanted, as for `advise`, which then chooses samples, seeds and depth."),
    ] = None,
    restart: Annotated[bool, typer.Option("--restart", help="Throw away what an interrupted run left.")] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Render a scene's views and patterns to EXR files with a captures.toml, ready to solve.

    The same command goes on where an interrupted one stopped.
    """
    from wallmirror.captures.unfinished import unfinished_folder
    from wallmirror.jobs.capturing import capture_scene
    from wallmirror.scene import load_scene

    terminal = Terminal(as_json=as_json)
    loaded = load_scene(scene)
    plan = None
    if tolerance is not None:
        from wallmirror.jobs.advising import plan_capture
        from wallmirror.jobs.capturing import planned_before
        from wallmirror.planning.words import capture_line

        kept = None if restart else planned_before(loaded, out, tolerance)
        plan = kept or plan_capture(loaded, tolerance, seed=seed)
        terminal.note(f"planned: {capture_line(plan)}")
    try:
        with terminal.progress(f"filming {loaded.name}") as advance:
            captures = capture_scene(
                loaded, out, spp=spp, seed=seed, max_depth=max_depth, plan=plan, restart=restart, progress=advance
            )
    except KeyboardInterrupt:
        if unfinished_folder(out).is_dir():
            terminal.note(f"what is finished lies in {unfinished_folder(out)}; the same command goes on from there")
        raise
    views, pixels, realisations = captures.radiance.shape
    terminal.say(f"{views} views x {realisations} patterns of {pixels} pixels in {out}")
    terminal.say(f"next: wallmirror solve {out} -o {out.with_name(out.name + '_solved')}")
    terminal.document(
        {"directory": str(out), "views": views, "pixels": pixels, "realisations": realisations, **captures.provenance}
    )
