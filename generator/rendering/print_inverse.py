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

from typing import Final

import numpy as np
import numpy.typing as npt

from generator.kernels.choice import channels_of

_Array = npt.NDArray[np.float64]

STEPS: Final = 8
"""Steps of a path from grey to a colour: with twice as many, places differ by less than a hundredth of a cell."""

_ROUNDS: Final = 12
"""Levenberg-Marquardt steps at each step of a path; inside the gamut four are enough."""

BRIGHTNESS_COST: Final = 0.5
"""What a relative difference of brightness counts against one of chromaticity. Chosen: see
docs/reference/rendering.md."""

_AXES: Final = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]]) / np.sqrt([[3.0], [2.0], [6.0]])
"""Brightness and two directions of chromaticity, of length 1, for logarithmic differences of channels."""

_SCALE: Final = _AXES * np.array([[BRIGHTNESS_COST**0.5], [1.0], [1.0]])


def corners(places: _Array, bits: int) -> tuple[npt.NDArray[np.int64], _Array]:
    """Return the eight cells around places (K, 3), and their trilinear weights: (K, 8) int64 and (K, 8) float64.

    Examples
    --------
    >>> cells, weights = corners(np.array([[0.0, 0.25, 1.0]]), bits=1)
    >>> cells[weights > 0].tolist(), weights[weights > 0].tolist()
    ([1, 3], [0.75, 0.25])
    """
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


def _seen(colours: _Array, places: _Array, bits: int) -> tuple[_Array, _Array]:
    """Return log R (K, 3) at places (K, 3), and its derivatives by the place (K, 3 channels, 3 codes).

    `colours`: (8**bits, 3) float64 > 0.
    """
    cells, weights = corners(places, bits)
    around = colours[cells]
    seen = np.einsum("kc,kcx->kx", weights, around)
    part = places - np.clip(np.floor(places), 0, (1 << bits) - 2)
    cube = around.reshape(-1, 2, 2, 2, 3)
    red, green, blue = (np.stack([1 - part[:, channel], part[:, channel]], axis=1) for channel in range(3))
    slopes = np.stack(
        [
            np.einsum("kj,kl,kjlx->kx", green, blue, cube[:, 1] - cube[:, 0]),
            np.einsum("ki,kl,kilx->kx", red, blue, cube[:, :, 1] - cube[:, :, 0]),
            np.einsum("ki,kj,kijx->kx", red, green, cube[:, :, :, 1] - cube[:, :, :, 0]),
        ],
        axis=2,
    )
    return np.log(seen), slopes / seen[:, :, None]


def nearest_to(colours: _Array, wanted: _Array, start: _Array, bits: int) -> _Array:
    """Return the places (K, 3) at which a print comes nearest to wanted colours, from places `start` (K, 3).

    `colours`: (8**bits, 3) float64 > 0, what the camera sees of the cells. `wanted`: (K, 3) float64 > 0.
    """
    top = float((1 << bits) - 1)
    target = np.log(wanted)
    places, damping = start.copy(), np.full(len(start), 1e-3)
    logs, slopes = _seen(colours, places, bits)
    miss = (logs - target) @ _SCALE.T
    cost = (miss**2).sum(axis=1)
    for _ in range(_ROUNDS):
        jacobian = np.einsum("ac,kcp->kap", _SCALE, slopes)
        gradient = np.einsum("kap,ka->kp", jacobian, miss)
        held = ((places <= 0) & (gradient > 0)) | ((places >= top) & (gradient < 0))
        jacobian = np.where(held[:, None, :], 0.0, jacobian)
        normal = np.einsum("kap,kaq->kpq", jacobian, jacobian)
        diagonal = np.einsum("kpp->kp", normal)
        scale = diagonal.max(axis=1, keepdims=True) + 1e-12
        normal[:, range(3), range(3)] += damping[:, None] * (diagonal + 1e-3 * scale) + np.where(held, scale, 0.0)
        towards = np.where(held, 0.0, -gradient)[..., None]
        step = np.asarray(np.linalg.solve(normal, towards), np.float64)[..., 0]
        tried: _Array = np.clip(places + np.clip(step, -4.0, 4.0), 0.0, top)
        logs, derived = _seen(colours, tried, bits)
        missed = (logs - target) @ _SCALE.T
        new = (missed**2).sum(axis=1)
        better = new < cost
        places[better], miss[better], slopes[better], cost[better] = (
            tried[better],
            missed[better],
            derived[better],
            new[better],
        )
        damping = np.where(better, damping * 0.3, damping * 8.0)
    return places


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
    start = np.empty((len(levels), 3))
    for row, target in enumerate(np.log(wanted) @ _SCALE.T):
        cell = int(((logs - target) ** 2).sum(axis=1).argmin())
        start[row] = channels_of(cell, bits)
    # On a chart of few cells the nearest may lie beside the grey axis, at a kink of its own: two starts, the better.
    found = [nearest_to(colours, wanted, start, bits)]
    brightness = np.maximum.accumulate(np.sort(colours.mean(axis=1)[_diagonal(bits)]))
    along = np.interp(levels, brightness, np.linspace(0, top, len(brightness)))
    found.append(nearest_to(colours, wanted, np.repeat(along[:, None], 3, axis=1), bits))
    costs = [(((_seen(colours, places, bits)[0] - np.log(wanted)) @ _SCALE.T) ** 2).sum(axis=1) for places in found]
    return np.where((costs[1] <= costs[0])[:, None], found[1], found[0])


def _diagonal(bits: int) -> npt.NDArray[np.int64]:
    """Return the cells of three equal codes, ascending."""
    return np.arange(1 << bits) * (1 | 1 << bits | 1 << 2 * bits)
