"""Orientation of the chart in an image: rotation about the optical axis, and tilt relative to the sensor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def off_level_deg(rotation_deg: float) -> tuple[float, int]:
    """Split a rotation into an angle of −45 … 45 degrees, clockwise, and a number of quarter turns, −1 … 2.

    >>> off_level_deg(92.0), off_level_deg(358.5), off_level_deg(180.0)
    ((2.0, 1), (-1.5, 0), (0.0, 2))
    """
    turned = -((180 - rotation_deg) % 360 - 180)
    quarters = round(turned / 90)
    return turned - 90 * quarters, 2 if quarters == -2 else quarters


def keystone(corners_px: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return longer / shorter − 1 for two pairs of opposite sides: left and right, top and bottom.

    `corners_px`: (4, 2) float64 px, corners of the page clockwise from the printed top-left.
    """
    top, right, bottom, left = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).tolist()
    return max(left / right, right / left) - 1, max(top / bottom, bottom / top) - 1
