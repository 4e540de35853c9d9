"""SHA-256 of bytes, files and streams, against the published examples."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np
import pytest

from foundation.files import HashingWriter, file_sha256, sha256_of

ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
"""Of the bytes abc (FIPS 180-4, NIST's example values)."""
NOTHING = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_an_array_that_does_not_lie_in_one_piece_is_refused() -> None:
    with pytest.raises(ValueError, match="contiguous"):
        sha256_of(np.arange(10, dtype=np.uint8)[::2])


def test_a_file_of_several_blocks(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(data)
    assert file_sha256(tmp_path / "a") == hashlib.sha256(data).hexdigest()
    (tmp_path / "b").touch()
    assert file_sha256(tmp_path / "b") == NOTHING
    with pytest.raises(FileNotFoundError):
        file_sha256(tmp_path / "c")


def test_what_is_written_is_hashed_counted_and_passed_on() -> None:
    stream = io.BytesIO()
    writer = HashingWriter(stream)
    assert (writer.write(b"a"), writer.write(memoryview(b"bc"))) == (1, 2)
    assert (writer.tell(), writer.sha256, stream.getvalue()) == (3, ABC, b"abc")


def test_an_array_counts_by_its_bytes() -> None:
    stream = io.BytesIO()
    writer = HashingWriter(stream)
    numbers = np.arange(6, dtype="<u2").reshape(2, 3)
    assert writer.write(numbers) == 12
    assert (writer.tell(), stream.getvalue()) == (12, numbers.tobytes())
    assert writer.sha256 == sha256_of(numbers)
