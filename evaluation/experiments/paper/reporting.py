"""Each experiment's results as a folder: a page, tables as CSV and LaTeX, figures as SVG or PNG.

Chromaticities of lights (sections 3.1 and 3.3) are those of the white under each light of a table, as its camera sees
it: what the paper's two figures show for the EOS 550D and the 6D Mark II, and beside them the ground truths of real
data sets, to see which of their lights a table can stand for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.experiments.paper.colour_reduction import BitsResult, bits_table, reduction_strip, reduction_table
from evaluation.experiments.paper.material import Truths
from evaluation.experiments.paper.table1 import (
    Block,
    SizeRow,
    block_table,
    block_title,
    joint_table,
    noise_table,
    print_table,
    size_table,
)
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, table_to_latex, tables_to_latex
from evaluation.results.tables import Table, table_to_csv
from foundation import pages
from foundation.folders import atomic_folder
from foundation.plots import FAINT, INK, draw_svg, legend_label, series_style, standalone_svg
from generator.lights.choices import nearest_lights

if TYPE_CHECKING:
    from generator import Lut


def rb_of(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rb-chromaticities (N, 2) float64 of lights (N, 3) float64, linear camera RGB of any length.

    Examples
    --------
    >>> rb_of(np.array([[1.0, 2.0, 1.0]]))
    array([[0.25, 0.25]])
    """
    return (lights / lights.sum(axis=1, keepdims=True))[:, [0, 2]]


def chromaticity_rows(luts: Sequence[Lut]) -> Table:
    """Return every light of tables with its kind and chromaticity, for CSV."""
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        for light, (r, b) in zip(lut.illuminations, rb_of(lut.white), strict=True):
            rows.append((lut.provenance.camera, light.index, light.kind, light.cct_k, float(r), float(b)))
    return Table("rb-chromaticities of lights", ("camera", "light", "kind", "cct_k", "r", "b"), tuple(rows), digits=4)


def coverage_table(luts: Sequence[Lut], sets: Mapping[str, npt.NDArray[np.float64]]) -> Table:
    """Return how near the lights of tables come to the ground truths of data sets.

    `sets`: name of a data set to its ground truths, (N, 3) float64, linear camera RGB of any length.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        for name, truths in sets.items():
            matches = nearest_lights(lut, truths).matches
            angles = np.array([match.angle for match in matches])
            different = len({match.mixture.label for match in matches})
            rows.append(
                (
                    lut.provenance.camera,
                    name,
                    len(truths),
                    different,
                    float(np.median(angles)),
                    float(np.percentile(angles, 95, method="hazen")),
                    float(angles.max()),
                )
            )
    return Table(
        "Angle from ground truths to the nearest light of a table, degrees",
        ("Table", "Data set", "Ground truths", "Lights that are nearest", "Median", "95th percentile", "Largest"),
        tuple(rows),
    )


# Markers of series, so that they differ in print without colour.
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")

# Width of a dot in the figure of chromaticities; of points in one square of that width one is drawn.
_SEEN: Final = 0.004


def _draw_bits(figure: Any, found: BitsResult, kind: ErrorKind) -> None:
    """Draw the paper's figure of bits removal: each method's median against the bits; the raw image's as a line."""
    axes = figure.add_subplot()
    counts = list(found.reduced)
    for place, raw in enumerate(found.raw):
        style = series_style(place)
        medians = [results[place].summary(kind).median for results in found.reduced.values()]
        axes.plot(counts, medians, marker=_MARKERS[place % len(_MARKERS)], label=legend_label(raw.method), **style)
        axes.axhline(raw.summary(kind).median, color=style["color"], linewidth=0.8, linestyle=":")
    axes.set_xlabel("bits of each sRGB code set to zero (dotted: the linear image as it is)")
    axes.set_ylabel(f"median {kind} error, degrees")
    axes.set_xticks(counts)
    axes.set_ylim(bottom=0)
    axes.legend()


def _draw_sizes(figure: Any, rows: Sequence[SizeRow], method: str) -> None:
    """Draw a method's median error against the images' side, a line for each data set."""
    axes = figure.add_subplot()
    for place, cell in enumerate(dict.fromkeys(row.cell for row in rows)):
        of_cell = [row for row in rows if row.cell == cell]
        axes.plot(
            [row.side for row in of_cell],
            [row.medians[method] for row in of_cell],
            marker=_MARKERS[place % len(_MARKERS)],
            label=legend_label(block_title(cell)),
            **series_style(place),
        )
    sides = sorted({row.side for row in rows})
    axes.set_xscale("log", base=2)
    axes.set_xticks(sides, [str(side) for side in sides])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_xlabel("longest side of an image, px")
    axes.set_ylabel(f"{method}: median reproduction error, degrees")
    figure.legend(loc="outside lower center", ncols=2)


def _draw_chromaticities(figure: Any, luts: Sequence[Lut], sets: Mapping[str, npt.NDArray[np.float64]]) -> None:
    """Draw the paper's figures of lights in camera RGB side by side, over ground truths (N, 3) of named data sets."""
    reach = max(float(rb_of(lut.white).max()) for lut in luts) * 1.04
    for place, lut in enumerate(luts):
        axes = figure.add_subplot(1, len(luts), place + 1)
        black_body = np.array([light.kind == "blackbody" for light in lut.illuminations], dtype=np.bool_)
        uniform, bodies = rb_of(lut.white[~black_body]), rb_of(lut.white[black_body])
        if len(uniform):
            axes.scatter(*uniform.T, s=7, color=FAINT, linewidths=0, label=f"uniform ({len(uniform)})", zorder=2)
        for number, (name, truths) in enumerate(sets.items()):
            style = series_style(number)
            points = rb_of(truths)
            _, first = np.unique((points / _SEEN).round(), axis=0, return_index=True)
            seen = points[first]
            axes.scatter(
                *seen.T, s=5, color=style["color"], linewidths=0, alpha=0.6, label=legend_label(name), zorder=3
            )
        if len(bodies):
            axes.scatter(
                *bodies.T,
                s=16,
                marker="D",
                facecolors="none",
                edgecolors=INK,
                linewidths=0.8,
                label=f"black bodies ({len(bodies)})",
                zorder=4,
            )
        axes.set_title(lut.provenance.camera)
        axes.set_xlabel("r")
        axes.set_ylabel("b")
        axes.set_xlim(0, reach)
        axes.set_ylim(0, reach)
        axes.set_aspect("equal")
        axes.legend(loc="upper right", fontsize=8, markerscale=1.6, handletextpad=0.2)


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
    with atomic_folder(folder, "the report") as partial:
        (partial / "report.html").write_text(pages.page(report.title, report.parts), encoding="utf-8")
        for name, content in report.files.items():
            (partial / name).write_bytes(content)


def _table_files(name: str, table: Table) -> dict[str, bytes]:
    """Return a table's files by their names: CSV and LaTeX."""
    return {f"{name}.csv": table_to_csv(table).encode(), f"{name}.tex": table_to_latex(table).encode()}


def table1_report(
    blocks: Sequence[Block],
    luts: Sequence[Lut],
    conditions: Sequence[str],
    kind: ErrorKind,
    sizes: Sequence[SizeRow] = (),
) -> PaperReport:
    """Return the report of table 1, first with one kind of error, then with the other.

    `sizes`: the errors for other sizes of images; may be empty.
    """
    other: ErrorKind = "recovery" if kind == "reproduction" else "reproduction"
    first, second = ([block_table(block, one) for block in blocks] for one in (kind, other))
    noise, prints = noise_table(luts), print_table(luts)
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
        drawn = draw_svg(_draw_sizes, sizes, "White-Patch", inches=(7.6, 4.8))
        table = size_table(sizes)
        tables.append(table)
        files |= {"sizes.csv": table_to_csv(table).encode(), "sizes.svg": standalone_svg(drawn)}
        caption = (
            "White-Patch takes the largest of all values, of which a larger image has more: of noise, and of whites."
        )
        parts += [pages.heading("Images of other sizes"), pages.figure(drawn, caption), table_part(table)]
    parts += [pages.heading("The tables"), table_part(noise), table_part(prints)]
    parts += [pages.heading(f"{other.capitalize()} error, degrees"), *map(table_part, second)]
    return PaperReport("Table 1: plain methods on generated data sets", tuple(tables), tuple(parts), files)


def table2_report(tables: Sequence[Table], conditions: Sequence[str]) -> PaperReport:
    """Return the report of table 2: both halves as one table, then the ratios."""
    *halves, ratios = tables
    caption = "Comparison of performance of learning-based methods with respect to the training"
    files = {
        "table2.tex": tables_to_latex(caption, halves).encode(),
        **_table_files("ratios", ratios),
        **{
            f"trained_on_{name}.csv": table_to_csv(half).encode()
            for name, half in zip(("real", "generated"), halves, strict=True)
        },
    }
    parts = (*map(pages.paragraph, conditions), *map(table_part, tables))
    return PaperReport("Table 2: trained on real and on generated images", tuple(tables), parts, files)


def bits_report(found: BitsResult, kind: ErrorKind, name: str, conditions: Sequence[str]) -> PaperReport:
    """Return the report of bits removal on a data set of that name."""
    drawn, table = draw_svg(_draw_bits, found, kind, inches=(6.4, 3.8)), bits_table(found, kind, name)
    caption = "Medians against the bits of each sRGB code that were set to zero; dotted, the linear images as they are."
    files = {"bits.svg": standalone_svg(drawn), **_table_files("bits", table)}
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
    drawn = draw_svg(_draw_chromaticities, luts, truths, inches=(4.6 * len(luts), 4.7))
    caption = (
        "rb-chromaticities, r = R / (R + G + B) and b = B / (R + G + B) in linear RGB of each table's camera, of the "
        "white under each light of the table; in colour the ground truths of data sets, each in its own camera's RGB."
    )
    parts, tables = [pages.figure(drawn, caption)], list[Table]()
    files = {
        "chromaticities.svg": standalone_svg(drawn),
        "chromaticities.csv": table_to_csv(chromaticity_rows(luts)).encode(),
    }
    if truths:
        coverage = coverage_table(luts, truths)
        tables.append(coverage)
        parts.append(table_part(coverage))
        files |= _table_files("coverage", coverage)
    return PaperReport("Chromaticities of the lights", tuple(tables), tuple(parts), files)
