"""The same picture with 0 … 7 bits of each code set to zero: the paper's figure of colour reduction (section 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.paper.bits import BITS, clear_bits
from evaluation.results.tables import Table

PANEL: Final = 200
"""Longest side of a panel, px: eight of them fit a page, and the steps of 3 bits can still be seen."""

_GAP: Final = 6
"""White between panels, px."""

_COLUMNS: Final = 4
"""Panels side by side."""


def reduction_strip(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> npt.NDArray[np.uint8]:
    """Return the panels of a picture with bits set to zero, four in a row, white between them.

    `picture`: (H, W, 3) uint8, sRGB codes; made smaller first if a side is above `PANEL`. Returns (h, w, 3) uint8, sRGB
    codes.
    """
    import cv2

    scale = min(1.0, PANEL / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    width, height = size
    rows = -(-len(bits) // _COLUMNS)
    columns = min(_COLUMNS, len(bits))
    shape = (rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3)
    strip = np.full(shape, 255, np.uint8)
    for place, count in enumerate(bits):
        top, left = place // _COLUMNS * (height + _GAP), place % _COLUMNS * (width + _GAP)
        strip[top : top + height, left : left + width] = clear_bits(small, count)
    return strip


def reduction_table(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> Table:
    """Return what is left of a picture (H, W, 3) uint8, sRGB codes: its colours and its distance from the original."""
    rows: list[tuple[str | float | None, ...]] = []
    for count in bits:
        reduced = clear_bits(picture, count)
        colours = len(np.unique(reduced.reshape(-1, 3), axis=0))
        error = float(np.mean((reduced.astype(np.float64) - picture) ** 2))
        ratio = 10 * float(np.log10(255**2 / error)) if error else None
        rows.append((count, 8 ** (8 - count), colours, ratio))
    return Table(
        "A picture with its colours reduced",
        ("Bits set to zero", "Colours possible", "Colours in the picture", "Peak signal to noise, dB"),
        tuple(rows),
        digits=1,
    )
