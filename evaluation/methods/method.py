"""Contracts of methods that estimate the illuminant of an image.

A `Method` has a name and `estimate(image, saturation, mask)`. A `LocalMethod` also estimates the illuminant of every
pixel. A `Learner` is fitted to scenes and returns a method.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image, Scene

__all__ = ["Image", "Learner", "LocalMethod", "Method"]


class Method(Protocol):
    """A method with fixed parameters that estimates the illuminant of an image."""

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimated illuminant of an image.

        Parameters
        ----------
        image
            (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black level subtracted, any unit.
        saturation
            Pixels with a channel of at least this value are clipped and not used; in the unit of the image. None if no
            pixel is clipped.
        mask
            (H, W) bool, True for pixels that must not be used; None if all may be used.

        Returns
        -------
        numpy.ndarray
            (3,) float64, linear camera RGB of length 1. If no pixel is usable, the object `prepared.GREY` itself.
        """
        ...


@runtime_checkable
class LocalMethod(Method, Protocol):
    """A method that also estimates the illuminant of every pixel, for scenes under several illuminants."""

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the estimated illuminant of each pixel.

        Parameters
        ----------
        image
            (H, W, 3), see `Method.estimate`.
        saturation
            See `Method.estimate`.
        mask
            (H, W) bool, see `Method.estimate`.

        Returns
        -------
        numpy.ndarray
            (H, W, 3) float32, linear camera RGB, r + g + b = 1.
        """
        ...


@runtime_checkable
class Learner(Protocol):
    """A method that must be fitted to scenes with ground truth before use."""

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        ...

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Method:
        """Return the method fitted to scenes.

        Parameters
        ----------
        scenes
            Training images with their ground truths, at least one.
        seed
            Seed of all random numbers: equal seeds and scenes must result in equal methods.

        Returns
        -------
        Method
            The fitted method. A learner that stores its model in itself may return itself.
        """
        ...
