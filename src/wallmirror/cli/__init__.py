"""The command line: a thin skin over public functions; exit 0 good, 1 a verdict failed, 2 bad input, 3 undetermined."""

from __future__ import annotations

import sys
from typing import Any

# Each module adds its commands to `app`, which lists them in this order.
from wallmirror.cli import starting, filming, solving, studying  # isort: skip
from wallmirror.cli.options import app
from wallmirror.console import Terminal
from wallmirror.errors import WallmirrorError

# With which Typer leaves where options or arguments are wrong, once it has said so.
_MISUSED = 2

__all__ = ["app", "filming", "main", "solving", "starting", "studying"]


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
            if end.code == _MISUSED and "--json" in given:
                told = getattr(end.__context__, "format_message", lambda: "the command was not understood")()
                Terminal(as_json=True).document({"error": told, "exit_code": _MISUSED})
            raise
        Terminal().error("interrupted; earlier results are untouched")
        sys.exit(130)
