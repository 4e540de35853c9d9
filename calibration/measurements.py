"""What was measured by a build, or by a check, in named groups of frozen values: verdict, report and table rest on it.

Nothing is judged here, nothing drawn, no file read. L lights, C colours, G levels of grey, S samples of a cell; counts
are above black unless called raw.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator

from calibration.budget import Budget
from calibration.checks.frame_consistency import FrameConsistency, OriginFigures
from calibration.checks.light_codes import CodeAgreement
from calibration.checks.stray_light import StrayLight
from calibration.citation import OriginRecord
from calibration.radiometry.dark_frames import DarkSummary
from calibration.radiometry.drift import DriftCorrection
from calibration.radiometry.primaries import Additivity, Primaries
from calibration.radiometry.superposition import Superposition
from calibration.registration.register import Registration
from calibration.sampling import PhotonTransfer, bleed
from calibration.spread.added_light import AddedLight
from calibration.spread.correction import LensFigures
from calibration.spread.fitting import PointSpread
from calibration.table.lut import Unfit
from drivers.raw.rawfile import Channel, FrameOrigin
from experiment.framing.pictures import Shift
from experiment.measures.paper import Paper
from experiment.measures.sensor import black_drift
from experiment.measures.stains import Stains
from experiment.session.records import FrameRecord
from foundation.colorimetry import angles_deg
from foundation.records import FloatArray

_Array = npt.NDArray[np.float64]
_Levels = Annotated[FloatArray, AfterValidator(lambda values: values.reshape(-1, 3))]


@dataclass(frozen=True, eq=False)
class FrameMeasurements:
    """What was measured on one light or white frame.

    - `black`: (2, 2) float64 counts, black level of each position of the Bayer block.
    - `channel`: the channel in which the chart's movement was measured.
    - `shift`: movement against the frame that was registered last.
    - `reregistered`: whether the chart had moved so far that it was registered again in this frame.
    - `greys`, `grey_errors`: (G, 3) float64 counts above black of each level of grey, field divided out, and their
      standard errors.
    - `dark`: (3,) float64 counts, dark light of bare paper that was subtracted; zeros where none was.
    - `share_at_zero`: share, 0 … 1, of the frame's samples in the table that are 0.
    - `blur_px`: σ of the frame's blur, half-size px: that of the frame registered last, plus the change since.
    - `exposure`: shutter time × ISO speed / f-number² by the raw file, s; 0 where it does not state them.
    """

    record: FrameRecord
    black: FloatArray
    channel: Channel
    shift: Shift
    reregistered: bool
    paper: Paper
    consistency: FrameConsistency
    greys: _Levels
    grey_errors: _Levels
    dark: FloatArray
    share_at_zero: float
    blur_px: float
    exposure: float
    origin: FrameOrigin


@dataclass(frozen=True, eq=False)
class LinearityMeasurements:
    """Deviation of counts from proportion to the light (EMVA 1288, release 4.0, linearity error).

    - `files`: the frames, by rising exposure.
    - `level`: (B,) float64, shares of saturation, rising.
    - `deviation`: (3, B) float64, relative, of R, G and B from the straight line that fits best; NaN where no patch has
      data.
    """

    files: tuple[str, ...]
    level: _Array
    deviation: _Array

    @property
    def worst(self) -> float:
        """The largest deviation, a share."""
        return float(np.nanmax(np.abs(self.deviation)))

    @property
    def range(self) -> tuple[float, float]:
        """The lowest and the highest share of saturation for which a channel has data."""
        measured = np.flatnonzero(np.isfinite(self.deviation).any(axis=0))
        return float(self.level[measured[0]]), float(self.level[measured[-1]])

    def to_json(self) -> list[tuple[float, list[float | None]]]:
        """Return each level with the deviations of R, G and B, None where there are no data; for `report.json`."""

        def rounded(values: _Array) -> list[float | None]:
            return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]

        levels = self.level.tolist()
        return [(float(f"{level:.4g}"), rounded(self.deviation[:, number])) for number, level in enumerate(levels)]


@dataclass(frozen=True)
class SessionMeasurements:
    """What was read.

    - `registered_file`: the frame that was registered first, relative to the session.
    - `codes`: codes of each light of the plan, 0 … 255.
    """

    folder: Path
    camera: str
    lights: int
    registered_file: str
    white_references: int
    codes: tuple[tuple[int, int, int], ...]


# Standard deviation of a frame's brightness, a share, where white frames do not show it (judgement).
_USUAL_SCATTER = 0.001

_SCATTER_FRAMES = 3  # White frames from which on they show it


@dataclass(frozen=True, eq=False)
class LightMeasurements:
    """What was measured of the lights, light by light; a check has one row, of the frame that it read.

    - `white`, `white_error`: (L, 3) float64 counts, the ground truth and its standard error, in the units of the
      samples.
    - `gains`: (L, 3) float64, the lamp's light at each light over that in the first white frame; ones where it is not
      known.
    - `subtracted`: (L, 3) float64 counts, dark light of bare paper that was subtracted; None where none was to be.
    - `share_at_zero`: (L,) float64, share of each light's samples in the table that are 0; (0,) after a check.
    - `additivity`: how white is made of the primaries; None where a frame that is needed is missing.
    - `codes`: how the whites agree with their codes, by all other lights (`calibration.checks.light_codes`); lights
      from index L on in `exchanges` and `seen_as` are white frames. None after a check.
    - `white_frames`: the same of the white frames: of the first alone where the others differ from it as a lamp drifts,
      or of all. None without.
    - `drift`: how the lights are brought to one lamp in the table; None where that was not asked for. All else is as
      measured.
    - `stray`: light in frames that the dark ones do not show; None without the three primaries each alone or a dark
      frame.
    """

    white: _Array
    white_error: _Array
    gains: _Array
    subtracted: _Array | None
    share_at_zero: _Array
    additivity: Additivity | None
    codes: CodeAgreement | None
    white_frames: CodeAgreement | None
    drift: DriftCorrection | None = None
    stray: StrayLight | None = None

    @property
    def brightest(self) -> _Array:
        """(3,) float64 counts of bare paper under the brightest light."""
        brightest: _Array = self.white[int(np.argmax(self.white.sum(axis=1)))]
        return brightest

    @property
    def off_codes_deg(self) -> _Array | None:
        """(L,) float64 degrees, how far each white is off its codes for certain; None after a check.

        Of lights whose names are exchanged, the angle between the two.
        """
        if self.codes is None:
            return None
        off = self.codes.off_deg.copy()
        for pair in self.codes.exchanges:
            both = [light for light in (pair.one, pair.other) if light < len(off)]
            off[both] = np.maximum(off[both], pair.angle_deg)
        return off

    def lights_off_codes(self, accepted_deg: float) -> list[int]:
        """Return the lights further than `accepted_deg` from what their codes predict, the furthest first."""
        off = self.off_codes_deg
        return [] if off is None else [int(light) for light in np.argsort(-off) if off[light] > accepted_deg]


@dataclass(frozen=True, eq=False)
class GreyMeasurements:
    """What was measured of the printed levels of grey.

    - `values`, `errors`: (L, G, 3) float64 counts under each light, field divided out, and their standard errors; NaN
      where no patch of a level can be used.
    """

    names: tuple[str, ...]
    values: _Array
    errors: _Array

    def tints_deg(self, white: _Array) -> _Array:
        """Return (G,) degrees between each level and white, under the light with the most of its weakest channel.

        `white` (L, 3) float64 is the ground truth; a grey has the light's chromaticity only as far as the print is
        neutral.
        """
        if not self.names:
            return np.zeros(0)
        best = int(np.argmax(white.min(axis=1)))
        return angles_deg(white[best], self.values[best])


@dataclass(frozen=True, eq=False)
class SensorMeasurements:
    """What was measured of the sensor.

    - `saturation_counts`: raw count of saturation.
    - `saturation_measured`: whether a photosite of a cell reached it, so that the count is measured and not the raw
      file's statement.
    - `white_level`: saturation as a sample value: counts above black.
    - `noise`: (3,) float64, median standard deviation of one sample under white, relative to paper white.
    - `transfer`: photon-transfer curve of the frame that was registered first.
    - `superposition`: what lights of several primaries show of it beside the primaries alone.
    """

    saturation_counts: int
    saturation_measured: bool
    white_level: int
    noise: _Array
    transfer: PhotonTransfer
    linearity: LinearityMeasurements | None
    superposition: Superposition


@dataclass(frozen=True, eq=False)
class CellMeasurements:
    """What was found of the chart's cells.

    - `window`: pixels along the side of a cell's window; S = window².
    - `stains`: where the print does not have its codes' colours, in the order of colour indices.
    - `levels`: (C, 3) float64, of each cell in the frame that was registered first, bare paper 1.
    - `added`: light that lies on some of them whatever is printed there.
    """

    window: int
    unfit: tuple[Unfit, ...]
    stains: Stains
    levels: _Array
    added: AddedLight


@dataclass(frozen=True, eq=False)
class TableMeasurements:
    """All that was measured by a build, or by a check.

    - `frames`: figures of every light and white frame read, in the order taken.
    - `dark_frames`: what the dark frames show; of a check, the first of them.
    - `origins`: which frames' files state another camera, lens or exposure than most.
    - `primaries`: the primaries each alone, by which the field of coloured cells is known apart from that of paper;
      None where the plan has no light of each alone, or one is too dim.
    - `lens`, `point_spread`: what the lens spreads beside its sharp core, and what of it was subtracted; None where it
      was not measured.
    - `origin`: with what, when and by whom the frames were taken.
    """

    session: SessionMeasurements
    registration: Registration
    frames: tuple[FrameMeasurements, ...]
    lights: LightMeasurements
    greys: GreyMeasurements
    sensor: SensorMeasurements
    dark_frames: DarkSummary
    cells: CellMeasurements
    origins: OriginFigures
    primaries: Primaries | None
    lens: LensFigures
    point_spread: PointSpread | None
    origin: OriginRecord
    budget: Budget

    @property
    def is_of_one_frame(self) -> bool:
        """Whether these are a check's, which reads one light or white frame, and one dark frame."""
        return self.lights.codes is None

    @property
    def primary_lights(self) -> tuple[int, ...]:
        """Lights of red, green and blue alone at their full, by their numbers; () where one is missing."""
        found = {codes: light for light, codes in enumerate(self.session.codes)}
        alone = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
        return tuple(found[codes] for codes in alone) if found.keys() >= set(alone) else ()

    @property
    def white_frames(self) -> tuple[FrameMeasurements, ...]:
        """The white frames, in the order taken."""
        return tuple(frame for frame in self.frames if frame.record.kind == "white")

    @property
    def registered_frame(self) -> FrameMeasurements:
        """The frame that was registered first; another where that one is not among those measured."""
        named = (frame for frame in self.frames if frame.record.file == self.session.registered_file)
        return next(named, self.frames[0])

    def added_bleed(self, frame: FrameMeasurements) -> float:
        """Return how much more light a frame's worst sample has from beyond its cell than the registered frame's."""
        registration, window = self.registration, self.cells.window
        own, first = (bleed(registration.cell_px, px, window) for px in (frame.blur_px, registration.blur_px))
        return own - first

    @property
    def largest_shift_px(self) -> float:
        """The chart's largest movement between a frame and the registration that it was sampled by, half-size px."""
        return max((frame.shift.length_px for frame in self.frames), default=0.0)

    @property
    def black_drift(self) -> float:
        """Drift of the black level over the session, counts."""
        return black_drift([*(frame.black for frame in self.frames), *self.dark_frames.blacks])

    @property
    def white_drift(self) -> float:
        """Largest relative change of paper white between white frames, over the channels."""
        whites = np.array([frame.paper.white for frame in self.white_frames])
        return float((np.ptp(whites, axis=0) / whites.mean(axis=0)).max()) if len(whites) > 1 else 0.0

    @property
    def white_scatter(self) -> float:
        """Standard deviation of a white frame's brightness about its neighbours', a share; what is usual of few."""
        whites = np.array([frame.paper.white.sum() for frame in self.white_frames])
        if len(whites) < _SCATTER_FRAMES:
            return _USUAL_SCATTER
        off = whites[1:-1] - (whites[:-2] + whites[2:]) / 2
        return float(np.sqrt((off**2).mean() / 1.5) / whites.mean())

    @property
    def dark_share(self) -> float:
        """Light of bare paper while the projector shows black, of white, in the worst channel; NaN if not measured."""
        share = np.abs(self.dark_frames.light / self._full_white).max()
        return float(share) if np.isfinite(self.dark_frames.light).all() else float("nan")

    @property
    def dark_change(self) -> float:
        """Change of that light between dark frames, of white; NaN of one dark frame."""
        lights = self.dark_frames.lights
        return float((np.ptp(lights, axis=0) / self._full_white).max()) if len(lights) > 1 else float("nan")

    @property
    def _full_white(self) -> _Array:
        """(3,) float64 counts of bare paper under white, or under the brightest light where no white was taken."""
        whites = [frame.paper.white for frame in self.white_frames]
        return np.mean(whites, axis=0) if whites else self.lights.brightest
