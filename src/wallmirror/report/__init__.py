"""Figures and the self-contained report page."""

from wallmirror.report.page import FigureBlock, Section, TableBlock, Verdict, page_html, write_page

__all__ = ["FigureBlock", "Section", "TableBlock", "Verdict", "page_html", "write_page"]
