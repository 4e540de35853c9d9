"""Results folders of several transfers, such as one for each of several cameras, pooled into one.

A ratio of medians is known to some 15 % from two hundred images: what is to be told apart by less needs the images of
several cameras together. Each folder's rows are those of `evaluate transfer`; a row of the pool has the errors of the
same method, trained in the same way, on all folders' test images, every image once and with the same weight. Its
intervals are of images drawn from all of them, and ratios stay paired by image.

The results folder has the tables of a transfer over all images and of each test set by itself, and a page of forest
plots of the ratios.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, cast, get_args

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.experiments.transfer.outcome import (
    BESIDE_CAPTION,
    HEADS,
    LEVEL,
    SHOWN,
    ForestLine,
    RowRatio,
    TransferFigures,
    beside_plot,
    figures_of,
    forest_plot,
    labelled_results,
    long_table,
    shown_ratios,
    tables_of,
    write_shown,
)
from evaluation.experiments.transfer.rows import Kind, TransferRow, Way
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part
from evaluation.results.files import MethodErrors, errors_csv, read_errors
from evaluation.results.result import Result
from evaluation.results.tables import Cell, Table, table_to_csv
from foundation import pages
from foundation.errors import FormatError, InputError, counted, first_of
from foundation.files import read_csv, write_whole
from foundation.folders import whole_folder
from foundation.version import software

_KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class TransferResults:
    """A results folder of `evaluate transfer`, read back.

    - `place`: the folder as it was named.
    - `test`: name of the test set.
    - `images`: the names of the N test images.
    - `truths`: (N, 3) float64, linear camera RGB of their lights.
    - `rows`: its rows, the images in that order.
    - `error`: the kind of error that it was summed up by.
    - `conditions`: what of its settings would make its rows other ones, each as JSON text by its name.
    - `generated`: whether the test images were generated.
    """

    place: str
    test: str
    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    rows: tuple[TransferRow, ...]
    error: ErrorKind
    conditions: Mapping[str, str] = field(default_factory=dict[str, str])
    generated: bool = False


def read_transfer(place: Path | str) -> TransferResults:
    """Return what a results folder of `evaluate transfer` holds."""
    folder = Path(place)
    about = _about(folder)
    errors = read_errors(folder)
    rows: list[TransferRow] = []
    first: MethodErrors | None = None
    truths: npt.NDArray[np.float64] | None = None
    for row, seeds in _listed(folder / "results.csv"):
        found = [errors.get(name) for name in row.labels(seeds)]
        whole = [one for one in found if one is not None]
        if len(whole) < len(found):
            raise FormatError(
                f"{folder / 'errors.csv'} lacks {first_of(row.labels(seeds))}, which results.csv has; the files of a "
                "results folder belong together: run the transfer again"
            )
        results: list[Result] = []
        for one in whole:
            first = first or one
            if one.images != first.images or one.truths is None or one.estimates is None:
                raise FormatError(
                    f"{folder / 'errors.csv'}: {one.method} has other images than {first.method}, or lights are "
                    "missing; run the transfer again"
                )
            truths = one.truths if truths is None else truths
            results.append(Result(row.method, one.estimates, one.errors, one.guessed))
        rows.append(replace(row, results=tuple(results)))
    if first is None or truths is None:
        raise FormatError(f"{folder / 'results.csv'} has no row; run the transfer again")
    try:
        test, error = str(about["test"]["name"]), about["settings"]["error"]
        generated = about["test"].get("generated") is not None
        conditions = _conditions(about["settings"])
    except (AttributeError, KeyError, TypeError) as fault:
        raise FormatError(f"{folder / 'run.json'} does not say the {fault} of the transfer; run it again") from fault
    return TransferResults(str(place), test, first.images, truths, tuple(rows), error, conditions, generated)


def _conditions(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return what of a transfer's settings is to be the same in those that are pooled.

    Not the colour matrix, which each camera has of its own, nor which images were tested.
    """
    found = {f"--{name}": settings.get(name) for name in ("folds", "images", "side", "shared")}
    for method in (*settings.get("methods", ()), *settings.get("statistics", ())):
        found[f"the settings of {method['name']}"] = method.get("settings")
    return {name: json.dumps(value, sort_keys=True) for name, value in found.items()}


def _about(folder: Path) -> dict[str, Any]:
    expected = "name a folder that evaluate transfer --out has written"
    try:
        found = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {folder / 'run.json'}: {error.strerror or error}; {expected}") from error
    except ValueError as error:
        raise FormatError(f"{folder / 'run.json'} is no JSON: {error}; {expected}") from error
    about = cast("dict[str, Any]", found) if isinstance(found, dict) else {}
    if about.get("format") != "crop.transfer":
        raise InputError(
            f"{folder} holds results of the format {about.get('format')!r}, expected 'crop.transfer'; {expected}"
        )
    return about


def _listed(path: Path) -> list[tuple[TransferRow, int]]:
    """Return the rows that a results file lists, without results, and the number of their seeds."""
    lines = read_csv(path, "name a folder that evaluate transfer --out has written")[1]
    try:
        found = {
            (line["method"], line["training"], line["data"], line.get("way", ""), line.get("real", "")): (
                int(line["images"]),
                int(line["seeds"]),
            )
            for line in lines
        }
    except (KeyError, ValueError) as error:
        raise FormatError(f"{path} is no table of a transfer: {error}; run the transfer again") from error
    strange = [kind for _, kind, *_ in found if kind not in _KINDS]
    if strange:
        raise FormatError(f"{path} has the training {first_of(strange)}; expected one of {', '.join(_KINDS)}")
    return [
        (TransferRow(method, cast("Kind", kind), data, images, (), cast("Way", way), real), seeds)
        for (method, kind, data, way, real), (images, seeds) in found.items()
    ]


@dataclass(frozen=True, eq=False)
class Pool:
    """Several results as one.

    - `images`: folder and name of each of the N images, `folder/image`.
    - `truths`: (N, 3) float64.
    - `tests`: (N,) str, the test set of each image.
    - `rows`: the rows that all folders have.
    - `notes`: sentences for the reader: rows left out, conditions that differ.
    """

    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    tests: tuple[str, ...]
    rows: tuple[TransferRow, ...]
    notes: tuple[str, ...]


def pool_transfers(parts: Sequence[TransferResults]) -> Pool:
    """Return the rows of several results with the errors of all their images.

    A row is found again by its method, by how it was trained, and by the name of its training set; where each of the
    folders has a single training set, whatever its name. Seed k of the pool is seed k of each. A row's training images
    are those of the folder with the fewest.
    """
    if not parts:
        raise InputError("no results to pool: name folders that evaluate transfer --out has written")
    _require_apart(parts)
    single = all(len({row.data for row in part.rows if row.data}) == 1 for part in parts)
    keyed = [{_key(row, single): row for row in part.rows} for part in parts]
    common = [key for key in keyed[0] if all(key in rows for rows in keyed)]
    missing = sorted({", ".join(word for word in key if word) for rows in keyed for key in rows if key not in common})
    if not common:
        raise InputError(
            f"{parts[0].place} and the others have no row in common: they have {first_of(missing, 4)}; pool transfers "
            "of the same methods, whose training sets have the same names"
        )
    notes = [f"Left out, since not all of the results have them: {'; '.join(missing)}"] if missing else []
    notes += _differences(parts)
    places = [part.place for part in parts]
    labels = [Path(place).resolve().name for place in places]
    if len(set(labels)) < len(labels):
        labels = places
    rows = [_joined([rows[key] for rows in keyed], places, single) for key in common]
    return Pool(
        images=tuple(f"{label}/{image}" for label, part in zip(labels, parts, strict=True) for image in part.images),
        truths=np.concatenate([part.truths for part in parts]),
        tests=tuple(part.test for part in parts for _ in part.images),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _differences(parts: Sequence[TransferResults]) -> list[str]:
    """Return sentences on conditions that are not the same in all folders, and on test images that are not real."""
    notes: list[str] = []
    for name in dict.fromkeys(name for part in parts for name in part.conditions):
        places: dict[str, list[str]] = {}
        for part in parts:
            if name in part.conditions:
                places.setdefault(part.conditions[name], []).append(part.place)
        if len(places) > 1:
            told = "; ".join(f"{value} in {', '.join(named)}" for value, named in places.items())
            notes.append(f"The results do not have the same conditions: {name} is {told}")
    made = list(dict.fromkeys(part.test for part in parts if part.generated))
    if made:
        notes.append(f"Made by generate, so that they say nothing of real images: the test sets {', '.join(made)}")
    return notes


def _joined(rows: Sequence[TransferRow], places: Sequence[str], single: bool) -> TransferRow:
    """Return one row of those of all folders, which are of one method and training."""
    counts = [len(row.results) for row in rows]
    if len(set(counts)) > 1:
        told = ", ".join(f"{count} in {place}" for count, place in zip(counts, places, strict=True))
        raise InputError(f"{rows[0].method} has different numbers of seeds: {told}; run all with the same --seeds")
    names = list(dict.fromkeys(row.data for row in rows))
    results = [_concatenated([row.results[seed] for row in rows]) for seed in range(counts[0])]
    return TransferRow(
        method=rows[0].method,
        kind=rows[0].kind,
        data="each camera's own" if single and len(names) > 1 else names[0],
        images=min(row.images for row in rows),
        results=tuple(results),
        way=rows[0].way,
        real=rows[0].real,
    )


def _concatenated(results: Sequence[Result]) -> Result:
    return Result(
        results[0].method,
        np.concatenate([result.estimates for result in results]),
        {kind: np.concatenate([result.errors[kind] for result in results]) for kind in results[0].errors},
        np.concatenate([result.guessed for result in results]),
    )


def _key(row: TransferRow, single: bool) -> tuple[str, Kind, str, Way, str]:
    return row.method, row.kind, "" if single else row.data, row.way, row.real


def _require_apart(parts: Sequence[TransferResults]) -> None:
    """Refuse results of which two hold one image: it would count twice, and intervals would be too narrow."""
    seen: dict[tuple[str, tuple[float, ...]], int] = {}
    for number, part in enumerate(parts):
        for image, truth in zip(part.images, part.truths, strict=True):
            share = tuple(round(float(each / truth.sum()), 6) for each in truth)
            other = seen.setdefault((image, share), number)
            if other != number:
                raise InputError(
                    f"{image} is a test image of {parts[other].place} and of {part.place}; pool results of different "
                    "images, such as of different cameras, or of parts of one data set (evaluate transfer --only)"
                )


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
        *([pages.figure(beside_plot(whole), BESIDE_CAPTION)] if whole.to_better else []),
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
            lines.append(ForestLine(label, shown_ratios(one), series))
            lines += [
                ForestLine(name, shown_ratios(ratios[number]), series, whole=False)
                for name, ratios in zip(names, single, strict=False)
            ]
    return lines


@dataclass(frozen=True)
class PoolTables:
    """What a pool comes to: tables, and what they were made of.

    - `shown`: in the order in which they are shown.
    - `single`: all numbers of each test set by itself, its name and images before them, see `outcome.long_table`.
    - `figures`: what the rows come to over all images.
    - `figures_of_tests`: the same of each test set by itself, by its name.
    - `base`: what the rows are trained on that every other one is held to, as it was asked for; None if none was.
    """

    shown: tuple[Table, ...]
    single: Table
    figures: TransferFigures
    figures_of_tests: Mapping[str, TransferFigures]
    base: str | None


def make_tables(pool: Pool, error: ErrorKind, base: str | None = None) -> PoolTables:
    """Return the tables of a pool, summed up by one kind of error."""
    tests = list(dict.fromkeys(pool.tests))
    name = " + ".join(tests)
    every = figures_of(pool.rows, error, base=base)
    members = {test: np.flatnonzero(np.array(pool.tests) == test) for test in tests}
    single = {
        test: figures_of(
            [replace(row, results=tuple(result.at(places) for result in row.results)) for row in pool.rows],
            error,
            base=base,
        )
        for test, places in members.items()
    }
    apart = _by_test_set(single, {test: len(places) for test, places in members.items()})
    listed = [(test, long_table(figures)) for test, figures in single.items()]
    rows: list[tuple[Cell, ...]] = [(test, len(members[test]), *row) for test, table in listed for row in table.rows]
    return PoolTables(
        (*tables_of(every, name, len(pool.images)), apart),
        Table("All numbers of each test set", ("test", "test_images", *listed[0][1].columns), tuple(rows)),
        every,
        single,
        base,
    )


def save_pool(pool: Pool, tables: PoolTables, places: Sequence[str], error: ErrorKind, folder: Path) -> None:
    """Write the folder of a pool: three CSV files of results and errors, `tables.tex`, `report.html`, `run.json`."""
    about = {
        "format": "crop.pool",
        "version": 1,
        "software": software(),
        "results": list(places),
        "tests": {test: pool.tests.count(test) for test in dict.fromkeys(pool.tests)},
        "error": error,
        "base": tables.base,
        "notes": list(pool.notes),
    }
    with whole_folder(folder, "the results") as partial:
        write_whole(partial / "by_test_set.csv", table_to_csv(tables.single))
        write_whole(partial / "errors.csv", errors_csv(pool.images, pool.truths, labelled_results(pool.rows)))
        page = pool_page(pool, tables.shown, tables.figures, tables.figures_of_tests, places)
        write_shown(partial, tables.figures, tables.shown, page, about)


def _by_test_set(single: dict[str, TransferFigures], images: dict[str, int]) -> Table:
    """Return the ratios to real cross-validation on each test set: median / mean / worst quarter."""
    first = next(iter(single.values()))
    rows = [
        (
            one.row.method,
            one.row.training,
            *(
                " / ".join(f"{figures.to_real[number].ratios[place].value:.2f}" for place in SHOWN)
                for figures in single.values()
            ),
        )
        for number, one in enumerate(first.to_real)
    ]
    return Table(
        "Each test set by itself: errors in parts of the same method's cross-validation",
        ("Method", "Trained on", *(f"{test}, {counted(count, 'image')}" for test, count in images.items())),
        tuple(rows),
        notes=("Median / mean / worst quarter; with their intervals in by_test_set.csv.",),
    )
