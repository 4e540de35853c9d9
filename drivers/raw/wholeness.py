"""Whether a raw file can hold the frame that it claims, and whether a frame was filled up where bytes were lost.

Rules that hold inside:

- Pure functions of bytes and counts that return a reason in words, or None. Nothing is repaired.
- LibRaw reads behind a file's end as zeros or ones without a word. So what a file says of itself is held against its
  bytes first, and what came out against its black level.

Sources: TIFF 6.0 (strips), TIFF technical note 1 and DNG 1.7.1 (tiles). Where the pixels of an RW2 (tag 0x118) and of a
RAF (byte 100) begin is as ExifTool's tables of tags describe it (RawDataOffset; the header of RAF files).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.tiff import Directory, TiffTag

_LEAST_BITS = 0.25
"""Bits for each photosite below which no codec of a maker's puts a frame: lossless JPEG spends one on each at least
(ITU-T T.81, annex H), and noise takes several. Chosen."""

_UNCOMPRESSED, _DEFLATE = 1, (8, 32946)
"""Compression (TIFF 6.0; DNG 1.7.1, chapter 3; 32946: Adobe's number of old)."""

_LEAST_BLACK = 16
"""Counts of black from which on a photosite that is far below it is none; cameras without such a level cut at zero."""

_TILE = (32, 256)
"""Rows and columns of the smallest part that is looked at: the least that is stored by itself."""


def extents_fault(data: bytes | memoryview, pixels: Directory, *, dng: bool) -> str | None:
    """Return why the strips and tiles of the raw pixels cannot be those of a whole file; None where they can.

    `data`: the file's bytes; `dng`: whether what it states of compression and bits is what the standard means by it.
    """
    for places, sizes in (
        (TiffTag.STRIP_OFFSETS, TiffTag.STRIP_BYTE_COUNTS),
        (TiffTag.TILE_OFFSETS, TiffTag.TILE_BYTE_COUNTS),
    ):
        numbers = len(pixels.integers(places)), len(pixels.integers(sizes))
        if numbers[0] != numbers[1]:
            return f"it states {numbers[0]} places of its pixels and {numbers[1]} sizes"
    extents = sorted(pixels.extents())
    for offset, size in extents:
        if offset < 0 or size <= 0 or offset + size > len(data):
            return f"its pixels reach from byte {offset} to {offset + size}, and it has only {len(data)}"
    for (first, size), (following, _) in pairwise(extents):
        if first + size > following:
            return f"parts of its pixels lie upon each other, at byte {following}"
    bits = pixels.integers(TiffTag.BITS_PER_SAMPLE)
    photosites = _first(pixels, TiffTag.IMAGE_WIDTH) * _first(pixels, TiffTag.IMAGE_LENGTH)
    plain = dng and pixels.integers(TiffTag.COMPRESSION) == (_UNCOMPRESSED,)
    least = max(bits, default=0) if plain else _LEAST_BITS
    return _too_few(sum(size for _, size in extents), photosites, least) if extents else None


def is_deflated(pixels: Directory) -> bool:
    """Return whether raw pixels are compressed by Deflate, as DNG of floating point are."""
    return any(number in _DEFLATE for number in pixels.integers(TiffTag.COMPRESSION))


def size_fault(data: bytes | memoryview, directories: Sequence[Directory], photosites: int) -> str | None:
    """Return why so many `photosites` cannot lie in a file, of whatever maker; None where they can.

    `data`: the file's bytes. Directories that describe that many photosites must have their bytes in the file.
    """
    fault = _too_few(len(data), photosites, _LEAST_BITS)
    if fault is not None:
        return fault
    start = _start(data, directories)
    if start is not None:
        return _too_few(max(len(data) - start, 0), photosites, _LEAST_BITS)
    for directory in directories:
        area = _first(directory, TiffTag.IMAGE_WIDTH) * _first(directory, TiffTag.IMAGE_LENGTH)
        # Previews are smaller by far; a sensor's borders are not always counted.
        if 2 * area >= photosites and directory.extents():
            inside = sum(max(min(offset + size, len(data)) - offset, 0) for offset, size in directory.extents())
            fault = _too_few(inside, photosites, _LEAST_BITS)
            if fault is not None:
                return fault
    return None


def _start(data: bytes | memoryview, directories: Sequence[Directory]) -> int | None:
    """Return the byte from which on the pixels of an RW2 or a RAF lie; None for other files."""
    if bytes(data[:4]) == b"IIU\0":
        return next((place[0] for one in directories if (place := one.integers(TiffTag.RW2_PIXELS))), None)
    if bytes(data[:8]) == b"FUJIFILM" and len(data) >= 104:
        return int(struct.unpack_from(">I", data, 100)[0])
    return None


def _too_few(size: int, photosites: int, least_bits: float) -> str | None:
    if 8 * size >= photosites * least_bits:
        return None
    return f"it holds {size} bytes of pixels for {photosites} photosites, at least {least_bits:g} bits each expected"


def _first(directory: Directory, tag: TiffTag) -> int:
    return next(iter(directory.integers(tag)), 0)


def filled_fault(counts: NDArray[np.uint16], black: NDArray[np.float64]) -> str | None:
    """Return which part of a frame is no exposure, as of a file that was cut and filled with zeros; None if none is.

    `counts`: (H, W) of the visible area; `black`: (2, 2) counts. A row, or a tile of 32×256, in which no photosite
    reaches half of the black level is none that a sensor gives, whose dark is that level and noise about it.
    """
    level = float(black.min())
    if level < _LEAST_BLACK:
        return None
    rows = np.flatnonzero(counts.max(axis=1) < level / 2)
    if rows.size:
        what = f"{rows.size} of its {counts.shape[0]} rows, from row {rows[0]}"
    else:
        height, width = (min(side, size) for side, size in zip(_TILE, counts.shape, strict=True))
        bands = np.maximum.reduceat(counts, range(0, counts.shape[0] - height + 1, height), axis=0)
        tiles = np.maximum.reduceat(bands, range(0, counts.shape[1] - width + 1, width), axis=1)
        low = np.argwhere(tiles < level / 2)
        if not low.size:
            return None
        what = f"{len(low)} parts of {height}×{width}, from row {low[0][0] * height}, column {low[0][1] * width},"
    return f"{what} do not reach half of its black level of {level:g} counts, as where a cut file was filled with zeros"
