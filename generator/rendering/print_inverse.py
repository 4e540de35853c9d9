"""Find the position in the chart at which the camera records a given colour.

The print is treated as continuous: colours are interpolated between patches. A position p is a code per channel from 0
to 2ⁿ - 1, not necessarily whole. R(p) is what the camera records there under a reference illuminant, relative to its
white: trilinear interpolation of the means of the eight patches around p. The position of a colour t minimises ::

    |S (log R(p) - log t)|²,   0 ≤ p ≤ 2ⁿ - 1

S converts channel differences to brightness and chromaticity, with less weight on brightness. The errors of methods are
angles, so a colour outside the gamut of the print should keep its hue rather than its brightness.

The target moves from the grey of equal brightness to the colour, in `STEPS` steps. Each step starts at the previous
position and makes Levenberg-Marquardt iterations within the chart (K. Levenberg 1944, D. Marquardt 1963; bounds by
projection, C. T. Kelley, *Iterative Methods for Optimization*, 1999, section 5.4). Outside the gamut, positions follow
its surface, so similar colours have neighbouring positions.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from generator.kernels.choice import channels_of

_Array = npt.NDArray[np.float64]

# Steps of a path from grey to a colour; with twice as many, positions change by less than 0.01 patch.
STEPS: Final = 8

_ROUNDS: Final = 12  # Levenberg-Marquardt iterations per step of a path; inside the gamut 4 are enough

_STRIDE: Final = 4.0  # Largest change of a position per iteration along each axis, patches

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
def _evaluate(colours: Any, position: Any, target: Any, side: Any, scale: Any, residual: Any, jacobian: Any) -> Any:
    # Fills `residual` (3,) with S (log R(p) - log t) and `jacobian` (3, 3) with its derivatives; returns |residual|².
    low_r = min(max(math.floor(position[0]), 0), side - 2)
    low_g = min(max(math.floor(position[1]), 0), side - 2)
    low_b = min(max(math.floor(position[2]), 0), side - 2)
    red, green, blue = position[0] - low_r, position[1] - low_g, position[2] - low_b
    first = (low_r * side + low_g) * side + low_b
    residual[:], jacobian[:] = 0.0, 0.0
    for channel in range(3):
        value, by_red, by_green, by_blue = 0.0, 0.0, 0.0, 0.0
        for corner in range(8):
            up_r, up_g, up_b = corner >> 2, corner >> 1 & 1, corner & 1
            colour = colours[first + (up_r * side + up_g) * side + up_b, channel]
            weight_r, weight_g, weight_b = (
                red if up_r else 1 - red,
                green if up_g else 1 - green,
                blue if up_b else 1 - blue,
            )
            value += weight_r * weight_g * weight_b * colour
            by_red += (2 * up_r - 1) * weight_g * weight_b * colour
            by_green += (2 * up_g - 1) * weight_r * weight_b * colour
            by_blue += (2 * up_b - 1) * weight_r * weight_g * colour
        for axis in range(3):
            residual[axis] += scale[axis, channel] * (math.log(value) - target[channel])
            jacobian[axis, 0] += scale[axis, channel] * by_red / value
            jacobian[axis, 1] += scale[axis, channel] * by_green / value
            jacobian[axis, 2] += scale[axis, channel] * by_blue / value
    return residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2


@compiled
def _descend(colours: Any, targets: Any, positions: Any, side: Any, scale: Any, rounds: Any, costs: Any) -> None:
    # Moves each of the positions (K, 3) to the minimum, and fills `costs` (K,) with the squared residuals.
    top = side - 1.0
    residual, new_residual, jacobian, new_jacobian = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    gradient, trial, normal, is_bound = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3, np.bool_)
    for k in range(len(positions)):
        position, damping = positions[k], 1e-3
        cost = _evaluate(colours, position, targets[k], side, scale, residual, jacobian)
        for _ in range(rounds):
            largest = 0.0
            for p in range(3):
                gradient[p] = jacobian[0, p] * residual[0] + jacobian[1, p] * residual[1] + jacobian[2, p] * residual[2]
                is_bound[p] = (position[p] <= 0 and gradient[p] > 0) or (position[p] >= top and gradient[p] < 0)
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
            for p in range(2, -1, -1):
                for r in range(p + 1, 3):
                    trial[p] -= normal[r, p] * trial[r]
                trial[p] /= normal[p, p]
            for p in range(3):
                trial[p] = min(max(position[p] + min(max(trial[p], -_STRIDE), _STRIDE), 0.0), top)
            new_cost = _evaluate(colours, trial, targets[k], side, scale, new_residual, new_jacobian)
            if new_cost < cost:
                position[:], residual[:], jacobian[:], cost = trial, new_residual, new_jacobian, new_cost
                damping *= 0.3
            else:
                damping *= 8.0
        costs[k] = cost


def nearest_positions(colours: _Array, targets: _Array, start: _Array, bits: int) -> _Array:
    """Return the positions (K, 3) at which a print is nearest to target colours, starting from `start` (K, 3).

    `colours`: (8**bits, 3) float64 > 0, camera RGB of the patches. `targets`: (K, 3) float64 > 0.
    """
    return _nearest_with_costs(colours, targets, start, bits)[0]


def _nearest_with_costs(colours: _Array, targets: _Array, start: _Array, bits: int) -> tuple[_Array, _Array]:
    positions, costs = np.array(start, np.float64), np.empty(len(start))
    inputs = np.array(colours, np.float64), np.log(np.array(targets, np.float64))
    _descend(*inputs, positions, 1 << bits, _SCALE, _ROUNDS, costs)
    return positions, costs


def invert(colours: _Array, greys: _Array, targets: _Array, bits: int) -> _Array:
    """Return the positions (K, 3) float64, 0 … 2ⁿ - 1, of target colours, along paths from greys.

    `colours`: (8**bits, 3) float64 > 0, camera RGB of the patches relative to white. `greys`: (K,) float64, brightness
    of the grey at which each path begins. `targets`: (K, 3) float64 > 0.
    """
    grey = np.repeat(greys[:, None], 3, axis=1)
    levels, level_index = np.unique(greys, return_inverse=True)
    start = _grey_positions(colours, levels, bits)[level_index]
    positions = start
    for step in range(1, STEPS + 1):
        share = step / STEPS
        positions = nearest_positions(colours, (1 - share) * grey + share * targets, positions, bits)
    return positions


def _grey_positions(colours: _Array, levels: _Array, bits: int) -> _Array:
    top = (1 << bits) - 1
    targets = np.repeat(levels[:, None], 3, axis=1)
    logs = np.log(colours) @ _SCALE.T
    nearest = [((logs - target) ** 2).sum(axis=1).argmin() for target in np.log(targets) @ _SCALE.T]
    # On a chart of few patches, a path from the nearest patch may end in a local minimum off the grey axis. A second
    # path starts on the diagonal of equal codes, and the better result is used.
    starts = [channels_of(nearest, bits).astype(np.float64)]
    brightness = np.maximum.accumulate(np.sort(colours.mean(axis=1)[_diagonal(bits)]))
    diagonal_codes = np.interp(levels, brightness, np.linspace(0, top, len(brightness)))
    starts.append(np.repeat(diagonal_codes[:, None], 3, axis=1))
    (first, costs), (second, second_costs) = (_nearest_with_costs(colours, targets, start, bits) for start in starts)
    return np.where((second_costs <= costs)[:, None], second, first)


def _diagonal(bits: int) -> npt.NDArray[np.int64]:
    return np.arange(1 << bits) * (1 | 1 << bits | 1 << 2 * bits)
