"""Smaller images, of usable pixels only."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image


def shrink(
    image: Image, usable: npt.NDArray[np.bool_], longest: int, least: float = 0.5
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image whose longer side is `longest` px, and where it must not be used.

    A pixel is the mean, weighted by area, of the usable pixels that it stands for.

    `image`: (H, W, 3) uint16, float32 or float64. `usable`: (H, W) bool, True where a pixel may be used. `longest`: px,
    below the longer side. `least`: share of a pixel's area, 0 … 1, that must be exceeded by what is usable of it.
    Returns (h, w, 3) float32, 0 where nothing is usable; (h, w) bool, True where no more of a pixel is usable than
    `least`.
    """
    import cv2

    height, width = usable.shape
    factor = longest / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    share = np.asarray(cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    planes: list[npt.NDArray[np.float32]] = []
    for channel in range(3):
        kept = np.where(usable, image[..., channel], 0).astype(np.float32)
        planes.append(np.asarray(cv2.resize(kept, size, interpolation=cv2.INTER_AREA), dtype=np.float32))
    found = np.stack(planes, axis=-1) / np.maximum(share, np.finfo(np.float32).tiny)[..., None]
    masked = share <= least
    found[share <= 0] = 0
    return found.astype(np.float32), masked
