"""Images as they look when an estimate or the truth is applied: made small, white balanced, with the curve of sRGB.

No colour matrix is applied, so the colours are the camera's own: less saturated than a photograph, but a cast shows as
it would there. The exposure is the same for all pictures of an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.scene import MixedScene, Scene
from foundation.colorimetry import srgb_codes

_HEIGHT = 170
"""Pixels of a picture's height: three beside each other fill half a page."""

_WIDEST = 300
"""Pixels of a picture's width at most: a panorama would make the others tiny."""

_WHITE_PERCENTILE = 98.0
"""Percentile of the brightest channel, under the true light, that becomes white: what is above are highlights."""

_GAP = 6
"""Pixels between pictures, white on every screen."""

_MASKED = 0.18
"""Linear grey that stands for masked pixels: the middle of a display's range."""

_HALF = 0.5
"""Share of a small pixel that is masked above which it is drawn as masked."""

_QUALITY = 88
"""Of the JPEG files: traces of compression are not seen, and a page of a hundred pictures stays below 2 MB."""

_LEAST_GAIN = 1e-6
"""Share of the green channel that replaces a light's channel at zero, which cannot be divided by."""


def developed(scene: Scene, estimates: Sequence[npt.NDArray[np.float64]]) -> list[bytes]:
    """Return a JPEG file for each estimate: the scene as recorded, corrected by the estimate, and by the truth.

    `estimates`: (3,) float64 each, camera RGB of any length.
    """
    image, mask = scene.read()
    linear = image.astype(np.float32)
    if mask is not None:
        # What is masked must not shine into its neighbours when the image is resized, nor set the exposure.
        linear[mask] = 0
    small = _resized(linear)
    truth: npt.NDArray[Any] = scene.truth
    if isinstance(scene, MixedScene):
        field = scene.read_truth_map()
        truth = _resized(np.where(np.isfinite(field), field, np.float32(scene.truth / scene.truth.sum())))
    covered = None if mask is None else _resized(mask.astype(np.float32)) > _HALF
    free = small * _gains(truth)
    free = free.reshape(-1, 3) if covered is None else free[~covered]
    white = float(np.percentile(free.max(axis=1), _WHITE_PERCENTILE)) if len(free) else 0.0

    def seen(light: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        lit = small * _gains(light) / np.float32(white or 1.0)
        if covered is not None:
            lit[covered] = _MASKED
        return srgb_codes(lit)

    raw, right = seen(np.ones(3)), seen(truth)
    gap = np.full((len(small), _GAP, 3), 255, np.uint8)
    return [_jpeg(np.hstack([raw, gap, seen(light), gap, right])) for light in estimates]


def _jpeg(picture: npt.NDArray[np.uint8]) -> bytes:
    import cv2

    codes = np.ascontiguousarray(picture[..., ::-1])
    _, encoded = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return encoded.tobytes()


def _gains(light: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return what corrects for a light (..., 3) and leaves green as it is."""
    given = np.asarray(light, dtype=np.float64)
    floored = np.maximum(given, _LEAST_GAIN * given.max(axis=-1, keepdims=True))
    return (floored[..., 1:2] / floored).astype(np.float32)


def _resized(array: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    import cv2

    height, width = array.shape[:2]
    scale = min(_HEIGHT / height, _WIDEST / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(array, size, interpolation=way), dtype=np.float32)
