"""The flat field: how evenly projector and lens light the print in a frame.

A smooth shape for each channel, divided out of samples and ground truth alike. Its mean over the centres of the chart's
cells is 1, so that dividing it out leaves the table's mean level as it was. Its parameters are kept, so it can be
undone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import product
from experiment.measures.polynomials import order_of, page_polynomial

LEAST_FIELD = 0.05
"""Where a polynomial that is extrapolated falls below this share of the mean light, the field is taken to be this:
samples are divided by it, and no print is lit so unevenly."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlatField:
    """The shape of the light over the print, mean 1 over the cells' centres.

    - `page_mm`: width and height of the page.
    - `coefficients`: for each channel, the factors whose product the shape is: each (terms,) float64, of some total
      order.
    """

    page_mm: tuple[float, float]
    coefficients: tuple[tuple[_Array, ...], tuple[_Array, ...], tuple[_Array, ...]]

    @classmethod
    def uniform(cls, page_mm: tuple[float, float]) -> FlatField:
        """Return the field that is 1 everywhere on a page of that width and height."""
        return cls(page_mm, ((), (), ()))

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the field (N, 3) float64 at points (N, 2) mm, > 0; 1 is its mean over the cells."""
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        shape = np.ones((len(points), 3))
        for channel, factors in enumerate(self.coefficients):
            for factor in factors:
                shape[:, channel] *= product(page_polynomial(points, self.page_mm, order_of(len(factor))), factor)
        return np.maximum(shape, LEAST_FIELD)

    def orders(self) -> tuple[int, ...]:
        """Return the total order of each channel's last factor, which was fitted on the frame itself."""
        return tuple(order_of(len(factors[-1])) if factors else 0 for factors in self.coefficients)

    def parameters(self) -> list[list[list[float]]]:
        """Return the coefficients for `lut.json`: [channel][factor][term], seven significant digits."""
        return [
            [[float(f"{value:.7g}") for value in factor.tolist()] for factor in factors]
            for factors in self.coefficients
        ]
