"""Tables of results as values, printed by commands, shown on pages and written as CSV.

Contains the general `Table`, its CSV text, and the tables of errors: the statistics of Banić et al. 2019 and worst 5 %,
all statistics, and errors under several illuminants. `reports.table_output` prints the tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind, MapError, summarise
from evaluation.results.result import NO_PIXEL, Result, Subject
from foundation.errors import first_few
from foundation.files import csv_text

Cell = str | float | None  # A text, a number (an `int` is not converted), or an unknown value

MISSING = "–"  # Shown for `None`; CSV has an empty field


@dataclass(frozen=True)
class Table:
    """A table with a title.

    - `title`: content and unit: "Cube+: reproduction angular error of 1707 images, degrees".
    - `columns`: headings of the columns, at least one.
    - `rows`: each with one value for each column. A column of numbers and None is aligned as numbers.
    - `digits`: number of decimals of a float in printed tables; CSV has nine significant digits.
    - `notes`: sentences below the table.
    - `best`: for columns of numbers, whether the smallest or the largest number is printed bold in LaTeX.
    - `margins`: half-widths of the intervals of numbers by row and column; printed after "±", not in CSV.

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
    best: Mapping[str, Literal["smallest", "largest"]] = field(
        default_factory=dict[str, Literal["smallest", "largest"]]
    )
    margins: Mapping[tuple[int, int], float] = field(default_factory=dict[tuple[int, int], float])

    def __post_init__(self) -> None:
        lengths = {len(row) for row in self.rows} | {len(self.columns)}
        if len(lengths) > 1 or not self.columns:
            raise ValueError(
                f"{self.title}: rows of {sorted(lengths)} values, expected {len(self.columns)}, one a column"
            )

    def texts(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows as text, numbers rounded to `digits`."""
        return tuple(
            tuple(
                _text(cell, self.digits)
                + (f" ± {self.margins[row, column]:.{self.digits}f}" if (row, column) in self.margins else "")
                for column, cell in enumerate(cells)
            )
            for row, cells in enumerate(self.rows)
        )

    def best_cells(self) -> set[tuple[int, int]]:
        """Return row and column of the best numbers of the columns in `best`; several if their texts are equal."""
        best: set[tuple[int, int]] = set()
        for name, direction in self.best.items() if len(self.rows) > 1 else ():
            column = self.columns.index(name)
            numbers = {
                row: round(cell, self.digits)
                for row, cells in enumerate(self.rows)
                if isinstance(cell := cells[column], float) and math.isfinite(cell)
            }
            limit = (min if direction == "smallest" else max)(numbers.values(), default=None)
            best |= {(row, column) for row, number in numbers.items() if number == limit}
        return best

    def numeric(self) -> tuple[bool, ...]:
        """Return True for each column that contains numbers and no text."""
        columns = [[row[index] for row in self.rows] for index in range(len(self.columns))]
        return tuple(
            not any(isinstance(cell, str) for cell in column) and any(cell is not None for cell in column)
            for column in columns
        )


def finite_or_none(number: float) -> float | None:
    """Return the number; None if it is not finite."""
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
    """Return columns and rows as CSV text (RFC 4180, lines end with LF), without title and notes.

    Numbers have nine significant digits; an unknown value is an empty field.

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


PAPER_COLUMNS = ("Algorithm", "Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.")  # Columns of Banić et al. 2019

# Columns of tables of errors that do not repeat a table of the paper.
ERROR_COLUMNS = (*PAPER_COLUMNS, "Worst 5%")

BEST_ERRORS: Mapping[str, Literal["smallest"]] = dict.fromkeys(ERROR_COLUMNS[1:], "smallest")

# Further statistics: 95th percentile, maximum, and percentage of errors below 3 degrees.
FURTHER_COLUMNS = ("95%", "Max.", "< 3° (%)")

# Names of all statistics in files for programs; `below3` is a fraction, 0 … 1.
STATISTICS_COLUMNS = ("mean", "median", "trimean", "best25", "worst25", "avg", "worst5", "p95", "maximum", "below3")

_NO_PIXEL_CAUSES = "too small for it, clipped, black or uniform"  # Reasons for an image without a usable pixel

_NAMED_IMAGES = 3  # Images named in a note; errors.csv lists all


def summary_table(subject: Subject, results: Sequence[Result], metric: ErrorKind, with_further: bool = False) -> Table:
    """Return the statistics of one kind of error for each method, with notes on images without an estimate.

    `with_further`: adds the 95th percentile, the maximum and the percentage below 3 degrees.
    """
    mixed_count = sum(subject.mixed)
    mixed_text = f" ({mixed_count} under several illuminants, compared with their mean)" if mixed_count else ""
    if mixed_count == len(subject.images):
        mixed_text = " under several illuminants, compared with their mean"
    return Table(
        f"{subject.name}: {metric} angular error of {len(subject.images)} images{mixed_text}, degrees",
        (*ERROR_COLUMNS, *(FURTHER_COLUMNS if with_further else ())),
        tuple((result.marked_name, *_statistics(result.errors[metric], with_further)) for result in results),
        notes=tuple(note for result in results for note in _missing_estimate_notes(subject, result)),
        best=BEST_ERRORS,
    )


def lights_tables(subject: Subject, results: Sequence[Result], metric: ErrorKind) -> tuple[Table, ...]:
    """Return additional tables for images under several illuminants; none if their errors by pixel are missing.

    The first table has the errors by pixel, by region and against the mean illuminant. If some images have one
    illuminant, the second table has their statistics.
    """
    single = np.array([not mixed for mixed in subject.mixed])
    if single.all() or any(result.maps is None for result in results):
        return ()
    tables = [_mixed_table(subject, results)]
    if single.any():
        title = (
            f"{subject.name}: {metric} angular error of the {int(single.sum())} images under one illuminant, degrees"
        )
        single_results = [result.at(np.flatnonzero(single)) for result in results]
        rows = tuple((result.marked_name, *_statistics(result.errors[metric], False)) for result in single_results)
        tables.append(Table(title, ERROR_COLUMNS, rows, best=BEST_ERRORS))
    return tuple(tables)


def statistics_rows(subject: Subject, results: Sequence[Result]) -> Table:
    """Return the table of `results.csv`: all statistics of every kind of error.

    Column `error`: recovery or reproduction; with the prefix `pixel_` or `region_` under several illuminants; or
    `pixel_rgb`. MAE_illum of LSMI is pixel_recovery; MAE_rgb is pixel_rgb. Column `lights`: images under "all", "one"
    or "several" illuminants. Column `count`: number of images, or of regions.
    """
    mixed = np.array(subject.mixed)
    subsets: list[tuple[str, npt.NDArray[np.bool_]]] = [("all", np.ones(len(mixed), bool))]
    if mixed.any():
        subsets += [(name, in_subset) for name, in_subset in (("one", ~mixed), ("several", mixed)) if in_subset.any()]
    kinds: tuple[ErrorKind, ...] = ("recovery", "reproduction")
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        for lights, in_subset in subsets:
            for metric in kinds:
                missing = int(result.guessed[in_subset].sum())
                rows.append(_row(result.method, metric, lights, result.errors[metric][in_subset], missing))
        if result.maps is not None:
            missing = int(result.guessed[mixed].sum())
            errors_by_kind = _map_errors(result.maps).items()
            rows += [_row(result.method, name, "several", errors, missing) for name, errors in errors_by_kind]
    return Table(
        f"{subject.name}: errors, degrees",
        ("method", "error", "lights", "count", *STATISTICS_COLUMNS, "no_estimate"),
        tuple(rows),
    )


def _map_errors(maps: Mapping[int, MapError]) -> dict[str, npt.NDArray[np.float64]]:
    regions = [region for error in maps.values() for region in error.regions]
    errors_by_kind = {
        "pixel_recovery": [error.recovery for error in maps.values()],
        "pixel_reproduction": [error.reproduction for error in maps.values()],
        "pixel_rgb": [error.rgb for error in maps.values()],
        "region_recovery": [region.recovery for region in regions],
        "region_reproduction": [region.reproduction for region in regions],
    }
    return {name: np.array(errors, dtype=np.float64) for name, errors in errors_by_kind.items()}


def _mixed_table(subject: Subject, results: Sequence[Result]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    excluded = 0
    for result in results:
        maps = result.maps
        assert maps is not None
        errors = _map_errors(maps)
        excluded = max(excluded, int(np.isnan(errors["pixel_rgb"]).sum()))
        columns = [errors[name] for name in ("pixel_recovery", "pixel_rgb", "region_recovery")]
        mixed = result.at(np.array(list(maps), np.int64))
        columns.append(mixed.errors["recovery"])
        rows.append((mixed.marked_name, *(cell for column in columns for cell in _mean_and_median(column))))
    excluded_note = (f"{excluded} images are excluded: all of their pixels are masked or have no ground truth",)
    return Table(
        f"{subject.name}: recovery angular error of the {sum(subject.mixed)} images under several illuminants, degrees",
        ("Algorithm", *("MAE_illum", "med.", "MAE_rgb", "med.", "By region", "med.", "Mean light", "med.")),
        tuple(rows),
        notes=(
            "Each mean over images (by region: over all regions) has its median in the next column",
            "MAE_illum and MAE_rgb: by pixel, averaged over pixels and then over images, as LSMI defines them (Kim et "
            "al., ICCV 2021)",
            "By region: against the illuminant that gives more than half of a pixel's light; all regions count equally",
            "Mean light: one estimate for the whole image against the mean of its illuminants, as in the table above",
            *(excluded_note if excluded else ()),
        ),
        best=dict.fromkeys(("MAE_illum", "MAE_rgb", "By region", "Mean light"), "smallest"),
    )


def _mean_and_median(errors: npt.NDArray[np.float64]) -> tuple[float | None, float | None]:
    measured = errors[np.isfinite(errors)]
    return (float(measured.mean()), float(np.median(measured))) if len(measured) else (None, None)


def _row(method: str, error: str, lights: str, errors: npt.NDArray[np.float64], missing: int) -> tuple[Cell, ...]:
    measured = errors[np.isfinite(errors)]
    if not len(measured):
        return (method, error, lights, 0, *(None for _ in STATISTICS_COLUMNS), missing)
    summary = summarise(measured)
    return (
        *(method, error, lights, len(measured)),
        *(float(getattr(summary, name)) for name in STATISTICS_COLUMNS),
        missing,
    )


def _statistics(errors: npt.NDArray[np.float64], with_further: bool) -> Iterable[float]:
    summary = summarise(errors)
    return (*summary.as_tuple(), *((summary.p95, summary.maximum, 100 * summary.below3) if with_further else ()))


def _missing_estimate_notes(subject: Subject, result: Result) -> Iterable[str]:
    count, causes = len(subject.images), result.causes or {}
    missing = [int(index) for index in np.flatnonzero(result.guessed)]
    without_pixel = [index for index in missing if causes.get(index, NO_PIXEL) == NO_PIXEL]
    without_estimate = [index for index in missing if causes.get(index, NO_PIXEL) != NO_PIXEL]
    # Grey replaces a missing estimate, so that a method does not improve if it omits difficult images.
    replaced = "grey was used as their estimate"
    if without_pixel:
        fraction = f"{len(without_pixel)} of {count} images"
        yield f"{result.method}: no usable pixel in {fraction} ({_NO_PIXEL_CAUSES}); {replaced}"
    if without_estimate:
        examples = first_few([f"{subject.images[index]} {causes[index]}" for index in without_estimate], _NAMED_IMAGES)
        yield f"{result.method}: no estimate for {len(without_estimate)} of {count} images ({examples}); {replaced}"
    incomplete = [index for index in causes if not result.guessed[index]]
    if incomplete:
        examples = first_few([f"{subject.images[index]}: {causes[index]}" for index in incomplete], _NAMED_IMAGES)
        yield f"{result.method}: no estimate for pixels of {len(incomplete)} images ({examples}); grey was used instead"
