"""Where do the public functions break: every quantity at its extremes against every entry point.

    python validation/extremes.py [--entry NAME] [--out FOLDER]

The cells stand in extreme_cases, one module for each topic; how one is judged stands in extreme_cases/harness.py. Leaves
results/extremes.json and EXTREMES.md, and leaves with 1 on a fault.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from extreme_cases import (
    alternating,
    blind,
    bounces,
    bounds,
    brdfs,
    calibrating,
    capture_sets,
    channels,
    commands,
    comparing,
    convolutions,
    geometry,
    half_circle,
    invariances,
    inverse,
    kernels,
    lost_light,
    moving_camera,
    operators,
    planning,
    regularising,
    rendering,
    richardson_lucy,
    scene_files,
    single_files,
    solver_options,
    solving,
    tables,
    transport,
)
from extreme_cases.harness import Case, Cell, run

from wallmirror.files import write_atomically

HERE = Path(__file__).parent
#: The topics, in the order of the page.
TOPICS = (
    *(geometry, brdfs, tables, transport, kernels, bounces, convolutions, half_circle),
    *(operators, regularising, richardson_lucy, channels, blind),
    *(solving, inverse, lost_light, solver_options, moving_camera, calibrating, alternating, bounds, invariances),
    *(rendering, comparing, planning),
    *(capture_sets, scene_files, single_files, commands),
)


def all_cases() -> list[Case]:
    """Every cell, in the order of the page."""
    return [case for topic in TOPICS for case in topic.cases()]


def page(cells: list[Cell]) -> str:
    """The table by entry point and quantity."""
    marks = {"right": "✓", "refused": "refused", "fault": "**FAULT**"}
    lines = []
    entries = dict.fromkeys(cell.entry for cell in cells)
    for entry in entries:
        lines += [
            f"## `{entry}`",
            "",
            "| quantity | value | outcome | error (allowed), or the refusal |",
            "|---|---|---|---|",
        ]
        for c in (c for c in cells if c.entry == entry):
            told = c.words if c.error is None else f"{c.error:.1e} ({c.tolerance:.1e})"
            lines.append(f"| {c.quantity} | {c.value} | {marks[c.outcome]} | {told.replace('|', '/')} |")
        lines.append("")
    counted = {outcome: sum(c.outcome == outcome for c in cells) for outcome in marks}
    head = (
        f"# Extremes\n\n{len(cells)} cells: {counted['right']} right, {counted['refused']} refused with a sentence, "
        f"{counted['fault']} faults. Made by `python validation/extremes.py`; what each outcome means stands there.\n\n"
    )
    return head + "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entry", help="only entry points whose name begins so")
    parser.add_argument("--out", type=Path, default=HERE, help="folder for results/extremes.json and EXTREMES.md")
    arguments = parser.parse_args()
    started = time.perf_counter()
    cells = []
    for case in all_cases():
        if arguments.entry and not case.entry.startswith(arguments.entry):
            continue
        cells.append(run(case))
        if cells[-1].outcome == "fault":
            print(f"FAULT {case.entry}: {case.quantity} {case.value}: {cells[-1].words}", flush=True)
    faults = sum(cell.outcome == "fault" for cell in cells)
    print(f"{len(cells)} cells, {faults} faults, {time.perf_counter() - started:.0f} s")
    if not arguments.entry:
        document = json.dumps([asdict(cell) for cell in cells], indent=1, allow_nan=False) + "\n"
        write_atomically(arguments.out / "results" / "extremes.json", document)
        write_atomically(arguments.out / "EXTREMES.md", page(cells))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
