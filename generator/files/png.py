"""PNG (ISO/IEC 15948), 16-bit RGB, its chunks written here around `deflate`.

A chunk of data holds a band of rows, so that an image of any size needs little memory beside its file, and several
threads may work on one image. Values are the image's own: no gAMA, cICP or iCCP chunk, since camera RGB is no display's
and some readers would convert, and no sBIT, since values lie at the lower end of the 16 bits. What is known of the
image stands in a tEXt chunk.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from foundation.errors import InputError
from generator.files.deflate import WIDEST, Packer
from generator.files.metadata import ImageMetadata

SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
"""The first bytes of every PNG file (clause 5.2)."""
BAND: Final = 1 << 18
"""Most pixels of a band, unless a row has more: 1.5 MiB, so that an image of any size needs little memory."""
TALLEST: Final = (1 << 31) - 1
"""Largest size in the format (clause 11.2.2)."""

_ZLIB: Final = bytes([0x78, 0x01])
"""Deflate, a window of 32 KiB, packed fast (RFC 1950, 2.2)."""
_ADLER: Final = 65521
"""The modulus of Adler-32, the largest prime below 2¹⁶ (RFC 1950, 8.2)."""

_threads = threading.local()
"""Each thread's packer, with its working memory."""


def encode_png(image: npt.NDArray[np.uint16], metadata: ImageMetadata, threads: int = 1) -> bytes:
    """Return the file of `image` (H, W, 3) uint16; no byte depends on the number of threads."""
    return b"".join([bytes(piece) for piece in png_pieces(image, metadata, threads)])


def png_pieces(
    image: npt.NDArray[np.uint16], metadata: ImageMetadata, threads: int = 1
) -> Iterator[bytes | memoryview]:
    """Yield the file of `image` (H, W, 3) uint16 piece by piece; the memory of each is used again for the next."""
    height, width, _ = image.shape
    if width > WIDEST or height > TALLEST:
        raise InputError(
            f"an image of {width}x{height} px is too large for PNG: {WIDEST} columns and {TALLEST} rows at most; "
            "make it smaller"
        )
    yield SIGNATURE
    yield from chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0))
    yield from chunk(b"tEXt", b"Description\0" + metadata.to_json().encode("ascii"))
    rows = max(1, BAND // width)
    tops = range(0, height, rows)
    total = 1
    for number, (data, checksum, size) in enumerate(_bands(image, rows, tops, threads)):
        total = _joined(total, checksum, size)
        start = b"" if number else _ZLIB
        end = struct.pack(">I", total) if number == len(tops) - 1 else b""
        yield from chunk(b"IDAT", start, data, end)
    yield from chunk(b"IEND")


def _bands(
    image: npt.NDArray[np.uint16], rows: int, tops: range, threads: int
) -> Iterator[tuple[bytes | memoryview, int, int]]:
    """Yield the packed data of each band, and the checksum and size of what it unpacks to."""

    def pack(top: int) -> tuple[memoryview, int, int]:
        data, plain = _packer().pack(np.ascontiguousarray(image[top : top + rows]), last=top + rows >= len(image))
        checksum = int(isal_zlib.adler32(plain.data))  # pyright: ignore  # its stub leaves the function out
        return data.data, checksum, plain.size

    def keep(top: int) -> tuple[bytes, int, int]:
        data, checksum, size = pack(top)
        return bytes(data), checksum, size

    if threads > 1 and len(tops) > 1:
        with ThreadPoolExecutor(threads) as pool:
            yield from pool.map(keep, tops)
    else:
        yield from map(pack, tops)


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


def chunk(kind: bytes, *parts: bytes | memoryview) -> Iterator[bytes | memoryview]:
    """Yield the pieces of a chunk (clause 5.3)."""
    checksum = isal_zlib.crc32(kind)
    for part in parts:
        checksum = isal_zlib.crc32(part, checksum)
    yield struct.pack(">I", sum(len(part) for part in parts)) + kind
    yield from filter(None, parts)
    yield struct.pack(">I", checksum)


def decode_png(data: bytes) -> npt.NDArray[np.generic]:
    """Return what a PNG holds, (H, W) or (H, W, channels), RGB, uint8 or uint16, as it stands there."""
    import cv2

    # OpenCV would read other formats, too.
    found = None
    if data.startswith(SIGNATURE):
        found = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise ValueError("no whole PNG file")
    if found.ndim == 2:
        return found
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB if found.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
