"""Outcome of a transfer: statistics with intervals, ratios of rows, tables, and the results folder.

Each statistic is averaged over the seeds. A bootstrap sample has the same images for all seeds, so intervals show only
the effect of other test images. The standard deviation over seeds is reported separately.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from evaluation.datasets.generated import GeneratedScene
from evaluation.experiments.bootstrap import (
    LEVEL,
    STATISTICS,
    TAIL_GROUPS,
    BoundedFigure,
    ErrorSample,
    bounded_figures,
    hide_tails,
    safe_ratio,
)
from evaluation.experiments.folds import folds_to_csv, groups_of
from evaluation.experiments.transfer.plan import TransferPlan, is_generated
from evaluation.experiments.transfer.rows import NAIVE, TransferRow
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, table_to_latex
from evaluation.results.files import errors_csv
from evaluation.results.result import Result
from evaluation.results.tables import BEST_ERRORS, ERROR_COLUMNS, MISSING, Table, finite_or_none, table_to_csv
from evaluation.scene import SceneSet
from foundation import pages
from foundation.files import write_atomic
from foundation.folders import atomic_folder
from foundation.plots import FigureForm, draw_svg, legend_label, series_style, standalone_svg
from foundation.version import software

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RowFigures:
    """Statistics of one row."""

    row: TransferRow
    statistics: tuple[BoundedFigure, ...]  # In the order of `bootstrap.STATISTICS`, degrees
    # Standard deviation of each statistic over the seeds, degrees; None with a single seed
    spread: tuple[float, ...] | None


@dataclass(frozen=True)
class RowRatio:
    """Statistics of a row divided by the statistics of another row with the same method, paired by image."""

    # Numerator and denominator of the ratios
    row: TransferRow
    base: TransferRow
    ratios: tuple[BoundedFigure, ...]  # In the order of `bootstrap.STATISTICS`


@dataclass(frozen=True)
class TransferFigures:
    """All figures of the rows."""

    error: ErrorKind
    rows: tuple[RowFigures, ...]  # Every row with its statistics
    to_real: tuple[RowRatio, ...]  # Rows trained on other data, relative to real cross-validation of the same method
    to_naive: tuple[RowRatio, ...]  # Generated rows relative to the naive rows of the same pictures and illuminants
    # Adapted rows relative to the better of two rows: training on the real images alone, or on the set alone
    to_better: tuple[RowRatio, ...] = ()
    # Adapted generated rows relative to naive rows adapted to the same images
    to_naive_adapted: tuple[RowRatio, ...] = ()


def figures_of(rows: Sequence[TransferRow], error: ErrorKind, groups: Sequence[str] | None = None) -> TransferFigures:
    """Return statistics, intervals and ratios of rows on the same test images.

    `groups`: group of each test image; images of one group are drawn together. None if every image is its own group.
    """
    samples = [[ErrorSample.of(result.errors[error]) for result in row.results] for row in rows]
    values = [np.mean([sample.estimate() for sample in seeds], axis=0) for seeds in samples]
    pairs = _pairs(rows, [float(value[0]) for value in values])

    def statistics(counts: npt.NDArray[np.int64]) -> Floats:
        means = [np.mean([sample.statistics(counts) for sample in seeds], axis=0) for seeds in samples]
        ratios = [safe_ratio(means[row], means[base]) for indices in pairs.values() for row, base in indices]
        return np.concatenate([*means, *ratios], axis=1)

    images = len(samples[0][0].order)
    bounded = hide_tails(bounded_figures(statistics, images, groups), len(set(groups or range(images))))
    figures = _batches(bounded)
    entries = tuple(RowFigures(row, next(figures), _spread(seeds)) for row, seeds in zip(rows, samples, strict=True))
    ratios = {
        name: tuple(RowRatio(rows[row], rows[base], next(figures)) for row, base in indices)
        for name, indices in pairs.items()
    }
    return TransferFigures(error, entries, **ratios)


def _batches(figures: Sequence[BoundedFigure]) -> Iterator[tuple[BoundedFigure, ...]]:
    remaining = iter(figures)
    while batch := tuple(itertools.islice(remaining, len(STATISTICS))):
        yield batch


def _pairs(rows: Sequence[TransferRow], means: Sequence[float]) -> dict[str, list[tuple[int, int]]]:
    """Return the indices of rows and their base rows, for each field of `TransferFigures` with ratios."""
    pairs: dict[str, list[tuple[int, int]]] = {"to_real": [], "to_naive": [], "to_better": [], "to_naive_adapted": []}
    for index, row in enumerate(rows):
        for base, base_row in enumerate(rows):
            if base_row.method != row.method:
                continue
            has_other_training = row.kind not in ("cross-validation", "none") and not row.real_use
            if base_row.kind == "cross-validation" and has_other_training:
                pairs["to_real"].append((index, base))
            if row.kind == "generated" and base_row.kind in NAIVE and base_row.data == row.data:
                if not row.real_use and not base_row.real_use:
                    pairs["to_naive"].append((index, base))
                elif row.real_use == base_row.real_use == "adapted" and row.real == base_row.real:
                    pairs["to_naive_adapted"].append((index, base))
        if row.real_use == "adapted":
            pairs["to_better"].append((index, min(_unadapted_rows(rows, row), key=lambda base: means[base])))
    return pairs


def _unadapted_rows(rows: Sequence[TransferRow], adapted: TransferRow) -> list[int]:
    # Rows of the same method trained on the real images alone, and on the set alone.
    row_keys = {("alone", adapted.real, "real", ""), ("", "", adapted.kind, adapted.data)}
    return [
        index
        for index, row in enumerate(rows)
        if row.method == adapted.method
        and (row.real_use, row.real, row.kind, "" if row.kind == "real" else row.data) in row_keys
    ]


def _spread(seeds: Sequence[ErrorSample]) -> tuple[float, ...] | None:
    if len(seeds) < 2:
        return None
    deviations = np.std([sample.estimate() for sample in seeds], axis=0, ddof=1)
    return tuple(float(deviation) for deviation in deviations)


# Tables have all statistics, because a single statistic can mislead.
STATISTIC_HEADS: Final = ERROR_COLUMNS[1:]


def errors_table(figures: TransferFigures, name: str, images: int) -> Table:
    """Return the statistics of all rows without N real images; with several seeds, their means."""
    unadapted = [row for row in figures.rows if not row.row.real_use]
    seeds = max(len(row.row.results) for row in figures.rows)
    # Student's interval of a mean over seeds. The statistics begin in column 3.
    margins = {
        (number, column): float(stats.t.ppf((1 + LEVEL) / 2, seeds - 1)) * deviation / math.sqrt(seeds)
        for number, row in enumerate(unadapted)
        for column, deviation in enumerate(row.spread or (), start=3)
    }
    notes = [
        f"{row.row.method}, {row.row.training}: no estimate for {guessed.sum()} images; grey was used instead"
        for row in figures.rows
        if (guessed := row.row.results[0].guessed).any()
    ]
    if margins:
        notes.append(f"Means over {seeds} seeds with their {LEVEL * 100:.0f} % intervals (Student's t).")
    return Table(
        f"{name}: {figures.error} angular error of {images} images, degrees",
        ("Method", "Trained on", "Images", *STATISTIC_HEADS),
        tuple((*_row_start(row.row), *(statistic.value for statistic in row.statistics)) for row in unadapted),
        notes=tuple(notes),
        best=BEST_ERRORS,
        margins=margins,
    )


def intervals_table(figures: TransferFigures, name: str) -> Table:
    """Return the confidence intervals over test images of the statistics in `errors_table`."""
    return Table(
        f"{name}: {LEVEL * 100:.0f} % intervals of the {figures.error} angular error, degrees",
        ("Method", "Trained on", "Images", *STATISTIC_HEADS),
        tuple(
            (*_row_start(row.row), *map(_interval_text, row.statistics)) for row in figures.rows if not row.row.real_use
        ),
        notes=(
            "BCa bootstrap over the test images: range expected for other images of the same kind. Worst 5% needs "
            f"{TAIL_GROUPS} images.",
        ),
    )


def real_ratios_table(figures: TransferFigures, name: str) -> Table:
    """Return rows trained on other data, relative to cross-validation of the same method on the test images."""
    is_generated_base = any(ratio.base.data for ratio in figures.to_real)
    base_text = f"cross-validation on {name} (generated)" if is_generated_base else "real cross-validation"
    meaning = f"as good as {'images of the generated test set' if is_generated_base else 'real images'}"
    return _ratios_table(
        f"{name}: errors relative to the same method's {base_text}",
        [(ratio, ratio.row.training) for ratio in figures.to_real],
        f"With {LEVEL * 100:.0f} % intervals, paired by test image. A ratio of 1: {meaning}.",
    )


def naive_ratios_table(figures: TransferFigures, name: str) -> Table | None:
    """Return the generated rows relative to the naive rows; None without a naive baseline."""
    if not figures.to_naive:
        return None
    return _ratios_table(
        f"{name}: errors with generated images relative to errors with the same pictures and illuminants without a LUT",
        [(ratio, ratio.base.training) for ratio in figures.to_naive],
        "Paired by test image. Below 1: the LUT improves this method.",
        "Relative to",
    )


def _ratios_table(
    title: str, ratios: Sequence[tuple[RowRatio, str]], note: str, second_head: str = "Trained on"
) -> Table:
    rows = tuple(
        (pair.row.method, label, pair.row.images or None, pair.base.images or None, *map(_ratio_text, pair.ratios))
        for pair, label in ratios
    )
    return Table(title, ("Method", second_head, "Images", "Base", *STATISTIC_HEADS), rows, notes=(note, _BASE_NOTE))


_BASE_NOTE: Final = "Images: training images of the row. Base: training images of the row in the denominator."


def _ratio_text(figure: BoundedFigure) -> str:
    interval = f" ({_interval_text(figure)})" if math.isfinite(figure.low) else ""
    return f"{figure.value:.2f}{interval}" if math.isfinite(figure.value) else MISSING


def _interval_text(figure: BoundedFigure) -> str:
    return f"{figure.low:.2f} – {figure.high:.2f}" if math.isfinite(figure.low) else MISSING


def adaptation_table(figures: TransferFigures, name: str) -> Table | None:
    """Return the mean errors with N real images; None if no real images were used."""
    means = {(row.row.method, row.row.training): row.statistics[0].value for row in figures.rows}
    ratios = {(ratio.row.method, ratio.row.training): _ratio_text(ratio.ratios[0]) for ratio in figures.to_better}
    real_data = next((ratio.row.data for ratio in figures.rows if ratio.row.kind == "real"), "")
    rows: list[tuple[str | float | None, ...]] = []
    for row in (entry.row for entry in figures.rows if entry.row.real_use == "adapted"):
        real_mean = means.get((row.method, replace(row, kind="real", data=real_data, real_use="alone").training))
        key = row.method, row.training
        set_mean = means[row.method, row.material]
        rows.append((row.method, row.material, row.real, real_mean, set_mean, means[key], ratios[key]))
    if not rows:
        return None
    return Table(
        f"{name}: mean {figures.error} error with N real images, degrees",
        ("Method", "Set", "N", "N alone", "Set alone", "Adapted", "Adapted / better alone"),
        tuple(rows),
        notes=(
            "N: number of real images, from the other folds. N alone: trained on these images. Set alone: trained on "
            "the set. Adapted: trained on the set, then adapted to these images. The last column divides this error by "
            "the smaller of the other two. All statistics are in results.csv.",
        ),
    )


def harm_notes(figures: TransferFigures) -> list[str]:
    """Return a note for each row whose adaptation increased the mean error significantly."""
    return [
        f"{ratio.row.method}, {ratio.row.training}: adaptation changes the mean error by a factor of "
        f"{_ratio_text(ratio.ratios[0])}, expected 1 or less; use only {ratio.base.training} for training"
        for ratio in figures.to_better
        if ratio.ratios[0].low > 1
    ]


def naive_adapted_table(figures: TransferFigures, name: str) -> Table | None:
    """Return adapted generated rows relative to adapted naive rows; None without adapted naive rows."""
    if not figures.to_naive_adapted:
        return None
    rows = tuple(
        (ratio.row.method, ratio.base.material, ratio.row.real, *map(_ratio_text, ratio.ratios))
        for ratio in figures.to_naive_adapted
    )
    return Table(
        f"{name}: errors with generated images relative to naive ones, both adapted to N real images",
        ("Method", "Relative to", "N", *STATISTIC_HEADS),
        rows,
        notes=("Paired by test image. Below 1: with N real images, the LUT still improves this method.",),
    )


def long_table(figures: TransferFigures) -> Table:
    """Return all numbers for other programs: a row for each method, training and statistic."""
    to_real = {(row_ratio.row.method, row_ratio.row.training): row_ratio for row_ratio in figures.to_real}
    rows: list[tuple[str | float | None, ...]] = []
    for row in figures.rows:
        ratio = to_real.get((row.row.method, row.row.training))
        for index, statistic in enumerate(STATISTICS):
            spread = row.spread[index] if row.spread else None
            ratio_values = map(finite_or_none, ratio.ratios[index]) if ratio else (None, None, None)
            row_columns = (row.row.method, row.row.kind, row.row.data, row.row.images, len(row.row.results))
            numbers = *map(finite_or_none, row.statistics[index]), spread
            rows.append(
                (*row_columns, figures.error, statistic, *numbers, *ratio_values, row.row.real_use, row.row.real)
            )
    return Table("All numbers", _LONG_COLUMNS, tuple(rows))


# Columns of results.csv; `way` is the use of real images. Fields are empty for numbers that a row does not have.
_LONG_COLUMNS: Final = (
    *("method", "training", "data", "images", "seeds", "error", "statistic"),
    *("degrees", "low", "high", "seed_sd", "ratio_to_real", "ratio_low", "ratio_high"),
    *("way", "real"),
)


def _row_start(row: TransferRow) -> tuple[str, str, int | None]:
    return row.method, row.training, row.images or None


def adaptation_plot(figures: TransferFigures, form: FigureForm = "page") -> bytes:
    """Return the mean error against the number of real images: one panel for each method, 95 % intervals."""
    panels: dict[str, dict[str, dict[float, BoundedFigure]]] = {}
    for entry in figures.rows:
        row = entry.row
        label = "real alone" if row.real_use == "alone" else f"{row.material}, {row.real_use}"
        if row.real_use:
            real_count = math.inf if row.real == "all" else int(row.real)
            panels.setdefault(row.method, {}).setdefault(label, {})[real_count] = entry.statistics[0]
    for entry in figures.rows:
        for label, points in panels.get(entry.row.method, {}).items():
            if not entry.row.real_use and label.startswith(f"{entry.row.material}, "):
                points[0] = entry.statistics[0]
    return draw_svg(
        _draw_panels,
        panels,
        figures.error,
        inches=(max(4.6, 3.1 * len(panels) + 0.4), 5.2 if len(panels) == 1 else 4.4),
        form=form,
    )


def errors_plot(figures: TransferFigures, form: FigureForm = "page") -> bytes:
    """Return the mean error of each row with its 95 % interval over the test images; one colour for each method."""
    return draw_svg(_draw_rows, figures, inches=(7.2, 0.9 + 0.24 * len(figures.rows)), form=form)


def _draw_rows(figure: Any, figures: TransferFigures) -> None:
    axes = figure.subplots()
    methods = list(dict.fromkeys(row.row.method for row in figures.rows))
    for position, entry in enumerate(figures.rows):
        value, low, high = entry.statistics[0]
        ends = None if math.isnan(low) else [[value - low], [high - value]]
        colour = series_style(methods.index(entry.row.method))["color"]
        axes.errorbar([value], [position], xerr=ends, marker="o", markersize=4, capsize=2, color=colour)
    names = [row.labels(1)[0] for row in (entry.row for entry in figures.rows)]
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set(ylim=(len(names) - 0.5, -0.5), xlim=(0, None), xlabel=f"mean {figures.error} error, degrees")


def _draw_panels(figure: Any, panels: Mapping[str, Mapping[str, Mapping[float, BoundedFigure]]], error: str) -> None:
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    labels = list(dict.fromkeys(label for curves in panels.values() for label in curves))
    for axes, (method, curves) in zip(grid, panels.items(), strict=True):
        counts = sorted({count for points in curves.values() for count in points})
        for label, points in curves.items():
            style = series_style(labels.index(label))
            positions = np.array([counts.index(count) for count in sorted(points)]) + 0.06 * (labels.index(label) - 2)
            values, lows, highs = (np.array(item) for item in zip(*(points[n] for n in sorted(points)), strict=True))
            axes.errorbar(
                positions, values, [values - lows, highs - values], marker="o", markersize=3, label=label, **style
            )
        axes.set_xticks(range(len(counts)), ["all" if math.isinf(count) else f"{count:g}" for count in counts])
        axes.set(title=method, xlabel="real images")
    grid[0].set_ylabel(f"mean {error} error, degrees")
    handles, names = grid[0].get_legend_handles_labels()
    # Names of methods and sets are long, so each column of the legend needs the width of a panel.
    columns = min(2, len(panels))
    labelled = [legend_label(name) for name in names]
    figure.legend(handles, labelled, loc="outside lower center", ncols=columns, fontsize=8)


@dataclass(frozen=True, eq=False)
class TransferOutcome:
    """Results of a transfer."""

    test: SceneSet  # The test set, N images
    plan: TransferPlan  # Training sets and notes
    # Results and their statistics
    rows: tuple[TransferRow, ...]
    figures: TransferFigures
    folds: tuple[npt.NDArray[np.int64], ...]  # For each seed the fold of each test image, (N,) int64
    settings: Mapping[str, Any]  # Settings of the command, as JSON

    def tables(self) -> tuple[Table, ...]:
        """Return the tables in display order."""
        figures, name = self.figures, self.test.name
        tables = (
            errors_table(figures, name, len(self.test.scenes)),
            intervals_table(figures, name),
            real_ratios_table(figures, name),
            naive_ratios_table(figures, name),
            adaptation_table(figures, name),
            naive_adapted_table(figures, name),
        )
        return tuple(table for table in tables if table is not None)


def labelled_results(rows: Sequence[TransferRow]) -> tuple[Result, ...]:
    """Return the results of all rows with unique names: method, training and, with several seeds, the seed."""
    labelled: list[Result] = []
    for row in rows:
        labels = row.labels(len(row.results))
        labelled += [replace(result, method=label) for result, label in zip(row.results, labels, strict=True)]
    return tuple(labelled)


def save_outcome(outcome: TransferOutcome, folder: Path, figures: FigureForm | None = None) -> None:
    """Write the results folder: results.csv, errors.csv, folds_SEED.csv, tables.tex, report.html, run.json.

    If real images were used, also beside_real.svg. With `figures`, also the figures for a paper.
    """
    names = [scene.name for scene in outcome.test.scenes]
    truths = np.stack([scene.truth for scene in outcome.test.scenes])
    with atomic_folder(folder, "the results") as partial:
        groups = groups_of(outcome.test.scenes)
        write_atomic(partial / "errors.csv", errors_csv(names, truths, labelled_results(outcome.rows), groups))
        for seed, folds in enumerate(outcome.folds):
            write_atomic(partial / f"folds_{seed}.csv", folds_to_csv(names, folds))
        write_atomic(partial / "results.csv", table_to_csv(long_table(outcome.figures)))
        write_atomic(partial / "tables.tex", "\n".join(map(table_to_latex, outcome.tables())))
        write_atomic(partial / "report.html", report_page(outcome))
        if outcome.figures.to_better:
            write_atomic(partial / "beside_real.svg", standalone_svg(adaptation_plot(outcome.figures)))
        if figures:
            write_atomic(partial / f"means.{figures}", errors_plot(outcome.figures, figures))
        if figures and outcome.figures.to_better:
            write_atomic(partial / f"real_images.{figures}", adaptation_plot(outcome.figures, figures))
        write_atomic(partial / "run.json", json.dumps(_provenance(outcome), indent=2, ensure_ascii=False) + "\n")


def report_page(outcome: TransferOutcome) -> str:
    """Return the report as HTML text."""
    test = outcome.test
    elements = [
        pages.paragraph(
            f"Learned methods trained on {_training_sets(outcome)} and tested on {len(test.scenes)} images of "
            f"{test.name}{' (generated)' if is_generated(test) else ''}, compared with cross-validation of the same "
            "methods on these images. Column Images is the number of training images."
        ),
        *(table_part(table) for table in outcome.tables()),
    ]
    if outcome.figures.to_better:
        elements.append(
            pages.figure(
                adaptation_plot(outcome.figures), "Mean error against the number of real images; 0: the set alone."
            )
        )
    elements.append(pages.heading("Conditions"))
    elements += [pages.paragraph(note) for note in outcome.plan.notes]
    elements += [pages.paragraph(f"{test.name}, {name}: {text}.") for name, text in test.treatment.items()]
    settings = json.dumps(dict(outcome.settings), ensure_ascii=False)
    elements.append(pages.paragraph(f"Settings: {settings}. {software()}."))
    return pages.page(f"Transfer to {test.name}", elements)


def _training_sets(outcome: TransferOutcome) -> str:
    kinds = {training_set.data: training_set.kind for training_set in reversed(outcome.plan.training)}
    set_texts = [f"{name} ({'not generated' if kinds[name] == 'other' else 'generated'})" for name in sorted(kinds)]
    return ", ".join(set_texts)


def _provenance(outcome: TransferOutcome) -> dict[str, Any]:
    return {
        "format": "crop.transfer",
        "version": 1,
        "software": software(),
        "settings": dict(outcome.settings),
        "test": _set_record(outcome.test),
        "training": [
            {"data": data_set.data, "kind": data_set.kind, "images": len(data_set.scenes)}
            for data_set in outcome.plan.training
        ],
        "training_sets": [_set_record(data_set) for data_set in outcome.plan.sets],
        "notes": list(outcome.plan.notes),
    }


def _set_record(data: SceneSet) -> dict[str, Any]:
    first = data.scenes[0]
    record: dict[str, Any] = {
        "name": data.name,
        "layout": data.layout,
        "place": data.location,
        "images": len(data.scenes),
        "treatment": dict(data.treatment),
    }
    if isinstance(first, GeneratedScene):
        description = first.dataset.description
        record["generated"] = {
            "software": description.software,
            "table": description.table.model_dump(mode="json"),
            "seed": description.seed,
            "options": description.options,
        }
    return record
