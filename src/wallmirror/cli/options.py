"""The application, and the options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
