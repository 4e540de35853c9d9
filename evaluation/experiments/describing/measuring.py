"""The numbers of one image that a data set's figures are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.describing.cells import LEVELS, Cells, reduce_scene
from evaluation.experiments.describing.noise import measure_blocks, relative_noise
from evaluation.scene import MixedScene, Scene
from generator.statistics import CELLS, numbers_of_cells, percentile

_NOISE_FROM: Final = 0.1
"""Signal from which blocks tell an image's noise, over the 99th percentile of its green: shot noise rules there."""


@dataclass(frozen=True, eq=False)
class ImageNumbers:
    """What one image gives.

    - `name`: the image's name.
    - `size`: width and height, px.
    - `values`: by the names that `quantities.QUANTITIES` makes its figures of, but those of lights; NaN where one is
      not known.
    - `lights`: (K, 3) float64: the light, or the lights, linear camera RGB with r + g + b = 1.
    - `luminance`, `chroma`: (70,) and (64, 64) float64: histograms of the cells, each of sum 1; all 0 of an image
      without a usable cell.
    - `blocks`: (M, 2, 3) float64: signal and noise of blocks, over saturation, or over the 99th percentile of green
      where no saturation is known.
    - `masked`: share of the pixels that are masked.
    """

    name: str
    size: tuple[int, int]
    values: Mapping[str, float]
    lights: npt.NDArray[np.float64]
    luminance: npt.NDArray[np.float64]
    chroma: npt.NDArray[np.float64]
    blocks: npt.NDArray[np.float64]
    masked: float


def measure_scene(scene: Scene, side: int = CELLS) -> ImageNumbers:
    """Return the numbers of a scene; its image is read, and let go."""
    image, mask = scene.read()
    cells = reduce_scene(scene, image, mask, side)
    lights = np.asarray(scene.lights if isinstance(scene, MixedScene) else [scene.truth], dtype=np.float64)
    values, luminance, chroma = _of_cells(cells)
    blocks = measure_blocks(image, scene.saturation, mask)
    bright = percentile(blocks[:, 0, 1], 99)
    values["noise"] = relative_noise(blocks, _NOISE_FROM * bright) if len(blocks) else np.nan
    unit = bright if scene.saturation is None else scene.saturation
    return ImageNumbers(
        name=scene.name,
        size=(image.shape[1], image.shape[0]),
        values=values,
        lights=lights / lights.sum(axis=1, keepdims=True),
        luminance=luminance,
        chroma=chroma,
        blocks=blocks / unit if len(blocks) and unit > 0 else np.empty((0, 2, 3)),
        masked=cells.masked / cells.pixels,
    )


def _of_cells(cells: Cells) -> tuple[dict[str, float], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the numbers that cells give, and the histograms of their luminance and chroma."""
    values, luminance, chroma = numbers_of_cells(cells.colours)
    shown = int(cells.levels.sum())
    reached = np.searchsorted(np.cumsum(cells.levels), 0.99 * shown)
    values["exposure"] = (int(reached) + 0.5) / LEVELS if shown else np.nan
    values["clipped"] = cells.clipped / shown if shown else np.nan
    return values, luminance, chroma
