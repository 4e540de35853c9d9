"""What a pool comes to: the tables of a transfer over all images, each test set by itself, and the folder of both."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evaluation.experiments.pooling.page import SHOWN, pool_page
from evaluation.experiments.pooling.pool import Pool
from evaluation.experiments.transfer.figures import TransferFigures, figures_of
from evaluation.experiments.transfer.outcome import labelled_results
from evaluation.experiments.transfer.rows import TransferRow
from evaluation.experiments.transfer.tables import (
    base_ratios_table,
    errors_table,
    intervals_table,
    long_table,
    naive_ratios_table,
    real_ratios_table,
)
from evaluation.metrics import ErrorKind
from evaluation.reports.latex import table_to_latex
from evaluation.results.run_files import errors_csv
from evaluation.results.tables import Cell, Table, table_to_csv
from foundation.errors import counted
from foundation.files import whole_folder, write_whole
from foundation.version import software


@dataclass(frozen=True)
class PoolTables:
    """What a pool comes to: tables, and what they were made of.

    - `shown`: in the order in which they are shown.
    - `pooled`: all numbers of the pool for other programs, see `transfer.tables.long_table`.
    - `single`: the same of each test set by itself, its name and images before them.
    - `figures`: what the rows come to over all images.
    - `figures_of_tests`: the same of each test set by itself, by its name.
    - `base`: what the rows are trained on that every other one is held to, as it was asked for; None if none was.
    """

    shown: tuple[Table, ...]
    pooled: Table
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
        test: figures_of([_at(row, places) for row in pool.rows], error, base=base) for test, places in members.items()
    }
    shown = (
        errors_table(every, name, len(pool.images)),
        intervals_table(every, name),
        real_ratios_table(every, name),
        naive_ratios_table(every, name),
        base_ratios_table(every, name),
        _by_test_set(single, {test: len(places) for test, places in members.items()}),
    )
    listed = [(test, long_table(figures)) for test, figures in single.items()]
    rows: list[tuple[Cell, ...]] = [(test, len(members[test]), *row) for test, table in listed for row in table.rows]
    return PoolTables(
        tuple(table for table in shown if table is not None),
        long_table(every),
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
        write_whole(partial / "results.csv", table_to_csv(tables.pooled))
        write_whole(partial / "by_test_set.csv", table_to_csv(tables.single))
        write_whole(partial / "errors.csv", errors_csv(pool.images, pool.truths, labelled_results(pool.rows)))
        write_whole(partial / "tables.tex", "\n".join(table_to_latex(table) for table in tables.shown))
        report = pool_page(pool, tables.shown, tables.figures, tables.figures_of_tests, places)
        write_whole(partial / "report.html", report)
        write_whole(partial / "run.json", json.dumps(about, indent=2, ensure_ascii=False) + "\n")


def _at(row: TransferRow, places: np.ndarray[tuple[int], np.dtype[np.int64]]) -> TransferRow:
    return replace(row, results=tuple(result.at(places) for result in row.results))


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
