"""White balance of OpenCV's xphoto as a method: what a program that uses OpenCV gets.

`GrayworldWB` is Gray-world over the pixels that are not too colourful. It corrects an image; the light is what it
divides by: for each channel the sum before over the sum after. Masked and saturated pixels are given to it as black.

Two others are left out. `SimpleWB` stretches each channel between percentiles, offset included, and so is no estimate
of a light. `LearningBasedWB` (D. Cheng et al., CVPR 2015) of OpenCV 5.0 gives one of several lights for the same image
from one call to the next, degrees apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

_TOP = 16383
"""Value that white gets: a quarter of uint16, so that a channel multiplied by up to 4 is not cut off."""

_ROWS = 256
"""Rows that are scaled at a time, so that no float64 copy of a large image is made."""


@dataclass(frozen=True)
class OpenCvGrayWorld:
    """Gray-world of xphoto.

    `name`: its name in tables.

    Examples
    --------
    >>> image = np.random.default_rng(0).uniform(0.1, 1, (40, 60, 1)) * [0.5, 1.0, 0.7]
    >>> OpenCvGrayWorld().estimate(image).round(2)
    array([0.38, 0.76, 0.53])
    """

    name: str = "Gray-world (OpenCV)"

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        import cv2

        xphoto: Any = cv2.xphoto
        usable = prepared.usable(0)
        peak = float(prepared.moments()[2].max())
        if not peak:
            return GREY
        given = np.zeros(prepared.image.shape, dtype=np.uint16)
        for top in range(0, prepared.height, _ROWS):
            rows = np.s_[top : top + _ROWS]
            part = np.where(usable[rows][..., None], prepared.image[rows], 0)[..., ::-1]
            given[rows] = np.rint(part / peak * _TOP)
        after = np.asarray(xphoto.createGrayworldWB().balanceWhite(given)).reshape(-1, 3).sum(axis=0, dtype=np.float64)
        before = given.reshape(-1, 3).sum(axis=0, dtype=np.float64)
        return unit(np.divide(before, after, out=np.zeros(3), where=after > 0)[::-1])
