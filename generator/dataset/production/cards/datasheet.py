"""DATASHEET.md: the questions of *Datasheets for Datasets*, answered where the software knows, left open where not.

T. Gebru, J. Morgenstern, B. Vecchione, J. Wortman Vaughan, H. Wallach, H. Daumé III, K. Crawford, "Datasheets for
Datasets", Communications of the ACM 64(12), 2021, pp. 86-92: its seven sections, and its questions shortened, are in
`datasheet.md` beside this file. A question that only the makers can answer is marked `OPEN`, so that a search finds it.
"""

from __future__ import annotations

from pathlib import Path
from string import Template
from typing import Final

from generator.dataset.production.cards.facts import (
    citation_of,
    counted_images,
    kind_of,
    name_of,
    option,
    origin_table,
    stored_white,
    summary_of,
    table_cell,
    table_name,
    truth_of,
)
from generator.dataset.production.records import Description

OPEN: Final = "**TO BE ANSWERED BY THE LAB.**"
"""What stands where only the makers of a dataset know the answer."""


def datasheet(description: Description) -> str:
    """Return the text of DATASHEET.md."""
    template = Template((Path(__file__).parent / "datasheet.md").read_text("utf-8"))
    table, origin = description.table, dict(origin_table(description))
    authors = "" if table.origin is None else "; ".join(table.origin.authors)
    splits = "; ".join(f"{part}: {images} images" for part, images in description.splits.items())
    by_colour = option(description, "rendering") is not None
    rendering = "by codes: a picture's 8-bit sRGB value is the code of a printed cell"
    answers: dict[str, object] = {
        "authors": f"The table: {authors}. The dataset: {OPEN}" if authors else OPEN,
        "camera": table.camera,
        "citation": citation_of(description),
        "dates": origin["Dates"],
        "format": option(description, "format"),
        "images": counted_images(description),
        "kind": kind_of(description),
        "layout": option(description, "layout"),
        "licence": origin["Licence"],
        "lights": len(description.lights),
        "name": name_of(description),
        "open": OPEN,
        "origin": "\n".join(f"| {name} | {table_cell(value)} |" for name, value in origin.items()),
        "pixels": description.pixels,
        "rendering": "colorimetrically, by the cells whose measured colour matches" if by_colour else rendering,
        "replaced": description.replaced_pixels,
        "samples": table.samples,
        "seed": description.seed,
        "skipped": len(description.skipped),
        "software": description.software,
        "sources": description.sources,
        "splits": f"{splits}. All images of a picture are in one part."
        if splits
        else "None; keep all images of a picture in one part.",
        "summary": summary_of(description),
        "table": table.sha256,
        "table_name": table_name(description),
        "table_software": table.software,
        "truth": truth_of(description),
        "white_level": stored_white(description),
    }
    # The makers of the dataset are asked for whether or not those of the table are known.
    return template.substitute(answers, count=template.template.count("${open}") + 1)
