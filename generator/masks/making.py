"""Masks that are computed: new ones for each image, at any size.

A plan makes the masks of image after image; a maker makes those of one image at any size. Rules that hold inside:

- Lengths are shares of the picture's longer side, and noise has its place in the picture and not in a pixel. So the
  masks of one seed and number look the same at every size; an edge is never sharper than one pixel.
- What is made depends on the seed and the image's number alone; purpose 5 of `philox`.
- Every pixel is computed with +, −, ×, ÷ and √ alone, which IEEE 754 rounds alike everywhere. So the same masks are
  the same bytes on every processor, up to the last bit of the few sines that place the shapes.

The first light is the one that falls where no shape is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from generator.masks.shapes import RandomStreams, Shape
from generator.masks.weights import MaskMaker, Weights, quantise_shares

_PIXELS: Final = 1 << 15
"""Pixels computed at a time: intermediate arrays of so many float32 stay in the processor's cache."""


@dataclass(frozen=True)
class MadeMasks:
    """The masks of one image; a `MaskMaker`."""

    shape: Shape
    streams: RandomStreams

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        longer = max(height, width)
        u = ((np.arange(width) - (width - 1) / 2) / longer).astype(np.float32)[None, :]
        v = ((np.arange(height) - (height - 1) / 2) / longer).astype(np.float32)[:, None]
        shares = self.shape.shares(self.streams, (width / longer / 2, height / longer / 2), lights, 1 / longer, u)
        out = np.empty((height, width, lights), np.float32)
        rows = max(1, _PIXELS // width)
        for top in range(0, height, rows):
            quantise_shares(shares(v[top : top + rows]), out[top : top + rows])
        return out


@dataclass(frozen=True)
class MadeMaskPlan:
    """Masks of one shape, anew for each image; a `MaskPlan`."""

    shape: Shape
    seed: int

    def maker(self, number: int) -> MaskMaker:
        """Return the masks of image `number`."""
        return MadeMasks(self.shape, RandomStreams(self.seed, number))

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return self.shape.describe()
