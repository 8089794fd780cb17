"""The frame of the thesis's figures: ids, files, the page, and that no figure hides what it is drawn from."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from wallmirror import InputError
from wallmirror.cli import app, main
from wallmirror.jobs.bouncing import Measured
from wallmirror.report.style import new_figure
from wallmirror.thesis import Claim, Made, ThesisFigure, figure_ids, make_figure, make_figures
from wallmirror.thesis.gallery import write_gallery
from wallmirror.thesis.picture_claims import _below


def a_figure(**changes) -> ThesisFigure:
    figure = new_figure(3, 2)
    figure.subplots().plot([0, 1], [0, 1])
    given = {
        "id": "3.99",
        "title": "A line",
        "about": "It rises.",
        "figure": figure,
        "columns": {"x (m)": np.arange(3.0), "y": [1.0]},
        "numbers": {"slope": 1.0},
        "claims": (Claim(thesis="It <falls>.", outcome="refuted", measured="It rises by 1."),),
    }
    return ThesisFigure(**{**given, **changes})


def test_ids_are_in_the_order_of_the_thesis_and_each_names_its_own_figure():
    ids = figure_ids()
    numbers = [tuple(int(n) for n in i.partition("-")[0].split(".")) for i in ids]
    chapters = [n[0] for n in numbers]
    assert chapters == sorted(chapters)
    assert len(set(ids)) == len(ids)
    assert make_figure("2.10").id == "2.10"


def test_every_figure_of_chapters_1_to_3_is_there():
    wanted = {f"1.{n}" for n in range(1, 6)} | {f"2.{n}" for n in range(1, 13)} | {f"3.{n}" for n in range(1, 15)}
    assert wanted <= set(figure_ids())


def test_csv_holds_every_column_whole():
    rows = list(csv.reader(io.StringIO(a_figure().to_csv())))
    assert rows == [["x (m)", "y"], ["0.0", "1.0"], ["1.0", ""], ["2.0", ""]]


@pytest.mark.parametrize("changes", [{"columns": {"image": np.zeros((2, 2))}}, {"numbers": {"slope": float("nan")}}])
def test_a_figure_without_sound_numbers_is_refused(changes):
    with pytest.raises(InputError, match=r"3\.99"):
        a_figure(**changes)


def test_a_claim_needs_a_known_outcome():
    with pytest.raises(InputError, match="outcome"):
        Claim(thesis="", outcome="maybe", measured="")  # type: ignore[arg-type]


def test_gallery_shows_claims_beside_numbers(tmp_path):
    write_gallery([Made(a_figure(), 1.0)], tmp_path / "gallery.html")
    page = (tmp_path / "gallery.html").read_text()
    assert "1 claim of the thesis: 1 refuted" in page
    assert "It &lt;falls&gt;." in page
    assert "It rises by 1." in page
    assert "slope" in page


def test_files_of_one_figure(tmp_path):
    (made,) = make_figures(["2.10"], tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        "fig_2.10.png",
        "fig_2.10.csv",
        "gallery.html",
        "claims.md",
        "results.json",
    }
    assert (tmp_path / "fig_2.10.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "results.json").read_text())[0]["numbers"] == dict(made.figure.numbers)


def test_command_line(tmp_path):
    result = CliRunner().invoke(app, ["figures", "2.10", "-o", str(tmp_path), "--json"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["figures"][0]["id"] == "2.10"
    with pytest.raises(SystemExit) as left:
        main(["figures", "7.1", "2.10", "-o", str(tmp_path / "none")])
    assert left.value.code == 2
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("low", "high", "outcome"), [(0.01, 0.04, "confirmed"), (0.06, 0.2, "refuted"), (0.04, 0.06, "undecided")]
)
def test_a_share_is_judged_as_far_as_its_interval_tells(low, high, outcome):
    assert _below(Measured(0.5 * (low + high), 0.0, low, high), 0.05) == outcome
