"""Images exposed like those of a real data set."""

from __future__ import annotations

from typing import Final

import numpy as np

from generator.statistics.statistics_file import RealStatistics
from generator.variation.variation import AutomaticExposure

SHARE: Final = 0.01
"""Share of an image's pixels whose brightest channel is brighter than its exposure: so `evaluate describe` has it."""

_LEAST: Final = 0.001
"""Least exposure that is followed: below it an image is black."""


def like_exposure(target: RealStatistics) -> AutomaticExposure | None:
    """Return the exposure by which images reach the levels that those of a real data set reach.

    Returns the levels drawn by eleven quantiles; None where the real data set's saturation is not known.
    """
    known = target.known("exposure")
    if not known.size:
        return None
    levels = np.percentile(known, np.linspace(0, 100, 11), method="hazen")
    return AutomaticExposure(SHARE, tuple(float(f"{level:.6g}") for level in np.clip(levels, _LEAST, 1.0)))


def exposure_sentence(target: RealStatistics) -> str:
    """Return in one line how images are exposed."""
    known = target.known("exposure")
    if not known.size:
        return f"exposure: that of {target.name} is not known without its saturation; images are exposed as the table"
    low, middle, high = np.percentile(known, (10, 50, 90), method="hazen")
    return f"exposure: {middle:.2f} of saturation in the median, {low:.2f} to {high:.2f} in eight of ten images"
