"""PNG (ISO/IEC 15948), 16-bit RGB, its chunks written here."""

from __future__ import annotations

import struct
import zlib
from typing import Final

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from generator.encoders.shot import Shot

LARGEST_CHUNK: Final = 1 << 30
"""Bytes of compressed data in one chunk; the standard allows 2³¹ − 1 (clause 5.3)."""


def encode_png(image: npt.NDArray[np.uint16], shot: Shot) -> bytes:
    """Return the file of `image` (H, W, 3) uint16."""
    height, width, _ = image.shape
    # Every row is led by the number of its filter, 0 for none; samples are big-endian (clauses 7.2 and 9.2).
    rows = np.zeros((height, 1 + 6 * width), np.uint8)
    rows[:, 1:] = np.ascontiguousarray(image, dtype=">u2").view(np.uint8).reshape(height, 6 * width)
    data = zlib.compress(rows.data, 1)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [data[start : start + LARGEST_CHUNK] for start in range(0, len(data), LARGEST_CHUNK)]
    note = b"Description\0" + shot.note().encode("ascii")
    chunks = [_chunk(b"IHDR", head), _chunk(b"tEXt", note), *(_chunk(b"IDAT", part) for part in parts)]
    return b"".join([b"\x89PNG\r\n\x1a\n", *chunks, _chunk(b"IEND", b"")])


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind)))
