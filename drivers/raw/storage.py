"""Find where raw files store the counts of a frame (`StoredFrame`), and read the structure of CR3 files.

Any bytes give a result or raise `RawDamaged`. CR3 is the format of the EOS R, EOS M50, EOS 250D and later bodies. It is
an ISO base media file of nested boxes, big-endian. A box has its size (32 bits), a type of four letters, and content.
Size 1 means a size of 64 bits after the type, and size 0 means a box up to the end of the file. If a box extends beyond
the end, the file is truncated. Invalid content inside a box is ignored.

Sources: ISO/IEC 14496-12, 4.2 (boxes), 8.7.3 (sample sizes) and 8.7.5 (chunk offsets). The rest has no public standard:
P. Harvey, ExifTool (CanonRaw.pm); L. Clévy, "Describing the Canon Raw v3 (CR3) file format" (structure); LibRaw 0.22
for the content of CDI1 (src/metadata/cr3_parser.cpp) and CMP1 (src/decoders/crx.cpp).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.tiff import Directory, TiffDamaged, TiffTag, read_directories

Extent = tuple[int, int]  # Part of a file: first byte, and number of bytes

LEAST_BITS = 0.25  # Smallest accepted size of compressed counts, bits per photosite; noise alone needs several bits


class RawDamaged(ValueError):
    """The bytes of a raw file are incomplete or inconsistent."""


class RawUnsupported(ValueError):
    """The raw file may be complete, but we cannot read or check its kind of pixels."""


class NotBayer(ValueError):
    """The raw file is not from a sensor with one colour filter per photosite."""


@dataclass(frozen=True)
class Area:
    """A rectangle of photosites: first row and column, counted from 0, and number of rows and columns."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True)
class StoredFrame:
    """Storage of the counts of one frame, as the file describes it.

    - `rows`, `columns`: size of the whole sensor.
    - `extents`: parts of the file that hold the counts, in order.
    - `least_bits`: smallest possible number of stored bits per photosite.
    - `bits`: number of bits of the largest possible count.
    - `lossless`: whether each extent is a lossless JPEG.
    - `spare_rows`: number of rows that LibRaw may add.
    - `directory`: TIFF directory that describes the frame, None if the file is not TIFF.
    """

    rows: int
    columns: int
    extents: tuple[Extent, ...]
    least_bits: float = LEAST_BITS
    bits: int = 16
    lossless: bool = False
    spare_rows: int = 0
    directory: Directory | None = None

    def has_size(self, rows: int, columns: int) -> bool:
        """Return whether LibRaw may return a sensor of this size for this frame."""
        return columns == self.columns and rows in (self.rows, self.rows + self.spare_rows)


def ciff_entries(data: bytes | memoryview) -> dict[int, Extent]:
    """Return the extents of the values in a Canon CRW by tag, also those in inner heaps; empty for other files.

    Source: Canon, CIFF 1.0 revision 4. A heap ends with the offset of its table. Entries of types 0x28 and 0x30 are
    inner heaps.
    """
    if bytes(data[6:14]) != b"HEAPCCDR":
        return {}
    extents: dict[int, Extent] = {}
    heaps = [(struct.unpack_from("<I", data, 2)[0], len(data))]
    for _ in range(64):
        if not heaps:
            break
        start, end = heaps.pop()
        try:
            table = start + struct.unpack_from("<I", data, end - 4)[0]
            (count,) = struct.unpack_from("<H", data, table)
            for number in range(min(count, 127)):
                tag, size, offset = struct.unpack_from("<HII", data, table + 2 + 10 * number)
                if tag & 0xC000 == 0:
                    extents.setdefault(tag, (start + offset, size))
                if tag & 0xF800 in (0x2800, 0x3000) and size >= 6 and start + offset + size <= len(data):
                    heaps.append((start + offset, start + offset + size))
        except struct.error:
            continue
    return extents


MAX_BOXES = 4096  # Most boxes that are read; a real file has about a hundred

_CANON_UUID = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")  # uuid of the box with Canon's metadata
_SAMPLE_ENTRY_HEAD = 82  # Bytes of a CRAW sample entry before its inner boxes (cr3_parser.cpp)
_MAX_SAMPLES = 4096  # Most samples (images) of a track; a file of burst images has a few hundred
_UUID_LENGTH = 16  # Bytes of the uuid at the start of a uuid box (ISO/IEC 14496-12, 4.2)
_TABLE_HEAD = 8  # Bytes of `stsd` before its entries: version, flags and count (ISO/IEC 14496-12, 8.5.2)
_FULL_BOX_HEAD = 4  # Bytes of version and flags in a full box (ISO/IEC 14496-12, 4.2)
_AREA_TABLE_LENGTH = 48  # Bytes of `IAD1` of the full image: six areas of four numbers; for previews it is shorter
_LEFT_BLACK, _UPPER_BLACK = 3, 4  # Indices of the optically black areas in `IAD1` (cr3_parser.cpp)


@dataclass(frozen=True)
class Cr3:
    """Content of a CR3 file.

    - `maker`, `model`: such as ``Canon`` and ``Canon EOS R``; empty if missing.
    - `black`: optically black areas at the left and the top of the full image, in sensor coordinates.
    - `frames`: the raw frames.
    - `exif`: directories of the Exif box, with serial number and lens; empty without this box.
    """

    maker: str = ""
    model: str = ""
    black: tuple[Area, ...] = ()
    exif: tuple[Directory, ...] = ()
    frames: tuple[StoredFrame, ...] = ()


@dataclass(frozen=True)
class _Box:
    box_type: bytes
    start: int
    end: int


def read_cr3(data: bytes | memoryview) -> Cr3:
    """Return the content of a CR3 file."""
    maker = model = ""
    black: tuple[Area, ...] = ()
    exif: tuple[Directory, ...] = ()
    frames: list[StoredFrame] = []
    budget = [MAX_BOXES]
    box_types: set[bytes] = set()
    for box in _boxes(data, 0, len(data), budget, is_file=True):
        box_types.add(box.box_type)
        if box.box_type != b"moov":
            continue
        for inner in _boxes(data, box.start, box.end, budget):
            if inner.box_type == b"uuid" and bytes(data[inner.start : inner.start + _UUID_LENGTH]) == _CANON_UUID:
                for entry in _boxes(data, inner.start + _UUID_LENGTH, inner.end, budget):
                    if entry.box_type == b"CMT1":
                        directories = _directories(data[entry.start : entry.end])
                        names = ((tags.text(TiffTag.MAKE), tags.text(TiffTag.MODEL)) for tags in directories)
                        maker, model = next((pair for pair in names if pair[1]), ("", ""))
                    elif entry.box_type == b"CMT2":
                        exif = _directories(data[entry.start : entry.end])
            elif inner.box_type == b"trak":
                table = _find_box(data, inner, budget, b"mdia", b"minf", b"stbl")
                entry = table and _find_box(data, table, budget, b"stsd", b"CRAW")
                if table is None or entry is None:
                    continue
                black = _black_areas(data, entry, budget) or black
                frames += _track_frames(data, table, entry, budget)
    for box_type, content_name in ((b"moov", "description of its images"), (b"mdat", "images")):
        if box_type not in box_types:
            raise RawDamaged(f"it contains no {content_name} ({box_type.decode('ascii')})")
    return Cr3(maker, model, black, exif, tuple(frames))


def _boxes(
    data: bytes | memoryview, start: int, end: int, budget: list[int], *, is_file: bool = False
) -> Iterator[_Box]:
    """Yield the boxes between two positions; a damaged box ends the iteration, or raises an error if `is_file`."""
    # `budget` holds the number of boxes that may still be read.
    while end - start >= 8:
        budget[0] -= 1
        if budget[0] < 0:
            raise RawDamaged(f"it has more than {MAX_BOXES} boxes, expected about 100")
        size, box_type = struct.unpack_from(">I4s", data, start)
        header_size = 8
        if size == 1 and end - start >= 16:
            (size,) = struct.unpack_from(">Q", data, start + 8)
            header_size = 16
        elif size == 0:
            size = end - start
        if size < header_size or start + size > end:
            if is_file:
                name = box_type.decode("ascii", "replace")
                raise RawDamaged(f"its box {name!r} extends to byte {start + size}, the file has {end} bytes")
            return
        yield _Box(box_type, start + header_size, start + size)
        start += size
    if is_file and start != end:
        raise RawDamaged(f"{end - start} bytes follow its last box, expected 0 or at least 8")


def _directories(content: bytes | memoryview) -> tuple[Directory, ...]:
    try:
        return tuple(read_directories(bytes(content)))
    except TiffDamaged:
        return ()


# Bytes of a box before its inner boxes.
_HEADER_SIZES = {b"stsd": _TABLE_HEAD, b"CRAW": _SAMPLE_ENTRY_HEAD, b"CDI1": _FULL_BOX_HEAD}


def _find_box(data: bytes | memoryview, box: _Box, budget: list[int], *box_types: bytes) -> _Box | None:
    """Return the box that is reached through nested boxes of the given types, or None if one is missing."""
    for box_type in box_types:
        child = next((inner for inner in _boxes(data, box.start, box.end, budget) if inner.box_type == box_type), None)
        if child is None:
            return None
        box = _Box(box_type, min(child.start + _HEADER_SIZES.get(box_type, 0), child.end), child.end)
    return box


def _track_frames(data: bytes | memoryview, table: _Box, entry: _Box, budget: list[int]) -> list[StoredFrame]:
    """Return the frames of a raw track, in which each chunk holds one frame; empty for other tracks."""
    compression = _find_box(data, entry, budget, b"CMP1")
    sizes_box, offsets_box = _find_box(data, table, budget, b"stsz"), _find_box(data, table, budget, b"co64")
    if compression is None or compression.end - compression.start < 16:
        return []
    columns, rows = struct.unpack_from(">II", data, compression.start + 8)
    if sizes_box is None or offsets_box is None:
        raise RawDamaged("a track of its pixels has no sizes (stsz) or offsets (co64)")
    stsz, co64 = (bytes(data[box.start : box.end]) for box in (sizes_box, offsets_box))
    try:
        common_length, count = struct.unpack_from(">II", stsz, 4)
        (chunks,) = struct.unpack_from(">I", co64, 4)
        if not 0 < count == chunks <= _MAX_SAMPLES:
            raise RawDamaged(f"a track of its pixels has {count} samples in {chunks} chunks, expected equal numbers")
        lengths = (common_length,) * count if common_length else struct.unpack_from(f">{count}I", stsz, 12)
        offsets = struct.unpack_from(f">{count}Q", co64, 8)
    except struct.error as error:
        raise RawDamaged("a track of its pixels ends within its tables") from error
    return [StoredFrame(rows, columns, (extent,)) for extent in zip(offsets, lengths, strict=True)]


def _black_areas(data: bytes | memoryview, entry: _Box, budget: list[int]) -> tuple[Area, ...]:
    """Return the optically black areas of a track; empty if it is not the full image."""
    box = _find_box(data, entry, budget, b"CDI1", b"IAD1")
    if box is None:
        return ()
    if box.end - box.start < _AREA_TABLE_LENGTH:
        return ()
    numbers = struct.unpack_from(f">{_AREA_TABLE_LENGTH // 2}H", data, box.start)
    areas: list[Area] = []
    for index in (_LEFT_BLACK, _UPPER_BLACK):
        first_column, first_row, last_column, last_row = numbers[4 * index : 4 * index + 4]
        # The last row and column belong to the area, as in all areas in Canon's files.
        if last_column > first_column and last_row > first_row:
            areas.append(Area(first_row, first_column, last_row - first_row + 1, last_column - first_column + 1))
    return tuple(areas)
