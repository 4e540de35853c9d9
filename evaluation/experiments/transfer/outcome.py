"""The result folder of a transfer: tables, every image's errors, folds, and how all was made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import folds_to_csv
from evaluation.experiments.transfer.figures import TransferFigures
from evaluation.experiments.transfer.plan import TransferPlan, is_generated
from evaluation.experiments.transfer.rows import TransferRow
from evaluation.experiments.transfer.tables import (
    errors_table,
    intervals_table,
    long_table,
    naive_ratios_table,
    paper_ratios_table,
    real_ratios_table,
)
from evaluation.reports.latex import table_to_latex
from evaluation.reports.page import table_part
from evaluation.results.result import Result
from evaluation.results.run_files import errors_csv
from evaluation.results.tables import Table, table_to_csv
from evaluation.scene import SceneSet
from foundation import pages
from foundation.files import whole_folder, write_whole
from foundation.plots import FAINT, INK, series_style, svg_of
from foundation.version import software


@dataclass(frozen=True, eq=False)
class TransferOutcome:
    """Everything that a transfer came to.

    - `test`: the test set, N images: of `crossed` those that count.
    - `crossed`: the test set as it was opened, M images, on which methods were cross-validated.
    - `plan`: what was trained on.
    - `rows`, `figures`: the results and what they come to.
    - `folds`: for each seed the fold of each image of `crossed`, (M,) int64.
    - `settings`: what was asked for, as JSON has it.
    """

    test: SceneSet
    crossed: SceneSet
    plan: TransferPlan
    rows: tuple[TransferRow, ...]
    figures: TransferFigures
    folds: tuple[npt.NDArray[np.int64], ...]
    settings: Mapping[str, Any]

    def tables(self) -> tuple[Table, ...]:
        """Return the tables in the order in which they are shown."""
        name = self.test.name
        made = (
            errors_table(self.figures, name, len(self.test.scenes)),
            intervals_table(self.figures, name),
            real_ratios_table(self.figures, name),
            naive_ratios_table(self.figures, name),
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
    """Write the result folder: `results.csv`, `errors.csv`, `folds.csv`, `tables.tex`, `report.html`, `run.json`."""
    names = [scene.name for scene in outcome.test.scenes]
    every = [scene.name for scene in outcome.crossed.scenes]
    truths = np.stack([scene.truth for scene in outcome.test.scenes])
    with whole_folder(folder, "the results") as partial:
        write_whole(partial / "results.csv", table_to_csv(long_table(outcome.figures)))
        write_whole(partial / "errors.csv", errors_csv(names, truths, labelled_results(outcome.rows)))
        for seed, folds in enumerate(outcome.folds):
            write_whole(partial / f"folds_{seed}.csv", folds_to_csv(every, folds))
        write_whole(partial / "tables.tex", "\n".join(table_to_latex(table) for table in outcome.tables()))
        write_whole(partial / "report.html", report_page(outcome))
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
    if outcome.figures.to_real:
        picture = svg_of(_draw_ratios, outcome.figures, inches=(8.5, 1 + 0.28 * len(outcome.figures.to_real)))
        parts.append(
            pages.figure(
                picture,
                f"Median error in parts of the same method's cross-validation on {test.name}, with 95 % intervals; the "
                "vertical line is that cross-validation. Left of it a row's images train better than the test set's "
                "own do.",
            )
        )
    parts += [table_part(paper_ratios_table()), pages.heading("Conditions")]
    parts += [pages.paragraph(note) for note in outcome.plan.notes]
    parts += [pages.paragraph(f"{test.name}, {what}: {sentence}.") for what, sentence in test.treatment.items()]
    parts.append(pages.paragraph(f"Settings: {json.dumps(dict(outcome.settings), ensure_ascii=False)}. {software()}."))
    return pages.page(f"Transfer to {test.name}", parts)


def _training_sets(outcome: TransferOutcome) -> str:
    """Return the names of what was trained on, each said to be generated where it was."""
    named = {some.data: some.kind for some in reversed(outcome.plan.training)}
    listed = [f"{name} ({'not generated' if named[name] == 'other' else 'generated'})" for name in sorted(named)]
    return ", ".join(listed)


def _draw_ratios(figure: Any, found: TransferFigures) -> None:
    axes = figure.subplots()
    methods = list(dict.fromkeys(one.row.method for one in found.to_real))
    for place, one in enumerate(found.to_real):
        ratio = one.ratios[1]
        look = {"color": series_style(methods.index(one.row.method))["color"]}
        axes.plot([ratio.low, ratio.high], [place, place], **look)
        axes.plot([ratio.value], [place], "o", **look)
    axes.axvline(1, color=FAINT, linewidth=1)
    axes.set_yticks(range(len(found.to_real)), [f"{one.row.method}, {one.row.training}" for one in found.to_real])
    axes.tick_params(axis="y", labelcolor=INK)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("ratio of medians")


def _provenance(outcome: TransferOutcome) -> dict[str, Any]:
    return {
        "format": "crop.transfer",
        "version": 1,
        "software": software(),
        "libraries": _libraries(),
        "settings": dict(outcome.settings),
        "test": _described(outcome.test),
        "training": [
            {"data": some.data, "kind": some.kind, "images": len(some.scenes)} for some in outcome.plan.training
        ],
        "training_sets": [_described(some) for some in outcome.plan.sets],
        "notes": list(outcome.plan.notes),
    }


def _described(data: SceneSet) -> dict[str, Any]:
    from evaluation.datasets.generated import GeneratedScene

    first = data.scenes[0]
    described: dict[str, Any] = {
        "name": data.name,
        "layout": data.layout,
        "place": data.place,
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


def _libraries() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found: dict[str, str] = {}
    for name in ("numpy", "scipy", "scikit-learn", "opencv-contrib-python-headless", "torch"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
