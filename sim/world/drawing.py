"""The print in front of the camera: rectangles of plain colour on paper, and the map of them that is rendered.

Millimetres on the print, origin at its top-left corner, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

PAPER: Final = (255, 255, 255)
"""The code that prints nothing."""

_FINEST_MM: Final = 1e-3
"""Coordinates nearer than a micrometre are one: rounding parts them, and no lens does."""

_MOST_LINES: Final = 6000
"""Distinct coordinates along an axis of the map, so that its labels stay below 150 MB."""


@dataclass(frozen=True, eq=False)
class Print:
    """A drawing on paper: rectangles of plain colour, each over those before it.

    - `page_mm`: width and height of the sheet; bare paper where no rectangle lies.
    - `rectangles_mm`: (N, 4) float64: left, top, right, bottom.
    - `rgb`: (N, 3) uint8, the code printed; (255, 255, 255) prints nothing.
    """

    page_mm: tuple[float, float]
    rectangles_mm: NDArray[np.float64]
    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.rectangles_mm)
        if self.rectangles_mm.shape != (count, 4) or self.rgb.shape != (count, 3):
            raise ValueError(
                f"rectangles {self.rectangles_mm.shape} and codes {self.rgb.shape}; (N, 4), (N, 3) expected"
            )
        if np.any(self.rectangles_mm[:, 2:] < self.rectangles_mm[:, :2]):
            raise ValueError("a rectangle's right or bottom lies before its left or top")


@dataclass(frozen=True, eq=False)
class LabelMap:
    """A print as a map of labels between lines.

    - `x_lines`, `y_lines`: (M,) float64, ascending, mm: every x and every y at which the print changes.
    - `labels`: (len(y_lines) + 1, len(x_lines) + 1) int32: row of `codes` between the lines; `len(codes)` beyond the
      page.
    - `codes`: (N, 3) int64, distinct codes of the print, ascending; bare paper is one of them.
    """

    x_lines: NDArray[np.float64]
    y_lines: NDArray[np.float64]
    labels: NDArray[np.int32]
    codes: NDArray[np.int64]


def label_map(sheet: Print) -> LabelMap:
    """Return the map of a print; what of a rectangle lies off the page is left out."""
    codes, label = np.unique(np.concatenate([sheet.rgb.astype(np.int64), [PAPER]]), axis=0, return_inverse=True)
    boxes = np.concatenate([sheet.rectangles_mm, [[0, 0, *sheet.page_mm]]])
    boxes = np.clip(boxes, 0, [*sheet.page_mm, *sheet.page_mm])
    (x_lines, left, right), (y_lines, top, bottom) = _lines(boxes[:, 0::2]), _lines(boxes[:, 1::2])
    labels = np.full((len(y_lines) + 1, len(x_lines) + 1), len(codes), dtype=np.int32)
    label = label.reshape(-1).astype(np.int32)
    # The page, which comes last, lies under everything.
    for k in (len(label) - 1, *range(len(label) - 1)):
        labels[top[k] + 1 : bottom[k] + 1, left[k] + 1 : right[k] + 1] = label[k]
    return LabelMap(x_lines, y_lines, labels, codes)


def _lines(ends: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return the sorted distinct coordinates of (N, 2) ends, and the index of each beginning and each end among them.

    Coordinates within a micrometre are one; where a drawing has more than a few thousand, nearer ones are joined, each
    then standing at the mean of those it stands for.
    """
    finest = _FINEST_MM
    while True:
        rounded, index = np.unique(np.round(ends / finest), return_inverse=True)
        if len(rounded) <= _MOST_LINES:
            break
        finest *= 1.5
    index = index.reshape(ends.shape)
    count = np.bincount(index.ravel())
    return np.bincount(index.ravel(), weights=ends.ravel()) / count, index[:, 0], index[:, 1]
