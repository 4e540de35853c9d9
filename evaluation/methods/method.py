"""What every method of illumination estimation is to the code that runs it.

A method is a value with a name and `estimate(image, saturation, mask)`. Two kinds can do more: a `LocalMethod` gives
the light of every pixel, and a `Learner` is fitted to scenes first and gives the method that it has learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image, Scene

__all__ = ["Image", "Learner", "LocalMethod", "Method"]


class Method(Protocol):
    """An illumination estimation method with its parameters fixed."""

    @property
    def name(self) -> str:
        """The method's name in tables."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimated light (3,) float64, camera RGB of length 1; `GREY` of `prepared` if no pixel is usable.

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


@runtime_checkable
class LocalMethod(Method, Protocol):
    """A method that estimates the light of every pixel, for scenes under several lights."""

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the estimated light of each pixel: (H, W, 3) float32, r + g + b = 1; see `Method.estimate`."""
        ...


@runtime_checkable
class Learner(Protocol):
    """A method that has yet to be fitted to scenes with known lights."""

    @property
    def name(self) -> str:
        """The method's name in tables."""
        ...

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Method:
        """Return the method fitted to scenes; a class that keeps what it has learned in itself may return itself.

        Parameters
        ----------
        scenes
            The training images with their ground truths, at least one.
        seed
            Of all that is random in the fit: the same seed and scenes give the same method.
        """
        ...
