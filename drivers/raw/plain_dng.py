"""What a DNG states of its sensor, and the counts of one that holds them as memory does.

Rules that hold inside:

- `read_plainly` gives what LibRaw would, or None; what it is not sure of it leaves to LibRaw.
- Rows and columns of colour filters and of black levels count from the active area's corner (DNG 1.7, ActiveArea).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.raw.storage import Stored
from drivers.tiff import CFA, Directory, TiffTag

BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


@dataclass(frozen=True)
class Area:
    """A rectangle of photosites: first row and column, counted from 0, and how many of each."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True, eq=False)
class PlainDng:
    """A DNG whose counts are in the file as in memory.

    - `sensor`: (RH, RW) uint16, read-only, a view into the file's bytes.
    - `pattern`: colours of the 2×2 block at the visible top-left.
    - `black`: (2, 2) float64 counts for that block, read-only.
    - `white_level`: counts.
    - `iso`, `aperture`, `shutter_s`: the exposure; None where it is not stated.
    """

    sensor: NDArray[np.uint16]
    active: Area
    pattern: str
    black: NDArray[np.float64]
    white_level: int
    iso: int | None
    aperture: float | None
    shutter_s: float | None


_PLAIN: dict[TiffTag, tuple[tuple[int, ...], ...]] = {
    TiffTag.COMPRESSION: ((1,),),
    TiffTag.PHOTOMETRIC_INTERPRETATION: ((CFA,),),
    TiffTag.BITS_PER_SAMPLE: ((16,),),
    TiffTag.SAMPLES_PER_PIXEL: ((1,), ()),
    TiffTag.CFA_REPEAT_PATTERN_DIM: ((2, 2),),
    TiffTag.CFA_PLANE_COLOR: ((0, 1, 2), ()),
    TiffTag.CFA_LAYOUT: ((1,), ()),
    TiffTag.LINEARIZATION_TABLE: ((),),
    TiffTag.GRAY_RESPONSE_CURVE: ((),),
    TiffTag.TILE_OFFSETS: ((),),
}
"""What a plain file states, or does not state."""


def read_plainly(data: bytes | memoryview, directories: Sequence[Directory], stored: Stored) -> PlainDng | None:
    """Return what a plain DNG holds; None for any other file.

    LibRaw copies such counts one by one, which takes longer than all that is done with a frame afterwards.

    `data`: the file's bytes; `stored`: the frame that it describes.
    """
    pixels = stored.directory
    if pixels is None or data[:2] != b"II" or sys.byteorder != "little":
        return None
    if any(pixels.integers(tag) not in allowed for tag, allowed in _PLAIN.items()):
        return None
    size = stored.rows, stored.columns
    pattern = pixels.integers(TiffTag.CFA_PATTERN)
    white, black = pixels.numbers(TiffTag.WHITE_LEVEL), stated_black(pixels)
    letters = "".join("RGB"[index] for index in pattern if 0 <= index < 3)
    if letters not in BAYER_PATTERNS or len(white) != 1 or black is None:
        return None
    active, start = active_area(pixels, size), stored.extents[0][0]
    enough = sum(length for _, length in stored.extents) == 2 * size[0] * size[1]
    if active is None or not enough or start % 2:
        return None
    sensor = np.frombuffer(data, dtype=np.uint16, count=size[0] * size[1], offset=start).reshape(size)
    black = np.array(black)
    black.setflags(write=False)
    iso, aperture, shutter = (
        _exposure(directories, tag)
        for tag in (TiffTag.PHOTOGRAPHIC_SENSITIVITY, TiffTag.F_NUMBER, TiffTag.EXPOSURE_TIME)
    )
    return PlainDng(
        sensor,
        active,
        letters,
        black,
        int(white[0]),
        round(iso) if iso else None,
        (round(aperture, 4) or None) if iso else None,
        (shutter or None) if iso else None,
    )


def _exposure(directories: Sequence[Directory], tag: TiffTag) -> float:
    """Return the first number of `tag` in any directory, 0 if none has it."""
    found = (directory.numbers(tag) for directory in directories)
    return next((numbers[0] for numbers in found if numbers), 0.0)


def stated_black(pixels: Directory | None) -> NDArray[np.float64] | None:
    """Return DNG's BlackLevel for the visible block, (2, 2) float64; None where LibRaw is needed for it.

    LibRaw cuts the level to an integer. The rows and columns of BlackLevel count from the active area's corner
    (DNG 1.7, BlackLevel); deltas per row and column enter by their mean, as in LibRaw.
    """
    if pixels is None or not pixels.numbers(TiffTag.BLACK_LEVEL):
        return None
    levels = np.array(pixels.numbers(TiffTag.BLACK_LEVEL), dtype=np.float64)
    shape = pixels.integers(TiffTag.BLACK_LEVEL_REPEAT_DIM) or (1, 1)
    if shape not in ((1, 1), (1, 2), (2, 1), (2, 2)) or levels.size != shape[0] * shape[1]:
        return None
    deltas = [pixels.numbers(tag) for tag in (TiffTag.BLACK_LEVEL_DELTA_H, TiffTag.BLACK_LEVEL_DELTA_V)]
    extra = sum(float(np.mean(delta)) for delta in deltas if delta)
    return np.broadcast_to(levels.reshape(shape), (2, 2)) + extra


def active_area(pixels: Directory | None, sensor: tuple[int, int]) -> Area | None:
    """Return the visible area that a DNG states; LibRaw would make its top even for a Canon, dcraw does not."""
    areas = stated_areas(pixels, TiffTag.ACTIVE_AREA, sensor)
    return areas[0] if areas and min(areas[0].height, areas[0].width) >= 2 else None


def stated_areas(pixels: Directory | None, tag: TiffTag, sensor: tuple[int, int]) -> tuple[Area, ...]:
    """Return the rectangles of `tag`, stored as top, left, bottom, right, that lie on the sensor."""
    edges = () if pixels is None else pixels.integers(tag)
    return tuple(
        Area(top, left, bottom - top, right - left)
        for top, left, bottom, right in zip(*(iter(edges),) * 4, strict=False)
        if 0 <= top < bottom <= sensor[0] and 0 <= left < right <= sensor[1]
    )
