"""Weighted linear least squares, small and without threads.

Frames are decoded by threads of ours; a linear-algebra library that starts its own beside them is slower than one that
starts none, for problems of a few dozen unknowns.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def product(matrix: npt.NDArray[np.float64], vector: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return matrix (N, K) times vector (K,), or (K, M) columns, in this thread alone."""
    return np.asarray(np.einsum("nk,k...->n...", matrix, vector), dtype=np.float64)


def least_squares(
    design: npt.NDArray[np.float64], values: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the x (K,) that minimises Σ w (values − design x)².

    By the normal equations, whose condition is the square of the design's: fit for orthogonal-like bases of order
    unity. A ridge of 1e-10 keeps equal columns solvable.

    Parameters
    ----------
    design
        (N, K) float64.
    values, weights
        (N,) float64, weights ≥ 0.
    """
    from calibration.sampling import loops

    # One kind of array, whatever comes, so that there is one kind of machine code.
    return loops.weighted_fit(*(np.require(array, np.float64, ["C", "W"]) for array in (design, values, weights)))
