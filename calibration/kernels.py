"""Compiled inner loops of calibration: light spread by the lens, comparison with neighbours, means and variances.

Sums must not be reordered, so that a LUT has the same bytes on every processor. The module imports nothing of CroP
except the compiler, because a change in any imported module would recompile all kernels.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Index = npt.NDArray[np.int64]
_Slot = npt.NDArray[np.int32]

# The print is a grid of equal slots; a patch fills one slot. Each slot has this number of parts along each side. A
# module of a tag is two parts wide, so that every printed edge lies between two parts.
PARTS = 5

# On each side of a patch, the light of this number of slots is calculated separately. For light from further away,
# the position of the sampling window within its slot does not matter.
REACH = 2

ACROSS = 2 * REACH + 1  # Slots along one side of the square around a patch


@compiled
def window_shares(scale: float, pitches: _Array, offsets: _Array, window: int, shares: _Array) -> None:
    """Fill `shares` (pitches, offsets, 25) with the fractions of a window's light from the 25 parts of five slots.

    The calculation is for one axis. The light is spread by a Gaussian of σ `scale` px. Slots are `pitches` px long. The
    window has `window` pixels; its centre is `offsets` px from the centre of the middle slot. Light from beyond the
    five slots is added to the outermost parts.
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
    """Interpolate `shares` (pitches, offsets, 25) bilinearly at a pitch and an offset, into `out` (25,)."""
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
    row: _Index, column: _Index, neighbours: _Slot, parts: _Slot, offset: _Array, pitch: _Array, shares: _Array,
    grid: _Array, amount: _Array, weights: _Float, background: _Float,
) -> None:  # fmt: skip
    """Calculate the fractions of a patch's light that come from the 5 × 5 slots around it.

    Fills `weights` (N, 25, 3) with the fractions from patches, and `background` (N, 3 kinds, 3) with the fractions from
    paper, black ink and the area beyond the sheet. The last axis is the channel.

    `row`, `column`, `neighbours`, `parts`: (N,), (N,) int64, (N, 25) and (5 R, 5 C) int32, as in `PrintedGrid`.
    `offset`: (N, 3, 2) px along the print's axes, from the patch centre to the window centre of each channel. `pitch`:
    (N, 2) px, width and height of a slot at each patch. `shares`: of K kernels, (K, pitches, offsets, 25), by
    `window_shares`. `grid`: (4,) first pitch and step, first offset and step. `amount`: (N, 3, K), fraction of
    light that each kernel spreads.
    """
    kernels, patch_count = shares.shape[0], len(row)
    x, y = np.empty(ACROSS * PARTS), np.empty(ACROSS * PARTS)
    for n in range(len(row)):
        for channel in range(3):
            weights[n, :, channel] = 0
            background[n, :, channel] = 0
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
                                kind = parts[top + j, left + i] - patch_count
                                part_share = x[a * PARTS + i] * y[b * PARTS + j]
                                background[n, kind, channel] += np.float32(share * part_share)


@compiled
def light_around(
    neighbours: _Slot, weights: _Float, background: _Float, levels: _Array, light: _Array, inks: _Array, out: _Array
) -> None:
    """Fill `out` (N, 3) with the light that each patch receives from its surroundings.

    It is the weighted sum of the `levels` (N, 3) of patches and of the `inks` (3 kinds, 3). Paper and black ink are
    multiplied by the local `light` (N, 3). The last kind, the background behind the print, has its own light.
    """
    for n in range(len(neighbours)):
        # The processor calculates three independent sums in parallel.
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
                weight = background[n, kind, channel]
                if weight != 0:
                    lit = inks[kind, channel] if kind == 2 else light[n, channel] * inks[kind, channel]
                    out[n, channel] += weight * lit


@compiled
def blur_rows(image: _Float, taps: _Float, out: _Float) -> None:
    """Fill `out` (R, N) with a finite `image` (R, N), blurred along axis 0 with an odd number of `taps`.

    The first and the last row are repeated beyond the edges.
    """
    rows, reach = image.shape[0], len(taps) // 2
    padded = np.zeros(len(taps) + 3, dtype=np.float32)
    padded[: len(taps)] = taps
    for row in range(rows):
        out[row] = 0
        sums = out[row]
        # Four rows at once, added in their order, so that each sum is loaded and stored less often.
        for tap in range(0, len(taps), 4):
            first = row + tap - reach
            row1, row2 = image[min(max(first, 0), rows - 1)], image[min(max(first + 1, 0), rows - 1)]
            row3, row4 = image[min(max(first + 2, 0), rows - 1)], image[min(max(first + 3, 0), rows - 1)]
            a, b, c, d = padded[tap], padded[tap + 1], padded[tap + 2], padded[tap + 3]
            for n in range(image.shape[1]):
                sums[n] = (((sums[n] + a * row1[n]) + b * row2[n]) + c * row3[n]) + d * row4[n]


@compiled
def print_slots(shares: _Float, light: _Array, inks: _Array, image: _Float) -> None:
    """Fill `image` (N, 3) with the light of each slot, from its `shares` (N, 3 kinds) of the `inks` (3 kinds, 3).

    Paper and black ink are multiplied by the local `light` (N, 3). The last kind, the background behind the print, has
    its own light.
    """
    for slot in range(len(shares)):
        for channel in range(3):
            total = shares[slot, 0] * (light[slot, channel] * inks[0, channel])
            total += shares[slot, 1] * (light[slot, channel] * inks[1, channel])
            total += shares[slot, 2] * inks[2, channel]
            image[slot, channel] = np.float32(total)


@compiled
def add_far(image: _Float, row: _Index, column: _Index, share: _Array, levels: _Array, added: _Array) -> None:
    """Add to `added` (N, 3) the light that patches receive from a blurred print, minus the light that they lose.

    `image`: (R, K, 3) blurred print. `row`, `column`: (N,) slot of each patch. `share`: (3,) fraction of the light that
    is spread. `levels`: (N, 3) light of each patch.
    """
    for n in range(len(row)):
        for channel in range(3):
            far = np.float64(image[row[n], column[n], channel])
            added[n, channel] += share[channel] * (far - levels[n, channel])


@compiled
def colour_differences(columns: _Array, side: int, residual: _Array) -> None:
    """Fill `residual` (C, M) with the difference between each value and its neighbours in the colour cube.

    `columns`: (C, M) float64 values of C = side³ patches in the order of colour indices. Along each axis (code of red,
    green or blue), the mean of both neighbours is subtracted. The differences are averaged over the axes with two
    neighbours.
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
                        neighbour_mean = 0.5 * (columns[cell - step, column] + columns[cell + step, column])
                        residual[cell, column] += columns[cell, column] - neighbour_mean
                for column in range(columns.shape[1]):
                    residual[cell, column] /= max(axes, 1)


@compiled
def clipped_to_neighbours(values: _Array, around: _Index, out: _Array) -> None:
    """Fill `out` (N,) with `values`, each limited to the second lowest and second highest value of its neighbourhood.

    `around`: (N, K) indices of the value itself and its neighbours. NaN stays NaN. A value becomes NaN if fewer than
    three values of its neighbourhood are known.
    """
    for n in range(len(values)):
        lowest, low, highest, high = np.inf, np.inf, -np.inf, -np.inf
        count = 0
        for neighbour in around[n]:
            value = values[neighbour]
            is_known = value == value
            below, above = value if is_known else np.inf, value if is_known else -np.inf
            # Minima and maxima instead of branches, which the processor could not predict.
            low = min(low, max(lowest, below))
            lowest = min(lowest, below)
            high = max(high, min(highest, above))
            highest = max(highest, above)
            count += is_known
        out[n] = np.nan if count < 3 or np.isnan(values[n]) else min(max(values[n], low), high)


@compiled
def moments(values: _Count, means: _Array, variances: _Array) -> None:
    """Fill `means` and `variances` (N, 3) float64, with S − 1 degrees of freedom, of `values` (N, S, 3) uint16."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        for channel in range(3):
            total, squares = np.int64(0), np.int64(0)
            for number in range(samples):
                value = np.int64(values[patch, number, channel])
                total += value
                squares += value * value
            means[patch, channel] = total / samples
            # S Σv² and (Σv)² are exact integers, so their difference has no rounding error.
            variances[patch, channel] = (samples * squares - total * total) / (samples * (samples - 1))
