"""SHA-256 of bytes, files and streams, against the published examples."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from foundation.files import HashingWriter, file_sha256, sha256_of, stream_sha256

ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
"""Of the bytes abc (FIPS 180-4, NIST's example values)."""
NOTHING = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_bytes_and_arrays_have_the_hash_of_their_memory() -> None:
    assert sha256_of(b"abc") == ABC
    assert sha256_of(b"") == NOTHING
    assert sha256_of(np.frombuffer(b"abc", dtype=np.uint8)) == ABC
    assert sha256_of(np.array([[0x6261]], dtype="<u2")) == sha256_of(b"ab")


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


def test_a_stream_is_hashed_from_where_it_stands() -> None:
    stream = io.BytesIO(b"xyabc")
    stream.seek(2)
    assert stream_sha256(stream) == ABC


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


def test_an_archive_can_be_written_through_it() -> None:
    stream = io.BytesIO()
    writer = HashingWriter(stream)
    with zipfile.ZipFile(writer, "w") as archive:
        archive.writestr("a.txt", "abc")
    assert writer.sha256 == sha256_of(stream.getvalue())
    assert zipfile.ZipFile(stream).read("a.txt") == b"abc"
