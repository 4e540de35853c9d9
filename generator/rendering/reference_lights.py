"""Lights of a table under which profiles of its print are made, and which of them stands for another light.

A profile holds under one light. Under another of nearly the same chromaticity the cells look nearly the same beside
white, so a few of a table's lights, no light far from one of them, serve for all: mixtures of cells are made once for
each and kept. What is lost by a reference instead of the light itself: docs/reference/rendering.md.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

REACH: Final = 0.2
"""Largest distance of a light from its reference, in natural logarithms of R/G and B/G. Measured on simulated tables:
docs/reference/rendering.md."""

_Array = npt.NDArray[np.float64]


def reference_lights(whites: _Array, reach: float = REACH) -> tuple[int, ...]:
    """Return lights so spread that none is farther than `reach` from one of them.

    The first is the one nearest to the middle; each next is the farthest from those before (T. F. Gonzalez, "Clustering
    to minimize the maximum intercluster distance", Theoretical Computer Science 38, 1985: at most twice as far as the
    best choice of as many).

    Parameters
    ----------
    whites
        (L, 3) float64 > 0, linear camera RGB of the lights, of any length.
    reach
        Largest distance to a reference, in natural logarithms of R/G and B/G.

    Examples
    --------
    >>> reference_lights(np.array([[1, 1, 1], [1.1, 1, 1], [3, 1, 1], [1, 1, 3.0]]))
    (1, 3, 2)
    """
    places = log_chromaticities(whites)
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    chosen = [int(np.linalg.norm(places - middle, axis=1).argmin())]
    distances = np.linalg.norm(places - places[chosen[0]], axis=1)
    while distances.max() > reach:
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return tuple(chosen)


def nearest_reference(references: tuple[int, ...], whites: _Array, white: npt.ArrayLike) -> int:
    """Return the reference nearest to a light.

    Parameters
    ----------
    references
        Numbers of lights.
    whites
        (L, 3) float64 > 0, linear camera RGB of the lights.
    white
        (3,) float > 0, linear camera RGB of the light that is wanted, of any length.

    Examples
    --------
    >>> whites = np.array([[1, 1, 1], [1.1, 1, 1], [3, 1, 1], [1, 1, 3.0]])
    >>> nearest_reference((1, 3, 2), whites, [10, 10, 25])
    3
    """
    places = log_chromaticities(whites[list(references)])
    return references[int(np.linalg.norm(places - log_chromaticities(np.asarray(white, np.float64)), axis=1).argmin())]


def log_chromaticities(rgb: _Array) -> _Array:
    """Return ln(R/G) and ln(B/G), (..., 2) float64, of linear RGB (..., 3) float64 > 0."""
    logs = np.log(rgb)
    return logs[..., [0, 2]] - logs[..., [1]]
