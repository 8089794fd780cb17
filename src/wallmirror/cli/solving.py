"""From films to pattern and BRDF: `solve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wallmirror.cli.options import AsJson, Out, Seed, app
from wallmirror.console import Terminal
from wallmirror.errors import InputError


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
            help="angle_sum, microfacet (rough facets: two exponents more), or auto: facets where the films ask for them."
        ),
    ] = "auto",
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
