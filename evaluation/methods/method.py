"""What every method of illumination estimation is to the code that runs it: a name, and an estimate of an image."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64]
"""(H, W, 3), linear camera RGB ≥ 0 with black subtracted, in any unit."""


class Method(Protocol):
    """An illumination estimation method with its parameters fixed."""

    @property
    def name(self) -> str:
        """The method's name in tables."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimated light (3,) float64, camera RGB of length 1; `pixels.GREY` itself if no pixel is usable.

        Parameters
        ----------
        image
            (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black subtracted, any unit.
        saturation
            Value in that unit from which a pixel is clipped and not used; None if none is.
        mask
            (H, W) bool, True where a pixel must not be used.
        """
        ...
