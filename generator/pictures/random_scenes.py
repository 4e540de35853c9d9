"""Random colours instead of pictures, as in the set "Random" of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from foundation.errors import InputError
from generator import philox
from generator.pictures.sources import LARGEST_SIDE, SourcePicture


@dataclass(frozen=True, slots=True)
class RandomScene:
    """A picture of random codes, uniform in 0 … 255, like the second set of scenes of the paper (section 4.3).

    Codes R, G, B of pixel (x, y) are the three high bytes, highest first, of word x mod 4 of Philox4x32-10 with counter
    (⌊x/4⌋, y, number, 2) and the seed as key.

    - `number`: 0 … 2³² − 1; scenes of different numbers are independent.
    - `width`, `height`: size, px.
    - `seed`: 0 … 2⁶⁴ − 1.
    """

    number: int
    width: int
    height: int
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the picture in the data set."""
        return f"random-{self.number:06d}"

    def to_json(self) -> dict[str, Any]:
        """Return number, size and seed as a JSON object."""
        return {"random": self.number, "size": [self.width, self.height], "seed": self.seed}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8."""
        blocks = np.arange((self.width + 3) // 4)
        rows = np.arange(self.height)[:, None]
        word_columns = philox.words(self.seed, blocks, rows, self.number, philox.SCENES)
        words = np.stack(word_columns, axis=-1).reshape(self.height, -1)[:, : self.width]
        codes = np.stack([words >> np.uint32(24), words >> np.uint32(16), words >> np.uint32(8)], axis=-1)
        return SourcePicture(codes.astype(np.uint8))


def random_scenes(count: int, width: int, height: int, seed: int = 0) -> tuple[RandomScene, ...]:
    """Return `count` random scenes of `width` × `height` px, numbered from 0."""
    if count < 1:
        raise InputError(f"{count} random scenes are requested, expected 1 or more")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"random scenes of {width}x{height} px are requested, expected 1 to {LARGEST_SIDE} px")
    return tuple(RandomScene(number, width, height, seed) for number in range(count))
