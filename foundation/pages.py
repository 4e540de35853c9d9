"""Pages as one HTML file that can be mailed: Jinja2 templates, one style sheet, figures inside, nothing fetched.

A page follows the reader's choice of a light or dark screen and fits a telephone. Templates escape whatever they are
given but what is markup already. A package keeps its own in a folder `templates`; they extend `base.html` and take
pieces from `parts.html`, both here. Pages that are a row of headings, tables and figures need none: `page` puts them
together. The content security policy in each page lets a browser run its own script and no other, so that a name out of
a file cannot become code even if it reached the page as markup.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final, Literal

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

_LEAST_SVG: Final = "36rem"  # Width below which a drawing scrolls in its place, since its letters would be too small

# An option of a command and an interval, in escaped text: browsers break lines behind each hyphen and dash, whatever
# space follows.
_UNBROKEN = re.compile(r"(?<![\w-])--[a-z][\w-]*|[-−]?\d[\d.]* – [-−]?\d[\d.]*")


@dataclass(frozen=True)
class RenderedPage:
    """A page: its text, and its content security policy for a server that sends it."""

    text: str
    policy: str


def render(
    package: str,
    template: str,
    *,
    scripts: Sequence[str] = (),
    styles: Sequence[str] = (),
    uses_server: bool = False,
    **values: Any,
) -> RenderedPage:
    """Return the page that a template of a package makes of values, among them its `title`.

    `scripts` and `styles` are files beside the template, put into the page in that order, the styles after the common
    sheet. `uses_server`: whether the page asks the server that it came from.
    """
    script = Markup("".join(_text(package, name) for name in scripts))
    sheets = (("foundation", "colours.css"), ("foundation", "style.css"), *((package, name) for name in styles))
    style = Markup("".join(_text(*sheet) for sheet in sheets))
    # A page without a script may style its elements, as figures do: nothing in it can run.
    policy = (
        f"default-src 'none'; {f'script-src {_hash(script)}; ' if script else ''}"
        f"style-src {_hash(style) if script else repr('unsafe-inline')}; base-uri 'none'; form-action 'none'; "
        f"{'''connect-src 'self'; img-src 'self' data:''' if uses_server else 'img-src data:'}"
    )
    found = _environment(package).get_template(template)
    return RenderedPage(found.render(script=script, style=style, policy=Markup(policy), **values), policy)


def page(title: str, parts: Sequence[Markup]) -> str:
    r"""Return the text of an HTML file that shows the pieces made by the functions below.

    Examples
    --------
    >>> "<h1>A &amp; B</h1>\n<p>x &lt; y</p>" in page("A & B", [paragraph("x < y")])
    True
    """
    return render("foundation", "base.html", title=title, parts=parts).text


def heading(text: str, level: int = 2) -> Markup:
    """Return a heading; level 1 is the page's title and not to be given."""
    return _piece("heading", text, level)


def paragraph(text: str) -> Markup:
    """Return a paragraph of plain text."""
    return _piece("paragraph", text)


def note(text: str) -> Markup:
    """Return a paragraph in small, faint type."""
    return _piece("note", text)


def verdict(kind: Literal["accept", "remark", "refuse"], sentence: str) -> Markup:
    """Return a sentence in a box of the verdict's colour."""
    return _piece("verdict", kind, sentence)


def table(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    notes: Sequence[str] = (),
) -> Markup:
    """Return a table with its title and notes; it scrolls sideways where the screen is narrow.

    `numeric` says of each column whether it is of numbers; an interval of numbers is not broken over two lines.

    Examples
    --------
    >>> "<td class='number'>1.5</td>" in table("Errors", ("Algorithm", "Mean"), (("<a>", "1.5"),), (False, True))
    True
    """
    return _piece("table", title, heads, rows, numeric, notes)


def figure(picture: bytes, caption: str, alt: str | None = None, wide: bool = False) -> Markup:
    """Return a figure of the bytes of an SVG, PNG or JPEG file; SVG stands in the page and takes its colours.

    A `wide` one, of several panels side by side, scrolls sideways on a phone, where it would be too small to read.
    """
    return _piece("figure", picture, caption, alt, None, wide)


def row(parts: Sequence[Markup]) -> Markup:
    """Return pieces side by side, as many as the screen is wide for."""
    return _piece("row", parts)


def fold(summary: str, parts: Sequence[Markup], is_open: bool = False) -> Markup:
    """Return pieces that a click on their summary shows and hides."""
    return _piece("fold", summary, parts, is_open)


@cache
def _environment(package: str) -> Environment:
    packages = dict.fromkeys((package, "foundation"))
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters: dict[str, Any] = made.filters
    filters.update(element=_element, unbroken=_unbroken)
    return made


def _piece(name: str, *values: Any) -> Markup:
    module: Any = _environment("foundation").get_template("parts.html").module
    return Markup(getattr(module, name)(*values).strip())


@cache
def _text(package: str, name: str) -> str:
    return (resources.files(package) / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _unbroken(text: str) -> Markup:
    """Return a text whose intervals and options of commands stay on one line; what is copied of it is the text."""
    return Markup(_UNBROKEN.sub(r"<span class='unbroken'>\g<0></span>", str(escape(text))))


def _element(picture: bytes, alt: str) -> Markup:
    """Return the element of a picture: SVG stands in the page, PNG and JPEG as data URLs."""
    for start, kind in ((b"\x89PNG", "png"), (b"\xff\xd8", "jpeg")):
        if picture.startswith(start):
            data = base64.b64encode(picture).decode()
            return Markup("<img alt='{}' src='data:image/{};base64,{}'>").format(alt, kind, data)
    found = re.search(r"<svg\b.*</svg>", picture.decode("utf-8", errors="replace"), re.DOTALL)
    if not found:
        raise ValueError(f"a picture that begins with {picture[:8]!r} is none; expected PNG, JPEG or SVG")
    # No drawing is made larger than it is, so that its letters are those of the others on the page.
    own = re.search(r'<svg\b[^>]* width="([\d.]+)pt"', found[0])
    style = f" style='min-width: min({_LEAST_SVG}, {own[1]}pt)'" if own else ""
    return Markup(found[0].replace("<svg", f"<svg role='img' aria-label='{escape(alt)}'{style}", 1))
