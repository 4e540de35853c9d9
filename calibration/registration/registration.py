"""The chart's place in a frame, as a value."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calibration.registration.blocks import Blocks, PlaceErrors
from calibration.registration.colour_model import ColourModel
from calibration.registration.displacement import Displacement
from calibration.registration.lateral_colour import LateralColour
from calibration.registration.lens import Lens
from calibration.sampling.windows import SAMPLE_REACH_PX
from experiment.framing.finding import Framing
from experiment.framing.homography import rms
from experiment.framing.planes import Channel

MAX_PLACE_ERROR_PX = 0.5
"""Three standard errors of the place of a cell of 10 px, at most: at 0.5 px the outermost of its 25 pixels, rounding
included, has 0.1 % of its light from the next cell at a blur of 0.7 px (`calibration.sampling.windows`)."""

CLEARANCE_PX = 1.75
"""From there to the edge of a cell of 10 px, for which the limits of places were found."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Registration:
    """The chart's place in a frame.

    - `framing`: the tags, or the field's outline, as found.
    - `lens`, `displacement`: the two parts of the map of green.
    - `lateral`: where red and blue lie against it.
    - `marks_residual_px`: (N, 2) float64, the tags' corners against the final map; of a chart without tags the field's
      outline, across.
    - `lens_residual_px`: RMS of the same against the lens alone: what the paper's waviness leaves.
    - `blocks`: fit of the cells.
    - `place_errors`: how well places are known.
    - `colours`: the colour model of the frame.
    - `mismatched_cells`: (N,) bool, cells in the chart's order whose colour is not nearly the model's: covered,
      damaged, misprinted.
    - `agreement`: correlation of the cells' colours with the model's, the mean of the channels that carry light.
    - `blur_px`: σ of the tags' edges, or of the field's.
    - `cell_px`: half-size pixels per cell, the shorter side of the smallest.
    - `shift_px`: movement since the frame that was registered, (dx, dy).
    """

    framing: Framing
    lens: Lens
    displacement: Displacement
    lateral: LateralColour
    marks_residual_px: _Array
    lens_residual_px: float
    blocks: Blocks
    place_errors: PlaceErrors
    colours: ColourModel
    mismatched_cells: _Mask
    agreement: float
    blur_px: float
    cell_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)

    def to_pixels(self, points_mm: npt.ArrayLike, channel: Channel = "G") -> _Array:
        """Return the half-size pixels (N, 2) float64, x then y, where a channel sees points (N, 2) on the print.

        The lens shifts red and blue against green. Samples are taken where green is.
        """
        places = self.lens.to_pixels(points_mm) + self.displacement.at(points_mm) + self.shift_px
        return places + self.lateral.shift_px(places, channel)

    def uncertainty_px(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard error (N,) float64 px of the places of points (N, 2) on the print, in green."""
        return self.place_errors.at(points_mm)

    def uncertain(self, points_mm: npt.ArrayLike) -> _Mask:
        """Return which points (N,) bool are known too badly to be sampled: three standard errors exceed the limit."""
        return np.asarray(3 * self.uncertainty_px(points_mm) > MAX_PLACE_ERROR_PX * self.clearance)

    @property
    def places_known_px(self) -> tuple[float, float]:
        """Standard error of places, px: the median over the field, and the largest of the outermost cells but 1 %."""
        error = self.place_errors.error_px
        rim = np.concatenate([error[1], error[-2], error[:, 1], error[:, -2]])
        return float(np.median(error)), float(np.percentile(rim, 99))

    def shifted(self, dx: float, dy: float) -> Registration:
        """Return this registration for a frame in which the chart lies (dx, dy) px further."""
        return replace(self, shift_px=(self.shift_px[0] + dx, self.shift_px[1] + dy))

    @property
    def marks_rms_px(self) -> float:
        """RMS distance of the tags' corners, or the field's outline, from the final map."""
        return rms(self.marks_residual_px)

    @property
    def block_rms_px(self) -> float:
        """RMS displacement that the good blocks would still need: the registration's own estimate of its error."""
        return rms(self.blocks.residual_px[self.blocks.good])

    @property
    def clearance(self) -> float:
        """How much further samples are from their cells' edges than in cells of 10 px, ≥ 1: places matter less by it.

        Cells of a hundred pixels are found to a pixel, which is nothing to them.
        """
        return max(1.0, (self.cell_px / 2 - SAMPLE_REACH_PX) / CLEARANCE_PX)
