"""Measure the largest counts of a frame and the fraction of clipped photosites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.raw.rawfile import CLIPPING_SHARE, Mosaic, frame_black

# Percentile of the counts that represents the maximum. Bare paper covers more than 0.1 % of a frame, hot photosites and
# reflections cover less.
BRIGHTEST_PERCENTILE = 99.9


@dataclass(frozen=True)
class Exposure:
    """Exposure of a frame, measured in its counts."""

    clipped: float  # fraction of photosites at or above `CLIPPING_SHARE` of saturation, 0 … 1
    brightest_dn: float  # `BRIGHTEST_PERCENTILE` of the counts above black, at the brightest position of the 2×2 block
    range_dn: float  # saturation level minus black level

    @property
    def level(self) -> float:
        """Brightest counts relative to saturation, 0 … 1, both above black."""
        return self.brightest_dn / self.range_dn


def measure_exposure(mosaic: Mosaic) -> Exposure:
    """Measure the exposure of the visible area of a frame."""
    black = frame_black(mosaic)
    clipped = np.count_nonzero(mosaic.counts >= CLIPPING_SHARE * mosaic.white_level) / mosaic.counts.size
    # Every fourth block is enough for the percentile.
    planes = mosaic.block_planes()[:, :, ::2, ::2].reshape(2, 2, -1)
    brightest = np.percentile(planes, BRIGHTEST_PERCENTILE, axis=2) - black
    return Exposure(float(clipped), float(brightest.max()), float(mosaic.white_level - black.mean()))
