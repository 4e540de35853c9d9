"""All figures of a build, or of a check, in named groups: what the verdict judges and report and table are made from.

L lights, C colours, G levels of grey, S samples of a cell; counts are above black unless called raw.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.checks.frame_origins import OriginFigures
from calibration.checks.light_codes import CodeAgreement
from calibration.checks.stray_light import StrayLight
from calibration.citation import OriginRecord
from calibration.figures.frame_figures import FrameFigures
from calibration.figures.linearity_figures import LinearityFigures
from calibration.radiometry.dark_frames import DarkSummary
from calibration.radiometry.drift import DriftCorrection
from calibration.radiometry.greys import tint_deg
from calibration.radiometry.photon_transfer import PhotonTransfer
from calibration.radiometry.primaries import Primaries
from calibration.registration.register import Registration
from calibration.spread.correction import LensFigures
from calibration.spread.fitting import PointSpread
from calibration.table.lut import Unfit
from experiment.measures.sensor_range import black_drift
from experiment.measures.stains import Stains

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SessionFigures:
    """What was read.

    - `folder`: the session's folder.
    - `camera`: maker and model as the raw files name it.
    - `lights`: lights with an accepted frame.
    - `registered_file`: the frame that was registered first, relative to the session.
    - `white_references`: white references that the chart has.
    - `codes`: codes of each light of the plan, 0 … 255.
    """

    folder: Path
    camera: str
    lights: int
    registered_file: str
    white_references: int
    codes: tuple[tuple[int, int, int], ...]


@dataclass(frozen=True, eq=False)
class LightFigures:
    """What was measured of the lights, light by light; a check has one row, of the frame that it read.

    - `white`, `white_error`: (L, 3) float64 counts, the ground truth and its standard error, in the units of the
      samples.
    - `gains`: (L, 3) float64, the lamp's light at each light over that in the first white frame; ones where it is not
      known.
    - `subtracted`: (L, 3) float64 counts, dark light of bare paper that was subtracted; None where none was to be.
    - `share_at_zero`: (L,) float64, share of each light's samples in the table that are 0; (0,) after a check.
    - `additivity`: (3,) float64, by how much the primaries together differ from white, relative to white; None where a
      frame that is needed is missing.
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
    additivity: _Array | None
    codes: CodeAgreement | None
    white_frames: CodeAgreement | None
    drift: DriftCorrection | None = None
    stray: StrayLight | None = None

    @cached_property
    def white_error_deg(self) -> _Array:
        """(L,) float64 degrees, standard error of each ground truth's direction."""
        return direction_error_deg(self.white, self.white_error)

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
class GreyFigures:
    """What was measured of the printed levels of grey.

    - `names`: of the G levels, brightest first.
    - `values`, `errors`: (L, G, 3) float64 counts under each light, field divided out, and their standard errors; NaN
      where no patch of a level can be used.
    """

    names: tuple[str, ...]
    values: _Array
    errors: _Array

    def tints_deg(self, white: _Array) -> _Array:
        """Return (G,) degrees between each level and white, under the light with the most of its weakest channel.

        `white` (L, 3) float64 is the ground truth.
        """
        if not self.names:
            return np.zeros(0)
        best = int(np.argmax(white.min(axis=1)))
        return tint_deg(white[best], self.values[best])


@dataclass(frozen=True, eq=False)
class SensorFigures:
    """What was measured of the sensor.

    - `saturation_counts`: raw count of saturation.
    - `saturation_measured`: whether a photosite of a cell reached it, so that the count is measured and not the raw
      file's statement.
    - `white_level`: saturation as a sample value: counts above black.
    - `noise`: (3,) float64, median standard deviation of one sample under white, relative to paper white.
    - `transfer`: photon-transfer curve of the frame that was registered first.
    - `linearity`: what a series of exposures shows; None where none was given.
    """

    saturation_counts: int
    saturation_measured: bool
    white_level: int
    noise: _Array
    transfer: PhotonTransfer
    linearity: LinearityFigures | None


@dataclass(frozen=True, eq=False)
class CellFigures:
    """What was found of the chart's cells.

    - `window`: pixels along the side of a cell's window; S = window².
    - `unfit`: cells not to be used, each with its cause.
    - `stains`: where the print does not have its codes' colours, in the order of colour indices.
    """

    window: int
    unfit: tuple[Unfit, ...]
    stains: Stains


@dataclass(frozen=True, eq=False)
class TableFigures:
    """All that was measured by a build, or by a check.

    - `registration`: of the frame that was registered first.
    - `frames`: figures of every light and white frame read, in the order taken.
    - `dark_frames`: what the dark frames show; of a check, the first of them.
    - `origins`: which frames' files state another camera, lens or exposure than most.
    - `primaries`: the primaries each alone, by which the field of coloured cells is known apart from that of paper;
      None where the plan has no light of each alone, or one is too dim.
    - `lens`, `point_spread`: what the lens spreads beside its sharp core, and what of it was subtracted; None where it
      was not measured.
    - `origin`: with what, when and by whom the frames were taken.
    """

    session: SessionFigures
    registration: Registration
    frames: tuple[FrameFigures, ...]
    lights: LightFigures
    greys: GreyFigures
    sensor: SensorFigures
    dark_frames: DarkSummary
    cells: CellFigures
    origins: OriginFigures
    primaries: Primaries | None
    lens: LensFigures
    point_spread: PointSpread | None
    origin: OriginRecord

    @property
    def white_frames(self) -> tuple[FrameFigures, ...]:
        """The white frames, in the order taken."""
        return tuple(frame for frame in self.frames if frame.record.kind == "white")

    @property
    def registered_frame(self) -> FrameFigures:
        """The frame that was registered first; another where that one is not among those measured."""
        named = (frame for frame in self.frames if frame.record.file == self.session.registered_file)
        return next(named, self.frames[0])

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


def direction_error_deg(white: _Array, error: _Array) -> _Array:
    """Return the standard error (L,) float64, degrees, of the direction of vectors with small independent errors.

    The root of the mean square angle: of each component's error, the part across the vector counts (first-order
    propagation of errors).

    `white`, `error`: (L, 3) float64 and its standard errors, in one unit.
    """
    length = np.linalg.norm(white, axis=1, keepdims=True)
    along = white / np.maximum(length, 1e-9)
    across = np.sqrt((error**2 * (1 - along**2)).sum(axis=1))
    return np.degrees(across / np.maximum(length[:, 0], 1e-9))
