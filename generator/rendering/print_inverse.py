"""Where in the chart the colours of a picture are found: the inverse of what the camera sees of the print.

The chart's cells are samples of a continuous print: between them, its colour is interpolated. A place in the chart is a
code of each channel, 0 … 2ⁿ - 1, that need not be whole, and R(p) is what the camera sees there under a reference
light, over that light's white: trilinear interpolation of the means of the eight cells around p. For a colour t the
place is the one where ::

    |S (log R(p) - log t)|²  is least,   0 ≤ p ≤ 2ⁿ - 1,

S turning differences of channels into brightness and chromaticity, of which brightness counts less: the field measures
lights by angles, and where the print cannot show a colour, its hue is to stay rather than its brightness. Colours are
found along paths: from the grey that is as bright to the colour in `STEPS` steps, each by Levenberg-Marquardt steps
bounded to the chart (K. Levenberg 1944, D. Marquardt 1963; bounds by projection, C. T. Kelley, *Iterative Methods for
Optimization*, 1999, section 5.4) from the place of the step before. So colours outside the print's gamut end where
their path leaves it, and slide along its surface: neighbours stay neighbours.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from generator.kernels.choice import channels_of

_Array = npt.NDArray[np.float64]

# Steps of a path from grey to a colour: with twice as many, places differ by less than a hundredth of a cell.
STEPS: Final = 8

_ROUNDS: Final = 12  # Levenberg-Marquardt steps at each step of a path; inside the gamut four are enough

_STRIDE: Final = 4.0  # Cells that one of these steps goes at most, along each axis

# What a relative difference of brightness counts against one of chromaticity. Chosen: see
# docs/reference/rendering.md.
BRIGHTNESS_COST: Final = 0.5

# Brightness and two directions of chromaticity, of length 1, for logarithmic differences of channels.
_AXES: Final = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]]) / np.sqrt([[3.0], [2.0], [6.0]])

_SCALE: Final = _AXES * np.array([[BRIGHTNESS_COST**0.5], [1.0], [1.0]])


def corners(places: _Array, bits: int) -> tuple[npt.NDArray[np.int64], _Array]:
    """Return the eight cells around places (K, 3), and their trilinear weights: (K, 8) int64 and (K, 8) float64."""
    top = (1 << bits) - 1
    low = np.clip(np.floor(places).astype(np.int64), 0, max(top - 1, 0))
    part = places - low
    shifts = np.array([2 * bits, bits, 0])
    cells = np.zeros((len(places), 8), np.int64)
    weights = np.ones((len(places), 8))
    for corner in range(8):
        for channel in range(3):
            up = corner >> (2 - channel) & 1
            cells[:, corner] += (low[:, channel] + up) << shifts[channel]
            weights[:, corner] *= part[:, channel] if up else 1 - part[:, channel]
    return cells, weights


@compiled
def _look(colours: Any, place: Any, target: Any, side: Any, scale: Any, miss: Any, jacobian: Any) -> Any:
    """Put S (log R(p) - log t) into `miss` (3,) and its derivatives by p into `jacobian` (3, 3); return its square."""
    low_r = min(max(math.floor(place[0]), 0), side - 2)
    low_g = min(max(math.floor(place[1]), 0), side - 2)
    low_b = min(max(math.floor(place[2]), 0), side - 2)
    red, green, blue = place[0] - low_r, place[1] - low_g, place[2] - low_b
    first = (low_r * side + low_g) * side + low_b
    miss[:], jacobian[:] = 0.0, 0.0
    for channel in range(3):
        seen, by_red, by_green, by_blue = 0.0, 0.0, 0.0, 0.0
        for corner in range(8):
            up_r, up_g, up_b = corner >> 2, corner >> 1 & 1, corner & 1
            colour = colours[first + (up_r * side + up_g) * side + up_b, channel]
            part_r, part_g, part_b = (
                red if up_r else 1 - red,
                green if up_g else 1 - green,
                blue if up_b else 1 - blue,
            )
            seen += part_r * part_g * part_b * colour
            by_red += (2 * up_r - 1) * part_g * part_b * colour
            by_green += (2 * up_g - 1) * part_r * part_b * colour
            by_blue += (2 * up_b - 1) * part_r * part_g * colour
        for axis in range(3):
            miss[axis] += scale[axis, channel] * (math.log(seen) - target[channel])
            jacobian[axis, 0] += scale[axis, channel] * by_red / seen
            jacobian[axis, 1] += scale[axis, channel] * by_green / seen
            jacobian[axis, 2] += scale[axis, channel] * by_blue / seen
    return miss[0] ** 2 + miss[1] ** 2 + miss[2] ** 2


@compiled
def _descend(colours: Any, targets: Any, places: Any, side: Any, scale: Any, rounds: Any, costs: Any) -> None:
    """Move places (K, 3) to where log R comes nearest to `targets` (K, 3), and put what is missed into `costs` (K,)."""
    top = side - 1.0
    miss, missed, jacobian, derived = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    gradient, tried, normal, held = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3, np.bool_)
    for k in range(len(places)):
        place, damping = places[k], 1e-3
        cost = _look(colours, place, targets[k], side, scale, miss, jacobian)
        for _ in range(rounds):
            largest = 0.0
            for p in range(3):
                gradient[p] = jacobian[0, p] * miss[0] + jacobian[1, p] * miss[1] + jacobian[2, p] * miss[2]
                held[p] = (place[p] <= 0 and gradient[p] > 0) or (place[p] >= top and gradient[p] < 0)
            for p in range(3):
                for q in range(3):
                    normal[p, q] = 0.0
                    if not (held[p] or held[q]):
                        for axis in range(3):
                            normal[p, q] += jacobian[axis, p] * jacobian[axis, q]
                largest = max(largest, normal[p, p])
            for p in range(3):
                normal[p, p] += damping * (normal[p, p] + 1e-3 * (largest + 1e-12))
                if held[p]:
                    normal[p, p] += largest + 1e-12
                    gradient[p] = 0.0
            # Cholesky's factor, in the lower triangle, and both substitutions.
            for p in range(3):
                for q in range(p + 1):
                    for r in range(q):
                        normal[p, q] -= normal[p, r] * normal[q, r]
                    normal[p, q] = math.sqrt(normal[p, p]) if p == q else normal[p, q] / normal[q, q]
            for p in range(3):
                tried[p] = -gradient[p]
                for r in range(p):
                    tried[p] -= normal[p, r] * tried[r]
                tried[p] /= normal[p, p]
            for p in range(2, -1, -1):
                for r in range(p + 1, 3):
                    tried[p] -= normal[r, p] * tried[r]
                tried[p] /= normal[p, p]
            for p in range(3):
                tried[p] = min(max(place[p] + min(max(tried[p], -_STRIDE), _STRIDE), 0.0), top)
            new = _look(colours, tried, targets[k], side, scale, missed, derived)
            if new < cost:
                place[:], miss[:], jacobian[:], cost = tried, missed, derived, new
                damping *= 0.3
            else:
                damping *= 8.0
        costs[k] = cost


def nearest_to(colours: _Array, wanted: _Array, start: _Array, bits: int) -> _Array:
    """Return the places (K, 3) at which a print comes nearest to wanted colours, from places `start` (K, 3).

    `colours`: (8**bits, 3) float64 > 0, what the camera sees of the cells. `wanted`: (K, 3) float64 > 0.
    """
    return _nearest_to(colours, wanted, start, bits)[0]


def _nearest_to(colours: _Array, wanted: _Array, start: _Array, bits: int) -> tuple[_Array, _Array]:
    """Return `nearest_to`, and by how much (K,) colours are missed there."""
    places, costs = np.array(start, np.float64), np.empty(len(start))
    given = np.array(colours, np.float64), np.log(np.array(wanted, np.float64))
    _descend(*given, places, 1 << bits, _SCALE, _ROUNDS, costs)
    return places, costs


def invert(colours: _Array, greys: _Array, wanted: _Array, bits: int) -> _Array:
    """Return the places (K, 3) float64, 0 … 2ⁿ - 1, of wanted colours along paths from greys.

    `colours`: (8**bits, 3) float64 > 0, what the camera sees of the cells over white. `greys`: (K,) float64, how bright
    the grey is that each path begins at. `wanted`: (K, 3) float64 > 0.
    """
    grey = np.repeat(greys[:, None], 3, axis=1)
    levels, which = np.unique(greys, return_inverse=True)
    start = _grey_places(colours, levels, bits)[which]
    places = start
    for step in range(1, STEPS + 1):
        share = step / STEPS
        places = nearest_to(colours, (1 - share) * grey + share * wanted, places, bits)
    return places


def _grey_places(colours: _Array, levels: _Array, bits: int) -> _Array:
    """Return the places (L, 3) of greys: from the nearest of many places on the diagonals around equal codes."""
    top = (1 << bits) - 1
    wanted = np.repeat(levels[:, None], 3, axis=1)
    logs = np.log(colours) @ _SCALE.T
    nearest = [((logs - target) ** 2).sum(axis=1).argmin() for target in np.log(wanted) @ _SCALE.T]
    # On a chart of few cells the nearest may lie beside the grey axis, at a kink of its own: two starts, the better.
    starts = [channels_of(nearest, bits).astype(np.float64)]
    brightness = np.maximum.accumulate(np.sort(colours.mean(axis=1)[_diagonal(bits)]))
    along = np.interp(levels, brightness, np.linspace(0, top, len(brightness)))
    starts.append(np.repeat(along[:, None], 3, axis=1))
    (one, missed), (other, missed_there) = (_nearest_to(colours, wanted, start, bits) for start in starts)
    return np.where((missed_there <= missed)[:, None], other, one)


def _diagonal(bits: int) -> npt.NDArray[np.int64]:
    return np.arange(1 << bits) * (1 | 1 << bits | 1 << 2 * bits)
