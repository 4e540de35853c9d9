"""Reports as one HTML file that can be mailed: text, tables and figures, no script, nothing fetched.

A page follows the reader's choice of a light or dark screen and fits a telephone: a wide table scrolls in its place.
Figures that are SVG stand in the page itself, so that they take the page's colours (`style.INK` and its like).
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from evaluation.reports.style import CSS_VARIABLES

if TYPE_CHECKING:
    from evaluation.results.tables import Table

_INTERVAL = re.compile(r"(?<=\d) – (?=[-−]?\d)")
"""What stands between the ends of an interval in a table's cell."""

_STYLE = f"""
{CSS_VARIABLES}
* {{ box-sizing: border-box }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 1100px; margin: 2rem auto; padding: 0 1rem }}
h1 {{ font-size: 1.6rem; line-height: 1.25; margin-bottom: .4rem }}
h2 {{ font-size: 1.2rem; margin: 2.4rem 0 .6rem }} h3 {{ font-size: 1rem; margin: 1.6rem 0 .4rem }}
p {{ margin: .4rem 0; max-width: 75ch; overflow-wrap: break-word }}
.scroll {{ overflow-x: auto; margin: .6rem 0 }}
table {{ border-collapse: collapse; font-size: .95rem }}
.title {{ font-weight: 600; margin: 1.2rem 0 .2rem }}
th, td {{ padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--grid); vertical-align: baseline;
  text-align: left }}
th {{ font-weight: 600; vertical-align: bottom }} .number {{ text-align: right; padding: .25rem 0 .25rem .9rem;
  font-variant-numeric: tabular-nums; white-space: nowrap }} th.number {{ white-space: normal }}
.number + :not(.number) {{ padding-left: 1.6rem }}
.note, figcaption {{ color: var(--faint); font-size: .9rem }}
figure {{ margin: .8rem 0; overflow-x: auto }} figure > svg {{ min-width: 36rem }}
figure > img, figure > svg {{ display: block; max-width: 100%; height: auto }}
figcaption {{ max-width: 75ch; margin-top: .3rem }} svg text {{ font-family: system-ui, sans-serif }}
.row {{ display: flex; flex-wrap: wrap; gap: 1rem 1.4rem }}
.row > figure {{ flex: 1 1 15rem; max-width: 100%; margin: 0 }}
details {{ margin: .5rem 0; border-top: 1px solid var(--grid) }} details[open] {{ padding-bottom: .8rem }}
summary {{ cursor: pointer; padding: .45rem 0; font-weight: 600 }}
@media print {{ body {{ margin: 0; max-width: none }} figure, tr {{ break-inside: avoid }} }}
"""


@dataclass(frozen=True)
class Part:
    """A piece of a page, made by the functions of this module.

    `html`: whole elements, every text in them escaped.
    """

    html: str


def heading(text: str, level: int = 2) -> Part:
    """Return a heading; level 1 is the page's title and not to be given."""
    return Part(f"<h{level}>{html.escape(text)}</h{level}>\n")


def paragraph(text: str) -> Part:
    """Return a paragraph of plain text."""
    return Part(f"<p>{html.escape(text)}</p>\n")


def table_part(table: Table) -> Part:
    """Return a table with its title and notes; it scrolls sideways where the screen is narrow.

    Examples
    --------
    >>> from evaluation.results.tables import Table
    >>> "<td class='number'>1.50</td>" in table_part(Table("Errors", ("Algorithm", "Mean"), (("<a>", 1.5),))).html
    True
    """
    marks = [" class='number'" if number else "" for number in table.numeric()]
    heads = "".join(
        f"<th{mark} scope='col'>{html.escape(head)}</th>" for mark, head in zip(marks, table.columns, strict=True)
    )
    rows = "".join(
        f"<tr>{''.join(f'<td{mark}>{_cell(text)}</td>' for mark, text in zip(marks, row, strict=True))}</tr>\n"
        for row in table.texts()
    )
    notes = "".join(f"<p class='note'>{html.escape(note)}</p>\n" for note in table.notes)
    return Part(
        f"<p class='title'>{html.escape(table.title)}</p>\n"
        f"<div class='scroll' role='region' tabindex='0' aria-label='{html.escape(table.title, quote=True)}'><table>"
        f"<thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>\n{notes}"
    )


def _cell(text: str) -> str:
    """Return a cell's text, escaped; an interval of numbers is not broken over two lines."""
    return _INTERVAL.sub("\u00a0–\u00a0", html.escape(text))


def figure_part(picture: bytes, caption: str, alt: str | None = None) -> Part:
    """Return a figure."""
    says = html.escape(caption if alt is None else alt, quote=True)
    below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    return Part(f"<figure>{_picture(picture, says)}{below}</figure>\n")


def row_part(parts: Sequence[Part]) -> Part:
    """Return parts side by side, as many as the screen is wide for."""
    return Part(f"<div class='row'>{''.join(part.html for part in parts)}</div>\n")


def details_part(summary: str, parts: Sequence[Part], open_at_first: bool = False) -> Part:
    """Return parts that a click on their summary shows and hides."""
    shown = " open" if open_at_first else ""
    content = "".join(part.html for part in parts)
    return Part(f"<details{shown}><summary>{html.escape(summary)}</summary>\n{content}</details>\n")


def page(title: str, parts: Sequence[Part]) -> str:
    """Return the text of an HTML file.

    Examples
    --------
    >>> page("A & B", [paragraph("x < y")]).count("&")
    3
    """
    name = html.escape(title)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{name}</title><style>{_STYLE}</style></head><body>\n<h1>{name}</h1>\n"
        f"{''.join(part.html for part in parts)}</body></html>\n"
    )


def _picture(picture: bytes, alt: str) -> str:
    """Return the element of a picture: SVG stands in the page, PNG and JPEG as data URLs."""
    for start, kind in ((b"\x89PNG", "png"), (b"\xff\xd8", "jpeg")):
        if picture.startswith(start):
            return f"<img alt='{alt}' src='data:image/{kind};base64,{base64.b64encode(picture).decode()}'>"
    text = picture.decode("utf-8", errors="replace")
    found = re.search(r"<svg\b.*</svg>", text, re.DOTALL)
    if not found:
        raise ValueError(f"a picture that begins with {picture[:8]!r} is none; expected PNG, JPEG or SVG")
    return found[0].replace("<svg", f"<svg role='img' aria-label='{alt}'", 1)
