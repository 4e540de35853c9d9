"""The Gray-Edge framework: the light is the Minkowski mean of an image or of its derivatives.

J. van de Weijer, T. Gevers, A. Gijsenij, "Edge-based color constancy", IEEE Transactions on Image Processing 16(9),
2007, equation 13: ``e ∝ (∫ |∂ⁿ f_σ / ∂xⁿ|ᵖ dx)^(1/p)`` for each channel. With n = 0 and σ = 0 it is Gray-world (p = 1),
White-Patch (p = ∞) and Shades-of-Gray; with n = 0 general Gray-world. Filters are those of the authors' program, see
`gaussian.py`. What is left out is so too, pixels along the edges included, where there is a filter. Without one (σ = 0)
nothing of a pixel comes from beyond the edge, so every pixel counts, and the estimate is what NumPy's mean, root mean
square or maximum gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import PreparedImage, PreparedMethod, unit


@dataclass(frozen=True)
class GrayEdge(PreparedMethod):
    """One method of the framework.

    - `name`: its name in tables.
    - `order`: n, order of the derivative: 0, 1 or 2.
    - `p`: Minkowski norm, ≥ 1; infinity takes the maximum.
    - `sigma`: scale of the Gaussian, px; 0 for none, which only order 0 allows.
    - `border`: pixels left out along every edge; by default 0 where σ is 0, else ⌊σ⌋ + 1 as in the authors' program,
      which leaves out 1 px for σ = 0 too.

    Raises `ValueError`: order, norm and scale make no method of the framework.

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
                f"order {self.order}, p {self.p}, sigma {self.sigma} make no method of the framework; expected order 0 "
                "to 2, p from 1, and sigma from 0, above 0 for a derivative"
            )

    @property
    def left_out(self) -> int:
        """Pixels left out along every edge."""
        if self.border is not None:
            return self.border
        return math.floor(self.sigma) + 1 if self.sigma else 0

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        return unit(prepared.norm(self.order, self.sigma, self.p, self.left_out))
