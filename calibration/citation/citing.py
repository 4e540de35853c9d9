"""How a table is cited: a BibTeX entry, made of what the table says of its origin.

The entry type `misc` is that which all styles of BibTeX know (O. Patashnik, BibTeXing, 1988, section 3.1); `dataset`
is BibLaTeX's alone. What the table does not say is left out of the entry and named in a comment, never invented.
"""

from __future__ import annotations

import re
from typing import Final

from calibration.citation.record import NOT_RECORDED, OriginRecord

KEY_DIGITS: Final = 8
"""Digits of the table's hash in the key of its entry: two tables of one lab never share them by chance."""

_SPECIAL: Final = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    **{sign: f"\\{sign}" for sign in "&%$#_"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}
"""Characters that TeX reads as commands (D. Knuth, The TeXbook, chapter 7), and how they are printed."""


def table_title(camera: str, lights: int | None, origin: OriginRecord | None, computed: bool = False) -> str:
    """Return what a table is called: as the lab says, else by its camera and lights."""
    if origin is not None and origin.title:
        return origin.title
    kind = "Computed look-up table" if computed else "Look-up table"
    return f"{kind} of the {camera}" + ("" if lights is None else f" under {lights} lights")


def bibtex(
    camera: str, lights: int | None, software: str, sha256: str, origin: OriginRecord | None, computed: bool = False
) -> str:
    """Return a BibTeX entry of a table.

    `origin`: what it says of its origin; None for tables made before that was kept.
    """
    known = origin or OriginRecord()
    year = known.year
    key = "-".join(
        part for part in (_word(_family(known.authors)), _word(camera), year or "", sha256[:KEY_DIGITS]) if part
    )
    made = "computed" if computed else "simulated" if known.rig == "simulated" else "photographed"
    fields = {
        "author": " and ".join(_name(author) for author in known.authors),
        "title": f"{{{tex_text(table_title(camera, lights, origin, computed))}}}",
        "year": year or "",
        "howpublished": tex_text(f"Look-up table, {made}; made with {software}"),
        "note": tex_text(f"SHA-256 {sha256}" + (f"; licence {known.licence}" if known.licence else "")),
        "url": re.sub(r"[{}\\\s]", "", known.url or ""),
    }
    missing = [name for name in ("author", "year", "url") if not fields[name]]
    if not known.licence:
        missing.append("licence")
    body = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items() if value)
    comment = f"% {NOT_RECORDED} by the table: {', '.join(missing)}\n" if missing else ""
    return f"{comment}@misc{{{key},\n{body}}}\n"


def tex_text(text: str) -> str:
    """Return a text so that TeX prints it as it is."""
    return "".join(_SPECIAL.get(character, character) for character in " ".join(text.split()))


def _name(author: str) -> str:
    """Return an author's name for BibTeX: "Family, Given" as it is, a name without a comma in braces as one whole."""
    text = tex_text(author)
    return text if "," in author else f"{{{text}}}"


def _family(authors: list[str]) -> str:
    return authors[0].partition(",")[0] if authors else "crop"


def _word(text: str) -> str:
    """Return a text as part of a key: letters and digits of ASCII."""
    return re.sub(r"[^a-z0-9]+", "", text.casefold())[:40]
