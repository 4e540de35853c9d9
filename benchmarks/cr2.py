"""Raw files of the layout of an EOS 550D's CR2, for measurements: what reading one costs, no camera can be asked here.

Four directories as Canon writes them: a picture for the card's display, a thumbnail, an RGB preview, and the sensor:
lossless JPEG of two components, 14 bits, predictor 1, cut into upright slices. The pictures that nobody here looks at
hold noise of a plausible size, so that the file is as large as a camera's.

Sources: ITU-T T.81 (1992), annex H and clauses B, F.1.2, K.3.1, for lossless JPEG; L. Clevy, "Inside the Canon RAW format
version 2" (lclevy.free.fr/cr2) for directories, slices and the order of samples; TIFF 6.0 section 2.
"""

from __future__ import annotations

import struct
from datetime import datetime
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from drivers.camera import ExposureSettings
from foundation.compiled import compiled
from sim.world.sensors import Body

SLICES = (2, 1728, 1888)
"""Widths of an EOS 550D's slices: two of the first, one of the last; together its 5344 columns."""

PREVIEW_BYTES = 4_900_000
"""Of the picture for the card's display: twice what it is in a camera, so that the file has the 25 MB of a 550D's."""

_DIFFERENCES = 15
"""Categories of differences of 14-bit counts: of 0 … 14 bits (T.81, table H.2)."""


def encode_cr2(
    counts: npt.NDArray[np.uint16], body: Body, *, settings: ExposureSettings, taken_at: datetime, serial: str
) -> bytes:
    """Return a CR2 file.

    Parameters
    ----------
    counts
        (3516, 5344) uint16 below 2**14, the whole sensor's counts.
    body
        Whose file it is.
    settings
        How the frame was exposed.
    taken_at
        When.
    serial
        Serial number of the body, decimal digits.
    """
    pixels = _lossless_jpeg(_sliced(counts))
    noise = np.random.default_rng(1).integers(0, 255, PREVIEW_BYTES, dtype=np.uint8).tobytes()
    preview = b"\xff\xd8" + noise + b"\xff\xd9"
    shutter = Fraction(settings.shutter_s).limit_denominator(10_000)
    aperture = Fraction(settings.aperture).limit_denominator(100)
    stamp = taken_at.strftime("%Y:%m:%d %H:%M:%S").encode() + b"\0"
    model = body.model.encode() + b"\0"
    notes = _directory(
        [
            (0x0006, 2, model),
            (0x000C, 4, struct.pack("<I", int(serial))),
            (0x0010, 4, struct.pack("<I", 0x80000270)),
        ],
        0,
    )
    exif_values = [
        (0x829A, 5, struct.pack("<II", *shutter.as_integer_ratio())),
        (0x829D, 5, struct.pack("<II", *aperture.as_integer_ratio())),
        (0x8827, 3, struct.pack("<H", settings.iso)),
        (0x9003, 2, stamp),
        (0x927C, 7, notes),
    ]
    rows, columns = counts.shape
    shown = [(0x0100, 3, struct.pack("<H", 5184)), (0x0101, 3, struct.pack("<H", 3456))]

    def laid_out(exif_at: int, second: int, third: int, raw: int, preview_at: int, pixels_at: int) -> list[bytes]:
        main = [
            *shown,
            (0x0102, 3, struct.pack("<HHH", 8, 8, 8)),
            (0x0103, 3, struct.pack("<H", 6)),
            (0x010F, 2, body.maker.encode() + b"\0"),
            (0x0110, 2, model),
            (0x0111, 4, struct.pack("<I", preview_at)),
            (0x0112, 3, struct.pack("<H", 1)),
            (0x0117, 4, struct.pack("<I", len(preview))),
            (0x0132, 2, stamp),
            (0x8769, 4, struct.pack("<I", exif_at)),
        ]
        thumbnail = [(0x0201, 4, struct.pack("<I", preview_at)), (0x0202, 4, struct.pack("<I", 15_000))]
        small = [
            (0x0100, 3, struct.pack("<H", 64)),
            (0x0101, 3, struct.pack("<H", 64)),
            (0x0102, 3, struct.pack("<HHH", 8, 8, 8)),
            (0x0103, 3, struct.pack("<H", 1)),
            (0x0106, 3, struct.pack("<H", 2)),
            (0x0111, 4, struct.pack("<I", preview_at)),
            (0x0115, 3, struct.pack("<H", 3)),
            (0x0116, 3, struct.pack("<H", 64)),
            (0x0117, 4, struct.pack("<I", 64 * 64 * 3)),
        ]
        sensor = [
            (0x0103, 3, struct.pack("<H", 6)),
            (0x0111, 4, struct.pack("<I", pixels_at)),
            (0x0117, 4, struct.pack("<I", len(pixels))),
            (0xC5D8, 4, struct.pack("<I", 1)),
            (0xC5E0, 4, struct.pack("<I", 3)),
            (0xC640, 3, struct.pack("<HHH", *SLICES)),
            (0xC6C5, 4, struct.pack("<I", 1)),
        ]
        first = _directory(main, 16, second)
        return [
            first,
            _directory(exif_values, exif_at),
            _directory(thumbnail, second, third),
            _directory(small, third, raw),
            _directory(sensor, raw),
        ]

    sizes = [len(part) for part in laid_out(0, 0, 0, 0, 0, 0)]
    ends = [16 + sum(sizes[: n + 1]) for n in range(len(sizes))]
    preview_at = ends[-1]
    pixels_at = preview_at + len(preview)
    parts = laid_out(ends[0], ends[1], ends[2], ends[3], preview_at, pixels_at)
    header = struct.pack("<2sHI2sBBI", b"II", 42, 16, b"CR", 2, 0, ends[3])
    assert counts.shape == (rows, columns)
    return b"".join([header, *parts, preview, pixels])


def _directory(tags: list[tuple[int, int, bytes]], at: int, following: int = 0) -> bytes:
    """Return a TIFF directory at byte `at`: tag, type and bytes of each value, and the place of the next directory."""
    sizes = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1}
    entries, values = struct.pack("<H", len(tags)), b""
    values_at = at + 2 + 12 * len(tags) + 4
    for code, kind, value in sorted(tags):
        entries += struct.pack("<HHI", code, kind, len(value) // sizes[kind])
        if len(value) <= 4:
            entries += value.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(values))
            values += value + bytes(len(value) % 2)
    return entries + struct.pack("<I", following) + values


def _sliced(counts: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return the counts in the order of their slices, in rows of the sensor's width."""
    number, width, last = SLICES
    cuts = [counts[:, n * width : (n + 1) * width] for n in range(number)]
    cuts.append(counts[:, number * width : number * width + last])
    return np.concatenate([cut.ravel() for cut in cuts]).reshape(counts.shape)


def _lossless_jpeg(samples: npt.NDArray[np.uint16]) -> bytes:
    """Return lossless JPEG of rows of two interleaved components."""
    rows, columns = samples.shape
    categories = _categories(samples)
    lengths, codes, listed = _code_table(categories)
    table = bytes(listed[0]) + bytes(listed[1])
    head = b"\xff\xd8"
    head += struct.pack(">HHB", 0xFFC4, 3 + len(table), 0) + table
    frame = struct.pack(">BHHB", 14, rows, columns // 2, 2) + bytes([1, 0x11, 0, 2, 0x11, 0])
    head += struct.pack(">HH", 0xFFC3, 2 + len(frame)) + frame
    scan = bytes([2, 1, 0, 2, 0, 1, 0, 0])
    head += struct.pack(">HH", 0xFFDA, 2 + len(scan)) + scan
    out = np.empty(samples.size * 5, dtype=np.uint8)
    size = _entropy_coded(samples, lengths, codes, out)
    return head + out[:size].tobytes() + b"\xff\xd9"


def _code_table(
    numbers: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], tuple[list[int], list[int]]]:
    """Return lengths and codes by category, and the table as a file has it; shorter codes for frequent categories."""
    order = np.argsort(-numbers, kind="stable")
    # Lengths 2, 2, 3, 4 … 14, 14: a prefix code whatever the numbers are, near the best one for photographs.
    sorted_lengths = [2, 2, 3, *range(4, 16)][:_DIFFERENCES]
    lengths, codes = np.zeros(_DIFFERENCES, np.int64), np.zeros(_DIFFERENCES, np.int64)
    code, before = 0, sorted_lengths[0]
    for length, category in zip(sorted_lengths, order, strict=True):
        code <<= length - before
        lengths[category], codes[category], before = length, code, length
        code += 1
    counts = [sorted_lengths.count(length) for length in range(1, 17)]
    return lengths, codes, (counts, [int(category) for category in order])


@compiled
def _difference(samples: npt.NDArray[np.uint16], row: int, column: int) -> int:  # pragma: no cover
    """Return a sample minus its prediction: the one before of its component, at a row's start the one above."""
    if column >= 2:
        predicted = np.int64(samples[row, column - 2])
    elif row > 0:
        predicted = np.int64(samples[row - 1, column])
    else:
        predicted = np.int64(1 << 13)
    return np.int64(samples[row, column]) - predicted


@compiled
def _bits(value: int) -> int:  # pragma: no cover
    """Return how many bits a magnitude has."""
    bits = 0
    while value:
        value >>= 1
        bits += 1
    return bits


@compiled
def _categories(samples: npt.NDArray[np.uint16]) -> npt.NDArray[np.int64]:  # pragma: no cover
    """Return how many differences there are of each category."""
    found = np.zeros(15, np.int64)
    for row in range(samples.shape[0]):
        for column in range(samples.shape[1]):
            found[_bits(abs(_difference(samples, row, column)))] += 1
    return found


@compiled
def _entropy_coded(
    samples: npt.NDArray[np.uint16],
    lengths: npt.NDArray[np.int64],
    codes: npt.NDArray[np.int64],
    out: npt.NDArray[np.uint8],
) -> int:  # pragma: no cover
    """Write the coded differences to `out`, a zero behind each byte of ones; return how many bytes there are."""
    size, held, waiting = 0, np.int64(0), 0
    for row in range(samples.shape[0]):
        for column in range(samples.shape[1]):
            difference = _difference(samples, row, column)
            category = _bits(abs(difference))
            tail = difference if difference >= 0 else difference + (1 << category) - 1
            held = (held << (lengths[category] + category)) | (codes[category] << category) | tail
            waiting += lengths[category] + category
            while waiting >= 8:
                waiting -= 8
                byte = (held >> waiting) & 0xFF
                out[size] = byte
                size += 1
                if byte == 0xFF:
                    out[size] = 0
                    size += 1
            held &= (np.int64(1) << waiting) - 1
    if waiting:
        # The rest of the last byte is of ones (T.81, F.1.2.3).
        byte = ((held << (8 - waiting)) | ((1 << (8 - waiting)) - 1)) & 0xFF
        out[size] = byte
        size += 1
        if byte == 0xFF:
            out[size] = 0
            size += 1
    return size
