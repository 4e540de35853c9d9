"""Draw training crops: windows of generated images, as float32 planes of R, G and B.

A crop is a window of the image that `rendering.draw_samples` draws for the whole picture. It may be mirrored. Its
samples are multiplied by a gain, divided by the saturation level and clipped at 1::

    out[c, y, x] = min(float32(sample) · float32(gain / white_level), 1)

The gain is digital: it scales signal and noise equally. A gain below 1 also makes saturated pixels darker. Part of the
black of the print may be subtracted: black_counts[c], followed by multiplication by stretch[c]
(`generator.rendering.black_points`). With s[c] = gain · stretch[c] / white_level, the crop is then::

    out[c, y, x] = min(float32(sample) · float32(s[c]) + float32(-black_counts[c] · s[c]), float32(min(gain, 1)))

Negative values are kept, because clipping noise at 0 would make black too bright.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.arrays import native
from foundation.compiled import compiled
from foundation.errors import InputError
from generator.kernels.choice import (
    EDGE_BYTES,
    OFFSETS_BYTES,
    check_out,
    check_picture,
    check_samples,
    check_white_level,
    choose_group,
    packed_rows,
    prefetch,
    readable,
    row_keys,
    run_in_threads,
)
from generator.kernels.vector import EIGHT, GROUP, offset_at, plane1, planes8, planes8_mirrored

Window = tuple[int, int, int, int]  # x, y, width and height of a window in the picture, px

SCALES: Final = 7  # Values of a crop for `vector.planes8`: three factors, three summands, one limit


@compiled
def _crop(
    plan: Any,
    seeds: Any,
    scales: Any,
    scales_address: int,
    tables: int,
    light_bytes: int,
    last: int,
    count: Any,
    bits: Any,
    width: int,
    height: int,
    target: int,
    pitches: Any,
    first: int,
    end: int,
    scratch: int,
) -> None:
    # `scales_address` is the address of `scales` (N, 7) float32. `last` is the address of the samples of the last
    # illuminant, from `choice.readable`. Samples of a row are prefetched while the previous row is written, because
    # they may be in no cache.
    row_bytes = OFFSETS_BYTES * (width // GROUP + 2)
    for item in range(first, end):
        light, picture, pitch, picture_width, x0, y0, flip, image, lights = plan[item]
        samples = last if light == lights - 1 else tables + light * light_bytes
        scales_at = scales_address + 4 * SCALES * item
        low, high = x0 // GROUP, (x0 + width - 1) // GROUP
        for y in range(height + 1):
            if y < height:
                keys = row_keys(y0 + y, 0, image, seeds[item])
                row = picture + y * pitch
                row_offsets = scratch + EDGE_BYTES + row_bytes * (y & 1)
                for group in range(low, high + 1):
                    group_offsets = row_offsets + OFFSETS_BYTES * (group - low)
                    choose_group(row, picture_width, group, keys, count, bits, scratch, group_offsets)
                    for i in range(GROUP):
                        prefetch(samples + offset_at(group_offsets + 4 * i))
            if y == 0:
                continue
            offsets = scratch + EDGE_BYTES + row_bytes * ((y - 1) & 1) + 4 * (x0 - GROUP * low)
            if flip:
                offsets += 4 * (width - 1)
            red = target + item * pitches[0] + (y - 1) * pitches[2]
            green, blue = red + pitches[1], red + 2 * pitches[1]
            if width < EIGHT:
                for x in range(width):
                    sample = samples + offset_at(offsets - 4 * x if flip else offsets + 4 * x)
                    for channel in range(3):
                        factor, summand, limit = scales[item, channel], scales[item, 3 + channel], scales[item, 6]
                        plane1(sample + 2 * channel, factor, summand, limit, red + channel * pitches[1] + 4 * x)
            else:
                for start in range(0, width, EIGHT):
                    # If the width is no multiple of eight, the last eight pixels overlap the previous ones.
                    x = min(start, width - EIGHT)
                    if flip:
                        planes8_mirrored(samples, offsets - 4 * x, scales_at, red + 4 * x, green + 4 * x, blue + 4 * x)
                    else:
                        planes8(samples, offsets + 4 * x, scales_at, red + 4 * x, green + 4 * x, blue + 4 * x)


def _checked_window(window: Sequence[int], picture: npt.NDArray[np.uint8]) -> Window:
    x0, y0, width, height = (int(number) for number in window)
    if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > picture.shape[1] or y0 + height > picture.shape[0]:
        raise InputError(
            f"the window {width}x{height} at ({x0}, {y0}) is not inside the picture of "
            f"{picture.shape[1]}x{picture.shape[0]} pixels"
        )
    return x0, y0, width, height


def draw_batch(
    tables: npt.NDArray[np.uint16],
    lights: npt.ArrayLike,
    pictures: Sequence[npt.NDArray[np.uint8]],
    windows: npt.ArrayLike,
    *,
    white_level: int,
    flips: npt.ArrayLike = False,
    gains: npt.ArrayLike = 1.0,
    seeds: npt.ArrayLike = 0,
    images: npt.ArrayLike = 0,
    black_counts: npt.ArrayLike | None = None,
    stretches: npt.ArrayLike = 1.0,
    threads: int = 1,
    out: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.float32]:
    """Draw N training crops; the module docstring has the formula.

    Samples are not copied, so `tables` may be a file of several gigabytes, mapped to memory. Other Python threads can
    run at the same time.

    Parameters
    ----------
    tables
        (L, 8**bits, S, 3) uint16, samples of L illuminants, for example `lut.samples`.
    lights
        (N,) int, index of the illuminant of each crop, 0 … L − 1.
    pictures
        N source pictures (H, W, 3) uint8 of any sizes. The same array may be given several times.
    windows
        (N, 4) int, x, y, width, height of each crop in px. All crops have the same width and height.
    white_level
        Saturation level, 1 … 65535 counts. It is scaled to 1.
    flips
        (N,) bool, or one value for all: mirror the crop left to right. Mirrored pixels keep their samples.
    gains
        (N,) float ≥ 0, or one value for all: factor on the values before clipping.
    seeds, images
        (N,) int, or one value for all, as for `draw_samples`.
    black_counts
        (N, 3) float ≥ 0, counts subtracted from the channels of each crop; None subtracts nothing.
    stretches
        (N, 3) float > 0, or one value for all: factor after the subtraction. Unused if `black_counts` is None.
    threads
        Number of threads that share the crops. The result does not depend on it.
    out
        (N, 3, height, width) float32 to fill instead of a new array.

    Returns
    -------
    ndarray
        (N, 3, height, width) float32, linear camera RGB; 1 is saturation.

    Raises
    ------
    InputError
        If a shape, type or value is not as described above.

    Examples
    --------
    >>> tables = np.arange(2 * 8 * 2 * 3, dtype=np.uint16).reshape(2, 8, 2, 3)
    >>> white = np.full((6, 8, 3), 255, np.uint8)
    >>> crops = draw_batch(tables, [0, 1], [white, white], [(0, 0, 4, 4), (4, 2, 4, 4)], white_level=100)
    >>> crops.shape, crops.dtype
    ((2, 3, 4, 4), dtype('float32'))
    """
    tables = native(tables)
    if tables.ndim != 4 or not len(tables):
        raise InputError(f"the samples have shape {tables.shape}, expected (illuminants, 8**bits, samples, 3)")
    bits = check_samples(tables[0])
    check_white_level(white_level)
    count = len(pictures)
    boxes = np.asarray(windows, dtype=np.int64)
    if boxes.shape != (count, 4) or not count:
        raise InputError(f"{count} pictures have windows of shape {boxes.shape}, expected (pictures, 4)")
    width, height = int(boxes[0, 2]), int(boxes[0, 3])
    if (boxes[:, 2:] != boxes[0, 2:]).any():
        raise InputError("the windows of a batch differ in size, expected one width and height for all")
    light_ids = np.asarray(lights, dtype=np.int64)
    if light_ids.shape != (count,) or light_ids.min() < 0 or light_ids.max() >= len(tables):
        raise InputError(f"the illuminants are {light_ids.tolist()}, expected {count} from 0 to {len(tables) - 1}")
    item_gains = np.broadcast_to(np.asarray(gains, dtype=np.float64), count)
    if not (np.isfinite(item_gains) & (item_gains >= 0)).all():
        raise InputError(f"the smallest gain is {item_gains.min()}, expected finite numbers ≥ 0")
    seed_ids, image_ids = _whole_numbers(seeds, count, 64, "seed"), _whole_numbers(images, count, 32, "image number")
    target = check_out(out, (count, 3, height, width), np.float32)
    work = target if target.strides[3] == 4 or width == 1 else np.empty(target.shape, np.float32)
    last_samples = readable(tables[-1])
    # A batch often contains a picture several times; it is checked once.
    distinct = {id(picture): picture for picture in pictures}
    for picture in distinct.values():
        check_picture(picture)
    sources = [packed_rows(picture) for picture in distinct.values()]
    layouts = np.array([(source.ctypes.data, source.strides[0], *source.shape[1::-1]) for source in sources], np.int64)
    rows = {identity: row for row, identity in enumerate(distinct)}
    layout = layouts[[rows[id(picture)] for picture in pictures]]
    is_outside = (boxes[:, :2] < 0).any(axis=1) | (boxes[:, :2] + boxes[:, 2:] > layout[:, 2:]).any(axis=1)
    for item in np.flatnonzero(is_outside | (min(width, height) < 1))[:1]:
        _checked_window(boxes[item].tolist(), pictures[int(item)])
    plan = np.zeros((count, 9), np.int64)
    plan[:, 0], plan[:, 1], plan[:, 2:4] = light_ids, layout[:, 0] + boxes[:, 1] * layout[:, 1], layout[:, 1:3]
    plan[:, 4:6], plan[:, 6] = boxes[:, :2], np.broadcast_to(flips, count)
    plan[:, 7], plan[:, 8] = image_ids, len(tables)
    scales = scales_of(item_gains, white_level, black_counts, stretches)

    def fill(first: int, end: int) -> None:
        scratch = np.empty(EDGE_BYTES + 2 * OFFSETS_BYTES * (width // GROUP + 2), np.uint8)
        _crop(
            plan,
            seed_ids,
            scales,
            scales.ctypes.data,
            tables.ctypes.data,
            tables.strides[0],
            last_samples.ctypes.data,
            np.uint32(tables.shape[2]),
            np.uint32(bits),
            width,
            height,
            work.ctypes.data,
            np.array(work.strides[:3]),
            first,
            end,
            scratch.ctypes.data,
        )

    run_in_threads(fill, count, threads)
    if work is not target:
        target[...] = work
    return target


def scales_of(
    gains: npt.NDArray[np.float64], white_level: int, black_counts: npt.ArrayLike | None, stretches: npt.ArrayLike
) -> npt.NDArray[np.float32]:
    """Return (N, 7) float32: factors, summands and limit of each crop, in the order of `vector.planes8`."""
    scales = np.empty((len(gains), SCALES), np.float32)
    if black_counts is None:
        # -0.0 is added because it changes no number, not even the sign of 0.
        scales[:, :3], scales[:, 3:6], scales[:, 6] = (gains / white_level)[:, None], -0.0, 1.0
        return scales
    blacks = np.broadcast_to(np.asarray(black_counts, np.float64), (len(gains), 3))
    factors = np.broadcast_to(np.asarray(stretches, np.float64), blacks.shape)
    if not ((blacks >= 0) & (factors > 0) & np.isfinite(blacks) & np.isfinite(factors)).all():
        raise InputError("the black counts or stretches are out of range, expected finite numbers ≥ 0 and > 0")
    scaled_gains = (gains / white_level)[:, None] * factors
    scales[:, :3], scales[:, 3:6], scales[:, 6] = scaled_gains, -blacks * scaled_gains, np.minimum(gains, 1)
    return scales


def _whole_numbers(numbers: npt.ArrayLike, count: int, bits: int, name: str) -> npt.NDArray[np.uint64]:
    values = np.asarray(numbers)
    if values.dtype.kind not in "iu":
        values = np.asarray(numbers, dtype=object)
    smallest, largest = int(values.min()), int(values.max())
    if smallest < 0 or largest >= 1 << bits:
        raise InputError(f"the {name}s are {smallest} to {largest}, expected 0 to 2^{bits} - 1")
    return np.ascontiguousarray(np.broadcast_to(values.astype(np.uint64), count))
