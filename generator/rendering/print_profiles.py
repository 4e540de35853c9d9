"""What a camera sees of every cell of the chart under a light, from the table itself.

The samples of a table are linear camera RGB, and its ground truth is what the camera sees of an ideal white. So the
mean of a cell's samples over the white of the light is the cell's reflectance as this camera sees it under this
light, and 1, 1, 1 is a grey that is as bright as can be. Rules that hold inside:

- The mean counts, not the median: a picture made from the table shows samples as they are, each as often as another.
- A cell that is not to be trusted is left out and not repaired: one that the table lists as unfit, one with a clipped
  sample, whose mean is too low, and one whose mean a few odd samples have moved.
- Black and white are neutral: the darkest and the brightest grey that mixtures of cells make exactly. A print's own
  black and its paper are tinted, and greys mapped between them would be, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import QualityError
from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR
from generator.lights.lighting import single_mixture

if TYPE_CHECKING:
    from calibration.table.lut import Lut

# Distance of a cell's mean from its median, in standard errors, from which its mean is not trusted: far beyond the
# tails of 100 000 cells and channels of normal samples, where the standard error is known to a seventh from 25
# samples; one photosite of 25 that is clipped beside a cell of a tenth of saturation moves the mean by more.
ODD_SIGMAS: Final = 8.0

ODD_SHIFT: Final = 0.02  # Least shift of a mean, relative to the median, that matters: 0.02 is a degree of hue at most

# White point over the brightest grey that the print's cells can make: at the very edge of the gamut, cells of unlike
# colours would have to be mixed. Greys near white are then within 0.1 degrees on simulated unmanaged prints.
WHITE_MARGIN: Final = 0.99

# White point over the mean of the paper at most, so that white, too, is drawn from several cells.
PAPER_MARGIN: Final = 0.97

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrintProfile:
    """What a camera sees of each cell of a chart under one light.

    - `colours`: (8**bits, 3) float64, mean of each cell's samples over the white of the light; 1 = what an ideal white
      shows.
    - `usable`: (8**bits,) bool, whether a cell's mean is to be trusted; see the head of this file. At least one is.
    """

    colours: _Array
    usable: npt.NDArray[np.bool_]

    @property
    def bits(self) -> int:
        """Bits of a channel of the chart, 1 … 5."""
        return (len(self.colours).bit_length() - 1) // 3

    @property
    def black(self) -> float:
        """The darkest grey that mixtures of cells make, or how bright the print's black is; 1 = ideal white."""
        return self._neutral[0]

    @property
    def white(self) -> float:
        """The white point: the brightest grey that is asked of the print; 1 = ideal white."""
        return self._neutral[1]

    @cached_property
    def _neutral(self) -> tuple[float, float]:
        brightness = self.colours.mean(axis=1)
        usable = np.flatnonzero(self.usable)
        darkest, brightest = (float(pick(brightness[usable])) for pick in (np.min, np.max))
        if self.usable[0]:
            darkest = float(brightness[0])
        if self.usable[-1]:
            brightest = float(brightness[-1])
        ends = neutral_ends(self.colours[usable])
        if ends is not None:
            darkest, brightest = max(darkest, ends[0]), min(brightest * PAPER_MARGIN, ends[1] * WHITE_MARGIN)
        # A print without contrast, or one that has no grey between its black and its paper, is one grey.
        return darkest, max(darkest, brightest)


def profile_of(lut: Lut, light: int) -> PrintProfile:
    """Return what the camera of a table sees of each cell under one of its lights."""
    white = single_mixture(light).white(lut)
    samples = lut.light_samples(light)
    means = samples.mean(axis=1, dtype=np.float64)
    usable = (samples.max(axis=(1, 2)) < lut.provenance.white_level) & ~odd_cells(samples, means)
    # A channel that sees nothing of a cell, in noise about 0, has no relative difference to anything.
    usable &= means.min(axis=1) > 0
    usable[[cell.colour for cell in lut.provenance.unfit]] = False
    if not usable.any():
        raise QualityError(
            f"under light {light} no cell of the table {lut.folder} is fit for a profile of its print: all are listed "
            "as unfit, clipped, or dark; choose other lights, or build the table again from a shorter exposure"
        )
    return PrintProfile(means / white, usable)


def odd_cells(samples: npt.NDArray[np.uint16], means: _Array) -> npt.NDArray[np.bool_]:
    """Return which cells have means that a few odd samples have moved: hot photosites, dust.

    `samples`: (N, S, 3) uint16, the samples of a light. `means`: (N, 3) float64, their means. Returns (N,) bool.
    """
    medians = np.median(samples, axis=1)
    deviations = np.median(np.abs(samples - medians[:, None]), axis=1)
    # Half a count for rounding: without it, samples that are mostly one number have no scale.
    sigmas = MEDIAN_ERROR * MAD_TO_SIGMA * np.maximum(deviations, 0.5) / np.sqrt(samples.shape[1])
    shifts = np.abs(means - medians)
    return ((shifts > ODD_SIGMAS * sigmas) & (shifts > ODD_SHIFT * medians)).any(axis=1)


def neutral_ends(colours: _Array) -> tuple[float, float] | None:
    """Return the darkest and the brightest grey (g, g, g) that mixtures of colours make exactly.

    They are where the grey axis enters and leaves the convex hull of the colours.

    `colours`: (N, 3) float64, linear. Returns the two values of g; None if no mixture is grey, or the colours lie in a
    plane.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        planes: Any = ConvexHull(colours).equations
    except (QhullError, ValueError):
        return None
    # Inside, every plane has normal · g (1, 1, 1) + offset ≤ 0.
    slopes, offsets = planes[:, :3].sum(axis=1), planes[:, 3]
    entering, leaving = slopes < 0, slopes > 0
    if not entering.any() or not leaving.any():
        return None
    low = float((-offsets[entering] / slopes[entering]).max())
    high = float((-offsets[leaving] / slopes[leaving]).min())
    return (low, high) if 0 < low < high else None
