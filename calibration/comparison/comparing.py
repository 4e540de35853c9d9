"""Compare two tables light by light, and report whether noise alone explains what differs. Always B over A.

- Memory is bounded: one light of each table for each thread.
- The noise comes from the tables. A cell's standard error is the scatter of its own samples over the root of their
  number; a white's is that of `references.csv`.
- With 700 lights and 32 768 cells, every difference is significant, however small. So a difference counts if noise
  explains it with a chance below one in a hundred for the whole table, and if it is above a floor that no use of a
  table notices.

L common lights, C colours.
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import stats

from calibration.kernels import moments
from calibration.pipeline.build import build, refused_folder
from calibration.table.lut import REFERENCES, REPORT_JSON, Lut, open_lut
from calibration.table.verification import chart_difference
from experiment.chart.model import Chart, load_chart
from experiment.lights import Illumination
from experiment.measures.stains import STAINED
from experiment.session.folder import Session
from experiment.session.journal import JOURNAL_FILE
from foundation.colorimetry import angles_deg
from foundation.compiled import ordered_map, processor_count
from foundation.errors import FormatError, first_few
from foundation.files import write_atomic

_Array = npt.NDArray[np.float64]
_Numbers = npt.NDArray[np.int64]

# Chance with which noise alone makes any light of a whole table differ.
CHANCE = 0.01

# Factor by which the standard errors of whites may be too small: they are the scatter about a polynomial that was
# fitted to the same references, with up to a third as many terms (a factor of 1.22), and references are few.
ERROR_OF_ERRORS = 1.3

# Angle between whites, degrees, that is called none: 1/200 of the error of a good method (judgement).
ANGLE_FLOOR_DEG = 0.005

# Relative difference of brightness that is called none: fields that were fitted again on another sheet leave up to
# 0.17 % in the whites of a small simulated chart.
BRIGHTNESS_FLOOR = 0.002

# Root mean square of all cells, and of one light's, in units of their noise up to which noise is the cause. Sessions of
# one simulated room with other noise give 1.00 to 1.05.
CELL_SCORE = 1.1
LIGHT_SCORE = 1.3

# Standard errors, and relative difference, from which on a cell's mean over all lights is named. By chance one cell of
# 5·10⁸ has the first; the second is that of a stain in `build-lut`.
CELL_SIGMAS = 6.0
CELL_FLOOR = STAINED

# Counts above which a cell is compared: the mean of 25 samples of 300 counts has an error of 1 %.
LEAST_COUNTS = 300.0

LightProgress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class LightDifferences:
    """Differences light by light.

    - `one`, `other`: (L,) int64, number of the light in A and in B.
    - `angle_deg`: (L,) float64 degrees between the two whites.
    - `angle_p`: (L,) float64, chance that noise alone makes the whites' colours differ as much.
    - `brightness`: (L,) float64, B's white over A's less 1, mean of the channels by their errors.
    - `brightness_p`: (L,) float64, chance that noise alone makes it differ as much.
    - `cell_score`: (L,) float64, root mean square of the cells' differences in units of their standard errors; NaN if
      no cell is bright enough.
    """

    one: _Numbers
    other: _Numbers
    angle_deg: _Array
    angle_p: _Array
    brightness: _Array
    brightness_p: _Array
    cell_score: _Array


@dataclass(frozen=True, eq=False)
class CellDifferences:
    """Differences cell by cell over all lights: B over A less 1, each over its own light's white.

    Only lights under which both means are above `LEAST_COUNTS` count; NaN if there is none, and for unfit cells.

    - `lights`: (C, 3) int64, lights that count.
    - `mean`: (C, 3) float64, over the lights.
    - `noise`: (C, 3) float64, standard error of `mean`.
    - `offset`: (3,) float64, mean of all differences.
    - `rms`, `rms_by_noise`: root mean square of all differences, and its prediction by noise.
    - `score`: root mean square of all differences in units of their standard errors.
    """

    lights: _Numbers
    mean: _Array
    noise: _Array
    offset: _Array
    rms: float
    rms_by_noise: float
    score: float


@dataclass(frozen=True)
class NoiseAnswer:
    """Whether one quantity is the same within noise, its numbers in words, and the lights or cells that differ."""

    name: str
    same_within_noise: bool
    said: str


@dataclass(frozen=True, eq=False)
class TableComparison:
    """How two tables differ; `places` are the folders of the tables, or of the sessions that they were built of."""

    places: tuple[Path, Path]
    warnings: tuple[str, ...]
    lights: LightDifferences
    cells: CellDifferences
    answers: tuple[NoiseAnswer, ...]

    @property
    def same_within_noise(self) -> bool:
        """Whether everything is the same within noise."""
        return all(answer.same_within_noise for answer in self.answers)


def compare(
    one: Lut, other: Lut, progress: LightProgress = lambda done, total: None, places: tuple[Path, Path] | None = None
) -> TableComparison:
    """Return how far two tables of one chart differ, and whether noise alone explains it."""
    if differs := chart_difference(one, other):
        raise FormatError(
            f"{one.folder} and {other.folder} are of different charts ({differs}), so that their cells cannot be "
            "compared; name two tables or sessions of one chart.json"
        )
    pairs = light_pairs(one.illuminations, other.illuminations)
    if not pairs:
        raise FormatError(
            f"{one.folder} and {other.folder} have no light in common; expected at least one of the same kind and codes"
        )
    cells, cell_score = _compare_cells(one, other, pairs, progress)
    lights = _compare_lights(one, other, pairs, cell_score)
    answers = _colour_answer(lights), _brightness_answer(lights), _cells_answer(lights, cells)
    places = places or (one.folder, other.folder)
    return TableComparison(places, _warnings(one, other, len(pairs)), lights, cells, answers)


@contextmanager
def table_of(place: Path, progress: Callable[[int, int, str], None] | None = None) -> Generator[Lut]:
    """Yield the table in a folder, or that of the session in it, which is built as `build-lut` builds it.

    The table of a session lies in a hidden folder beside the session until the end: 707 lights need 3.5 GB. Of a build
    that ends at a frame the report stays in `SESSION.refused`.
    """
    if not (place / JOURNAL_FILE).is_file():
        yield open_lut(place)
        return
    beside = tempfile.TemporaryDirectory(prefix=f".{place.name}.compared.", dir=place.resolve().parent)
    with beside as folder, Session.open(place) as session:
        table = Path(folder) / "table"
        try:
            build(session, table, progress)
        finally:
            # `acquire run --retake bad`, which the message of a refused frame names, looks for it beside the session.
            refused = refused_folder(table) / REPORT_JSON
            if refused.is_file():
                write_atomic(refused_folder(place.resolve()) / REPORT_JSON, refused.read_bytes())
        yield open_lut(table)


def chart_of(places: Sequence[Path]) -> Chart | None:
    """Return the chart of the first session among the places; None if all are tables, which do not contain it."""
    charts = (place / "chart.json" for place in places if (place / JOURNAL_FILE).is_file())
    return next((load_chart(path) for path in charts if path.is_file()), None)


def light_pairs(one: Sequence[Illumination], other: Sequence[Illumination]) -> list[tuple[int, int]]:
    """Return the numbers in either table of lights of the same kind, temperature, codes and name, by the first's order.

    Of a light that a table has more than once, the first is paired with the other table's first, and so on.
    """
    waiting: dict[Illumination, list[int]] = {}
    for light in reversed(other):
        waiting.setdefault(replace(light, index=0), []).append(light.index)
    return [(light.index, numbers.pop()) for light in one if (numbers := waiting.get(replace(light, index=0)))]


def _warnings(one: Lut, other: Lut, common: int) -> tuple[str, ...]:
    ours, theirs = one.provenance, other.provenance
    alone, others = len(one.white) - common, len(other.white) - common
    same_frames = ours.session_sha256 == theirs.session_sha256 and ours.computed is None
    warnings = {
        f"two cameras, {ours.camera} and {theirs.camera}: they differ first of all": ours.camera != theirs.camera,
        f"{common} common lights are compared; {alone} are in A only, {others} in B only": bool(alone or others),
        "both tables are of the same frames: their noise is the same, and agreement shows nothing": same_frames,
    }
    return tuple(warning for warning, holds in warnings.items() if holds)


def differing_lights(lights: LightDifferences) -> _Numbers:
    """Return (K,) int64 the numbers in A of the lights whose colour differs, in their order."""
    return lights.one[_beyond(lights.angle_p) & (lights.angle_deg > ANGLE_FLOOR_DEG)]


def differing_cells(cells: CellDifferences) -> _Numbers:
    """Return (K,) int64 the colours whose mean over the lights differs from that of the others; the worst first."""
    off = np.abs(cells.mean - cells.offset)
    beyond = np.flatnonzero(((off > CELL_SIGMAS * cells.noise) & (off > CELL_FLOOR)).any(axis=1))
    return beyond[np.argsort(-np.nan_to_num(off[beyond]).max(axis=1))]


def _beyond(chances: _Array) -> npt.NDArray[np.bool_]:
    """Return which of several lights noise alone does not explain, at `CHANCE` for all of them (Bonferroni)."""
    return chances < CHANCE / len(chances)


def _answer(name: str, said: str, *beyond: str) -> NoiseAnswer:
    return NoiseAnswer(name, not any(beyond), "; ".join(filter(None, (said, *beyond))))


def _named(numbers: _Numbers, what: str) -> str:
    return f"{len(numbers)} {what}: {first_few(numbers.tolist())}" if len(numbers) else ""


def _colour_answer(lights: LightDifferences) -> NoiseAnswer:
    said = f"{np.median(lights.angle_deg):.4f}° between whites on the median, {lights.angle_deg.max():.4f}° at most"
    return _answer("colour of lights", said, _named(differing_lights(lights), "lights are beyond noise"))


def _brightness_answer(lights: LightDifferences) -> NoiseAnswer:
    off = lights.brightness
    # The bootstrap takes two values at least.
    drawn = stats.bootstrap((np.resize(off, max(len(off), 2)),), np.median, n_resamples=999, method="percentile", rng=0)
    low, high = drawn.confidence_interval
    said = (
        f"{100 * np.median(off):+.3f} % on the median (95 % interval {100 * low:+.3f} to {100 * high:+.3f} %), "
        f"{100 * off.min():+.3f} to {100 * off.max():+.3f} % of all lights"
    )
    beyond = _beyond(lights.brightness_p) & (np.abs(off) > BRIGHTNESS_FLOOR)
    return _answer("brightness of lights", said, _named(lights.one[beyond], "lights are beyond noise"))


def _cells_answer(lights: LightDifferences, cells: CellDifferences) -> NoiseAnswer:
    uneven = lights.one[lights.cell_score > LIGHT_SCORE]
    return _answer(
        "cells",
        f"{100 * cells.rms:.3f} % RMS, by noise alone {100 * cells.rms_by_noise:.3f} %",
        f"{cells.score:.3f} times their noise" if cells.score > CELL_SCORE else "",
        _named(uneven, f"lights are beyond {LIGHT_SCORE:g} times their noise"),
        _named(differing_cells(cells), "cells differ under all lights"),
    )


def _compare_cells(
    one: Lut, other: Lut, pairs: Sequence[tuple[int, int]], progress: LightProgress
) -> tuple[CellDifferences, _Array]:
    """Return the differences of the cells, and their root mean square (L,) float64 by light in units of noise."""
    unfit = sorted({cell.colour for table in (one, other) for cell in table.provenance.unfit})
    # A difference over its estimated error has Student's distribution; freedoms by Welch and Satterthwaite, for
    # variances of means in inverse proportion to the samples.
    sizes = np.array([one.samples.shape[2], other.samples.shape[2]], dtype=np.float64)
    widening = stats.t((1 / sizes).sum() ** 2 / (1 / sizes**2 / (sizes - 1)).sum()).std()

    def work(pair: tuple[int, int]) -> tuple[_Array, _Array]:
        (ours, our_noise), (theirs, their_noise) = _relative_means(one, pair[0]), _relative_means(other, pair[1])
        share = theirs / ours - 1
        share[unfit] = np.nan
        return share, our_noise + their_noise

    # Sums over the lights: number, difference, and squares of difference, noise and score.
    sums = np.zeros((5, one.samples.shape[1], 3))
    scores = np.empty(len(pairs))
    for number, (share, noise) in enumerate(ordered_map(work, pairs, processor_count())):
        known = np.isfinite(share)
        terms = np.stack([known, share, share**2, noise, share**2 / noise / widening**2])
        scores[number] = np.sqrt(terms[4, known].mean()) if known.any() else np.nan
        sums += np.where(known, terms, 0.0)
        progress(number + 1, len(pairs))
    count, total = sums[0], sums[0].sum()
    if not total:
        raise FormatError(f"no cell is above {LEAST_COUNTS:g} counts in both tables; compare longer exposures")
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, error = sums[1] / count, np.sqrt(sums[3]) / count
        offset = sums[1].sum(axis=0) / count.sum(axis=0)
    rms, rms_by_noise, score = np.sqrt(sums[2:].sum(axis=(1, 2)) / total).tolist()
    return CellDifferences(count.astype(np.int64), mean, error, offset, rms, rms_by_noise, score), scores


def _relative_means(lut: Lut, light: int) -> tuple[_Array, _Array]:
    """Return the means of a light's cells over its white, and their relative variances; NaN if a cell is too dark."""
    lut.require_unchanged(light)
    samples = np.asarray(lut.samples[light])
    means, scatter = np.empty((len(samples), 3)), np.empty((len(samples), 3))
    moments(samples, means, scatter)
    means[means <= LEAST_COUNTS] = np.nan
    # Integers have at least the scatter of rounding.
    return means / lut.white[light], np.maximum(scatter, 1 / 12) / samples.shape[1] / means**2


def _compare_lights(one: Lut, other: Lut, pairs: Sequence[tuple[int, int]], cell_score: _Array) -> LightDifferences:
    numbers = np.array(pairs, dtype=np.int64).T
    whites = np.stack([one.white[numbers[0]], other.white[numbers[1]]])
    errors = ERROR_OF_ERRORS * np.stack([white_errors(one)[numbers[0]], white_errors(other)[numbers[1]]])
    # Logarithms of a channel's ratio have normal errors. Their weighted mean is the brightness, and what differs from
    # it is the colour: χ² of two freedoms. A channel below its own error has next to no weight.
    whites_known = np.maximum(whites, errors)
    ratio = np.log(whites_known[1] / whites_known[0])
    weight = 1 / ((errors / whites_known) ** 2).sum(axis=0)
    brightness = (weight * ratio).sum(axis=1) / weight.sum(axis=1)
    colour = (weight * (ratio - brightness[:, None]) ** 2).sum(axis=1)
    return LightDifferences(
        one=numbers[0],
        other=numbers[1],
        angle_deg=angles_deg(whites[0], whites[1]),
        angle_p=stats.chi2(2).sf(colour),
        brightness=np.expm1(brightness),
        brightness_p=stats.chi2(1).sf(brightness**2 * weight.sum(axis=1)),
        cell_score=cell_score,
    )


def white_errors(lut: Lut) -> _Array:
    """Return the standard errors (L, 3) float64 of a table's whites by `references.csv`."""
    path = lut.folder / REFERENCES
    errors = np.zeros(lut.white.shape)
    try:
        for row in csv.DictReader(path.read_text("utf-8").splitlines()):
            if row["name"] == "white":
                errors[int(row["light"])] = [float(row[name]) for name in ("r_error", "g_error", "b_error")]
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise FormatError(f"{path} cannot be used: {error}; build the table again") from error
    if not (errors > 0).all():
        raise FormatError(f"{path} lacks the error of a white; build the table again")
    return errors
