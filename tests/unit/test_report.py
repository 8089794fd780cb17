"""The report page: self-contained, escaped, replaced as a whole."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from wallmirror.errors import InputError
from wallmirror.files import write_atomically
from wallmirror.report import FigureBlock, Section, TableBlock, Verdict, write_page
from wallmirror.report.figures import photograph


def some_page(path, title="A <b>title</b>"):
    figure = Figure()
    figure.add_subplot().plot([0, 1], [1, 0])
    write_page(
        path,
        title=title,
        lead="0.5 % off & fine",
        verdicts=[Verdict(True, "good"), Verdict(False, "bad"), Verdict(None, "so so")],
        sections=[Section("One", ("prose", TableBlock(("a", "b"), (("1", "<2>"),)), FigureBlock(figure, "a 'line'")))],
    )
    return path.read_text()


def test_page_fetches_nothing(tmp_path):
    page = some_page(tmp_path / "report.html")
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(s.startswith(("data:", "#")) for s in sources)


def test_text_is_escaped(tmp_path):
    page = some_page(tmp_path / "report.html")
    assert "<b>title" not in page
    assert "&lt;2&gt;" in page
    assert "0.5\u00a0% off &amp; fine" in page


def test_a_failing_page_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    before = some_page(path)
    monkeypatch.setattr("wallmirror.report.page.embed", lambda figure: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        some_page(path, title="new")
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_unwritable_folder_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "file" / "report.html", "text")


def test_photograph_of_darkness_is_drawn():
    assert photograph(np.zeros((9, 16))).axes
