"""The files of a solution: tables as CSV, and all of them written together."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wallmirror.files import write_together

Array = NDArray[np.float64]


def write_results(out: Path, *, source: str, brdf: str, page: str, summary: dict[str, Any]) -> None:
    """Write the four files of a solution, all or none of them: source.csv, brdf.csv, report.html and solution.json."""
    write_together(
        out,
        {
            "source.csv": source,
            "brdf.csv": brdf,
            "report.html": page,
            # Last, so that its presence says that the rest is complete.
            "solution.json": json.dumps(summary, indent=2, allow_nan=False) + "\n",
        },
    )


def csv_text(header: list[str], rows: list[list[float]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def source_csv(source: Array, std: Array) -> str:
    """A pattern (M, B) with its standard deviations, a row for each entry."""
    elements, realisations = source.shape
    rows = [[i, b, source[i, b], std[i, b]] for b in range(realisations) for i in range(elements)]
    return csv_text(["element", "realisation", "radiance", "standard_deviation"], rows)
