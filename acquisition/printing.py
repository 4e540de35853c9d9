"""The chart as a print: a list of rectangles, and from it TIFF, PDF and preview."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.chart import PAPER_WHITE, Chart, Tag
from drivers.errors import InputError

TAG_MODULES = 8
"""Modules along the black square of a tag 36h11: 6 of data inside a black border of one."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """What is printed, on bare paper, in painter's order: a later rectangle covers an earlier one.

    Attributes
    ----------
    page_mm
        Width and height of the sheet.
    rectangles_mm
        (N, 4) float64, left, top, right, bottom; origin at the sheet's top-left corner, x right, y down.
    rgb
        (N, 3) uint8, printed code of each rectangle; (255, 255, 255) is bare paper.
    """

    page_mm: tuple[float, float]
    rectangles_mm: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]


def drawing(chart: Chart) -> Drawing:
    """Return the rectangles of a chart: tags first (white rim, black square, white modules), cells, references.

    Raises
    ------
    InputError
        A tag is of a family that is not known here, or does not stand upright.
    """
    half = np.array(chart.cell_mm) / 2
    rectangles = [np.empty((0, 4)), *(_tag_rectangles(tag)[0] for tag in chart.tags)]
    rgb = [np.empty((0, 3), dtype=np.uint8), *(_tag_rectangles(tag)[1] for tag in chart.tags)]
    rectangles.append(np.concatenate([chart.centres_mm - half, chart.centres_mm + half], axis=1))
    rgb.append(chart.rgb)
    if chart.references:
        centres = np.array([reference.centre_mm for reference in chart.references])
        halves = np.array([reference.size_mm for reference in chart.references]) / 2
        rectangles.append(np.concatenate([centres - halves, centres + halves], axis=1))
        rgb.append(np.array([reference.rgb for reference in chart.references], dtype=np.uint8))
    return Drawing(chart.page_mm, np.concatenate(rectangles), np.concatenate(rgb))


def tag_modules(tag: Tag) -> npt.NDArray[np.bool_]:
    """Return the modules of a tag's black square, (8, 8) bool, true where white, as the print is seen upright.

    The picture is OpenCV's of `DICT_APRILTAG_36h11`, which is the picture of the AprilTag authors turned by half a
    turn; their detectors give the same ids and the corners in the order [1, 0, 3, 2] of `corners_mm`.

    Raises
    ------
    InputError
        The tag's family or number is not known.
    """
    import cv2

    if tag.family != "36h11":
        raise InputError(f"tag {tag.id} is of family {tag.family}; only 36h11 can be printed")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    if not 0 <= tag.id < len(dictionary.bytesList):
        raise InputError(
            f"tag {tag.id} does not exist; family 36h11 has the numbers 0 to {len(dictionary.bytesList) - 1}"
        )
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, tag.id, TAG_MODULES)) > 127


def _tag_rectangles(tag: Tag) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    left, top = tag.corners_mm[0]
    right, bottom = tag.corners_mm[2]
    upright = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    if not (right > left and bottom > top and np.allclose(tag.corners_mm, upright, atol=1e-3)):
        raise InputError(f"tag {tag.id} does not stand upright on the chart; only upright tags can be printed")
    size = np.array([right - left, bottom - top]) / TAG_MODULES
    rim = np.array([left, top, right, bottom]) + np.concatenate([-size, size])
    rows, columns = np.nonzero(tag_modules(tag))
    corner = np.array([left, top]) + np.stack([columns, rows], axis=1) * size
    rectangles = np.concatenate([[rim], [[left, top, right, bottom]], np.concatenate([corner, corner + size], axis=1)])
    rgb = np.full((len(rectangles), 3), PAPER_WHITE, dtype=np.uint8)
    rgb[1] = 0
    return rectangles, rgb
