"""The inner loops of a frame, compiled: photosites become samples, references a field, samples the table's values.

Compiled for the processor at hand at the first call and kept on disk for the next. No state, no lock, and the
interpreter's is released, so that each frame has a thread to itself. Without licence to reorder sums: a table's bytes
depend on neither processor nor thread. What the numbers mean stands where the loops are called, in
`calibration.sampling.samples` and `calibration.radiometry.paper`.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from numba import uint64

from foundation.compiled import compiled
from foundation.robust import MAD_TO_SIGMA

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Place = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


@numba.njit(inline="always")
def _rounded(value: Any, field: Any) -> Any:
    """Return a sample as the table holds it."""
    return np.uint16(min(max(np.rint(value / field), np.float32(0)), np.float32(65535)))


@compiled
def sample(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    samples: _Float,
    peak: _Count,
) -> None:
    """Fill samples (N, window², 3) and their highest counts (N,); patches that are not inside are left at 0.

    Parameters
    ----------
    sensor
        (photosites,) uint16.
    corner
        (N,) the top-left photosite of each patch's first pixel.
    order
        (N,) the patches as they are best visited: neighbours on the sensor one after another, for the memory's sake.
    inside
        (N,) whether a patch lies on the sensor.
    step
        Photosites from a block to the one below.
    places
        (4,) photosites from a block's top-left one to its red, its two greens and its blue.
    window
        Pixels along a patch's side.
    black
        (3,) float32.
    """
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest = np.int32(0)
        patch_samples = samples[patch]
        if not inside[patch]:
            patch_samples[:] = 0
            peak[patch] = 0
            continue
        number = uint64(0)
        for row in range(window):
            # Unsigned places spare the test for one before the array's beginning.
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                patch_samples[number, 0] = np.float32(r) - black[0]
                patch_samples[number, 1] = np.float32(g + h) * np.float32(0.5) - black[1]
                patch_samples[number, 2] = np.float32(b) - black[2]
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def tabulate(samples: _Float, dark: _Float, field: _Float, values: _Count) -> None:
    """Fill values (N, S, 3) from samples, less `dark` (N, 3), over `field` (N, 3)."""
    for patch in range(samples.shape[0]):
        for number in range(samples.shape[1]):
            for channel in range(3):
                above = samples[patch, number, channel] - dark[patch, channel]
                values[patch, number, channel] = _rounded(above, field[patch, channel])


@compiled
def sample_to_table(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    dark: _Float,
    field: _Float,
    values: _Count,
    peak: _Count,
) -> None:
    """Do `sample` and `tabulate` in one go, without the samples between them."""
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest = np.int32(0)
        patch_values = values[patch]
        if not inside[patch]:
            patch_values[:] = 0
            peak[patch] = 0
            continue
        number = uint64(0)
        for row in range(window):
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                above = np.float32(r) - black[0] - dark[patch, 0]
                patch_values[number, 0] = _rounded(above, field[patch, 0])
                above = np.float32(g + h) * np.float32(0.5) - black[1] - dark[patch, 1]
                patch_values[number, 1] = _rounded(above, field[patch, 1])
                above = np.float32(b) - black[2] - dark[patch, 2]
                patch_values[number, 2] = _rounded(above, field[patch, 2])
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def patch_means(values: _Count, means: _Array) -> None:
    """Fill means (N, 3) of values (N, S, 3)."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        red, green, blue = np.int64(0), np.int64(0), np.int64(0)
        for number in range(samples):
            red += values[patch, number, 0]
            green += values[patch, number, 1]
            blue += values[patch, number, 2]
        means[patch, 0], means[patch, 1], means[patch, 2] = red / samples, green / samples, blue / samples


@compiled
def combined(basis: _Array, factors: _Array, out: _Array) -> None:
    """Fill out (3, N) with the sums over k of factors[c, k] · basis[k, n]."""
    out[:] = 0
    for start in range(0, basis.shape[1], 2048):
        end = min(start + 2048, basis.shape[1])
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
    """Return the x (K,) that minimises Σ w (values − design x)²; as `calibration.radiometry.fitting.least_squares`."""
    count, unknowns = design.shape
    gram, solution = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for point in range(count):
        line = design[point]
        for i in range(unknowns):
            weighted = weights[point] * line[i]
            solution[i] += weighted * values[point]
            for j in range(i + 1):
                gram[i, j] += weighted * line[j]
    trace = 0.0
    for i in range(unknowns):
        trace += gram[i, i]
    for i in range(unknowns):
        gram[i, i] += 1e-10 * max(trace / unknowns, 1e-30)
    _solve(gram, solution)
    return solution


@compiled
def robust_fit(design: _Array, values: _Array, rounds: int) -> tuple[_Array, _Array, _Array]:
    """Return solution (K,), weights (N,) and residuals (N,) of a fit without what lies far off.

    Least squares by the normal equations, reweighted by Tukey's biweight at six robust standard deviations. The
    design's condition is squared: fit for orthogonal-like bases of order unity. A ridge of 1e-10 keeps equal columns
    solvable.

    Parameters
    ----------
    design
        (N, K) float64, C order.
    values
        (N,) float64.
    rounds
        Solutions in a row.
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
            inside = max(1 - (residual[point] / (6 * scale)) ** 2, 0.0)
            weights[point] = inside * inside
    return solution, weights, residual


@compiled
def _solve(gram: _Array, solution: _Array) -> None:
    """Replace a right side by the solution, given the lower half of a positive definite matrix (Cholesky)."""
    unknowns = len(solution)
    for j in range(unknowns):
        for k in range(j):
            for i in range(j, unknowns):
                gram[i, j] -= gram[i, k] * gram[j, k]
        pivot = np.sqrt(max(gram[j, j], 1e-300))
        for i in range(j, unknowns):
            gram[i, j] /= pivot
    for i in range(unknowns):
        for k in range(i):
            solution[i] -= gram[i, k] * solution[k]
        solution[i] /= gram[i, i]
    for i in range(unknowns - 1, -1, -1):
        for k in range(i + 1, unknowns):
            solution[i] -= gram[k, i] * solution[k]
        solution[i] /= gram[i, i]
