"""Inner loops of calibration, compiled: the lens's spread, cells among neighbours, moments.

Without licence to reorder sums: a table's bytes depend on neither processor nor thread. What the numbers mean stands
where the kernels are called. Of this software only the compiler is imported: a change of what is imported has all
kernels compiled again.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Place = npt.NDArray[np.int64]
_Slot = npt.NDArray[np.int32]

PARTS = 5  # Parts along a slot: a tag's module is two of them, so that every edge printed lies between two parts

# Slots on each side of a patch that are looked at one by one, 25 px and more: what comes from further away does not
# depend on where within its slot a patch is sampled.
REACH = 2

ACROSS = 2 * REACH + 1  # Slots along the neighbourhood of a patch


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
    row: _Place, column: _Place, neighbours: _Slot, parts: _Slot, offset: _Array, pitch: _Array, shares: _Array,
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
    neighbours: _Slot, weights: _Float, others: _Float, levels: _Array, light: _Array, inks: _Array, out: _Array
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
    """Fill out (R, N) with a finite image (R, N) blurred down its rows by odd `taps`; its border is repeated."""
    rows, reach = image.shape[0], len(taps) // 2
    padded = np.zeros(len(taps) + 3, dtype=np.float32)
    padded[: len(taps)] = taps
    for row in range(rows):
        out[row] = 0
        sums = out[row]
        # Four rows at once, added in their order: each sum is fetched and put back a fourth as often.
        for tap in range(0, len(taps), 4):
            first = row + tap - reach
            one, two = image[min(max(first, 0), rows - 1)], image[min(max(first + 1, 0), rows - 1)]
            three, four = image[min(max(first + 2, 0), rows - 1)], image[min(max(first + 3, 0), rows - 1)]
            a, b, c, d = padded[tap], padded[tap + 1], padded[tap + 2], padded[tap + 3]
            for place in range(image.shape[1]):
                sums[place] = (((sums[place] + a * one[place]) + b * two[place]) + c * three[place]) + d * four[place]


@compiled
def print_slots(shares: _Float, light: _Array, inks: _Array, image: _Float) -> None:
    """Fill image (N, 3) with slots whose `shares` (N, 3 kinds) show `inks` (3 kinds, 3) in the `light` (N, 3) there.

    The last kind, what lies behind the print, has light of its own.
    """
    for slot in range(len(shares)):
        for channel in range(3):
            seen = shares[slot, 0] * (light[slot, channel] * inks[0, channel])
            seen += shares[slot, 1] * (light[slot, channel] * inks[1, channel])
            seen += shares[slot, 2] * inks[2, channel]
            image[slot, channel] = np.float32(seen)


@compiled
def add_far(image: _Float, row: _Place, column: _Place, share: _Array, levels: _Array, added: _Array) -> None:
    """Add to added (N, 3) what patches get of an image (R, K, 3), at their `row` and `column`, for their levels (N, 3).

    `share`: (3,) of the light of each channel.
    """
    for n in range(len(row)):
        for channel in range(3):
            far = np.float64(image[row[n], column[n], channel])
            added[n, channel] += share[channel] * (far - levels[n, channel])


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


@compiled
def clipped_to_neighbours(values: _Array, around: _Place, out: _Array) -> None:
    """Fill out (N,) with values brought between the second lowest and second highest of those `around` each (N, K).

    NaN is no value and stays; where fewer than three values are around, its own among them, nothing vouches for a
    value, and it becomes NaN.
    """
    for n in range(len(values)):
        lowest, low, highest, high = np.inf, np.inf, -np.inf, -np.inf
        count = 0
        for place in around[n]:
            value = values[place]
            known = value == value
            below, above = value if known else np.inf, value if known else -np.inf
            # Without branches, which no processor could predict.
            low = min(low, max(lowest, below))
            lowest = min(lowest, below)
            high = max(high, min(highest, above))
            highest = max(highest, above)
            count += known
        out[n] = np.nan if count < 3 or np.isnan(values[n]) else min(max(values[n], low), high)


@compiled
def moments(values: _Count, means: _Array, variances: _Array) -> None:
    """Fill means and variances (N, 3) float64, the latter with S − 1 freedoms, of values (N, S, 3) uint16."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        for channel in range(3):
            total, squares = np.int64(0), np.int64(0)
            for number in range(samples):
                value = np.int64(values[patch, number, channel])
                total += value
                squares += value * value
            means[patch, channel] = total / samples
            # Integers: S Σv² and (Σv)² are exact, so their difference has every digit.
            variances[patch, channel] = (samples * squares - total * total) / (samples * (samples - 1))
