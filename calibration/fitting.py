"""Weighted linear least squares, small and without threads.

Frames are decoded by threads of ours; a linear-algebra library that starts its own beside them is slower than one that
starts none, for problems of a few dozen unknowns.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


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
    weighted = design * weights[:, None]
    gram = np.einsum("ni,nj->ij", weighted, design)
    gram[np.diag_indices_from(gram)] += 1e-10 * max(float(np.trace(gram)) / len(gram), 1e-30)
    return np.asarray(np.linalg.solve(gram, np.einsum("ni,n->i", weighted, values)), dtype=np.float64)
