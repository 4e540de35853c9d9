"""The light of each pixel, and of all together, where several lights share a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from generator.kernels.compiled import compiled


@compiled
def _chromaticities(weights: Any, whites: Any, out: Any) -> None:
    for y in range(weights.shape[0]):
        for x in range(weights.shape[1]):
            red = green = blue = np.float32(0)
            for light in range(weights.shape[2]):
                weight = weights[y, x, light]
                red += weight * whites[light, 0]
                green += weight * whites[light, 1]
                blue += weight * whites[light, 2]
            total = red + green + blue
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = red / total, green / total, blue / total


@compiled
def _sums(weights: Any, out: Any) -> None:
    for y in range(weights.shape[0]):
        for light in range(weights.shape[2]):
            row = 0.0
            for x in range(weights.shape[1]):
                row += weights[y, x, light]
            out[light] += row


def chromaticities(weights: npt.NDArray[np.float32], whites: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return the chromaticity of the sum of the lights' whites, each times its weight, in each pixel.

    Parameters
    ----------
    weights
        (H, W, K) float32 ≥ 0, not all 0 in a pixel.
    whites
        (K, 3) linear camera RGB above 0.

    Returns
    -------
    ndarray
        (H, W, 3) float32, r + g + b = 1, computed in float32, lights added up in their order.
    """
    out = np.empty((*weights.shape[:2], 3), np.float32)
    _chromaticities(weights, whites.astype(np.float32), out)
    return out


def mean_weights(weights: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the mean (K,) float64 of weights (H, W, K) float32, H and W ≥ 1."""
    out = np.zeros(weights.shape[2], np.float64)
    _sums(weights, out)
    return out / (weights.shape[0] * weights.shape[1])
