"""What a data set's images and lights are, in figures: measured image by image, written as `STATS.json`, read back.

All figures but noise, exposure and clipping are of images reduced to at most 64 x 64 cells with the light divided out:
means over a cell's usable pixels. Statistics of scenes depend on the size at which they are taken, since averaging
takes away noise, texture and chroma, so images of all sizes and shapes are reduced to the same number of cells;
images of fewer pixels keep them. Luminance is the mean of the three channels.

Noise is what an image's flattest blocks show, and the photon-transfer curve that it follows. A block of 8 x 8 pixels
has the standard deviation that the Laplacian of J. Immerkaer, "Fast noise variance estimation", Computer Vision and
Image Understanding 64 (1996) 300-302, leaves of it: what lies on a plane, it does not see. Texture it does see, so the
flattest tenth of the blocks speaks for the noise, and an image that is texture all over has its noise overstated. Noise
that neighbouring pixels share, as after demosaicing, scaling or compression, is understated: that of a thumbnail is
what averaging has left, not the camera's.

Lights lie in the plane of ln(R/G) and ln(B/G). The file's format is versioned and documented in docs/formats.md:
numbers with six significant digits, null for a figure that is not known of an image.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import group_of
from evaluation.scene import Image, MixedScene, Scene, SceneSet, told_of
from foundation.compiled import ordered_map
from foundation.errors import FormatError, InputError
from foundation.records import from_plain
from foundation.version import software
from generator.statistics import (
    CELLS,
    CHROMA_EDGES,
    FORMAT,
    GREY_DEG,
    LUMINANCE_EDGES,
    LUMINANCE_PERCENTS,
    VERSION,
    cell_borders,
    lights_of,
    log_chroma,
    numbers_of_cells,
    percentile,
    read_content,
)

Summed = Literal["median", "mean", "spread"]
"""How numbers of images become one of the set; the spread is their standard deviation."""


@dataclass(frozen=True)
class Quantity:
    """A figure of a data set.

    - `name`: in files: `chroma_spread`.
    - `value`: the number of an image that it is made of; several quantities may be of one.
    - `title`: in tables: "Chroma spread".
    - `definition`: what it is, in one sentence.
    - `summed`: how it is made of the images' numbers.
    - `signed`: whether it has a sign or its zero is a place like any other, so that two sets are told apart by their
      difference and not by their ratio.
    """

    name: str
    value: str
    title: str
    definition: str
    summed: Summed = "median"
    signed: bool = False


QUANTITIES: Final[tuple[Quantity, ...]] = (
    *(
        Quantity(
            f"luminance_{percent}",
            f"luminance_{percent}",
            f"Luminance, {percent}{'st' if percent == 1 else 'th'} percentile",
            f"The {percent}{'st' if percent == 1 else 'th'} percentile of a cell's luminance over the 99th.",
        )
        for percent in LUMINANCE_PERCENTS
    ),
    Quantity(
        "exposure",
        "exposure",
        "Exposure",
        "The 99th percentile of a pixel's largest channel over saturation, before the light is divided out.",
    ),
    Quantity("clipped", "clipped", "Clipped share", "Share of the unmasked pixels that are clipped.", "mean"),
    Quantity(
        "chroma_spread",
        "chroma_spread",
        "Chroma spread",
        "Root mean square of the standard deviations of r, g and b (each channel over their sum) of an image's cells.",
    ),
    Quantity("log_red_spread", "log_red_spread", "Spread of ln(R/G)", "Standard deviation of ln(R/G) in an image."),
    Quantity("log_blue_spread", "log_blue_spread", "Spread of ln(B/G)", "Standard deviation of ln(B/G) in an image."),
    Quantity(
        "near_grey", "near_grey", "Near-grey share", f"Share of cells within {GREY_DEG:g} degrees of white.", "mean"
    ),
    Quantity(
        "grey_offset_red",
        "grey_red",
        "Grey-world offset, red",
        "ln(R/G) of an image's mean: where grey lies.",
        "mean",
        True,
    ),
    Quantity(
        "grey_offset_blue",
        "grey_blue",
        "Grey-world offset, blue",
        "ln(B/G) of an image's mean: where grey lies.",
        "mean",
        True,
    ),
    Quantity(
        "grey_spread_red",
        "grey_red",
        "Grey-world spread, red",
        "Standard deviation over the images of ln(R/G) of their means.",
        "spread",
    ),
    Quantity(
        "grey_spread_blue",
        "grey_blue",
        "Grey-world spread, blue",
        "Standard deviation over the images of ln(B/G) of their means.",
        "spread",
    ),
    Quantity(
        "edges", "edges", "Mean edge", "Mean of |difference of ln luminance| between neighbouring cells of an image."
    ),
    Quantity("edges_95", "edges_95", "Strong edges", "95th percentile of the same differences of an image."),
    Quantity(
        "noise",
        "noise",
        "Noise over signal",
        "Noise of green over its signal in the flattest tenth of the blocks of 8 x 8 pixels, at full size.",
    ),
    Quantity("light_red", "light_red", "Light, red", "Mean of ln(R/G) of the lights.", "mean", True),
    Quantity("light_blue", "light_blue", "Light, blue", "Mean of ln(B/G) of the lights.", "mean", True),
    Quantity(
        "light_spread_red",
        "light_red",
        "Spread of lights, red",
        "Standard deviation of ln(R/G) of the lights.",
        "spread",
    ),
    Quantity(
        "light_spread_blue",
        "light_blue",
        "Spread of lights, blue",
        "Standard deviation of ln(B/G) of the lights.",
        "spread",
    ),
)
"""All of them, in the order of the tables."""


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


BLOCK: Final = 8
"""Pixels a side of a block: flat places of that size are in most photographs, and 36 Laplacians tell noise to 20 %."""

BLOCKS_AN_IMAGE: Final = 256
"""Blocks measured of an image at most, on an even grid: the flattest tenth are then 25."""

_FLATTEST: Final = 10
"""Percentile of the blocks' noise that is taken for the noise: flat places are a tenth of most photographs."""

_OF_FLATTEST: Final = 0.7325
"""That percentile over the noise of blocks of white noise alone, from 400 000 simulated blocks."""

_LEVELS: Final = 12
"""Levels of signal, in equal steps of its logarithm."""

_LEAST_BLOCKS: Final = 30
"""Blocks that a level needs: the flattest tenth are then three."""

_LEAST_LEVELS: Final = 4
"""Levels that a curve of two numbers is fitted to at least."""

_LEAST_SPAN: Final = 4.0
"""Largest over smallest signal that separate shot from read noise."""

_FITS: Final = 0.25
"""Root mean square of ln(fitted / measured) up to which the levels lie on the curve."""

_LAPLACIAN: Final = ((1, -2, 1), (-2, 4, -2), (1, -2, 1))
"""Immerkaer's mask: the difference of two Laplacians; on white noise its standard deviation is 6 times the noise's."""


@dataclass(frozen=True)
class NoiseLevel:
    """The noise at one level of signal.

    - `signal`, `sigma`: mean and standard deviation of a pixel in the flattest blocks, in the unit of the curve.
    - `blocks`: blocks of that level.
    """

    signal: float
    sigma: float
    blocks: int


@dataclass(frozen=True)
class NoiseCurve:
    """Noise against signal of one channel: variance = read² + gain · signal.

    - `levels`: what was measured.
    - `read`, `gain`: the fitted curve, in the unit of the signal; None where the levels are too few, span too little,
      or do not lie on it.
    - `misfit`: root mean square of ln(fitted / measured standard deviation); None where nothing was fitted.
    """

    levels: tuple[NoiseLevel, ...]
    read: float | None = None
    gain: float | None = None
    misfit: float | None = None


def measure_blocks(
    image: Image,
    saturation: float | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
    limit: int = BLOCKS_AN_IMAGE,
) -> npt.NDArray[np.float64]:
    """Return mean and noise of blocks of an image whose pixels are all usable.

    `image`: (H, W, 3), linear camera RGB with black subtracted. `saturation`: value from which a pixel is clipped; None
    if none is. `mask`: (H, W) bool, True where a pixel must not be used; or None. Returns (M, 2, 3) float64: mean, and
    standard deviation by the Laplacian, of each channel. M may be 0.
    """
    down, across = (size // BLOCK for size in image.shape[:2])
    step = max(1, int(np.ceil(np.sqrt(down * across / limit))))
    found: list[npt.NDArray[np.float64]] = []
    for row in range(step // 2 if down > step // 2 else 0, down, step):
        top = row * BLOCK
        for column in range(step // 2 if across > step // 2 else 0, across, step):
            left = column * BLOCK
            place = (slice(top, top + BLOCK), slice(left, left + BLOCK))
            usable, _ = usable_pixels(image[place], saturation, None if mask is None else mask[place])
            if usable.all():
                found.append(image[place].astype(np.float64))
    if not found:
        return np.empty((0, 2, 3))
    blocks = np.stack(found)
    inside = BLOCK - 2
    response = sum(
        weight * blocks[:, down : down + inside, across : across + inside]
        for down, line in enumerate(_LAPLACIAN)
        for across, weight in enumerate(line)
    )
    return np.stack([blocks.mean(axis=(1, 2)), np.sqrt(np.mean(np.square(response), axis=(1, 2))) / 6], axis=1)


def relative_noise(blocks: npt.NDArray[np.float64], least: float) -> float:
    """Return the noise of green over its signal in the flattest blocks of an image; NaN of fewer than ten blocks.

    `blocks`: (M, 2, 3) float64, of `measure_blocks`. `least`: signal from which a block counts, in the image's unit: in
    the dark the ratio is the read noise's.
    """
    signal, sigma = blocks[:, 0, 1], blocks[:, 1, 1]
    bright = signal > max(least, 0)
    if bright.sum() < 10:
        return np.nan
    return float(np.percentile(sigma[bright] / signal[bright], _FLATTEST)) / _OF_FLATTEST


def photon_transfer(blocks: Sequence[npt.NDArray[np.float64]]) -> tuple[NoiseCurve, ...]:
    """Return the photon-transfer curves of red, green and blue.

    `blocks`: for each image (M, 2, 3) float64, of `measure_blocks`, in a unit that the images share.
    """
    together = np.concatenate([np.empty((0, 2, 3)), *blocks])
    return tuple(_curve(together[:, 0, channel], together[:, 1, channel]) for channel in range(3))


def _curve(signal: npt.NDArray[np.float64], sigma: npt.NDArray[np.float64]) -> NoiseCurve:
    from scipy.optimize import nnls

    lit = signal > 0
    signal, sigma = signal[lit], sigma[lit]
    if not signal.size:
        return NoiseCurve(())
    low, high = np.percentile(signal, [0.5, 99.5])
    steps = np.log(signal / low) / max(np.log(high / low), 1e-9) * _LEVELS
    level = np.clip(steps.astype(np.int64), 0, _LEVELS - 1)
    levels: list[NoiseLevel] = []
    for number in range(_LEVELS):
        inside = level == number
        if (count := int(inside.sum())) < _LEAST_BLOCKS:
            continue
        flattest = np.percentile(sigma[inside], _FLATTEST)
        if flattest > 0:
            mean = float(signal[inside][sigma[inside] <= flattest].mean())
            levels.append(NoiseLevel(mean, float(flattest) / _OF_FLATTEST, count))
    if len(levels) < _LEAST_LEVELS or levels[-1].signal < _LEAST_SPAN * levels[0].signal:
        return NoiseCurve(tuple(levels))
    means, sigmas = (np.array([getattr(level, name) for level in levels]) for name in ("signal", "sigma"))
    # Variances are known to a share of themselves, so each equation is divided by its own.
    solved = nnls(np.stack([np.ones_like(means), means], axis=1) / sigmas[:, None] ** 2, np.ones_like(means))[0]
    variance, gain = (float(number) for number in solved)
    misfit = float(np.sqrt(np.mean((np.log((variance + gain * means) / sigmas**2) / 2) ** 2)))
    if misfit > _FITS:
        return NoiseCurve(tuple(levels), misfit=misfit)
    return NoiseCurve(tuple(levels), variance**0.5, gain, misfit)


_COMPARED: Final = 1000
"""Lights of a set that the energy distance is taken of, at most: distances of all pairs are held."""

_SHUFFLES: Final = 199
"""Permutations of a test: the least p is then 1/200."""


@dataclass(frozen=True)
class LightDistribution:
    """Where lights lie in the plane of ln(R/G) and ln(B/G).

    - `count`: lights.
    - `mean`: of ln(R/G) and ln(B/G).
    - `covariance`: the two variances and the covariance between them: red, both, blue.
    - `axis_deg`: direction of the principal axis, -90 … 90 degrees from the axis of ln(R/G); daylight and incandescent
      lamps lie along a line that falls.
    - `along`, `across`: standard deviations along the principal axis and across it.
    - `hull_area`: area of the convex hull; 0 of lights on a line.
    """

    count: int
    mean: tuple[float, float]
    covariance: tuple[float, float, float]
    axis_deg: float
    along: float
    across: float
    hull_area: float


def light_distribution(lights: npt.ArrayLike) -> LightDistribution:
    """Return the distribution of lights (N, 3) float, linear camera RGB of any length, N ≥ 1.

    Examples
    --------
    >>> found = light_distribution([[1, 1, 2], [2, 1, 1], [1.5, 1, 1.4]])
    >>> round(found.axis_deg), found.along > 10 * found.across
    (-45, True)
    """
    from scipy.spatial import ConvexHull, QhullError

    points = log_chroma(lights)
    centred = points - points.mean(axis=0)
    covariance = centred.T @ centred / len(points)
    values, vectors = np.linalg.eigh(covariance)
    across, along = np.sqrt(np.maximum(values, 0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    try:
        # Of points in a plane Qhull calls the area volume.
        area = float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        area = 0.0
    return LightDistribution(
        count=len(points),
        mean=(float(points[:, 0].mean()), float(points[:, 1].mean())),
        covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        axis_deg=(angle + 90) % 180 - 90,
        along=float(along),
        across=float(across),
        hull_area=area,
    )


def energy_distance(one: npt.ArrayLike, other: npt.ArrayLike, seed: int = 0) -> tuple[float, float]:
    """Return the energy distance of two sets of points as a share of its largest, and its p.

    G. J. Székely, M. L. Rizzo, "Energy statistics", J. Statistical Planning and Inference 143 (2013) 1249-1272: the
    coefficient of inhomogeneity, 0 of equal distributions and 1 of two single points.

    `one`, `other`: (N, D) and (M, D) float; of more than 1000 points a random 1000 are taken. Returns the share, 0 … 1,
    and the share of 200 random divisions of all points into two such sets that lie as far apart.

    Examples
    --------
    >>> energy_distance([[0, 0]] * 5, [[1, 1]] * 5)[0]
    1.0
    """
    from scipy.spatial.distance import cdist

    random = np.random.default_rng(seed)
    sides = [
        points if len(points) <= _COMPARED else points[random.choice(len(points), _COMPARED, replace=False)]
        for points in (np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64))
    ]
    count, total = len(sides[0]), sum(map(len, sides))
    together = np.concatenate(sides)
    distances = cdist(together, together)
    sums = distances.sum(axis=0)

    # Each row says which points are of the first set: as they are, then at random.
    member = np.zeros((_SHUFFLES + 1, total))
    member[:, :count] = 1
    member[1:] = random.permuted(member[1:], axis=1)
    apart = member @ distances
    between = 2 * (apart * (1 - member)).sum(axis=1) / (count * (total - count))
    within = (apart * member).sum(axis=1) / count**2
    within += ((sums - apart) * (1 - member)).sum(axis=1) / (total - count) ** 2
    found = between - within
    farther = int((found >= found[0] - 1e-12).sum())
    return (float(found[0] / between[0]) if between[0] > 0 else 0.0), farther / (_SHUFFLES + 1)


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
    values, luminance, chroma = numbers_of_cells(cells.colours)
    shown = int(cells.levels.sum())
    reached = np.searchsorted(np.cumsum(cells.levels), 0.99 * shown)
    values["exposure"] = (int(reached) + 0.5) / LEVELS if shown else np.nan
    values["clipped"] = cells.clipped / shown if shown else np.nan
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
    for numbers in told_of(ordered_map(partial(measure_scene, side=side), data.scenes, workers), on_scene):
        sizes[numbers.size] += 1
        values.append(numbers.values)
        lights.append(numbers.lights)
        blocks.append(numbers.blocks.astype(np.float32))
        luminance += numbers.luminance
        chroma += numbers.chroma
        masked += numbers.masked
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


QUANTILES: Final = (0, 1, 5, 10, 25, 50, 75, 90, 95, 99, 100)
"""Percents at which the distribution of a number over the images is written."""

_DIGITS: Final = 6
"""Significant digits: the thousandth part of what images tell."""

_CHANNELS: Final = ("red", "green", "blue")


def statistics_to_json(description: DataDescription) -> str:
    """Return the text of a `STATS.json`; the same description gives the same text."""
    known = figures(description)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "software": software(),
        "data": {
            "name": description.name,
            "layout": description.layout,
            "place": description.place,
            "images": len(description.images),
            "mixed": description.mixed,
            "groups": description.groups,
            "treatment": dict(description.treatment),
        },
        "cells": description.side,
        "sizes": [{"width": width, "height": height, "images": count} for width, height, count in description.sizes],
        "masked": description.masked,
        "figures": [
            {
                "name": quantity.name,
                "of": quantity.value,
                "summed": quantity.summed,
                "definition": quantity.definition,
                "value": known[quantity.name],
            }
            for quantity in QUANTITIES
        ],
        "quantiles": {name: _quantiles(known_values(description, name)) for name in (*description.values, *OF_LIGHTS)},
        "noise": {
            "unit": description.noise_unit,
            **{channel: asdict(curve) for channel, curve in zip(_CHANNELS, description.noise, strict=True)},
        },
        "light_distribution": asdict(light_distribution(description.lights)),
        "luminance": {"log10_edges": LUMINANCE_EDGES, "shares": description.luminance},
        "chroma": {"edges": CHROMA_EDGES, "shares": description.chroma},
        "lights": description.lights,
        "images": list(description.images),
        "values": dict(description.values),
    }
    lines = [f"{json.dumps(key)}: {json.dumps(_plain(value))}" for key, value in content.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_statistics(path: Path | str) -> DataDescription:
    """Return the description that a `STATS.json` holds."""
    known, _ = read_content(path)
    try:
        return _description(known, path)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is not as its format has it: {error!r}; {_REMEDY}") from error


_REMEDY: Final = "write it anew with evaluate describe DATA --out STATS.json"


def _description(content: Mapping[str, Any], path: Path | str) -> DataDescription:
    data, noise = content["data"], content["noise"]
    images = tuple(map(str, content["images"]))
    values = {name: _array(given) for name, given in content["values"].items()}
    missing = {quantity.value for quantity in QUANTITIES} - values.keys() - OF_LIGHTS.keys()
    if missing or any(given.shape != (len(images),) for given in values.values()):
        raise ValueError(f"values of {len(images)} images expected, and of {', '.join(sorted(missing)) or 'each name'}")
    luminance, chroma = _array(content["luminance"]["shares"]), _array(content["chroma"]["shares"])
    if luminance.shape != (len(LUMINANCE_EDGES) - 1,) or chroma.shape != (len(CHROMA_EDGES) - 1,) * 2:
        raise ValueError(f"histograms of {luminance.shape} and {chroma.shape} bins")
    return DataDescription(
        name=data["name"],
        layout=data["layout"],
        place=data["place"],
        treatment=dict(data["treatment"]),
        side=int(content["cells"]),
        images=images,
        mixed=int(data["mixed"]),
        sizes=tuple((int(size["width"]), int(size["height"]), int(size["images"])) for size in content["sizes"]),
        masked=float(content["masked"]),
        values=values,
        lights=lights_of(content),
        luminance=luminance,
        chroma=chroma,
        noise_unit=noise["unit"],
        noise=tuple(from_plain(NoiseCurve, noise[channel], path, _REMEDY) for channel in _CHANNELS),
        groups=None if data.get("groups") is None else int(data["groups"]),
    )


def _array(given: Any) -> npt.NDArray[np.float64]:
    """Return numbers as an array, null as NaN."""
    return np.array(given, dtype=np.float64)


def _quantiles(values: npt.NDArray[np.float64]) -> dict[str, float | int | None]:
    levels = np.percentile(values, QUANTILES, method="hazen") if values.size else [None] * len(QUANTILES)
    return {"images": values.size, **{str(percent): level for percent, level in zip(QUANTILES, levels, strict=True)}}


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: rounded, and null for what is not finite."""
    match value:
        case dict():
            return {str(key): _plain(inner) for key, inner in cast("dict[Any, Any]", value).items()}
        case list() | tuple():
            return [_plain(inner) for inner in cast("list[Any]", value)]
        case np.ndarray():
            return _plain(cast("npt.NDArray[np.float64]", value).tolist())
        case float() | np.floating():
            number = float(cast("float", value))
            return float(f"{number:.{_DIGITS}g}") if math.isfinite(number) else None
        case _:
            return value
