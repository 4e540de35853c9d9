"""One frame's way: decoded → located → sampled → measured, by the baseline, which all frames of a table share.

- Cells are in the order of colour indices, not in the chart's own; references follow them, the white ones first.
- A frame is measured with the baseline, the frame registered last, and the dark light (that of the last dark frame, or
  of the first for frames before it), and with nothing else, so that any thread may measure it in any order.

C cells of S samples, W white references, N grey references; places on the print in millimetres, in frames in half-size
pixels.
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

_TAKEN_AGAIN = "or take it again: acquire run LAB.toml SESSION finds such frames by itself"

_OUTLIER_SIGMAS = 6.0  # Robust standard deviations from the median beyond which a patch is covered or dirty

_FEW_PATCHES = 4  # Patches up to which none is left out: of so few, none is surely the one that is wrong


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

    @property
    def white_patches(self) -> slice:
        """Where the white references are among cells and references."""
        return slice(len(self.cells_mm), len(self.cells_mm) + len(self.whites_mm))

    @property
    def printed(self) -> npt.NDArray[np.int64]:
        """(W + N,) int64, what each reference is printed with: 0 for nothing, else one more than its level of grey."""
        return np.concatenate([np.zeros(len(self.whites_mm), dtype=np.int64), 1 + self.levels.level])


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

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, half-size px."""
        height, width = self.mosaic.block_planes().shape[2:]
        return height, width


def decode_frame(session: Session, record: FrameRecord) -> DecodedFrame:
    """Return a frame as read from its file, whose SHA-256 is checked first."""
    path = session.folder / record.file
    try:
        data = read_buffer(path)
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
    mosaic = decode_raw(data, path, is_verified=True)
    fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    if fault is not None:
        raise FormatError(
            f"{path} is no whole frame: {fault}; restore the file from a copy, or take it again: acquire run LAB.toml "
            "SESSION --retake with the number of its light"
        )
    black = frame_black(mosaic)
    return DecodedFrame(record, mosaic, black, strongest_channel(mosaic, black), mosaic.saturation())


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
    cells, references = sites_of(registration, points, decoded.shape, options.window)
    gauges: dict[Channel, Plane] = {
        channel: gauges_of(decoded.mosaic, channel, decoded.black, registration.framing) for channel in CHANNELS
    }
    return RegisteredFrame(decoded.record.file, registration, cells, references, gauges)


def sites_of(
    registration: Registration, points: ChartPoints, shape: tuple[int, int], window: int
) -> tuple[Sites, Sites]:
    """Return the sites of the cells and of the references.

    `shape` is rows and columns of the half-size frame, `window` the pixels along a window's side.
    """
    cells, references = (
        sites_at(registration.to_pixels(places), shape, window) for places in (points.cells_mm, points.references_mm)
    )
    return cells, references


# What all frames of a session have in common: visible area, shape of the sensor, Bayer pattern.
SensorLayout = tuple[Area, tuple[int, ...], str]


def sensor_layout(mosaic: Mosaic) -> SensorLayout:
    """Return the layout of a frame's sensor."""
    return mosaic.visible, mosaic.sensor.shape, mosaic.pattern


@dataclass(frozen=True, eq=False)
class Baseline:
    """What all frames of a table share; `baseline_of` makes it before the first frame is measured.

    - `camera`, `layout`: maker and model, and the sensor's layout, the same in all frames.
    - `whites`: (W, 3) float64 counts above black of its white references; NaN where one cannot be used.
    - `means`: (C + W + N, 3) float64 counts above black of its cells and references.
    - `paper`: reads flat field and white of frames, with the shape of this one's as base.
    - `superposition`: what the first frame and those of the primaries show of the sensor's linearity; what is usual if
      one of them is lacking, or the chart has moved in it.
    - `primaries`: the primaries each alone; None where they were not given or cannot be used.
    - `lens`: what the lens spreads beside its sharp core, measured; None where it was not, or could not be.
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
    superposition: Superposition
    primaries: Primaries | None = None
    lens: LensCorrection | None = None

    @cached_property
    def consistency_check(self) -> ConsistencyCheck:
        """The check of frames against the first, each cell by the field of its own colour as far as it is known."""
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


@dataclass(frozen=True, eq=False)
class LocatedFrame:
    """A frame and where the chart lies in it.

    - `registered`: the frame registered last: this one, if the chart had to be registered again.
    - `at`: where it is sampled: as there, moved along by `shift`.
    - `shift`: movement against the frame that was registered before.
    """

    decoded: DecodedFrame
    registered: RegisteredFrame
    at: RegisteredFrame
    shift: Shift
    reregistered: bool


@dataclass(frozen=True, eq=False)
class SampledFrame:
    """A light or white frame as sampled.

    - `paper`: flat field and white.
    - `greys`: (N, 3) float64 counts above black of the grey references; NaN where one cannot be used.
    - `values`: (C, S, 3) uint16, the table's samples.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `samples`, `noise`: (C, S, 3) float32 counts above black and (C, 3) float64 counts, their noise; None if not asked
      for.
    - `dark`: (3,) float64 counts, dark light of bare paper that was subtracted; zeros if none was.
    """

    located: LocatedFrame
    paper: Paper
    greys: _Array
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    samples: _Samples | None
    noise: _Array | None
    dark: _Array


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """A light or white frame as measured, without its counts.

    - `registered`: the frame registered last, with which it was measured.
    - `inside`: (C,) bool, whether all pixels of a cell lie in the frame.
    - `values`, `highest`, `samples`, `noise`: as sampled.
    """

    figures: FrameMeasurements
    registered: RegisteredFrame
    saturation: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    inside: npt.NDArray[np.bool_]
    samples: _Samples | None
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


def locate(
    baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame, register_again: bool
) -> LocatedFrame | None:
    """Return where the chart lies in a frame, by that of the frame registered last.

    If it has moved too far for that, it is registered again, or None is returned if `register_again` is False.
    """
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    channel, framing = decoded.strongest, registered.registration.framing
    gauges = gauges_of(decoded.mosaic, channel, decoded.black, framing)
    shift = shift_between(registered.gauges[channel], framing, gauges)
    # A turn or a change of distance moves the tags differently; moving the grid along would not help.
    turned = shift.largest_px > shift.length_px + STILL_PX
    if shift.gauges == 0 or shift.length_px > REREGISTER_PX or turned:
        if not register_again:
            return None
        found = baseline.register(decoded)
        return LocatedFrame(decoded, found, found, _movement(baseline, registered, found), reregistered=True)
    at = registered
    if shift.length_px > STILL_PX:
        moved = registered.registration.shifted(shift.dx, shift.dy)
        cells, references = sites_of(moved, baseline.points, decoded.shape, baseline.options.window)
        lens = baseline.correction(moved, cells, references)
        at = replace(registered, cells=cells, references=references, lens=lens)
    return LocatedFrame(decoded, registered, at, shift, reregistered=False)


def _movement(baseline: Baseline, before: RegisteredFrame, after: RegisteredFrame) -> Shift:
    """Return how far the cells have moved from one registered frame to another, however far that is."""
    cells_mm = baseline.points.cells_mm
    by = after.registration.to_pixels(cells_mm) - before.registration.to_pixels(cells_mm)
    dx, dy = np.median(by, axis=0).tolist()
    return Shift(dx, dy, float(np.linalg.norm(by, axis=1).max()), len(by))


def sample(baseline: Baseline, located: LocatedFrame, dark: DarkLight | None, keep_samples: bool) -> SampledFrame:
    """Return the samples of a light or white frame. `dark`: what is subtracted from them; nothing if None."""
    decoded, at, points = located.decoded, located.at, baseline.points
    references, highest = gather(decoded.mosaic, decoded.black, at.references)
    seen = usable_means(references, highest, at.references, decoded.saturation)
    to_subtract = _to_subtract(decoded, at, references, dark)
    of_cells = None
    if to_subtract is not None:
        of_cells, of_references = np.split(to_subtract, [len(points.cells_mm)])
        seen -= of_references
    whites, greys = np.split(seen, [len(points.whites_mm)])
    paper, shape = baseline.paper.read(whites, decoded.record.file)
    if baseline.primaries is not None:
        shape = shape * baseline.primaries.field_ratio(paper.white)
    if keep_samples:
        kept, highest = gather(decoded.mosaic, decoded.black, at.cells)
        values, noise = table_values(kept, shape, of_cells), sample_noise(kept)
        if of_cells is not None:
            # Hot photosites and stains are looked for in samples that still have the dark light.
            added = of_cells if dark is None else of_cells - dark.patches[: len(of_cells)]
            kept -= added[:, None]
    else:
        values, highest = gather_values(decoded.mosaic, decoded.black, at.cells, shape, of_cells)
        kept = noise = None
    dark_paper = np.zeros(3) if dark is None else dark.paper
    return SampledFrame(located, paper, greys, values, highest, kept, noise, dark_paper)


def _to_subtract(
    decoded: DecodedFrame, at: RegisteredFrame, references: _Samples, dark: DarkLight | None
) -> _Samples | None:
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


def measure(baseline: Baseline, sampled: SampledFrame) -> MeasuredFrame:
    """Return what a light or white frame shows."""
    located, points, values = sampled.located, baseline.points, sampled.values
    decoded, shift, origin = located.decoded, located.shift, located.decoded.mosaic.origin
    greys, grey_errors = points.levels.read(sampled.greys, sampled.paper.field.at(points.greys_mm))
    # σ of the registered frame's blur, and what the gauges are softer than in it.
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
        blur_px=float(np.sqrt(max(located.at.registration.blur_px**2 + blur_growth_px2, 0.0))),
        exposure=origin.exposure,
        origin=origin,
    )
    return MeasuredFrame(
        figures,
        located.registered,
        decoded.saturation,
        values,
        sampled.highest,
        located.at.cells.inside,
        sampled.samples,
        sampled.noise,
    )


def measure_dark(baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame) -> MeasuredDarkFrame:
    """Return what a dark frame shows; no tag is seen in it, so the chart is assumed to lie where it did."""
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    whites_mm = baseline.points.whites_mm
    cells, _ = gather(decoded.mosaic, decoded.black, registered.cells)
    references, _ = gather(decoded.mosaic, decoded.black, registered.references)
    whites = np.flatnonzero(registered.references.inside[: len(whites_mm)])
    shape = baseline.paper.base.at(whites_mm)[whites]
    figures, excess = measure_dark_frame(decoded.record, decoded.black, cells, references[whites], shape)
    means = np.concatenate([winsorised_means(patches, figures.noise) for patches in (cells, references)])
    return MeasuredDarkFrame(replace(figures, origin=decoded.mosaic.origin), registered, excess, means)
