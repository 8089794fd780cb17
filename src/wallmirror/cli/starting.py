"""What a newcomer runs first: `demo` and `doctor`."""

from __future__ import annotations

from pathlib import Path

import typer

from wallmirror.cli.options import AsJson, Out, Seed, app
from wallmirror.console import Terminal


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
