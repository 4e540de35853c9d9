"""Brightness of the counts of a frame, and fraction of clipped photosites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.raw.rawfile import CLIPPING_SHARE, Mosaic, frame_black

# Percentile used as the brightest counts: bare paper fills more than a thousandth of a frame, hot photosites and
# reflections less.
BRIGHTEST_PERCENTILE = 99.9


@dataclass(frozen=True)
class Exposure:
    """Brightness of the counts of a frame."""

    clipped: float  # fraction of photosites at or above `CLIPPING_SHARE` of saturation, 0 … 1
    brightest_dn: float  # `BRIGHTEST_PERCENTILE` of counts above black, brightest position of the 2×2 block
    range_dn: float  # saturation level minus black level

    @property
    def level(self) -> float:
        """Brightest counts relative to the range of the sensor, 0 … 1."""
        return self.brightest_dn / self.range_dn


def measure_exposure(mosaic: Mosaic) -> Exposure:
    """Measure the brightness of the visible area of a frame."""
    black = frame_black(mosaic)
    clipped = np.count_nonzero(mosaic.counts >= CLIPPING_SHARE * mosaic.white_level) / mosaic.counts.size
    # Every fourth block is enough for the percentile.
    planes = mosaic.block_planes()[:, :, ::2, ::2].reshape(2, 2, -1)
    brightest = np.percentile(planes, BRIGHTEST_PERCENTILE, axis=2) - black
    return Exposure(float(clipped), float(brightest.max()), float(mosaic.white_level - black.mean()))
