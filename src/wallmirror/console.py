"""The one place that talks to the terminal: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

#: Reports progress of a long job: called with (done, total).
Advance = Callable[[int, int], None]

_PLAIN_INTERVAL = 5.0


def _console(stream: TextIO) -> Console:
    """Wide where nobody watches, so that tables in files keep their rows on one line."""
    return Console(file=stream, highlight=False, soft_wrap=True, width=None if stream.isatty() else 160)


class Terminal:
    """What a command says, for people or (`as_json`) as one JSON document on stdout.

    Parameters
    ----------
    as_json:
        Print only the final JSON document on stdout; notes and progress go to stderr all the same.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        self.as_json = as_json
        self._out = _console(sys.stderr if as_json else sys.stdout)
        self._err = _console(sys.stderr)

    def say(self, text: str = "", *, style: str | None = None) -> None:
        """A line of the result for people."""
        self._out.print(text, style=style, markup=False)

    def note(self, text: str) -> None:
        """A remark on stderr: what happens now."""
        self._err.print(text, style="dim", markup=False)

    def error(self, text: str) -> None:
        """The one sentence of a failure, on stderr."""
        self._err.print(f"wallmirror: {text}", style="bold red", markup=False)

    def table(self, columns: list[str], rows: list[list[str]], *, words: int = 1) -> None:
        """A small table of results; the first columns, `words` of them, are left-aligned, the others right."""
        table = Table(box=None, pad_edge=False, header_style="bold")
        for i, column in enumerate(columns):
            table.add_column(column, justify="left" if i < words else "right", overflow="fold")
        for row in rows:
            table.add_row(*row)
        self._out.print(table)

    def document(self, content: dict[str, Any]) -> None:
        """The JSON document, when one was asked for."""
        if self.as_json:
            sys.stdout.write(json.dumps(content, indent=2, allow_nan=False) + "\n")
            sys.stdout.flush()

    @contextmanager
    def progress(self, what: str) -> Iterator[Advance]:
        """A progress bar where stderr is a terminal, else a plain line every few seconds."""
        if self._err.is_terminal:
            with Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                console=self._err,
                transient=True,
            ) as bar:
                task = bar.add_task(what, total=None)
                yield lambda done, total: bar.update(task, completed=done, total=total)
            return
        last = time.monotonic()

        def advance(done: int, total: int) -> None:
            nonlocal last
            now = time.monotonic()
            if done == total or now - last >= _PLAIN_INTERVAL:
                last = now
                self.note(f"{what}: {done} of {total}")

        yield advance
