"""The inner loop of comparing cells with their neighbours, compiled.

Compiled for the processor at hand, without licence to reorder sums. What the numbers mean stands where it is called, in
`calibration.checks.frame_consistency`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


@compiled
def clipped_to_neighbours(values: _Array, around: _Index, out: _Array) -> None:
    """Fill out (N,) with values brought between the second lowest and second highest of those `around` each (N, K).

    NaN is no value and stays; where fewer than three values are around, its own among them, nothing vouches for a
    value, and it becomes NaN.
    """
    for n in range(len(values)):
        lowest, low, highest, high = np.inf, np.inf, -np.inf, -np.inf
        count = 0
        for place in around[n]:
            value = values[place]
            known = value == value
            below, above = value if known else np.inf, value if known else -np.inf
            # Without branches, which nobody could foretell.
            low = min(low, max(lowest, below))
            lowest = min(lowest, below)
            high = max(high, min(highest, above))
            highest = max(highest, above)
            count += known
        out[n] = np.nan if count < 3 or np.isnan(values[n]) else min(max(values[n], low), high)
