"""What a transfer comes to: statistics with their intervals, ratios of rows, their tables, and the results folder.

With several seeds a statistic is the mean of the statistics of the seeds, not that of their errors together, and a
resample is of images: one that is drawn counts in every seed. So the interval states what other test images would have
given; the spread over seeds is stated apart.
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

from evaluation.datasets.generated import GeneratedScene
from evaluation.experiments.bootstrap import (
    LEVEL,
    STATISTICS,
    BoundedFigure,
    ErrorSample,
    bounded_figures,
    safe_ratio,
)
from evaluation.experiments.folds import folds_to_csv, groups_of
from evaluation.experiments.transfer.plan import TransferPlan, is_generated
from evaluation.experiments.transfer.rows import NAIVE, TransferRow
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, table_to_latex
from evaluation.results.files import errors_csv
from evaluation.results.result import Result
from evaluation.results.tables import PAPER_COLUMNS, Table, finite_or_none, table_to_csv
from evaluation.scene import SceneSet
from foundation import pages
from foundation.files import write_whole
from foundation.folders import whole_folder
from foundation.plots import legend_label, series_style, standalone, svg_of
from foundation.version import software

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RowFigures:
    """What one row comes to.

    - `statistics`: in the order of `bootstrap.STATISTICS`, degrees.
    - `spread`: standard deviation of each statistic over the seeds, degrees; None with a single one.
    """

    row: TransferRow
    statistics: tuple[BoundedFigure, ...]
    spread: tuple[float, ...] | None


@dataclass(frozen=True)
class RowRatio:
    """What a row comes to in parts of another with the same method, image by image on the same resamples.

    - `row`, `base`: the row, and what it is held to.
    - `ratios`: in the order of `bootstrap.STATISTICS`.
    """

    row: TransferRow
    base: TransferRow
    ratios: tuple[BoundedFigure, ...]


@dataclass(frozen=True)
class TransferFigures:
    """All that is told of the rows.

    - `error`: the kind of error.
    - `rows`: every row with its statistics.
    - `to_real`: every row that was trained elsewhere against the same method's real cross-validation.
    - `to_naive`: every generated row against the naive rows of the same pictures and lights.
    - `to_better`: every row adapted to N real images against the better in the mean of real images alone and of its set
      alone.
    - `to_naive_adapted`: every adapted generated row against its naive ones, adapted to the same images.
    """

    error: ErrorKind
    rows: tuple[RowFigures, ...]
    to_real: tuple[RowRatio, ...]
    to_naive: tuple[RowRatio, ...]
    to_better: tuple[RowRatio, ...] = ()
    to_naive_adapted: tuple[RowRatio, ...] = ()


def figures_of(rows: Sequence[TransferRow], error: ErrorKind, groups: Sequence[str] | None = None) -> TransferFigures:
    """Return statistics, intervals and ratios of rows on the same test images.

    `groups`: what each test image shares with others, so that they are drawn together; None if every image is its own
    group.
    """
    samples = [[ErrorSample.of(result.errors[error]) for result in row.results] for row in rows]
    values = [np.mean([one.estimate() for one in several], axis=0) for several in samples]
    pairs = _pairs(rows, [float(value[0]) for value in values])

    def numbers(counts: npt.NDArray[np.int64]) -> Floats:
        known = [np.mean([one.statistics(counts) for one in several], axis=0) for several in samples]
        ratios = [safe_ratio(known[row], known[base]) for several in pairs.values() for row, base in several]
        return np.concatenate([*known, *ratios], axis=1)

    made = _batches(bounded_figures(numbers, len(samples[0][0].order), groups))
    listed = tuple(RowFigures(row, next(made), _spread(several)) for row, several in zip(rows, samples, strict=True))
    ratios = {
        name: tuple(RowRatio(rows[row], rows[base], next(made)) for row, base in several)
        for name, several in pairs.items()
    }
    return TransferFigures(error, listed, **ratios)


def _batches(figures: Sequence[BoundedFigure]) -> Iterator[tuple[BoundedFigure, ...]]:
    several = iter(figures)
    while batch := tuple(itertools.islice(several, len(STATISTICS))):
        yield batch


def _pairs(rows: Sequence[TransferRow], means: Sequence[float]) -> dict[str, list[tuple[int, int]]]:
    """Return the places of each row and of what it is held to, by the name of the ratios in `TransferFigures`."""
    pairs: dict[str, list[tuple[int, int]]] = {
        "to_real": [],
        "to_naive": [],
        "to_better": [],
        "to_naive_adapted": [],
    }
    for place, row in enumerate(rows):
        for base, other in enumerate(rows):
            if other.method != row.method:
                continue
            if other.kind == "cross-validation" and row.kind not in ("cross-validation", "none") and not row.way:
                pairs["to_real"].append((place, base))
            if row.kind == "generated" and other.kind in NAIVE and other.data == row.data:
                if not row.way and not other.way:
                    pairs["to_naive"].append((place, base))
                elif row.way == other.way == "adapted" and row.real == other.real:
                    pairs["to_naive_adapted"].append((place, base))
        if row.way == "adapted":
            pairs["to_better"].append((place, min(_alone(rows, row), key=lambda base: means[base])))
    return pairs


def _alone(rows: Sequence[TransferRow], adapted: TransferRow) -> list[int]:
    """Return the places of the rows of what an adapted row was made of: real images alone, and its set alone."""
    wanted = {("alone", adapted.real, "real", ""), ("", "", adapted.kind, adapted.data)}
    return [
        number
        for number, row in enumerate(rows)
        if row.method == adapted.method
        and (row.way, row.real, row.kind, "" if row.kind == "real" else row.data) in wanted
    ]


def _spread(several: Sequence[ErrorSample]) -> tuple[float, ...] | None:
    if len(several) < 2:
        return None
    deviations = np.std([one.estimate() for one in several], axis=0, ddof=1)
    return tuple(float(part) for part in deviations)


# All six statistics stand in every table, since any one of them misleads alone.
HEADS: Final = PAPER_COLUMNS[1:]


def errors_table(found: TransferFigures, name: str, images: int) -> Table:
    """Return the statistics of every row; of several seeds their means."""
    without = [row for row in found.rows if not row.row.way]
    notes = [
        f"{row.row.method}, {row.row.training}: no light in {guessed.sum()} images; grey stands in for it"
        for row in found.rows
        if (guessed := row.row.results[0].guessed).any()
    ]
    if any(row.spread for row in found.rows):
        median = [row.spread[1] for row in found.rows if row.spread]
        notes.append(
            f"Means over seeds; the standard deviation of a median over seeds is up to {max(median):.2f} degrees."
        )
    return Table(
        f"{name}: {found.error} angular error of {images} images, degrees",
        ("Method", "Trained on", "Images", *HEADS),
        tuple((*_heads(row.row), *(figure.value for figure in row.statistics)) for row in without),
        notes=tuple(notes),
    )


def intervals_table(found: TransferFigures, name: str) -> Table:
    """Return the confidence intervals of every row's statistics."""
    return Table(
        f"{name}: {LEVEL * 100:.0f} % intervals of these errors, degrees",
        ("Method", "Trained on", "Images", *HEADS),
        tuple(
            (*_heads(row.row), *(f"{figure.low:.2f} – {figure.high:.2f}" for figure in row.statistics))
            for row in found.rows
            if not row.row.way
        ),
        notes=("BCa bootstrap over the test images: what other images of the same kind would have given.",),
    )


def real_ratios_table(found: TransferFigures, name: str) -> Table:
    """Return every row in parts of the same method's cross-validation on the test images, real ones or not."""
    made = any(one.base.data for one in found.to_real)
    base = f"cross-validation on {name} (generated)" if made else "real cross-validation"
    good = "as good as images of the test set, which are generated, not real" if made else "as good as real images"
    return _ratios_table(
        f"{name}: errors in parts of the same method's {base}",
        [(one, one.row.training) for one in found.to_real],
        f"With {LEVEL * 100:.0f} % intervals, paired by test image. 1: {good}.",
    )


def naive_ratios_table(found: TransferFigures, name: str) -> Table | None:
    """Return the generated rows in parts of the naive ones; None if there was no naive baseline."""
    if not found.to_naive:
        return None
    return _ratios_table(
        f"{name}: errors with generated images in parts of those with the same pictures and lights, but no table",
        [(one, one.base.training) for one in found.to_naive],
        "Paired by test image. Below 1: the table is worth something to this method.",
        "In parts of",
    )


def _ratios_table(
    title: str, ratios: Sequence[tuple[RowRatio, str]], note: str, second_head: str = "Trained on"
) -> Table:
    rows = tuple(
        (one.row.method, said, one.row.images or None, one.base.images or None, *map(_written, one.ratios))
        for one, said in ratios
    )
    return Table(title, ("Method", second_head, "Images", "Base", *HEADS), rows, notes=(note, _BASE))


_BASE: Final = "Images and Base: training images of the row, and of what it is held to."


def _written(figure: BoundedFigure) -> str:
    return f"{figure.value:.2f} ({figure.low:.2f} – {figure.high:.2f})" if math.isfinite(figure.value) else "–"


def beside_table(found: TransferFigures, name: str) -> Table | None:
    """Return the mean errors beside N real images; None if there were none."""
    known = {(row.row.method, row.row.training): row.statistics[0].value for row in found.rows}
    better = {(one.row.method, one.row.training): _written(one.ratios[0]) for one in found.to_better}
    of_real = next((one.row.data for one in found.rows if one.row.kind == "real"), "")
    rows: list[tuple[str | float | None, ...]] = []
    for row in (each.row for each in found.rows if each.row.way == "adapted"):
        alone = known.get((row.method, replace(row, kind="real", data=of_real, way="alone").training))
        own = row.method, row.training
        rows.append((*own[:1], row.material, row.real, alone, known[row.method, row.material], known[own], better[own]))
    if not rows:
        return None
    return Table(
        f"{name}: mean {found.error} error beside N real images, degrees",
        ("Method", "Set", "N", "N alone", "Set alone", "Adapted", "Adapted in parts of the better alone"),
        tuple(rows),
        notes=(
            "The N are drawn from the other folds. Adapted: trained on the set, then adapted to N. All statistics are "
            "in results.csv.",
        ),
    )


def harm_notes(found: TransferFigures) -> list[str]:
    """Return what the reader is told of rows whose adapting made the mean error larger, beyond chance."""
    return [
        f"{one.row.method}, {one.row.training}: adapting does harm, {_written(one.ratios[0])} of the mean error of "
        f"{one.base.training} alone; use that"
        for one in found.to_better
        if one.ratios[0].low > 1
    ]


def naive_adapted_table(found: TransferFigures, name: str) -> Table | None:
    """Return adapted generated rows in parts of adapted naive ones; None if there are none."""
    if not found.to_naive_adapted:
        return None
    rows = tuple(
        (one.row.method, one.base.material, one.row.real, *map(_written, one.ratios)) for one in found.to_naive_adapted
    )
    return Table(
        f"{name}: errors with generated images in parts of those with naive ones, both adapted to N real images",
        ("Method", "In parts of", "N", *HEADS),
        rows,
        notes=("Paired by test image. Below 1: beside N real images the table is still worth something.",),
    )


def long_table(found: TransferFigures) -> Table:
    """Return all numbers for other programs: a row for each method, training and statistic."""
    to_real = {(one.row.method, one.row.training): one for one in found.to_real}
    rows: list[tuple[str | float | None, ...]] = []
    for row in found.rows:
        ratio = to_real.get((row.row.method, row.row.training))
        for place, statistic in enumerate(STATISTICS):
            spread = row.spread[place] if row.spread else None
            parts = map(finite_or_none, ratio.ratios[place]) if ratio else (None, None, None)
            who = (row.row.method, row.row.kind, row.row.data, row.row.images, len(row.row.results))
            beside = row.row.way, row.row.real
            rows.append(
                (*who, found.error, statistic, *map(finite_or_none, row.statistics[place]), spread, *parts, *beside)
            )
    return Table("All numbers", _LONG, tuple(rows))


# Columns of the file for other programs; empty where a row has no such number.
_LONG: Final = (
    *("method", "training", "data", "images", "seeds", "error", "statistic"),
    *("degrees", "low", "high", "seed_sd", "ratio_to_real", "ratio_low", "ratio_high"),
    *("way", "real"),
)


def _heads(row: TransferRow) -> tuple[str, str, int | None]:
    return row.method, row.training, row.images or None


def beside_plot(found: TransferFigures) -> bytes:
    """Return the mean error against N real images as SVG: a panel for each method, with 95 % intervals."""
    panels: dict[str, dict[str, dict[float, BoundedFigure]]] = {}
    for each in found.rows:
        row = each.row
        label = "real alone" if row.way == "alone" else f"{row.material}, {row.way}"
        if row.way:
            place = math.inf if row.real == "all" else int(row.real)
            panels.setdefault(row.method, {}).setdefault(label, {})[place] = each.statistics[0]
    for each in found.rows:
        for label, points in panels.get(each.row.method, {}).items():
            if not each.row.way and label.startswith(f"{each.row.material}, "):
                points[0] = each.statistics[0]
    return svg_of(
        _draw_beside, panels, found.error, inches=(max(4.6, 3.1 * len(panels) + 0.4), 5.2 if len(panels) == 1 else 4.4)
    )


def _draw_beside(figure: Any, panels: Mapping[str, Mapping[str, Mapping[float, BoundedFigure]]], error: str) -> None:
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    labels = list(dict.fromkeys(label for curves in panels.values() for label in curves))
    for axes, (method, curves) in zip(grid, panels.items(), strict=True):
        counts = sorted({count for points in curves.values() for count in points})
        for label, points in curves.items():
            style = series_style(labels.index(label))
            places = np.array([counts.index(count) for count in sorted(points)]) + 0.06 * (labels.index(label) - 2)
            values, lows, highs = (np.array(part) for part in zip(*(points[n] for n in sorted(points)), strict=True))
            axes.errorbar(
                places, values, [values - lows, highs - values], marker="o", markersize=3, label=label, **style
            )
        axes.set_xticks(range(len(counts)), ["all" if math.isinf(count) else f"{count:g}" for count in counts])
        axes.set(title=method, xlabel="real images")
    grid[0].set_ylabel(f"mean {error} error, degrees")
    handles, named = grid[0].get_legend_handles_labels()
    # Names are long: beside one another they need the width of two panels.
    columns = min(2, len(panels))
    labelled = [legend_label(name) for name in named]
    figure.legend(handles, labelled, loc="outside lower center", ncols=columns, fontsize=8)


@dataclass(frozen=True, eq=False)
class TransferOutcome:
    """Everything that a transfer came to.

    - `test`: the test set, N images.
    - `plan`: what was trained on.
    - `rows`, `figures`: the results and what they come to.
    - `folds`: for each seed the fold of each test image, (N,) int64.
    - `settings`: what was asked for, as JSON has it.
    """

    test: SceneSet
    plan: TransferPlan
    rows: tuple[TransferRow, ...]
    figures: TransferFigures
    folds: tuple[npt.NDArray[np.int64], ...]
    settings: Mapping[str, Any]

    def tables(self) -> tuple[Table, ...]:
        """Return the tables in the order in which they are shown."""
        found, name = self.figures, self.test.name
        made = (
            errors_table(found, name, len(self.test.scenes)),
            intervals_table(found, name),
            real_ratios_table(found, name),
            naive_ratios_table(found, name),
            beside_table(found, name),
            naive_adapted_table(found, name),
        )
        return tuple(table for table in made if table is not None)


def labelled_results(rows: Sequence[TransferRow]) -> tuple[Result, ...]:
    """Return the results of all rows, each under a name of its own: method, training and, of several, the seed."""
    named: list[Result] = []
    for row in rows:
        labels = row.labels(len(row.results))
        named += [replace(result, method=label) for result, label in zip(row.results, labels, strict=True)]
    return tuple(named)


def save_outcome(outcome: TransferOutcome, folder: Path) -> None:
    """Write the result folder: `results.csv`, `errors.csv`, `folds.csv`, `tables.tex`, `report.html`, `run.json`.

    Beside N real images `beside_real.svg`, too.
    """
    names = [scene.name for scene in outcome.test.scenes]
    truths = np.stack([scene.truth for scene in outcome.test.scenes])
    with whole_folder(folder, "the results") as partial:
        groups = groups_of(outcome.test.scenes)
        write_whole(partial / "errors.csv", errors_csv(names, truths, labelled_results(outcome.rows), groups))
        for seed, folds in enumerate(outcome.folds):
            write_whole(partial / f"folds_{seed}.csv", folds_to_csv(names, folds))
        write_whole(partial / "results.csv", table_to_csv(long_table(outcome.figures)))
        write_whole(partial / "tables.tex", "\n".join(map(table_to_latex, outcome.tables())))
        write_whole(partial / "report.html", report_page(outcome))
        if outcome.figures.to_better:
            write_whole(partial / "beside_real.svg", standalone(beside_plot(outcome.figures)))
        write_whole(partial / "run.json", json.dumps(_provenance(outcome), indent=2, ensure_ascii=False) + "\n")


def report_page(outcome: TransferOutcome) -> str:
    """Return the report as the text of one HTML file."""
    test = outcome.test
    parts = [
        pages.paragraph(
            f"Learned methods trained on {_training_sets(outcome)} and tested on {len(test.scenes)} images of "
            f"{test.name}{' (generated)' if is_generated(test) else ''}, beside the same methods cross-validated on "
            "these images. Each row was trained on as many images as its column says."
        ),
        *(table_part(table) for table in outcome.tables()),
    ]
    if outcome.figures.to_better:
        parts.append(
            pages.figure(
                beside_plot(outcome.figures), "Mean error against the number of real images; 0: the set alone."
            )
        )
    parts.append(pages.heading("Conditions"))
    parts += [pages.paragraph(note) for note in outcome.plan.notes]
    parts += [pages.paragraph(f"{test.name}, {what}: {sentence}.") for what, sentence in test.treatment.items()]
    parts.append(pages.paragraph(f"Settings: {json.dumps(dict(outcome.settings), ensure_ascii=False)}. {software()}."))
    return pages.page(f"Transfer to {test.name}", parts)


def _training_sets(outcome: TransferOutcome) -> str:
    """Return the names of what was trained on, each said to be generated where it was."""
    named = {some.data: some.kind for some in reversed(outcome.plan.training)}
    listed = [f"{name} ({'not generated' if named[name] == 'other' else 'generated'})" for name in sorted(named)]
    return ", ".join(listed)


def _provenance(outcome: TransferOutcome) -> dict[str, Any]:
    return {
        "format": "crop.transfer",
        "version": 1,
        "software": software(),
        "settings": dict(outcome.settings),
        "test": _described(outcome.test),
        "training": [
            {"data": some.data, "kind": some.kind, "images": len(some.scenes)} for some in outcome.plan.training
        ],
        "training_sets": [_described(some) for some in outcome.plan.sets],
        "notes": list(outcome.plan.notes),
    }


def _described(data: SceneSet) -> dict[str, Any]:
    first = data.scenes[0]
    described: dict[str, Any] = {
        "name": data.name,
        "layout": data.layout,
        "place": data.location,
        "images": len(data.scenes),
        "treatment": dict(data.treatment),
    }
    if isinstance(first, GeneratedScene):
        about = first.dataset.description
        described["generated"] = {
            "software": about.software,
            "table": about.table.model_dump(mode="json"),
            "seed": about.seed,
            "options": about.options,
        }
    return described
