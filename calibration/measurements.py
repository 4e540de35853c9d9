"""Types for the measurements of a build or a check. Verdict, report and LUT are based on them.

L illuminants, C colours, G printed greys, S samples per patch. Counts are above the black level unless called raw.
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
    """Measurements of one frame of an illuminant or of white."""

    record: FrameRecord
    black: FloatArray  # (2, 2) float64 counts, black level of each position of the Bayer block
    channel: Channel  # Channel in which the chart's movement was measured
    shift: Shift  # Movement since the frame that was registered last
    reregistered: bool  # True if the chart had moved too far and was registered again in this frame
    paper: Paper
    consistency: FrameConsistency
    greys: _Levels  # (G, 3) float64 counts above black of each printed grey, divided by the flat field
    grey_errors: _Levels  # (G, 3) float64 counts, standard errors of `greys`
    dark: FloatArray  # (3,) float64 counts, dark light on bare paper that was subtracted; 0 without subtraction
    share_at_zero: float  # Fraction of the frame's samples in the LUT that are 0
    blur_px: float  # σ of the frame's blur, half-size px: from the frame registered last and the change since then
    exposure: float  # Shutter time × ISO speed / f-number² from the raw file, s; 0 if unknown
    origin: FrameOrigin


@dataclass(frozen=True, eq=False)
class LinearityMeasurements:
    """Deviation of counts from proportionality to light (EMVA 1288, release 4.0, linearity error)."""

    files: tuple[str, ...]  # Frames by increasing exposure
    level: _Array  # (B,) float64, increasing, relative to saturation
    deviation: _Array  # (3, B) float64, relative deviation of R, G, B from the best straight line; NaN without data

    @property
    def worst(self) -> float:
        """Largest relative deviation."""
        return float(np.nanmax(np.abs(self.deviation)))

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest level with data, relative to saturation."""
        measured = np.flatnonzero(np.isfinite(self.deviation).any(axis=0))
        return float(self.level[measured[0]]), float(self.level[measured[-1]])

    def to_json(self) -> list[tuple[float, list[float | None]]]:
        """Return each level with the deviations of R, G and B for `report.json`; None without data."""

        def rounded(values: _Array) -> list[float | None]:
            return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]

        levels = self.level.tolist()
        return [(float(f"{level:.4g}"), rounded(self.deviation[:, number])) for number, level in enumerate(levels)]


@dataclass(frozen=True)
class SessionMeasurements:
    """Properties of the session."""

    folder: Path
    camera: str
    lights: int  # Number of illuminants
    registered_file: str  # Frame that was registered first, relative to the session
    white_references: int
    codes: tuple[tuple[int, int, int], ...]  # 8-bit codes of each planned illuminant


# Relative standard deviation of a frame's brightness, if it cannot be measured. Chosen by judgement.
_USUAL_SCATTER = 0.001

_SCATTER_FRAMES = 3  # White frames needed to measure this scatter


@dataclass(frozen=True, eq=False)
class LightMeasurements:
    """Measurements of the illuminants. After `build-lut check`, there is only the row of its frame."""

    white: _Array  # (L, 3) float64 counts, ground truth in the units of the samples
    white_error: _Array  # (L, 3) float64 counts, standard error of `white`
    gains: _Array  # (L, 3) float64, lamp brightness relative to the first white frame; 1 if unknown
    # (L, 3) float64 counts, dark light on bare paper that was subtracted; None without subtraction
    subtracted: _Array | None
    # (L,) float64, fraction of each illuminant's samples in the LUT that are 0; (0,) after a check
    share_at_zero: _Array
    additivity: Additivity | None  # White compared with the sum of the primaries; None if a frame is missing
    # Agreement of illuminants and codes; None after a check. In `exchanges` and `seen_as`, indices ≥ L are white frames
    codes: CodeAgreement | None
    # Agreement of white frames and full white; None without white frames. If they differ by drift alone,
    # only the first is compared
    white_frames: CodeAgreement | None
    # Drift correction in the LUT; None if not requested. All other values are as measured
    drift: DriftCorrection | None = None
    # Light that dark frames do not contain; None if the frame of a primary alone or a dark frame is missing
    stray: StrayLight | None = None

    @property
    def brightest(self) -> _Array:
        """(3,) float64 counts of bare paper under the brightest illuminant."""
        brightest: _Array = self.white[int(np.argmax(self.white.sum(axis=1)))]
        return brightest

    @property
    def off_codes_deg(self) -> _Array | None:
        """(L,) float64 degrees, significant angle between each ground truth and its prediction; None after a check.

        For exchanged illuminants, it is at least the angle between their predictions.
        """
        if self.codes is None:
            return None
        angle_deg = self.codes.off_deg.copy()
        for pair in self.codes.exchanges:
            indices = [light for light in (pair.one, pair.other) if light < len(angle_deg)]
            angle_deg[indices] = np.maximum(angle_deg[indices], pair.angle_deg)
        return angle_deg

    def lights_off_codes(self, accepted_deg: float) -> list[int]:
        """Return the illuminants that deviate from their codes by more than `accepted_deg`, the worst first."""
        deg = self.off_codes_deg
        return [] if deg is None else [int(light) for light in np.argsort(-deg) if deg[light] > accepted_deg]


@dataclass(frozen=True, eq=False)
class GreyMeasurements:
    """Measurements of the printed greys."""

    names: tuple[str, ...]
    values: _Array  # (L, G, 3) float64 counts divided by the flat field; NaN if no patch is usable
    errors: _Array  # (L, G, 3) float64 counts, standard errors of `values`

    def tints_deg(self, white: _Array) -> _Array:
        """Return the angles (G,) between greys and white, degrees.

        The illuminant with the most counts in its weakest channel is used, because its noise is lowest.

        `white`: (L, 3) float64 counts, the ground truth.
        """
        if not self.names:
            return np.zeros(0)
        best = int(np.argmax(white.min(axis=1)))
        return angles_deg(white[best], self.values[best])


@dataclass(frozen=True, eq=False)
class SensorMeasurements:
    """Measurements of the sensor."""

    saturation_counts: int  # Raw count of saturation
    saturation_measured: bool  # True if a photosite of a patch reached saturation; else the count is from the raw file
    white_level: int  # Saturation in counts above black
    noise: _Array  # (3,) float64, median standard deviation of one sample under white, relative to paper white
    transfer: PhotonTransfer  # Photon-transfer curve of the frame registered first
    linearity: LinearityMeasurements | None
    superposition: Superposition  # Nonlinearity, from a mixture of primaries compared with each primary alone


@dataclass(frozen=True, eq=False)
class CellMeasurements:
    """Measurements of the chart's patches."""

    window: int  # Side of the sampling window, px; S = window²
    unfit: tuple[Unfit, ...]  # Patches that must not be used, with the reason
    stains: Stains  # Areas of the print with colours that do not match their codes
    levels: _Array  # (C, 3) float64, each patch in the frame registered first, relative to bare paper
    added: AddedLight  # Light that is added equally to dark and bright patches of an area, for example by a reflection


@dataclass(frozen=True, eq=False)
class TableMeasurements:
    """All measurements of a build or a check."""

    session: SessionMeasurements
    registration: Registration
    frames: tuple[FrameMeasurements, ...]  # Frames of illuminants and of white, in the order taken
    lights: LightMeasurements
    greys: GreyMeasurements
    sensor: SensorMeasurements
    dark_frames: DarkSummary  # Dark frames; only the first one in a check
    cells: CellMeasurements
    origins: OriginFigures  # Frames with another camera, lens or exposure than most frames
    # Frames of the primaries alone, for the flat field of coloured patches; None if a frame is missing or too dim
    primaries: Primaries | None
    lens: LensFigures  # Light that the lens spreads, and its correction
    point_spread: PointSpread | None  # None if the spread was not measured
    origin: OriginRecord  # Camera, settings, time and author of the frames
    budget: Budget

    @property
    def is_of_one_frame(self) -> bool:
        """True for a check, which reads one frame of an illuminant or of white, and one dark frame."""
        return self.lights.codes is None

    @property
    def primary_lights(self) -> tuple[int, ...]:
        """Indices of full red, green and blue alone; () if one is missing."""
        index_by_codes = {codes: light for light, codes in enumerate(self.session.codes)}
        alone = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
        return tuple(index_by_codes[codes] for codes in alone) if index_by_codes.keys() >= set(alone) else ()

    @property
    def white_frames(self) -> tuple[FrameMeasurements, ...]:
        """The white frames, in the order taken."""
        return tuple(frame for frame in self.frames if frame.record.kind == "white")

    @property
    def registered_frame(self) -> FrameMeasurements:
        """The frame registered first; if it was not measured, the first measured frame."""
        candidates = (frame for frame in self.frames if frame.record.file == self.session.registered_file)
        return next(candidates, self.frames[0])

    def added_bleed(self, frame: FrameMeasurements) -> float:
        """Return the light of neighbouring patches in the worst sample, minus this light in the registered frame."""
        registration, window = self.registration, self.cells.window
        own, first = (bleed(registration.cell_px, px, window) for px in (frame.blur_px, registration.blur_px))
        return own - first

    @property
    def largest_shift_px(self) -> float:
        """Largest movement of the chart between a frame and its registration, half-size px."""
        return max((frame.shift.length_px for frame in self.frames), default=0.0)

    @property
    def black_drift(self) -> float:
        """Drift of the black level over the session, counts."""
        return black_drift([*(frame.black for frame in self.frames), *self.dark_frames.blacks])

    @property
    def white_drift(self) -> float:
        """Largest relative difference of paper white between white frames, in the worst channel."""
        whites = np.array([frame.paper.white for frame in self.white_frames])
        return float((np.ptp(whites, axis=0) / whites.mean(axis=0)).max()) if len(whites) > 1 else 0.0

    @property
    def white_scatter(self) -> float:
        """Relative standard deviation of white frames' brightness about the mean of the frames before and after."""
        whites = np.array([frame.paper.white.sum() for frame in self.white_frames])
        if len(whites) < _SCATTER_FRAMES:
            return _USUAL_SCATTER
        deviations = whites[1:-1] - (whites[:-2] + whites[2:]) / 2
        return float(np.sqrt((deviations**2).mean() / 1.5) / whites.mean())

    @property
    def dark_share(self) -> float:
        """Light on bare paper while the projector shows black, relative to white, worst channel; NaN if unknown."""
        share = np.abs(self.dark_frames.light / self._full_white).max()
        return float(share) if np.isfinite(self.dark_frames.light).all() else float("nan")

    @property
    def dark_change(self) -> float:
        """Change of the light in dark frames during the session, relative to white; NaN with one dark frame."""
        lights = self.dark_frames.lights
        return float((np.ptp(lights, axis=0) / self._full_white).max()) if len(lights) > 1 else float("nan")

    @property
    def _full_white(self) -> _Array:
        # The brightest illuminant replaces missing white frames.
        whites = [frame.paper.white for frame in self.white_frames]
        return np.mean(whites, axis=0) if whites else self.lights.brightest
