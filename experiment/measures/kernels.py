"""The inner loops of least squares, compiled.

Compiled for the processor at hand at the first call and kept on disk for the next. No state, no lock, and the
interpreter's is released, so that each frame has a thread to itself. Without licence to reorder sums: a table's bytes
depend on neither processor nor thread. They are called through `experiment.measures.least_squares`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from foundation.robust import MAD_TO_SIGMA

_POINTS_AT_A_TIME = 2048
"""Points that the terms are added up for at a time: three channels of them, and a line of the basis, stay in the
processor's second cache."""

_RIDGE = 1e-10
"""Share of the normal matrix's mean diagonal that is added to it: keeps equal columns solvable."""

_CUT = 6.0
"""Robust standard deviations from which on a residual has no weight (J. W. Tukey's biweight)."""

_Array = npt.NDArray[np.float64]


@compiled
def linear_combinations(basis: _Array, factors: _Array, out: _Array) -> None:
    """Fill out (3, N) with the sums over k of factors[c, k] · basis[k, n]; basis (K, N), factors (3, K); float64."""
    out[:] = 0
    for start in range(0, basis.shape[1], _POINTS_AT_A_TIME):
        end = min(start + _POINTS_AT_A_TIME, basis.shape[1])
        for term in range(basis.shape[0]):
            line = basis[term, start:end]
            for channel in range(3):
                factor = factors[channel, term]
                if factor != 0:
                    sums = out[channel, start:end]
                    for point in range(end - start):
                        sums[point] += factor * line[point]


@compiled
def weighted_fit(design: _Array, values: _Array, weights: _Array) -> _Array:
    """Return the x (K,) that minimises Σ w (values − design x)²; design (N, K), values and weights (N,), float64."""
    gram, solution = _normal_equations(design, values, weights)
    _solve_positive_definite(gram, solution)
    return solution


@compiled
def robust_fit(design: _Array, values: _Array, rounds: int) -> tuple[_Array, _Array, _Array]:
    """Return solution (K,), weights (N,) and residuals (N,) of a fit that outliers do not move.

    Least squares by the normal equations, reweighted by Tukey's biweight.

    `design`: (N, K) float64, C order. `values`: (N,) float64.
    """
    count, unknowns = design.shape
    weights, residual = np.ones(count), values.copy()
    solution = np.zeros(unknowns)
    for _ in range(rounds):
        solution = weighted_fit(design, values, weights)
        for point in range(count):
            predicted = 0.0
            for i in range(unknowns):
                predicted += design[point, i] * solution[i]
            residual[point] = values[point] - predicted
        scale = MAD_TO_SIGMA * np.median(np.abs(residual)) + 1e-9
        for point in range(count):
            inside = max(1 - (residual[point] / (_CUT * scale)) ** 2, 0.0)
            weights[point] = inside * inside
    return solution, weights, residual


@compiled
def held_out_squares(design: _Array, values: _Array, weights: _Array, counts: npt.NDArray[np.int64]) -> _Array:
    """Return, for fits by the first counts[m] columns, the weighted mean (M,) of squared errors at points left out.

    Each point as predicted by the fit to all others: its residual over 1 − its leverage (R. D. Cook, S. Weisberg,
    *Residuals and Influence in Regression*, section 2.2), so that no fit is made twice. Of nested fits the leverages
    are sums of one row of the design in the coordinates in which the largest fit's normal matrix is 1.

    `design`, `values`, `weights`: (N, K), (N,) and (N,) float64, C order. `counts`: (M,) int64, rising, K at most.
    """
    points, unknowns = design.shape
    gram, right = _normal_equations(design, values, weights)
    _factorise(gram)
    _solve_lower(gram, right)
    squares, row = np.zeros(len(counts)), np.zeros(unknowns)
    total = 0.0
    for point in range(points):
        total += weights[point]
        if weights[point] == 0:
            continue
        leverage, predicted, column = 0.0, 0.0, 0
        for fit in range(len(counts)):
            while column < counts[fit]:
                value = design[point, column]
                for k in range(column):
                    value -= gram[column, k] * row[k]
                value /= gram[column, column]
                row[column] = value
                leverage += weights[point] * value * value
                predicted += value * right[column]
                column += 1
            error = (values[point] - predicted) / max(1 - leverage, 1e-3)
            squares[fit] += weights[point] * error * error
    return squares / max(total, 1e-300)


@compiled
def _normal_equations(design: _Array, values: _Array, weights: _Array) -> tuple[_Array, _Array]:
    """Return the lower half of the normal matrix (K, K), its ridge added, and the right side (K,)."""
    count, unknowns = design.shape
    gram, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for point in range(count):
        line = design[point]
        for i in range(unknowns):
            weighted = weights[point] * line[i]
            right[i] += weighted * values[point]
            for j in range(i + 1):
                gram[i, j] += weighted * line[j]
    trace = 0.0
    for i in range(unknowns):
        trace += gram[i, i]
    for i in range(unknowns):
        gram[i, i] += _RIDGE * max(trace / unknowns, 1e-30)
    return gram, right


@compiled
def _factorise(gram: _Array) -> None:
    """Replace the lower half of a positive definite matrix by its Cholesky factor."""
    unknowns = len(gram)
    for j in range(unknowns):
        for k in range(j):
            for i in range(j, unknowns):
                gram[i, j] -= gram[i, k] * gram[j, k]
        pivot = np.sqrt(max(gram[j, j], 1e-300))
        for i in range(j, unknowns):
            gram[i, j] /= pivot


@compiled
def _solve_lower(factor: _Array, solution: _Array) -> None:
    """Replace a right side by the solution, given a lower triangle."""
    for i in range(len(solution)):
        for k in range(i):
            solution[i] -= factor[i, k] * solution[k]
        solution[i] /= factor[i, i]


@compiled
def _solve_positive_definite(gram: _Array, solution: _Array) -> None:
    """Replace a right side by the solution, given the lower half of a positive definite matrix (Cholesky)."""
    unknowns = len(solution)
    _factorise(gram)
    _solve_lower(gram, solution)
    for i in range(unknowns - 1, -1, -1):
        for k in range(i + 1, unknowns):
            solution[i] -= gram[k, i] * solution[k]
        solution[i] /= gram[i, i]
