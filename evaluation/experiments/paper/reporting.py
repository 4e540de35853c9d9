"""Each experiment's results as a folder: a page, tables as CSV and LaTeX, figures as SVG or PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.experiments.paper.bits import bits_table
from evaluation.experiments.paper.chromaticities import chromaticity_rows, coverage_table, table_lights
from evaluation.experiments.paper.drawing import bits_figure, chromaticities_figure, sizes_figure, standalone
from evaluation.experiments.paper.facts import noise_table, print_colours, print_table, table_noise
from evaluation.experiments.paper.hot import hot_table
from evaluation.experiments.paper.reduction import reduction_strip, reduction_table
from evaluation.experiments.paper.table1 import block_table, joint_table, size_table
from evaluation.reports.latex import table_to_latex, tables_to_latex
from evaluation.reports.page import table_part
from evaluation.results.tables import Table, table_to_csv
from foundation import pages
from foundation.files import whole_folder

if TYPE_CHECKING:
    from evaluation.experiments.paper.bits import BitsResult
    from evaluation.experiments.paper.hot import HotRow
    from evaluation.experiments.paper.scenes.truths import Truths
    from evaluation.experiments.paper.table1 import Block, SizeRow
    from evaluation.metrics import ErrorKind
    from generator import Lut

_TABLE1 = (
    "Performance of White-Patch, Gray-world and Shades-of-Gray on eight generated data sets, {kind} error in degrees"
)


@dataclass(frozen=True, eq=False)
class PaperReport:
    """What an experiment leaves.

    - `title`: of the page.
    - `tables`: what is printed, in order.
    - `files`: beside the page: name to content.
    """

    title: str
    tables: tuple[Table, ...]
    parts: tuple[Markup, ...]
    files: Mapping[str, bytes]


def write_report(report: PaperReport, folder: Path) -> None:
    """Write a report to a new folder, whole or not at all; its page is `report.html`."""
    with whole_folder(folder, "the report") as partial:
        (partial / "report.html").write_text(pages.page(report.title, report.parts), encoding="utf-8")
        for name, content in report.files.items():
            (partial / name).write_bytes(content)


def table1_report(
    blocks: Sequence[Block],
    luts: Sequence[Lut],
    conditions: Sequence[str],
    kind: ErrorKind,
    sizes: Sequence[SizeRow] = (),
    hot: Sequence[HotRow] = (),
) -> PaperReport:
    """Return the report of table 1, first with one kind of error, then with the other.

    `sizes`: the errors for other sizes of images; may be empty. `hot`: white-Patch's errors with hot photosites; may be
    empty.
    """
    other: ErrorKind = "recovery" if kind == "reproduction" else "reproduction"
    first = [block_table(block, kind) for block in blocks]
    second = [block_table(block, other) for block in blocks]
    noise = noise_table([table_noise(lut) for lut in luts])
    prints = print_table([print_colours(lut) for lut in luts])
    files = {
        "table1.csv": table_to_csv(joint_table(blocks)).encode(),
        "table1.tex": tables_to_latex(_TABLE1.format(kind=kind), first).encode(),
        f"table1_{other}.tex": tables_to_latex(_TABLE1.format(kind=other), second).encode(),
        "noise.csv": table_to_csv(noise).encode(),
        "print.csv": table_to_csv(prints).encode(),
    }
    parts = [
        *map(pages.paragraph, conditions),
        pages.heading(f"{kind.capitalize()} error, degrees"),
        *map(table_part, first),
    ]
    tables = [*first, noise, prints]
    if sizes:
        drawn = sizes_figure(sizes, "White-Patch")
        table = size_table(sizes)
        tables.append(table)
        files |= {"sizes.csv": table_to_csv(table).encode(), "sizes.svg": standalone(drawn)}
        caption = (
            "White-Patch takes the largest of all values, of which a larger image has more: of noise, and of whites."
        )
        parts += [pages.heading("Images of other sizes"), pages.figure(drawn, caption), table_part(table)]
    if hot:
        table = hot_table(hot, kind)
        tables.append(table)
        files |= {"hot.csv": table_to_csv(table).encode(), "hot.tex": table_to_latex(table).encode()}
        parts += [pages.heading("Hot photosites"), table_part(table)]
    parts += [pages.heading("The tables"), table_part(noise), table_part(prints)]
    parts += [pages.heading(f"{other.capitalize()} error, degrees"), *map(table_part, second)]
    return PaperReport("Table 1: plain methods on generated data sets", tuple(tables), tuple(parts), files)


def table2_report(tables: Sequence[Table], conditions: Sequence[str]) -> PaperReport:
    """Return the report of table 2: both halves as one table, then the ratios."""
    *halves, ratios = tables
    caption = "Comparison of performance of learning-based methods with respect to the training"
    files = {
        "table2.tex": tables_to_latex(caption, halves).encode(),
        "ratios.tex": table_to_latex(ratios).encode(),
        "ratios.csv": table_to_csv(ratios).encode(),
        **{
            f"trained_on_{name}.csv": table_to_csv(half).encode()
            for name, half in zip(("real", "generated"), halves, strict=True)
        },
    }
    parts = (*map(pages.paragraph, conditions), *map(table_part, tables))
    return PaperReport("Table 2: trained on real and on generated images", tuple(tables), parts, files)


def bits_report(found: BitsResult, kind: ErrorKind, name: str, conditions: Sequence[str]) -> PaperReport:
    """Return the report of bits removal on a data set of that name."""
    drawn, table = bits_figure(found, kind), bits_table(found, kind, name)
    caption = "Medians against the bits of each sRGB code that were set to zero; dotted, the linear images as they are."
    files = {
        "bits.svg": standalone(drawn),
        "bits.csv": table_to_csv(table).encode(),
        "bits.tex": table_to_latex(table).encode(),
    }
    parts = (*map(pages.paragraph, conditions), pages.figure(drawn, caption), table_part(table))
    return PaperReport("The effect of colour reduction on illumination estimation", (table,), parts, files)


def reduction_report(picture: npt.NDArray[np.uint8], name: str) -> PaperReport:
    """Return the report of a picture (H, W, 3) uint8, sRGB codes, with 0 … 7 bits of its codes set to zero."""
    import cv2

    table = reduction_table(picture)
    strip = reduction_strip(picture)
    drawn = bytes(np.asarray(cv2.imencode(".png", strip[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]))
    caption = f"{name} with 0 to 7 bits of each code set to zero, row by row; the tables of the paper keep 5 of 8 bits."
    files = {"reduction.png": drawn, "reduction.csv": table_to_csv(table).encode()}
    return PaperReport(
        "Influence of colour reduction", (table,), (pages.figure(drawn, caption), table_part(table)), files
    )


def chromaticities_report(luts: Sequence[Lut], sets: Sequence[Truths]) -> PaperReport:
    """Return the report of the lights of tables, beside the ground truths of data sets."""
    truths = {found.name: found.lights for found in sets}
    lights = [table_lights(lut) for lut in luts]
    drawn = chromaticities_figure(lights, truths)
    caption = (
        "rb-chromaticities, r = R / (R + G + B) and b = B / (R + G + B) in linear RGB of each table's camera, of the "
        "white under each light of the table; in colour the ground truths of data sets, each in its own camera's RGB."
    )
    parts, tables = [pages.figure(drawn, caption)], list[Table]()
    files = {
        "chromaticities.svg": standalone(drawn),
        "chromaticities.csv": table_to_csv(chromaticity_rows(luts)).encode(),
    }
    if truths:
        coverage = coverage_table(luts, truths)
        tables.append(coverage)
        parts.append(table_part(coverage))
        files |= {
            "coverage.csv": table_to_csv(coverage).encode(),
            "coverage.tex": table_to_latex(coverage).encode(),
        }
    return PaperReport("Chromaticities of the lights", tuple(tables), tuple(parts), files)
