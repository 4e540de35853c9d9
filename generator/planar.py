"""Crops for training: float32, one plane a channel, of any window of a picture.

A crop is the window of the image that `kernel.draw_samples` makes of the whole picture, mirrored if asked for, times a
gain, in units of the sensor's saturation and cut off there:

    out[c, y, x] = min(float32(sample) · float32(gain / white_level), 1)

A gain is digital: it scales signal and noise alike, and saturated pixels darken with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import InputError
from generator.arguments import (
    check_picture,
    check_place,
    check_samples,
    check_target,
    check_white,
    share,
)
from generator.choice import chosen, colour_of, row_keys
from generator.compiled import compiled

Window = tuple[int, int, int, int]


@compiled
def _crop(
    picture: Any, samples: Any, bits: int, seed: Any, image: int, x0: int, y0: int, flip: bool, scale: Any, out: Any
) -> None:
    count = samples.shape[1]
    width = out.shape[2]
    for y in range(out.shape[1]):
        keys = row_keys(y0 + y, 0, image, seed)
        for x in range(width):
            sample = samples[colour_of(picture[y0 + y, x0 + x], bits), chosen(x0 + x, keys, count)]
            to = width - 1 - x if flip else x
            for channel in range(3):
                out[channel, y, to] = min(np.float32(sample[channel]) * scale, np.float32(1))


def _checked_window(window: Sequence[int], picture: npt.NDArray[np.uint8]) -> Window:
    x0, y0, width, height = (int(number) for number in window)
    if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > picture.shape[1] or y0 + height > picture.shape[0]:
        raise InputError(
            f"the window {width}x{height} at ({x0}, {y0}) is not inside the picture of "
            f"{picture.shape[1]}x{picture.shape[0]} pixels"
        )
    return x0, y0, width, height


def _checked_gain(gain: float) -> float:
    if not 0 <= gain < float("inf"):
        raise InputError(f"the gain is {gain}, expected a finite number from 0")
    return gain


def draw_planar(
    samples: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    *,
    white_level: int,
    window: Window | None = None,
    flip: bool = False,
    gain: float = 1.0,
    seed: int = 0,
    image: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.float32]:
    """Return a window of the raw linear image of `picture` as float32 planes; the rule stands at the head of this file.

    Parameters
    ----------
    samples
        (8**bits, S, 3) uint16, linear camera RGB of one light.
    picture
        (H, W, 3) uint8 sRGB codes.
    white_level
        Sample value of the sensor's saturation, which becomes 1; 1 … 65535.
    window
        x and y of its first pixel in the picture, width and height; None is the whole picture.
    flip
        Whether the window is mirrored left to right. The choices stay with the picture's pixels.
    gain
        Factor on the values, ≥ 0, before they are cut off at 1.
    seed, image
        As for `draw_samples`.
    threads
        Threads that share the rows; no byte depends on it.
    out
        (3, height, width) float32 to fill instead of a new array.

    Returns
    -------
    ndarray
        (3, height, width) float32, linear camera RGB, 0 … 1 = saturation.

    Raises
    ------
    InputError
        A shape, type or number is not as above, or the window is not inside the picture.
    """
    bits = check_samples(samples)
    check_picture(picture)
    check_white(white_level)
    whole = (0, 0, picture.shape[1], picture.shape[0])
    x0, y0, width, height = whole if window is None else _checked_window(window, picture)
    target = check_target(out, (3, height, width), np.float32)
    key = check_place(seed, image)
    scale = np.float32(_checked_gain(gain) / white_level)

    def fill(top: int, bottom: int) -> None:
        _crop(picture, samples, bits, key, image, x0, y0 + top, flip, scale, target[:, top:bottom])

    share(fill, height, threads)
    return target


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
    threads: int = 1,
    out: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.float32]:
    """Return N crops, item i being `draw_planar(tables[lights[i]], pictures[i], window=windows[i], ...)`.

    Nothing is copied or prepared, so that `tables` may be gigabytes mapped from disk. All work is done without the
    interpreter's lock.

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
        As for `draw_planar`.
    flips, gains, seeds, images
        (N,) or one for all, as for `draw_planar`.
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
    """
    if tables.ndim != 4 or not len(tables):
        raise InputError(f"the tables are {tables.shape}, expected (lights, 8**bits, samples, 3)")
    check_samples(tables[0])
    check_white(white_level)
    count = len(pictures)
    frames = np.asarray(windows, dtype=np.int64)
    if frames.shape != (count, 4) or not count:
        raise InputError(f"{count} pictures and windows {frames.shape} were given, expected one window of 4 a picture")
    if (frames[:, 2:] != frames[0, 2:]).any():
        raise InputError("the windows of a batch differ in size; give all one width and height")
    numbers = np.asarray(lights, dtype=np.int64)
    if numbers.shape != (count,) or numbers.min() < 0 or numbers.max() >= len(tables):
        raise InputError(f"lights {numbers.tolist()} were given, expected {count} from 0 to {len(tables) - 1}")
    target = check_target(out, (count, 3, int(frames[0, 3]), int(frames[0, 2])), np.float32)
    flipped, gained = np.broadcast_to(flips, count), np.broadcast_to(gains, count)
    seeded, imaged = np.broadcast_to(seeds, count), np.broadcast_to(images, count)

    def fill(first: int, end: int) -> None:
        for i in range(first, end):
            draw_planar(
                tables[numbers[i]],
                pictures[i],
                white_level=white_level,
                window=(int(frames[i, 0]), int(frames[i, 1]), int(frames[i, 2]), int(frames[i, 3])),
                flip=bool(flipped[i]),
                gain=float(gained[i]),
                seed=int(seeded[i]),
                image=int(imaged[i]),
                out=target[i],
            )

    share(fill, count, threads)
    return target
