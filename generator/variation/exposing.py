"""A raw image exposed anew: its counts times a factor, with the noise that a camera would have had, cut at saturation.

Let a count x of a table have the mean m and the variance read² + shot · m (`sensor_noise`). Under a · m of light at k
times the ISO speed, k ≥ a, the variance would be read_k² + k · shot · a m, while a x has a² read² + a · shot · a m. So

    y = a x + √max(0, (read_k² − a² read²) + (k − a) shot · a x) · z,    z a standard normal deviate,

has the right mean and, since the second term is linear in x, on the average the right variance. a x alone would be too
quiet where a < 1: of half the light, shot noise is 1.41 times that of half the counts. Where a > k nothing can be taken
away: such an image is one of ISO speed a, not k.

Then y is rounded to the nearest whole number, halves to the even one, so that rounding has no bias, and cut to 0 …
white level: nothing wraps. What is random is a pure function of seed, image, row and column: the key of a row is the
first two words of Philox with counter (y, 0, image, 14), the second above the first, and the word of column x is that
of SplitMix64 (G. Steele, D. Lea, C. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014) with the
state key + (x + 1) · 0x9E3779B97F4A7C15. Its upper three times 14 bits choose the deviates of red, green and blue
(`deviates`). Pixels are computed with +, −, ×, √ in float32 alone, which IEEE 754 rounds alike everywhere.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint32, uint64

from foundation.compiled import compiled, inlined
from foundation.errors import InputError
from generator import philox
from generator.kernels.arguments import check_seed, check_white_level, run_in_threads
from generator.kernels.choice import philox4x32
from generator.variation.deviates import BITS, normal_deviates
from generator.variation.sensor_noise import SensorNoise

Image = npt.NDArray[np.uint16]
Three = tuple[float, float, float]

PURPOSE: Final = np.uint32(philox.NOISE)
"""Of the words that are the keys of rows, as compiled code takes it."""
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_SHIFTS: Final = tuple(np.uint64(64 - BITS * place) for place in (1, 2, 3))
_MASK: Final = np.uint64((1 << BITS) - 1)
_RED_SHIFT, _GREEN_SHIFT, _BLUE_SHIFT = _SHIFTS
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)
_ZERO: Final = np.float32(0)
_ONE: Final = np.float32(1)


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

    Examples
    --------
    >>> image = np.arange(300, dtype=np.uint16).reshape(10, 10, 3)
    >>> brightness_reached(image, 0.02), brightness_reached(image, 0.0)
    (296.0, 299.5)
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
    threads: int = 1,
    out: Image | None = None,
) -> float:
    """Expose an image anew, in place unless `out` is given; the head of this file has the formulas.

    `image`: (H, W, 3) uint16, linear camera RGB, counts of a table. `wanted`, `ratio`: noise at the wanted ISO speed,
    and that speed over the table's, 1 or more; `noise` and 1 if not given. Where the factor is larger, the noise is
    that of the factor as ISO speed. `weights`, `end`: (H, W, 2) float32, how much of each pixel's light is that of the
    near and of the far end, and the light of the far end over that of the near one, above 0 up to 1; None for the same
    light everywhere. `threads`: that share the rows; no count depends on it. `out`: (H, W, 3) uint16 to fill.

    Examples
    --------
    >>> noise = SensorNoise(read=(5.0, 4.0, 5.0), shot=(0.5, 0.25, 0.5))
    >>> image = np.full((100, 100, 3), 1000, np.uint16)
    >>> expose(image, 0.5, noise)
    0.0
    >>> bool(abs(image.mean() - 500) < 1), bool(image.std(axis=(0, 1))[0] > 10)
    (True, True)
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
    clipped: list[int] = []

    def fill(top: int, bottom: int) -> None:
        clipped.append(
            _expose(
                image[top:bottom],
                far[top:bottom] if uneven else far,
                uneven,
                numbers,
                noisy,
                normal_deviates(),
                np.float32(speed),
                np.float32(white_level),
                key,
                number,
                first_row + top,
                target[top:bottom],
            )
        )

    run_in_threads(fill, len(image), threads)
    return sum(clipped) / max(1, image.shape[0] * image.shape[1])


def _weights_of(image: Image, weights: npt.NDArray[np.float32] | None) -> tuple[npt.NDArray[np.float32], bool]:
    if weights is None:
        return np.zeros((1, 1, 2), np.float32), False
    if weights.dtype != np.float32 or weights.shape != (*image.shape[:2], 2):
        raise InputError(f"the weights are {weights.dtype} {weights.shape}, expected float32 {(*image.shape[:2], 2)}")
    return np.ascontiguousarray(weights), True
