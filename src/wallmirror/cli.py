"""The command line: a thin skin over public functions; exit 0 good, 1 a verdict failed, 2 bad input, 3 undetermined."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from wallmirror.console import Terminal
from wallmirror.errors import InputError, WallmirrorError

app = typer.Typer(
    name="wallmirror",
    help="Turn a wall into a mirror: recover a wall's BRDF and a hidden card's pattern from the light on the wall.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, everything else on stderr.")]
Seed = Annotated[int, typer.Option(min=0, help="Root of all random numbers.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]


@app.command(epilog="Example: wallmirror demo -o out/demo")
def demo(out: Out = Path("out/demo"), seed: Seed = 0, as_json: AsJson = False) -> None:
    """Render, compare and solve three scenes, and leave one page that shows how well it went."""
    from wallmirror.jobs.demo import run_demo

    terminal = Terminal(as_json=as_json)
    result = run_demo(out, seed=seed, stage=terminal.progress, tell=terminal.note)
    rows = []
    for run in result.runs:
        solution, judgement = run.solved.solution, run.solved.judgement
        if judgement is not None:
            rows.append(
                [
                    run.scene.name,
                    str(run.depth - 1),
                    f"{100 * judgement.source_error:.2g} %",
                    f"{100 * solution.predicted_error:.2g} %",
                    "-" if solution.one_bounce is None else f"{100 * solution.one_bounce.bias:.2g} %",
                    solution.verdict,
                ]
            )
    terminal.table(["scene", "bounces", "error", "error bars", "bias foretold", "verdict"], rows)
    gain = result.validation.comparison.gain
    terminal.say(
        f"model against Mitsuba: gain - 1 = {gain.estimate:+.1e} ± {gain.standard_error:.0e}, "
        f"{'not told apart' if result.validation.passed else 'REJECTED'}"
    )
    terminal.say(f"{'PASSED' if result.passed else 'FAILED'} in {result.seconds:.0f} s; open {result.report}")
    terminal.document(result.summary())
    raise typer.Exit(0 if result.passed else 1)


@app.command(epilog="Example: wallmirror doctor --json")
def doctor(as_json: AsJson = False) -> None:
    """Look at everything that rendering needs, and say what to do about each fault."""
    from wallmirror.pathtracing.diagnosis import diagnose

    terminal = Terminal(as_json=as_json)
    findings = diagnose()
    terminal.table(
        ["", "looked at", "found"],
        [["ok" if f.ok else "FAULT", f.name, f.detail + (f" -> {f.remedy}" if f.remedy else "")] for f in findings],
    )
    good = all(f.ok for f in findings)
    terminal.say("All is well." if good else "Mend the faults above; wallmirror uses what works until then.")
    terminal.document({"ok": good, "findings": [vars(f) for f in findings]})
    raise typer.Exit(0 if good else 1)


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
    from wallmirror.jobs.validating import QUICK_SPP, QUICK_VIEWS, SPP, VIEWS, validate_scenes, verdict
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
        int | None, typer.Option(min=1, help="Samples per pixel; the plan's or the scene's own if left out.")
    ] = None,
    max_depth: Annotated[int | None, typer.Option(min=2, help="2 is one bounce; the scene's own if left out.")] = None,
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


@app.command(epilog="Example: wallmirror solve out/box -o out/box_solved")
def solve(
    context: typer.Context,
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIRECTORY", help="Folder with captures.toml and its EXR files.")
    ],
    out: Out = Path("out/solution"),
    method: Annotated[
        str, typer.Option(help="auto, closed_form, maximum_likelihood, few_captures or poisson.")
    ] = "auto",
    general: Annotated[
        bool,
        typer.Option(
            "--general", help="A BRDF of both angles, from a folder for each of several positions of the camera."
        ),
    ] = False,
    reciprocal: Annotated[
        bool, typer.Option("--reciprocal", help="General: the BRDF is the same with its angles exchanged.")
    ] = False,
    wall: Annotated[
        str,
        typer.Option(
            help="angle_sum, microfacet (two exponents more, for walls of rough facets), or auto: what the films require."
        ),
    ] = "angle_sum",
    nonnegative: Annotated[bool, typer.Option(help="Keep BRDF and pattern >= 0.")] = True,
    support_deg: Annotated[
        float | None, typer.Option(help="Few captures: the BRDF is 0 beyond this angle sum (degrees).")
    ] = None,
    step_deg: Annotated[
        float | None, typer.Option(help="Knot spacing of the BRDF; the data choose if left out.")
    ] = None,
    counts: Annotated[float | None, typer.Option(help="Poisson: counts that a radiance of 1 makes.")] = None,
    background: Annotated[float, typer.Option(help="Poisson: mean counts of an unlit pixel.")] = 0.0,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Find the card's offset, distance and width from the captures first.")
    ] = False,
    scale: Annotated[str, typer.Option(help="What settles the scale: peak, albedo or level.")] = "peak",
    wall_albedo: Annotated[
        float | None, typer.Option(help="The wall's albedo, if known, for the one-bounce check and --scale albedo.")
    ] = None,
    source_level: Annotated[
        float | None, typer.Option(help="The pattern's mean radiance, if known, for --scale level.")
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Error of the pattern that is good enough; exit 1 where the answer is not known so well."),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Recover the card's pattern and the wall's BRDF from a capture set, with error bars and certificates."""
    from wallmirror.jobs.solving import solve_directory

    terminal = Terminal(as_json=as_json)
    if general:
        _solve_general(context, directories, out, reciprocal, step_deg, terminal)
        return
    if reciprocal:
        raise InputError("has a meaning with --general alone; leave it out", field="reciprocal")
    if len(directories) > 1:
        raise InputError(
            f"names {len(directories)} capture sets; one is solved at a time, or all together with --general",
            field="directory",
        )
    solved = solve_directory(
        directories[0],
        out,
        calibrated=calibrate,
        progress=terminal.note,
        method=method,  # type: ignore[arg-type]  # `solve` checks it and names the choices
        wall=wall,  # type: ignore[arg-type]
        nonnegative=nonnegative,
        support_deg=support_deg,
        step_deg=step_deg,
        counts_per_radiance=counts,
        background=background,
        scale=scale,  # type: ignore[arg-type]
        wall_albedo=wall_albedo,
        source_level=source_level,
        tolerance=tolerance,
        seed=seed,
    )
    if solved.calibration is not None:
        terminal.say(solved.calibration.status)
    solution = solved.solution
    terminal.say(solution.status)
    for warning in solution.warnings[1:]:
        terminal.say(f"warning: {warning}")
    if solved.judgement is not None:
        terminal.say(f"against the known truth: the pattern is {100 * solved.judgement.source_error:.2g} % off")
    if solved.shortfall:
        terminal.say(f"FAILED: {solved.shortfall}")
    terminal.say(f"open {out / 'report.html'}")
    terminal.document(solved.summary())
    raise typer.Exit(1 if solved.shortfall else 0)


def _solve_general(
    context: typer.Context,
    directories: list[Path],
    out: Path,
    reciprocal: bool,
    step_deg: float | None,
    terminal: Terminal,
) -> None:
    from wallmirror.jobs.solving_general import solve_directories

    meant = {"directories", "out", "general", "reciprocal", "step_deg", "as_json"}
    for name in context.params:
        given = context.get_parameter_source(name)
        if name not in meant and given is not None and given.name == "COMMANDLINE":
            raise InputError("has no meaning with --general; leave it out", field=name)
    solved = solve_directories(directories, out, reciprocal=reciprocal, step_deg=step_deg, progress=terminal.note)
    terminal.say(solved.solution.status)
    if solved.source_error is not None:
        terminal.say(f"against the known truth: the pattern is {100 * solved.source_error:.2g} % off")
    terminal.say(f"open {out / 'report.html'}")
    terminal.document(solved.summary())


@app.command(epilog="Example: wallmirror figures 3.2 3.3 -o out/figures")
def figures(
    ids: Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="Such as 3.9; all if left out.")] = None,
    out: Out = Path("out/figures"),
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Make the thesis's figures again, with the numbers behind them and what becomes of its claims."""
    from wallmirror.thesis import make_figures

    terminal = Terminal(as_json=as_json)
    with terminal.progress("figures") as advance:
        made = make_figures(ids or (), out, seed=seed, progress=advance)
    for one in made:
        terminal.say(f"{one.figure.id:<18}{one.figure.title}: {one.figure.line}")
    terminal.say(f"open {out / 'gallery.html'}")
    terminal.document({"figures": [one.summary() for one in made]})


@app.command(epilog="Example: wallmirror tradeoff forward --quick -o out/tradeoff")
def tradeoff(
    panels: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PANEL]...", help="forward, inverse, budget, scaling; all if left out."),
    ] = None,
    out: Out = Path("out/tradeoff"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and smaller runs, within a minute.")] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure what a second buys: error against seconds of models, path tracer and solvers, and what sizes cost."""
    from wallmirror.jobs.trading import measure_tradeoffs

    terminal = Terminal(as_json=as_json)
    with terminal.progress("measuring, per cent") as advance:
        traded = measure_tradeoffs(panels or (), out, quick=quick, seed=seed, progress=advance)
    for panel in traded.panels:
        terminal.say(panel.title, style="bold")
        for statement in panel.conclusions:
            mark = {True: "ok    ", False: "FAIL  ", None: "      "}[statement.met]
            terminal.say(mark + statement.text)
    terminal.say(f"{'PASSED' if traded.passed else 'FAILED'} in {traded.seconds:.0f} s; open {out / 'tradeoff.html'}")
    terminal.document(traded.summary())
    raise typer.Exit(0 if traded.passed else 1)


def main(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit code; every foreseen failure is one sentence."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        app(given)
    except WallmirrorError as error:
        terminal = Terminal(as_json="--json" in given)
        terminal.error(str(error))
        document: dict[str, Any] = {"error": str(error), "exit_code": error.exit_code}
        terminal.document(document)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, SystemExit) as end:  # Typer turns Ctrl-C into exit code 130 without a word
        if isinstance(end, SystemExit) and end.code != 130:
            raise
        Terminal().error("interrupted; earlier results are untouched")
        sys.exit(130)


if __name__ == "__main__":
    main()
