"""What a comparison found, as frozen values. B over A, always: A is the first table, B the second.

L common lights, C colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ComparedTable:
    """One of the two tables.

    - `place`: its folder, or that of the session that it was made of for the comparison.
    - `camera`, `software`: as `lut.json` has them.
    - `lights`, `samples`: lights, and samples of each cell.
    - `drift_corrected`: whether the lamp's drift was taken out of it.
    """

    place: Path
    camera: str
    software: str
    lights: int
    samples: int
    drift_corrected: bool


@dataclass(frozen=True, eq=False)
class LightDifferences:
    """What differs light by light.

    - `one`, `other`: (L,) int64, the light's number in A and in B.
    - `angle_deg`: (L,) float64 degrees between the two whites.
    - `angle_noise_deg`: (L,) float64 degrees, root mean square of that angle by the whites' standard errors alone; NaN
      where a table does not have them.
    - `angle_score`: (L,) float64, the angle in units of its errors: χ² of two freedoms over 2 has this squared; NaN
      likewise.
    - `brightness`: (L,) float64, length of B's white over A's, less 1.
    - `brightness_left`: (L,) float64, the same after the drift that both tables record, and the median of the lights,
      are divided out.
    - `brightness_noise`: (L,) float64, standard error of either by the whites' errors alone; NaN where it is not known.
    - `gains`: (3,) float64, B's white over A's channel by channel, median of the lights with enough of it.
    - `cell_rms`, `cell_noise`: (L,) float64, root mean square over the cells of B over A less 1, each over its own
      light's white, and what noise alone predicts of it; NaN where no cell is bright enough.
    - `cell_score`: (L,) float64, root mean square of the cells' differences in units of their standard errors: 1 by
      noise alone.
    """

    one: npt.NDArray[np.int64]
    other: npt.NDArray[np.int64]
    angle_deg: _Array
    angle_noise_deg: _Array
    angle_score: _Array
    brightness: _Array
    brightness_left: _Array
    brightness_noise: _Array
    gains: _Array
    cell_rms: _Array
    cell_noise: _Array
    cell_score: _Array


@dataclass(frozen=True, eq=False)
class CellDifferences:
    """What differs cell by cell, over all lights: B over A less 1, each over its own light's white.

    Only where both means are above `LEAST_COUNTS`; NaN where none is, and for cells that a table lists as unfit.

    - `lights`: (C, 3) int64, lights that count.
    - `mean`, `spread`: (C, 3) float64, over the lights.
    - `noise`: (C, 3) float64, standard error of `mean` by noise alone.
    - `worst`, `worst_light`: (C, 3) float64, the largest difference in units of its standard error, with its sign; (C,
      3) int64 the light of A under which it is, −1 for none.
    - `worst_share`: (C, 3) float64, that difference, relative.
    - `unfit_one`, `unfit_other`: cells that only A, and only B, lists as unfit.
    - `score`: root mean square over cells, channels and lights of differences in units of their standard errors.
    - `rms`, `predicted_rms`: root mean square of the differences, and by noise alone.
    - `offset`: (3,) float64, mean of all differences.
    """

    lights: npt.NDArray[np.int64]
    mean: _Array
    spread: _Array
    noise: _Array
    worst: _Array
    worst_light: npt.NDArray[np.int64]
    worst_share: _Array
    unfit_one: tuple[int, ...]
    unfit_other: tuple[int, ...]
    score: float
    rms: float
    predicted_rms: float
    offset: _Array

    @property
    def beyond_noise(self) -> float:
        """What of `rms` noise does not explain: the root of the difference of the squares, 0 where it explains all."""
        return float(np.sqrt(max(self.rms**2 - self.predicted_rms**2, 0.0)))


@dataclass(frozen=True)
class ColourGroup:
    """Cells of one part of the colour cube.

    - `name`: which channels of the code are in the upper half: ``black``, ``blue`` … ``white``.
    - `cells`: how many of them count.
    - `mean`, `spread`: mean and standard deviation over the cells of their mean difference, in the channel that
      deviates most.
    - `worst`: the largest mean difference, with its sign.
    """

    name: str
    cells: int
    mean: float
    spread: float
    worst: float
    worst_colour: int


@dataclass(frozen=True)
class GeometryDifference:
    """How the chart lay elsewhere in the frame that was registered first; half-size px of A's frame.

    - `shift_px`: (dx, dy) of the page's middle.
    - `turned_deg`: clockwise in the picture.
    - `scale`: B's size over A's, less 1.
    - `bent_px`: root mean square of what shift, turn and scale leave: perspective, another lens, another shape of the
      sheet.
    """

    shift_px: tuple[float, float]
    turned_deg: float
    scale: float
    bent_px: float


@dataclass(frozen=True)
class NoiseAnswer:
    """Whether one thing is the same within noise.

    - `name`: ``colour of lights``, ``brightness of lights``, ``cells``.
    - `same`: yes, no, or None where it cannot be said.
    - `said`: the numbers, in words.
    """

    name: str
    same: bool | None
    said: str


@dataclass(frozen=True, eq=False)
class TableComparison:
    """All of it."""

    one: ComparedTable
    other: ComparedTable
    warnings: tuple[str, ...]
    lights: LightDifferences
    cells: CellDifferences
    groups: tuple[ColourGroup, ...]
    geometry: GeometryDifference | None
    answers: tuple[NoiseAnswer, ...]

    @property
    def same(self) -> bool | None:
        """Whether everything is the same within noise; None where something cannot be said and nothing differs."""
        said = [answer.same for answer in self.answers]
        return False if False in said else None if None in said else True
