"""The tables of a transfer: errors, their intervals, ratios; and the paper's own ratios to stand beside them."""

from __future__ import annotations

import math
from typing import Final

from evaluation.experiments.bootstrap import STATISTICS
from evaluation.experiments.transfer.figures import LEVEL, BoundedFigure, RowRatio, TransferFigures
from evaluation.experiments.transfer.rows import TransferRow
from evaluation.results.tables import Table

HEADS: Final = ("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.")
"""Heads of the statistics, in their order: all six stand in every table, since any one of them misleads alone."""

_PAPER: Final = {
    "Regression trees (simple features)": ((2.54, 1.66, 1.89, 0.45, 6.07, 1.85), (1.57, 0.89, 1.04, 0.20, 4.15, 1.04)),
    "Smart Color Cat": ((2.47, 1.43, 1.76, 0.40, 6.21, 1.73), (2.27, 1.35, 1.61, 0.34, 5.72, 1.58)),
    "Color Beaver (using Gray-world)": ((1.73, 0.74, 0.97, 0.37, 4.75, 1.17), (1.49, 0.77, 0.98, 0.21, 3.94, 0.99)),
}
"""Degrees on Cube+: trained on generated images, and cross-validated on Cube+ (paper, table 2)."""


def errors_table(found: TransferFigures, name: str, images: int) -> Table:
    """Return the statistics of every row; of several seeds their means."""
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
        tuple((*_heads(row.row), *(figure.value for figure in row.statistics)) for row in found.rows),
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
        ),
        notes=("BCa bootstrap over the test images: what other images of the same kind would have given.",),
    )


def real_ratios_table(found: TransferFigures, name: str) -> Table:
    """Return every row in parts of the same method's cross-validation on the test images, real ones or not."""
    made = any(one.base.data for one in found.to_real)
    base = f"cross-validation on {name} (generated)" if made else "real cross-validation"
    good = "as good as images of the test set, which are generated, not real" if made else "as good as real images"
    return Table(
        f"{name}: errors in parts of the same method's {base}",
        ("Method", "Trained on", *HEADS),
        tuple((one.row.method, one.row.training, *_ratio_cells(one)) for one in found.to_real),
        notes=(f"With {LEVEL * 100:.0f} % intervals, paired by test image. 1: {good}.",),
    )


def naive_ratios_table(found: TransferFigures, name: str) -> Table | None:
    """Return the generated rows in parts of the naive ones; None if there was no naive baseline."""
    if not found.to_naive:
        return None
    return Table(
        f"{name}: errors with generated images in parts of those with the same pictures and lights, but no table",
        ("Method", "In parts of", *HEADS),
        tuple((one.row.method, one.base.training, *_ratio_cells(one)) for one in found.to_naive),
        notes=("Paired by test image. Below 1: the table is worth something to this method.",),
    )


def base_ratios_table(found: TransferFigures, name: str) -> Table | None:
    """Return every row in parts of the row that was asked for; None if none was."""
    if not found.to_base:
        return None
    return Table(
        f"{name}: errors in parts of those of the same method, trained on {found.to_base[0].base.training}",
        ("Method", "Trained on", *HEADS),
        tuple((one.row.method, one.row.training, *_ratio_cells(one)) for one in found.to_base),
        notes=("Paired by test image. Sets of other pictures or lights are held together with the choice of them.",),
    )


def paper_ratios_table() -> Table:
    """Return the paper's ratios, of its table 2.

    Examples
    --------
    >>> paper_ratios_table().texts()[2]
    ('Color Beaver (using Gray-world)', '0.74 / 0.77', '1.16', '0.96', '0.99', '1.76', '1.21', '1.18')
    """
    rows = [
        (
            method,
            f"{generated[1]:.2f} / {real[1]:.2f}",
            *(one / other for one, other in zip(generated, real, strict=True)),
        )
        for method, (generated, real) in _PAPER.items()
    ]
    return Table(
        "The paper, Cube+: generated in parts of real cross-validation",
        ("Method", "Medians, degrees", *HEADS),
        tuple(rows),
        notes=("Paper, table 2; Canon EOS 550D, Cube+ images as source pictures and as the test.",),
    )


def long_table(found: TransferFigures) -> Table:
    """Return all numbers for other programs: a row for each method, training and statistic."""
    to_real = {(one.row.method, one.row.training): one for one in found.to_real}
    rows: list[tuple[str | float | None, ...]] = []
    for row in found.rows:
        ratio = to_real.get((row.row.method, row.row.training))
        for place, statistic in enumerate(STATISTICS):
            spread = row.spread[place] if row.spread else None
            parts = _three(ratio.ratios[place]) if ratio else (None, None, None)
            who = (row.row.method, row.row.kind, row.row.data, row.row.images, len(row.row.results))
            rows.append((*who, found.error, statistic, *_three(row.statistics[place]), spread, *parts))
    return Table("All numbers", _LONG, tuple(rows))


_LONG: Final = (
    *("method", "training", "data", "images", "seeds", "error", "statistic"),
    *("degrees", "low", "high", "seed_sd", "ratio_to_real", "ratio_low", "ratio_high"),
)
"""Columns of the file for other programs; empty where a row has no such number."""


def _heads(row: TransferRow) -> tuple[str, str, int | None]:
    return row.method, row.training, row.images or None


def _ratio_cells(ratio: RowRatio) -> tuple[str, ...]:
    return tuple(
        f"{figure.value:.2f} ({figure.low:.2f} – {figure.high:.2f})" if math.isfinite(figure.value) else "–"
        for figure in ratio.ratios
    )


def _three(figure: BoundedFigure) -> tuple[float | None, ...]:
    return tuple(number if math.isfinite(number) else None for number in (figure.value, figure.low, figure.high))
