"""Change the exposure of a raw image: scale its counts and add the noise of a camera at the new exposure.

A count x of a look-up table (LUT) has the mean m and the variance read² + shot · m (`sensor_noise`). The new exposure
multiplies counts by a, at k times the ISO speed of the LUT, with k ≥ a. Then the mean is a m and the variance
read_k² + k · shot · a m, where read_k is the read noise at k times the speed. The product a x has too little noise: its
variance is a² read² + a · shot · a m. The missing noise is added, with a standard normal deviate z:

    y = a x + √max(0, (read_k² − a² read²) + (k − a) shot · a x) · z

y has the correct mean. Its variance is correct on average, because the second term is linear in x. For example, shot
noise at half the light is 1.41 times the shot noise of halved counts. If a > k, noise would have to be removed, which
is impossible, so k = a is used instead.

y is rounded to the nearest whole number, halves to even, so that rounding has no bias. It is clipped to 0 … saturation
level.

Deviates depend only on seed, image, row and column. The key of a row is the first two words of Philox with counter
(y, 0, image, 14); the second word is the upper half. Column x has a word of SplitMix64 (G. Steele, D. Lea, C. Flood,
"Fast splittable pseudorandom number generators", OOPSLA 2014) with the state key + (x + 1) · 0x9E3779B97F4A7C15. Its
upper three groups of 14 bits select the deviates of red, green and blue (`sensor_noise.normal_deviates`). Pixels are
calculated with +, −, × and √ in float32 only. IEEE 754 defines their rounding, so the result is the same on all
machines.

Noise is added to training crops (float32 planes multiplied by a gain) by the same model, with image 0 and one seed per
crop.
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

PURPOSE: Final = np.uint32(philox.NOISE)  # Purpose of the Philox words that are keys of rows, for compiled code
# Constants of SplitMix64: increment of the state, and two multipliers.
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_SHIFTS: Final = tuple(np.uint64(64 - BITS * channel) for channel in (1, 2, 3))
_MASK: Final = np.uint64((1 << BITS) - 1)
_RED_SHIFT, _GREEN_SHIFT, _BLUE_SHIFT = _SHIFTS
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)


@inlined
def draw_row(key: Any, width: int, table: Any, deviates: Any) -> None:
    """Fill `deviates` (3 · width,) float32 with the deviates of the pixels of a row: red, green, blue."""
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
    # Fills `target` and returns its number of saturated pixels. `numbers` (5, 3) float32 has one row for each of:
    # factor on the light, its decrease at the far end, target read variance, LUT read variance, LUT shot variance per
    # count. Columns are channels.
    rows, width = source.shape[0], source.shape[1]
    deviates = np.zeros(3 * width, np.float32)
    factors = np.empty(3 * width, np.float32)
    values = np.empty(3 * width, np.float32)
    noise_terms = np.empty((3, 3 * width), np.float32)
    for x in range(width):
        for channel in range(3):
            factors[3 * x + channel] = numbers[0, channel]
            for term in range(3):
                noise_terms[term, 3 * x + channel] = numbers[2 + term, channel]
    saturated = 0
    for y in range(rows):
        if noisy:
            k0, k1, _, _ = philox4x32(uint32(first_row + y), uint32(0), uint32(image), PURPOSE, seed)
            draw_row((uint64(k1) << _32) | uint64(k0), width, table, deviates)
        if uneven:
            for x in range(width):
                far_weight = weights[y, x, 1]
                for channel in range(3):
                    factors[3 * x + channel] = numbers[0, channel] - far_weight * numbers[1, channel]
        source_row, target_row = source[y].reshape(3 * width), target[y].reshape(3 * width)
        # The buffer is separate, because a loop that may overwrite its input is not vectorised.
        for i in range(3 * width):
            values[i] = factors[i] * np.float32(source_row[i])
        if noisy:
            for i in range(3 * width):
                factor, light = factors[i], values[i]
                shot = (ratio - factor) * noise_terms[2, i] * light
                added_variance = noise_terms[0, i] - factor * factor * noise_terms[1, i] + shot
                values[i] = light + np.sqrt(max(added_variance, _ZERO)) * deviates[i]
        for i in range(3 * width):
            target_row[i] = np.uint16(min(max(np.rint(values[i]), _ZERO), white))
        saturation = np.uint16(white)
        for x in range(width):
            saturated += max(target_row[3 * x], target_row[3 * x + 1], target_row[3 * x + 2]) >= saturation
    return saturated


@compiled
def _count_brightness(source: Any, weights: Any, uneven: bool, numbers: Any, counts: Any) -> None:
    # Adds the brightness of each pixel, after the fall-off of the light, to the histogram `counts` (65536,).
    for y in range(source.shape[0]):
        for x in range(source.shape[1]):
            brightest = _ZERO
            for channel in range(3):
                factor = _ONE - weights[y, x, 1] * numbers[channel] if uneven else _ONE
                brightest = max(brightest, factor * np.float32(source[y, x, channel]))
            counts[int(brightest)] += 1


def brightness_reached(
    image: Image, share: float, weights: npt.NDArray[np.float32] | None = None, far_end: Three = (1.0, 1.0, 1.0)
) -> float:
    """Return the brightness that a share of the pixels of an image reaches or exceeds, in counts.

    The brightness of a pixel is its largest channel. `image`: (H, W, 3) uint16. `share`: 0 … 1; 0 gives half a count
    more than the largest brightness. `weights`, `far_end`: fall-off of the light, as for `expose`.
    """
    counts = np.zeros(65536, np.int64)
    light_shares, is_uneven = _weights_of(image, weights)
    _count_brightness(image, light_shares, is_uneven, np.array([1 - end for end in far_end], np.float32), counts)
    at_or_above = np.cumsum(counts[::-1])[::-1]
    pixel_count = round(share * at_or_above[0])
    if pixel_count < 1:
        return float(np.flatnonzero(counts)[-1]) + 0.5
    return float(np.flatnonzero(at_or_above >= pixel_count)[-1])


def expose(
    image: Image,
    factor: float,
    noise: SensorNoise,
    *,
    target_noise: SensorNoise | None = None,
    iso_ratio: float = 1.0,
    weights: npt.NDArray[np.float32] | None = None,
    far_end: Three = (1.0, 1.0, 1.0),
    white_level: int = 65535,
    seed: int = 0,
    number: int = 0,
    first_row: int = 0,
    out: Image | None = None,
) -> float:
    """Change the exposure of an image, in place unless `out` is given; return the share of saturated pixels.

    The module docstring has the formulas.

    Parameters
    ----------
    image
        (H, W, 3) uint16, contiguous, linear camera RGB, counts of a LUT.
    factor
        Factor on the light, > 0. If it exceeds `iso_ratio`, the noise is that of an ISO ratio equal to the factor.
    noise
        Noise of the samples of the LUT.
    target_noise, iso_ratio
        Noise at the target ISO speed, and that speed relative to the LUT, ≥ 1; `noise` and 1 by default.
    weights
        (H, W, 2) float32, weights of the near and the far end of the fall-off in each pixel; None for even light.
    far_end
        Red, green and blue light of the far end relative to the near end, > 0 and ≤ 1.
    white_level
        Saturation level, 1 … 65535 counts.
    seed, number
        Seed, 0 … 2⁶⁴ − 1, and number of the image, 0 … 2³² − 1.
    first_row
        Row of the whole image at which `image` begins.
    out
        (H, W, 3) uint16 to fill.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.
    """
    target = image if out is None else out
    for array in (image, target):
        if array.dtype != np.uint16 or array.ndim != 3 or array.shape[2] != 3 or not array.flags.c_contiguous:
            raise InputError(f"the image is {array.dtype} {array.shape}, expected contiguous uint16 (height, width, 3)")
    if target.shape != image.shape:
        raise InputError(f"`out` is {target.shape}, expected {image.shape}")
    if not (0 < factor < np.inf and 1 <= iso_ratio < np.inf and all(0 < channel <= 1 for channel in far_end)):
        raise InputError(
            f"the factor is {factor}, the ISO ratio {iso_ratio} and the far end {far_end}; expected a factor > 0, "
            "a ratio ≥ 1, and light > 0 and ≤ 1"
        )
    check_white_level(white_level)
    key = check_seed(seed, number)
    light_shares, is_uneven = _weights_of(image, weights)
    final_noise = target_noise or noise
    rows = (
        [factor] * 3,
        [factor * (1 - channel) for channel in far_end],
        np.square(final_noise.read),
        np.square(noise.read),
        noise.shot,
    )
    numbers = np.array(rows, np.float32)
    speed = max(iso_ratio, factor)
    smallest_factor = factor * min(far_end)
    is_noisy = any(
        read**2 > smallest_factor**2 * table_read**2 or (speed > smallest_factor and shot > 0)
        for read, table_read, shot in zip(final_noise.read, noise.read, noise.shot, strict=True)
    )
    saturated = _expose(
        image,
        light_shares,
        is_uneven,
        numbers,
        is_noisy,
        normal_deviates(),
        np.float32(speed),
        np.float32(white_level),
        key,
        number,
        first_row,
        target,
    )
    return saturated / max(1, image.shape[0] * image.shape[1])


def _weights_of(image: Image, weights: npt.NDArray[np.float32] | None) -> tuple[npt.NDArray[np.float32], bool]:
    if weights is None:
        return np.zeros((1, 1, 2), np.float32), False
    if weights.dtype != np.float32 or weights.shape != (*image.shape[:2], 2):
        raise InputError(f"the weights are {weights.dtype} {weights.shape}, expected float32 {(*image.shape[:2], 2)}")
    return np.ascontiguousarray(weights), True


_ZERO: Final = np.float32(0)
# Lower limit if values below black are kept. Noise never reaches it.
_NO_FLOOR: Final = np.float32(-1)
_ONE: Final = np.float32(1)


@compiled
def _add_noise(images: Any, dark: Any, shot: Any, seeds: Any, table: Any, lower_limit: Any) -> None:
    # The variance is `dark` (N, 3) + `shot` (N, 3) · value.
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
                    noisy_value = value + np.sqrt(max(base + slope * value, _ZERO)) * deviates[3 * x + channel]
                    row[x] = min(max(noisy_value, lower_limit), _ONE)


def add_noise(
    images: npt.NDArray[np.float32],
    gains: npt.NDArray[np.float64],
    noise: SensorNoise,
    seeds: npt.NDArray[np.uint64],
    *,
    white_level: int,
    target_noise: SensorNoise | None = None,
    iso_ratio: float = 1.0,
    below_black: bool = False,
    threads: int = 1,
) -> None:
    """Add noise to training crops, in place: the noise of a camera whose exposure is changed by the gain.

    Parameters
    ----------
    images
        (N, 3, H, W) float32, already multiplied by the gains; 1 is saturation. Results are clipped to 0 … 1.
    gains
        (N,) float64 > 0. Nothing is added for a gain above `iso_ratio`.
    noise
        Noise of the samples of the LUT.
    seeds
        (N,) uint64, seed of each crop.
    white_level
        Saturation level, 1 … 65535 counts.
    target_noise, iso_ratio
        Noise at the target ISO speed, and that speed relative to the LUT, ≥ 1; `noise` and 1 by default.
    below_black
        Keep results below 0.
    threads
        Number of threads that share the crops. The result does not depend on it.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.
    """
    if images.dtype != np.float32 or images.ndim != 4 or images.shape[1] != 3 or not images.flags.c_contiguous:
        raise InputError(f"the crops are {images.dtype} {images.shape}, expected contiguous float32 (N, 3, H, W)")
    count = len(images)
    if gains.shape != (count,) or seeds.shape != (count,) or not (gains > 0).all() or not 1 <= iso_ratio < np.inf:
        raise InputError(
            f"gains are {gains.shape}, seeds {seeds.shape} and the ISO ratio is {iso_ratio}; expected gains ({count},) "
            f"> 0, seeds ({count},) and a ratio ≥ 1"
        )
    check_white_level(white_level)
    final_noise = target_noise or noise
    gain_column = gains[:, None]
    dark = np.maximum((np.square(final_noise.read) - gain_column**2 * np.square(noise.read)) / white_level**2, -1)
    shot = np.maximum(iso_ratio - gain_column, 0) * np.array(noise.shot) / white_level
    # A crop with a gain above `iso_ratio` already has the noise of a higher ISO speed.
    dark = np.where(gain_column > iso_ratio, 0, dark)
    variances = dark.astype(np.float32), shot.astype(np.float32)
    deviates, lower_limit = normal_deviates(), _NO_FLOOR if below_black else _ZERO

    def fill(first: int, end: int) -> None:
        items = slice(first, end)
        _add_noise(images[items], variances[0][items], variances[1][items], seeds[items], deviates, lower_limit)

    run_in_threads(fill, count, threads)
