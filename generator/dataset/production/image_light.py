"""What is recorded of the light of one image: its lights, their mean, and the maps that lie beside the image.

An image under one light has that light's ground truth, however its intensity falls off. Where it falls off with a tint
(`generator.variation.variation`) the light stands in the records twice, as it is at the near and at the far end, and
masks and maps say how much of either reaches a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from generator.dataset.production.records import LightRow, Triple
from generator.lights.lighting import Lighting
from generator.variation.variation import Varied

if TYPE_CHECKING:
    from calibration.table.lut import Lut


@dataclass(frozen=True, eq=False)
class ImageLight:
    """The light of one image.

    - `truth`: chromaticity, sum 1, of the light averaged over the pixels.
    - `maps`: kind, what follows the image's number in the file's name, and the bytes of each map beside the image.
    """

    truth: Triple
    rows: list[LightRow]
    maps: list[tuple[str, str, bytes]]


def image_light(
    lut: Lut, lighting: Lighting, weights: npt.NDArray[np.float32] | None, varied: Varied, tints: bool
) -> ImageLight:
    """Return the light of an image.

    `weights`: (H, W, K) float32, of each of K lights in each pixel; None of one light.
    """
    from generator.masks.maps import encode_maps, mean_weights

    labels = [mixture.label for mixture in lighting.mixtures]
    whites = lighting.whites(lut)
    intensity = None
    if tints:
        weights, labels = varied.weights, labels * 2
        whites = np.concatenate([whites, whites * np.array(varied.end)])
    elif weights is not None:
        intensity = varied.intensity()
    rows = [
        LightRow(illumination=label, truth=chromaticity(white)) for label, white in zip(labels, whites, strict=True)
    ]
    if weights is None:
        return ImageLight(rows[0].truth, rows, [])
    reaching = weights if intensity is None else weights * intensity[..., None]
    truth = chromaticity(np.asarray(mean_weights(reaching) @ whites))
    return ImageLight(truth, rows, encode_maps(weights, whites))


def chromaticity(white: npt.NDArray[np.float64]) -> Triple:
    """Return (r, g, b) of sum 1 of linear RGB (3,) float64."""
    red, green, blue = (float(part) for part in white / white.sum())
    return red, green, blue
