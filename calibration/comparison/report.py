"""The page of a comparison, and its files: `report.html`, `comparison.json`, `lights.csv`, `cells.csv`."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path

from calibration.comparison.plots import draw_cells, draw_lights, draw_map
from calibration.comparison.values import ColourGroup, ComparedTable, NoiseAnswer, TableComparison
from calibration.comparison.wording import cells_csv, comparison_json, geometry_text, lights_csv
from calibration.report.page import STYLE, Picture, picture_html
from experiment.chart.model import Chart
from foundation.files import whole_folder, write_whole
from foundation.plots import png_of

PICTURES = ("lights.png", "cells.png", "map.png")
"""Names of the pictures beside the page, as far as they are drawn."""


def write_comparison(comparison: TableComparison, folder: Path, chart: Chart | None = None) -> None:
    """Write a comparison into a new folder, whole or not at all."""
    pictures = _pictures(comparison, chart)
    with whole_folder(folder, "the comparison") as partial:
        write_whole(partial / "lights.csv", lights_csv(comparison))
        write_whole(partial / "cells.csv", cells_csv(comparison))
        for name, picture in zip(PICTURES, pictures, strict=False):
            write_whole(partial / name, picture.png)
        write_whole(partial / "report.html", comparison_page(comparison, pictures))
        write_whole(partial / "comparison.json", json.dumps(comparison_json(comparison), indent=2) + "\n")


def comparison_page(comparison: TableComparison, pictures: Sequence[Picture]) -> str:
    """Return the text of `report.html`."""
    names = [table.place.name for table in (comparison.one, comparison.other)]
    title = f"{names[0]} and {names[1]} compared"
    kind, sentence = {
        True: ("accept", "The same within noise."),
        False: ("remark", "They differ by more than noise."),
        None: ("remark", "Whether they are the same within noise cannot be said of everything."),
    }[comparison.same]
    warnings = "".join(f"<p class='note'>Note: {html.escape(warning)}.</p>" for warning in comparison.warnings)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>\n<h1>{html.escape(title)}</h1>"
        f"{_tables(comparison)}<p class='verdict {kind}'>{sentence}</p>{warnings}"
        f"<table>{''.join(map(_answer, comparison.answers))}"
        f"<tr><td></td><th>chart in the frame</th><td class='note'>{html.escape(geometry_text(comparison))}</td></tr>"
        f"</table>{''.join(map(picture_html, pictures))}{_colours(comparison.groups)}</body></html>\n"
    )


def _pictures(comparison: TableComparison, chart: Chart | None) -> list[Picture]:
    found = [
        Picture(
            "Light by light",
            "Left: angle between the two whites, and what their standard errors alone give. Middle: brightness, as "
            "measured, and without the drift that both tables record and the median of all lights. Right: how far the "
            "cells differ in units of their noise; 1 is noise alone.",
            png_of(draw_lights, comparison.lights),
        ),
        Picture(
            "Cell by cell",
            "Each cell over its own light's white, B over A, mean over the lights. Right: in units of its standard "
            "error; what is wider than the line is not noise.",
            png_of(draw_cells, comparison.cells),
        ),
    ]
    if chart is not None:
        caption = "The same where the cells lie. Noise is a fine grain; a stain, a shadow or another field has a shape."
        found.append(Picture("On the print", caption, png_of(draw_map, chart, comparison.cells)))
    return found


def _tables(comparison: TableComparison) -> str:
    return f"<table>{_table('A', comparison.one)}{_table('B', comparison.other)}</table>"


def _table(name: str, table: ComparedTable) -> str:
    said = (
        f"{table.lights} lights, {table.samples} samples a cell{', drift taken out' if table.drift_corrected else ''}"
    )
    return (
        f"<tr><th>{name}</th><td>{html.escape(str(table.place))}</td><td>{html.escape(table.camera)}</td>"
        f"<td class='note'>{html.escape(said)}; {html.escape(table.software)}</td></tr>"
    )


def _answer(answer: NoiseAnswer) -> str:
    kind, word = {True: ("accept", "same"), False: ("remark", "differs"), None: ("remark", "not known")}[answer.same]
    return (
        f"<tr><td class='{kind}'>{word}</td><th>{html.escape(answer.name)}</th>"
        f"<td class='note'>{html.escape(answer.said)}</td></tr>"
    )


def _colours(groups: Sequence[ColourGroup]) -> str:
    rows = "".join(
        f"<tr><th>{group.name}</th><td class='number'>{group.cells}</td>"
        f"<td class='number'>{100 * group.mean:+.3f} %</td>"
        f"<td class='number'>{100 * group.spread:.3f} %</td><td class='number'>{100 * group.worst:+.2f} %</td>"
        f"<td class='note'>colour {group.worst_colour}</td></tr>"
        for group in groups
        if group.cells
    )
    return (
        "<h2>By colour</h2><table><tr><th>cells</th><th>number</th><th>mean</th><th>spread</th><th>worst</th><th></th>"
        f"</tr>{rows}</table>"
    )
