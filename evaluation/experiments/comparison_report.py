"""A comparison's tables, page and files."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from evaluation.experiments.bootstrap import STATISTICS
from evaluation.experiments.comparing import (
    Comparison,
    largest_differences,
    missing_images,
    verdict,
)
from evaluation.reports.latex import tables_to_latex
from evaluation.reports.page import table_part
from evaluation.reports.scatter import FLOOR_DEG, error_scatter
from evaluation.results.summary_tables import PAPER_COLUMNS
from evaluation.results.tables import Table, table_to_csv
from foundation import pages
from foundation.errors import counted
from foundation.files import whole_folder

_HEADS = dict(zip(STATISTICS, PAPER_COLUMNS[1:], strict=True))
"""Statistics as every other table heads them; files keep the short names."""

_LABELLED = 5
"""Images labelled in a scatter: more names would cover one another."""

METHOD = (
    "Wilcoxon signed-rank test, two-sided; equal errors are ranked and then left out (Pratt).",
    "Effect: matched-pairs rank-biserial correlation, -1: the first errs less on every image; 1: more on every one.",
)
"""What the numbers of `tests_table` are."""


def tests_table(comparisons: Sequence[Comparison]) -> Table:
    """Return the signed-rank tests, a row a comparison."""
    several = len(comparisons) > 1
    notes = (*METHOD, *((f"p (Holm) is corrected for the {len(comparisons)} comparisons here.",) if several else ()))
    return Table(
        f"Paired {comparisons[0].matched.kind} errors",
        ("First", "Second", "p", "p (Holm)", "Effect", "Images", "First better", "Second better", "Equal"),
        tuple(
            (
                *made.matched.names,
                f"{made.test.p:.2g}",
                f"{made.p_holm:.2g}",
                made.test.effect,
                len(made.matched.images),
                made.test.wins,
                made.test.losses,
                made.test.ties,
            )
            for made in comparisons
        ),
        notes=notes,
    )


def statistics_table(comparison: Comparison, level: float) -> Table:
    """Return every statistic of one comparison, with difference and ratio."""
    one, other = comparison.matched.names
    images = counted(len(comparison.matched.images), "image")
    return Table(
        f"{one} against {other}: {comparison.matched.kind} errors of {images}, degrees",
        ("Statistic", "First", "Second", "Difference", "from", "to", "Ratio", "ratio from", "ratio to"),
        tuple(
            (_HEADS[made.statistic], made.one, made.other, *made.difference, *(_known(number) for number in made.ratio))
            for made in comparison.statistics
        ),
        digits=3,
        notes=(f"Intervals of {level:.0%}: BCa bootstrap over images, 2000 resamples, the same for both.",),
    )


def images_table(comparison: Comparison, count: int = 10) -> Table:
    """Return the images on which the two differ most."""
    matched = comparison.matched
    return Table(
        f"{matched.names[0]} against {matched.names[1]}: the largest differences, degrees",
        ("Image", "First", "Second", "Difference"),
        tuple(
            (matched.images[place], one, other, one - other)
            for place in largest_differences(matched, count)
            for one, other in [(float(matched.one[place]), float(matched.other[place]))]
        ),
    )


def comparison_page(comparisons: Sequence[Comparison], notes: Sequence[str], level: float) -> str:
    """Return the HTML page of comparisons."""
    parts: list[Markup] = [*(pages.paragraph(note) for note in notes)]
    parts += [pages.paragraph(verdict(made, level)) for made in comparisons]
    parts.append(table_part(tests_table(comparisons)))
    for made in comparisons:
        matched = made.matched
        marked = {place: matched.images[place] for place in largest_differences(matched, _LABELLED)}
        picture = error_scatter(matched.one, matched.other, matched.names, marked)
        caption = (
            f"An image a point: above the line (blue) {matched.names[0]} errs less, below it (orange) more. The images "
            f"with the largest differences are named. Errors below {FLOOR_DEG:g} degrees are drawn there."
        )
        parts += [
            pages.heading(f"{matched.names[0]} against {matched.names[1]}"),
            table_part(statistics_table(made, level)),
            pages.row([pages.figure(picture, caption), table_part(images_table(made))]),
        ]
    return pages.page(_title(comparisons), parts)


def write_comparisons(folder: Path, comparisons: Sequence[Comparison], notes: Sequence[str], level: float) -> None:
    """Write a new folder: `tests.csv`, `statistics.csv`, `images.csv`, `tables.tex` and `report.html`."""
    with whole_folder(folder, "the comparison") as place:
        (place / "tests.csv").write_text(table_to_csv(tests_table(comparisons)), encoding="utf-8")
        (place / "statistics.csv").write_text(_statistics_csv(comparisons), encoding="utf-8")
        (place / "images.csv").write_text(_images_csv(comparisons), encoding="utf-8")
        tables = [tests_table(comparisons)]
        tables += [statistics_table(made, level) for made in comparisons]
        text = "\n".join(tables_to_latex(table.title, [table]) for table in tables)
        (place / "tables.tex").write_text(text, encoding="utf-8")
        (place / "report.html").write_text(comparison_page(comparisons, notes, level), encoding="utf-8")


def notes_of(comparisons: Sequence[Comparison]) -> tuple[str, ...]:
    """Return the sentences on images that are missing, each once."""
    return tuple(dict.fromkeys(note for made in comparisons for note in missing_images(made.matched)))


def _title(comparisons: Sequence[Comparison]) -> str:
    if len(comparisons) == 1:
        return "{} against {}".format(*comparisons[0].matched.names)
    return f"{len(comparisons)} comparisons of {comparisons[0].matched.kind} errors"


def _known(number: float) -> float | None:
    return None if number != number else number


def _statistics_csv(comparisons: Sequence[Comparison]) -> str:
    heads = ("difference", "difference_low", "difference_high", "ratio", "ratio_low", "ratio_high")
    rows = tuple(
        (
            *made.matched.names,
            compared.statistic,
            compared.one,
            compared.other,
            *(_known(number) for number in (*compared.difference, *compared.ratio)),
        )
        for made in comparisons
        for compared in made.statistics
    )
    return table_to_csv(Table("", ("first", "second", "statistic", "first_deg", "second_deg", *heads), rows))


def _images_csv(comparisons: Sequence[Comparison]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("first", "second", "image", "first_deg", "second_deg", "difference_deg"))
    for made in comparisons:
        matched = made.matched
        for image, one, other in zip(matched.images, matched.one, matched.other, strict=True):
            numbers = (f"{number:.6f}" for number in (one, other, one - other))
            writer.writerow((*matched.names, image, *numbers))
    return text.getvalue()
