"""`wallmirror figures`: the thesis's figures as files, and a page that holds its claims against our numbers."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from wallmirror.console import Advance
from wallmirror.files import write_atomically
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.thesis.catalogue import figure_ids, make_figure, require_figure
from wallmirror.thesis.figure import Outcome, ThesisFigure

_LEAD = (
    "Every figure of chapters 1 to 3 of the thesis, computed again, with the numbers behind it and what they make of the "
    "thesis's claims."
)


@dataclass(frozen=True)
class Made:
    """A figure and the seconds that it took."""

    figure: ThesisFigure
    seconds: float

    def summary(self) -> dict[str, Any]:
        """Everything but the picture and its columns, ready for JSON."""
        f = self.figure
        return {
            "id": f.id,
            "title": f.title,
            "numbers": dict(f.numbers),
            "claims": [asdict(claim) for claim in f.claims],
            "seconds": self.seconds,
        }


def make_figures(ids: Sequence[str], out: Path, *, seed: int = 0, progress: Advance | None = None) -> list[Made]:
    """Make the named figures, or all, and write each as PNG and CSV, with gallery.html, claims.md and results.json.

    Parameters
    ----------
    ids:
        Such as "3.9"; empty for all.
    out:
        Folder for the files; those of figures that were not asked for stay as they are.

    Raises
    ------
    InputError
        For an unknown id, before any figure is made.
    """
    chosen = tuple(dict.fromkeys(ids)) or figure_ids()
    for figure_id in chosen:
        require_figure(figure_id)
    made = []
    for number, figure_id in enumerate(chosen, 1):
        started = time.perf_counter()
        figure = make_figure(figure_id, seed=seed)
        made.append(Made(figure, time.perf_counter() - started))
        name = f"fig_{figure_id}"
        write_atomically(out / f"{name}.png", figure.to_png())
        write_atomically(out / f"{name}.csv", figure.to_csv())
        if progress is not None:
            progress(number, len(chosen))
    write_atomically(out / "results.json", json.dumps([m.summary() for m in made], indent=1, allow_nan=False) + "\n")
    write_atomically(out / "claims.md", claims_page(made))
    write_gallery(made, out / "gallery.html")
    return made


def claims_page(made: Sequence[Made]) -> str:
    """The thesis's claims beside our numbers as Markdown, for a repository."""
    rows = [(m.figure.id, c.thesis, c.outcome, c.measured) for m in made for c in m.figure.claims]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(
        [
            "# The thesis's claims, chapters 1 to 3",
            "",
            f"{_counted(made)} Made by `wallmirror figures`, whose gallery shows each figure; an outcome is computed from the "
            "numbers of the run.",
            "",
            "| figure | the thesis | verdict | measured |",
            "|---|---|---|---|",
            *lines,
            "",
        ]
    )


def _counted(made: Sequence[Made]) -> str:
    """How many claims came out how, in a sentence."""
    counted = Counter(claim.outcome for m in made for claim in m.figure.claims)
    told = ", ".join(f"{counted[outcome]} {outcome}" for outcome in get_args(Outcome) if counted[outcome])
    return f"{counted.total()} claim{'s' if counted.total() != 1 else ''} of the thesis: {told}."


def write_gallery(made: Sequence[Made], path: Path) -> None:
    """The page with every figure, its numbers, and the thesis's claims beside the measured ones."""
    claims = [(m.figure, claim) for m in made for claim in m.figure.claims]
    verdicts = [Verdict(None, _counted(made))] if claims else []
    table = TableBlock(
        ("figure", "the thesis", "verdict", "measured"),
        tuple((figure.id, claim.thesis, claim.outcome, claim.measured) for figure, claim in claims),
    )
    sections = [Section("Claims and numbers", (table,))] if claims else []
    sections += [Section(f"{m.figure.id} · {m.figure.title}", _blocks(m)) for m in made]
    write_page(path, title="The thesis's figures, made again", lead=_LEAD, verdicts=verdicts, sections=sections)


def _blocks(made: Made) -> tuple[str | FigureBlock | TableBlock | Verdict, ...]:
    figure = made.figure
    good = {"confirmed": True, "corrected": None, "refuted": False, "undecided": None}
    numbers = tuple((name, f"{number:.4g}") for name, number in figure.numbers.items())
    return (
        FigureBlock(figure.figure, figure.about),
        *([TableBlock(("measured", ""), numbers)] if numbers else []),
        *(Verdict(good[c.outcome], f"{c.outcome.capitalize()}: {c.thesis} {c.measured}") for c in figure.claims),
    )
