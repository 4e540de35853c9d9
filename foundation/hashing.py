"""SHA-256 of files and of what is written to a stream (FIPS 180-4), always as 64 lowercase hexadecimal digits."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any, BinaryIO, Final

_BLOCK: Final = 1 << 20
"""Bytes read at a time: a block stays in the processor's second cache."""


def sha256_of(data: Any) -> str:
    """Return the SHA-256 of `data`: bytes, or an object with a contiguous buffer such as a C-ordered array."""
    return hashlib.sha256(data).hexdigest()


def stream_sha256(stream: BinaryIO) -> str:
    """Return the SHA-256 of what is left to read of an open file."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK):
        digest.update(block)
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return stream_sha256(stream)


class HashingWriter(io.RawIOBase):
    """A stream that is written in order, hashed and counted meanwhile.

    `stream`: takes all bytes of every write, as a buffered file does; it is not closed by this one.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._digest = hashlib.sha256()
        self._written = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes, or an object with a contiguous buffer; return the number of bytes."""
        size = memoryview(data).nbytes
        self._digest.update(data)
        self._stream.write(data)
        self._written += size
        return size

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._written

    @property
    def sha256(self) -> str:
        """Hash of all that was written so far."""
        return self._digest.hexdigest()
