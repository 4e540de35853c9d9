"""How the chart lies elsewhere in one frame than in another: shift, turn, scale, and what they leave."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calibration.comparison.values import GeometryDifference

_Array = npt.NDArray[np.float64]


def geometry_difference(one: _Array, other: _Array) -> GeometryDifference:
    """Return the similarity that takes places to others best, in least squares.

    The closed solution with complex numbers, of which scale and turn are one; places are x + iy, y down.

    `one`, `other`: (N, 2) float64 half-size px, N at least 2: the same points of the print in two frames.
    """
    first, second = (places[:, 0] + 1j * places[:, 1] for places in (one, other))
    middle, after = first.mean(), second.mean()
    about = first - middle
    factor = (np.conj(about) @ (second - after)) / (np.conj(about) @ about)
    left = second - after - factor * about
    shift = after - middle
    return GeometryDifference(
        shift_px=(float(shift.real), float(shift.imag)),
        turned_deg=float(np.degrees(np.angle(factor))),
        scale=float(np.abs(factor)) - 1,
        bent_px=float(np.sqrt((np.abs(left) ** 2).mean())),
    )
