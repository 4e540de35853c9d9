"""Weights of lights in the pixels of a picture: their values, and who makes them.

The weights of a pixel are whole 65535ths that sum to 1, so that a 16-bit file holds them without loss.
"""

from __future__ import annotations

from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

FULL: Final = 65535
"""Weight 1 as a 16-bit file holds it: the largest value of 16 bits."""

Weights = npt.NDArray[np.float32]
"""(H, W, K) float32, 0 … 1: the weight of each of K lights in each pixel; sum 1."""

_FULL: Final = np.float32(FULL)
_WHOLE: Final = np.int32(FULL)
_HALF: Final = np.float32(0.5)


@runtime_checkable
class MaskMaker(Protocol):
    """Where in one picture each of its lights falls."""

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        ...


class MaskPlan(Protocol):
    """Masks for every image of a dataset."""

    def maker(self, number: int) -> MaskMaker:
        """Return the masks of image `number`."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values for `dataset.json`."""
        ...


@compiled
def _quantise_shares_of_two(first: Any, second: Any, out: Any) -> None:
    """Do as `_quantise_shares` for two lights and `out` (H, 2 W) float32, in a loop that the compiler vectorises."""
    for y in range(first.shape[0]):
        for x in range(first.shape[1]):
            total = first[y, x] + second[y, x]
            one = np.int32(first[y, x] / total * _FULL + _HALF)
            other = np.int32(second[y, x] / total * _FULL + _HALF)
            left, is_less = np.int32(_WHOLE - one - other), np.int32(second[y, x] > first[y, x])
            out[y, 2 * x] = np.float32(np.int32(one + left * np.int32(1 - is_less))) / _FULL
            out[y, 2 * x + 1] = np.float32(np.int32(other + left * is_less)) / _FULL


@compiled
def _quantise_shares(shares: Any, out: Any) -> None:
    """Fill `out` (H, W, K) float32 with `shares` (K, H, W) float32 as `quantise_shares` does."""
    lights, rows, columns = shares.shape
    for y in range(rows):
        for x in range(columns):
            total = shares[0, y, x]
            largest = 0
            for light in range(1, lights):
                total += shares[light, y, x]
                if shares[light, y, x] > shares[largest, y, x]:
                    largest = light
            left = FULL
            for light in range(lights):
                part = np.int32(shares[light, y, x] / total * _FULL + _HALF)
                left -= part
                out[y, x, light] = np.float32(part) / _FULL
            part = np.int32(shares[largest, y, x] / total * _FULL + _HALF)
            out[y, x, largest] = np.float32(part + left) / _FULL


def quantise_shares(shares: npt.NDArray[np.floating[Any]], out: Weights) -> None:
    """Fill `out` with shares in whole 65535ths that sum to 1; the largest takes up the rounding error.

    `shares`: (K, H, W) float32 ≥ 0, not all 0 in a pixel. `out`: (H, W, K) float32, 0 to 1, contiguous.

    Examples
    --------
    >>> weights = np.empty((1, 1, 3), np.float32)
    >>> quantise_shares(np.ones((3, 1, 1), np.float32), weights)
    >>> (weights * FULL).tolist()
    [[[21845.0, 21845.0, 21845.0]]]
    """
    if len(shares) == 2:
        _quantise_shares_of_two(shares[0], shares[1], out.reshape(len(out), -1))
    else:
        _quantise_shares(shares, out)
