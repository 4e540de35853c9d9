"""Two tables compared light by light, in bounded memory; whether they are the same within noise; B over A, always.

- A light of either table is held at a time for each thread.
- What noise alone predicts is taken from the tables themselves: a cell's standard error from the scatter of its own
  samples, a white's from `references.csv`. Where photosites differ in response, samples scatter by that too, and noise
  then predicts a little more than there is.
- With 700 lights and 32 768 cells any difference is significant, however small. So what is asked is whether what is
  beyond noise matters: limits are those of noise at a chance of one in a hundred for the whole table, widened by what
  standard errors may be off themselves, and a floor of what no use of a table would notice.

L common lights, C colours.
"""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.kernels import moments
from calibration.pipeline.build import build
from calibration.pipeline.frames import BuildOptions
from calibration.report.report import report_json
from calibration.table.lut import REFERENCES, REPORT_JSON, Lut, open_lut
from calibration.table.verification import chart_difference
from calibration.verdict import BuildResult
from experiment.chart.model import Chart, load_chart
from experiment.lights import Illumination
from experiment.measures.stains import STAINED
from experiment.session.folder import Session
from experiment.session.journal import JOURNAL_FILE
from foundation.colorimetry import angles_deg
from foundation.compiled import ordered_map, processor_count
from foundation.errors import FormatError, counted, first_of
from foundation.files import storage_error, write_whole

_Array = npt.NDArray[np.float64]

CHANCE = 0.01
"""With which noise alone makes any light of a whole table differ."""

ERROR_OF_ERRORS = 1.3
"""By how much the whites' standard errors may be too small: they are the scatter about a polynomial that was fitted to
the same references, with up to a third as many terms (a factor of 1.22), from references few in number."""

ANGLE_FLOOR_DEG = 0.005
"""Angle that is called none (judgement): a two-hundredth of a good method's error of one degree."""

BRIGHTNESS_FLOOR = 0.002
"""Difference of brightness that is called none: fields that were fitted anew on another sheet leave up to 0.17 % in
the whites of a small simulated chart; a fifth of the drift that is usual in a session."""

CELL_SCORE = 1.1
"""Root mean square of cells in units of their noise up to which noise is the cause: what is beyond is then less than
half of the noise of a single cell of 25 samples. Sessions of one simulated room with other noise give 1.00 to 1.05."""

LIGHT_SCORE = 1.3
"""The same of one light's cells."""

CELL_SIGMAS = 6.0
"""Standard errors by which a cell's mean over all lights must differ to be named; by chance one of 5·10⁸."""

CELL_FLOOR = STAINED
"""Relative difference that it must have, too: that from which on `build-lut` calls a cell stained. Pixels are taken
whole, so a cell of 9 px that lies a fraction of one elsewhere takes in 1.5 % more or less of a bright neighbour."""

CHART_FILE = "chart.json"
"""What was photographed, in a session's folder (docs/formats.md)."""

ReportBuild = Callable[[int, int, str], None]
"""Called with frames taken in, frames in all, and what is being done."""

LEAST_COUNTS = 300.0
"""Counts above which a cell is compared: 25 samples of 300 counts have a mean good to 1 %, and the errors
of tables in docs/measured.md are of the same cells."""

MOST_THREADS = 4
"""Each holds a light of both tables, 10 MB with 25 samples; reading the disk is what takes the time."""

GROUPS = ("black", "blue", "green", "cyan", "red", "magenta", "yellow", "white")
"""Parts of the colour cube: bits 4, 2 and 1 of the place are whether red, green and blue are in the upper half."""

_LEAST_SHARE = 0.05
"""Share of a white's largest channel from which on another channel's gain counts: fainter ones are noise."""

ReportLights = Callable[[int, int], None]
"""Called with the number of lights compared, and the number of all."""


@dataclass(frozen=True)
class ComparedTable:
    """One of the two tables.

    - `place`: its folder, or that of the session that it was made of for the comparison.
    - `lights`, `samples`: lights, and samples of each cell.
    """

    place: Path
    camera: str
    software: str
    lights: int
    samples: int
    drift_corrected: bool


@dataclass(frozen=True, eq=False)
class LightDifferences:
    """What differs light by light.

    - `one`, `other`: (L,) int64, the light's number in A and in B.
    - `angle_deg`: (L,) float64 degrees between the two whites.
    - `angle_noise_deg`: (L,) float64 degrees, root mean square of that angle by the whites' standard errors alone; NaN
      where a table does not have them.
    - `angle_score`: (L,) float64, the angle in units of its errors: χ² of two freedoms over 2 has this squared; NaN
      likewise.
    - `brightness`: (L,) float64, length of B's white over A's, less 1.
    - `brightness_left`: (L,) float64, the same after the drift that both tables record, and the median of the lights,
      are divided out.
    - `brightness_noise`: (L,) float64, standard error of either by the whites' errors alone; NaN where it is not known.
    - `gains`: (3,) float64, B's white over A's channel by channel, median of the lights with enough of it.
    - `cell_rms`, `cell_noise`: (L,) float64, root mean square over the cells of B over A less 1, each over its own
      light's white, and what noise alone predicts of it; NaN where no cell is bright enough.
    - `cell_score`: (L,) float64, root mean square of the cells' differences in units of their standard errors: 1 by
      noise alone.
    """

    one: npt.NDArray[np.int64]
    other: npt.NDArray[np.int64]
    angle_deg: _Array
    angle_noise_deg: _Array
    angle_score: _Array
    brightness: _Array
    brightness_left: _Array
    brightness_noise: _Array
    gains: _Array
    cell_rms: _Array
    cell_noise: _Array
    cell_score: _Array


@dataclass(frozen=True, eq=False)
class CellDifferences:
    """What differs cell by cell, over all lights: B over A less 1, each over its own light's white.

    Only where both means are above `LEAST_COUNTS`; NaN where none is, and for cells that a table lists as unfit.

    - `lights`: (C, 3) int64, lights that count.
    - `mean`, `spread`: (C, 3) float64, over the lights.
    - `noise`: (C, 3) float64, standard error of `mean` by noise alone.
    - `worst`, `worst_light`: (C, 3) float64, the largest difference in units of its standard error, with its sign; (C,
      3) int64 the light of A under which it is, −1 for none.
    - `worst_share`: (C, 3) float64, that difference, relative.
    - `unfit_one`, `unfit_other`: cells that only A, and only B, lists as unfit.
    - `score`: root mean square over cells, channels and lights of differences in units of their standard errors.
    - `rms`, `predicted_rms`: root mean square of the differences, and by noise alone.
    - `offset`: (3,) float64, mean of all differences.
    """

    lights: npt.NDArray[np.int64]
    mean: _Array
    spread: _Array
    noise: _Array
    worst: _Array
    worst_light: npt.NDArray[np.int64]
    worst_share: _Array
    unfit_one: tuple[int, ...]
    unfit_other: tuple[int, ...]
    score: float
    rms: float
    predicted_rms: float
    offset: _Array

    @property
    def beyond_noise(self) -> float:
        """What of `rms` noise does not explain: the root of the difference of the squares, 0 where it explains all."""
        return float(np.sqrt(max(self.rms**2 - self.predicted_rms**2, 0.0)))


@dataclass(frozen=True)
class ColourGroup:
    """Cells of one part of the colour cube.

    - `mean`, `spread`: mean and standard deviation over the cells of their mean difference, in the channel that
      deviates most.
    - `worst`: the largest mean difference, with its sign.
    """

    name: str
    cells: int
    mean: float
    spread: float
    worst: float
    worst_colour: int


@dataclass(frozen=True)
class GeometryDifference:
    """How the chart lay elsewhere in the frame that was registered first; half-size px of A's frame.

    - `shift_px`: (dx, dy) of the page's middle.
    - `turned_deg`: clockwise in the picture.
    - `scale`: B's size over A's, less 1.
    - `bent_px`: root mean square of what shift, turn and scale leave: perspective, another lens, another shape of the
      sheet.
    """

    shift_px: tuple[float, float]
    turned_deg: float
    scale: float
    bent_px: float


@dataclass(frozen=True)
class NoiseAnswer:
    """Whether one thing is the same within noise, None where it cannot be said, and the numbers in words."""

    name: str
    same: bool | None
    said: str


@dataclass(frozen=True, eq=False)
class TableComparison:
    """How two tables differ."""

    one: ComparedTable
    other: ComparedTable
    warnings: tuple[str, ...]
    lights: LightDifferences
    cells: CellDifferences
    groups: tuple[ColourGroup, ...]
    geometry: GeometryDifference | None
    answers: tuple[NoiseAnswer, ...]

    @property
    def same(self) -> bool | None:
        """Whether everything is the same within noise; None where something cannot be said and nothing differs."""
        said = [answer.same for answer in self.answers]
        return False if False in said else None if None in said else True


def light_pairs(one: Sequence[Illumination], other: Sequence[Illumination]) -> list[tuple[int, int]]:
    """Return the numbers in either table of lights of the same kind, temperature, codes and name, by the first's order.

    Where a table has a light more than once, the first of it is that of the other's first, and so on.
    """
    there: dict[object, list[int]] = {}
    for light in reversed(other):
        there.setdefault(_key(light), []).append(light.index)
    return [(light.index, found.pop()) for light in one if (found := there.get(_key(light)))]


def _key(light: Illumination) -> object:
    return light.kind, light.cct_k, light.colour, light.name


def warnings_of(one: Lut, other: Lut, common: int) -> tuple[str, ...]:
    """Return what a reader must know of two tables with so many lights in common, a sentence each."""
    ours, theirs = one.provenance, other.provenance
    found: list[str] = []
    if ours.camera != theirs.camera:
        found.append(
            f"two cameras, {ours.camera} and {theirs.camera}: what differs is first of all the cameras, not the lab"
        )
    alone, others = len(one.illuminations) - common, len(other.illuminations) - common
    if alone or others:
        found.append(
            f"{common} lights are compared, which both have; {alone} of the first and {others} of the second are not "
            "in the other"
        )
    if (ours.computed is None) != (theirs.computed is None):
        found.append("one of the tables was computed, and nothing was photographed for it")
    if ours.session_sha256 == theirs.session_sha256 and ours.computed is None:
        found.append("both tables are of the same frames: their noise is the same, and agreement shows nothing")
    if one.samples.shape[2] != other.samples.shape[2]:
        found.append(
            f"{one.samples.shape[2]} samples a cell against {other.samples.shape[2]}: the larger window takes in more "
            "of a cell's rim"
        )
    return tuple(found)


def answers_of(lights: LightDifferences, cells: CellDifferences) -> tuple[NoiseAnswer, ...]:
    """Return whether the lights' colour, their brightness, and the cells are the same within noise."""
    return _colour(lights), _brightness(lights), _cells(lights, cells)


def differing_lights(lights: LightDifferences) -> npt.NDArray[np.int64]:
    """Return (K,) int64 the places, among the compared lights, of those whose colour differs; the worst first."""
    beyond = np.flatnonzero((lights.angle_score > _most_score(len(lights.one))) & (lights.angle_deg > ANGLE_FLOOR_DEG))
    return beyond[np.argsort(-lights.angle_deg[beyond])]


def differing_cells(cells: CellDifferences) -> npt.NDArray[np.int64]:
    """Return (K,) int64 the colours whose mean over the lights differs from that of the others; the worst first."""
    with np.errstate(invalid="ignore"):
        off = np.abs(cells.mean - cells.offset)
        beyond = np.flatnonzero(((off > CELL_SIGMAS * cells.noise) & (off > CELL_FLOOR)).any(axis=1))
    return beyond[np.argsort(-np.nanmax(off[beyond], axis=1))] if len(beyond) else beyond


def _most_score(count: int) -> float:
    """Return the score that noise alone exceeds in any of `count` lights with `CHANCE`: χ² of two freedoms."""
    return ERROR_OF_ERRORS * float(np.sqrt(np.log(count / CHANCE)))


def _colour(lights: LightDifferences) -> NoiseAnswer:
    angle, noise = lights.angle_deg, lights.angle_noise_deg
    worst = int(angle.argmax())
    said = f"median {np.median(angle):.4f}°, worst {angle[worst]:.4f}° (light {lights.one[worst]})"
    if not np.isfinite(lights.angle_score).any():
        return NoiseAnswer("colour of lights", None, f"{said}; what noise alone gives is not known of these tables")
    beyond = differing_lights(lights)
    said += f"; noise alone gives {np.nanmedian(noise):.4f}° RMS under the median light"
    if len(beyond):
        said += f"; {len(beyond)} of {len(angle)} lights are beyond it: {first_of(lights.one[beyond].tolist())}"
    return NoiseAnswer("colour of lights", not len(beyond), said)


def _brightness(lights: LightDifferences) -> NoiseAnswer:
    off, left, noise = lights.brightness, lights.brightness_left, lights.brightness_noise
    said = (
        f"{100 * float(np.median(off)):+.3f} % on the median, {100 * off.min():+.3f} to {100 * off.max():+.3f} %; "
        f"without the recorded drift and that median {100 * float(np.sqrt((left**2).mean())):.3f} % RMS, "
        f"{100 * np.abs(left).max():.3f} % at most"
    )
    if not np.isfinite(noise).any():
        return NoiseAnswer("brightness of lights", None, f"{said}; what noise alone gives is not known of these tables")
    # Two-sided and of one freedom, so bounded by the same tail as two.
    limit = np.maximum(_most_score(len(off)) * np.sqrt(2) * noise, BRIGHTNESS_FLOOR)
    beyond = int((np.abs(off) > limit).sum())
    said += f"; noise alone gives {100 * float(np.nanmedian(noise)):.3f} %"
    if beyond:
        still = int((np.abs(left) > limit).sum())
        said += f"; {beyond} of {len(off)} lights are beyond it, {still} without drift and median"
    return NoiseAnswer("brightness of lights", not beyond, said)


def _cells(lights: LightDifferences, cells: CellDifferences) -> NoiseAnswer:
    if not np.isfinite(cells.score):
        return NoiseAnswer("cells", None, "no cell is bright enough in both tables")
    named = differing_cells(cells)
    uneven = np.flatnonzero(lights.cell_score > LIGHT_SCORE)
    said = (
        f"{100 * cells.rms:.3f} % RMS of cells above 300 counts, of which noise explains "
        f"{100 * cells.predicted_rms:.3f} % and leaves {100 * cells.beyond_noise:.3f} %; "
        f"{cells.score:.3f} in units of noise"
    )
    if len(uneven):
        order = uneven[np.argsort(-lights.cell_score[uneven])]
        said += f"; {len(uneven)} lights are beyond {LIGHT_SCORE:g}: {first_of(lights.one[order].tolist())}"
    if len(named):
        said += f"; {len(named)} cells differ under all lights: {first_of(named.tolist())}"
    return NoiseAnswer("cells", cells.score <= CELL_SCORE and not len(uneven) and not len(named), said)


def geometry_difference(one: _Array, other: _Array) -> GeometryDifference:
    """Return the similarity that takes places to others best, in least squares.

    The closed solution with complex numbers, of which scale and turn are one; places are x + iy, y down.

    `one`, `other`: (N, 2) float64 half-size px, N at least 2: the same points of the print in two frames.
    """
    first, second = (places[:, 0] + 1j * places[:, 1] for places in (one, other))
    middle, after = first.mean(), second.mean()
    about = first - middle
    factor = (np.conj(about) @ (second - after)) / (np.conj(about) @ about)
    left = second - after - factor * about
    shift = after - middle
    return GeometryDifference(
        shift_px=(float(shift.real), float(shift.imag)),
        turned_deg=float(np.degrees(np.angle(factor))),
        scale=float(np.abs(factor)) - 1,
        bent_px=float(np.sqrt((np.abs(left) ** 2).mean())),
    )


@contextmanager
def table_of(place: Path, options: BuildOptions, progress: ReportBuild | None = None) -> Generator[Lut]:
    """Yield the table of a table's folder as it is, or of a session's, which is built as `build-lut` builds it.

    The table of a session lies in a hidden folder beside the session until the end: it needs 3.5 GB of 707 lights.
    """
    if not (place / JOURNAL_FILE).is_file():
        yield open_lut(place)
        return
    try:
        scratch = tempfile.TemporaryDirectory(prefix=f".{place.name}.compared.", dir=place.resolve().parent)
    except OSError as error:
        raise storage_error(place.parent, error) from error
    with scratch as folder, Session.open(place) as session:
        table = Path(folder) / "table"
        build(session, table, progress, _write_figures, options)
        yield open_lut(table)


def chart_of(places: Sequence[Path]) -> Chart | None:
    """Return the chart of the first session among the places; None where all are tables, which do not hold it."""
    found = (place / CHART_FILE for place in places if (place / JOURNAL_FILE).is_file())
    return next((load_chart(path) for path in found if path.is_file()), None)


def _write_figures(result: BuildResult, session: Session, folder: Path) -> None:
    """Write the figures of a table without its pictures, which nobody sees."""
    write_whole(folder / REPORT_JSON, json.dumps(report_json(result)) + "\n")


def compare(
    one: Lut,
    other: Lut,
    progress: ReportLights | None = None,
    places: tuple[Path | None, Path | None] = (None, None),
) -> TableComparison:
    """Return how far two tables of one chart differ, and whether noise alone explains it."""
    differs = chart_difference(one, other)
    if differs:
        raise FormatError(
            f"{one.folder} and {other.folder} are of different charts ({differs}), so that their cells cannot be "
            "compared; name two tables or sessions of one chart.json"
        )
    pairs = light_pairs(one.illuminations, other.illuminations)
    if not pairs:
        raise FormatError(
            f"{one.folder} has {counted(len(one.illuminations), 'light')} and {other.folder} "
            f"{len(other.illuminations)}, none of them the same: expected at least one of the same kind and codes"
        )
    lights, cells = _differences(one, other, pairs, progress)
    first, second = (
        _described(table, place or table.folder) for table, place in zip((one, other), places, strict=True)
    )
    return TableComparison(
        one=first,
        other=second,
        warnings=warnings_of(one, other, len(pairs)),
        lights=lights,
        cells=cells,
        groups=colour_groups(cells, one.provenance.bits),
        geometry=_geometry(one, other),
        answers=answers_of(lights, cells),
    )


def _differences(
    one: Lut, other: Lut, pairs: Sequence[tuple[int, int]], progress: ReportLights | None
) -> tuple[LightDifferences, CellDifferences]:
    unfit = [{cell.colour for cell in table.provenance.unfit} for table in (one, other)]
    usable = np.ones(one.samples.shape[1], dtype=np.bool_)
    usable[sorted(unfit[0] | unfit[1])] = False
    # A difference over its estimated error has Student's distribution, whose variance is n / (n − 2); n by Welch and
    # Satterthwaite, for variances of means in inverse proportion to the samples.
    sizes = np.array([one.samples.shape[2], other.samples.shape[2]], dtype=np.float64)
    freedoms = float((1 / sizes).sum() ** 2 / (1 / sizes**2 / (sizes - 1)).sum())
    widening = float(np.sqrt(freedoms / (freedoms - 2)))

    def work(pair: tuple[int, int]) -> tuple[_Array, _Array, _Array]:
        return _compare_light(one, other, *pair, usable, widening)

    sums = _Sums.empty(len(usable))
    squares = np.full((3, len(pairs)), np.nan)
    for number, found in enumerate(ordered_map(work, pairs, min(processor_count(), MOST_THREADS))):
        there = np.isfinite(found[0])
        share, deviation, variance = (np.where(there, values, 0.0) for values in found)
        if there.any():
            of_light = (share[there] ** 2, variance[there], deviation[there] ** 2)
            squares[:, number] = [values.mean() for values in of_light]
        sums.add(share, deviation, variance, there, pairs[number][0])
        if progress is not None:
            progress(number + 1, len(pairs))
    cells = sums.result(tuple(sorted(unfit[0] - unfit[1])), tuple(sorted(unfit[1] - unfit[0])))
    return _light_differences(one, other, pairs, *np.sqrt(squares)), cells


def _compare_light(
    one: Lut, other: Lut, light: int, counterpart: int, usable: npt.NDArray[np.bool_], widening: float
) -> tuple[_Array, _Array, _Array]:
    """Return what differs of the cells of one light, each mean over its own table's white: shares (C, 3) float64.

    And the same in units of its standard error, and the square of that; NaN where a cell does not count.
    """
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
    return share, share / np.sqrt(both) / widening, both


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

    def add(self, share: _Array, score: _Array, variance: _Array, there: npt.NDArray[np.bool_], light: int) -> None:
        """Add a light's differences, 0 where a cell does not count."""
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
    one: Lut, other: Lut, pairs: Sequence[tuple[int, int]], rms: _Array, noise: _Array, score: _Array
) -> LightDifferences:
    numbers = np.array(pairs, dtype=np.int64).T
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
    known = lut.provenance
    corrected = any(done.get("name") == "drift" and bool(done.get("applied")) for done in known.corrections)
    return ComparedTable(place, known.camera, known.software, len(lut.illuminations), lut.samples.shape[2], corrected)


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
