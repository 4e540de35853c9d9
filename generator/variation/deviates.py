"""Normal deviates from random words: the quantiles of the standard normal distribution at even steps of probability.

A deviate is one of 2¹⁴ numbers, the quantiles at (i + ½) / 2¹⁴, scaled so that their variance is 1; their mean is 0 to
the last bit. They reach 4.0 standard deviations, beyond which lie 6 of 100 000 normal numbers.
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
import numpy.typing as npt

BITS: Final = 14
"""Of a random word that choose a deviate: 64 KiB of them stay in the second-level cache."""


@lru_cache(maxsize=1)
def normal_deviates() -> npt.NDArray[np.float32]:
    """Return the deviates (16384,) float32, rising.

    Examples
    --------
    >>> table = normal_deviates()
    >>> table.shape, round(float(table.std()), 6), round(float(table[-1]), 2)
    ((16384,), 1.0, 4.01)
    """
    half = 1 << (BITS - 1)
    upper = np.array([NormalDist().inv_cdf(0.5 + (place + 0.5) / (2 * half)) for place in range(half)])
    upper /= np.sqrt(np.mean(upper**2))
    return np.concatenate([-upper[::-1], upper]).astype(np.float32)
