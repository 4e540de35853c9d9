"""The figures of section 4 as SVG: medians against bits set to zero, against sizes, and chromaticities of lights."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.paper.chromaticities import TableLights, rb_of
from evaluation.experiments.paper.table1 import block_title
from foundation import plots
from foundation.plots import FAINT, INK, legend_label, series_style, svg_of

if TYPE_CHECKING:
    from evaluation.experiments.paper.bits import BitsResult
    from evaluation.experiments.paper.table1 import SizeRow
    from evaluation.metrics import ErrorKind

_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")
"""Markers of series, so that they differ in print without colour."""

_SEEN: Final = 0.004
"""Width of a dot in the figure of chromaticities; of points in one square of that width one is drawn."""

_PLACE: Final = re.compile(rb'(<use [^>]*\bx="[\d.]+?\.\d)\d*(" y="[\d.]+?\.\d)\d*"')
"""The place of a dot, of which a tenth of a point is as much as can be seen."""


def bits_figure(found: BitsResult, kind: ErrorKind) -> bytes:
    """Return the paper's figure of bits removal: each method's median against the bits; the raw image's as a line."""
    return svg_of(_draw_bits, found, kind, inches=(6.4, 3.8))


def _draw_bits(figure: Any, found: BitsResult, kind: ErrorKind) -> None:
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


def sizes_figure(rows: Sequence[SizeRow], method: str) -> bytes:
    """Return a method's median error against the images' side, a line for each data set."""
    return svg_of(_draw_sizes, rows, method, inches=(7.6, 4.8))


def _draw_sizes(figure: Any, rows: Sequence[SizeRow], method: str) -> None:
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


def chromaticities_figure(
    tables: Sequence[TableLights], sets: Mapping[str, npt.NDArray[np.float64]] | None = None
) -> bytes:
    """Return the paper's figures of lights in camera RGB side by side, over the ground truths of data sets.

    `sets`: name of a data set to its ground truths, (N, 3) float64, linear camera RGB of any length.
    """
    return svg_of(_draw_chromaticities, tables, sets or {}, inches=(4.6 * len(tables), 4.7))


def _draw_chromaticities(
    figure: Any, tables: Sequence[TableLights], sets: Mapping[str, npt.NDArray[np.float64]]
) -> None:
    reach = max(float(found.rb.max()) for found in tables) * 1.04
    for place, found in enumerate(tables):
        axes = figure.add_subplot(1, len(tables), place + 1)
        uniform, bodies = found.rb[~found.black_body], found.rb[found.black_body]
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
        axes.set_title(found.camera)
        axes.set_xlabel("r")
        axes.set_ylabel("b")
        axes.set_xlim(0, reach)
        axes.set_ylim(0, reach)
        axes.set_aspect("equal")
        axes.legend(loc="upper right", fontsize=8, markerscale=1.6, handletextpad=0.2)


def standalone(svg: bytes) -> bytes:
    """Return an SVG of `svg_of` as a file of its own, light or dark as the reader likes."""
    return _PLACE.sub(rb'\1\2"', plots.standalone(svg))
