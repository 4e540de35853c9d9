"""The inner loops of the lens's spread, compiled: weights of the slots around a patch, their sums, and wide blurs.

Compiled for the processor at hand, without licence to reorder sums: a table's bytes depend on neither processor nor
thread. What the numbers mean stands where they are called, in `calibration.spread.surroundings`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from calibration.spread.printed_grid import PARTS, REACH
from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Index = npt.NDArray[np.int32]
_Place = npt.NDArray[np.int64]

ACROSS = 2 * REACH + 1
"""Slots along the neighbourhood of a patch."""


@compiled
def window_shares(scale: float, pitches: _Array, offsets: _Array, window: int, shares: _Array) -> None:
    """Fill shares (pitches, offsets, 25): of a kernel's light in a window, what comes from each part of five slots.

    Along one axis, with a Gaussian of σ `scale` px: the mean over the `window` pixels whose middle lies `offsets` px
    beside the middle slot's; slots are `pitches` px long. What comes from beyond counts for the outermost parts.
    """
    parts = shares.shape[2]
    root = scale * math.sqrt(2.0)
    for p in range(len(pitches)):
        for o in range(len(offsets)):
            for part in range(parts):
                shares[p, o, part] = 0.0
            for pixel in range(window):
                at = offsets[o] + pixel - window // 2
                before = 0.0
                for part in range(parts):
                    edge = ((part + 1) / PARTS - REACH - 0.5) * pitches[p]
                    below = 1.0 if part == parts - 1 else 0.5 * math.erfc((at - edge) / root)
                    shares[p, o, part] += (below - before) / window
                    before = below


@compiled
def _interpolated(
    shares: _Array, first_pitch: float, pitch_step: float, first_offset: float, offset_step: float, pitch: float,
    offset: float, out: _Array,
) -> None:  # fmt: skip
    """Fill `out` (25,) with a kernel's shares (pitches, offsets, 25) at a pitch and an offset, bilinearly."""
    p = min(max((pitch - first_pitch) / pitch_step, 0.0), shares.shape[0] - 1.000001)
    o = min(max((offset - first_offset) / offset_step, 0.0), shares.shape[1] - 1.000001)
    i, j = int(p), int(o)
    u, v = p - i, o - j
    for part in range(len(out)):
        low = shares[i, j, part] + (shares[i, j + 1, part] - shares[i, j, part]) * v
        high = shares[i + 1, j, part] + (shares[i + 1, j + 1, part] - shares[i + 1, j, part]) * v
        out[part] = low + (high - low) * u


@compiled
def weights_around(
    row: _Place, column: _Place, neighbours: _Index, parts: _Index, offset: _Array, pitch: _Array, shares: _Array,
    grid: _Array, amount: _Array, weights: _Float, others: _Float,
) -> None:  # fmt: skip
    """Fill weights (N, 25, 3) and others (N, 3 kinds, 3) float32 of light from the slots around patches.

    `row`, `column`, `neighbours`, `parts`: (N,), (N,) int64, (N, 25) and (5 R, 5 K) int32, as in `PrintedGrid`.
    `offset`: (N, 3, 2) float64 px along the print's axes, from a patch's centre to its window's, for each channel.
    `pitch`: (N, 2) float64 px, a slot's width and height at each patch. `shares`: (K, pitches, offsets, 25) float64,
    from `window_shares`. `grid`: (4,) first pitch and its step, first offset and its step. `amount`: (N, 3, K) float64,
    how much of each kernel there is in each channel at each patch.
    """
    kernels, count = shares.shape[0], len(row)
    x, y = np.empty(ACROSS * PARTS), np.empty(ACROSS * PARTS)
    for n in range(len(row)):
        for channel in range(3):
            weights[n, :, channel] = 0
            others[n, :, channel] = 0
            for k in range(kernels):
                share = amount[n, channel, k]
                if share == 0:
                    continue
                dx, dy = offset[n, channel, 0], offset[n, channel, 1]
                _interpolated(shares[k], grid[0], grid[1], grid[2], grid[3], pitch[n, 0], dx, x)
                _interpolated(shares[k], grid[0], grid[1], grid[2], grid[3], pitch[n, 1], dy, y)
                for b in range(ACROSS):
                    for a in range(ACROSS):
                        if neighbours[n, b * ACROSS + a] >= 0:
                            across, down = 0.0, 0.0
                            for part in range(PARTS):
                                across += x[a * PARTS + part]
                                down += y[b * PARTS + part]
                            weights[n, b * ACROSS + a, channel] += np.float32(share * across * down)
                            continue
                        top, left = (row[n] + b - REACH) * PARTS, (column[n] + a - REACH) * PARTS
                        for j in range(PARTS):
                            for i in range(PARTS):
                                kind = parts[top + j, left + i] - count
                                part_share = x[a * PARTS + i] * y[b * PARTS + j]
                                others[n, kind, channel] += np.float32(share * part_share)


@compiled
def light_around(
    neighbours: _Index, weights: _Float, others: _Float, levels: _Array, light: _Array, inks: _Array, out: _Array
) -> None:
    """Fill out (N, 3) with the light from around patches.

    Weighted levels (N, 3), and inks (3 kinds, 3) in the light (N, 3) of the place; the last kind, what lies behind the
    print, has light of its own.
    """
    for n in range(len(neighbours)):
        # The channels side by side, since each is a chain of sums.
        red, green, blue = 0.0, 0.0, 0.0
        for slot in range(neighbours.shape[1]):
            source = neighbours[n, slot]
            if source >= 0:
                red += weights[n, slot, 0] * levels[source, 0]
                green += weights[n, slot, 1] * levels[source, 1]
                blue += weights[n, slot, 2] * levels[source, 2]
        out[n, 0], out[n, 1], out[n, 2] = red, green, blue
        for kind in range(3):
            for channel in range(3):
                weight = others[n, kind, channel]
                if weight != 0:
                    lit = inks[kind, channel] if kind == 2 else light[n, channel] * inks[kind, channel]
                    out[n, channel] += weight * lit


@compiled
def blur_rows(image: _Float, taps: _Float, out: _Float) -> None:
    """Fill out (R, N) with an image (R, N) blurred down its rows by odd `taps`; its border is repeated."""
    rows, reach = image.shape[0], len(taps) // 2
    for row in range(rows):
        out[row] = 0
        for tap in range(len(taps)):
            source = min(max(row + tap - reach, 0), rows - 1)
            weight = taps[tap]
            line, sums = image[source], out[row]
            for place in range(image.shape[1]):
                sums[place] += weight * line[place]


@compiled
def colour_differences(columns: _Array, side: int, residual: _Array) -> None:
    """Fill residual (C, M) with values less the mean of their two neighbours along each axis of the code that has two.

    `columns` (C, M) float64 are values of C = side³ cells in the order of colour indices.
    """
    for red in range(side):
        for green in range(side):
            for blue in range(side):
                cell = (red * side + green) * side + blue
                axes = 0
                for column in range(columns.shape[1]):
                    residual[cell, column] = 0.0
                for axis in range(3):
                    code = red if axis == 0 else green if axis == 1 else blue
                    if code == 0 or code == side - 1:
                        continue
                    step = side * side if axis == 0 else side if axis == 1 else 1
                    axes += 1
                    for column in range(columns.shape[1]):
                        beside = 0.5 * (columns[cell - step, column] + columns[cell + step, column])
                        residual[cell, column] += columns[cell, column] - beside
                for column in range(columns.shape[1]):
                    residual[cell, column] /= max(axes, 1)
