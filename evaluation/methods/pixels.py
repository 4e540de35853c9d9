"""Which pixels of an image a method may use."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

GREY = np.full(3, 3**-0.5)
"""The estimate where no pixel may be used, or none differs from black: no cast.

Methods return this very array then, by which it is told from grey that was found.
"""
GREY.setflags(write=False)


def usable(
    image: npt.NDArray[np.integer[Any]] | npt.NDArray[np.floating[Any]],
    saturation: float | None,
    mask: npt.NDArray[np.bool_] | None,
    border: int,
) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True where a pixel may be used.

    Left out are pixels of which a channel is saturated, with their eight neighbours; masked pixels; and `border` px
    along every edge (J. van de Weijer's reference program of the Gray-Edge framework, 2007).
    """
    import cv2

    height, width = image.shape[:2]
    if saturation is None:
        free = np.ones((height, width), dtype=bool)
    else:
        clipped = (
            (image[..., 0] >= saturation) | (image[..., 1] >= saturation) | (image[..., 2] >= saturation)
        ).astype(np.uint8)
        free = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) == 0
    if mask is not None:
        free = free & ~mask
    if border:
        inside = np.zeros((height, width), dtype=bool)
        inside[border:-border, border:-border] = True
        free = free & inside
    return np.asarray(free, dtype=bool)


def unit(estimate: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `estimate` (3,) scaled to length 1, or `GREY` where it is zero or not finite."""
    vector = np.asarray(estimate, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    return vector / length if np.isfinite(length) and length > 0 else GREY
