"""The thesis again, and what a second buys: `figures` and `tradeoff`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wallmirror.cli.options import AsJson, Out, Seed, app
from wallmirror.console import Terminal


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
    full: Annotated[
        bool, typer.Option("--full", help="Scaling: on to the largest sizes that 16 GB hold, half an hour.")
    ] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure what a second buys: error against seconds of models, path tracer and solvers, and what sizes cost."""
    from wallmirror.jobs.trading import measure_tradeoffs

    terminal = Terminal(as_json=as_json)
    with terminal.progress("measuring, per cent") as advance:
        traded = measure_tradeoffs(panels or (), out, quick=quick, full=full, seed=seed, progress=advance)
    for panel in traded.panels:
        terminal.say(panel.title, style="bold")
        for statement in panel.conclusions:
            mark = {True: "ok    ", False: "FAIL  ", None: "      "}[statement.met]
            terminal.say(mark + statement.text)
    terminal.say(f"{'PASSED' if traded.passed else 'FAILED'} in {traded.seconds:.0f} s; open {out / 'tradeoff.html'}")
    terminal.document(traded.summary())
    raise typer.Exit(0 if traded.passed else 1)
