"""How bright the counts of a frame are, and how many photosites are clipped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.raw.rawfile import CLIPPING_SHARE, Mosaic, frame_black

# Percentile that stands for the brightest counts: bare paper fills more than a thousandth of a frame, hot photosites
# and reflections less.
BRIGHTEST_PERCENTILE = 99.9


@dataclass(frozen=True)
class Exposure:
    """How bright a frame's counts are.

    - `clipped`: share of photosites at or above `CLIPPING_SHARE` of saturation, 0 … 1.
    - `brightest_dn`: `BRIGHTEST_PERCENTILE` of the counts above black, of the brightest position of the 2×2 block.
    - `range_dn`: saturation minus black.
    """

    clipped: float
    brightest_dn: float
    range_dn: float

    @property
    def level(self) -> float:
        """Brightest counts as a share of the sensor's range, 0 … 1."""
        return self.brightest_dn / self.range_dn


def measure_exposure(mosaic: Mosaic) -> Exposure:
    """Return how bright a mosaic's visible area is; every fourth 2×2 block is enough for the percentile."""
    black = frame_black(mosaic)
    clipped = np.count_nonzero(mosaic.counts >= CLIPPING_SHARE * mosaic.white_level) / mosaic.counts.size
    planes = mosaic.block_planes()[:, :, ::2, ::2].reshape(2, 2, -1)
    brightest = np.percentile(planes, BRIGHTEST_PERCENTILE, axis=2) - black
    return Exposure(float(clipped), float(brightest.max()), float(mosaic.white_level - black.mean()))
