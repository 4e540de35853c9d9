"""The sensor's range in a frame: its black level below, its saturation above. Raw counts of the camera.

Black is each frame's own, one value for each position of the 2×2 block. Raw counts are never scaled in time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic

_Array = npt.NDArray[np.float64]

MAX_BLACK_DRIFT = 1.0
"""Counts that the black level may drift over a session without a remark (judgement): a sixth of the read noise of a
photosite, and a thirtieth of the darkest cells of use."""

_PLATEAU = 64
"""Photosites at a frame's highest count from which on that count is saturation: noise does not pile up so at one."""


def saturation(mosaic: Mosaic) -> int:
    """Return the raw count at which the sensor saturates, as far as this frame shows it.

    What the metadata state, or what the frame shows if that is lower: a plateau of at least 64 photosites at the
    frame's highest count. LibRaw's tables state 15 831 for an EOS 550D that saturates at 13 584 (ISO 100), so a
    session without one clipped photosite keeps the stated value and its clipping limit lies too high; it does no harm
    there, as nothing came near.
    """
    counts = mosaic.counts
    top = int(counts.max())
    if top < mosaic.white_level and int(np.count_nonzero(counts == top)) >= _PLATEAU:
        return top
    return mosaic.white_level


def black_drift(blacks: Sequence[_Array]) -> float:
    """Return the largest drift of the black level of any position of the block over frames, counts.

    `blacks` are (2, 2) float64 counts each.
    """
    if not blacks:
        return 0.0
    return float(np.ptp(np.stack(blacks), axis=0).max())
