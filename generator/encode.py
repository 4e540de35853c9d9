"""A 16-bit linear image as the bytes of a file, losslessly.

PNG (ISO/IEC 15948) is written here, without row filters: the triples of a table repeat, which the compressor sees only
where no filter has mixed neighbours, so files are a tenth to a fifth smaller than with the usual filter. Compressing is
most of the time that a dataset takes; `_compress` is the one place to make faster. TIFF is written uncompressed, which
every reader can read, and is the fast choice.
"""

from __future__ import annotations

import struct
import zlib
from typing import Final, Literal

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import InputError

Format = Literal["png", "tiff"]
LARGEST_CHUNK: Final = 1 << 30
"""Bytes of compressed data in one PNG chunk; the standard allows 2³¹ − 1 (clause 5.3)."""


def encode_image(image: npt.NDArray[np.uint16], form: Format = "png") -> bytes:
    """Return `image` (H, W, 3) uint16, RGB, as the bytes of a 16-bit file.

    Raises
    ------
    InputError
        The image is not of that shape and type, or too large for the format.
    """
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image is {image.dtype} {image.shape}, expected uint16 (height, width, 3)")
    if form == "png":
        return _png(image)
    return _by_opencv(".tiff", image, [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE])


def encode_preview(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return `picture` (H, W, 3) uint8, RGB, as the bytes of a JPEG file of quality 92."""
    return _by_opencv(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])


def _png(image: npt.NDArray[np.uint16]) -> bytes:
    height, width, _ = image.shape
    # Every row is led by the number of its filter, 0 for none; samples are big-endian (clauses 7.2 and 9.2).
    rows = np.zeros((height, 1 + 6 * width), np.uint8)
    rows[:, 1:] = np.ascontiguousarray(image, dtype=">u2").view(np.uint8).reshape(height, 6 * width)
    data = _compress(rows)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [data[start : start + LARGEST_CHUNK] for start in range(0, len(data), LARGEST_CHUNK)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [_chunk(b"IHDR", head), *(_chunk(b"IDAT", part) for part in parts), _chunk(b"IEND", b"")]
    )


def _compress(rows: npt.NDArray[np.uint8]) -> bytes:
    """Return a zlib stream of `rows`; releases the interpreter's lock."""
    return zlib.compress(rows.data, 1)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))


def _by_opencv(suffix: str, image: npt.NDArray[np.uint16] | npt.NDArray[np.uint8], options: list[int]) -> bytes:
    size = f"{image.shape[1]}x{image.shape[0]}"
    try:
        done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    except cv2.error as error:
        raise InputError(f"an image of {size} px cannot be written as {suffix}: {error}") from error
    if not done:
        raise InputError(f"an image of {size} px cannot be written as {suffix}")
    return data.tobytes()
