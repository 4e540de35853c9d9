"""A table of results as a value: what commands print, pages show, papers set and other programs read.

Every command of `evaluate` makes one of these and hands it to `reports.table_output`; as CSV it is written here. So are
the tables that sum up results: the paper's six columns, every statistic, and errors under several lights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind, MapError, summarise
from evaluation.results.result import NO_PIXEL, Result, Subject
from foundation.errors import first_few
from foundation.files import csv_text

Cell = str | float | None  # A name, a number (an `int` stays one), or nothing known

MISSING = "–"  # What stands for `None` where people read; in CSV the field is empty


@dataclass(frozen=True)
class Table:
    """A table with a title.

    - `title`: what it shows, with the unit of its numbers: "Cube+: reproduction angular error of 1707 images, degrees".
    - `columns`: heads of the columns, at least one.
    - `rows`: as many cells as columns each. A column whose cells are numbers or None is set as numbers.
    - `digits`: decimals of a float where people read; CSV has them all.
    - `notes`: sentences below the table.

    Examples
    --------
    >>> Table("Errors, degrees", ("Algorithm", "Mean"), (("Gray-world", 3.14159), ("Grey", None))).texts()
    (('Gray-world', '3.14'), ('Grey', '–'))
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: int = 2
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lengths = {len(row) for row in self.rows} | {len(self.columns)}
        if len(lengths) > 1 or not self.columns:
            raise ValueError(f"{self.title}: rows of {sorted(lengths)} cells under {len(self.columns)} heads")

    def texts(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows as people read them, numbers rounded to `digits`."""
        return tuple(tuple(_text(cell, self.digits) for cell in row) for row in self.rows)

    def numeric(self) -> tuple[bool, ...]:
        """Return for each column whether it holds numbers: at least one, and no text."""
        columns = [[row[place] for row in self.rows] for place in range(len(self.columns))]
        return tuple(
            not any(isinstance(cell, str) for cell in column) and any(cell is not None for cell in column)
            for column in columns
        )


def finite_or_none(number: float) -> float | None:
    """Return a number as a cell has it: None where it is not finite."""
    return number if math.isfinite(number) else None


def _text(cell: Cell, digits: int) -> str:
    match cell:
        case None:
            return MISSING
        case float():
            return f"{cell:.{digits}f}"
        case _:
            return str(cell)


def table_to_csv(table: Table) -> str:
    """Return the columns and rows as CSV text (RFC 4180, lines end with LF): numbers to nine significant digits.

    Title and notes are left out, so that the text is a table and nothing else; an unknown value is an empty field.

    Examples
    --------
    >>> print(table_to_csv(Table("Errors", ("method", "mean", "images"), (("a, b", 1 / 3, 9), ("c", None, 0)))), end="")
    method,mean,images
    "a, b",0.333333333,9
    c,,0
    """
    cells = [
        ["" if cell is None else f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row]
        for row in table.rows
    ]
    return csv_text([table.columns, *cells])


PAPER_COLUMNS = ("Algorithm", "Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.")  # Heads of the paper's tables

# Heads of the statistics beyond them: 95th percentile, maximum, and percentage of errors below 3 degrees.
FURTHER_COLUMNS = ("95%", "Max.", "< 3° (%)")

# Heads of all statistics in files for programs; `below3` is a share, 0 … 1.
STATISTICS_COLUMNS = ("mean", "median", "trimean", "best25", "worst25", "avg", "p95", "maximum", "below3")

_NO_PIXEL_CAUSES = "too small for it, clipped, black or even"  # Why an image has no usable pixel for a method

_NAMED = 3  # Images that a note names: all of them stand in errors.csv


def summary_table(subject: Subject, results: Sequence[Result], kind: ErrorKind, further: bool = False) -> Table:
    """Return the table of the paper for one kind of error, with notes on images for which a method gave no light.

    `further`: whether to add the 95th percentile, the maximum and the percentage below 3 degrees.
    """
    several = sum(subject.mixed)
    held = f" ({several} of them under several lights, held to the mean of these)" if several else ""
    held = " under several lights, held to the mean of these" if several == len(subject.images) else held
    return Table(
        f"{subject.name}: {kind} angular error of {len(subject.images)} images{held}, degrees",
        (*PAPER_COLUMNS, *(FURTHER_COLUMNS if further else ())),
        tuple((result.marked_name, *_statistics(result.errors[kind], further)) for result in results),
        notes=tuple(note for result in results for note in _notes(subject, result)),
    )


def lights_tables(subject: Subject, results: Sequence[Result], kind: ErrorKind) -> tuple[Table, ...]:
    """Return what is to stand beside the summary where several lights fall on images; nothing where they do not.

    The first table has the errors by pixel, by region and against the mean light of the images under several lights;
    the second, where there are any, the paper's statistics of the other images alone.
    """
    single = np.array([not mixed for mixed in subject.mixed])
    if single.all() or any(result.maps is None for result in results):
        return ()
    tables = [_several(subject, results)]
    if single.any():
        title = f"{subject.name}: {kind} angular error of the {int(single.sum())} images under one light, degrees"
        alone = [result.at(np.flatnonzero(single)) for result in results]
        rows = tuple((result.marked_name, *_statistics(result.errors[kind], False)) for result in alone)
        tables.append(Table(title, PAPER_COLUMNS, rows))
    return tuple(tables)


def statistics_rows(subject: Subject, results: Sequence[Result]) -> Table:
    """Return every statistic of every kind of error as one long table for programs: `results.csv`.

    Its `error` is recovery or reproduction, or, of images under several lights, one of these with `pixel_` or `region_`
    before it, or `pixel_rgb`: LSMI's MAE_illum is pixel_recovery, its MAE_rgb pixel_rgb. `lights` says of which images
    the row is: "all", "one" or "several" lights. `count` are the images, of regions the regions.
    """
    mixed = np.array(subject.mixed)
    parts: list[tuple[str, npt.NDArray[np.bool_]]] = [("all", np.ones(len(mixed), bool))]
    if mixed.any():
        parts += [(name, which) for name, which in (("one", ~mixed), ("several", mixed)) if which.any()]
    kinds: tuple[ErrorKind, ...] = ("recovery", "reproduction")
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        for lights, which in parts:
            for kind in kinds:
                missing = int(result.guessed[which].sum())
                rows.append(_row(result.method, kind, lights, result.errors[kind][which], missing))
        if result.maps is not None:
            missing = int(result.guessed[mixed].sum())
            named = _by_place(result.maps).items()
            rows += [_row(result.method, name, "several", errors, missing) for name, errors in named]
    return Table(
        f"{subject.name}: errors, degrees",
        ("method", "error", "lights", "count", *STATISTICS_COLUMNS, "no_estimate"),
        tuple(rows),
    )


def _by_place(maps: Mapping[int, MapError]) -> dict[str, npt.NDArray[np.float64]]:
    """Return the errors by pixel and by region of images under several lights, by their names in files."""
    regions = [region for error in maps.values() for region in error.regions]
    found = {
        "pixel_recovery": [error.recovery for error in maps.values()],
        "pixel_reproduction": [error.reproduction for error in maps.values()],
        "pixel_rgb": [error.rgb for error in maps.values()],
        "region_recovery": [region.recovery for region in regions],
        "region_reproduction": [region.reproduction for region in regions],
    }
    return {name: np.array(errors, dtype=np.float64) for name, errors in found.items()}


def _several(subject: Subject, results: Sequence[Result]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    unjudged = 0
    for result in results:
        maps = result.maps
        assert maps is not None
        errors = _by_place(maps)
        unjudged = max(unjudged, int(np.isnan(errors["pixel_rgb"]).sum()))
        columns = [errors[name] for name in ("pixel_recovery", "pixel_rgb", "region_recovery")]
        mixed = result.at(np.array(list(maps), np.int64))
        columns.append(mixed.errors["recovery"])
        rows.append((mixed.marked_name, *(cell for column in columns for cell in _mean_and_median(column))))
    none_left = (f"{unjudged} images have no pixel whose light is known and that is not masked: they are left out",)
    return Table(
        f"{subject.name}: recovery angular error of the {sum(subject.mixed)} images under several lights, degrees",
        (
            "Algorithm",
            *("MAE_illum", "med.", "MAE_rgb", "med.", "By region", "med.", "Mean light", "med."),
        ),
        tuple(rows),
        notes=(
            "Each column is the mean over images, that by region over all regions; beside it the median",
            "MAE_illum and MAE_rgb: by pixel, averaged over pixels and then over images, as LSMI defines them (Kim et "
            "al., ICCV 2021)",
            "By region: against the light that gives more than half of a pixel's light; every region counts the same",
            "Mean light: the one estimate for the whole image against the mean of its lights, as in the table above",
            *(none_left if unjudged else ()),
        ),
    )


def _mean_and_median(errors: npt.NDArray[np.float64]) -> tuple[float | None, float | None]:
    known = errors[np.isfinite(errors)]
    return (float(known.mean()), float(np.median(known))) if len(known) else (None, None)


def _row(method: str, error: str, lights: str, errors: npt.NDArray[np.float64], missing: int) -> tuple[Cell, ...]:
    known = errors[np.isfinite(errors)]
    if not len(known):
        return (method, error, lights, 0, *(None for _ in STATISTICS_COLUMNS), missing)
    summary = summarise(known)
    return (
        *(method, error, lights, len(known)),
        *(float(getattr(summary, name)) for name in STATISTICS_COLUMNS),
        missing,
    )


def _statistics(errors: npt.NDArray[np.float64], further: bool) -> Iterable[float]:
    summary = summarise(errors)
    return (*summary.as_tuple(), *((summary.p95, summary.maximum, 100 * summary.below3) if further else ()))


def _notes(subject: Subject, result: Result) -> Iterable[str]:
    """Yield what is to be said of images for which a method gave no light, or none for some pixels."""
    count, causes = len(subject.images), result.causes or {}
    missing = [int(number) for number in np.flatnonzero(result.guessed)]
    blind = [number for number in missing if causes.get(number, NO_PIXEL) == NO_PIXEL]
    wrong = [number for number in missing if causes.get(number, NO_PIXEL) != NO_PIXEL]
    taken = "their light was taken to be grey"
    if blind:
        counted = f"{len(blind)} of {count} images"
        yield f"{result.method}: no usable pixel in {counted} ({_NO_PIXEL_CAUSES}); {taken}"
    if wrong:
        named = first_few([f"{subject.images[number]} {causes[number]}" for number in wrong], _NAMED)
        yield f"{result.method}: no light for {len(wrong)} of {count} images ({named}); {taken}"
    partly = [number for number in causes if not result.guessed[number]]
    if partly:
        named = first_few([f"{subject.images[number]}: {causes[number]}" for number in partly], _NAMED)
        yield f"{result.method}: no light for pixels of {len(partly)} images ({named}); they were taken to be grey"
