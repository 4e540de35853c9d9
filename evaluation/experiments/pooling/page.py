"""The page of a pool: what was pooled, its tables, and forest plots of its ratios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from markupsafe import Markup

from evaluation.experiments.pooling.pool import Pool
from evaluation.experiments.transfer.figures import LEVEL, RowRatio, TransferFigures
from evaluation.experiments.transfer.tables import HEADS
from evaluation.reports.forest import ForestLine, Interval, forest_plot
from evaluation.reports.page import table_part
from evaluation.results.tables import Table
from foundation import pages
from foundation.errors import counted
from foundation.version import software

SHOWN: Final = (1, 0, 4)
"""Places in `bootstrap.STATISTICS` of what is shown of single test sets: median, mean and worst quarter."""

_MOST_LINES: Final = 90
"""Lines of a forest plot: with more, single test sets are left out, or the figure would be higher than two screens."""


def pool_page(
    pool: Pool,
    shown: Sequence[Table],
    whole: TransferFigures,
    single: Mapping[str, TransferFigures],
    places: Sequence[str],
) -> str:
    """Return the report of a pool as the text of one HTML file."""
    counts = {test: pool.tests.count(test) for test in single}
    told = ", ".join(f"{test} ({counted(count, 'image')})" for test, count in counts.items())
    images = counted(len(pool.images), "image")
    parts: list[Markup] = [
        pages.paragraph(
            f"Results of {counted(len(places), 'transfer')} pooled: {whole.error} errors of {images} of {told}, each "
            "image once and with the same weight."
        ),
        *_forest(
            "Against real cross-validation",
            whole.to_real,
            [figures.to_real for figures in single.values()],
            list(single),
            "Errors in parts of those of the same method, cross-validated on the test images themselves (the line at "
            "1). To the right of it real images train better.",
        ),
        *_forest(
            "Against the naive images",
            whole.to_naive,
            [figures.to_naive for figures in single.values()],
            list(single),
            "Errors with generated images in parts of those with naive ones, the same pictures under the same lights "
            "without a table (the line at 1). To the left of it the table is worth something.",
            against=True,
        ),
        *_forest(
            f"Against {whole.to_base[0].base.training}" if whole.to_base else "",
            whole.to_base,
            [figures.to_base for figures in single.values()],
            list(single),
            "Errors in parts of those of the same method with that training (the line at 1). To the left of it is "
            "better; where pictures or lights are others, the choice of them is held against it, too.",
        ),
        pages.heading("Tables"),
        *map(table_part, shown),
        pages.heading("Conditions"),
        *map(pages.paragraph, pool.notes),
        pages.paragraph(f"Made of {', '.join(places)}. {software()}."),
    ]
    return pages.page(f"Transfer to {' + '.join(single)}", parts)


def _forest(
    title: str,
    whole: Sequence[RowRatio],
    single: Sequence[Sequence[RowRatio]],
    names: Sequence[str],
    caption: str,
    against: bool = False,
) -> list[Markup]:
    """Return a heading and a forest plot; nothing where there is no ratio.

    `against` says whether a line is named after what a row is held to as well.
    """
    if not whole:
        return []
    apart = len(single) > 1
    lines = _lines(whole, single if apart else (), names, against)
    if len(lines) > _MOST_LINES:
        apart = False
        lines = _lines(whole, (), names, against)
    marks = f"Diamonds: all images, with intervals of {LEVEL:.0%}, paired by test image."
    if apart:
        marks += " Squares: each test set by itself."
    picture = forest_plot(lines, [HEADS[place] for place in SHOWN])
    alt = f"{title}: forest plot of the ratios of {', '.join(HEADS[place] for place in SHOWN)}"
    return [pages.heading(title), pages.figure(picture, f"{caption} {marks}", alt)]


def _lines(
    whole: Sequence[RowRatio], single: Sequence[Sequence[RowRatio]], names: Sequence[str], against: bool
) -> list[ForestLine]:
    """Return the lines of a forest plot: methods, each with its rows, each with its test sets."""
    lines: list[ForestLine] = []
    for series, method in enumerate(dict.fromkeys(one.row.method for one in whole)):
        lines.append(ForestLine(method))
        for number, one in enumerate(whole):
            if one.row.method != method:
                continue
            label = f"{one.row.data or one.row.training} / {one.base.kind}" if against else one.row.training
            lines.append(ForestLine(label, _intervals(one), series))
            lines += [
                ForestLine(name, _intervals(ratios[number]), series, whole=False)
                for name, ratios in zip(names, single, strict=False)
            ]
    return lines


def _intervals(ratio: RowRatio) -> tuple[Interval, ...]:
    figures = [ratio.ratios[place] for place in SHOWN]
    return tuple((figure.value, figure.low, figure.high) for figure in figures)
