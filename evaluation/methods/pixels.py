"""Which pixels of an image a method may use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

GREY = np.full(3, 3**-0.5)
"""The estimate (3,) float64 where no pixel is usable, or every one is black: no colour cast.

Methods then return this very array, which distinguishes it from an estimate that happens to be grey.
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

    `image`: (H, W, 3) of any integer or float dtype, linear camera RGB. `saturation`: value from which a channel is
    saturated; None if none is. `mask`: (H, W) bool, True where a pixel must not be used; None if every one may be.
    `border`: pixels left out along every edge, px.

    Examples
    --------
    >>> image = np.zeros((5, 6, 3))
    >>> image[0, 0] = 900
    >>> usable(image, saturation=800, mask=None, border=0).astype(int)
    array([[0, 0, 1, 1, 1, 1],
           [0, 0, 1, 1, 1, 1],
           [1, 1, 1, 1, 1, 1],
           [1, 1, 1, 1, 1, 1],
           [1, 1, 1, 1, 1, 1]])
    """
    height, width = image.shape[:2]
    free = np.ones((height, width), dtype=bool)
    if saturation is not None:
        free &= ~dilate_clipped(image, saturation)
    if mask is not None:
        free = free & ~mask
    if border:
        inside = np.zeros((height, width), dtype=bool)
        inside[border:-border, border:-border] = True
        free = free & inside
    return np.asarray(free, dtype=bool)


def dilate_clipped(
    image: npt.NDArray[np.integer[Any]] | npt.NDArray[np.floating[Any]], saturation: float
) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True where a channel is saturated or a neighbour's is.

    The image is (H, W, 3) of any dtype.
    """
    import cv2

    from evaluation.methods.filters.loops import mark_clipped

    clipped = np.zeros(image.shape[:2], dtype=np.uint8)
    kind: Any = image.dtype
    if kind.kind in "iu":
        if saturation > np.iinfo(kind).max:
            return clipped.view(np.bool_)
        limit = kind.type(max(0, math.ceil(saturation)))
    else:
        limit = kind.type(saturation)
    native: Any = np.ascontiguousarray(image, dtype=kind.newbyteorder("="))
    if mark_clipped(native, limit, clipped):
        clipped = cv2.dilate(clipped, np.ones((3, 3), np.uint8))
    return np.asarray(clipped).view(np.bool_)


def unit(estimate: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `estimate` (3,) as float64 scaled to length 1, or `GREY` where it is zero or not finite.

    Examples
    --------
    >>> unit([3, 4, 0])
    array([0.6, 0.8, 0. ])
    >>> unit([0, 0, 0]) is GREY
    True
    """
    vector = np.asarray(estimate, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    return vector / length if np.isfinite(length) and length > 0 else GREY
