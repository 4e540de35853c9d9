"""Measure one frame in steps: decode, locate, sample, measure. All frames of a LUT share one baseline.

Patches are in the order of colour indices. White references follow them, and grey references are last. A measurement
depends only on the frame, the baseline, the frame registered last and the dark light. The dark light is from the last
dark frame before this frame; if there is none, from the first dark frame. Therefore several threads may measure frames
in any order.

C patches of S samples, W white and N grey references. Positions are in mm on the print, and in half-size px in frames.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from calibration.checks.frame_consistency import ConsistencyCheck
from calibration.measurements import FrameMeasurements
from calibration.pipeline.frames import BuildOptions
from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    measure_dark_frame,
    reflectances,
    winsorised_means,
)
from calibration.radiometry.primaries import Primaries
from calibration.radiometry.superposition import Superposition
from calibration.registration.register import Registration, register
from calibration.sampling import (
    PhotonTransfer,
    Sites,
    gather,
    gather_means,
    gather_values,
    patch_means,
    sample_noise,
    sites_at,
    table_values,
)
from calibration.spread.correction import FrameCorrection, LensCorrection
from calibration.spread.surroundings import FrameLevels
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
from experiment.framing.pictures import REREGISTER_PX, STILL_PX, Shift, gauges_of, shift_between
from experiment.measures.paper import Paper, PaperReader
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import FormatError
from foundation.files import read_buffer
from foundation.robust import MAD_TO_SIGMA

_Array = npt.NDArray[np.float64]
_Samples = npt.NDArray[np.float32]

IN_PLACE = Shift(0.0, 0.0, 0.0, 0)  # No movement

_RETAKE_HINT = "or take it again with acquire run LAB.toml SESSION, which detects such frames"

# Distance from the median, in robust standard deviations, above which a grey reference counts as covered or dirty.
_OUTLIER_SIGMAS = 6.0

_MAX_WITHOUT_OUTLIERS = 4  # With at most this number of grey references, a wrong one cannot be identified


@dataclass(frozen=True, eq=False)
class GreyLevels:
    """The printed levels of grey of a chart."""

    names: tuple[str, ...]  # One per level, brightest first
    level: npt.NDArray[np.int64]  # (N,), level of each grey reference

    @classmethod
    def of(cls, references: Sequence[Reference]) -> GreyLevels:
        """Return the levels of grey references; references with the same printed code have one level."""
        codes = sorted({reference.rgb for reference in references}, reverse=True)
        first = {reference.rgb: reference.name for reference in reversed(references)}
        return cls(
            tuple(first[code] for code in codes),
            np.array([codes.index(reference.rgb) for reference in references], dtype=np.int64),
        )

    def read(self, means: _Array, field: _Array) -> tuple[_Array, _Array]:
        """Return value and standard error of each level, (G, 3) float64 counts; NaN without a usable reference.

        `means`: (N, 3) counts above black of each grey reference, NaN if unusable. `field`: (N, 3) their flat field.
        """
        flat = means / field
        value, error = np.full((len(self.names), 3), np.nan), np.full((len(self.names), 3), np.nan)
        for number in range(len(self.names)):
            counts = flat[self.level == number]
            counts = counts[np.isfinite(counts).all(axis=1)]
            if len(counts) == 0:
                continue
            median = np.median(counts, axis=0)
            sigma = MAD_TO_SIGMA * np.median(np.abs(counts - median), axis=0) + 1e-9
            is_near = (np.abs(counts - median) < _OUTLIER_SIGMAS * sigma).all(axis=1)
            used = counts[is_near] if len(counts) > _MAX_WITHOUT_OUTLIERS else counts
            value[number] = used.mean(axis=0)
            error[number] = used.std(axis=0, ddof=1) / np.sqrt(len(used)) if len(used) > 1 else np.nan
        return value, error


@dataclass(frozen=True, eq=False)
class ChartPoints:
    """Positions on a chart that are sampled."""

    cells_mm: _Array  # (C, 2) mm, centres of the patches in the order of colour indices
    whites_mm: _Array  # (W, 2) mm, centres of the white references
    greys_mm: _Array  # (N, 2) mm, centres of the grey references
    levels: GreyLevels

    @staticmethod
    def of(chart: Chart) -> ChartPoints:
        """Return the positions of a chart."""
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

    @property
    def white_patches(self) -> slice:
        """Indices of the white references among patches and references."""
        return slice(len(self.cells_mm), len(self.cells_mm) + len(self.whites_mm))

    @property
    def printed(self) -> npt.NDArray[np.int64]:
        """(W + N,) int64, ink of each reference: 0 for bare paper, else 1 + index of its level of grey."""
        return np.concatenate([np.zeros(len(self.whites_mm), dtype=np.int64), 1 + self.levels.level])


class ChangedFrame(FormatError):
    """A missing or changed frame file; the next run of the session takes it again automatically."""


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """A frame as read from its file."""

    record: FrameRecord
    mosaic: Mosaic
    black: _Array  # (2, 2) counts, black level of each position of the Bayer block
    strongest: Channel  # Channel with the brightest paper
    saturation: int  # Raw count of saturation in this frame (`Mosaic.saturation`)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, half-size px."""
        height, width = self.mosaic.block_planes().shape[2:]
        return height, width


def decode_frame(session: Session, record: FrameRecord) -> DecodedFrame:
    """Return a frame from its file, after checking the SHA-256."""
    path = session.folder / record.file
    try:
        data = read_buffer(path)
    except FileNotFoundError as error:
        raise ChangedFrame(
            f"{path} is missing, but listed in the session's journal; restore the file from a copy, {_RETAKE_HINT}"
        ) from error
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != record.sha256:
        raise ChangedFrame(
            f"{path} has changed: its SHA-256 is {sha256[:16]}…, expected "
            f"{record.sha256[:16]}…; restore the file from a copy, {_RETAKE_HINT}"
        )
    mosaic = decode_raw(data, path, is_verified=True)
    fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    if fault is not None:
        raise FormatError(
            f"{path} is incomplete: {fault}; restore the file from a copy, or take it again: acquire run LAB.toml "
            "SESSION --retake with the number of its illuminant"
        )
    black = frame_black(mosaic)
    return DecodedFrame(record, mosaic, black, strongest_channel(mosaic, black), mosaic.saturation())


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame with the chart registered in it, used for the following frames until the chart moves too far."""

    file: str
    registration: Registration
    cells: Sites
    references: Sites
    gauges: dict[Channel, Plane]  # Areas around the tags, or the outline of the patches, to measure movement
    lens: FrameCorrection | None = None  # Correction of light spread by the lens, at these sampling positions


def register_frame(
    decoded: DecodedFrame, chart: Chart, points: ChartPoints, options: BuildOptions, near: Registration | None = None
) -> RegisteredFrame:
    """Return a frame with the chart registered in it.

    `near`: registration of an earlier frame, which gives the approximate position of a chart without tags.
    """
    registration = register(decoded.mosaic, chart, decoded.record.file, options.corners, near)
    cells, references = sites_of(registration, points, decoded.shape, options.window)
    gauges: dict[Channel, Plane] = {
        channel: gauges_of(decoded.mosaic, channel, decoded.black, registration.framing) for channel in CHANNELS
    }
    return RegisteredFrame(decoded.record.file, registration, cells, references, gauges)


def sites_of(
    registration: Registration, points: ChartPoints, shape: tuple[int, int], window: int
) -> tuple[Sites, Sites]:
    """Return the sampling sites of patches and references.

    `shape`: rows and columns of the half-size frame. `window`: side of the sampling window, px.
    """
    cells, references = (
        sites_at(registration.to_pixels(mm), shape, window) for mm in (points.cells_mm, points.references_mm)
    )
    return cells, references


# Common to all frames of a session: visible area, shape of the sensor, Bayer pattern.
SensorLayout = tuple[Area, tuple[int, ...], str]


def sensor_layout(mosaic: Mosaic) -> SensorLayout:
    """Return the layout of a frame's sensor."""
    return mosaic.visible, mosaic.sensor.shape, mosaic.pattern


@dataclass(frozen=True, eq=False)
class Baseline:
    """Data shared by all frames of a LUT; created by `baseline_of` from the first frame."""

    chart: Chart
    points: ChartPoints
    options: BuildOptions
    camera: str  # Maker and model
    layout: SensorLayout
    first: RegisteredFrame
    whites: _Array  # (W, 3) counts above black of the white references; NaN if unusable
    means: _Array  # (C + W + N, 3) counts above black of patches and references
    paper: PaperReader  # Measures flat field and white of a frame, based on the flat field of the first frame
    transfer: PhotonTransfer
    # Linearity, from the first frame and the primaries; usual values if primaries are missing or the chart moved
    superposition: Superposition
    primaries: Primaries | None = None  # The primaries alone; None if missing or unusable
    lens: LensCorrection | None = None  # Measured light spread; None if not measured

    @cached_property
    def consistency_check(self) -> ConsistencyCheck:
        """Comparison of frames with the first frame. With primaries, the flat field depends on a patch's colour."""
        level = self.means[: len(self.points.cells_mm)]
        if self.primaries is None:
            field = self.paper.base.at(self.points.cells_mm)
        else:
            paper, shape = self.paper.read(self.whites, self.first.file)
            field = shape * self.primaries.field_ratio(paper.white)
        variance = self.transfer.variance(level / field) / self.options.samples
        codes, usable = self.chart.rgb[self.chart.cell_of_colour], compared_cells(self.chart, self.first)
        return ConsistencyCheck(codes, self.points.cells_mm, level / field, variance, usable)

    @property
    def levels(self) -> _Array:
        """(C, 3) float64, level of each patch in the first frame, relative to bare paper."""
        paper, at_cells = self.paper.read(self.whites, self.first.file)
        return self.means[: len(at_cells)] / (at_cells * np.maximum(paper.white, 1e-9))

    def require_layout(self, mosaic: Mosaic, source: str) -> None:
        """Raise FormatError if the sensor layout of a frame differs from the first; `source` names the frame."""
        layout = sensor_layout(mosaic)
        if layout != self.layout:
            new, first = (f"{shape[1]}×{shape[0]} photosites {pattern}" for _, shape, pattern in (layout, self.layout))
            raise FormatError(
                f"{source}: the sensor has {new}, expected {first} as in {self.first.file}; take the session "
                "again with one camera and one setting"
            )

    def register(self, decoded: DecodedFrame) -> RegisteredFrame:
        """Return a later frame with the chart registered in it; errors as in `register_frame`."""
        # A chart without tags keeps its orientation, so that a resumed build gives the same result.
        registered = register_frame(decoded, self.chart, self.points, self.options, self.first.registration)
        lens = self.correction(registered.registration, registered.cells, registered.references)
        return replace(registered, lens=lens)

    def correction(self, registration: Registration, cells: Sites, references: Sites) -> FrameCorrection | None:
        """Return the lens correction for frames sampled at these positions; None without correction."""
        if self.lens is None or not self.corrects_lens:
            return None
        return self.lens.of(registration, cells, references)

    @property
    def corrects_lens(self) -> bool:
        """True if frames are corrected for light spread by the lens."""
        return self.lens is not None and self.options.lens_correction and self.lens.spread.proven

    def movement(self, mosaic: Mosaic, black: _Array, channel: Channel, source: str) -> Shift:
        """Return the movement of the chart since the first frame. `black`: (2, 2) float64 counts."""
        self.require_layout(mosaic, source)
        framing = self.first.registration.framing
        return shift_between(self.first.gauges[channel], framing, gauges_of(mosaic, channel, black, framing))

    def patches(self, mosaic: Mosaic, black: _Array) -> tuple[_Array, npt.NDArray[np.uint16]]:
        """Return the patches of a frame at their positions in the first frame.

        `black`: (2, 2) float64 counts. Returns (C + W + N, 3) float64 mean counts above black, NaN outside the frame,
        and (C + W + N,) uint16, the highest raw count of each patch.
        """
        means: list[_Array] = []
        peaks: list[npt.NDArray[np.uint16]] = []
        for sites in (self.first.cells, self.first.references):
            samples, highest = gather(mosaic, black, sites)
            means.append(np.where(sites.inside[:, None], samples.mean(axis=1, dtype=np.float64), np.nan))
            peaks.append(highest)
        return np.concatenate(means), np.concatenate(peaks)

    def reflectances(self) -> _Array:
        """Return the reflectance (C + W + N, 3) float64 of patches and references in the first frame; paper is 1."""
        paper, shape = self.paper.read(self.whites, self.first.file)
        field = np.concatenate([shape, paper.field.at(self.points.references_mm)])
        return reflectances(self.means, field, paper.white)


def background_counts(decoded: DecodedFrame, background: Sites) -> _Array:
    """Return the mean (3,) float64 counts above black of the background behind the print; 0 if not visible."""
    if not len(background.rows):
        return np.zeros(3)
    return gather_means(decoded.mosaic, decoded.black, background).mean(axis=0)


def compared_cells(chart: Chart, registered: RegisteredFrame) -> npt.NDArray[np.bool_]:
    """Return the patches (C,) that are inside the frame and match the chart."""
    return registered.cells.inside & ~registered.registration.mismatched_cells[chart.cell_of_colour]


def usable_means(
    samples: npt.NDArray[np.float32], highest: npt.NDArray[np.uint16], sites: Sites, saturation: int
) -> _Array:
    """Return the means (N, 3) float64, counts above black, of patches; NaN if outside the frame or clipped.

    `samples`: (N, S, 3) float32 counts above black. `highest`: (N,) uint16, the highest raw count of each patch.
    `saturation`: raw count of saturation.
    """
    means = samples.mean(axis=1, dtype=np.float64)
    means[~(sites.inside & (highest < CLIPPING_SHARE * saturation))] = np.nan
    return means


@dataclass(frozen=True, eq=False)
class LocatedFrame:
    """A frame with the position of the chart in it."""

    decoded: DecodedFrame
    registered: RegisteredFrame  # The frame registered last, which may be this frame
    moved: RegisteredFrame  # `registered` with its sampling positions moved by `shift`
    shift: Shift  # Movement since the frame registered before this one
    reregistered: bool


@dataclass(frozen=True, eq=False)
class SampledFrame:
    """A light or white frame with its samples."""

    located: LocatedFrame
    paper: Paper
    greys: _Array  # (N, 3) counts above black of the grey references; NaN if unusable
    values: npt.NDArray[np.uint16]  # (C, S, 3), samples of the LUT
    highest: npt.NDArray[np.uint16]  # (C,), highest raw count of each patch
    samples: _Samples | None  # (C, S, 3) counts above black; None if not requested
    noise: _Array | None  # (C, 3) counts, noise of one sample; None if not requested
    dark: _Array  # (3,) counts, subtracted dark light on bare paper; 0 if none


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """Measurements and samples of a light or white frame."""

    figures: FrameMeasurements
    registered: RegisteredFrame  # The frame registered last, used for the measurement
    saturation: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    inside: npt.NDArray[np.bool_]  # (C,), all pixels of a patch are inside the frame
    samples: _Samples | None
    noise: _Array | None


@dataclass(frozen=True, eq=False)
class MeasuredDarkFrame:
    """Measurements of a dark frame."""

    figures: DarkFrameFigures
    registered: RegisteredFrame  # The frame registered last, used for the measurement
    excess: npt.NDArray[np.int16]  # (C, S, 3) counts of samples above the median of their patch
    means: _Array  # (C + W + N, 3) counts above black of patches and references


def locate(
    baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame, register_again: bool
) -> LocatedFrame | None:
    """Return the position of the chart in a frame, relative to the frame registered last.

    If the chart has moved too far, it is registered again; if `register_again` is False, the result is None.
    """
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    channel, framing = decoded.strongest, registered.registration.framing
    gauges = gauges_of(decoded.mosaic, channel, decoded.black, framing)
    shift = shift_between(registered.gauges[channel], framing, gauges)
    # After a rotation or a change of distance the tags move differently; a shifted grid would not fit.
    is_distorted = shift.largest_px > shift.length_px + STILL_PX
    if shift.gauges == 0 or shift.length_px > REREGISTER_PX or is_distorted:
        if not register_again:
            return None
        new = baseline.register(decoded)
        return LocatedFrame(decoded, new, new, _movement(baseline, registered, new), reregistered=True)
    moved = registered
    if shift.length_px > STILL_PX:
        shifted = registered.registration.shifted(shift.dx, shift.dy)
        cells, references = sites_of(shifted, baseline.points, decoded.shape, baseline.options.window)
        lens = baseline.correction(shifted, cells, references)
        moved = replace(registered, cells=cells, references=references, lens=lens)
    return LocatedFrame(decoded, registered, moved, shift, reregistered=False)


def _movement(baseline: Baseline, previous: RegisteredFrame, current: RegisteredFrame) -> Shift:
    cells_mm = baseline.points.cells_mm
    displacement = current.registration.to_pixels(cells_mm) - previous.registration.to_pixels(cells_mm)
    dx, dy = np.median(displacement, axis=0).tolist()
    return Shift(dx, dy, float(np.linalg.norm(displacement, axis=1).max()), len(displacement))


def sample(baseline: Baseline, located: LocatedFrame, dark: DarkLight | None, keep_samples: bool) -> SampledFrame:
    """Return the samples of a light or white frame. `dark`: light to subtract, if any."""
    decoded, moved, points = located.decoded, located.moved, baseline.points
    references, highest = gather(decoded.mosaic, decoded.black, moved.references)
    means = usable_means(references, highest, moved.references, decoded.saturation)
    to_subtract = _to_subtract(decoded, moved, references, dark)
    dark_of_cells = None
    if to_subtract is not None:
        dark_of_cells, dark_of_references = np.split(to_subtract, [len(points.cells_mm)])
        means -= dark_of_references
    whites, greys = np.split(means, [len(points.whites_mm)])
    paper, shape = baseline.paper.read(whites, decoded.record.file)
    if baseline.primaries is not None:
        shape = shape * baseline.primaries.field_ratio(paper.white)
    if keep_samples:
        samples, highest = gather(decoded.mosaic, decoded.black, moved.cells)
        values, noise = table_values(samples, shape, dark_of_cells), sample_noise(samples)
        if dark_of_cells is not None:
            # These samples are used to find faulty patches. Only light spread by the lens is subtracted from them.
            added = dark_of_cells if dark is None else dark_of_cells - dark.patches[: len(dark_of_cells)]
            samples -= added[:, None]
    else:
        values, highest = gather_values(decoded.mosaic, decoded.black, moved.cells, shape, dark_of_cells)
        samples = noise = None
    dark_paper = np.zeros(3) if dark is None else dark.paper
    return SampledFrame(located, paper, greys, values, highest, samples, noise, dark_paper)


def _to_subtract(
    decoded: DecodedFrame, moved: RegisteredFrame, references: _Samples, dark: DarkLight | None
) -> _Samples | None:
    """Return the dark light and the light added by the lens, (P, 3) float32 counts; None without either."""
    if moved.lens is None:
        return None if dark is None else dark.patches
    cells = gather_means(decoded.mosaic, decoded.black, moved.cells)
    means = np.concatenate([cells, references.mean(axis=1, dtype=np.float64)])
    if dark is not None:
        means -= dark.patches
    added = moved.lens.added(FrameLevels(means, background_counts(decoded, moved.lens.background))).astype(np.float32)
    return added if dark is None else added + dark.patches


def measure(baseline: Baseline, sampled: SampledFrame) -> MeasuredFrame:
    """Return the measurements of a light or white frame."""
    located, points, values = sampled.located, baseline.points, sampled.values
    decoded, shift, origin = located.decoded, located.shift, located.decoded.mosaic.origin
    greys, grey_errors = points.levels.read(sampled.greys, sampled.paper.field.at(points.greys_mm))
    # Squared blur of the registered frame, plus the increase since then in the areas that measure movement.
    blur_growth_px2 = 0.0 if located.reregistered else shift.blur_growth_px2
    mean = patch_means(values)
    variance = baseline.transfer.variance(mean) / baseline.options.samples
    figures = FrameMeasurements(
        record=decoded.record,
        black=decoded.black,
        channel=decoded.strongest,
        shift=shift,
        reregistered=located.reregistered,
        paper=sampled.paper,
        consistency=baseline.consistency_check.compare(mean, variance),
        greys=greys,
        grey_errors=grey_errors,
        dark=sampled.dark,
        share_at_zero=1 - int(np.count_nonzero(values)) / values.size,
        blur_px=float(np.sqrt(max(located.moved.registration.blur_px**2 + blur_growth_px2, 0.0))),
        exposure=origin.exposure,
        origin=origin,
    )
    return MeasuredFrame(
        figures,
        located.registered,
        decoded.saturation,
        values,
        sampled.highest,
        located.moved.cells.inside,
        sampled.samples,
        sampled.noise,
    )


def measure_dark(baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame) -> MeasuredDarkFrame:
    """Return the measurements of a dark frame; the chart is assumed at its position in `registered`."""
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    whites_mm = baseline.points.whites_mm
    cells, _ = gather(decoded.mosaic, decoded.black, registered.cells)
    references, _ = gather(decoded.mosaic, decoded.black, registered.references)
    whites = np.flatnonzero(registered.references.inside[: len(whites_mm)])
    shape = baseline.paper.base.at(whites_mm)[whites]
    figures, excess = measure_dark_frame(decoded.record, decoded.black, cells, references[whites], shape)
    means = np.concatenate([winsorised_means(patches, figures.noise) for patches in (cells, references)])
    return MeasuredDarkFrame(replace(figures, origin=decoded.mosaic.origin), registered, excess, means)
