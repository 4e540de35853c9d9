"""The angle between colours as vectors, which is how colour constancy measures errors of lights."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def angles_deg(one: npt.ArrayLike, other: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angles between colours and others, degrees.

    `one`, `other`: (..., 3) float or int each, broadcast against each other; linear RGB of any length above 0. Returns
    (...) float64, 0 … 180. By W. Kahan's formula of the half angle, which keeps its digits at every angle; the arc
    cosine loses half of them at small ones.
    """
    a, b = _unit(one), _unit(other)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _unit(vector: npt.ArrayLike) -> npt.NDArray[np.float64]:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
