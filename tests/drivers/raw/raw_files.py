"""Creates raw files with any counts: CR2 in Canon's layout, DNG and other TIFF with any tags.

Sources: TIFF 6.0; ITU-T T.81 annex H (lossless JPEG, predictor 1); DNG 1.4; CR2: the fourth directory holds the raw
strip, in slices by tag 50752.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# TIFF tags: code to type, number of values, and bytes of the values.
Tags = dict[int, tuple[int, int, bytes]]


def write_cr2(
    path: Path,
    counts: NDArray[np.uint16],
    model: str,
    iso: int = 100,
    slices: tuple[int, int, int] | None = None,
) -> None:
    """Write the CR2 of `cr2_bytes`."""
    path.write_bytes(cr2_bytes(counts, model, iso, slices))


def cr2_bytes(
    counts: NDArray[np.uint16], model: str, iso: int = 100, slices: tuple[int, int, int] | None = None
) -> bytes:
    """Return a CR2; `counts` is (H, W) uint16 of the whole sensor, W even, below 2**14.

    `slices`: number without the last, width, and width of the last; None for one slice.
    """
    width = counts.shape[1]
    number, each, last = slices or (0, 0, width)
    cuts = [counts[:, n * each : (n + 1) * each] for n in range(number)] + [counts[:, number * each :]]
    strip = lossless_jpeg(np.concatenate([cut.ravel() for cut in cuts]).reshape(counts.shape))
    exif: Tags = {33434: ratios((1, 2)), 33437: ratios((8, 1)), 34855: shorts(iso)}
    directories: list[Tags] = [
        {271: text("Canon"), 272: text(model), 274: shorts(1), 34665: longs(0)},
        {},
        {},
        {259: shorts(6), 273: longs(0), 279: longs(len(strip)), 50752: shorts(number, each, last)},
    ]
    # Header: TIFF, then "CR", version 2.0, and the position of the raw directory.
    starts: list[int] = []
    place = 16
    for tags in (*directories, exif):
        starts.append(place)
        place += len(_directory(tags, 0, 0))
    directories[0][34665] = longs(starts[4])
    directories[3][273] = longs(place)
    links = [starts[1], starts[2], starts[3], 0, 0]
    data = b"II*\0" + struct.pack("<I", 16) + b"CR\x02\0" + struct.pack("<I", starts[3])
    for tags, start, link in zip((*directories, exif), starts, links, strict=True):
        data += _directory(tags, start, link)
    return data + strip


def shorts(*numbers: int) -> tuple[int, int, bytes]:
    """Return the value of a tag of SHORTs."""
    return 3, len(numbers), struct.pack(f"<{len(numbers)}H", *numbers)


def longs(*numbers: int) -> tuple[int, int, bytes]:
    """Return the value of a tag of LONGs."""
    return 4, len(numbers), struct.pack(f"<{len(numbers)}I", *numbers)


def ratios(*numbers: tuple[int, int]) -> tuple[int, int, bytes]:
    """Return the value of a tag of RATIONALs."""
    return 5, len(numbers), b"".join(_rational(*number) for number in numbers)


def text(value: str) -> tuple[int, int, bytes]:
    """Return the value of a tag of ASCII."""
    return 2, len(value) + 1, value.encode() + b"\0"


def write_dng(path: Path, counts: NDArray[np.uint16], more: Tags | None = None, strip: bytes | None = None) -> None:
    """Write the DNG of `dng_bytes`."""
    path.write_bytes(dng_bytes(counts, more, strip))


def dng_bytes(
    counts: NDArray[np.uint16], more: Tags | None = None, strip: bytes | None = None, place: int | None = 273
) -> bytes:
    """Return a DNG of `counts` (H, W) uint16, RGGB unless `more` changes it; uncompressed without `strip`.

    `place`: tag of the position of the pixels; None if `more` has it.
    """
    height, width = counts.shape
    tags: Tags = {
        254: longs(0),
        256: longs(width),
        257: longs(height),
        258: shorts(16),
        259: shorts(1),
        262: shorts(32803),
        277: shorts(1),
        278: longs(height),
        33421: shorts(2, 2),
        33422: (1, 4, b"\0\1\1\2"),
        50706: (1, 4, b"\1\4\0\0"),
        50708: text("CroP Test"),
        50714: shorts(64),
        50717: longs(4095),
        **(more or {}),
    }
    return tiff_bytes(tags, strip or counts.astype("<u2").tobytes(), place_tag=place)


def tiff_bytes(
    tags: Tags, pixels: bytes, magic: bytes = b"II*\0", place_tag: int | None = 273, through: int | None = None
) -> bytes:
    """Return a TIFF of one directory and pixels; `through`: a tag of an outer directory that points to it."""
    tags = {279: longs(len(pixels)), **tags, **({} if place_tag is None else {place_tag: longs(0)})}
    first = b"" if through is None else _directory({through: longs(8 + 18)}, 8, 0)
    start = 8 + len(first)
    if place_tag is not None:
        tags[place_tag] = longs(start + len(_directory(tags, 0, 0)))
    return magic + struct.pack("<I", 8) + first + _directory(tags, start, 0) + pixels


def lossless_jpeg(counts: NDArray[np.uint16]) -> bytes:
    """Return `counts` as Canon stores them: two interleaved components, 14 bits, predictor 1."""
    height, width = counts.shape
    signed = counts.astype(np.int32).reshape(height, width // 2, 2)
    predicted = np.empty_like(signed)
    predicted[:, 1:] = signed[:, :-1]
    predicted[1:, 0] = signed[:-1, 0]
    predicted[0, 0] = 1 << 13
    difference = (signed - predicted).reshape(height, width)
    # Rows with equal differences have the same code and are encoded once, so a whole sensor takes about 1 s.
    alike = bool((difference == difference[0]).all())
    one = (difference[0] if alike else difference).ravel()
    size = np.zeros(one.shape, np.int32)
    for bit in range(14):
        size += np.abs(one) >> bit > 0
    # Sixteen codes of five bits, 0 … 15, so that each category is its own code.
    codes = (size.astype(np.int64) << size) | np.where(one < 0, one + (1 << size) - 1, one)
    bits = _bits(codes, size + 5)
    # Eight rows are whole bytes.
    many = height // 8 if alike else 0
    rest = np.tile(bits, height % 8) if alike else bits
    packed = np.packbits(np.tile(bits, 8)).tobytes() * many if many else b""
    packed += np.packbits(np.concatenate((rest, np.ones(-rest.size % 8, np.uint8)))).tobytes()
    tables = b"".join(bytes([table]) + bytes([0, 0, 0, 0, 16] + [0] * 11) + bytes(range(16)) for table in (0, 1))
    return (
        b"\xff\xd8"
        + _segment(0xC4, tables)
        + _segment(0xC3, struct.pack(">BHHB", 14, height, width // 2, 2) + bytes([1, 0x11, 0, 2, 0x11, 0]))
        + _segment(0xDA, bytes([2, 1, 0x00, 2, 0x10, 1, 0, 0]))
        + packed.replace(b"\xff", b"\xff\x00")
        + b"\xff\xd9"
    )


def _bits(values: NDArray[np.int64], lengths: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the bits of `values`, each with its own length, most significant first."""
    places = np.arange(int(lengths.max()) - 1, -1, -1)
    return (((values[:, None] >> places) & 1).astype(np.uint8))[places < lengths[:, None]]


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def _directory(tags: Tags, at: int, link: int) -> bytes:
    values_at = at + 2 + 12 * len(tags) + 4
    entries, values = struct.pack("<H", len(tags)), b""
    for code, (kind, count, value) in sorted(tags.items()):
        entries += struct.pack("<HHI", code, kind, count)
        if len(value) <= 4:
            entries += value.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(values))
            values += value + bytes(len(value) % 2)
    return entries + struct.pack("<I", link) + values


def _rational(top: int, bottom: int) -> bytes:
    return struct.pack("<II", top, bottom)
