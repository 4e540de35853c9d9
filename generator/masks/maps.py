"""Maps beside the images of a dataset: the weight of each light, and the ground truth, of every pixel.

`masks/NNNNNN_k.png` holds the weight of light k = 0 … K − 1 in 16-bit grey, 65535 = 1, sum 65535, and
`ground_truth/NNNNNN.png` r, g, b in 16 bits with r + g + b = 65535.
A pixel's ground truth is the chromaticity of the sum of the lights' whites, each times its weight.
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
    """Return r, g and b as whole parts of `full` that sum to it; green takes the errors of rounding."""
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
    """Do the same for weights (H, 2 W) and `out` (H, 3 W), in a loop that the compiler vectorises."""
    for y in range(weights.shape[0]):
        for x in range(weights.shape[1] // 2):
            one, other = weights[y, 2 * x], weights[y, 2 * x + 1]
            # Added to 0 first, as for any number of lights, so that the bits are the same.
            red = _ZERO + one * whites[0, 0] + other * whites[1, 0]
            green = _ZERO + one * whites[0, 1] + other * whites[1, 1]
            blue = _ZERO + one * whites[0, 2] + other * whites[1, 2]
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
    """Return the chromaticity of the sum of the lights' whites, each times its weight, in each pixel.

    `weights`: (H, W, K) float32 ≥ 0, not all 0 in a pixel. `whites`: (K, 3) float64, linear camera RGB above 0. Returns
    whole parts of `full` ≤ 65535: (H, W, 3) uint16, of which each pixel sums to `full`, computed in float32, lights
    added up in their order. Red and blue are rounded, green is the rest.
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
    """Return weights (H, W, K) float32 from 0 to 1 as whole parts of `full` ≤ 65535, rounded: (K, H, W) uint16."""
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
    """Return what goes beside an image of several lights: folder, what follows the image's number, PNG file.

    `weights`: (H, W, K) float32 in whole 65535ths, what the image was made with. `whites`: (K, 3) float64, the ground
    truth of each light, linear camera RGB, not normalised.
    """
    shares = quantised_weights(weights, FULL)
    maps = [("masks", f"_{light}.png", encode_map(share)) for light, share in enumerate(shares)]
    truth = quantised_chromaticities(weights, whites, FULL)
    return [*maps, ("ground_truth", ".png", encode_map(truth))]


def decode_weights(files: Sequence[bytes], what: str) -> Weights:
    """Return the weights (H, W, K) float32, sum 1, of the K mask files of an image of a dataset."""
    masks = [_from_16_bits(data, 2, what) for data in files]
    if len({mask.shape for mask in masks}) != 1:
        raise FormatError(f"the masks of {what} differ in size; make the dataset again")
    return np.stack(masks, axis=-1)


def decode_ground_truth(data: bytes, what: str) -> npt.NDArray[np.float32]:
    """Return the ground truth (H, W, 3) float32, r + g + b = 1, of every pixel of an image of a dataset."""
    return _from_16_bits(data, 3, what)


def _from_16_bits(data: bytes, dimensions: int, what: str) -> npt.NDArray[np.float32]:
    """Return the values (H, W) or (H, W, 3) float32, 0 … 1, of a file of 16 bits."""
    image = decode_values(data, what)
    if image.dtype != np.uint16 or image.ndim != dimensions:
        raise FormatError(f"{what} is no map of 16 bits; make the dataset again")
    return np.asarray(image / np.float32(FULL), dtype=np.float32)
