"""The pixels that a chart is designed in: 600 to the inch, and boxes of whole ones.

Lengths on the print are millimetres elsewhere; what is printed begins and ends on a pixel of this raster.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

MM_PER_INCH = 25.4
"""Exact, by definition of the international inch."""

DESIGN_DPI = 600
"""Resolution of the design: photo printers and plotters work at it or at a multiple."""

PX_MM = MM_PER_INCH / DESIGN_DPI
"""Millimetres of a pixel of the design."""

_ROUNDING_PX = 1e-3
"""How far a coordinate read from a file may lie beside a whole pixel: six decimals of a millimetre are 2e-5 px."""

Boxes = npt.NDArray[np.int64]
"""(N, 4) int64: left, top, right, bottom, px at 600 dpi."""


def whole_px(boxes_mm: npt.ArrayLike) -> Boxes:
    """Return the smallest boxes (N, 4) int64, whole pixels, that hold boxes (N, 4) mm: left, top, right, bottom."""
    exact = np.asarray(boxes_mm, dtype=np.float64).reshape(-1, 4) / PX_MM
    return np.concatenate([np.floor(exact[:, :2] + _ROUNDING_PX), np.ceil(exact[:, 2:] - _ROUNDING_PX)], axis=1).astype(
        np.int64
    )
