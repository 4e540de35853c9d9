"""PNG (ISO/IEC 15948), 16-bit RGB, its chunks written here around `deflate`.

A chunk of data holds a band of rows, so that an image of any size needs little memory beside its file, and several
threads may work on one image. Values are the image's own: no gAMA, cICP or iCCP chunk, since camera RGB is no display's
and some readers would convert, and no sBIT, since values lie at the lower end of the 16 bits. What is known of the
image stands in a tEXt chunk.
"""

from __future__ import annotations

import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from drivers.errors import InputError
from generator.encoders.deflate import WIDEST, Packer
from generator.encoders.shot import Shot

BAND: Final = 1 << 18
"""Pixels that a band has at most, unless a row has more."""
TALLEST: Final = (1 << 31) - 1
"""Largest size in the format (clause 11.2.2)."""

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_ZLIB: Final = bytes([0x78, 0x01])
"""Deflate, a window of 32 KiB, packed fast (RFC 1950, 2.2)."""
_ADLER: Final = 65521

_threads = threading.local()


def encode_png(image: npt.NDArray[np.uint16], shot: Shot, threads: int = 1) -> bytes:
    """Return the file of `image` (H, W, 3) uint16; no byte depends on the number of threads.

    Raises
    ------
    InputError
        The image is wider or higher than a PNG may be.
    """
    height, width, _ = image.shape
    if width > WIDEST or height > TALLEST:
        raise InputError(
            f"an image of {width}x{height} px is too large for PNG: {WIDEST} columns and {TALLEST} rows at most; "
            "make it smaller"
        )
    rows = max(1, BAND // width)
    tops = range(0, height, rows)

    def pack(top: int) -> tuple[bytes, int, int]:
        data, plain = _packer().pack(np.ascontiguousarray(image[top : top + rows]), last=top + rows >= height)
        return data, isal_zlib.adler32(plain.data), plain.size

    if threads > 1 and len(tops) > 1:
        with ThreadPoolExecutor(threads) as pool:
            bands = list(pool.map(pack, tops))
    else:
        bands = [pack(top) for top in tops]
    total = 1
    chunks: list[bytes] = []
    for number, (data, checksum, size) in enumerate(bands):
        total = _joined(total, checksum, size)
        start = b"" if number else _ZLIB
        end = struct.pack(">I", total) if number == len(bands) - 1 else b""
        chunks += _chunk(b"IDAT", start, data, end)
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0))
    note = _chunk(b"tEXt", b"Description\0" + shot.note().encode("ascii"))
    return b"".join([_SIGNATURE, *head, *note, *chunks, *_chunk(b"IEND")])


def _packer() -> Packer:
    """Return the calling thread's own packer."""
    if not hasattr(_threads, "packer"):
        _threads.packer = Packer()
    return _threads.packer


def _joined(first: int, second: int, size: int) -> int:
    """Return the Adler-32 of two pieces of data from that of each, `size` the bytes of the second (RFC 1950, 8.2)."""
    low = ((first & 0xFFFF) + (second & 0xFFFF) - 1) % _ADLER
    high = ((first >> 16) + (second >> 16) + ((first & 0xFFFF) - 1) * size) % _ADLER
    return high << 16 | low


def _chunk(kind: bytes, *parts: bytes) -> list[bytes]:
    """Return the pieces of a chunk (clause 5.3)."""
    checksum = isal_zlib.crc32(kind)
    for part in parts:
        checksum = isal_zlib.crc32(part, checksum)
    size = sum(len(part) for part in parts)
    return [struct.pack(">I", size), kind, *parts, struct.pack(">I", checksum)]
