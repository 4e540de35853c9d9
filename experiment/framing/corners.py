"""Corners of a chart's field as a person reads them off a raw picture, for where the field is not found automatically.

They are given in pixels of the raw file as it is stored, not turned by a viewer: x right, y down, the first pixel of
the visible picture at 0,0; clockwise from the corner that is printed top-left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

LEAST_SIDE_PX = 192
"""Raw pixels a side must have for its edge to be looked for around it: four times the 24 half-size pixels that the
search reaches to either side (`experiment.framing.outline.CORNER_REACH_PX`)."""

_Points = npt.NDArray[np.float64]
Corners = tuple[tuple[float, float], ...]


def parse_corners(texts: Sequence[str]) -> Corners:
    """Return four corners (x, y), half-size px, of four texts X,Y in raw pixels."""
    if len(texts) != 4:
        raise InputError(
            f"{len(texts)} corners are given, {' '.join(texts)}; four are expected, X,Y each, in pixels of the raw file"
        )
    places: list[tuple[float, float]] = []
    for text in texts:
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"{text!r} is no corner; two numbers X,Y are expected, in pixels of the raw file")
        places.append(((x - 0.5) / 2, (y - 0.5) / 2))
    require_corners(np.array(places))
    return tuple(places)


def corners_text(corners_px: npt.ArrayLike) -> str:
    """Return corners (N, 2) float half-size px as a person gives them: "X,Y X,Y", whole raw pixels."""
    return " ".join(f"{2 * x + 0.5:.0f},{2 * y + 0.5:.0f}" for x, y in np.asarray(corners_px).reshape(-1, 2))


def require_corners(corners_px: _Points, shape: tuple[int, int] | None = None) -> None:
    """Require that corners can be those of a field of cells.

    `corners_px`: (4, 2) float64 half-size px, clockwise from the printed top-left. `shape`: height and width of the
    picture, half-size px, if it is known.
    """
    text = corners_text(corners_px)
    clockwise = "give four places X,Y, clockwise from the printed top-left corner of the field of cells"
    flat = corners_px.astype(np.float32)[:, None]
    if corners_px.shape != (4, 2) or not cv2.isContourConvex(flat) or cv2.contourArea(flat) < 1:
        raise InputError(f"the corners given, {text}, span no convex quadrilateral; {clockwise}")
    if cv2.contourArea(flat, oriented=True) < 0:
        raise InputError(
            f"the corners given, {text}, run counter-clockwise; {clockwise}, and take the frame without a mirror"
        )
    if shape is not None and ((corners_px < -0.5).any() or (corners_px > (shape[1] - 0.5, shape[0] - 0.5)).any()):
        raise InputError(
            f"the corners given, {text}, do not lie in the picture of {2 * shape[1]}×{2 * shape[0]} pixels; "
            "give pixels of the raw file as it is stored, not turned"
        )
    shortest = 2 * float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).min())
    if shortest < LEAST_SIDE_PX:
        raise InputError(
            f"the corners given, {text}, are too close together: {shortest:.0f} pixels, at least {LEAST_SIDE_PX} "
            "expected; give the corners of the whole field of cells"
        )
