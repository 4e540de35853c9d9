"""Means and variances of a light's samples, compiled: one pass over the table's integers, nothing rounded.

What the numbers mean stands where the kernel is called, in `calibration.comparison.comparing`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]
_Count = npt.NDArray[np.uint16]


@compiled
def moments(values: _Count, means: _Array, variances: _Array) -> None:
    """Fill means and variances (N, 3) float64, the latter with S − 1 freedoms, of values (N, S, 3) uint16."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        for channel in range(3):
            total, squares = np.int64(0), np.int64(0)
            for number in range(samples):
                value = np.int64(values[patch, number, channel])
                total += value
                squares += value * value
            means[patch, channel] = total / samples
            # Integers: S Σv² and (Σv)² are exact, so their difference has every digit.
            variances[patch, channel] = (samples * squares - total * total) / (samples * (samples - 1))
