"""The Gray-Edge framework: the estimate is the Minkowski mean of an image or of its derivatives.

J. van de Weijer, T. Gevers, A. Gijsenij, "Edge-based color constancy", IEEE Transactions on Image Processing 16(9),
2007, equation 13: ``e ∝ (∫ |∂ⁿ f_σ / ∂xⁿ|ᵖ dx)^(1/p)`` for each channel. For n = 0 and σ = 0 it is Gray-world (p = 1),
White-Patch (p = ∞) or Shades-of-Gray (any other p). For n = 0 and σ > 0 it is General Gray-world. Filters and excluded
pixels follow the authors' program, see `gaussian.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import PreparedImage, PreparedMethod, unit


@dataclass(frozen=True)
class GrayEdge(PreparedMethod):
    """One method of the Gray-Edge framework.

    Parameters
    ----------
    name
        Name in tables.
    order
        n, order of the derivative: 0, 1 or 2.
    p
        Minkowski norm, ≥ 1; infinity for the maximum.
    sigma
        Scale of the Gaussian, px; 0 for no filter, which is only possible with order 0.
    border
        Pixels excluded along every edge of the image. None selects ⌊σ⌋ + 1, or 0 if σ is 0.

    Raises
    ------
    ValueError
        The combination of order, norm and scale is not possible.

    Examples
    --------
    Gray-world on an image that is grey on average under a greenish light:

    >>> image = np.array([[[100, 200, 100], [300, 600, 300]], [[50, 100, 50], [30, 60, 30]]], np.uint16)
    >>> GrayEdge("Gray-world", order=0, p=1, sigma=0).estimate(image).round(3)
    array([0.408, 0.816, 0.408])
    """

    name: str
    order: int
    p: float
    sigma: float
    border: int | None = None

    def __post_init__(self) -> None:
        if self.order not in (0, 1, 2) or self.p < 1 or self.sigma < 0 or (self.order and not self.sigma):
            raise ValueError(
                f"order {self.order}, p {self.p}, sigma {self.sigma}; expected order 0 to 2, p of 1 or more, and sigma "
                "of 0 or more, above 0 for a derivative; correct them"
            )

    @property
    def border_width(self) -> int:
        """Pixels excluded along every edge of the image."""
        if self.border is not None:
            return self.border
        # The authors' program excludes 1 px even if σ is 0. Without a filter, no pixel depends on values outside.
        return math.floor(self.sigma) + 1 if self.sigma else 0

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        return unit(prepared.norm(self.order, self.sigma, self.p, self.border_width))
