"""At which size images are made to be like those of a real data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from foundation.errors import FormatError, InputError
from generator.pictures.sources import Source
from generator.statistics.statistics_file import RealStatistics

_LOOKED_AT: Final = 200
"""Pictures whose size is looked at, evenly spread over the list: a tenth of them is then known to a few percent."""

_TOO_SMALL: Final = 10
"""Percent of the pictures that may be too small for the crop, and are left out."""

_LEAST_SIDE: Final = 16
"""Least side of images, px: below it their cells say nothing of scenes."""


@dataclass(frozen=True)
class LikeSize:
    """A size of images.

    - `width`, `height`: what pictures are cut to, px.
    - `wanted`: width and height of most images of the real data set, px.
    """

    width: int
    height: int
    wanted: tuple[int, int]

    def describe(self) -> dict[str, Any]:
        """Return what `dataset.json` records."""
        return {"crop": [self.width, self.height], "wanted": list(self.wanted)}

    def sentence(self) -> str:
        """Return in one line which size it is."""
        same = (self.width, self.height) == self.wanted
        end = "" if same else ", as large as nine of ten pictures allow in that shape"
        return "size: {}x{} px{}; most real images have {}x{}".format(self.width, self.height, end, *self.wanted)


def like_size(target: RealStatistics, sources: Sequence[Source]) -> LikeSize | None:
    """Return the size of most real images, made smaller in that shape where pictures are smaller.

    Returns none for thumbnails, whose size and shape are not those of the photographs.
    """
    if target.layout == "thumbnails" or not target.sizes:
        return None
    width, height, _ = target.sizes[0]
    scales: list[float] = []
    for place in np.unique(np.linspace(0, len(sources) - 1, min(len(sources), _LOOKED_AT)).astype(int)):
        try:
            high, wide = sources[int(place)].read().picture.shape[:2]
        except FormatError:
            continue
        scales.append(min(wide / width, high / height))
    if not scales:
        raise InputError("none of the pictures can be read; name others with --sources")
    scale = min(1.0, float(np.percentile(scales, _TOO_SMALL, method="lower")))
    # Whole pixels below, so that the pictures that decide the scale are not too small by a fraction of one.
    size = LikeSize(int(width * scale + 1e-9), int(height * scale + 1e-9), (width, height))
    if min(size.width, size.height) < _LEAST_SIDE:
        raise InputError(
            f"pictures cut to the shape of {width}x{height} px would be {size.width}x{size.height} px, expected "
            f"{_LEAST_SIDE} px a side or more; name larger ones, or leave size out of --like-in"
        )
    return size
