"""The numbers of one image that a data set's figures are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.describing.cells import CELLS, LEVELS, Cells, reduce_scene
from evaluation.experiments.describing.lights import log_chroma
from evaluation.experiments.describing.noise import measure_blocks, relative_noise
from evaluation.experiments.describing.quantities import DARK, GREY_DEG, LUMINANCE_PERCENTS
from evaluation.scene import MixedScene, Scene
from foundation.angles import angles_deg

LUMINANCE_EDGES: Final = tuple(float(edge) for edge in np.linspace(-3, 0.5, 71))
"""Edges of the luminance histogram: decimal logarithm of luminance over the 99th percentile."""

CHROMA_EDGES: Final = tuple(float(edge) for edge in np.linspace(-1.6, 1.6, 65))
"""Edges of the chroma histogram along ln(R/G) and ln(B/G); colours beyond are counted at the rim."""

_NOISE_FROM: Final = 0.1
"""Signal from which blocks tell an image's noise, over the 99th percentile of its green: shot noise rules there."""


@dataclass(frozen=True, eq=False)
class ImageNumbers:
    """What one image gives.

    Attributes
    ----------
    name
        The image's name.
    size
        Width and height, px.
    values
        By the names that `quantities.QUANTITIES` makes its figures of, but those of lights; NaN where one is not known.
    lights
        (K, 3) float64: the light, or the lights, linear camera RGB with r + g + b = 1.
    luminance, chroma
        (70,) and (64, 64) float64: histograms of the cells, each of sum 1; all 0 of an image without a usable cell.
    blocks
        (M, 2, 3) float64: signal and noise of blocks, over saturation, or over the 99th percentile of green where no
        saturation is known.
    masked
        Share of the pixels that are masked.
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
    """Return the numbers of a scene; its image is read, and let go.

    Parameters
    ----------
    scene
        An image with its light or lights.
    side
        Cells a side to reduce it to, at most; 0 keeps every pixel.

    Raises
    ------
    FormatError
        The image cannot be read, or its ground truth is no light.
    """
    image, mask = scene.read()
    cells = reduce_scene(scene, image, mask, side)
    lights = np.asarray(scene.lights if isinstance(scene, MixedScene) else [scene.truth], dtype=np.float64)
    values, luminance, chroma = _of_cells(cells)
    blocks = measure_blocks(image, scene.saturation, mask)
    bright = _percentile(blocks[:, 0, 1], 99)
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
    luminance = cells.colours.mean(axis=2)
    known = luminance[np.isfinite(luminance)]
    white = _percentile(known, 99)
    shares = known / white if white > 0 else np.empty(0)
    values = {f"luminance_{percent}": _percentile(shares, percent) for percent in LUMINANCE_PERCENTS}
    shown = int(cells.levels.sum())
    reached = np.searchsorted(np.cumsum(cells.levels), 0.99 * shown)
    values["exposure"] = (int(reached) + 0.5) / LEVELS if shown else np.nan
    values["clipped"] = cells.clipped / shown if shown else np.nan
    edges = _edges(luminance, white)
    values["edges"] = float(edges.mean()) if edges.size else np.nan
    values["edges_95"] = _percentile(edges, 95)
    with np.errstate(divide="ignore"):
        darkness = np.log10(np.maximum(shares, 0))
    counted = np.histogram(np.clip(darkness, LUMINANCE_EDGES[0], LUMINANCE_EDGES[-1]), LUMINANCE_EDGES)[0]
    chroma_values, chroma = _of_colours(cells.colours[np.isfinite(luminance)])
    return values | chroma_values, counted / max(counted.sum(), 1), chroma


def _of_colours(colours: npt.NDArray[np.float64]) -> tuple[dict[str, float], npt.NDArray[np.float64]]:
    """Return the numbers that colours (N, 3) give, and the histogram of their chroma."""
    bins = len(CHROMA_EDGES) - 1
    lit = colours[(colours > 0).all(axis=1)]
    names = ("chroma_spread", "log_red_spread", "log_blue_spread", "near_grey", "grey_red", "grey_blue")
    if not len(lit):
        return dict.fromkeys(names, np.nan), np.zeros((bins, bins))
    places = log_chroma(lit)
    spread = float(np.sqrt((lit / lit.sum(axis=1, keepdims=True)).var(axis=0).mean()))
    near = float((angles_deg(lit, np.ones(3)) <= GREY_DEG).mean())
    red, blue = (float(number) for number in log_chroma(colours.mean(axis=0, keepdims=True))[0])
    kept = np.clip(places, CHROMA_EDGES[0], CHROMA_EDGES[-1])
    counted = np.histogram2d(kept[:, 0], kept[:, 1], (CHROMA_EDGES, CHROMA_EDGES))[0]
    numbers = (spread, *map(float, places.std(axis=0)), near, red, blue)
    return dict(zip(names, numbers, strict=True)), counted / len(lit)


def _edges(luminance: npt.NDArray[np.float64], white: float) -> npt.NDArray[np.float64]:
    """Return |difference of ln luminance| of all neighbours, side by side and one above the other."""
    if not white > 0:
        return np.empty(0)
    logarithm = np.log(np.maximum(luminance / white, DARK))
    steps = np.concatenate([np.abs(np.diff(logarithm, axis=axis)).ravel() for axis in (0, 1)])
    return steps[np.isfinite(steps)]


def _percentile(values: npt.NDArray[np.float64], percent: float) -> float:
    return float(np.percentile(values, percent, method="hazen")) if values.size else np.nan
