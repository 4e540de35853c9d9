"""Weighted linear least squares and products of small matrices, without threads.

Frames are decoded by threads of ours; a linear-algebra library that starts its own beside them is slower than one that
starts none, for problems of a few dozen unknowns.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_LINE_ROUNDS = 8
"""Reweighted solutions in a row of a line."""

_LEAST_RESIDUAL = 0.1
"""Of the median residual: what a point's residual counts for at least, so that none on the line has all the weight."""

_Array = npt.NDArray[np.float64]


def product(matrix: _Array, vector: _Array) -> _Array:
    """Return a matrix times a vector, or times the columns of another matrix, computed in this thread alone.

    `matrix`: (N, K) float64. `vector`: (K,) or (K, M) float64. Returns (N,) or (N, M) float64.
    """
    return np.asarray(np.einsum("nk,k...->n...", matrix, vector), dtype=np.float64)


def linear_combinations(basis: _Array, factors: _Array) -> _Array:
    """Return the sums Σₖ factors[c, k] · basis[k, n], computed in this thread alone.

    `basis`: (K, N) float64, term by term, so that the compiled loop runs along the points. `factors`: (3, K) float64;
    terms whose factor is 0 cost nothing. Returns (3, N) float64.
    """
    from experiment.measures import kernels

    sums = np.empty((len(factors), basis.shape[1]))
    kernels.linear_combinations(basis, factors, sums)
    return sums


def least_squares(design: _Array, values: _Array, weights: _Array) -> _Array:
    """Return the solution x (K,) float64 that minimises Σ w (values − design x)².

    By the normal equations, whose condition is the square of the design's: fit for orthogonal-like bases of order
    unity. A ridge of 1e-10 of the normal matrix's mean diagonal keeps equal columns solvable.

    `design`: (N, K) float64. `values`: (N,) float64. `weights`: (N,) float64, ≥ 0.
    """
    from experiment.measures import kernels

    return kernels.weighted_fit(*(_plain(array) for array in (design, values, weights)))


def robust_least_squares(design: _Array, values: _Array, rounds: int) -> tuple[_Array, _Array, _Array]:
    """Return the solution, weights and residuals of least squares that outliers do not move.

    Iteratively reweighted by Tukey's biweight, cut at six robust standard deviations of the residuals (P. J. Huber,
    E. M. Ronchetti, *Robust Statistics*, 2nd edition, chapter 7); otherwise as `least_squares`.

    `design`: (N, K) float64. `values`: (N,) float64. Returns (K,) float64. Returns (N,) float64, 0 … 1. Returns (N,)
    float64, values − design x.
    """
    from experiment.measures import kernels

    return kernels.robust_fit(_plain(design), _plain(values), rounds)


def least_absolute_line(x: _Array, y: _Array) -> tuple[float, float]:
    """Return intercept and slope of the line that minimises Σ ``|y − line|``, so that a few points do not decide.

    Reweighted least squares (E. J. Schlossmacher, J. Am. Stat. Assoc. 68 (1973) 857).

    `x`, `y`: (N,) float64.
    """
    design, weights = np.column_stack([np.ones(len(x)), x]), np.ones(len(x))
    solution = np.array([0.0, 1.0])
    for _ in range(_LINE_ROUNDS):
        solution = least_squares(design, y, weights)
        residual = np.abs(y - design @ solution)
        weights = 1 / np.maximum(residual, _LEAST_RESIDUAL * float(np.median(residual)) + 1e-9)
    return float(solution[0]), float(solution[1])


def held_out_squares(design: _Array, values: _Array, weights: _Array, counts: tuple[int, ...]) -> _Array:
    """Return the mean squared error at points left out, for fits by more and more columns of one design.

    `design`: (N, K) float64. `values`: (N,) float64. `weights`: (N,) float64, ≥ 0; points of weight 0 count neither for
    the fits nor for their errors. Returns (M,) float64, the weighted mean for each count; every point as the fit to all
    others predicts it.
    """
    from experiment.measures import kernels

    fits = np.array(counts, dtype=np.int64)
    return kernels.held_out_squares(_plain(design), _plain(values), _plain(weights), fits)


def _plain(array: _Array) -> _Array:
    """Return an array as float64, C order, writable: numba compiles a function anew for each other kind."""
    return np.require(array, np.float64, ["C", "W"])
