"""Maps of images with several illuminants: the weights and the ground truth of every pixel, as 16-bit PNG files.

`masks/NNNNNN_k.png` is the weight of illuminant k = 0 … K − 1 of image NNNNNN, in grey; 65535 is weight 1. The weights
of a pixel sum to 1. `ground_truth/NNNNNN.png` has r, g, b with r + g + b = 65535. The ground truth of a pixel is the
chromaticity of the weighted sum of the ground truths of its illuminants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled, inlined
from foundation.errors import FormatError
from generator.files import encode_map
from generator.masks.making import FULL, Weights, decode_values

_ZERO: Final = np.float32(0)


@inlined
def _light_at(weights: Any, whites: Any, y: int, x: int) -> Any:
    red = green = blue = _ZERO
    for light in range(weights.shape[2]):
        weight = weights[y, x, light]
        red += weight * whites[light, 0]
        green += weight * whites[light, 1]
        blue += weight * whites[light, 2]
    return red, green, blue


@inlined
def _quantised(red: Any, green: Any, blue: Any, full: Any) -> Any:
    # Integers with the sum `full`; green absorbs the rounding errors.
    total = red + green + blue
    first, last = np.int32(np.rint(red / total * full)), np.int32(np.rint(blue / total * full))
    return first, np.int32(np.int32(full) - first - last), last


@compiled
def _quantise_chromaticities(weights: Any, whites: Any, full: Any, out: Any) -> None:
    for y in range(weights.shape[0]):
        for x in range(weights.shape[1]):
            red, green, blue = _light_at(weights, whites, y, x)
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = _quantised(red, green, blue, full)


@compiled
def _quantise_chromaticities_of_two(weights: Any, whites: Any, full: Any, out: Any) -> None:
    # Does the same as `_quantise_chromaticities` for weights (H, 2 W) and `out` (H, 3 W), in a loop that the compiler
    # vectorises.
    for y in range(weights.shape[0]):
        for x in range(weights.shape[1] // 2):
            first, second = weights[y, 2 * x], weights[y, 2 * x + 1]
            # The sum starts from 0, as for any number of illuminants, so that results are equal to the last bit.
            red = _ZERO + first * whites[0, 0] + second * whites[1, 0]
            green = _ZERO + first * whites[0, 1] + second * whites[1, 1]
            blue = _ZERO + first * whites[0, 2] + second * whites[1, 2]
            out[y, 3 * x], out[y, 3 * x + 1], out[y, 3 * x + 2] = _quantised(red, green, blue, full)


@compiled
def _quantise_weights(weights: Any, full: Any, out: Any) -> None:
    for y in range(weights.shape[0]):
        for light in range(weights.shape[2]):
            for x in range(weights.shape[1]):
                out[light, y, x] = np.int32(np.rint(weights[y, x, light] * full))


@compiled
def _sums(weights: Any, out: Any) -> None:
    for y in range(weights.shape[0]):
        for light in range(weights.shape[2]):
            row = 0.0
            for x in range(weights.shape[1]):
                row += weights[y, x, light]
            out[light] += row


def quantised_chromaticities(
    weights: npt.NDArray[np.float32], whites: npt.NDArray[np.float64], full: int
) -> npt.NDArray[np.uint16]:
    """Return the chromaticity (H, W, 3) uint16 of the weighted sum of illuminants, with the sum `full` in each pixel.

    `weights` is (H, W, K) float32 ≥ 0, not all 0 in a pixel; `whites` is (K, 3) float64, linear camera RGB above 0;
    `full` is at most 65535. Red and blue are rounded, green is the rest.
    """
    height, width, lights = weights.shape
    out = np.empty((height, width, 3), np.uint16)
    numbers = whites.astype(np.float32), np.float32(full)
    if lights == 2:
        _quantise_chromaticities_of_two(weights.reshape(height, -1), *numbers, out.reshape(height, -1))
    else:
        _quantise_chromaticities(weights, *numbers, out)
    return out


def quantised_weights(weights: npt.NDArray[np.float32], full: int) -> npt.NDArray[np.uint16]:
    """Return weights (H, W, K) float32 from 0 to 1 as (K, H, W) uint16, rounded, with `full` for weight 1."""
    height, width, lights = weights.shape
    out = np.empty((lights, height, width), np.uint16)
    _quantise_weights(weights, np.float32(full), out)
    return out


def mean_weights(weights: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the mean (K,) float64 of weights (H, W, K) float32, H and W ≥ 1."""
    out = np.zeros(weights.shape[2], np.float64)
    _sums(weights, out)
    return out / (weights.shape[0] * weights.shape[1])


def encode_maps(weights: Weights, whites: npt.NDArray[np.float64]) -> list[tuple[str, str, bytes]]:
    """Return the maps of an image: folder, end of the file name, and PNG file of each.

    `weights` is (H, W, K) float32 in multiples of 1/65535; `whites` is (K, 3) float64, the ground truth of each
    illuminant, linear camera RGB, not normalised.
    """
    shares = quantised_weights(weights, FULL)
    maps = [("masks", f"_{light}.png", encode_map(share)) for light, share in enumerate(shares)]
    truth = quantised_chromaticities(weights, whites, FULL)
    return [*maps, ("ground_truth", ".png", encode_map(truth))]


def decode_weights(files: Sequence[bytes], name: str) -> Weights:
    """Return the weights (H, W, K) float32, sum 1, of the K mask files of an image; raises FormatError."""
    masks = [_from_16_bits(data, 2, name) for data in files]
    if len({mask.shape for mask in masks}) != 1:
        raise FormatError(f"the masks of {name} differ in size, expected equal sizes; make the data set again")
    return np.stack(masks, axis=-1)


def decode_ground_truth(data: bytes, name: str) -> npt.NDArray[np.float32]:
    """Return the ground truth map (H, W, 3) float32, r + g + b = 1, of an image; raises FormatError."""
    return _from_16_bits(data, 3, name)


def _from_16_bits(data: bytes, dimensions: int, name: str) -> npt.NDArray[np.float32]:
    image = decode_values(data, name)
    if image.dtype != np.uint16 or image.ndim != dimensions:
        raise FormatError(f"{name} is {image.dtype} {image.shape}, expected a 16-bit map; make the data set again")
    return np.asarray(image / np.float32(FULL), dtype=np.float32)
