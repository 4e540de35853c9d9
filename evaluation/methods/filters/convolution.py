"""Gaussian derivatives of tiles of images, by separable filters whose inner loops are in `taps.py`.

Rows filtered along x stand in columns of 16 numbers: (columns, rows, 16), one cache line a row, which is what the
filter along y reads from top to bottom. An image is filtered in tiles whose columns fit a core's cache, from top to
bottom; the rows that a tile shares with the one above are kept, and those beyond the image are copies.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.methods.filters.taps import (
    CHUNK,
    OUTPUTS,
    across_all,
    across_even,
    across_even_odd,
    beside_all,
    copy_line,
    down_curvature,
    down_even,
    down_gradient,
    transpose,
)
from foundation.compiled import compiled
from generator.kernels.vector import LANES, LINE

GROUP: Final = LANES
"""Rows that are filtered along x at a time: one a lane."""
NEAR: Final = 9
"""Reach of kernels up to which rows are not transposed for order 2: its four transpositions a vector take longer than
loads that begin between two cache lines. Orders 0 and 1 have two and three, and are not faster so."""
STRETCH: Final = 4 * 3 * CHUNK
"""Numbers of a row that are converted before they are transposed: 16 rows of them take 12 KB of the nearest cache."""
_BYTES: Final = 4
"""Of a float32."""


@compiled
def _turn_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    lines: npt.NDArray[np.float32],
    turned: npt.NDArray[np.float32],
) -> None:
    """Write 16 rows of an image (H, 3 W) from `top` on, times `scale`, transposed to `turned` (3 P + 16, 16) float32.

    Its P pixels begin with pixel `left`; beyond the image stand copies of its first and last pixels and of its last
    row. `lines` (16, STRETCH) float32 is scratch.
    """
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + turned.shape[0] - LANES)
    before = begin - 3 * left
    for start in range(begin, end, STRETCH):
        count = min(STRETCH, end - start)
        for row in range(GROUP):
            values = image[min(top + row, height - 1), start : start + count]
            line = lines[row, :count]
            if scale == 1:
                for j in range(count):
                    line[j] = np.float32(values[j])
            else:
                for j in range(count):
                    line[j] = np.float32(values[j] * scale)
        for at in range(0, count, LANES):
            target = turned.ctypes.data + (start - 3 * left + at) * LINE
            transpose(lines.ctypes.data + at * _BYTES, STRETCH * _BYTES, target)
    for at in range(before):
        turned[at] = turned[before + at % 3]
    for at in range(end - 3 * left, turned.shape[0]):
        turned[at] = turned[at - 3]


@compiled
def _convert_row(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    y: int,
    left: int,
    line: npt.NDArray[np.float32],
) -> None:
    """Write a row of an image (H, 3 W) times `scale`, from pixel `left` on, to `line` (3 P,) float32.

    Beyond the image stand copies of its first and last pixels and of its last row.
    """
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + line.size)
    values = image[min(y, height - 1), begin:end]
    before = begin - 3 * left
    inside = line[before : before + end - begin]
    if scale == 1:
        for j in range(values.size):
            inside[j] = np.float32(values[j])
    else:
        for j in range(values.size):
            inside[j] = np.float32(values[j] * scale)
    for at in range(before):
        line[at] = inside[at % 3]
    for at in range(before + inside.size, line.size):
        line[at] = line[at - 3]


@compiled
def _filter_row(
    row: int, weights: npt.NDArray[np.float32], line: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]
) -> None:
    """Filter a row, as `_convert_row` wrote it from `reach` pixels before the tile on, to a row of three columns."""
    reach = weights.shape[1] - 1
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    for at in range(0, columns.shape[1], 3):
        source = line.ctypes.data + 3 * reach * _BYTES + at * LINE
        smooth = columns.ctypes.data + at * column + row * LINE
        beside_all(source, reach, even, odd, bend, smooth, smooth + field, smooth + 2 * field, column)


@compiled
def filter_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    rows: int,
    done: int,
    weights: npt.NDArray[np.float32],
    order: int,
    lines: npt.NDArray[np.float32],
    turned: npt.NDArray[np.float32],
    chunk: npt.NDArray[np.float32],
    columns: npt.NDArray[np.float32],
) -> int:
    """Filter the rows of an image along x that a tile needs and the tile above it has not left.

    Returns the first row of the image that is not filtered, `done` of the tile below.

    `image`: (H, 3 W) uint16, float32 or float64, rows of interleaved pixels. `scale`: factor for values that float32
    does not hold. `weights`: (3, reach + 1) float32: the halves of the kernels of order 0, 1 and 2 from their centres
    on. `lines`: (16, STRETCH) float32, scratch. `turned`: (Q + 6 reach + 16, 16) float32, scratch, its first number at
    a cache line; Q, numbers of a row of the tile, is a multiple of 48. `chunk`: (order + 1, 48, 16) float32, scratch,
    its first number at a cache line. `columns`: (order + 1, Q / 16, rows + 2 reach + 16, 16) float32: the filtered rows
    in columns of 16 numbers, from row top - reach on; its first number at a cache line. What stands there of the tile
    above is used.
    """
    reach = weights.shape[1] - 1
    height = image.shape[0]
    start = top - reach
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    plane = chunk.shape[1] * LINE
    kept = chunk.ctypes.data
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    if top:
        for at in range(columns.shape[1] * (order + 1)):
            first = columns.ctypes.data + at * column
            for row in range(done - start):
                copy_line(first + (row + rows) * LINE, first + row * LINE)
    line = turned.reshape(-1)[: columns.shape[1] * LANES + 6 * reach]
    while done < min(height, top + rows + reach):
        if order == 2 and reach <= NEAR:
            for row in range(GROUP):
                _convert_row(image, scale, done + row, left - reach, line)
                _filter_row(done + row - start, weights, line, columns)
            done += GROUP
            continue
        _turn_rows(image, scale, done, left - reach, lines, turned)
        to = columns.ctypes.data + (done - start) * LINE
        for at in range(0, columns.shape[1], 3):
            for channel in range(3):
                for pixel in range(0, CHUNK, OUTPUTS):
                    source = turned.ctypes.data + (3 * reach + at * LANES + 3 * pixel + channel) * LINE
                    smooth = kept + (3 * pixel + channel) * LINE
                    if order == 0:
                        across_even(source, reach, even, smooth)
                    elif order == 1:
                        across_even_odd(source, reach, even, odd, smooth, smooth + plane)
                    else:
                        across_all(source, reach, even, odd, bend, smooth, smooth + plane, smooth + 2 * plane)
            for one in range(order + 1):
                for part in range(3):
                    transpose(kept + one * plane + part * LANES * LINE, LINE, to + one * field + (at + part) * column)
        done += GROUP
    for at in range(columns.shape[1] * (order + 1)):
        first = columns.ctypes.data + at * column
        if not top:
            for row in range(reach):
                copy_line(first + reach * LINE, first + row * LINE)
        for row in range(done - start, rows + 2 * reach):
            copy_line(first + (row - 1) * LINE, first + row * LINE)
    return done


@compiled
def filter_columns(
    columns: npt.NDArray[np.float32],
    weights: npt.NDArray[np.float32],
    order: int,
    rows: int,
    out: npt.NDArray[np.float32],
) -> None:
    """Write the size of the Gaussian derivative of rows that are filtered along x to `out`.

    `columns`: (order + 1, Q / 16, R, 16) float32, what `filter_rows` wrote: R ≥ rows + 2 reach, rows rounded up to
    fours. `weights`: (3, reach + 1) float32: the halves of the kernels of order 0, 1 and 2 from their centres on.
    `out`: (rows, Q) or longer float32, its first number at a cache line.
    """
    reach = weights.shape[1] - 1
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    pitch = out.shape[1] * _BYTES
    for at in range(columns.shape[1]):
        for y in range(0, rows, OUTPUTS):
            smooth = columns.ctypes.data + at * column + (y + reach) * LINE
            target = out.ctypes.data + y * pitch + at * LINE
            if order == 0:
                down_even(smooth, reach, even, target, pitch)
            elif order == 1:
                down_gradient(smooth, smooth + field, reach, even, odd, target, pitch)
            else:
                down_curvature(smooth, smooth + field, smooth + 2 * field, reach, even, odd, bend, target, pitch)
