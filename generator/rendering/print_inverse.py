"""Find the position in the chart at which the camera records a given colour.

The print is treated as continuous: colours are interpolated between patches. A position p is a code per channel from 0
to 2ⁿ - 1, not necessarily whole. R(p) is what the camera records there under a reference illuminant, relative to its
white: trilinear interpolation of the means of the eight patches around p. The position of a colour t minimises ::

    |S (log R(p) - log t)|²,   0 ≤ p ≤ 2ⁿ - 1

S converts channel differences to brightness and chromaticity, with less weight on brightness. The errors of methods are
angles, so a colour outside the gamut of the print should keep its hue rather than its brightness.

R has kinks at patches, and noise folds it in dark colours, so a descent through the chart may stop far from the
minimum. The search is therefore exhaustive. A cell is the cube between eight neighbouring patches. Inside a cell, R is
a weighted mean of the eight patches, so each channel and each ratio of two channels lies between the smallest and the
largest of the patches. This gives a lower bound of the minimum in a cell. Cells are tried in the order of their bounds
by bounded least squares (K. Levenberg 1944, D. Marquardt 1963; bounds by projection, C. T. Kelley, *Iterative Methods
for Optimization*, 1999, section 5.4), until no other cell can be better (branch and bound: A. H. Land, A. G. Doig
1960).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]

# A cell is not tried if it cannot reduce the residual, a relative difference of colours, by more than this amount.
_TOLERANCE: Final = 1e-4

_ROUNDS: Final = 100  # Iterations in a cell; 6 are enough for most, 60 for colours far outside the gamut

_SMALLEST_STEP: Final = 1e-5  # Iterations end if the position changes by less, in patches

# Weight of brightness differences; chromaticity differences have the weight 1 (docs/reference/rendering.md).
BRIGHTNESS_COST: Final = 0.5

# Unit vectors of brightness and two chromaticity directions, for logarithmic channel differences.
_AXES: Final = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]]) / np.sqrt([[3.0], [2.0], [6.0]])

_SCALE: Final = _AXES * np.array([[BRIGHTNESS_COST**0.5], [1.0], [1.0]])


def corners(positions: _Array, bits: int) -> tuple[npt.NDArray[np.int64], _Array]:
    """Return the eight patches around positions (K, 3) and their trilinear weights, (K, 8) int64 and float64."""
    top = (1 << bits) - 1
    lower = np.clip(np.floor(positions).astype(np.int64), 0, max(top - 1, 0))
    fraction = positions - lower
    shifts = np.array([2 * bits, bits, 0])
    cells = np.zeros((len(positions), 8), np.int64)
    weights = np.ones((len(positions), 8))
    for corner in range(8):
        for channel in range(3):
            is_upper = corner >> (2 - channel) & 1
            cells[:, corner] += (lower[:, channel] + is_upper) << shifts[channel]
            weights[:, corner] *= fraction[:, channel] if is_upper else 1 - fraction[:, channel]
    return cells, weights


@compiled
def _evaluate(patches: Any, fraction: Any, target: Any, scale: Any, residual: Any, jacobian: Any) -> Any:
    # Fills `residual` (3,) with S (log R - log t) at a fraction (3,) of the cell between `patches` (8, 3), and
    # `jacobian` (3, 3) with its derivatives; returns |residual|².
    residual[:], jacobian[:] = 0.0, 0.0
    for channel in range(3):
        value, by_red, by_green, by_blue = 0.0, 0.0, 0.0, 0.0
        for corner in range(8):
            up_r, up_g, up_b = corner >> 2, corner >> 1 & 1, corner & 1
            weight_r, weight_g, weight_b = (
                fraction[0] if up_r else 1 - fraction[0],
                fraction[1] if up_g else 1 - fraction[1],
                fraction[2] if up_b else 1 - fraction[2],
            )
            value += weight_r * weight_g * weight_b * patches[corner, channel]
            by_red += (2 * up_r - 1) * weight_g * weight_b * patches[corner, channel]
            by_green += (2 * up_g - 1) * weight_r * weight_b * patches[corner, channel]
            by_blue += (2 * up_b - 1) * weight_r * weight_g * patches[corner, channel]
        difference = math.log(value) - target[channel]
        for axis in range(3):
            residual[axis] += scale[axis, channel] * difference
            jacobian[axis, 0] += scale[axis, channel] * by_red / value
            jacobian[axis, 1] += scale[axis, channel] * by_green / value
            jacobian[axis, 2] += scale[axis, channel] * by_blue / value
    return residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2


@compiled
def _descend(patches: Any, target: Any, scale: Any, fraction: Any, memory: Any) -> Any:
    # Moves `fraction` (3,) to a minimum within the cell between `patches` (8, 3); returns the squared residual.
    vectors, matrices = memory
    residual, new_residual, gradient, trial = vectors
    jacobian, new_jacobian, normal = matrices
    is_bound = np.empty(3, np.bool_)
    damping, cost = 1e-3, _evaluate(patches, fraction, target, scale, residual, jacobian)
    for _ in range(_ROUNDS):
        largest = 0.0
        for p in range(3):
            gradient[p] = jacobian[0, p] * residual[0] + jacobian[1, p] * residual[1] + jacobian[2, p] * residual[2]
            is_bound[p] = (fraction[p] <= 0 and gradient[p] > 0) or (fraction[p] >= 1 and gradient[p] < 0)
        for p in range(3):
            for q in range(3):
                normal[p, q] = 0.0
                if not (is_bound[p] or is_bound[q]):
                    for axis in range(3):
                        normal[p, q] += jacobian[axis, p] * jacobian[axis, q]
            largest = max(largest, normal[p, p])
        for p in range(3):
            normal[p, p] += damping * (normal[p, p] + 1e-3 * (largest + 1e-12))
            if is_bound[p]:
                normal[p, p] += largest + 1e-12
                gradient[p] = 0.0
        # Cholesky factor in the lower triangle, then both substitutions.
        for p in range(3):
            for q in range(p + 1):
                for r in range(q):
                    normal[p, q] -= normal[p, r] * normal[q, r]
                normal[p, q] = math.sqrt(normal[p, p]) if p == q else normal[p, q] / normal[q, q]
        for p in range(3):
            trial[p] = -gradient[p]
            for r in range(p):
                trial[p] -= normal[p, r] * trial[r]
            trial[p] /= normal[p, p]
        step = 0.0
        for p in range(2, -1, -1):
            for r in range(p + 1, 3):
                trial[p] -= normal[r, p] * trial[r]
            trial[p] /= normal[p, p]
        for p in range(3):
            trial[p] = min(max(fraction[p] + trial[p], 0.0), 1.0)
            step = max(step, abs(trial[p] - fraction[p]))
        if step < _SMALLEST_STEP:
            break
        new_cost = _evaluate(patches, trial, target, scale, new_residual, new_jacobian)
        if new_cost < cost:
            fraction[:], residual[:], jacobian[:], cost = trial, new_residual, new_jacobian, new_cost
            damping *= 0.3
        else:
            damping *= 8.0
    return cost


@compiled
def _search(colours: Any, bounds: Any, targets: Any, side: Any, scale: Any, positions: Any) -> None:
    # Fills `positions` (K, 3). Rows of `bounds` (8, cells): the smallest values of log R/G, log G/B, log B/R and of
    # the sum of log R, G and B in each cell, then the largest ones.
    cells = side - 1
    lower, candidates = np.empty(cells**3), np.empty(cells**3, np.int64)
    memory = np.empty((4, 3)), np.empty((3, 3, 3))
    patches, fraction = np.empty((8, 3)), np.empty(3)
    for k in range(len(targets)):
        red, green, blue = targets[k]
        ratios = red - green, green - blue, blue - red
        for cell in range(cells**3):
            total = 0.0
            for i in range(3):
                distance = max(bounds[i, cell] - ratios[i], ratios[i] - bounds[4 + i, cell], 0.0)
                total += distance * distance
            distance = max(bounds[3, cell] - red - green - blue, red + green + blue - bounds[7, cell], 0.0)
            lower[cell] = (total + BRIGHTNESS_COST * distance * distance) / 3
        # The cell with the smallest bound is tried first. Then only cells with a bound below its minimum remain.
        nearest, count, best = np.argmin(lower), 0, np.inf
        while True:
            low_r, low_g, low_b = nearest // cells**2, nearest // cells % cells, nearest % cells
            for corner in range(8):
                patch = ((low_r + (corner >> 2)) * side + low_g + (corner >> 1 & 1)) * side + low_b + (corner & 1)
                patches[corner] = colours[patch]
            is_first = best == np.inf
            # A cell may have several minima, so descents start at four corners of a tetrahedron in it.
            for start in range(4):
                fraction[0], fraction[1] = 0.2 + 0.6 * (start >> 1), 0.2 + 0.6 * (start & 1)
                fraction[2] = 0.2 + 0.6 * ((start >> 1) ^ (start & 1))
                cost = _descend(patches, targets[k], scale, fraction, memory)
                if cost < best:
                    best = cost
                    positions[k, 0] = low_r + fraction[0]
                    positions[k, 1] = low_g + fraction[1]
                    positions[k, 2] = low_b + fraction[2]
                limit = max(math.sqrt(best) - _TOLERANCE, 0.0) ** 2
                if limit == 0.0:
                    break
            if is_first:
                lower[nearest] = np.inf
                for cell in range(cells**3):
                    if lower[cell] < limit:
                        candidates[count] = cell
                        count += 1
            chosen = -1
            for i in range(count):
                if lower[candidates[i]] < limit and (chosen < 0 or lower[candidates[i]] < lower[candidates[chosen]]):
                    chosen = i
            if chosen < 0:
                break
            nearest = candidates[chosen]
            count -= 1
            candidates[chosen] = candidates[count]


def _bounds(colours: _Array, bits: int) -> _Array:
    logs = np.log(colours)
    numbers = np.concatenate([logs - np.roll(logs, -1, axis=1), logs], axis=1).reshape((1 << bits,) * 3 + (6,))
    ends: list[_Array] = []
    for pick in (np.minimum, np.maximum):
        corner = numbers
        for axis in range(3):
            slices = np.moveaxis(corner, axis, 0)
            corner = np.moveaxis(pick(slices[:-1], slices[1:]), 0, axis)
        ends.append(
            np.concatenate([corner[..., :3], corner[..., 3:].sum(axis=3, keepdims=True)], axis=3).reshape(-1, 4)
        )
    return np.ascontiguousarray(np.concatenate(ends, axis=1).T)


def invert(colours: _Array, targets: _Array, bits: int) -> _Array:
    """Return the positions (K, 3) float64, 0 … 2ⁿ - 1, at which a print is nearest to target colours.

    `colours`: (8**bits, 3) float64 > 0, camera RGB of the patches relative to white. `targets`: (K, 3) float64 > 0.
    """
    positions = np.empty((len(targets), 3))
    inputs = np.array(colours, np.float64), _bounds(colours, bits), np.log(np.array(targets, np.float64))
    _search(*inputs, 1 << bits, _SCALE, positions)
    return positions
