"""How the chart stands in a picture: turned about the axis of view, and tilted against the sensor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def off_level_deg(rotation_deg: float) -> tuple[float, int]:
    """Return the angle between the chart's rows and the picture's, and the quarter turns besides.

    The angle is in degrees, −45 … 45, clockwise; quarter turns are −1 … 2.

    >>> off_level_deg(92.0), off_level_deg(358.5), off_level_deg(180.0)
    ((2.0, 1), (-1.5, 0), (0.0, 2))
    """
    turned = -((180 - rotation_deg) % 360 - 180)
    quarters = round(turned / 90)
    return turned - 90 * quarters, 2 if quarters == -2 else quarters


def keystone(corners_px: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return by how much left and right, then top and bottom, differ in length: the longer over the shorter, less 1.

    `corners_px`: (4, 2) float64 px, the page's corners clockwise from the printed top-left.
    """
    top, right, bottom, left = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).tolist()
    return max(left / right, right / left) - 1, max(top / bottom, bottom / top) - 1
