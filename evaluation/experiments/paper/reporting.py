"""Write reports of the paper's experiments to folders: a page, tables as CSV and LaTeX, figures as SVG or PNG.

The figures of chromaticities (sections 3.1 and 3.3) show the white under each illuminant of a look-up table (LUT), in
camera RGB, with the ground truths of real data sets for comparison.
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
    printed_colours_table,
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


def rb_chromaticities(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rb-chromaticities (N, 2) float64 of illuminants (N, 3) float64, linear camera RGB of any scale.

    Examples
    --------
    >>> rb_chromaticities(np.array([[1.0, 2.0, 1.0]]))
    array([[0.25, 0.25]])
    """
    return (lights / lights.sum(axis=1, keepdims=True))[:, [0, 2]]


def chromaticity_rows(luts: Sequence[Lut]) -> Table:
    """Return every illuminant of the LUTs with kind and chromaticity, for CSV."""
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        for light, (r, b) in zip(lut.illuminations, rb_chromaticities(lut.white), strict=True):
            rows.append((lut.provenance.camera, light.index, light.kind, light.cct_k, float(r), float(b)))
    columns = ("camera", "light", "kind", "cct_k", "r", "b")
    return Table("rb-chromaticities of illuminants", columns, tuple(rows), digits=4)


def coverage_table(luts: Sequence[Lut], sets: Mapping[str, npt.NDArray[np.float64]]) -> Table:
    """Return the angles from ground truths of data sets to the nearest illuminants of LUTs.

    `sets`: ground truths by name of the data set, (N, 3) float64, linear camera RGB of any scale.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        for name, truths in sets.items():
            matches = nearest_lights(lut, truths).matches
            angles = np.array([match.angle for match in matches])
            nearest_count = len({match.mixture.label for match in matches})
            rows.append(
                (
                    lut.provenance.camera,
                    name,
                    len(truths),
                    nearest_count,
                    float(np.median(angles)),
                    float(np.percentile(angles, 95, method="hazen")),
                    float(angles.max()),
                )
            )
    return Table(
        "Angle from ground truths to the nearest illuminant of a look-up table (LUT), degrees",
        ("Table", "Data set", "Ground truths", "Lights that are nearest", "Median", "95th percentile", "Largest"),
        tuple(rows),
    )


# Markers of series. They distinguish series in print without colour.
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")

# Width of a dot in the figure of chromaticities. Only one point is drawn in each square of this width.
_DOT_WIDTH: Final = 0.004


def _draw_bits(figure: Any, bits_result: BitsResult, metric: ErrorKind) -> None:
    # As in the paper: median of each method against the number of bits. Dotted lines are for unchanged images.
    axes = figure.add_subplot()
    counts = list(bits_result.reduced)
    for index, raw in enumerate(bits_result.raw):
        style = series_style(index)
        medians = [results[index].summary(metric).median for results in bits_result.reduced.values()]
        axes.plot(counts, medians, marker=_MARKERS[index % len(_MARKERS)], label=legend_label(raw.method), **style)
        axes.axhline(raw.summary(metric).median, color=style["color"], linewidth=0.8, linestyle=":")
    axes.set_xlabel("bits of each sRGB code set to zero (dotted: unchanged linear images)")
    axes.set_ylabel(f"median {metric} error, degrees")
    axes.set_xticks(counts)
    axes.set_ylim(bottom=0)
    axes.legend()


def _draw_sizes(figure: Any, rows: Sequence[SizeRow], method: str) -> None:
    axes = figure.add_subplot()
    for index, key in enumerate(dict.fromkeys(row.key for row in rows)):
        block_rows = [row for row in rows if row.key == key]
        axes.plot(
            [row.side for row in block_rows],
            [row.medians[method] for row in block_rows],
            marker=_MARKERS[index % len(_MARKERS)],
            label=legend_label(block_title(key)),
            **series_style(index),
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
    # As in the paper: illuminants of each camera in one panel, together with ground truths of data sets.
    axis_end = max(float(rb_chromaticities(lut.white).max()) for lut in luts) * 1.04
    for index, lut in enumerate(luts):
        axes = figure.add_subplot(1, len(luts), index + 1)
        black_body = np.array([light.kind == "blackbody" for light in lut.illuminations], dtype=np.bool_)
        uniform, bodies = rb_chromaticities(lut.white[~black_body]), rb_chromaticities(lut.white[black_body])
        if len(uniform):
            axes.scatter(*uniform.T, s=7, color=FAINT, linewidths=0, label=f"uniform ({len(uniform)})", zorder=2)
        for set_index, (name, truths) in enumerate(sets.items()):
            style = series_style(set_index)
            points = rb_chromaticities(truths)
            _, first_indices = np.unique((points / _DOT_WIDTH).round(), axis=0, return_index=True)
            dots = points[first_indices]
            axes.scatter(
                *dots.T, s=5, color=style["color"], linewidths=0, alpha=0.6, label=legend_label(name), zorder=3
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
        axes.set_xlim(0, axis_end)
        axes.set_ylim(0, axis_end)
        axes.set_aspect("equal")
        axes.legend(loc="upper right", fontsize=8, markerscale=1.6, handletextpad=0.2)


_TABLE1_TEXT = (
    "Performance of White-Patch, Gray-world and Shades-of-Gray on eight generated data sets, {metric} error in degrees"
)


@dataclass(frozen=True, eq=False)
class PaperReport:
    """Report of one experiment."""

    title: str  # Title of the page
    tables: tuple[Table, ...]  # Printed tables, in order
    elements: tuple[Markup, ...]  # HTML elements of the page
    files: Mapping[str, bytes]  # Contents of the other files, by name


def write_report(report: PaperReport, folder: Path) -> None:
    """Write a report to a new folder, completely or not at all; its page is `report.html`."""
    with atomic_folder(folder, "the report") as partial:
        (partial / "report.html").write_text(pages.page(report.title, report.elements), encoding="utf-8")
        for name, content in report.files.items():
            (partial / name).write_bytes(content)


def _table_files(name: str, table: Table) -> dict[str, bytes]:
    return {f"{name}.csv": table_to_csv(table).encode(), f"{name}.tex": table_to_latex(table).encode()}


def table1_report(
    blocks: Sequence[Block],
    luts: Sequence[Lut],
    conditions: Sequence[str],
    metric: ErrorKind,
    sizes: Sequence[SizeRow] = (),
) -> PaperReport:
    """Return the report of table 1 with both kinds of error, `metric` first; `sizes` may be empty."""
    other_metric: ErrorKind = "recovery" if metric == "reproduction" else "reproduction"
    first_tables, second_tables = ([block_table(block, name) for block in blocks] for name in (metric, other_metric))
    noise, colours = noise_table(luts), printed_colours_table(luts)
    files = {
        "table1.csv": table_to_csv(joint_table(blocks)).encode(),
        "table1.tex": tables_to_latex(_TABLE1_TEXT.format(metric=metric), first_tables).encode(),
        f"table1_{other_metric}.tex": tables_to_latex(_TABLE1_TEXT.format(metric=other_metric), second_tables).encode(),
        "noise.csv": table_to_csv(noise).encode(),
        "print.csv": table_to_csv(colours).encode(),
    }
    elements = [
        *map(pages.paragraph, conditions),
        pages.heading(f"{metric.capitalize()} error, degrees"),
        *map(table_part, first_tables),
    ]
    tables = [*first_tables, noise, colours]
    if sizes:
        size_plot = draw_svg(_draw_sizes, sizes, "White-Patch", inches=(7.6, 4.8))
        table = size_table(sizes)
        tables.append(table)
        files |= {"sizes.csv": table_to_csv(table).encode(), "sizes.svg": standalone_svg(size_plot)}
        caption = "White-Patch uses the largest values. They increase with the number of pixels, because of noise."
        elements += [pages.heading("Images of other sizes"), pages.figure(size_plot, caption), table_part(table)]
    elements += [pages.heading("Look-up tables"), table_part(noise), table_part(colours)]
    elements += [pages.heading(f"{other_metric.capitalize()} error, degrees"), *map(table_part, second_tables)]
    return PaperReport("Table 1: methods on generated data sets", tuple(tables), tuple(elements), files)


def table2_report(tables: Sequence[Table], conditions: Sequence[str]) -> PaperReport:
    """Return the report of table 2; `tables` are the two halves and the ratios of their medians."""
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
    elements = (*map(pages.paragraph, conditions), *map(table_part, tables))
    return PaperReport("Table 2: trained on real and on generated images", tuple(tables), elements, files)


def bits_report(bits_result: BitsResult, metric: ErrorKind, name: str, conditions: Sequence[str]) -> PaperReport:
    """Return the report of colour reduction on the data set with this name."""
    plot, table = draw_svg(_draw_bits, bits_result, metric, inches=(6.4, 3.8)), bits_table(bits_result, metric, name)
    caption = "Medians against the number of bits of each sRGB code set to zero. Dotted lines: unchanged linear images."
    files = {"bits.svg": standalone_svg(plot), **_table_files("bits", table)}
    elements = (*map(pages.paragraph, conditions), pages.figure(plot, caption), table_part(table))
    return PaperReport("The effect of colour reduction on illuminant estimation", (table,), elements, files)


def reduction_report(picture: npt.NDArray[np.uint8], name: str) -> PaperReport:
    """Return the report of one picture (H, W, 3) uint8, sRGB codes, with 0 … 7 bits of its codes set to zero."""
    import cv2

    table = reduction_table(picture)
    strip = reduction_strip(picture)
    png = bytes(np.asarray(cv2.imencode(".png", strip[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]))
    caption = f"{name} with 0 to 7 bits of each code set to zero, row by row; the LUTs of the paper keep 5 of 8 bits."
    files = {"reduction.png": png, "reduction.csv": table_to_csv(table).encode()}
    return PaperReport(
        "Influence of colour reduction", (table,), (pages.figure(png, caption), table_part(table)), files
    )


def chromaticities_report(luts: Sequence[Lut], sets: Sequence[Truths]) -> PaperReport:
    """Return the report of the illuminants of LUTs, with ground truths of data sets."""
    truths = {ground_truths.name: ground_truths.lights for ground_truths in sets}
    plot = draw_svg(_draw_chromaticities, luts, truths, inches=(4.6 * len(luts), 4.7))
    caption = (
        "rb-chromaticities, r = R / (R + G + B) and b = B / (R + G + B), of the white under each illuminant of a "
        "look-up table (LUT), in linear camera RGB. In colour: ground truths of data sets, each in its own camera RGB."
    )
    elements, tables = [pages.figure(plot, caption)], list[Table]()
    files = {
        "chromaticities.svg": standalone_svg(plot),
        "chromaticities.csv": table_to_csv(chromaticity_rows(luts)).encode(),
    }
    if truths:
        coverage = coverage_table(luts, truths)
        tables.append(coverage)
        elements.append(table_part(coverage))
        files |= _table_files("coverage", coverage)
    return PaperReport("Chromaticities of the illuminants", tuple(tables), tuple(elements), files)
