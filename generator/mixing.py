"""Several lights at once, with the noise one exposure would have had.

Light is additive: under lights i of weights w_i a colour's mean is Σ w_i m_i, m_i its mean under light i alone. Noise
is not: a sample is x_i = m_i + n_i, where the variance of n_i is g m_i + r² (photons at gain g, and read noise r), and
one exposure under all lights has the variance g Σ w_i m_i + r². A weighted mean of samples would have g Σ w_i² m_i, too
quiet by half for two equal lights. Scaling deviations by the square root of the weight,

    y = Σ w_i m_i + Σ √w_i (x_i − m_i),   x_i drawn for each light on its own,

has the variance Σ w_i (g m_i + r²): photon noise exact for any weights, read noise exact where the weights sum to 1 and
√(Σ w_i) times too large otherwise. Weight 1 of one light gives that light's samples to the last bit.

What is approximate: m_i is the mean of the table's S samples and not of all paper of that colour; print and pixel
patterns that deviate in proportion to the light count as noise (their mixture is too quiet by √(Σ w_i²) for lights of
one brightness); samples clipped by the sensor stay clipped before they are mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import InputError
from generator import philox
from generator.arguments import (
    Picture,
    Samples,
    check_picture,
    check_place,
    check_tables,
    check_target,
    check_white,
    share,
)
from generator.choice import chosen, colour_of, row_keys
from generator.compiled import compiled
from generator.palette import bits_of


@compiled
def _mix_pixels(
    picture: Any,
    tables: Any,
    means: Any,
    weights: Any,
    bits: int,
    white: Any,
    seed: Any,
    image: int,
    first_row: int,
    out: Any,
) -> bool:
    """Fill `out`; return whether every weight was a finite number ≥ 0. All arithmetic is float32, light by light."""
    sound = True
    count = tables.shape[2]
    keys = np.empty((tables.shape[0], 3), np.uint32)
    total = np.empty(3, np.float32)
    for y in range(picture.shape[0]):
        for light in range(tables.shape[0]):
            keys[light] = row_keys(first_row + y, light, image, seed)
        for x in range(picture.shape[1]):
            colour = colour_of(picture[y, x], bits)
            total[:] = 0
            for light in range(tables.shape[0]):
                weight = weights[y, x, light]
                sound = sound and 0 <= weight < np.float32(np.inf)
                root = np.sqrt(weight)
                rest = weight - root
                sample = chosen(x, keys[light], count)
                for channel in range(3):
                    total[channel] += root * np.float32(tables[light, colour, sample, channel])
                    total[channel] += rest * means[light, colour, channel]
            for channel in range(3):
                out[y, x, channel] = np.uint16(min(max(total[channel] + np.float32(0.5), np.float32(0)), white))
    return sound


@compiled
def _mix_table(samples: Any, weight: float, words: Any, total: Any) -> None:
    """Add one light to `total` (C, S, 3) float64; sample i of each colour takes the place its shuffle gives it."""
    colours, count = samples.shape[0], samples.shape[1]
    root = np.sqrt(weight)
    order = np.empty(count, np.int64)
    for colour in range(colours):
        for i in range(count):
            order[i] = i
        for i in range(words.shape[1]):
            j = i + ((np.uint64(words[colour, i]) * np.uint64(count - i)) >> np.uint64(32))
            order[i], order[j] = order[j], order[i]
        for channel in range(3):
            mean = 0.0
            for i in range(count):
                mean += samples[colour, i, channel]
            mean /= count
            for i in range(count):
                total[colour, i, channel] += root * samples[colour, order[i], channel] + (weight - root) * mean


def _checked_weights(weights: npt.ArrayLike, lights: int) -> npt.NDArray[np.float64]:
    """Return `weights` as (K,) float64 after looking at them.

    Raises
    ------
    InputError
        They are not one finite number ≥ 0 a light.
    """
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (lights,) or not np.isfinite(checked).all() or (checked < 0).any():
        raise InputError(f"the weights are {np.asarray(weights).tolist()}, expected {lights} finite numbers from 0")
    return checked


def mixed_table(
    tables: Samples | Sequence[Samples], weights: npt.ArrayLike, *, white_level: int = 65535, seed: int = 0
) -> Samples:
    """Return the samples of a light that is the mixture of some lights; the formula stands at the head of this file.

    The result is used as a light's samples: `draw_samples(mixed_table(...), picture)`. Each colour's samples of the
    first light with a weight keep their order; those of each further light are shuffled on their own, so that the
    lights' noises meet by chance.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    weights
        (K,) ≥ 0, what each light contributes; 1 is the light as it was photographed.
    white_level
        Saturation of the sensor: larger values are cut to it.
    seed
        Of the shuffles, 0 … 2⁶⁴ − 1.

    Returns
    -------
    ndarray
        (8**bits, S, 3) uint16, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        A shape, type or number is not as above.
    """
    lights = check_tables(tables)
    checked = _checked_weights(weights, len(lights))
    check_white(white_level)
    colours, count, _ = lights[0].shape
    total = np.zeros(lights[0].shape, np.float64)
    shuffled = False
    for light, (samples, weight) in enumerate(zip(lights, checked, strict=True)):
        if weight == 0:
            continue
        words = np.zeros((colours, 0), np.uint32)
        if shuffled:
            colour: npt.NDArray[np.int64] = np.arange(colours, dtype=np.int64)[:, None]
            step: npt.NDArray[np.int64] = np.arange(count // 4 + 1, dtype=np.int64)
            four = philox.words(seed, colour, step, light, philox.MIXTURES)
            words = np.stack(four, axis=-1).reshape(colours, -1)[:, : count - 1]
        _mix_table(samples, float(weight), words, total)
        shuffled = True
    np.clip(np.floor(total + 0.5, out=total), 0, white_level, out=total)
    return total.astype(np.uint16)


def mix_samples(
    tables: Samples | Sequence[Samples],
    picture: Picture,
    weights: npt.NDArray[np.float32],
    *,
    white_level: int = 65535,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of `picture` under several lights, mixed in each pixel by weights of its own.

    The formula stands at the head of this file. Each light's sample is drawn by the rule of `choice.py` with the
    light's place in `tables`; where light 0 is alone with weight 1, the pixel is that of `draw_samples`.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    picture
        (H, W, 3) uint8 sRGB codes.
    weights
        (H, W, K) float32 ≥ 0, or (K,) for all pixels: what each light contributes; 1 is the light as photographed.
    white_level
        Saturation of the sensor: larger values are cut to it.
    seed, image, first_row, threads
        As for `kernel.draw_samples`.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, computed in float32, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        A shape, type or number is not as above.
    """
    lights = check_tables(tables)
    bits = bits_of(lights[0].shape[0])
    check_picture(picture)
    check_white(white_level)
    target = check_target(out, picture.shape, np.uint16)
    key = check_place(seed, image)
    shape = (*picture.shape[:2], len(lights))
    each = np.asarray(weights)
    if each.dtype != np.float32:
        each = _checked_weights(each, len(lights)).astype(np.float32)
    if each.shape not in (shape, shape[2:]):
        raise InputError(f"the weights are {each.shape}, expected {shape} or {shape[2:]}")
    each = np.broadcast_to(each, shape)
    stacked = np.stack(lights)
    means = stacked.mean(axis=2, dtype=np.float64).astype(np.float32)
    sound: list[bool] = []

    def fill(top: int, bottom: int) -> None:
        band = slice(top, bottom)
        sound.append(
            _mix_pixels(
                picture[band],
                stacked,
                means,
                each[band],
                bits,
                np.float32(white_level),
                key,
                image,
                first_row + top,
                target[band],
            )
        )

    share(fill, len(picture), threads)
    if not all(sound):
        raise InputError("a weight is negative, infinite or no number; expected finite numbers from 0")
    return target
