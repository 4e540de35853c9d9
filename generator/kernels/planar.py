"""Crops for training: float32, one plane a channel, of any window of a picture.

A crop is the window of the image that `rendering.draw_samples` makes of the whole picture, mirrored if asked for,
times a gain, in units of the sensor's saturation and cut off there:

    out[c, y, x] = min(float32(sample) · float32(gain / white_level), 1)

A gain is digital: it scales signal and noise alike, and saturated pixels darken with it. Where a share of the print's
black is taken out of a crop (`generator.rendering.black_points`), s[c] = gain · stretch[c] / white_level and

    out[c, y, x] = min(float32(sample) · float32(s[c]) + float32(-taken[c] · s[c]), float32(min(gain, 1)))

What noise takes below 0 stays below 0: cut off there, black would be too bright.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

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

Window = tuple[int, int, int, int]  # x and y of a window's first pixel in the picture, and its width and height, px

SCALES: Final = 7  # Numbers of an item that `vector.planes8` takes: factors and summands of three channels, and a limit


@compiled
def _crop(
    plan: Any,
    seeds: Any,
    scales: Any,
    lines: int,
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
    """Fill the items `first` to `end` of a batch.

    The offsets of a row are chosen, and their samples prefetched, before the row above is fetched: the samples may lie
    in memory that is in no cache. `last` is the table's last light as `arguments.readable` returns it. Of each item
    `scales`, (N, 7) float32 at address `lines`, has what `planes8` takes.
    """
    row_bytes = OFFSETS_BYTES * (width // GROUP + 2)
    for item in range(first, end):
        light, picture, pitch, picture_width, x0, y0, flip, image, lights = plan[item]
        samples = last if light == lights - 1 else tables + light * light_bytes
        line = lines + 4 * SCALES * item
        low, high = x0 // GROUP, (x0 + width - 1) // GROUP
        for y in range(height + 1):
            if y < height:
                keys = row_keys(y0 + y, 0, image, seeds[item])
                row = picture + y * pitch
                chosen = scratch + EDGE_BYTES + row_bytes * (y & 1)
                for group in range(low, high + 1):
                    to = chosen + OFFSETS_BYTES * (group - low)
                    choose_group(row, picture_width, group, keys, count, bits, scratch, to)
                    for i in range(GROUP):
                        prefetch(samples + offset_at(to + 4 * i))
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
                    # The last eight may overlap the ones before.
                    x = min(start, width - EIGHT)
                    if flip:
                        planes8_mirrored(samples, offsets - 4 * x, line, red + 4 * x, green + 4 * x, blue + 4 * x)
                    else:
                        planes8(samples, offsets + 4 * x, line, red + 4 * x, green + 4 * x, blue + 4 * x)


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
    taken: npt.ArrayLike | None = None,
    stretches: npt.ArrayLike = 1.0,
    threads: int = 1,
    out: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.float32]:
    """Return N crops; the rule stands at the head of this file.

    Tables are not copied, so that they may be gigabytes mapped from disk. All work is done without the interpreter's
    lock.

    Parameters
    ----------
    tables
        (L, 8**bits, S, 3) uint16, for example `lut.samples`.
    lights
        (N,) int, the light of each item.
    pictures
        N pictures (H, W, 3) uint8, of any sizes; one may serve many items.
    windows
        (N, 4) int, x, y, width, height; all of one width and height.
    white_level
        Sample value of the sensor's saturation, which becomes 1; 1 … 65535.
    flips
        (N,) bool, or one for all: whether the window is mirrored left to right. The choices stay with the picture's
        pixels.
    gains
        (N,) float ≥ 0, or one for all: factor on the values before they are cut off at 1.
    seeds, images
        (N,) int, or one for all, as for `draw_samples`.
    taken
        (N, 3) float ≥ 0, counts that are taken out of the channels of each item's samples; None takes out nothing.
    stretches
        (N, 3) float > 0, or one for all: what the rest is then multiplied by. Nothing is multiplied where `taken` is
        None.
    threads
        Threads that share the items; no byte depends on it.
    out
        (N, 3, height, width) float32 to fill instead of a new array.

    Returns
    -------
    ndarray
        (N, 3, height, width) float32, linear camera RGB, 0 … 1 = saturation.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

    Examples
    --------
    >>> tables = np.arange(2 * 8 * 2 * 3, dtype=np.uint16).reshape(2, 8, 2, 3)
    >>> white = np.full((6, 8, 3), 255, np.uint8)
    >>> crops = draw_batch(tables, [0, 1], [white, white], [(0, 0, 4, 4), (4, 2, 4, 4)], white_level=100)
    >>> crops.shape, crops.dtype
    ((2, 3, 4, 4), dtype('float32'))
    """
    if tables.ndim != 4 or not len(tables):
        raise InputError(f"the tables are {tables.shape}, expected (lights, 8**bits, samples, 3)")
    bits = check_samples(tables[0])
    check_white_level(white_level)
    count = len(pictures)
    frames = np.asarray(windows, dtype=np.int64)
    if frames.shape != (count, 4) or not count:
        raise InputError(f"{count} pictures and windows {frames.shape} were given, expected one window of 4 a picture")
    width, height = int(frames[0, 2]), int(frames[0, 3])
    if (frames[:, 2:] != frames[0, 2:]).any():
        raise InputError("the windows of a batch differ in size; give all one width and height")
    numbers = np.asarray(lights, dtype=np.int64)
    if numbers.shape != (count,) or numbers.min() < 0 or numbers.max() >= len(tables):
        raise InputError(f"lights {numbers.tolist()} were given, expected {count} from 0 to {len(tables) - 1}")
    gained = np.broadcast_to(np.asarray(gains, dtype=np.float64), count)
    if not (np.isfinite(gained) & (gained >= 0)).all():
        raise InputError(f"the gain is {gained.min()}, expected a finite number from 0")
    seeded, imaged = _whole_numbers(seeds, count, 64, "seed"), _whole_numbers(images, count, 32, "image number")
    target = check_out(out, (count, 3, height, width), np.float32)
    work = target if target.strides[3] == 4 or width == 1 else np.empty(target.shape, np.float32)
    if not tables[0].flags.c_contiguous:
        tables = np.ascontiguousarray(tables)
    last = readable(tables[-1])
    # Most batches show a picture more than once; each is checked once.
    distinct = {id(picture): picture for picture in pictures}
    for picture in distinct.values():
        check_picture(picture)
    sources = [packed_rows(picture) for picture in distinct.values()]
    layouts = np.array([(one.ctypes.data, one.strides[0], one.shape[1], one.shape[0]) for one in sources], np.int64)
    places = {identity: place for place, identity in enumerate(distinct)}
    shown = layouts[[places[id(picture)] for picture in pictures]]
    outside = (frames[:, :2] < 0).any(axis=1) | (frames[:, :2] + frames[:, 2:] > shown[:, 2:]).any(axis=1)
    for item in np.flatnonzero(outside | (min(width, height) < 1))[:1]:
        _checked_window(frames[item].tolist(), pictures[int(item)])
    plan = np.zeros((count, 9), np.int64)
    plan[:, 0], plan[:, 1], plan[:, 2:4] = numbers, shown[:, 0] + frames[:, 1] * shown[:, 1], shown[:, 1:3]
    plan[:, 4:6], plan[:, 6] = frames[:, :2], np.broadcast_to(flips, count)
    plan[:, 7], plan[:, 8] = imaged, len(tables)
    scales = scales_of(gained, white_level, taken, stretches)

    def fill(first: int, end: int) -> None:
        scratch = np.empty(EDGE_BYTES + 2 * OFFSETS_BYTES * (width // GROUP + 2), np.uint8)
        _crop(
            plan,
            seeded,
            scales,
            scales.ctypes.data,
            tables.ctypes.data,
            tables.strides[0],
            last.ctypes.data,
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
    gains: npt.NDArray[np.float64], white_level: int, taken: npt.ArrayLike | None, stretches: npt.ArrayLike
) -> npt.NDArray[np.float32]:
    """Return (N, 7) float32: what `vector.planes8` takes of each item."""
    scales = np.empty((len(gains), SCALES), np.float32)
    if taken is None:
        # A number is itself with -0 added to it.
        scales[:, :3], scales[:, 3:6], scales[:, 6] = (gains / white_level)[:, None], -0.0, 1.0
        return scales
    counts = np.broadcast_to(np.asarray(taken, np.float64), (len(gains), 3))
    factors = np.broadcast_to(np.asarray(stretches, np.float64), counts.shape)
    if not ((counts >= 0) & (factors > 0) & np.isfinite(counts) & np.isfinite(factors)).all():
        raise InputError("what is taken out of samples is to be finite numbers from 0, stretches numbers above 0")
    exact = (gains / white_level)[:, None] * factors
    scales[:, :3], scales[:, 3:6], scales[:, 6] = exact, -counts * exact, np.minimum(gains, 1)
    return scales


def _whole_numbers(numbers: npt.ArrayLike, count: int, bits: int, name: str) -> npt.NDArray[np.uint64]:
    """Return `count` whole numbers 0 … 2**bits − 1 as (count,) uint64; a single one is repeated."""
    given = np.asarray(numbers)
    if given.dtype.kind not in "iu":
        given = np.asarray(numbers, dtype=object)
    least, most = int(given.min()), int(given.max())
    if least < 0 or most >= 1 << bits:
        raise InputError(f"a {name} is {least} or {most}, expected 0 to 2^{bits} - 1")
    return np.ascontiguousarray(np.broadcast_to(given.astype(np.uint64), count))
