"""What one frame says: how the chart has moved, its paper and greys, its samples.

Laws that hold inside:

- A frame is measured with what holds for its stretch, the time between two bumps, and nothing else, so that frames can
  be measured in any order and by any thread.
- The chart must lie where it was registered: a movement up to a tenth of a pixel is let be, up to half a pixel the
  grid is moved along, and beyond it the frame is registered anew and begins a stretch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.chart.model import Chart
from acquisition.framing.planes import CHANNELS, Channel, Plane, channel_offset_px, phases
from acquisition.framing.tags import Framing
from acquisition.session.folder import FrameRecord
from calibration.checks.likeness import Expectation, Likeness
from calibration.pipeline.frames import Decoded
from calibration.radiometry.cell_field import field_of_cells
from calibration.radiometry.dark_light import DarkLight, Subtraction, quiet_means, reflectances
from calibration.radiometry.darkness import DarkFigures, read_dark
from calibration.radiometry.greys import Levels
from calibration.radiometry.paper import AROUND, CLIPPED, ORDERS, Field, Paper, PaperReader
from calibration.radiometry.photon_transfer import PhotonTransfer, photon_transfer
from calibration.radiometry.primaries import Primaries
from calibration.registration.movement import Shift, gauge_boxes, shift_between
from calibration.registration.register import Registration, register
from calibration.sampling.samples import (
    WINDOW,
    Sites,
    gather,
    gather_values,
    noise_of,
    patch_means,
    sites_at,
    table_values,
)
from drivers.raw.rawfile import Mosaic
from foundation.errors import FormatError, RegistrationError

STILL_PX = 0.1
BUMP_PX = 0.5

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What was measured on one frame.

    Attributes
    ----------
    record
        The frame.
    black
        (2, 2) float64 counts, black level of each position of the block.
    channel
        The colour in which the chart's movement was measured.
    shift
        Movement against the frame registered last.
    registered
        Whether this frame was registered anew.
    paper
        Field and white.
    likeness
        How like the print, as it was first registered, the frame is.
    greys, grey_errors
        (G, 3) float64 counts above black of each level of grey, field divided out, and their standard errors.
    dark
        (3,) float64 counts, dark light of bare paper that was subtracted; zeros where none was.
    at_zero
        Share of the table's samples that are 0.
    blur_px
        How soft the frame is: that of the frame registered last, and what tags or outline are softer than in it.
    exposure
        Shutter time × ISO speed / f-number² by the raw file, s; 0 where it does not state them.
    """

    record: FrameRecord
    black: _Array
    channel: Channel
    shift: Shift
    registered: bool
    paper: Paper
    likeness: Likeness
    greys: _Array = field(default_factory=lambda: np.zeros((0, 3)))
    grey_errors: _Array = field(default_factory=lambda: np.zeros((0, 3)))
    dark: _Array = field(default_factory=lambda: np.zeros(3))
    at_zero: float = 0.0
    blur_px: float = 0.0
    exposure: float = 0.0

    def told(self) -> dict[str, Any]:
        """Return the figures as JSON holds them; `recall` makes them again to the last bit."""
        return {
            "black": self.black.tolist(),
            "channel": self.channel,
            "shift": list(astuple(self.shift)),
            "registered": self.registered,
            "field": [[factor.tolist() for factor in factors] for factors in self.paper.field.coefficients],
            "white": self.paper.white.tolist(),
            "error": self.paper.error.tolist(),
            "references": self.paper.references,
            "spread": self.paper.spread.tolist(),
            "likeness": [self.likeness.scatter, self.likeness.block, *self.likeness.at_mm],
            "greys": self.greys.tolist(),
            "grey_errors": self.grey_errors.tolist(),
            "dark": self.dark.tolist(),
            "at_zero": self.at_zero,
            "blur": self.blur_px,
            "exposure": self.exposure,
        }

    @staticmethod
    def recall(record: FrameRecord, page_mm: tuple[float, float], told: dict[str, Any]) -> FrameFigures:
        """Return the figures of a frame from what `told` returned."""
        red, green, blue = (tuple(np.array(factor) for factor in factors) for factors in told["field"])
        field = Field(page_mm, (red, green, blue))
        white, error, spread = (np.array(told[name]) for name in ("white", "error", "spread"))
        scatter, block, x_mm, y_mm = told["likeness"]
        return FrameFigures(
            record,
            np.array(told["black"]),
            told["channel"],
            Shift(*told["shift"]),
            told["registered"],
            Paper(field, white, error, told["references"], spread),
            Likeness(scatter, block, (x_mm, y_mm)),
            np.array(told["greys"]).reshape(-1, 3),
            np.array(told["grey_errors"]).reshape(-1, 3),
            np.array(told["dark"]),
            told["at_zero"],
            told["blur"],
            # Checkpoints of earlier versions do not know it.
            told.get("exposure", 0.0),
        )


@dataclass(frozen=True, eq=False)
class Stretch:
    """What holds from one bump to the next.

    Attributes
    ----------
    file
        The frame that was registered.
    registration
        Of that frame.
    cells
        Where the cells are sampled, in the order of colour indices.
    references
        Where the references are sampled, the white ones first.
    planes
        The frame around its tags, or the outline of its field, to compare others with.
    """

    file: str
    registration: Registration
    cells: Sites
    references: Sites
    planes: dict[Channel, Plane]


@dataclass(frozen=True, eq=False)
class Measured:
    """A light or white frame as measured.

    Attributes
    ----------
    figures
        For the report, the ground truth and the field.
    stretch, dark
        What it was measured with, and what was subtracted.
    saturation
        Raw count of saturation, as far as this frame tells.
    values
        (C, S, 3) uint16, the table's samples.
    highest
        (C,) uint16, the highest raw count of each cell.
    inside
        (C,) bool, whether all pixels of a cell lie in the frame.
    samples, noise
        (C, S, 3) float32 counts above black and (C, 3) float64 their noise; None where they were not asked for.
    """

    figures: FrameFigures
    stretch: Stretch
    dark: DarkLight | None
    saturation: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    inside: npt.NDArray[np.bool_]
    samples: npt.NDArray[np.float32] | None
    noise: _Array | None


@dataclass(frozen=True, eq=False)
class MeasuredDark:
    """A dark frame as measured.

    Attributes
    ----------
    figures
        What it says.
    stretch
        What it was measured with.
    aside
        (C, S, 3) int16, how far samples stand above their cells.
    means
        (P, 3) float64 mean counts of cells, then references.
    """

    figures: DarkFigures
    stretch: Stretch
    aside: npt.NDArray[np.int16]
    means: _Array


def gauges_of(mosaic: Mosaic, channel: Channel, black: _Array, framing: Framing) -> Plane:
    """Return one colour of a mosaic around its gauges, and 0 elsewhere: all that a movement is measured in."""
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = np.float32(np.mean([black[place] for place in places]))
    values = np.zeros(blocks.shape[2:], dtype=np.float32)
    for left, top, right, bottom in gauge_boxes(framing):
        part = np.s_[top:bottom, left:right]
        values[part] = sum(blocks[place][part].astype(np.float32) for place in places) / np.float32(len(places)) - level
    return Plane(channel, values, channel_offset_px(places))


class Measurement:
    """Measures the frames of a session; it does not change, so threads may share it.

    Parameters
    ----------
    chart
        The chart of the session.
    first
        The frame that is registered first: its light's shape is the base of all others'.
    window
        Pixels along the side of a cell's window.
    corners
        As in `calibration.registration.register.register`, of the first frame; near enough for others.
    primaries
        The frames of red, green and blue alone, as `calibration.pipeline.frames.pure_frames` has them; gone through
        once.

    Attributes
    ----------
    primaries
        What they say; None where they were not given or cannot be told.
    """

    def __init__(
        self,
        chart: Chart,
        first: Decoded,
        window: int = WINDOW,
        corners: npt.ArrayLike | None = None,
        primaries: Iterable[Decoded] = (),
    ) -> None:
        self._chart, self._window = chart, window
        whites = [reference for reference in chart.references if reference.is_white]
        greys = [reference for reference in chart.references if not reference.is_white]
        self.levels = Levels.of(greys)
        self._white_mm = np.array([reference.centre_mm for reference in whites]).reshape(-1, 2)
        self._grey_mm = np.array([reference.centre_mm for reference in greys]).reshape(-1, 2)
        self._references_mm = np.concatenate([self._white_mm, self._grey_mm])
        # The table is ordered by colour index, the chart by its own order.
        self.cells_mm = chart.centres_mm[chart.cell_of_colour]
        self._shape = first.mosaic.block_planes().shape[2:]
        self._geometry = first.mosaic.visible, first.mosaic.sensor.shape, first.mosaic.pattern
        self._first_file = first.record.file
        self._corners = corners
        self._near: Registration | None = None
        self.first = self.register(first)
        # How the chart hangs is told once: always by the first frame, so that a build that goes on tells the same.
        self._near = self.first.registration
        samples, highest = gather(first.mosaic, first.black, self.first.references)
        seen = _means(samples, highest, self.first.references, first.saturation)[: len(whites)]
        base = PaperReader(self._white_mm, self.cells_mm, chart.page_mm).read(seen, first.record.file)[0].field
        cells = gather(first.mosaic, first.black, self.first.cells)[0].astype(np.float64)
        level = cells.mean(axis=1)
        there = self.first.cells.inside & ~self.first.registration.strangers[chart.cell_of_colour]
        codes = chart.rgb[chart.cell_of_colour]
        if not chart.tags:
            # Its references are in the margin, and do not tell what light there is in the middle.
            base = field_of_cells(codes, self.cells_mm, level, there, self._white_mm, seen, chart.page_mm)
        order = ORDERS[-1] if chart.tags else AROUND
        self._paper = PaperReader(self._white_mm, self.cells_mm, chart.page_mm, base, order)
        self._base_at_whites = base.at(self._white_mm)
        self.transfer: PhotonTransfer = photon_transfer(level, cells.var(axis=1, ddof=1), window**2)
        self._first_means = np.concatenate([level, samples.mean(axis=1, dtype=np.float64)])
        self._first_seen = seen
        self._expected = Expectation(codes, self.cells_mm, level / base.at(self.cells_mm), there)
        self.primaries: Primaries | None = None
        self.primaries = self._read_primaries(primaries)

    def register(self, decoded: Decoded) -> Stretch:
        """Find the chart in a frame, which begins a stretch."""
        registration = register(decoded.mosaic, self._chart, decoded.record.file, self._corners, self._near)
        cells, references = self._sites(registration)
        planes: dict[Channel, Plane] = {
            channel: gauges_of(decoded.mosaic, channel, decoded.black, registration.framing) for channel in CHANNELS
        }
        return Stretch(decoded.record.file, registration, cells, references, planes)

    def _read_primaries(self, frames: Iterable[Decoded]) -> Primaries | None:
        """Return what the primaries' own frames say, wherever the chart lay in them; None if it is not found in one."""
        lights: list[int] = []
        papers: list[Paper] = []
        cells: list[_Array] = []
        for decoded in frames:
            measured = self.measure(decoded, self.first, even=False)
            if isinstance(measured, Shift):
                try:
                    measured = self.measure_first(decoded, self.register(decoded), measured, even=False)
                except RegistrationError:
                    return None
            light = decoded.record.illumination
            assert light is not None
            lights.append(light)
            papers.append(measured.figures.paper)
            cells.append(patch_means(measured.values))
        return Primaries.of(lights, papers, cells, self.cells_mm) if lights else None

    def _sites(self, registration: Registration) -> tuple[Sites, Sites]:
        """Return the sites of the cells and of the references."""
        height, width = self._shape
        groups = self.cells_mm, self._references_mm
        cells, references = (
            sites_at(registration.to_pixels(places), (height, width), self._window) for places in groups
        )
        return cells, references

    def movement(self, mosaic: Mosaic, black: _Array, channel: Channel, what: str) -> Shift:
        """Return how far the chart has moved in a frame since the first one.

        Raises
        ------
        FormatError
            The sensor is not that of the first frame.
        """
        self._require_geometry(mosaic, what)
        framing = self.first.registration.framing
        return shift_between(self.first.planes[channel], framing, gauges_of(mosaic, channel, black, framing))

    def patches(self, mosaic: Mosaic, black: _Array) -> tuple[_Array, npt.NDArray[np.uint16]]:
        """Return the mean counts (P, 3) and highest raw counts (P,) of cells, then references, where they were first.

        NaN where a patch does not lie in the frame.
        """
        means: list[_Array] = []
        peaks: list[npt.NDArray[np.uint16]] = []
        for sites in (self.first.cells, self.first.references):
            samples, highest = gather(mosaic, black, sites)
            means.append(np.where(sites.inside[:, None], samples.mean(axis=1, dtype=np.float64), np.nan))
            peaks.append(highest)
        return np.concatenate(means), np.concatenate(peaks)

    def subtraction(self) -> Subtraction:
        """Return what learns the dark light, with the reflectances that the first frame shows."""
        paper, shape = self._paper.read(self._first_seen, self._first_file)
        field = np.concatenate([shape, paper.field.at(self._references_mm)])
        inside = np.concatenate([self.first.cells.inside, self.first.references.inside])
        return Subtraction(reflectances(self._first_means, field, paper.white), inside, self._window**2)

    def learn(self, subtraction: Subtraction, measured: MeasuredDark) -> DarkLight:
        """Take a dark frame into a subtraction.

        Raises
        ------
        QualityError
            The white references cannot be used.
        """
        cells = len(self.cells_mm)
        inside = measured.stretch.references.inside[: len(self._white_mm), None]
        seen = np.where(inside, measured.means[cells:][: len(self._white_mm)], np.nan)
        paper, shape = self._paper.read(seen, measured.figures.record.file)
        field = np.concatenate([shape, paper.field.at(self._references_mm)])
        return subtraction.add(measured.means, measured.figures.noise, paper, field)

    def measure(
        self, decoded: Decoded, stretch: Stretch, even: bool, dark: DarkLight | None = None
    ) -> Measured | Shift:
        """Return what a frame says; its movement alone, if that is such that it has to be registered anew.

        Parameters
        ----------
        decoded
            A light or white frame.
        stretch
            What holds for it.
        even
            Whether its samples are wanted, for what is learnt from frames of even light.
        dark
            What is subtracted from samples and references; nothing if not given.

        Raises
        ------
        FormatError
            The sensor is not that of the first frame.
        QualityError
            The white references cannot be used.
        """
        self._require_geometry(decoded.mosaic, decoded.record.file)
        channel, framing = decoded.strongest, stretch.registration.framing
        shift = shift_between(
            stretch.planes[channel], framing, gauges_of(decoded.mosaic, channel, decoded.black, framing)
        )
        # A turn or a change of distance moves the tags differently; moving the grid along would not mend it.
        turned = shift.largest_px > shift.length_px + STILL_PX
        if shift.tags == 0 or shift.length_px > BUMP_PX or turned:
            return shift
        cells, references = stretch.cells, stretch.references
        if shift.length_px > STILL_PX:
            cells, references = self._sites(stretch.registration.shifted(shift.dx, shift.dy))
        return self._measured(decoded, stretch, cells, references, shift, even, dark)

    def moved(self, before: Stretch, stretch: Stretch) -> Shift:
        """Return how far the cells have moved from one stretch to another, however far that is."""
        by = stretch.registration.to_pixels(self.cells_mm) - before.registration.to_pixels(self.cells_mm)
        dx, dy = np.median(by, axis=0).tolist()
        return Shift(dx, dy, float(np.linalg.norm(by, axis=1).max()), len(by))

    def measure_first(
        self, decoded: Decoded, stretch: Stretch, shift: Shift, even: bool, dark: DarkLight | None = None
    ) -> Measured:
        """Return what the frame says that has begun a stretch, `shift` after the one before; else as `measure`."""
        anew = stretch is not self.first
        return self._measured(decoded, stretch, stretch.cells, stretch.references, shift, even, dark, anew)

    def measure_dark(self, decoded: Decoded, stretch: Stretch) -> MeasuredDark:
        """Return what a dark frame says; no tag is seen in it, so the chart is taken to lie where it did."""
        self._require_geometry(decoded.mosaic, decoded.record.file)
        cells, _ = gather(decoded.mosaic, decoded.black, stretch.cells)
        references, _ = gather(decoded.mosaic, decoded.black, stretch.references)
        whites = np.flatnonzero(stretch.references.inside[: len(self._white_mm)])
        figures, aside = read_dark(
            decoded.record, decoded.black, cells, references[whites], self._base_at_whites[whites]
        )
        means = np.concatenate([quiet_means(patches, figures.noise) for patches in (cells, references)])
        return MeasuredDark(figures, stretch, aside, means)

    def _require_geometry(self, mosaic: Mosaic, what: str) -> None:
        if (mosaic.visible, mosaic.sensor.shape, mosaic.pattern) != self._geometry:
            raise FormatError(
                f"{what}: the sensor has {mosaic.sensor.shape[1]}×{mosaic.sensor.shape[0]} photosites "
                f"{mosaic.pattern}, that of {self._first_file} {self._geometry[1][1]}×{self._geometry[1][0]} "
                f"{self._geometry[2]}; "
                "a session has one camera with one setting"
            )

    def _measured(
        self,
        decoded: Decoded,
        stretch: Stretch,
        cells: Sites,
        references: Sites,
        shift: Shift,
        even: bool,
        dark: DarkLight | None,
        registered: bool = False,
    ) -> Measured:
        samples, highest = gather(decoded.mosaic, decoded.black, references)
        seen = _means(samples, highest, references, decoded.saturation)
        count = len(self.cells_mm)
        if dark is not None:
            seen -= dark.patches[count:]
        dark_cells = None if dark is None else dark.patches[:count]
        whites = len(self._white_mm)
        paper, shape = self._paper.read(seen[:whites], decoded.record.file)
        if self.primaries is not None:
            shape = shape * self.primaries.beside_paper(paper.white)
        greys, grey_errors = self.levels.read(seen[whites:], paper.field.at(self._grey_mm))
        if even:
            kept, highest = gather(decoded.mosaic, decoded.black, cells)
            values, noise = table_values(kept, shape, dark_cells), noise_of(kept)
        else:
            values, highest = gather_values(decoded.mosaic, decoded.black, cells, shape, dark_cells)
            kept = noise = None
        mean = patch_means(values[self._expected.cells])
        likeness = self._expected.held_against(mean, self.transfer.variance(mean) / self._window**2)
        softer = 0.0 if registered else shift.softer_px2
        figures = FrameFigures(
            decoded.record,
            decoded.black,
            decoded.strongest,
            shift,
            registered,
            paper,
            likeness,
            greys,
            grey_errors,
            np.zeros(3) if dark is None else dark.paper,
            1 - int(np.count_nonzero(values)) / values.size,
            float(np.sqrt(max(stretch.registration.blur_px**2 + softer, 0.0))),
            _exposure(decoded.mosaic),
        )
        return Measured(figures, stretch, dark, decoded.saturation, values, highest, cells.inside, kept, noise)


def _exposure(mosaic: Mosaic) -> float:
    """Return how much light a frame gathered, as its file states it; 0 where it does not."""
    if mosaic.shutter_s is None or mosaic.iso is None:
        return 0.0
    # A lens without contacts has no f-number, and keeps the one that it has.
    return mosaic.shutter_s * mosaic.iso / (mosaic.aperture or 1.0) ** 2


def _means(samples: npt.NDArray[np.float32], highest: npt.NDArray[np.uint16], sites: Sites, saturation: int) -> _Array:
    """Return the mean counts (N, 3) of patches, NaN where one is cut off or clipped."""
    seen = samples.mean(axis=1, dtype=np.float64)
    seen[~(sites.inside & (highest < CLIPPED * saturation))] = np.nan
    return seen
