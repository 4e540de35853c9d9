"""What a camera should see of the colours of a picture: linear, through the colour matrix of its body.

Source colours are nodes: of each channel 32 sRGB codes 255 k / 31, k = 0 … 31. A picture's codes lie between nodes, and
are shared out among them by dithering.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import decode_srgb
from generator.kernels.palette import channels_of
from generator.rendering.matrices import ColourMatrix

NODE_BITS: Final = 5
"""Bits of a channel of the source nodes: at 32 codes a channel, interpolating between nodes errs by less than the
samples of a cell differ."""

NODES: Final = 8**NODE_BITS
"""Number of source nodes."""


def node_codes() -> npt.NDArray[np.float64]:
    """Return the sRGB codes 0 … 1 of the source nodes, (32768, 3) float64; node (r << 10) | (g << 5) | b.

    Examples
    --------
    >>> node_codes()[[0, 31, 32767]].tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    """
    return channels_of(np.arange(NODES), NODE_BITS) / (2.0**NODE_BITS - 1)


def source_colours(matrix: ColourMatrix) -> npt.NDArray[np.float64]:
    """Return what the camera should see of each source node, over white: clip(C · linear sRGB, 0, 1).

    `matrix`: linear sRGB to camera RGB, rows of sum 1, so that a grey is a grey to the camera, too. Returns (32768, 3)
    float64, 0 … 1.

    Examples
    --------
    >>> from generator.rendering.matrices import camera_matrix
    >>> source_colours(camera_matrix("550D"))[[0, 31, 32767]].round(3).tolist()
    [[0.0, 0.0, 0.0], [0.079, 0.238, 0.748], [1.0, 1.0, 1.0]]
    """
    return np.clip(decode_srgb(node_codes()) @ matrix.rows.T, 0.0, 1.0)
