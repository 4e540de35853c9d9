"""Maps beside the images of a dataset: the weight of each light, and the ground truth, of every pixel.

`masks/NNNNNN_k.png` holds the weight of light k = 0 … K − 1 in 16-bit grey, 65535 = 1, sum 65535, and
`ground_truth/NNNNNN.png` r, g, b in 16 bits with r + g + b = 65535.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from generator.files import encode_map
from generator.masks.decoding import decode_values
from generator.masks.weights import FULL, Weights
from generator.masks.whites import quantised_chromaticities, quantised_weights


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
