"""What a build, or a check, found: the figures that verdict, report and table are made from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.checks.stains import Stains
from calibration.pipeline.linearity import Linearity
from calibration.pipeline.measuring import FrameFigures
from calibration.radiometry.darkness import Darkness
from calibration.radiometry.paper import black_drift
from calibration.radiometry.photon_transfer import PhotonTransfer
from calibration.radiometry.primaries import Primaries
from calibration.registration.register import Registration
from calibration.sampling.samples import WINDOW
from calibration.table.lut import Unfit
from calibration.verdict.verdict import Verdict, figures_of, judge

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BuildResult:
    """What a build, or a check, found.

    Attributes
    ----------
    session
        The session's folder.
    lut
        The table's folder; None after a check.
    camera
        Maker and model.
    registration
        Of the frame that was registered first.
    registered_file
        That frame, relative to the session.
    lights
        Lights in the table.
    white, white_error
        (L, 3) float64, ground truth and its standard error, units of the samples.
    white_level
        Sample value of saturation.
    unfit
        Cells not to be used.
    stains
        Where the print is not of its codes' colours, in the order of colour indices.
    frames
        Figures of every frame read, in order.
    noise
        (3,) float64, median standard deviation of one sample under white, relative to paper white.
    white_references
        White references of the chart.
    grey_names
        Levels of grey of the chart, G.
    greys, grey_errors
        (L, G, 3) float64, each level under each light and its standard error, units of the samples.
    darkness
        What the dark frames say; of a check, the first of them.
    added
        (3,) by how much the primaries together differ from white, relative; None where the session cannot tell.
    gains
        (L, 3) the lamp's drift at each light, as the white frames have it.
    transfer
        Noise of the cells of the frame that was registered first.
    saturated
        Whether a photosite of a cell reached saturation, so that its count was measured.
    window
        Pixels along the side of a cell's window.
    subtracted
        (L, 3) dark light of bare paper that was subtracted from each light; None where none was to be.
    at_zero
        (L,) share of each light's samples that are 0 in the table.
    linearity
        What a series of exposures said; None where none was given.
    primaries
        The primaries each alone, by which the field of coloured cells was told from that of paper; None where the plan
        has no light of each alone, or it is too dim.
    off_codes_deg
        (L,) how far each white is off what its codes give, degrees (`calibration.checks.labels`); None where the lights
        are too few, or not exposed alike.
    """

    session: Path
    lut: Path | None
    camera: str
    registration: Registration
    registered_file: str
    lights: int
    white: _Array
    white_error: _Array
    white_level: int
    unfit: tuple[Unfit, ...]
    stains: Stains
    frames: tuple[FrameFigures, ...] = field(default=())
    noise: _Array = field(default_factory=lambda: np.zeros(3))
    white_references: int = 0
    grey_names: tuple[str, ...] = ()
    greys: _Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    grey_errors: _Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    darkness: Darkness = field(default_factory=Darkness)
    added: _Array | None = None
    gains: _Array = field(default_factory=lambda: np.ones((0, 3)))
    transfer: PhotonTransfer | None = None
    saturated: bool = False
    window: int = WINDOW
    subtracted: _Array | None = None
    at_zero: _Array = field(default_factory=lambda: np.zeros(0))
    linearity: Linearity | None = None
    primaries: Primaries | None = None
    off_codes_deg: _Array | None = None

    @property
    def verdict(self) -> Verdict:
        """The figures against their limits."""
        return judge(figures_of(self))

    @property
    def largest_shift_px(self) -> float:
        """The chart's largest movement between a frame and the registration it was sampled with before correction."""
        return max((figures.shift.length_px for figures in self.frames), default=0.0)

    @property
    def black_drift(self) -> float:
        """Drift of the black level over the session, counts."""
        return black_drift([*(figures.black for figures in self.frames), *self.darkness.blacks])

    @property
    def white_drift(self) -> float:
        """Largest relative change of paper white between white frames, over the channels."""
        whites = np.array([figures.paper.white for figures in self.frames if figures.record.kind == "white"])
        return float((np.ptp(whites, axis=0) / whites.mean(axis=0)).max()) if len(whites) > 1 else 0.0


@dataclass(frozen=True)
class Growth:
    """How far a table is that still lacks frames: lights in it, of how many, and frames taken in now and before."""

    lights: int
    of: int
    new_frames: int
    frames: int
