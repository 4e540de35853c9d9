"""Methods that estimate the light of an image from its statistics.

Every method is a value with a name and `estimate(image, saturation, mask)`; `standard_methods` lists them by the name
that the command line knows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.pca import BrightDark

Image = npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64]


class Method(Protocol):
    """An illumination estimation method with its parameters fixed."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimated light (3,) float64 of unit length; `pixels.GREY` itself where no pixel may be used.

        Parameters
        ----------
        image
            (H, W, 3), linear camera RGB ≥ 0, black subtracted, any unit.
        saturation
            Value in that unit from which a pixel is clipped and not used; None if none is.
        mask
            (H, W) bool, True where a pixel must not be used.
        """
        ...


def standard_methods() -> Mapping[str, Method]:
    """Return the methods by short name, with the constants that are usual; the paper's three first."""
    return {
        "white-patch": GrayEdge("White-Patch", 0, np.inf, 0),
        "gray-world": GrayEdge("Gray-world", 0, 1, 0),
        "shades-of-gray": GrayEdge("Shades-of-Gray (p=2)", 0, 2, 0),
        "general-gray-world": GrayEdge("General Gray-world", 0, 9, 9),
        "gray-edge-1": GrayEdge("1st-order Gray-Edge", 1, 1, 6),
        "gray-edge-2": GrayEdge("2nd-order Gray-Edge", 2, 1, 1),
        "pca": BrightDark(),
    }


__all__ = ["BrightDark", "GrayEdge", "Image", "Method", "standard_methods"]
