"""A mosaic becomes linear camera RGB at half size: one pixel for each 2×2 block, nothing interpolated.

The paper's "simple subsampling and debayering" (section 3.3): red, the mean of both greens, blue, after the black level
has been subtracted, each phase its own. An odd last row or column is dropped. Pixel (i, j) is the block whose
top-left photosite is (2i, 2j); its red and blue were measured a quarter pixel beside its centre, which matters to
registration alone.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic
from experiment.framing.planes import CHANNELS, frame_black, phases


def half_size(mosaic: Mosaic, black: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float32]:
    """Return a frame as linear RGB.

    `black`: (2, 2) float64 counts of each position of the block; the masked border's mean if not given, or where there
    is none, what the metadata state. Returns (H // 2, W // 2, 3) float32, counts above black; noise makes some of a
    dark frame's negative.
    """
    black = frame_black(mosaic) if black is None else black
    blocks = mosaic.block_planes()
    image = np.empty((*blocks.shape[2:], 3), dtype=np.float32)
    for column, channel in enumerate(CHANNELS):
        places = phases(mosaic)[channel]
        image[..., column] = sum(blocks[place] - np.float32(black[place]) for place in places) / np.float32(len(places))
    return image
