"""Compare two tables light by light, in bounded memory: a light of either is held at a time for each thread.

What noise alone predicts is taken from the tables themselves: a cell's standard error from the scatter of its own
samples, a white's from `references.csv`. Where photosites differ in response, samples scatter by that too; it is the
same in both tables where the chart did not move between them, so that noise then predicts a little more than there is.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.comparison.answers import answers_of
from calibration.comparison.geometry import geometry_difference
from calibration.comparison.pairs import LightPairs, light_pairs, require_common_lights, require_one_chart, warnings_of
from calibration.comparison.values import (
    CellDifferences,
    ColourGroup,
    ComparedTable,
    GeometryDifference,
    LightDifferences,
    TableComparison,
)
from calibration.table.file_names import REFERENCES, REPORT_JSON
from calibration.table.lut import Lut
from foundation.colorimetry import angles_deg
from foundation.errors import FormatError
from foundation.processors import ordered_map, processor_count

LEAST_COUNTS = 300.0
"""Counts above which a cell is compared: 25 samples of 300 counts have a mean good to 1 %, and README's figures of a
table's error are of the same cells."""

MOST_THREADS = 4
"""Each holds a light of both tables, 10 MB with 25 samples; reading the disk is what takes the time."""

GROUPS = ("black", "blue", "green", "cyan", "red", "magenta", "yellow", "white")
"""Parts of the colour cube: bits 4, 2 and 1 of the place are whether red, green and blue are in the upper half."""

_LEAST_SHARE = 0.05
"""Share of a white's largest channel from which on another channel's gain counts: fainter ones are noise."""

ReportLights = Callable[[int, int], None]
"""Called with the number of lights compared, and the number of all."""

_Array = npt.NDArray[np.float64]


def compare(
    one: Lut,
    other: Lut,
    progress: ReportLights | None = None,
    places: tuple[Path | None, Path | None] = (None, None),
) -> TableComparison:
    """Return how far two tables of one chart differ, and whether noise alone explains it."""
    require_one_chart(one, other)
    pairs = light_pairs(one.illuminations, other.illuminations)
    require_common_lights(pairs, one, other)
    lights, cells = _differences(one, other, pairs, progress)
    geometry = _geometry(one, other)
    first, second = (
        _described(table, place or table.folder) for table, place in zip((one, other), places, strict=True)
    )
    return TableComparison(
        one=first,
        other=second,
        warnings=warnings_of(one, other, pairs),
        lights=lights,
        cells=cells,
        groups=colour_groups(cells, one.provenance.bits),
        geometry=geometry,
        answers=answers_of(lights, cells),
    )


@dataclass(frozen=True, eq=False)
class _CellsOfALight:
    """Differences of a light's cells, (C, 3) float64 each; NaN where a cell does not count."""

    share: _Array
    score: _Array
    variance: _Array


def _differences(
    one: Lut, other: Lut, pairs: LightPairs, progress: ReportLights | None
) -> tuple[LightDifferences, CellDifferences]:
    unfit = [{cell.colour for cell in table.provenance.unfit} for table in (one, other)]
    usable = np.ones(one.samples.shape[1], dtype=np.bool_)
    usable[sorted(unfit[0] | unfit[1])] = False
    # A difference over its estimated error has Student's distribution, whose variance is n / (n − 2); n by Welch and
    # Satterthwaite, for variances of means in inverse proportion to the samples.
    sizes = np.array([one.samples.shape[2], other.samples.shape[2]], dtype=np.float64)
    freedoms = float((1 / sizes).sum() ** 2 / (1 / sizes**2 / (sizes - 1)).sum())
    widening = float(np.sqrt(freedoms / (freedoms - 2)))

    def work(pair: tuple[int, int]) -> _CellsOfALight:
        return _compare_light(one, other, *pair, usable, widening)

    sums = _Sums.empty(len(usable))
    rms, noise, score = (np.full(len(pairs.one), np.nan) for _ in range(3))
    todo = list(zip(pairs.one, pairs.other, strict=True))
    for number, found in enumerate(ordered_map(work, todo, min(processor_count(), MOST_THREADS))):
        there = np.isfinite(found.share)
        if there.any():
            rms[number] = np.sqrt((found.share[there] ** 2).mean())
            noise[number] = np.sqrt(found.variance[there].mean())
            score[number] = np.sqrt((found.score[there] ** 2).mean())
        sums.add(found, there, pairs.one[number])
        if progress is not None:
            progress(number + 1, len(todo))
    cells = sums.result(tuple(sorted(unfit[0] - unfit[1])), tuple(sorted(unfit[1] - unfit[0])))
    return _light_differences(one, other, pairs, rms, noise, score), cells


def _compare_light(
    one: Lut, other: Lut, light: int, counterpart: int, usable: npt.NDArray[np.bool_], widening: float
) -> _CellsOfALight:
    """Return what differs of the cells of one light, each mean over its own table's white."""
    from calibration.comparison.kernels import moments

    relative: list[_Array] = []
    variance: list[_Array] = []
    bright = np.broadcast_to(usable[:, None], (len(usable), 3)).copy()
    for table, number in ((one, light), (other, counterpart)):
        table.require_unchanged(number)
        values = np.asarray(table.samples[number])
        means, scatter = np.empty((len(values), 3)), np.empty((len(values), 3))
        moments(values, means, scatter)
        bright &= means > LEAST_COUNTS
        with np.errstate(divide="ignore", invalid="ignore"):
            # Integers have at least the scatter of rounding.
            variance.append(np.maximum(scatter, 1 / 12) / values.shape[1] / means**2)
        relative.append(means / table.white[number])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(bright, relative[1] / relative[0] - 1, np.nan)
        both = np.where(bright, variance[0] + variance[1], np.nan)
    return _CellsOfALight(share, share / np.sqrt(both) / widening, both)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over the lights compared so far, (C, 3) each; filled in place, since they are the size of a light."""

    count: npt.NDArray[np.int64]
    share: _Array
    squares: _Array
    variance: _Array
    scores: _Array
    worst: _Array
    worst_share: _Array
    worst_light: npt.NDArray[np.int64]

    @staticmethod
    def empty(cells: int) -> _Sums:
        shape = (cells, 3)
        return _Sums(
            count=np.zeros(shape, dtype=np.int64),
            share=np.zeros(shape),
            squares=np.zeros(shape),
            variance=np.zeros(shape),
            scores=np.zeros(shape),
            worst=np.zeros(shape),
            worst_share=np.zeros(shape),
            worst_light=np.full(shape, -1, dtype=np.int64),
        )

    def add(self, found: _CellsOfALight, there: npt.NDArray[np.bool_], light: int) -> None:
        share, score, variance = (np.where(there, each, 0.0) for each in (found.share, found.score, found.variance))
        self.count[...] += there
        self.share[...] += share
        self.squares[...] += share**2
        self.variance[...] += variance
        self.scores[...] += score**2
        further = np.abs(score) > np.abs(self.worst)
        self.worst[further], self.worst_share[further] = score[further], share[further]
        self.worst_light[further] = light

    def result(self, unfit_one: tuple[int, ...], unfit_other: tuple[int, ...]) -> CellDifferences:
        known, total = self.count > 0, max(int(self.count.sum()), 1)
        count = np.where(known, self.count, 1)
        mean = self.share / count
        spread = np.sqrt(np.maximum(self.squares / count - mean**2, 0.0))
        return CellDifferences(
            lights=self.count,
            mean=np.where(known, mean, np.nan),
            spread=np.where(known, spread, np.nan),
            noise=np.where(known, np.sqrt(self.variance) / count, np.nan),
            worst=np.where(known, self.worst, np.nan),
            worst_light=self.worst_light,
            worst_share=np.where(known, self.worst_share, np.nan),
            unfit_one=unfit_one,
            unfit_other=unfit_other,
            score=float(np.sqrt(self.scores.sum() / total)) if known.any() else float("nan"),
            rms=float(np.sqrt(self.squares.sum() / total)) if known.any() else float("nan"),
            predicted_rms=float(np.sqrt(self.variance.sum() / total)) if known.any() else float("nan"),
            offset=self.share.sum(axis=0) / np.maximum(self.count.sum(axis=0), 1),
        )


def _light_differences(
    one: Lut, other: Lut, pairs: LightPairs, rms: _Array, noise: _Array, score: _Array
) -> LightDifferences:
    numbers = [np.array(each, dtype=np.int64) for each in (pairs.one, pairs.other)]
    whites = [table.white[at] for table, at in zip((one, other), numbers, strict=True)]
    errors = [white_errors(table)[at] for table, at in zip((one, other), numbers, strict=True)]
    gains = [recorded_drift(table)[at] for table, at in zip((one, other), numbers, strict=True)]
    length = [np.linalg.norm(white, axis=1) for white in whites]
    # Errors of a direction are those across it, over the length; both whites have nearly one direction.
    middle = whites[0] / length[0][:, None] + whites[1] / length[1][:, None]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    covariance = sum(
        np.einsum("li,ij->lij", (error / size[:, None]) ** 2, np.eye(3))
        for error, size in zip(errors, length, strict=True)
    )
    assert isinstance(covariance, np.ndarray)
    across = _across(middle)
    difference = np.einsum("lki,li->lk", across, whites[1] / length[1][:, None] - whites[0] / length[0][:, None])
    plane = np.einsum("lki,lij,lmj->lkm", across, covariance, across)
    (xx, xy), (_, yy) = plane.transpose(1, 2, 0)
    x, y = difference.T
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    ratio = length[1] / length[0]
    steady = [np.linalg.norm(white / gain, axis=1) for white, gain in zip(whites, gains, strict=True)]
    left = steady[1] / steady[0]
    along = np.sqrt(
        sum(
            (
                ((error / size[:, None]) ** 2 * middle**2).sum(axis=1)
                for error, size in zip(errors, length, strict=True)
            ),
            start=np.zeros(len(ratio)),
        )
    )
    return LightDifferences(
        one=numbers[0],
        other=numbers[1],
        angle_deg=angles_deg(whites[0], whites[1]),
        angle_noise_deg=np.degrees(np.sqrt(np.trace(plane, axis1=1, axis2=2))),
        angle_score=np.sqrt(squared / 2),
        brightness=ratio - 1,
        brightness_left=left / np.median(left) - 1,
        brightness_noise=along,
        gains=_median_gains(whites[0], whites[1]),
        cell_rms=rms,
        cell_noise=noise,
        cell_score=score,
    )


def _across(directions: _Array) -> _Array:
    """Return (L, 2, 3) float64: two unit vectors across each of the unit vectors (L, 3), and across each other."""
    least = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first: _Array = np.asarray(np.cross(directions, least), dtype=np.float64)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second: _Array = np.asarray(np.cross(directions, first), dtype=np.float64)
    return np.stack([first, second], axis=1)


def _median_gains(one: _Array, other: _Array) -> _Array:
    """Return (3,) float64, median over lights of B's white over A's, where a channel has enough of both."""
    enough = np.minimum(one / one.max(axis=1, keepdims=True), other / other.max(axis=1, keepdims=True)) >= _LEAST_SHARE
    ratio = other / one
    return np.array(
        [float(np.median(ratio[enough[:, c], c])) if enough[:, c].any() else float("nan") for c in range(3)]
    )


def white_errors(lut: Lut) -> _Array:
    """Return the standard errors (L, 3) float64 of a table's whites by `references.csv`; NaN where it does not say."""
    errors = np.full(lut.white.shape, np.nan)
    path = lut.folder / REFERENCES
    if not path.is_file():
        return errors
    try:
        for row in csv.DictReader(io.StringIO(path.read_text("utf-8"))):
            if row["name"] == "white":
                errors[int(row["light"])] = [float(row[name]) for name in ("r_error", "g_error", "b_error")]
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise FormatError(f"{path} is damaged: {error}; build the table again") from error
    return errors


def recorded_drift(lut: Lut) -> _Array:
    """Return the lamp's drift (L, 3) float64 that a table records and still contains; ones where there is none."""
    for done in lut.provenance.corrections:
        if done.get("name") == "drift" and not done.get("applied"):
            gains = np.array(done["per_light"], dtype=np.float64)
            if gains.shape == lut.white.shape and (gains > 0).all():
                return gains
    return np.ones(lut.white.shape)


def colour_groups(cells: CellDifferences, bits: int) -> tuple[ColourGroup, ...]:
    """Return the differences by parts of the colour cube, eight of them, in the order of `GROUPS`."""
    colours = np.arange(len(cells.mean))
    upper = [(colours >> (shift * bits + bits - 1)) & 1 for shift in (2, 1, 0)]
    group = 4 * upper[0] + 2 * upper[1] + upper[2]
    known = np.isfinite(cells.mean).any(axis=1)
    filled = np.nan_to_num(cells.mean)
    largest = np.take_along_axis(filled, np.abs(filled).argmax(axis=1)[:, None], axis=1)[:, 0]
    found: list[ColourGroup] = []
    for number, name in enumerate(GROUPS):
        here = np.flatnonzero(known & (group == number))
        if not len(here):
            found.append(ColourGroup(name, 0, float("nan"), float("nan"), float("nan"), -1))
            continue
        worst = int(here[np.abs(largest[here]).argmax()])
        found.append(
            ColourGroup(
                name,
                len(here),
                float(np.nanmean(cells.mean[here])),
                float(np.nanstd(cells.mean[here])),
                float(largest[worst]),
                worst,
            )
        )
    return tuple(found)


def _described(lut: Lut, place: Path) -> ComparedTable:
    corrected = any(done.get("name") == "drift" and done.get("applied") for done in lut.provenance.corrections)
    known = lut.provenance
    return ComparedTable(
        place, known.camera, known.software, len(lut.illuminations), lut.samples.shape[2], bool(corrected)
    )


def _geometry(one: Lut, other: Lut) -> GeometryDifference | None:
    places: list[tuple[_Array, _Array]] = []
    for lut in (one, other):
        path = lut.folder / REPORT_JSON
        try:
            stored: Any = json.loads(path.read_bytes())["chart_places"]
            places.append((np.array(stored["mm"], dtype=np.float64), np.array(stored["px"], dtype=np.float64)))
        except (OSError, KeyError, TypeError, ValueError):
            # Tables of earlier software, and computed ones, do not say where the chart lay.
            return None
    if places[0][0].shape != places[1][0].shape or not np.allclose(places[0][0], places[1][0]):
        return None
    return geometry_difference(places[0][1], places[1][1])
