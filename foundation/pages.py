"""Make HTML pages from Jinja2 templates. A page is one file that contains its style, scripts and figures.

Pages support light and dark screens and phones. Templates escape all values except `Markup`. The templates of a
package are in its folder `templates`. They extend `base.html` and use the macros of `parts.html`, both in this package.
`page` makes a page of headings, tables and figures without a template.

The content security policy of a page allows only the script of the page. So a text from a file is never executed, even
if a template inserts it without escaping.
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

# A drawing is not made narrower than the smaller of these two, but scrolled, because its text would become too small.
_MIN_SVG_WIDTH: Final = "36rem"
_MIN_SVG_SCALE: Final = 0.75

# Command options, intervals such as "1 – 2", and "p = 1e-05". Browsers would break lines in them.
_NUMBER = r"[-−+]?\d[\d.]*(?:e[-+]\d+)?"
_UNBREAKABLE = re.compile(
    rf"(?<![\w-])--[a-z][\w-]*|{_NUMBER} (?:–|…|±|to) {_NUMBER}(?: %| px)?|\bp [=<≤] {_NUMBER}|\beffect {_NUMBER}"
    r"|\d[\d.]*e[-+]\d+"
)


@dataclass(frozen=True)
class RenderedPage:
    """HTML text of a page, and its content security policy as the value of an HTTP header."""

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
    """Render a template of a package with `values`, one of which is `title`.

    `scripts` and `styles` are names of files next to the template, which are inserted into the page. The styles follow
    the common style sheet. `uses_server`: whether the page sends requests to its server.
    """
    script = Markup("".join(_text(package, name) for name in scripts))
    sheets = (("foundation", "colours.css"), ("foundation", "style.css"), *((package, name) for name in styles))
    style = Markup("".join(_text(*sheet) for sheet in sheets))
    # Figures have inline styles, so a page without scripts allows all inline styles.
    policy = (
        f"default-src 'none'; {f'script-src {_hash(script)}; ' if script else ''}"
        f"style-src {_hash(style) if script else repr('unsafe-inline')}; base-uri 'none'; form-action 'none'; "
        f"{'''connect-src 'self'; img-src 'self' data:''' if uses_server else 'img-src data:'}"
    )
    loaded = _environment(package).get_template(template)
    return RenderedPage(loaded.render(script=script, style=style, policy=Markup(policy), **values), policy)


def page(title: str, parts: Sequence[Markup]) -> str:
    r"""Return the HTML of a page with a title and parts. The functions below make the parts.

    Examples
    --------
    >>> "<h1>A &amp; B</h1>\n<p>x &lt; y</p>" in page("A & B", [paragraph("x < y")])
    True
    """
    return render("foundation", "base.html", title=title, parts=parts).text


def heading(text: str, level: int = 2) -> Markup:
    """Return a heading of level 2 or more; level 1 is the title of the page."""
    return _piece("heading", text, level)


def paragraph(text: str) -> Markup:
    """Return a paragraph of plain text."""
    return _piece("paragraph", text)


def note(text: str) -> Markup:
    """Return a paragraph in small grey type."""
    return _piece("note", text)


def verdict(kind: Literal["accept", "remark", "refuse"], sentence: str) -> Markup:
    """Return a sentence in a box with the colour of the verdict."""
    return _piece("verdict", kind, sentence)


def table(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    notes: Sequence[str] = (),
) -> Markup:
    """Return a table with title and notes. It scrolls sideways on narrow screens.

    `numeric`: for each column, whether it holds numbers, which are aligned to the right.

    Examples
    --------
    >>> "<td class='number'>1.5</td>" in table("Errors", ("Algorithm", "Mean"), (("<a>", "1.5"),), (False, True))
    True
    """
    return _piece("table", title, heads, rows, numeric, notes)


def figure(
    picture: bytes | Sequence[bytes], caption: str, alt: str | None = None, is_photograph: bool = False
) -> Markup:
    """Return a figure from the bytes of an SVG, PNG or JPEG file; an SVG uses the colours of the page.

    Several pictures are placed next to each other, on a phone below each other. A phone scrolls a drawing that would
    become too small to read; a photograph is always shown as a whole.
    """
    return _piece("figure", [picture] if isinstance(picture, bytes) else picture, caption, alt, None, is_photograph)


def row(parts: Sequence[Markup]) -> Markup:
    """Return parts placed next to each other; parts that do not fit the screen start a new row."""
    return _piece("row", parts)


def fold(summary: str, parts: Sequence[Markup], is_open: bool = False) -> Markup:
    """Return parts that a click on the summary shows or hides."""
    return _piece("fold", summary, parts, is_open)


@cache
def _environment(package: str) -> Environment:
    packages = dict.fromkeys((package, "foundation"))
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters: dict[str, Any] = environment.filters
    filters.update(element=_element, unbroken=_unbroken)
    return environment


def _piece(name: str, *values: Any) -> Markup:
    module: Any = _environment("foundation").get_template("parts.html").module
    return Markup(getattr(module, name)(*values).strip())


@cache
def _text(package: str, name: str) -> str:
    return (resources.files(package) / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _unbroken(text: str) -> Markup:
    # A style prevents the line break. A special character would be copied with the text.
    return Markup(_UNBREAKABLE.sub(r"<span class='unbroken'>\g<0></span>", str(escape(text))))


def _element(picture: bytes, alt: str, is_photograph: bool = False) -> Markup:
    """Return the HTML element of a picture: SVG is inserted, PNG and JPEG become data URLs."""
    for start, kind in ((b"\x89PNG", "png"), (b"\xff\xd8", "jpeg")):
        if picture.startswith(start):
            data = base64.b64encode(picture).decode()
            return Markup("<img alt='{}' src='data:image/{};base64,{}'>").format(alt, kind, data)
    svg = re.search(r"<svg\b.*</svg>", picture.decode("utf-8", errors="replace"), re.DOTALL)
    if not svg:
        raise ValueError(f"image data start with {picture[:8]!r}, expected PNG, JPEG or SVG")
    # A drawing is never enlarged, so that the text of all drawings on a page has the same size.
    width = re.search(r'<svg\b[^>]* width="([\d.]+)pt"', svg[0])
    narrowest = f"min({_MIN_SVG_WIDTH}, {_MIN_SVG_SCALE * float(width[1]):g}pt)" if width else ""
    style = f" style='min-width: {narrowest}'" if narrowest and not is_photograph else ""
    # Drawings of equal size have equal identifiers. A reference to a drawing in a closed fold would not work.
    key = hashlib.sha256(picture).hexdigest()[:8]
    drawing = re.sub(r'(\bid="|="#|url\(#)', rf"\g<1>{key}-", svg[0])
    return Markup(drawing.replace("<svg", f"<svg role='img' aria-label='{escape(alt)}'{style}", 1))
