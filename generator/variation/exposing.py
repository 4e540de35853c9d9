"""A raw image exposed anew: its counts times a factor, with the noise that a camera would have had, cut at saturation.

Let a count x of a table have the mean m and the variance read² + shot · m (`sensor_noise`). Under a · m of light at k
times the ISO speed, k ≥ a, the variance would be read_k² + k · shot · a m, while a x has a² read² + a · shot · a m. So

    y = a x + √max(0, (read_k² − a² read²) + (k − a) shot · a x) · z,    z a standard normal deviate,

has the right mean and, since the second term is linear in x, on the average the right variance. a x alone would be too
quiet where a < 1: of half the light, shot noise is 1.41 times that of half the counts. Where a > k nothing can be
taken away: such an image is one of ISO speed a, not k.

Then y is rounded to the nearest whole number, halves to the even one, so that rounding has no bias, and cut to 0 …
white level: nothing wraps. What is random is a pure function of seed, image, row and column: the key of a row is the
first two words of Philox with counter (y, 0, image, 14), the second above the first, and the word of column x is that
of SplitMix64 (G. Steele, D. Lea, C. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014) with the
state key + (x + 1) · 0x9E3779B97F4A7C15. Its upper three times 14 bits choose the deviates of red, green and blue
(`sensor_noise.normal_deviates`). Pixels are computed with +, −, ×, √ in float32 alone, which IEEE 754 rounds alike
everywhere.

Crops for training, float32 planes that were given a gain, get noise by the same model and rule, with image 0 and each
item's own seed.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32, uint64

from foundation.compiled import compiled, inlined
from foundation.errors import InputError
from generator import philox
from generator.kernels.choice import check_seed, check_white_level, philox4x32, run_in_threads
from generator.variation.sensor_noise import BITS, SensorNoise, normal_deviates

Image = npt.NDArray[np.uint16]
Three = tuple[float, float, float]

PURPOSE: Final = np.uint32(philox.NOISE)  # Of the words that are the keys of rows, as compiled code takes it
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_SHIFTS: Final = tuple(np.uint64(64 - BITS * place) for place in (1, 2, 3))
_MASK: Final = np.uint64((1 << BITS) - 1)
_RED_SHIFT, _GREEN_SHIFT, _BLUE_SHIFT = _SHIFTS
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)


@inlined
def draw_row(key: Any, width: int, table: Any, deviates: Any) -> None:
    """Fill `deviates` (3 · width,) float32 with those of a row's pixels, red, green, blue."""
    state = key
    for x in range(width):
        state = uint64(state + _STEP)
        word = uint64((state ^ (state >> _30)) * _FIRST)
        word = uint64((word ^ (word >> _27)) * _SECOND)
        word = uint64(word ^ (word >> _31))
        deviates[3 * x] = table[word >> _RED_SHIFT]
        deviates[3 * x + 1] = table[(word >> _GREEN_SHIFT) & _MASK]
        deviates[3 * x + 2] = table[(word >> _BLUE_SHIFT) & _MASK]


@compiled
def _expose(
    source: Any,
    weights: Any,
    uneven: bool,
    numbers: Any,
    noisy: bool,
    table: Any,
    ratio: Any,
    white: Any,
    seed: Any,
    image: int,
    first_row: int,
    target: Any,
) -> int:
    """Fill `target` and return how many of its pixels have a channel at saturation.

    `numbers` (5, 3) float32 are, of each channel, the factor of the light, by how much less it is at the far end, the
    wanted variance of darkness, that of the table, and the table's variance a count.
    """
    rows, width = source.shape[0], source.shape[1]
    deviates = np.zeros(3 * width, np.float32)
    factors = np.empty(3 * width, np.float32)
    values = np.empty(3 * width, np.float32)
    constants = np.empty((3, 3 * width), np.float32)
    for x in range(width):
        for channel in range(3):
            factors[3 * x + channel] = numbers[0, channel]
            for constant in range(3):
                constants[constant, 3 * x + channel] = numbers[2 + constant, channel]
    clipped = 0
    for y in range(rows):
        if noisy:
            k0, k1, _, _ = philox4x32(uint32(first_row + y), uint32(0), uint32(image), PURPOSE, seed)
            draw_row((uint64(k1) << _32) | uint64(k0), width, table, deviates)
        if uneven:
            for x in range(width):
                far = weights[y, x, 1]
                for channel in range(3):
                    factors[3 * x + channel] = numbers[0, channel] - far * numbers[1, channel]
        row, out = source[y].reshape(3 * width), target[y].reshape(3 * width)
        # By way of a buffer, since a loop that may write what it reads is not compiled to vectors.
        for i in range(3 * width):
            values[i] = factors[i] * np.float32(row[i])
        if noisy:
            for i in range(3 * width):
                factor, light = factors[i], values[i]
                shot = (ratio - factor) * constants[2, i] * light
                missing = constants[0, i] - factor * factor * constants[1, i] + shot
                values[i] = light + np.sqrt(max(missing, _ZERO)) * deviates[i]
        for i in range(3 * width):
            out[i] = np.uint16(min(max(np.rint(values[i]), _ZERO), white))
        most = np.uint16(white)
        for x in range(width):
            clipped += max(out[3 * x], out[3 * x + 1], out[3 * x + 2]) >= most
    return clipped


@compiled
def _count_brightness(source: Any, weights: Any, uneven: bool, numbers: Any, counts: Any) -> None:
    """Add to `counts` (65536,) how often each value is the largest channel of a pixel, its light fallen off."""
    for y in range(source.shape[0]):
        for x in range(source.shape[1]):
            brightest = _ZERO
            for channel in range(3):
                factor = _ONE - weights[y, x, 1] * numbers[channel] if uneven else _ONE
                brightest = max(brightest, factor * np.float32(source[y, x, channel]))
            counts[int(brightest)] += 1


def brightness_reached(
    image: Image, share: float, weights: npt.NDArray[np.float32] | None = None, end: Three = (1.0, 1.0, 1.0)
) -> float:
    """Return the largest channel that a share of an image's pixels reaches or exceeds.

    `image`: (H, W, 3) uint16. `share`: 0 … 1. Of share 0, what no pixel reaches: half a count above the largest.
    `weights`, `end`: how its light falls off, (H, W, 2) float32 and three numbers, as of `expose`.
    """
    counts = np.zeros(65536, np.int64)
    far, uneven = _weights_of(image, weights)
    _count_brightness(image, far, uneven, np.array([1 - part for part in end], np.float32), counts)
    above = np.cumsum(counts[::-1])[::-1]
    wanted = round(share * above[0])
    if wanted < 1:
        return float(np.flatnonzero(counts)[-1]) + 0.5
    return float(np.flatnonzero(above >= wanted)[-1])


def expose(
    image: Image,
    factor: float,
    noise: SensorNoise,
    *,
    wanted: SensorNoise | None = None,
    ratio: float = 1.0,
    weights: npt.NDArray[np.float32] | None = None,
    end: Three = (1.0, 1.0, 1.0),
    white_level: int = 65535,
    seed: int = 0,
    number: int = 0,
    first_row: int = 0,
    out: Image | None = None,
) -> float:
    """Expose an image anew, in place unless `out` is given; the head of this file has the formulas.

    `image`: (H, W, 3) uint16, linear camera RGB, counts of a table. `wanted`, `ratio`: noise at the wanted ISO speed,
    and that speed over the table's, 1 or more; `noise` and 1 if not given. Where the factor is larger, the noise is
    that of the factor as ISO speed. `weights`, `end`: (H, W, 2) float32, how much of each pixel's light is that of the
    near and of the far end, and the light of the far end over that of the near one, above 0 up to 1; None for the same
    light everywhere. `out`: (H, W, 3) uint16 to fill.
    """
    target = image if out is None else out
    for array in (image, target):
        if array.dtype != np.uint16 or array.ndim != 3 or array.shape[2] != 3 or not array.flags.c_contiguous:
            raise InputError(f"the image is {array.dtype} {array.shape}, expected contiguous uint16 (height, width, 3)")
    if target.shape != image.shape:
        raise InputError(f"the target is {target.shape}, expected {image.shape}")
    if not (0 < factor < np.inf and 1 <= ratio < np.inf and all(0 < part <= 1 for part in end)):
        raise InputError(
            f"a factor of {factor}, an ISO ratio of {ratio} and a far end of {end} were asked for; expected a factor "
            "above 0, a ratio from 1, and light above 0 up to 1"
        )
    check_white_level(white_level)
    key = check_seed(seed, number)
    far, uneven = _weights_of(image, weights)
    aim = wanted or noise
    rows = (
        [factor] * 3,
        [factor * (1 - part) for part in end],
        np.square(aim.read),
        np.square(noise.read),
        noise.shot,
    )
    numbers = np.array(rows, np.float32)
    speed = max(ratio, factor)
    least = factor * min(end)
    noisy = any(
        read**2 > least**2 * own**2 or (speed > least and shot > 0)
        for read, own, shot in zip(aim.read, noise.read, noise.shot, strict=True)
    )
    clipped = _expose(
        image,
        far,
        uneven,
        numbers,
        noisy,
        normal_deviates(),
        np.float32(speed),
        np.float32(white_level),
        key,
        number,
        first_row,
        target,
    )
    return clipped / max(1, image.shape[0] * image.shape[1])


def _weights_of(image: Image, weights: npt.NDArray[np.float32] | None) -> tuple[npt.NDArray[np.float32], bool]:
    if weights is None:
        return np.zeros((1, 1, 2), np.float32), False
    if weights.dtype != np.float32 or weights.shape != (*image.shape[:2], 2):
        raise InputError(f"the weights are {weights.dtype} {weights.shape}, expected float32 {(*image.shape[:2], 2)}")
    return np.ascontiguousarray(weights), True


_ZERO: Final = np.float32(0)
# Least value where counts below black are kept: as far below 0 as saturation is above, where no noise reaches.
_NO_FLOOR: Final = np.float32(-1)
_ONE: Final = np.float32(1)


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
