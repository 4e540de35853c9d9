"""Pages are one file, have closed elements, and escape text."""

from __future__ import annotations

import base64
import hashlib
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from foundation import pages
from foundation.plots import INK, draw_svg

VOID = {"meta", "img", "br", "link"}


class Checker(HTMLParser):
    """Parser that tracks open elements, and collects text and addresses."""

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


@pytest.mark.slow
def test_page_is_complete_and_fetches_nothing() -> None:
    text = pages.page(
        "A <b> & 'c'",
        [
            pages.heading("H & H"),
            pages.paragraph("<script>alert(1)</script>"),
            pages.verdict("accept", "good & well"),
            pages.table("<t>", ("<a>", "b"), (("<x> & y", "1.00"),), (False, True), notes=("<n>",)),
            pages.fold("more <", [pages.note("inside &")]),
            pages.row([pages.figure(b"\x89PNG\r\n", "a 'quoted' caption"), pages.figure(draw_svg(draw), "drawn")]),
        ],
    )
    checker = checked(text)
    for words in (
        "A <b> & 'c'",
        "H & H",
        "<script>alert(1)</script>",
        "good & well",
        "<x> & y",
        "<n>",
        "more <",
        "inside &",
        "a 'quoted' caption",
        "<series> & more",
        "1.00",
    ):
        assert words in checker.text
    assert all(address.startswith(("data:", "#")) for address in checker.addresses)
    assert "script-src" not in text
    assert "default-src 'none'" in text


def test_policy_allows_only_own_script_and_style(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "pages_of_a_test" / "templates"
    folder.mkdir(parents=True)
    (folder.parent / "__init__.py").touch()
    (folder / "own.html").write_text('{% extends "base.html" %}{% block content %}<p>{{ name }}</p>{% endblock %}')
    (folder / "one.js").write_text("let a = '<';\n")
    (folder / "two.js").write_text("a += '&';\n")
    (folder / "own.css").write_text("p > b { color: red }\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    rendered = pages.render(
        "pages_of_a_test", "own.html", scripts=("one.js", "two.js"), styles=("own.css",), uses_server=True,
        title="T", name="<i>",
    )  # fmt: skip
    script, style = (re.search(f"(?s)<{name}>(.*)</{name}>", rendered.text) for name in ("script", "style"))
    assert script
    assert script[1] == "let a = '<';\na += '&';\n"
    assert style
    assert style[1].endswith("p > b { color: red }\n")
    assert "<p>&lt;i&gt;</p>" in rendered.text
    rules = dict(rule.strip().split(" ", 1) for rule in rendered.policy.split(";"))
    assert f'content="{rendered.policy}"' in rendered.text
    for name, text in (("script-src", script[1]), ("style-src", style[1])):
        assert rules[name] == f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
    assert rules["default-src"] == "'none'"
    assert rules["connect-src"] == "'self'"


def test_refuses_other_data_than_pictures() -> None:
    with pytest.raises(ValueError, match="GIF89a"):
        pages.figure(b"GIF89a", "")


def test_photograph_is_shown_as_a_whole_and_drawing_stays_readable() -> None:
    svg = b"<svg width='400pt'></svg>".replace(b"'", b'"')
    assert "min-width: min(36rem, 300pt)" in pages.figure(svg, "a drawing")
    assert "min-width" not in pages.figure(svg, "a photograph", is_photograph=True)
    panels = pages.figure([svg, svg.replace(b"></", b">2</")], "two")
    assert [f"aria-label='two, {number} of 2'" in panels for number in (1, 2)] == [True, True]


@pytest.mark.parametrize(
    "text", ["-0.3 – 0.12", "p = 2.1e-05", "effect +0.45", "1.2e-07", "--max-side", "1.5 ± 0.2", "+0.1 to +0.2 %"]
)
def test_numbers_and_options_stay_on_one_line(text: str) -> None:
    assert f"<span class='unbroken'>{text}</span>" in pages.paragraph(f"It is {text}, as expected.")
