"""A frame as a small picture for people: tone mapped, with the chart's tags, what deviates, and the cause drawn in."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic
from experiment.framing.planes import CHANNELS, phases

WIDTH_PX = 640
"""Longer side of a preview at most, as the journal has it."""

_QUALITY = 80
"""JPEG quality: some 40 kB, 30 MB a session."""

_GREEN, _RED, _AMBER = (60, 200, 60), (40, 40, 255), (40, 200, 255)
"""BGR codes: of tags, of what deviates, of the cause."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LETTER_PX = 7.4
"""Width of a letter of the cause at `_SCALE`, px."""

_SCALE = 0.42
"""Size of the letters, of OpenCV's font: the least that is read with ease."""

_FAINTEST = 0.01
"""Share of white to which a dark frame is brightened at most: else its noise would be the picture."""

_Array = npt.NDArray[np.float64]


def preview_jpeg(
    mosaic: Mosaic,
    black: _Array,
    white: _Array,
    outlines_px: Sequence[_Array],
    boxes: Sequence[tuple[int, int, int, int]],
    cause: str,
) -> bytes:
    """Return a frame as JPEG bytes, at most 640 px wide or high.

    `black`: (2, 2) float64, the frame's black level. `white`: (3,) float64, camera RGB above black that is shown as
    white: paper under full white. `outlines_px`: (K, 2) float64 each, half-size px: outlines of tags, or of the field.
    `boxes`: left, top, right, bottom of parts that deviate, half-size px.
    """
    blocks = mosaic.block_planes()
    height, width = blocks.shape[2:]
    step = -(-max(height, width) // WIDTH_PX)
    of = phases(mosaic)
    small = np.empty((-(-height // step), -(-width // step), 3), dtype=np.float32)
    for number, channel in enumerate(CHANNELS):
        row, column = of[channel][0]
        scale = np.float32(1 / max(float(white[number]), 1.0))
        small[:, :, 2 - number] = (blocks[row, column, ::step, ::step] - np.float32(black[row, column])) * scale
    brightest = max(float(np.percentile(small[::4, ::4].max(axis=2), 99.5)), _FAINTEST)
    image = (np.sqrt(np.clip(small, 0, brightest) / np.float32(brightest)) * 255).astype(np.uint8)
    for corners in outlines_px:
        cv2.polylines(image, [(corners / step).round().astype(np.int32)], True, _GREEN, 1, cv2.LINE_AA)
    for box in boxes:
        x0, y0, x1, y1 = (edge // step for edge in box)
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), _RED, 1)
    if cause:
        image = _written(image, cause)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _written(image: npt.NDArray[np.uint8], cause: str) -> npt.NDArray[np.uint8]:
    """Return the picture with a sentence over its lower edge."""
    # OpenCV's letters are those of ASCII.
    plain = cause.replace("°", " deg").replace("×", "x").replace("–", "-").replace("−", "-").replace("…", "...")
    lines = textwrap.wrap(plain.encode("ascii", "replace").decode(), max(20, int(image.shape[1] / _LETTER_PX)))[:5]
    height, line = len(image), 17
    top = height - line * len(lines) - line // 2
    image[top:] //= 3
    for number, text in enumerate(lines):
        cv2.putText(image, text, (6, top + line * (number + 1)), _FONT, _SCALE, _AMBER, 1, cv2.LINE_AA)
    return image
