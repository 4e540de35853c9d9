"""Compare two LUTs, A and B, and report whether noise alone explains their differences.

All differences are B relative to A. The noise is taken from the LUTs. The standard error of a patch is the scatter of
its samples, divided by the square root of their number. The standard errors of whites are in `references.csv`.

L common illuminants, C colours.
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
from experiment.lights import Illuminant
from experiment.measures.stains import STAINED
from experiment.session.folder import Session
from experiment.session.journal import JOURNAL_FILE
from foundation.colorimetry import angles_deg
from foundation.compiled import ordered_map, processor_count
from foundation.errors import FormatError, counted, first_few
from foundation.files import write_atomic

_Array = npt.NDArray[np.float64]
_Numbers = npt.NDArray[np.int64]
_Folders = tuple[Path, Path]

# Largest probability with which noise alone causes a reported difference anywhere in the LUT. A reported difference
# must also exceed one of the limits below, because with so many samples even negligible differences are significant.
MAX_CHANCE = 0.01

# Factor for the standard errors of whites. They are too small, because they are the scatter about a polynomial that was
# fitted to the same few white references.
ERROR_FACTOR = 1.3

# Negligible angle between whites, degrees: 1/200 of the error of a good method. Chosen by judgement.
ANGLE_FLOOR_DEG = 0.005

# Negligible relative difference of brightness. Two sheets of a small simulated chart differ by up to 0.17 %, because
# their flat fields differ.
BRIGHTNESS_FLOOR = 0.002

# Largest RMS difference of patches that noise explains, in units of noise. Two sessions in the same simulated room give
# 1.00 to 1.05.
CELL_SCORE = 1.1  # of all patches
LIGHT_SCORE = 1.3  # of the patches under one illuminant

# A patch is listed if its mean difference over all illuminants exceeds both limits. The first is in standard errors;
# the second is the limit of a stain in `build-lut`.
CELL_SIGMAS = 6.0
CELL_FLOOR = STAINED  # relative

# Patches with fewer counts are not compared. The mean of 25 samples of 300 counts has an error of 1 %.
MIN_COUNTS = 300.0

LightProgress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class LightDifferences:
    """Differences by illuminant."""

    one: _Numbers  # (L,), index of the illuminant in A
    other: _Numbers  # (L,), index of the illuminant in B
    angle_deg: _Array  # (L,) degrees between the two whites
    angle_p: _Array  # (L,), probability of such a difference of colour by noise alone
    brightness: _Array  # (L,), white of B / white of A − 1; channels weighted by their errors
    brightness_p: _Array  # (L,), probability of such a difference of brightness by noise alone
    # (L,), RMS of the patches' differences, divided by their standard errors; NaN if all are too dark
    cell_score: _Array


@dataclass(frozen=True, eq=False)
class CellDifferences:
    """Differences of the patches over all illuminants: B / A − 1, where A and B are relative to their own whites.

    Only illuminants under which both means exceed `MIN_COUNTS` are included. Unfit patches, and patches without such
    illuminants, are NaN.
    """

    lights: _Numbers  # (C, 3), number of illuminants included
    mean: _Array  # (C, 3), mean over the illuminants
    noise: _Array  # (C, 3), standard error of `mean`
    offset: _Array  # (3,), mean of all differences
    rms: float  # RMS of all differences
    rms_by_noise: float  # RMS expected from noise alone
    score: float  # RMS of all differences divided by their standard errors


@dataclass(frozen=True)
class NoiseAnswer:
    """Result for one quantity: whether noise explains the difference."""

    name: str
    same_within_noise: bool
    said: str  # Values, and the illuminants or patches that differ, as text


@dataclass(frozen=True, eq=False)
class TableComparison:
    """Differences of two LUTs; `folders` contain the LUTs or their sessions."""

    folders: _Folders
    warnings: tuple[str, ...]
    lights: LightDifferences
    cells: CellDifferences
    answers: tuple[NoiseAnswer, ...]

    @property
    def same_within_noise(self) -> bool:
        """True if noise explains all differences."""
        return all(answer.same_within_noise for answer in self.answers)


def compare(
    first: Lut, second: Lut, progress: LightProgress = lambda done, total: None, folders: _Folders | None = None
) -> TableComparison:
    """Return the differences of two LUTs of one chart, and whether noise explains them."""
    if differs := chart_difference(first, second):
        raise FormatError(
            f"{first.folder} and {second.folder} belong to different charts ({differs}), expected the same chart.json; "
            "give two LUTs or sessions of one chart"
        )
    pairs = light_pairs(first.illuminations, second.illuminations)
    if not pairs:
        raise FormatError(
            f"{first.folder}, {second.folder}: 0 common illuminants, expected at least 1; give LUTs of one "
            "illuminations.csv"
        )
    cells, cell_score = _compare_cells(first, second, pairs, progress)
    lights = _compare_lights(first, second, pairs, cell_score)
    answers = _colour_answer(lights), _brightness_answer(lights), _cells_answer(lights, cells)
    folders = folders or (first.folder, second.folder)
    return TableComparison(folders, _comparison_warnings(first, second, len(pairs)), lights, cells, answers)


@contextmanager
def table_of(folder: Path, progress: Callable[[int, int, str], None] | None = None) -> Generator[Lut]:
    """Yield the LUT in a folder, or build the LUT of the session in it.

    The LUT of a session is built in a temporary folder next to the session. For 707 illuminants, it needs 3.5 GB.
    """
    if not (folder / JOURNAL_FILE).is_file():
        yield open_lut(folder)
        return
    hidden_folder = tempfile.TemporaryDirectory(prefix=f".{folder.name}.compared.", dir=folder.resolve().parent)
    with hidden_folder as lut_folder, Session.open(folder) as session:
        lut = Path(lut_folder) / "table"
        try:
            build(session, lut, progress)
        finally:
            # `acquire run --retake bad` finds the report of a refused LUT next to the session.
            refused_report = refused_folder(lut) / REPORT_JSON
            if refused_report.is_file():
                write_atomic(refused_folder(folder.resolve()) / REPORT_JSON, refused_report.read_bytes())
        yield open_lut(lut)


def chart_of(folders: Sequence[Path]) -> Chart | None:
    """Return the chart of the first session among the folders; None if all are LUTs, which do not contain it."""
    charts = (folder / "chart.json" for folder in folders if (folder / JOURNAL_FILE).is_file())
    return next((load_chart(path) for path in charts if path.is_file()), None)


def light_pairs(first: Sequence[Illuminant], second: Sequence[Illuminant]) -> list[tuple[int, int]]:
    """Return the index pairs of illuminants with the same kind, temperature, codes and name, in the order of the first.

    Repeated illuminants are paired in their order.
    """
    waiting: dict[Illuminant, list[int]] = {}
    for light in reversed(second):
        waiting.setdefault(replace(light, index=0), []).append(light.index)
    return [(light.index, indices.pop()) for light in first if (indices := waiting.get(replace(light, index=0)))]


def _comparison_warnings(first: Lut, second: Lut, common: int) -> tuple[str, ...]:
    a, b = first.provenance, second.provenance
    a_only, b_only = len(first.white) - common, len(second.white) - common
    same_frames = a.session_sha256 == b.session_sha256 and a.computed is None
    warnings = {
        f"two cameras, {a.camera} and {b.camera}: differences are expected": a.camera != b.camera,
        f"{common} common illuminants are compared; {a_only} are only in A, {b_only} only in B": bool(a_only or b_only),
        "both LUTs were built from the same frames: their noise is identical, so agreement proves nothing": same_frames,
    }
    return tuple(warning for warning, applies in warnings.items() if applies)


def differing_lights(lights: LightDifferences) -> _Numbers:
    """Return (K,) int64 indices in A of the illuminants with another colour, in their order."""
    return lights.one[_is_significant(lights.angle_p) & (lights.angle_deg > ANGLE_FLOOR_DEG)]


def differing_cells(cells: CellDifferences) -> _Numbers:
    """Return (K,) int64 indices of colours with significant mean differences over the illuminants, the worst first."""
    deviation = np.abs(cells.mean - cells.offset)
    differing = np.flatnonzero(((deviation > CELL_SIGMAS * cells.noise) & (deviation > CELL_FLOOR)).any(axis=1))
    return differing[np.argsort(-np.nan_to_num(deviation[differing]).max(axis=1))]


def _is_significant(chances: _Array) -> npt.NDArray[np.bool_]:
    # Bonferroni correction: `MAX_CHANCE` is the probability for all illuminants together.
    return chances < MAX_CHANCE / len(chances)


def _answer(name: str, text: str, *faults: str) -> NoiseAnswer:
    return NoiseAnswer(name, not any(faults), "; ".join(filter(None, (text, *faults))))


def _listed(numbers: _Numbers, description: str, noun: str = "illuminant", plural: str | None = None) -> str:
    return f"{counted(len(numbers), noun, plural)} {description}: {first_few(numbers.tolist())}" if len(numbers) else ""


def _colour_answer(lights: LightDifferences) -> NoiseAnswer:
    text = f"angle between whites {np.median(lights.angle_deg):.4f}° (median), {lights.angle_deg.max():.4f}° (maximum)"
    return _answer("colour of illuminants", text, _listed(differing_lights(lights), "beyond noise"))


def _brightness_answer(lights: LightDifferences) -> NoiseAnswer:
    brightness = lights.brightness
    # The bootstrap needs at least two values.
    data = (np.resize(brightness, max(len(brightness), 2)),)
    bootstrap = stats.bootstrap(data, np.median, n_resamples=999, method="percentile", rng=0)
    low, high = bootstrap.confidence_interval
    text = (
        f"{100 * np.median(brightness):+.3f} % median (95 % interval {100 * low:+.3f} to {100 * high:+.3f} %), "
        f"{100 * brightness.min():+.3f} to {100 * brightness.max():+.3f} % over all illuminants"
    )
    differing = _is_significant(lights.brightness_p) & (np.abs(brightness) > BRIGHTNESS_FLOOR)
    return _answer("brightness of illuminants", text, _listed(lights.one[differing], "beyond noise"))


def _cells_answer(lights: LightDifferences, cells: CellDifferences) -> NoiseAnswer:
    differing = lights.one[lights.cell_score > LIGHT_SCORE]
    return _answer(
        "cells",
        f"{100 * cells.rms:.3f} % RMS, expected from noise {100 * cells.rms_by_noise:.3f} %",
        f"{cells.score:.3f} times the noise" if cells.score > CELL_SCORE else "",
        _listed(differing, f"beyond {LIGHT_SCORE:g} times the noise"),
        _listed(differing_cells(cells), "with differences under all illuminants", "patch", "patches"),
    )


def _compare_cells(
    first: Lut, second: Lut, pairs: Sequence[tuple[int, int]], progress: LightProgress
) -> tuple[CellDifferences, _Array]:
    """Return the differences of the patches, and their RMS (L,) float64 by illuminant, in units of noise."""
    unfit = sorted({cell.colour for table in (first, second) for cell in table.provenance.unfit})
    # A difference divided by its estimated error follows Student's t distribution, which is wider than the normal one.
    # The numbers of samples determine its degrees of freedom (Welch-Satterthwaite).
    sizes = np.array([first.samples.shape[2], second.samples.shape[2]], dtype=np.float64)
    widening = stats.t((1 / sizes).sum() ** 2 / (1 / sizes**2 / (sizes - 1)).sum()).std()

    def work(pair: tuple[int, int]) -> tuple[_Array, _Array]:
        (a, a_noise), (b, b_noise) = _relative_means(first, pair[0]), _relative_means(second, pair[1])
        share = b / a - 1
        share[unfit] = np.nan
        return share, a_noise + b_noise

    # Sums over the illuminants: count, difference, and squares of difference, noise and score.
    sums = np.zeros((5, first.samples.shape[1], 3))
    scores = np.empty(len(pairs))
    for number, (share, noise) in enumerate(ordered_map(work, pairs, processor_count())):
        is_known = np.isfinite(share)
        terms = np.stack([is_known, share, share**2, noise, share**2 / noise / widening**2])
        scores[number] = np.sqrt(terms[4, is_known].mean()) if is_known.any() else np.nan
        sums += np.where(is_known, terms, 0.0)
        progress(number + 1, len(pairs))
    count, total = sums[0], sums[0].sum()
    if not total:
        raise FormatError(
            f"0 patches exceed {MIN_COUNTS:g} counts in both LUTs, expected some; compare longer exposures"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, error = sums[1] / count, np.sqrt(sums[3]) / count
        offset = sums[1].sum(axis=0) / count.sum(axis=0)
    rms, rms_by_noise, score = np.sqrt(sums[2:].sum(axis=(1, 2)) / total).tolist()
    return CellDifferences(count.astype(np.int64), mean, error, offset, rms, rms_by_noise, score), scores


def _relative_means(lut: Lut, light: int) -> tuple[_Array, _Array]:
    """Return patch means relative to white, and their relative variances; NaN if too dark."""
    lut.require_unchanged(light)
    samples = np.asarray(lut.samples[light])
    means, scatter = np.empty((len(samples), 3)), np.empty((len(samples), 3))
    moments(samples, means, scatter)
    means[means <= MIN_COUNTS] = np.nan
    # Rounding to integers gives a variance of 1/12.
    return means / lut.white[light], np.maximum(scatter, 1 / 12) / samples.shape[1] / means**2


def _compare_lights(first: Lut, second: Lut, pairs: Sequence[tuple[int, int]], cell_score: _Array) -> LightDifferences:
    numbers = np.array(pairs, dtype=np.int64).T
    whites = np.stack([first.white[numbers[0]], second.white[numbers[1]]])
    errors = ERROR_FACTOR * np.stack([white_errors(first)[numbers[0]], white_errors(second)[numbers[1]]])
    # The logarithms of the channels' ratios have normal errors. Their weighted mean is the difference of brightness.
    # The deviations from this mean are the difference of colour, a χ² with two degrees of freedom. A channel below its
    # own error has almost no weight.
    positive_whites = np.maximum(whites, errors)
    ratio = np.log(positive_whites[1] / positive_whites[0])
    weight = 1 / ((errors / positive_whites) ** 2).sum(axis=0)
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
    """Return the standard errors (L, 3) float64 of a LUT's whites from `references.csv`."""
    path = lut.folder / REFERENCES
    errors = np.zeros(lut.white.shape)
    try:
        for row in csv.DictReader(path.read_text("utf-8").splitlines()):
            if row["name"] == "white":
                errors[int(row["light"])] = [float(row[name]) for name in ("r_error", "g_error", "b_error")]
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise FormatError(f"{path} cannot be used: {error}; build the LUT again") from error
    if not (errors > 0).all():
        raise FormatError(f"{path} lacks the standard error of a white; build the LUT again")
    return errors
