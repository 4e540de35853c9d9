"""An image as cells: means over its usable pixels, with the light divided out.

Statistics of scenes depend on the size at which they are taken: averaging takes away noise, texture and chroma. All
images are therefore reduced to at most `CELLS` cells a side first, whatever their size and shape, as thumbnails of real
data sets are. Images of fewer pixels keep them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image, MixedScene, Scene
from foundation.errors import FormatError
from generator.statistics import CELLS, cell_borders

LEVELS: Final = 4096
"""Steps of a share of saturation in which exposures are counted: 12 bits, a quarter of a raw file's."""

_BAND_PIXELS: Final = 1 << 18
"""Pixels reduced at once: 20 MB of working memory, however large the image."""

_USABLE: Final = 0.5
"""Share of a cell's pixels that must be usable."""


@dataclass(frozen=True, eq=False)
class Cells:
    """An image, reduced.

    - `colours`: (h, w, 3) float64, camera RGB divided by the light at equal mean over the channels, in the image's
      unit; NaN where less than half of the cell's pixels are usable.
    - `pixels`, `masked`, `clipped`: numbers of pixels: of the image, masked, and clipped of those not masked.
    - `levels`: (`LEVELS`,) int64: pixels not masked, counted by their largest channel as a share of saturation; empty
      where no saturation is known.
    """

    colours: npt.NDArray[np.float64]
    pixels: int
    masked: int
    clipped: int
    levels: npt.NDArray[np.int64]


def usable_pixels(
    image: Image, saturation: float | None, mask: npt.NDArray[np.bool_] | None
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which pixels are usable and which are clipped, both (H, W) bool; masked ones are neither.

    `image`: (H, W, 3), linear camera RGB with black subtracted. `saturation`: value from which a pixel is clipped, in
    any channel; None if none is. `mask`: (H, W) bool, True where a pixel must not be used; or None.
    """
    free = np.ones(image.shape[:2], np.bool_) if mask is None else ~mask
    # Channel by channel: a reduction over the three of each pixel takes ten times as long.
    if image.dtype.kind == "f":
        for channel in range(3):
            free &= np.isfinite(image[..., channel])
    if saturation is None:
        return free, np.zeros_like(free)
    clipped = np.zeros_like(free)
    for channel in range(3):
        clipped |= image[..., channel] >= saturation
    clipped &= free
    return free & ~clipped, clipped


def reduce_scene(scene: Scene, image: Image, mask: npt.NDArray[np.bool_] | None, side: int = CELLS) -> Cells:
    """Return a scene's image as cells; of a mixture, each pixel is divided by its own light.

    `image`: (H, W, 3), as `scene.read` gave it. `mask`: (H, W) bool or None, as `scene.read` gave it.
    """
    height, width = image.shape[:2]
    rows, columns = cell_borders(height, side), cell_borders(width, side)
    light = _even(np.asarray(scene.truth, dtype=np.float64))
    if not (np.isfinite(light).all() and light.min() > 0):
        raise FormatError(
            f"the ground truth of {scene.name} is {' '.join(f'{part:g}' for part in scene.truth)}; expected red, green "
            "and blue above 0, to be divided by"
        )
    lights = scene.read_truth_map() if isinstance(scene, MixedScene) else None
    colours = np.full((len(rows) - 1, len(columns) - 1, 3), np.nan)
    masked = clipped = 0
    levels = np.zeros(LEVELS if scene.saturation is not None else 0, np.int64)
    for first, last in _bands(rows, width):
        top, bottom = rows[first], rows[last]
        part = image[top:bottom]
        hidden = None if mask is None else mask[top:bottom]
        usable, over = usable_pixels(part, scene.saturation, hidden)
        masked += int((~(usable | over)).sum())
        clipped += int(over.sum())
        if scene.saturation is not None:
            largest = np.maximum(np.maximum(part[..., 0], part[..., 1]), part[..., 2])
            shown = largest[usable | over] / scene.saturation
            counted = np.clip(shown * LEVELS, 0, LEVELS - 1).astype(np.int64)
            levels += np.bincount(counted, minlength=LEVELS)
        values = part.astype(np.float64)
        if lights is not None:
            local = _even(lights[top:bottom].astype(np.float64))
            usable &= np.isfinite(local).all(axis=2) & (local > 0).all(axis=2)
            with np.errstate(divide="ignore", invalid="ignore"):
                values /= local
        else:
            values /= light
        values[~usable] = 0
        starts = rows[first:last] - top
        sums = np.add.reduceat(np.add.reduceat(values, starts, axis=0), columns[:-1], axis=1)
        used = np.add.reduceat(np.add.reduceat(usable.astype(np.int64), starts, axis=0), columns[:-1], axis=1)
        area = np.diff(rows[first : last + 1])[:, None] * np.diff(columns)
        enough = (used >= _USABLE * area) & (used > 0)
        colours[first:last][enough] = sums[enough] / used[enough][:, None]
    return Cells(colours, height * width, masked, clipped, levels)


def _bands(rows: npt.NDArray[np.int64], width: int) -> Iterator[tuple[int, int]]:
    """Give first and last-plus-one of rows of cells that are reduced together."""
    first, count = 0, len(rows) - 1
    while first < count:
        bottom = int(rows[first]) + max(1, _BAND_PIXELS // width)
        last = int((rows <= bottom).sum()) - 1
        last = min(max(last, first + 1), count)
        yield first, last
        first = last


def _even(light: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return lights (..., 3) scaled to a mean of 1 over the channels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return light / light.mean(axis=-1, keepdims=True)
