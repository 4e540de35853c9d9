"""The frames of a table: each is read once and measured, with what holds for all of them, and taken in.

- Cells are in the order of colour indices, not in the chart's own; references follow them, the white ones first.
- A frame is measured with the baseline, the frame registered last, and the dark light (that of the last dark frame, or
  of the first for frames before it), and with nothing else, so that any thread may measure it in any order. Measured
  before its turn, it counts only if the frame registered last is still the same.
- Frames enter in the order taken. What one adds depends on those before it alone, so that a build that was stopped goes
  on to the same bits.

C cells of S samples, W white references, N grey references; places on the print in millimetres, in frames in half-size
pixels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from calibration.checks.frame_consistency import ConsistencyCheck
from calibration.measurements import FrameMeasurements
from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    DarkLightEstimate,
    DarkSummary,
    HotPixels,
    dark_summary,
    measure_dark_frame,
    median_noise,
    reflectances,
    winsorised_means,
)
from calibration.radiometry.primaries import Primaries
from calibration.radiometry.superposition import Superposition
from calibration.registration.register import MAX_PLACE_ERROR_PX, Registration, register
from calibration.sampling import (
    WINDOW,
    WINDOWS,
    PhotonTransfer,
    Sites,
    gather,
    gather_means,
    gather_values,
    has_dead_photosite,
    patch_means,
    sample_noise,
    sites_at,
    table_values,
    unevenness,
)
from calibration.spread.added_light import MOST_ADDED, AddedLight, added_light
from calibration.spread.correction import FrameCorrection, LensCorrection
from calibration.spread.surroundings import FrameLevels
from calibration.table.lut import Unfit
from drivers.raw.rawfile import (
    CHANNELS,
    CLIPPING_SHARE,
    Channel,
    Mosaic,
    Plane,
    decode_raw,
    filled_fault,
    frame_black,
    strongest_channel,
)
from drivers.raw.storage import Area
from experiment.chart.model import Chart, Reference
from experiment.config import CitationSettings
from experiment.framing.field import Corners
from experiment.framing.pictures import REREGISTER_PX, STILL_PX, Shift, gauges_of, shift_between
from experiment.measures.paper import Paper, PaperReader
from experiment.measures.stains import Stains, find_stains
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import FormatError, InputError, RegistrationError
from foundation.files import read_whole
from foundation.records import from_plain, to_plain
from foundation.robust import MAD_TO_SIGMA

_BRIGHTEST_PERCENTILE = 99.5
"""Of the cells' levels, what is taken for paper white: the brightest of all may be a reflection."""

_Array = npt.NDArray[np.float64]
_Arrays = dict[str, npt.NDArray[Any]]

_TAKEN_AGAIN = "or take it again: acquire run LAB.toml SESSION finds such frames by itself"

_LEAST_BITS = 3
"""Bits of a channel from which on neighbours in colour predict a cell."""


@dataclass(frozen=True)
class BuildOptions:
    """How a table is built; by default 25 samples, the paper's, from which black and the lens's spread are subtracted.

    - `window`: pixels along the side of a cell's window: one of `calibration.sampling.WINDOWS`.
    - `subtract_dark`: whether the light of the dark frames is subtracted from samples and ground truth.
    - `corners`: four corners (x, y) of the field of cells in the frame that is registered first, half-size px,
      clockwise from the printed top-left, for a chart without tags; None to have it found.
    - `correct_drift`: whether the lamp's drift between white frames is taken out of samples and ground truth at the
      end.
    - `lens_correction`: whether what the lens spreads beside its sharp core is subtracted from samples and ground
      truth, where the print proves that it does.
    - `citation`: what the lab states of the table's origin; None for what the session's settings state. No sample
      depends on it.
    """

    window: int = WINDOW
    subtract_dark: bool = False
    corners: Corners | None = None
    correct_drift: bool = False
    lens_correction: bool = True
    citation: CitationSettings | None = None

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise InputError(
                f"a window of {self.window} pixels was asked for; {', '.join(map(str, WINDOWS[:-1]))} or {WINDOWS[-1]} "
                "expected: a window has a middle pixel, and cells are about 10 pixels wide"
            )

    @property
    def samples(self) -> int:
        """Samples of each cell."""
        return self.window**2


PAPER_OPTIONS = BuildOptions()
"""The paper's options, which hold where none are given."""

_OUTLIER_SIGMAS = 6.0
"""Robust standard deviations from the median beyond which a patch is covered or dirty."""

_FEW_PATCHES = 4
"""Patches up to which none is left out: of so few, none is surely the one that is wrong."""


@dataclass(frozen=True, eq=False)
class GreyLevels:
    """The printed levels of grey of a chart.

    - `names`: one for each level, brightest first.
    - `level`: (N,) int64, the level of each grey reference.
    """

    names: tuple[str, ...]
    level: npt.NDArray[np.int64]

    @classmethod
    def of(cls, references: Sequence[Reference]) -> GreyLevels:
        """Return the levels among references, one for each printed code."""
        codes = sorted({reference.rgb for reference in references}, reverse=True)
        first = {reference.rgb: reference.name for reference in reversed(references)}
        return cls(
            tuple(first[code] for code in codes),
            np.array([codes.index(reference.rgb) for reference in references], dtype=np.int64),
        )

    def read(self, seen: _Array, field: _Array) -> tuple[_Array, _Array]:
        """Return the value and standard error (G, 3) float64 of each level, counts, NaN where no patch can be used.

        `seen`: (N, 3) mean counts above black of each patch, NaN where it cannot be used. `field`: (N, 3) the field at
        each patch.
        """
        flat = seen / field
        value, error = np.full((len(self.names), 3), np.nan), np.full((len(self.names), 3), np.nan)
        for number in range(len(self.names)):
            patches = flat[self.level == number]
            patches = patches[np.isfinite(patches).all(axis=1)]
            if len(patches) == 0:
                continue
            middle = np.median(patches, axis=0)
            scale = MAD_TO_SIGMA * np.median(np.abs(patches - middle), axis=0) + 1e-9
            near = (np.abs(patches - middle) < _OUTLIER_SIGMAS * scale).all(axis=1)
            kept = patches[near] if len(patches) > _FEW_PATCHES else patches
            value[number] = kept.mean(axis=0)
            error[number] = kept.std(axis=0, ddof=1) / np.sqrt(len(kept)) if len(kept) > 1 else np.nan
        return value, error


@dataclass(frozen=True, eq=False)
class ChartPoints:
    """The points of a chart that are sampled.

    - `cells_mm`: (C, 2) float64 mm, centres of the cells in the order of colour indices.
    - `whites_mm`, `greys_mm`: (W, 2) and (N, 2) float64 mm, centres of the white and of the grey references.
    """

    cells_mm: _Array
    whites_mm: _Array
    greys_mm: _Array
    levels: GreyLevels

    @staticmethod
    def of(chart: Chart) -> ChartPoints:
        """Return the points of a chart."""
        whites = [reference for reference in chart.references if reference.is_white]
        greys = [reference for reference in chart.references if not reference.is_white]
        whites_mm, greys_mm = (
            np.array([reference.centre_mm for reference in references]).reshape(-1, 2) for references in (whites, greys)
        )
        return ChartPoints(chart.centres_mm[chart.cell_of_colour], whites_mm, greys_mm, GreyLevels.of(greys))

    @property
    def references_mm(self) -> _Array:
        """(W + N, 2) float64 mm, centres of the references."""
        return np.concatenate([self.whites_mm, self.greys_mm])


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame in which the chart was registered; it holds for those after it until the chart moves too far.

    - `gauges`: the frame around its tags, or the outline of its field, to measure movements against.
    - `lens`: corrects frames sampled at these places for what the lens spreads; None where nothing is corrected.
    """

    file: str
    registration: Registration
    cells: Sites
    references: Sites
    gauges: dict[Channel, Plane]
    lens: FrameCorrection | None = None


def register_frame(
    decoded: DecodedFrame, chart: Chart, points: ChartPoints, options: BuildOptions, near: Registration | None = None
) -> RegisteredFrame:
    """Return a frame with the chart registered in it."""
    registration = register(decoded.mosaic, chart, decoded.record.file, options.corners, near)
    cells, references = sites_of(registration, points, decoded.mosaic.block_planes().shape[2:], options.window)
    gauges: dict[Channel, Plane] = {
        channel: gauges_of(decoded.mosaic, channel, decoded.black, registration.framing) for channel in CHANNELS
    }
    return RegisteredFrame(decoded.record.file, registration, cells, references, gauges)


def sites_of(
    registration: Registration, points: ChartPoints, shape: tuple[int, ...], window: int
) -> tuple[Sites, Sites]:
    """Return the sites of the cells and of the references.

    `shape` is rows and columns of the half-size frame, `window` the pixels along a window's side.
    """
    height, width = shape
    cells, references = (
        sites_at(registration.to_pixels(places), (height, width), window)
        for places in (points.cells_mm, points.references_mm)
    )
    return cells, references


SensorLayout = tuple[Area, tuple[int, ...], str]
"""What all frames of a session have in common: visible area, shape of the sensor, Bayer pattern."""


def sensor_layout(mosaic: Mosaic) -> SensorLayout:
    """Return the layout of a frame's sensor."""
    return mosaic.visible, mosaic.sensor.shape, mosaic.pattern


@dataclass(frozen=True, eq=False)
class Baseline:
    """What holds for all frames of a session; made by `baseline_of`.

    - `camera`, `layout`: maker and model, and the sensor's layout, the same in all frames.
    - `whites`: (W, 3) float64 counts above black of its white references; NaN where one cannot be used.
    - `means`: (C + W + N, 3) float64 counts above black of its cells and references.
    - `paper`: reads flat field and white of frames, with the shape of this one's as base.
    - `primaries`: the primaries each alone; None where they were not given or cannot be used.
    - `lens`: what the lens spreads beside its sharp core, measured; None where it was not, or could not be.
    - `superposition`: what the first frame and those of the primaries show of the sensor's linearity; None where one of
      them is lacking, or the chart has moved in it.
    """

    chart: Chart
    points: ChartPoints
    options: BuildOptions
    camera: str
    layout: SensorLayout
    first: RegisteredFrame
    whites: _Array
    means: _Array
    paper: PaperReader
    transfer: PhotonTransfer
    consistency_check: ConsistencyCheck
    primaries: Primaries | None = None
    lens: LensCorrection | None = None
    superposition: Superposition | None = None

    @property
    def levels(self) -> _Array:
        """(C, 3) float64, of each cell in the first frame, bare paper 1."""
        paper, at_cells = self.paper.read(self.whites, self.first.file)
        return self.means[: len(at_cells)] / (at_cells * np.maximum(paper.white, 1e-9))

    def require_layout(self, mosaic: Mosaic, what: str) -> None:
        """Refuse a frame, called `what`, whose sensor or setting is not that of the first."""
        found = sensor_layout(mosaic)
        if found != self.layout:
            has, had = (f"{shape[1]}×{shape[0]} photosites {pattern}" for _, shape, pattern in (found, self.layout))
            raise FormatError(
                f"{what}: the sensor has {has}, that of {self.first.file} {had}; a session has one camera with one "
                "setting, so take the session anew"
            )

    def register(self, decoded: DecodedFrame) -> RegisteredFrame:
        """Return a later frame with the chart registered in it; errors are those of `register_frame`."""
        # A chart without tags hangs as in the first frame, so that a build that goes on has it the same way up.
        registered = register_frame(decoded, self.chart, self.points, self.options, self.first.registration)
        lens = self.correction(registered.registration, registered.cells, registered.references)
        return replace(registered, lens=lens)

    def correction(self, registration: Registration, cells: Sites, references: Sites) -> FrameCorrection | None:
        """Return what corrects the lens in frames that are sampled at these places; None where nothing is corrected."""
        if self.lens is None or not self.corrects_lens:
            return None
        return self.lens.of(registration, cells, references)

    @property
    def corrects_lens(self) -> bool:
        """Whether frames are corrected for what the lens spreads."""
        return self.lens is not None and self.options.lens_correction and self.lens.spread.proven

    def movement(self, mosaic: Mosaic, black: _Array, channel: Channel, what: str) -> Shift:
        """Return how far the chart has moved in a frame since the first one.

        `black`: (2, 2) float64 counts.
        """
        self.require_layout(mosaic, what)
        framing = self.first.registration.framing
        return shift_between(self.first.gauges[channel], framing, gauges_of(mosaic, channel, black, framing))

    def patches(self, mosaic: Mosaic, black: _Array) -> tuple[_Array, npt.NDArray[np.uint16]]:
        """Return what a frame has where cells and references were in the first one.

        `black`: (2, 2) float64 counts. Returns (C + W + N, 3) float64 counts above black; NaN where a patch does not
        lie in the frame. Returns (C + W + N,) uint16, the highest raw count of each patch.
        """
        means: list[_Array] = []
        peaks: list[npt.NDArray[np.uint16]] = []
        for sites in (self.first.cells, self.first.references):
            samples, highest = gather(mosaic, black, sites)
            means.append(np.where(sites.inside[:, None], samples.mean(axis=1, dtype=np.float64), np.nan))
            peaks.append(highest)
        return np.concatenate(means), np.concatenate(peaks)

    def added_light(self) -> AddedLight:
        """Return the light that lies on parts of the print in the first frame, whatever is printed there."""
        count = len(self.points.cells_mm)
        if self.chart.bits < _LEAST_BITS:
            return AddedLight.none(count)
        paper, _ = self.paper.read(self.whites, self.first.file)
        white = np.maximum(paper.white, 1e-9)
        noise = self.transfer.variance(self.levels * white) / self.options.samples / white**2
        usable = compared_cells(self.chart, self.first)
        with threadpool_limits(limits=1, user_api="blas"):
            return added_light(self.levels, noise, usable, self.points.cells_mm, self.chart.page_mm, self.chart.bits)

    def reflectances(self) -> _Array:
        """Return the reflectance (C + W + N, 3) float64 of cells and references in the first frame, bare paper 1."""
        paper, shape = self.paper.read(self.whites, self.first.file)
        field = np.concatenate([shape, paper.field.at(self.points.references_mm)])
        return reflectances(self.means, field, paper.white)


def beyond_print(decoded: DecodedFrame, beyond: Sites) -> _Array:
    """Return the mean (3,) float64 counts above black of what lies behind the print; 0 where it is not seen."""
    if not len(beyond.rows):
        return np.zeros(3)
    return gather_means(decoded.mosaic, decoded.black, beyond).mean(axis=0)


def compared_cells(chart: Chart, registered: RegisteredFrame) -> npt.NDArray[np.bool_]:
    """Return which cells (C,) are inside the frame and look like the chart's."""
    return registered.cells.inside & ~registered.registration.mismatched_cells[chart.cell_of_colour]


def usable_means(
    samples: npt.NDArray[np.float32], highest: npt.NDArray[np.uint16], sites: Sites, saturation: int
) -> _Array:
    """Return the means (N, 3) float64, counts above black, of patches; NaN where one is cut off or clipped.

    `samples`: (N, S, 3) float32 counts above black. `highest`: (N,) uint16, the highest raw count of each patch.
    `saturation`: raw count of saturation.
    """
    means = samples.mean(axis=1, dtype=np.float64)
    means[~(sites.inside & (highest < CLIPPING_SHARE * saturation))] = np.nan
    return means


class ChangedFrame(FormatError):
    """A frame's file is gone, or is not what was taken; the next run of the session takes it again by itself."""


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """A frame as read.

    - `black`: (2, 2) float64 counts, black level of each position of the block.
    - `strongest`: the channel with the brightest paper.
    - `saturation`: raw count of saturation, as far as it can be seen in this frame.
    """

    record: FrameRecord
    mosaic: Mosaic
    black: _Array
    strongest: Channel
    saturation: int


@dataclass(frozen=True, eq=False)
class SelectedFrames:
    """The frames that a table is made of.

    - `records`: every light's last accepted frame, and the accepted white and dark ones, in the order taken.
    - `primaries`: the frames of red, green and blue alone; () where one of the three is lacking.
    - `more_whites`: of a chart of few colours, further frames of the light in which it is registered.
    """

    records: tuple[FrameRecord, ...]
    lights_without: tuple[int, ...]
    registered: FrameRecord
    primaries: tuple[FrameRecord, ...]
    more_whites: tuple[FrameRecord, ...]

    @property
    def newest(self) -> FrameRecord:
        """The frame that was taken last, dark ones apart."""
        return max(self._lit, key=lambda record: record.attempt)

    @property
    def _lit(self) -> Iterator[FrameRecord]:
        return (record for record in self.records if record.kind != "dark")

    def is_even(self, record: FrameRecord) -> bool:
        """Return whether a frame's samples show how even cells are: the white ones, or the first with any light.

        A file counts once, whatever it stands for: its noise is the same each time, and would not average out.
        """
        first = next((one for one in self.records if one.kind == "white" and one.sha256 == record.sha256), None)
        return record == first or record is next(self._lit)


def decode_frame(session: Session, record: FrameRecord) -> DecodedFrame:
    """Return a frame as read from its file, whose SHA-256 is checked first."""
    path = session.folder / record.file
    try:
        data = read_whole(path)
    except FileNotFoundError as error:
        raise ChangedFrame(
            f"{path} is missing, but the session's journal counts it; restore the file from a copy, {_TAKEN_AGAIN}"
        ) from error
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise ChangedFrame(
            f"{path} is not the file that was taken: its SHA-256 is {found[:16]}…, the journal says "
            f"{record.sha256[:16]}…; restore the file from a copy, {_TAKEN_AGAIN}"
        )
    mosaic = decode_raw(data, path, known_whole=True)
    fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    if fault is not None:
        raise FormatError(
            f"{path} is no whole frame: {fault}; restore the file from a copy, or take it again: acquire run LAB.toml "
            "SESSION --retake with the number of its light"
        )
    black = frame_black(mosaic)
    return DecodedFrame(record, mosaic, black, strongest_channel(mosaic, black), mosaic.saturation())


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """A light or white frame as measured; C cells of S samples.

    - `registered`: the frame registered last, with which it was measured.
    - `values`: (C, S, 3) uint16, the table's samples.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `inside`: (C,) bool, whether all pixels of a cell lie in the frame.
    - `samples`, `noise`: (C, S, 3) float32 counts above black and (C, 3) float64 counts, their noise; None where not
      asked for.
    """

    figures: FrameMeasurements
    registered: RegisteredFrame
    saturation: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    inside: npt.NDArray[np.bool_]
    samples: npt.NDArray[np.float32] | None
    noise: _Array | None


@dataclass(frozen=True, eq=False)
class MeasuredDarkFrame:
    """A dark frame as measured; C cells of S samples.

    - `registered`: the frame registered last, with which it was measured.
    - `excess`: (C, S, 3) int16 counts, how far samples stand above their cells.
    - `means`: (C + W + N, 3) float64 counts above black of cells, then references.
    """

    figures: DarkFrameFigures
    registered: RegisteredFrame
    excess: npt.NDArray[np.int16]
    means: _Array


def measure_frame(
    baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame, keep_samples: bool, dark: DarkLight | None
) -> MeasuredFrame | Shift:
    """Return what a frame shows; its movement alone, if that is such that the chart has to be registered again.

    `dark`: what is subtracted from samples and references; nothing if None.
    """
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    channel, framing = decoded.strongest, registered.registration.framing
    gauges = gauges_of(decoded.mosaic, channel, decoded.black, framing)
    shift = shift_between(registered.gauges[channel], framing, gauges)
    # A turn or a change of distance moves the tags differently; moving the grid along would not help.
    turned = shift.largest_px > shift.length_px + STILL_PX
    if shift.gauges == 0 or shift.length_px > REREGISTER_PX or turned:
        return shift
    at = registered
    if shift.length_px > STILL_PX:
        moved = registered.registration.shifted(shift.dx, shift.dy)
        shape = decoded.mosaic.block_planes().shape[2:]
        cells, references = sites_of(moved, baseline.points, shape, baseline.options.window)
        lens = baseline.correction(moved, cells, references)
        at = replace(registered, cells=cells, references=references, lens=lens)
    return replace(measure_at(baseline, decoded, at, shift, False, keep_samples, dark), registered=registered)


def sample_dark_frame(baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame) -> MeasuredDarkFrame:
    """Return what a dark frame shows; no tag is seen in it, so the chart is assumed to lie where it did."""
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    cells, _ = gather(decoded.mosaic, decoded.black, registered.cells)
    references, _ = gather(decoded.mosaic, decoded.black, registered.references)
    whites_mm = baseline.points.whites_mm
    whites = np.flatnonzero(registered.references.inside[: len(whites_mm)])
    shape = baseline.paper.base.at(whites_mm)[whites]
    figures, excess = measure_dark_frame(decoded.record, decoded.black, cells, references[whites], shape)
    means = np.concatenate([winsorised_means(patches, figures.noise) for patches in (cells, references)])
    return MeasuredDarkFrame(replace(figures, origin=decoded.mosaic.origin), registered, excess, means)


def measure_primaries(baseline: Baseline, frames: Iterable[DecodedFrame]) -> Primaries | None:
    """Return what the frames of red, green and blue alone show; None where there are none or one cannot be used.

    The chart may lie elsewhere in them; `frames` are read once, one at a time.
    """
    lights: list[int] = []
    papers: list[Paper] = []
    cells: list[_Array] = []
    for decoded in frames:
        measured = measure_frame(baseline, decoded, baseline.first, keep_samples=False, dark=None)
        if isinstance(measured, Shift):
            try:
                registered = baseline.register(decoded)
            except RegistrationError:
                return None
            measured = measure_at(baseline, decoded, registered, measured, reregistered=True, keep_samples=False)
        light = decoded.record.illumination
        assert light is not None
        lights.append(light)
        papers.append(measured.figures.paper)
        cells.append(patch_means(measured.values))
    return Primaries.of(lights, papers, cells, baseline.points.cells_mm) if lights else None


def movement_of(baseline: Baseline, before: RegisteredFrame, after: RegisteredFrame) -> Shift:
    """Return how far the cells have moved from one registered frame to another, however far that is."""
    cells_mm = baseline.points.cells_mm
    by = after.registration.to_pixels(cells_mm) - before.registration.to_pixels(cells_mm)
    dx, dy = np.median(by, axis=0).tolist()
    return Shift(dx, dy, float(np.linalg.norm(by, axis=1).max()), len(by))


def measure_at(
    baseline: Baseline,
    decoded: DecodedFrame,
    at: RegisteredFrame,
    shift: Shift,
    reregistered: bool,
    keep_samples: bool,
    dark: DarkLight | None = None,
) -> MeasuredFrame:
    """Return what a frame shows that is sampled `at` these places, `shift` px from the frame registered before.

    `reregistered`: whether the chart was registered in this frame, whose blur is then its own. `dark`: as for
    `measure_frame`. The result's `registered` is `at`.
    """
    points = baseline.points
    samples, highest = gather(decoded.mosaic, decoded.black, at.references)
    seen = usable_means(samples, highest, at.references, decoded.saturation)
    to_subtract = _to_subtract(decoded, at, samples, dark)
    of_cells = None
    if to_subtract is not None:
        of_cells, of_references = np.split(to_subtract, [len(points.cells_mm)])
        seen -= of_references
    whites, greys = np.split(seen, [len(points.whites_mm)])
    paper, shape = baseline.paper.read(whites, decoded.record.file)
    if baseline.primaries is not None:
        shape = shape * baseline.primaries.field_ratio(paper.white)
    grey_values, grey_errors = points.levels.read(greys, paper.field.at(points.greys_mm))
    if keep_samples:
        kept, highest = gather(decoded.mosaic, decoded.black, at.cells)
        values, noise = table_values(kept, shape, of_cells), sample_noise(kept)
        if of_cells is not None and dark is None:
            kept -= of_cells[:, None]
        elif of_cells is not None and dark is not None:
            kept -= (of_cells - dark.patches[: len(of_cells)])[:, None]
    else:
        values, highest = gather_values(decoded.mosaic, decoded.black, at.cells, shape, of_cells)
        kept = noise = None
    # σ of the registered frame's blur, and what the gauges are softer than in it.
    blur_growth_px2 = 0.0 if reregistered else shift.blur_growth_px2
    mean = patch_means(values)
    variance = baseline.transfer.variance(mean) / baseline.options.samples
    figures = FrameMeasurements(
        record=decoded.record,
        black=decoded.black,
        channel=decoded.strongest,
        shift=shift,
        reregistered=reregistered,
        paper=paper,
        consistency=baseline.consistency_check.compare(mean, variance),
        greys=grey_values,
        grey_errors=grey_errors,
        dark=np.zeros(3) if dark is None else dark.paper,
        share_at_zero=1 - int(np.count_nonzero(values)) / values.size,
        blur_px=float(np.sqrt(max(at.registration.blur_px**2 + blur_growth_px2, 0.0))),
        exposure=decoded.mosaic.origin.exposure,
        origin=decoded.mosaic.origin,
    )
    return MeasuredFrame(figures, at, decoded.saturation, values, highest, at.cells.inside, kept, noise)


def _to_subtract(
    decoded: DecodedFrame, at: RegisteredFrame, references: npt.NDArray[np.float32], dark: DarkLight | None
) -> npt.NDArray[np.float32] | None:
    """Return what is subtracted from each patch, (P, 3) float32 counts: dark light, and what the lens added.

    `references` are the references' samples. None where nothing is subtracted.
    """
    if at.lens is None:
        return None if dark is None else dark.patches
    cells = gather_means(decoded.mosaic, decoded.black, at.cells)
    means = np.concatenate([cells, references.mean(axis=1, dtype=np.float64)])
    if dark is not None:
        means -= dark.patches
    added = at.lens.added(FrameLevels(means, beyond_print(decoded, at.lens.beyond))).astype(np.float32)
    return added if dark is None else added + dark.patches


_Figures = tuple[FrameMeasurements | DarkFrameFigures, ...]

EarlyMeasurement = MeasuredFrame | MeasuredDarkFrame | None
"""A frame as measured before its turn; None where the chart has to be registered again in it."""


@dataclass(frozen=True, eq=False)
class Accumulator:
    """What the frames of a session that were taken in so far have given; each frame makes a new one.

    - `saturation`: raw count of saturation, the lowest that a frame shows.
    - `dark`: what is subtracted from the frames that follow; None where nothing is.
    - `estimate`: of the dark light; only dark frames that are subtracted enter it.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `highest_at`: (C,) int64, the light under which it was reached; −1 for a white frame.
    - `outside`: (C,) bool, whether a cell was cut off in a frame.
    - `covered`: (C,) bool, whether a cell did not look like the chart's in a frame in which the chart was registered.
    - `place_error`: (C,) float64 half-size px, what a cell's place may be off by, the worst of the frames in
      which the chart was registered; over the clearance of its samples (`Registration.clearance`).
    - `even_sum`: (C, S, 3) float32, sum of the frames of even light, counts above black.
    - `even_noise2`: (C, 3) float64, sum of the variances of one sample in these frames, counts².
    """

    session: Session
    selected: SelectedFrames
    baseline: Baseline
    figures: _Figures
    saturation: int
    registered: RegisteredFrame
    dark: DarkLight | None
    estimate: DarkLightEstimate
    hot: HotPixels
    highest: npt.NDArray[np.uint16]
    highest_at: npt.NDArray[np.int64]
    outside: npt.NDArray[np.bool_]
    covered: npt.NDArray[np.bool_]
    place_error: _Array
    even_sum: npt.NDArray[np.float32]
    even_noise2: _Array
    even_frames: int

    @staticmethod
    def empty(session: Session, selected: SelectedFrames, baseline: Baseline, saturation: int) -> Accumulator:
        """Return what there is before any frame; `saturation` is the raw count that the first registered frame shows.

        The dark light that frames before the first dark one get is that one's, which is read for it.
        """
        count, samples, first = baseline.chart.colour_count, baseline.options.samples, baseline.first
        inside = np.concatenate([first.cells.inside, first.references.inside])
        found = Accumulator(
            session=session,
            selected=selected,
            baseline=baseline,
            figures=(),
            saturation=saturation,
            registered=first,
            dark=None,
            estimate=DarkLightEstimate.none(baseline.reflectances(), inside, samples),
            hot=HotPixels.none(count, samples),
            highest=np.zeros(count, dtype=np.uint16),
            highest_at=np.zeros(count, dtype=np.int64),
            outside=np.zeros(count, dtype=np.bool_),
            covered=_covered_cells(baseline, first),
            place_error=first.registration.expanded_px(baseline.points.cells_mm),
            even_sum=np.zeros((count, samples, 3), dtype=np.float32),
            even_noise2=np.zeros((count, 3)),
            even_frames=0,
        )
        if not baseline.options.subtract_dark:
            return found
        record = next(record for record in selected.records if record.kind == "dark")
        measured = sample_dark_frame(baseline, decode_frame(session, record), first)
        return replace(found, dark=found._learned(measured).dark)

    @cached_property
    def frames(self) -> tuple[FrameMeasurements, ...]:
        """Figures of the light and white frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, FrameMeasurements))

    @property
    def darks(self) -> tuple[DarkFrameFigures, ...]:
        """Figures of the dark frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, DarkFrameFigures))

    @property
    def records(self) -> list[FrameRecord]:
        """The frames taken in."""
        return [figures.record for figures in self.figures]

    def others_wait_for(self, record: FrameRecord) -> bool:
        """Return whether the frames after this one can be measured only when it has been taken in."""
        return self.baseline.options.subtract_dark and record.kind == "dark"

    def measure(self, record: FrameRecord) -> EarlyMeasurement:
        """Return what a frame shows now; None where the chart has to be registered again. Thread-safe."""
        decoded = decode_frame(self.session, record)
        if record.kind == "dark":
            return sample_dark_frame(self.baseline, decoded, self.registered)
        even = self.selected.is_even(record)
        measured = measure_frame(self.baseline, decoded, self.registered, even, self.dark)
        return None if isinstance(measured, Shift) else measured

    def with_next(
        self, record: FrameRecord, early: EarlyMeasurement
    ) -> tuple[Accumulator, MeasuredFrame | MeasuredDarkFrame]:
        """Return what there is after the next frame, and that frame as measured."""
        current = early is not None and early.registered is self.registered
        measured, before = early if current else self.measure(record), self
        if measured is None:
            before, measured = self._registered_again(record)
        if isinstance(measured, MeasuredDarkFrame):
            return before.with_dark_frame(measured), measured
        return before.with_frame(measured), measured

    def with_frame(self, measured: MeasuredFrame) -> Accumulator:
        """Return what there is after a light or white frame."""
        light = measured.figures.record.illumination
        brighter = measured.highest > self.highest
        after = replace(
            self,
            figures=(*self.figures, measured.figures),
            saturation=min(self.saturation, measured.saturation),
            highest=np.where(brighter, measured.highest, self.highest),
            highest_at=np.where(brighter, -1 if light is None else light, self.highest_at),
            outside=self.outside | ~measured.inside,
        )
        if measured.samples is None or measured.noise is None:
            return after
        return replace(
            after,
            even_sum=self.even_sum + measured.samples,
            even_noise2=self.even_noise2 + measured.noise**2,
            even_frames=self.even_frames + 1,
        )

    def with_dark_frame(self, measured: MeasuredDarkFrame) -> Accumulator:
        """Return what there is after a dark frame."""
        after = replace(self, figures=(*self.figures, measured.figures), hot=self.hot.with_frame(measured.excess))
        return after._learned(measured) if self.baseline.options.subtract_dark else after  # noqa: SLF001 - its own class

    def _registered_again(self, record: FrameRecord) -> tuple[Accumulator, MeasuredFrame]:
        """Return what there is once the chart is registered in this frame, and what the frame shows."""
        decoded = decode_frame(self.session, record)
        registered = self.baseline.register(decoded)
        shift = movement_of(self.baseline, self.registered, registered)
        even = self.selected.is_even(record)
        measured = measure_at(self.baseline, decoded, registered, shift, True, even, self.dark)
        after = replace(
            self,
            registered=registered,
            estimate=self.estimate.restarted(),
            hot=self.hot.restarted(median_noise(self.darks)),
            covered=self.covered | _covered_cells(self.baseline, registered),
            place_error=np.maximum(
                self.place_error, registered.registration.expanded_px(self.baseline.points.cells_mm)
            ),
        )
        return after, measured

    def _learned(self, measured: MeasuredDarkFrame) -> Accumulator:
        """Return what there is with a dark frame taken into the estimate of what is subtracted from those after it."""
        points, reader = self.baseline.points, self.baseline.paper
        means = measured.means[len(points.cells_mm) :][: len(points.whites_mm)]
        inside = measured.registered.references.inside[: len(points.whites_mm), None]
        paper, shape = reader.read(np.where(inside, means, np.nan), measured.figures.record.file)
        field = np.concatenate([shape, paper.field.at(points.references_mm)])
        estimate, dark = self.estimate.with_frame(measured.means, measured.figures.noise, paper, field)
        return replace(self, estimate=estimate, dark=dark)

    def to_json(self) -> dict[str, Any]:
        """Return what a checkpoint stores as text; the rest is `to_arrays`."""
        return {"registered": self.registered.file, "figures": to_plain(self.figures, _Figures)}

    def to_arrays(self) -> _Arrays:
        """Return what a checkpoint stores as arrays, (...) of any dtype, by name: those of this value and its parts."""
        parts = {"": self, "estimate.": self.estimate, "hot.": self.hot, "dark.": self.dark}
        return {prefix + name: each for prefix, part in parts.items() for name, each in _arrays_of(part).items()}

    def restored(self, values: Mapping[str, Any], arrays: _Arrays) -> Accumulator:
        """Return what was stored of a build of the same frames, `arrays` (...) of any dtype; this one is empty."""
        found = from_plain(_Figures, values["figures"], self.session.folder, "begin the build anew")
        figures = tuple(
            replace(each, record=record) for each, record in zip(found, self.selected.records, strict=False)
        )
        registered = self.baseline.first
        if values["registered"] != registered.file:
            record = next(record for record in self.selected.records if record.file == values["registered"])
            registered = self.baseline.register(decode_frame(self.session, record))

        def stored(prefix: str) -> dict[str, Any]:
            named = {name.removeprefix(prefix): each for name, each in arrays.items() if name.startswith(prefix)}
            return {name: each if each.ndim else each.item() for name, each in named.items() if "." not in name}

        dark = stored("dark.")
        return replace(
            self,
            figures=figures,
            registered=registered,
            dark=DarkLight(**dark) if dark else None,
            estimate=replace(self.estimate, **stored("estimate.")),
            hot=replace(self.hot, **stored("hot.")),
            **stored(""),
        )

    def dark_summary(self) -> DarkSummary:
        """Return what the dark frames show."""
        return dark_summary(self.darks, self.hot)

    def noise(self) -> _Array:
        """Return (3,) float64, median standard deviation of one sample in the even frames, of the brightest cells'."""
        frames = max(self.even_frames, 1)
        level = np.percentile(self.even_sum.mean(axis=1) / frames, _BRIGHTEST_PERCENTILE, axis=0)
        return np.sqrt(np.median(self.even_noise2 / frames, axis=0)) / np.maximum(level, 1e-6)

    def stains(self, field: _Array) -> Stains:
        """Return where the print does not have its codes' colours.

        `field` (C, 3) float64 is that of a frame of even light, of each cell's own colour as far as it is known: by the
        field of paper alone, cells of one side would be off where the primaries light the print in different ways.
        """
        cells_mm = self.baseline.points.cells_mm
        level = self.even_sum.mean(axis=1, dtype=np.float64) / max(self.even_frames, 1) / field
        return find_stains(level, cells_mm, self.baseline.chart.bits, ~(self.outside | self.covered))

    def unfit(self, stains: Stains, frames: Sequence[FrameMeasurements], added: AddedLight) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies; `frames`: what is said of them."""
        lit_by_others = added.certain_share_of(self.baseline.levels).max(axis=1)
        disturbed = disturbed_cells(frames)
        lit = [(frame.consistency.alone, frame.record.illumination) for frame in frames]
        alone = {colour: light for cells, light in lit if light is not None for colour in cells}
        even, dark = max(self.even_frames, 1), self.dark_summary()
        hottest = dark.hottest if len(dark.hottest) else np.zeros(self.baseline.chart.colour_count)
        dead = has_dead_photosite(self.even_sum / even)
        uneven = unevenness(self.even_sum / even, np.sqrt(self.even_noise2) / even)
        allowed, samples = CLIPPING_SHARE * self.saturation, self.even_sum.shape[1]
        found: list[Unfit] = []
        for colour in range(self.baseline.chart.colour_count):
            cause = ""
            if self.outside[colour]:
                cause = f"outside: its {samples} pixels do not all lie in the frame"
            elif self.highest[colour] >= allowed:
                light = int(self.highest_at[colour])
                under = f"light {light}" if light >= 0 else "white"
                cause = f"clipped: {int(self.highest[colour])} counts under {under}, below {allowed:.0f} allowed"
            elif self.covered[colour]:
                cause = "covered: it does not look like the chart's (covered, damaged, or printed otherwise)"
            elif self.place_error[colour] > MAX_PLACE_ERROR_PX:
                cause = (
                    f"misplaced: its place is known to {self.place_error[colour]:.2f} px, {MAX_PLACE_ERROR_PX:g} px "
                    "allowed; the print waves there, or little of it is seen"
                )
            elif lit_by_others[colour] > MOST_ADDED:
                cause = (
                    f"lit: {lit_by_others[colour]:.1%} of its level is light that lies on the print there (reflection)"
                )
            elif stains.stained[colour]:
                deviation = stains.deviation_of(colour)
                how = f"{abs(deviation):.1%} {'darker' if deviation < 0 else 'brighter'}"
                cause = f"stained: it is, or its surroundings are, {how} than their codes elsewhere on the print"
            elif hottest[colour] > 0:
                cause = f"hot: a photosite stands out by {hottest[colour]:.0f} counts in every dark frame"
            elif dead[colour]:
                cause = "dead: a photosite sees less than half of the light of its cell"
            elif uneven[colour] > 0:
                cause = f"uneven: rim and middle differ by {uneven[colour]:.1%} under white"
            elif colour in disturbed:
                cause = f"disturbed: {_disturbance(disturbed[colour])}"
            elif colour in alone:
                cause = f"unlike: under light {alone[colour]} it is far from its code, and its neighbours are not"
            if cause:
                found.append(Unfit(colour=colour, cause=cause))
        return tuple(found)


def stored_names() -> list[str]:
    """Return the names that a checkpoint stores; a build does not go on from one that was made with others."""
    parts = (Accumulator, FrameMeasurements, DarkFrameFigures, DarkLight, DarkLightEstimate, HotPixels)
    return [f"{part.__name__}.{field.name}" for part in parts for field in fields(part)]


def disturbed_cells(frames: Sequence[FrameMeasurements]) -> dict[int, list[tuple[int, float]]]:
    """Return the lights under which something covered cells, and how far these are off; by the cells' colours.

    White frames' do not count: a table has no samples of them.
    """
    found: dict[int, list[tuple[int, float]]] = {}
    for frame in frames:
        if frame.record.illumination is not None:
            for colour, off in frame.consistency.disturbed:
                found.setdefault(colour, []).append((frame.record.illumination, off))
    return found


def _disturbance(under: list[tuple[int, float]]) -> str:
    light, off = max(under, key=lambda one: abs(one[1]))
    more = f" and {len(under) - 1} more" if len(under) > 1 else ""
    deviation = f"{abs(off):.1%} {'darker' if off < 0 else 'brighter'} than its code gives"
    how = deviation if off else "too dark to be compared"
    return f"under light {light}{more} it is {how}, next to cells that are far off"


def _covered_cells(baseline: Baseline, registered: RegisteredFrame) -> npt.NDArray[np.bool_]:
    """Return the cells (C,) that do not look like the chart's, alone or with their neighbourhood."""
    registration = registered.registration
    nearest = np.asarray(cKDTree(registration.blocks.centres_mm).query(baseline.points.cells_mm)[1])
    return registration.mismatched_cells[baseline.chart.cell_of_colour] | ~registration.blocks.good[nearest]


def _arrays_of(part: Any) -> _Arrays:
    """Return the arrays and counts of a frozen value by the names of its fields; none of None."""
    values = {} if part is None else {field.name: getattr(part, field.name) for field in fields(part)}
    return {name: np.asarray(value) for name, value in values.items() if isinstance(value, np.ndarray | int)}
