"""Pages: one file with all in it, elements that close, text that stays text."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import pytest

from evaluation.reports.page import figure_part, heading, page, paragraph, row_part, table_part
from evaluation.reports.style import FAINT, GRID, INK, PAPER, SERIES, svg_of
from evaluation.results.tables import Table

VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Follows which elements are open, and collects text and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def checked(text: str) -> Checker:
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert not checker.open
    return checker


def draw(figure: Any) -> None:
    axes = figure.subplots()
    axes.plot([0, 1], [1, 2], color=INK, label="<series> & more")
    axes.legend()


def test_a_page_holds_all_and_fetches_nothing() -> None:
    svg = svg_of(draw)
    text = page(
        "A <b> & 'c'",
        [
            heading("H & H"),
            paragraph("<script>alert(1)</script>"),
            table_part(Table("<t>", ("<a>", "b"), (("<x> & y", 1.0),), notes=("<n>",))),
            row_part([figure_part(b"\x89PNG\r\n", "a 'quoted' caption"), figure_part(svg, "drawn")]),
        ],
    )
    found = checked(text)
    for words in ("A <b> & 'c'", "<script>alert(1)</script>", "<x> & y", "<n>", "<series> & more", "1.00"):
        assert words in found.text
    assert all(address.startswith(("data:", "#")) for address in found.addresses)


def test_figures_take_the_page_s_colours_and_are_the_same_each_time() -> None:
    svg = svg_of(draw)
    assert svg == svg_of(draw)
    text = svg.decode().lower()
    assert "var(--ink)" in text
    assert not [colour for colour in (INK, FAINT, GRID, PAPER) if colour in text]
    assert not {INK, FAINT, GRID, PAPER} & set(SERIES)


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="expected PNG, JPEG or SVG"):
        figure_part(b"GIF89a", "")


def test_an_interval_is_not_broken_over_two_lines() -> None:
    shown = table_part(Table("Intervals", ("Method", "Mean"), (("a – b", "2.30 – 3.41"),))).html
    assert "2.30\u00a0–\u00a03.41" in shown
    assert "a – b" in shown
