"""One self-contained HTML page: prose, tables and figures, nothing to fetch, readable without the README."""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from matplotlib.figure import Figure

from wallmirror.files import write_atomically
from wallmirror.report.figures import embed


@dataclass(frozen=True)
class TableBlock:
    """A table: column headings and rows of text."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True)
class FigureBlock:
    """A figure with the sentence below it."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Verdict:
    """A sentence with its colour: True good, False bad, None for neither."""

    good: bool | None
    text: str


Block = str | TableBlock | FigureBlock | Verdict


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it, in order; plain strings are paragraphs."""

    title: str
    blocks: tuple[Block, ...] = field(default_factory=tuple)


def write_page(path: Path, *, title: str, lead: str, verdicts: list[Verdict], sections: list[Section]) -> None:
    """Write the page as a whole, or leave the earlier one."""
    write_atomically(path, page_html(title=title, lead=lead, verdicts=verdicts, sections=sections))


def page_html(*, title: str, lead: str, verdicts: list[Verdict], sections: list[Section]) -> str:
    """The page as HTML."""
    contents = "".join(
        f'<li><a href="#s{number}">{escape(section.title)}</a></li>' for number, section in enumerate(sections, 1)
    )
    body = "".join(
        f'<section id="s{number}"><h2>{escape(section.title)}</h2>{"".join(map(_block, section.blocks))}</section>'
        for number, section in enumerate(sections, 1)
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title><style>{_STYLE}</style></head>
<body><main><h1>{escape(title)}</h1><p class="lead">{_text(lead)}</p>
{"".join(map(_block, verdicts))}
<nav><ol>{contents}</ol></nav>
{body}
<footer>{escape(_footer())}</footer></main></body></html>
"""


def _text(text: str) -> str:
    """Escaped, with numbers held together with their per cent sign."""
    return escape(text, quote=True).replace(" %", "\u00a0%")


def _block(block: Block) -> str:
    if isinstance(block, str):
        return f"<p>{_text(block)}</p>"
    if isinstance(block, Verdict):
        kind = {True: "good", False: "bad", None: "plain"}[block.good]
        mark = {True: "✓", False: "✗", None: "•"}[block.good]
        return f'<p class="verdict {kind}"><span>{mark}</span>{_text(block.text)}</p>'
    if isinstance(block, FigureBlock):
        alt = _text(block.caption)
        return f'<figure><img src="{embed(block.figure)}" alt="{alt}"><figcaption>{alt}</figcaption></figure>'
    head = "".join(f"<th>{_text(c)}</th>" for c in block.columns)
    rows = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in block.rows)
    caption = f"<caption>{_text(block.caption)}</caption>" if block.caption else ""
    return f'<div class="scroll"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _footer() -> str:
    parts = []
    for package in ("wallmirror", "mitsuba", "drjit", "numpy", "scipy"):
        try:
            parts.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            parts.append(f"{package} (not installed)")
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return f"{', '.join(parts)}; Python {platform.python_version()}, {platform.machine()}; {when}"


_STYLE = """
:root{color-scheme:light;--ink:#22272e;--faint:#57606a;--line:#d0d7de;--blue:#1664c0}
*{box-sizing:border-box}
body{margin:0;background:#f6f8fa;color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1040px;margin:0 auto;padding:40px 32px 64px;background:#fff}
h1{font-size:30px;line-height:1.2;margin:0 0 8px}
h2{font-size:21px;margin:40px 0 8px;padding-top:16px;border-top:1px solid var(--line)}
.lead{font-size:18px;color:var(--faint);margin:0 0 20px;max-width:46em}
p{max-width:46em;margin:10px 0}
nav ol{columns:2;padding-left:20px;font-size:15px;margin:20px 0 0}
a{color:var(--blue);text-decoration:none}a:hover{text-decoration:underline}
.verdict{display:flex;gap:10px;max-width:none;padding:10px 14px;border-radius:8px;margin:8px 0;background:#f6f8fa}
.verdict span{font-weight:700}
.good{background:#dafbe1}.good span{color:#116329}
.bad{background:#ffebe9}.bad span{color:#a40e26}
figure{margin:18px 0}img{max-width:100%;height:auto;display:block}
figcaption{font-size:14px;color:var(--faint);max-width:52em;margin-top:6px}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:14.5px;margin:14px 0;font-variant-numeric:tabular-nums}
caption{text-align:left;color:var(--faint);font-size:14px;padding-bottom:6px}
th,td{padding:5px 16px 5px 0;text-align:left;border-bottom:1px solid var(--line);vertical-align:top}
th{font-weight:600}
footer{margin-top:48px;color:var(--faint);font-size:13px}
"""
