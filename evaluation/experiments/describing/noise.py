"""Noise of images as their flattest blocks show it, and the photon-transfer curve that it follows.

A block of 8 x 8 pixels has the standard deviation that the Laplacian of J. Immerkaer, "Fast noise variance
estimation", Computer Vision and Image Understanding 64 (1996) 300-302, leaves of it: what lies on a plane, it does not
see. Texture it does see, so the flattest tenth of the blocks speaks for the noise, and an image that is texture all
over has its noise overstated. Noise that neighbouring pixels share, as after demosaicing, scaling or compression, is
understated: that of a thumbnail is what averaging has left, not the camera's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.describing.cells import usable_pixels
from evaluation.scene import Image

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
