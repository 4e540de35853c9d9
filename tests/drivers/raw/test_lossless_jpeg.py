"""Detection of damage inside a lossless JPEG, which LibRaw ignores; complete streams of two encoders are accepted."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.raw.lossless_jpeg import lossless_fault
from drivers.raw.rawfile import read_raw
from foundation.errors import FormatError
from tests.drivers.raw.raw_files import longs, lossless_jpeg, shorts, write_cr2, write_dng

Counts = NDArray[np.uint16]
NOISE: Counts = (2048 + np.random.default_rng(3).poisson(900, (64, 96))).astype(np.uint16)
RAMP: Counts = (1000 + 20 * np.arange(64)[:, None] + np.random.default_rng(4).integers(0, 9, (64, 96))).astype(
    np.uint16
)
FLAT: Counts = np.full((64, 96), 2048, np.uint16)


def by_imagecodecs(counts: Counts) -> bytes:
    """Return the stream of another encoder: one component, Huffman codes of the image."""
    return bytes(imagecodecs.ljpeg_encode(counts, bitspersample=14))


@pytest.mark.slow
@pytest.mark.parametrize("encode", [lossless_jpeg, by_imagecodecs])
@pytest.mark.parametrize("counts", [NOISE, RAMP, FLAT], ids=["noise", "ramp", "flat"])
def test_accepts_complete_streams(counts: Counts, encode: Callable[[Counts], bytes]) -> None:
    stream = encode(counts)
    assert lossless_fault(stream) is None
    # Whole words, or a sector, after the last sample.
    for padding in (bytes(3), b"\xff\xd9" + bytes(500)):
        assert lossless_fault(stream[:-2] + padding) is None


@pytest.mark.parametrize("encode", [lossless_jpeg, by_imagecodecs])
@pytest.mark.parametrize("counts", [NOISE, RAMP], ids=["noise", "ramp"])
def test_detects_zeroed_bytes_anywhere(counts: Counts, encode: Callable[[Counts], bytes]) -> None:
    stream = encode(counts)
    begin = stream.index(b"\xff\xda") + 14
    missed = [
        at
        for at in range(begin, len(stream) - 70, 41)
        if lossless_fault(stream[:at] + bytes(64) + stream[at + 64 :]) is None
    ]
    assert not missed


@pytest.mark.parametrize("cut", [1, 3, 50, 3000])
def test_detects_a_truncated_stream(cut: int) -> None:
    stream = lossless_jpeg(NOISE)
    assert re.search("ends before|no Huffman code", lossless_fault(stream[: -2 - cut]) or "")


def test_detects_extra_bytes() -> None:
    stream = lossless_jpeg(NOISE)
    assert "continues" in (lossless_fault(stream[:-2] + stream[-200:]) or "")


@given(st.integers(0, 400), st.binary(max_size=6))
def test_any_header_gives_no_exception(at: int, words: bytes) -> None:
    stream = lossless_jpeg(NOISE[:4])
    lossless_fault(stream[:at] + words + stream[at + len(words) :])
    lossless_fault(stream[:at])


def test_ignores_other_jpegs() -> None:
    assert lossless_fault(b"") is None
    assert lossless_fault(bytes(imagecodecs.jpeg8_encode(np.zeros((8, 8), np.uint8)))) is None


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"\xff\xd8\xff", b"\xff\xd8\xff\xdd\0\x04\0\x08\xff", "restart intervals"),
        (b"\2\1\0\2\x10\1\0\0", b"\2\1\0\2\x10\1\0\2", "point transform"),
        (b"\2\1\0\2\x10\1\0\0", b"\2\1\0\2\x10\x08\0\0", "invalid header"),
        (b"\2\1\0\2\x10\1\0\0", b"\2\1\0\2\x30\1\0\0", "invalid header"),
        (b"\2\1\0\2\x10\1\0\0", b"\1\1\0\1\0\0\0\0", "invalid header"),
    ],
    ids=["restart", "transform", "predictor", "a table that is not there", "a component that is not there"],
)
def test_refuses_unusual_headers(old: bytes, new: bytes, reason: str) -> None:
    stream = lossless_jpeg(NOISE)
    assert old in stream
    assert reason in (lossless_fault(stream.replace(old, new, 1)) or "")


@pytest.mark.parametrize("predictor", range(1, 8))
def test_predictors_match_the_standard(predictor: int) -> None:
    """T.81, table H.1, in numpy; with a wrong predictor samples exceed their precision."""
    counts = NOISE.astype(np.int64)
    left, up, corner = (np.roll(counts, shift, axes) for shift, axes in (((1), 1), ((1), 0), ((1, 1), (0, 1))))
    predicted = {
        1: left, 2: up, 3: corner, 4: left + up - corner, 5: left + (up - corner >> 1), 6: up + (left - corner >> 1),
        7: left + up >> 1,
    }[predictor].copy()  # fmt: skip
    predicted[0, 1:], predicted[1:, 0], predicted[0, 0] = left[0, 1:], up[1:, 0], 1 << 13
    # Differences of this predictor, encoded like those of predictor 1.
    stream = _stream_of((counts - predicted).ravel(), predictor)
    assert lossless_fault(stream) is None


def _stream_of(differences: NDArray[np.int64], predictor: int) -> bytes:
    rebuilt = lossless_jpeg(NOISE)
    head = rebuilt[: rebuilt.index(b"\xff\xda")]
    size = np.ceil(np.log2(np.abs(differences) + 1)).astype(int)
    bits = "".join(
        f"{number:05b}" + (f"{value if value > 0 else value + (1 << number) - 1:0{number}b}" if number else "")
        for number, value in zip(size.tolist(), differences.tolist(), strict=True)
    )
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    frame = head.index(b"\xff\xc3")
    one = head[:frame] + b"\xff\xc3" + struct.pack(">HBHHB", 11, 14, *NOISE.shape, 1) + bytes([1, 0x11, 0])
    scan = b"\xff\xda" + struct.pack(">H", 8) + bytes([1, 1, 0x00, predictor, 0, 0])
    return one + scan + data + b"\xff\xd9"


def test_refuses_files_with_a_damaged_stream(tmp_path: Path) -> None:
    strip = lossless_jpeg(np.tile(NOISE, (4, 4)))
    write_dng(
        tmp_path / "a.dng", np.tile(NOISE, (4, 4)), {259: shorts(7), 258: shorts(14), 279: longs(len(strip))}, strip
    )
    write_cr2(tmp_path / "a.cr2", np.tile(NOISE, (4, 4)), "Canon EOS 550D")
    for name in ("a.dng", "a.cr2"):
        path = tmp_path / name
        data = path.read_bytes()
        read_raw(path)
        middle = len(data) // 2
        path.write_bytes(data[:middle] + bytes(64) + data[middle + 64 :])
        with pytest.raises(FormatError, match="lossless JPEG is damaged"):
            read_raw(path)
