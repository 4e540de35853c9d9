"""Measure what a camera records of each patch of the chart under one illuminant, from the look-up table (LUT).

The mean of the samples of a patch, divided by the white of the illuminant, is the reflectance as this camera records
it; (1, 1, 1) is an ideal white. Unreliable patches are excluded, not repaired. Black and white are the darkest and the
brightest grey that mixtures of patches make exactly. The black patch and the paper are tinted, and greys between them
would be tinted, too.
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

# The mean of a patch is unreliable if it is more than this many standard errors from the median. With normally
# distributed samples, the means of 100 000 patches are far within this limit. One clipped photosite of 25 in a
# patch at 0.1 of saturation moves the mean by more.
ODD_SIGMAS: Final = 8.0

ODD_SHIFT: Final = 0.02  # Smallest relevant shift of a mean, relative to the median: 0.02 changes the hue by 1° at most

# White point relative to the brightest grey that patches can make. At the very edge of the gamut, patches of different
# colours would have to be mixed. With this margin, greys near white of simulated unmanaged prints are within 0.1°.
WHITE_MARGIN: Final = 0.99

# Largest white point relative to the mean of the paper. Below 1, white is interpolated like other greys.
PAPER_MARGIN: Final = 0.97

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrintProfile:
    """Colours of all patches of a chart under one illuminant.

    - `colours`: (8**bits, 3) float64, mean of the samples of each patch relative to the white; 1 = ideal white.
    - `usable`: (8**bits,) bool, whether the mean of a patch is reliable; at least one is.
    """

    colours: _Array
    usable: npt.NDArray[np.bool_]

    @property
    def bits(self) -> int:
        """Bits per channel of the chart, 1 … 5."""
        return (len(self.colours).bit_length() - 1) // 3

    @property
    def black(self) -> float:
        """The darkest grey that mixtures of patches make, or the print's black if none is grey; 1 = ideal white."""
        return self._neutral[0]

    @property
    def white(self) -> float:
        """The white point, the brightest grey that the print is used for; 1 = ideal white."""
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
        # A print without contrast, or without a grey between black and paper, has equal black and white points.
        return darkest, max(darkest, brightest)


def profile_of(lut: Lut, light: int) -> PrintProfile:
    """Return the colours of all patches under illuminant `light` of the LUT."""
    white = single_mixture(light).white(lut)
    samples = lut.light_samples(light)
    # The mean is used, not the median, because rendering draws each sample equally often.
    means = samples.mean(axis=1, dtype=np.float64)
    # A patch with a clipped sample has a mean that is too low.
    usable = (samples.max(axis=(1, 2)) < lut.provenance.white_level) & ~odd_cells(samples, means)
    # A channel that records only noise around 0 has no relative differences.
    usable &= means.min(axis=1) > 0
    usable[[cell.colour for cell in lut.provenance.unfit]] = False
    if not usable.any():
        raise QualityError(
            f"under illuminant {light} 0 patches of the LUT {lut.folder} are usable, expected 1 or more: all are "
            "listed as unfit, clipped or dark; choose other illuminants, or build the LUT again from a shorter exposure"
        )
    return PrintProfile(means / white, usable)


def odd_cells(samples: npt.NDArray[np.uint16], means: _Array) -> npt.NDArray[np.bool_]:
    """Return which patches have a mean that a few outliers have moved (hot photosites, dust), (N,) bool.

    `samples`: (N, S, 3) uint16, samples of an illuminant. `means`: (N, 3) float64, their means.
    """
    medians = np.median(samples, axis=1)
    deviations = np.median(np.abs(samples - medians[:, None]), axis=1)
    # Rounding errors reach half a count, but mostly equal samples would have a deviation of 0.
    sigmas = MEDIAN_ERROR * MAD_TO_SIGMA * np.maximum(deviations, 0.5) / np.sqrt(samples.shape[1])
    shifts = np.abs(means - medians)
    return ((shifts > ODD_SIGMAS * sigmas) & (shifts > ODD_SHIFT * medians)).any(axis=1)


def neutral_ends(colours: _Array) -> tuple[float, float] | None:
    """Return the darkest and the brightest grey (g, g, g) that mixtures of colours make exactly.

    The grey axis enters and leaves the convex hull of the colours (N, 3), float64, linear, at these values of g.
    Returns None if no mixture is grey, or if the colours lie in a plane.
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
