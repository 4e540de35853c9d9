"""A data set's description: its figures, lights, noise and sizes, made image by image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.describing.measuring import measure_scene
from evaluation.experiments.describing.noise import NoiseCurve, photon_transfer
from evaluation.experiments.describing.quantities import QUANTITIES, Summed
from evaluation.experiments.folds import group_of
from evaluation.scene import MixedScene, SceneSet
from foundation.errors import InputError
from foundation.processors import ordered_map
from generator.statistics import CELLS, CHROMA_EDGES, LUMINANCE_EDGES, log_chroma

OF_LIGHTS: Final = {"light_red": 0, "light_blue": 1}
"""Numbers that each light has, and not each image: places of ln(R/G) and ln(B/G)."""


@dataclass(frozen=True, eq=False)
class DataDescription:
    """What is to be known of a data set.

    - `name`, `layout`, `place`, `treatment`: as the `SceneSet` has them.
    - `side`: cells a side that images were reduced to; 0 if they were not.
    - `images`: N names.
    - `mixed`: images that several lights fall on.
    - `sizes`: width and height, px, with the number of images of that size, the most frequent first.
    - `masked`: mean share of the pixels that are masked.
    - `values`: (N,) float64 each, by the names that `QUANTITIES` makes its figures of, but those of lights; NaN where
      an image has no such number.
    - `lights`: (L, 3) float64, linear camera RGB with r + g + b = 1: of every image the light, or each of its lights.
    - `luminance`: (70,) float64, sum 1: mean histogram of the images, by `LUMINANCE_EDGES`.
    - `chroma`: (64, 64) float64, sum 1: mean histogram of ln(R/G) and ln(B/G), by `CHROMA_EDGES`.
    - `noise_unit`: unit of the photon-transfer curves: "saturation" or "99th percentile of green".
    - `noise`: the curves of red, green and blue.
    - `groups`: pictures, places or whatever else several images share, with those that share nothing; None if not
      known.
    """

    name: str
    layout: str
    place: str
    treatment: Mapping[str, str]
    side: int
    images: tuple[str, ...]
    mixed: int
    sizes: tuple[tuple[int, int, int], ...]
    masked: float
    values: Mapping[str, npt.NDArray[np.float64]]
    lights: npt.NDArray[np.float64]
    luminance: npt.NDArray[np.float64]
    chroma: npt.NDArray[np.float64]
    noise_unit: str
    noise: tuple[NoiseCurve, ...]
    groups: int | None = None


def describe(
    data: SceneSet, side: int = CELLS, workers: int = 1, on_scene: Callable[[], None] | None = None
) -> DataDescription:
    """Return the description of a data set; each image is read once and let go."""
    if not data.scenes:
        raise InputError(f"{data.place} holds no image; name a data set with one at least")
    values: list[Mapping[str, float]] = []
    lights: list[npt.NDArray[np.float64]] = []
    blocks: list[npt.NDArray[np.float32]] = []
    sizes: Counter[tuple[int, int]] = Counter()
    luminance, chroma = np.zeros(len(LUMINANCE_EDGES) - 1), np.zeros((len(CHROMA_EDGES) - 1,) * 2)
    masked = 0.0
    # Images are measured in no other threads than these, and what is kept of one is a few kilobytes.
    for numbers in ordered_map(partial(measure_scene, side=side), data.scenes, workers):
        sizes[numbers.size] += 1
        values.append(numbers.values)
        lights.append(numbers.lights)
        blocks.append(numbers.blocks.astype(np.float32))
        luminance += numbers.luminance
        chroma += numbers.chroma
        masked += numbers.masked
        if on_scene:
            on_scene()
    scaled = all(scene.saturation is not None for scene in data.scenes)
    return DataDescription(
        name=data.name,
        layout=data.layout,
        place=data.place,
        treatment=dict(data.treatment),
        side=side,
        images=tuple(scene.name for scene in data.scenes),
        mixed=sum(isinstance(scene, MixedScene) for scene in data.scenes),
        sizes=tuple((*size, count) for size, count in sizes.most_common()),
        masked=masked / len(values),
        values={name: np.array([given[name] for given in values]) for name in values[0]},
        lights=np.concatenate(lights),
        luminance=luminance / max(luminance.sum(), 1e-300),
        chroma=chroma / max(chroma.sum(), 1e-300),
        noise_unit="saturation" if scaled else "99th percentile of green",
        noise=photon_transfer([part.astype(np.float64) for part in blocks]),
        groups=len(set(map(group_of, data.scenes))),
    )


def known_values(description: DataDescription, value: str) -> npt.NDArray[np.float64]:
    """Return the numbers (M,) float64 that are known of the images, or of the lights."""
    if value in OF_LIGHTS:
        return log_chroma(description.lights)[:, OF_LIGHTS[value]]
    given = description.values[value]
    return given[np.isfinite(given)]


def summed(values: npt.NDArray[np.float64], how: Summed) -> float:
    """Return one number of images' numbers (N,) float64; NaN of none."""
    if not values.size:
        return np.nan
    match how:
        case "median":
            return float(np.median(values))
        case "mean":
            return float(values.mean())
        case "spread":
            return float(values.std())


def figures(description: DataDescription) -> dict[str, float]:
    """Return all figures of a data set by their names; NaN where one is not known."""
    return {
        quantity.name: summed(known_values(description, quantity.value), quantity.summed) for quantity in QUANTITIES
    }
