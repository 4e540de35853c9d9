"""The noise of less light, or of another ISO speed, on crops for training: float32 planes that were given a gain.

The model and the rule of random words are those of `exposing`; image 0, and each item's own seed.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32, uint64

from foundation.compiled import compiled
from foundation.errors import InputError
from generator.kernels.arguments import check_white_level, run_in_threads
from generator.kernels.choice import philox4x32
from generator.variation.deviates import normal_deviates
from generator.variation.exposing import PURPOSE, draw_row
from generator.variation.sensor_noise import SensorNoise

_ZERO: Final = np.float32(0)
_NO_FLOOR: Final = np.float32(-1)
"""Least value where counts below black are kept: as far below 0 as saturation is above, where no noise reaches."""
_ONE: Final = np.float32(1)
_32: Final = np.uint64(32)


@compiled
def _add_noise(images: Any, dark: Any, shot: Any, seeds: Any, table: Any, least: Any) -> None:
    """Add to `images` (N, 3, H, W) float32 noise of variance `dark` (N, 3) + `shot` (N, 3) · value, cut at `least`."""
    height, width = images.shape[2], images.shape[3]
    deviates = np.zeros(3 * width, np.float32)
    for item in range(images.shape[0]):
        if max(dark[item].max(), shot[item].max()) <= _ZERO:
            continue
        for y in range(height):
            k0, k1, _, _ = philox4x32(uint32(y), uint32(0), uint32(0), PURPOSE, seeds[item])
            draw_row((uint64(k1) << _32) | uint64(k0), width, table, deviates)
            for channel in range(3):
                row = images[item, channel, y]
                base, slope = dark[item, channel], shot[item, channel]
                for x in range(width):
                    value = row[x]
                    noisy = value + np.sqrt(max(base + slope * value, _ZERO)) * deviates[3 * x + channel]
                    row[x] = min(max(noisy, least), _ONE)


def add_noise(
    images: npt.NDArray[np.float32],
    gains: npt.NDArray[np.float64],
    noise: SensorNoise,
    seeds: npt.NDArray[np.uint64],
    *,
    white_level: int,
    wanted: SensorNoise | None = None,
    ratio: float = 1.0,
    below_black: bool = False,
    threads: int = 1,
) -> None:
    """Give items, in place, the noise of the light that their gains stand for; see `exposing`.

    `images`: (N, 3, H, W) float32, 0 … 1 = saturation, gains applied; cut to 0 … 1 again. `gains`: (N,) float64 > 0. Of
    a gain above the ratio nothing is added. `seeds`: (N,) uint64, of each item. `wanted`, `ratio`: noise at the wanted
    ISO speed, and that speed over the table's; `noise` and 1 if not given. `threads`: that share the items; no value
    depends on it.

    Examples
    --------
    >>> images = np.full((1, 3, 50, 50), 0.1, np.float32)
    >>> noise = SensorNoise((5.0, 4.0, 5.0), (0.5, 0.25, 0.5))
    >>> add_noise(images, np.array([0.5]), noise, np.array([7], np.uint64), white_level=10000)
    >>> bool(images.std() > 0.001), round(float(images.mean()), 3)
    (True, 0.1)
    """
    if images.dtype != np.float32 or images.ndim != 4 or images.shape[1] != 3 or not images.flags.c_contiguous:
        raise InputError(f"the items are {images.dtype} {images.shape}, expected contiguous float32 (N, 3, H, W)")
    count = len(images)
    if gains.shape != (count,) or seeds.shape != (count,) or not (gains > 0).all() or not 1 <= ratio < np.inf:
        raise InputError(
            f"gains {gains.shape}, seeds {seeds.shape} and a ratio of {ratio} were given; expected ({count},) above 0, "
            f"({count},), and 1 or more"
        )
    check_white_level(white_level)
    aim = wanted or noise
    each = gains[:, None]
    dark = np.maximum((np.square(aim.read) - each**2 * np.square(noise.read)) / white_level**2, -1)
    shot = np.maximum(ratio - each, 0) * np.array(noise.shot) / white_level
    # Where a gain exceeds the ratio, its own noise is that of a higher speed, and no less.
    dark = np.where(each > ratio, 0, dark)
    numbers = dark.astype(np.float32), shot.astype(np.float32)
    deviates, least = normal_deviates(), _NO_FLOOR if below_black else _ZERO

    def fill(first: int, end: int) -> None:
        some = slice(first, end)
        _add_noise(images[some], numbers[0][some], numbers[1][some], seeds[some], deviates, least)

    run_in_threads(fill, count, threads)
