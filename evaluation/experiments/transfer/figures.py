"""What rows of results come to: statistics with their intervals, and ratios of rows.

With several seeds a statistic is the mean of those of the seeds, not that of their errors together, and a resample is
of images: one that is drawn counts in every seed. So the interval says what other test images would have given; how
much another seed gives is stated apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.bootstrap import STATISTICS
from evaluation.experiments.resampling import ErrorSample, bca, resamples
from evaluation.experiments.transfer.rows import NAIVE, TransferRow
from evaluation.metrics import ErrorKind
from foundation.errors import InputError

COUNT: Final = 2000
"""Resamples: as many as `bootstrap.interval` takes by default."""
LEVEL: Final = 0.95
"""Confidence of an interval: the usual one."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BoundedFigure:
    """A number with the ends of its confidence interval; all NaN where it has none."""

    value: float
    low: float
    high: float


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
    - `to_base`: every other row against those that were asked for, of the same method.
    """

    error: ErrorKind
    rows: tuple[RowFigures, ...]
    to_real: tuple[RowRatio, ...]
    to_naive: tuple[RowRatio, ...]
    to_base: tuple[RowRatio, ...] = ()


@dataclass(frozen=True, eq=False)
class _Replicates:
    """Statistics of one row: of itself (6,), of resamples (B, 6), and without each image (N, 6); means over seeds."""

    estimate: Floats
    resampled: Floats
    without: Floats


def figures_of(
    rows: Sequence[TransferRow], error: ErrorKind, seed: int = 0, base: str | None = None
) -> TransferFigures:
    """Return statistics, intervals and ratios of rows on the same test images.

    `base`: `TransferRow.training` of rows that every other one is held to as well, with x for × and in any case; None
    for no such ratios.
    """
    bases = _named(rows, base)
    samples = [[ErrorSample.of(result.errors[error]) for result in row.results] for row in rows]
    drawn: list[list[Floats]] = [[] for _ in rows]
    for counts in resamples(len(samples[0][0].order), seed, COUNT):
        for batches, several in zip(drawn, samples, strict=True):
            batches.append(np.mean([one.statistics(counts) for one in several], axis=0))
    known = [
        _Replicates(
            np.mean([one.estimate() for one in several], axis=0),
            np.concatenate(batches),
            np.mean([one.without_each() for one in several], axis=0),
        )
        for several, batches in zip(samples, drawn, strict=True)
    ]
    listed = tuple(
        RowFigures(
            row,
            tuple(_figure(one.estimate[place], one.resampled[:, place], one.without[:, place]) for place in _PLACES),
            _spread(several),
        )
        for row, one, several in zip(rows, known, samples, strict=True)
    )

    def ratio(number: int, base: int) -> RowRatio:
        one, other = known[number], known[base]
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = [one.estimate / other.estimate, one.resampled / other.resampled, one.without / other.without]
        ratios = tuple(_figure(parts[0][place], parts[1][:, place], parts[2][:, place]) for place in _PLACES)
        return RowRatio(rows[number], rows[base], ratios)

    to_real = [
        ratio(number, base)
        for number, row in enumerate(rows)
        for base, other in enumerate(rows)
        if other.kind == "cross-validation"
        and other.method == row.method
        and row.kind not in ("cross-validation", "none")
    ]
    to_naive = [
        ratio(number, base)
        for number, row in enumerate(rows)
        for base, other in enumerate(rows)
        if row.kind == "generated" and other.kind in NAIVE and (other.method, other.data) == (row.method, row.data)
    ]
    to_base = [
        ratio(number, other)
        for number, row in enumerate(rows)
        for other in bases
        if number not in bases and rows[other].method == row.method
    ]
    return TransferFigures(error, listed, tuple(to_real), tuple(to_naive), tuple(to_base))


def _named(rows: Sequence[TransferRow], base: str | None) -> list[int]:
    """Return the places of the rows that were trained in the way of that name."""
    if base is None:
        return []
    trained = [(number, row) for number, row in enumerate(rows) if row.kind != "none"]
    found = [number for number, row in trained if _plain(row.training) == _plain(base)]
    if not found:
        known = dict.fromkeys(row.training for _, row in trained)
        raise InputError(f"no row was trained on {base!r}; expected one of: {'; '.join(known)}")
    methods = {rows[number].method for number in found}
    if not any(row.method in methods for number, row in trained if number not in found):
        raise InputError(f"no method was trained on anything but {base!r}; add results to hold to it, or leave it out")
    return found


def _plain(training: str) -> str:
    return " ".join(training.casefold().replace("×", " x ").split())


_PLACES: Final = range(len(STATISTICS))
"""Places of the statistics in arrays."""


def _figure(value: float, replicates: Floats, without: Floats) -> BoundedFigure:
    if not np.isfinite(value):
        return BoundedFigure(np.nan, np.nan, np.nan)
    return BoundedFigure(float(value), *bca(float(value), replicates, [without], LEVEL))


def _spread(several: Sequence[ErrorSample]) -> tuple[float, ...] | None:
    if len(several) < 2:
        return None
    deviations = np.std([one.estimate() for one in several], axis=0, ddof=1)
    return tuple(float(part) for part in deviations)
