"""Where raw files keep the photosites of a frame: what every kind of file says of it, and CR3, which is no TIFF.

What says it is a `Stored`; `drivers.raw.rawfile` reads those of TIFF files, a DNG's among them. Every byte sequence
whatever ends in frames or `RawDamaged`. A CR3 (EOS R, EOS M50, EOS 250D and later) is an ISO base media file: boxes in
boxes, each a size of 32 bits (1: of 64 bits, behind the type; 0: up to the end), a type of four letters, and content;
big-endian. One that reaches beyond the file's end betrays a cut; what is inside a box and makes no sense is left out.

Sources: ISO/IEC 14496-12, 4.2 (boxes), 8.7.3 (sizes of samples) and 8.7.5 (places of chunks). For the rest, of which
there is no public standard: P. Harvey, ExifTool (CanonRaw.pm); L. Clévy, "Describing the Canon Raw v3 (CR3) file
format" (structure); and LibRaw 0.22 for what CDI1 holds (src/metadata/cr3_parser.cpp) and CMP1 (src/decoders/crx.cpp).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.tiff import Directory, TiffDamaged, TiffTag, read_directories

Extent = tuple[int, int]  # First byte, and how many

# Bits for each photosite below which no codec of a maker's puts a frame, since noise takes several. Chosen.
LEAST_BITS = 0.25


class RawDamaged(ValueError):
    """The bytes are not all there, or contradict each other."""


class RawUnsupported(ValueError):
    """It may be whole, but pixels of this kind cannot be read, or not be checked."""


class NotBayer(ValueError):
    """Its pixels are not those of a sensor with one colour filter each."""


@dataclass(frozen=True)
class Area:
    """A rectangle of photosites: first row and column, counted from 0, and how many of each."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True)
class Stored:
    """The photosites of one frame as a file says that they are stored.

    - `rows`, `columns`: of the whole sensor.
    - `extents`: their bytes, in order.
    - `least_bits`: bits that a photosite takes at least.
    - `bits`: how many the largest count may have.
    - `lossless`: whether each extent is a lossless JPEG, which can be decoded to its end.
    - `spare_rows`: how many rows more LibRaw may make of it.
    - `directory`: what describes it in a TIFF file.
    """

    rows: int
    columns: int
    extents: tuple[Extent, ...]
    least_bits: float = LEAST_BITS
    bits: int = 16
    lossless: bool = False
    spare_rows: int = 0
    directory: Directory | None = None

    def holds(self, rows: int, columns: int) -> bool:
        """Return whether that is the size of the sensor as LibRaw would make it."""
        return columns == self.columns and rows in (self.rows, self.rows + self.spare_rows)


def ciff_entries(data: bytes | memoryview) -> dict[int, Extent]:
    """Return where the values of Canon's CRW lie, by tag, those of inner heaps included; none of any other file.

    Source: Canon, CIFF 1.0 revision 4: a heap ends with the offset of its table; types 0x28 and 0x30 are heaps.
    """
    if bytes(data[6:14]) != b"HEAPCCDR":
        return {}
    found: dict[int, Extent] = {}
    heaps = [(struct.unpack_from("<I", data, 2)[0], len(data))]
    for _ in range(64):
        if not heaps:
            break
        start, end = heaps.pop()
        try:
            table = start + struct.unpack_from("<I", data, end - 4)[0]
            (count,) = struct.unpack_from("<H", data, table)
            for number in range(min(count, 127)):
                kind, size, offset = struct.unpack_from("<HII", data, table + 2 + 10 * number)
                if kind & 0xC000 == 0:
                    found.setdefault(kind, (start + offset, size))
                if kind & 0xF800 in (0x2800, 0x3000) and size >= 6 and start + offset + size <= len(data):
                    heaps.append((start + offset, start + offset + size))
        except struct.error:
            continue
    return found


MAX_BOXES = 4096  # Boxes that are walked; a real file has about a hundred

_CANON = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")  # The uuid of the box with Canon's metadata
_SAMPLE_ENTRY_HEAD = 82  # Bytes of a CRAW sample entry before the boxes in it (cr3_parser.cpp)
_MOST_SAMPLES = 4096  # Samples of a track that are looked at; a roll of bursts has a few hundred
_UUID_LENGTH = 16  # Bytes of a uuid, which stands before the content of such a box (ISO/IEC 14496-12, 4.2)
_TABLE_HEAD = 8  # Bytes of `stsd` before its entries: version and flags, and how many (ISO/IEC 14496-12, 8.5.2)
_FULL_BOX_HEAD = 4  # Bytes of version and flags in a full box (ISO/IEC 14496-12, 4.2)
_WHOLE_AREAS = 48  # Bytes of `IAD1` in the track of the whole picture: six areas of four numbers; a preview's has fewer
_LEFT_BLACK, _UPPER_BLACK = 3, 4  # Which of those areas are optically black (cr3_parser.cpp)


@dataclass(frozen=True)
class Cr3:
    """What a CR3 says of itself.

    - `maker`, `model`: as ``Canon`` and ``Canon EOS R``; empty where the file does not say.
    - `black`: optically black areas that it states for its largest picture, on the whole sensor: left, upper; those
      that it leaves empty are left out.
    - `frames`: the pictures of its tracks of raw pixels.
    - `exif`: directories of its Exif box, with serial number and lens; none where it has no such box.
    """

    maker: str = ""
    model: str = ""
    black: tuple[Area, ...] = ()
    exif: tuple[Directory, ...] = ()
    frames: tuple[Stored, ...] = ()


@dataclass(frozen=True)
class _Box:
    kind: bytes
    start: int
    end: int


def read_cr3(data: bytes | memoryview) -> Cr3:
    """Return what a CR3 says of itself."""
    maker = model = ""
    black: tuple[Area, ...] = ()
    exif: tuple[Directory, ...] = ()
    frames: list[Stored] = []
    left = [MAX_BOXES]
    found: set[bytes] = set()
    for box in _boxes(data, 0, len(data), left, whole=True):
        found.add(box.kind)
        if box.kind != b"moov":
            continue
        for part in _boxes(data, box.start, box.end, left):
            if part.kind == b"uuid" and bytes(data[part.start : part.start + _UUID_LENGTH]) == _CANON:
                for entry in _boxes(data, part.start + _UUID_LENGTH, part.end, left):
                    if entry.kind == b"CMT1":
                        known = _directories(data[entry.start : entry.end])
                        named = ((one.text(TiffTag.MAKE), one.text(TiffTag.MODEL)) for one in known)
                        maker, model = next((names for names in named if names[1]), ("", ""))
                    elif entry.kind == b"CMT2":
                        exif = _directories(data[entry.start : entry.end])
            elif part.kind == b"trak":
                table = _inside(data, part, left, b"mdia", b"minf", b"stbl")
                entry = table and _inside(data, table, left, b"stsd", b"CRAW")
                if table is None or entry is None:
                    continue
                black = _black_areas(data, entry, left) or black
                frames += _frames(data, table, entry, left)
    for kind, what in ((b"moov", "description of its pictures"), (b"mdat", "pictures")):
        if kind not in found:
            raise RawDamaged(f"it holds no {what} ({kind.decode('ascii')})")
    return Cr3(maker, model, black, exif, tuple(frames))


def _boxes(data: bytes | memoryview, start: int, end: int, left: list[int], *, whole: bool = False) -> Iterator[_Box]:
    """Yield the boxes between two places; a damaged one ends the row, or, of a `whole` file, is an error."""
    while end - start >= 8:
        left[0] -= 1
        if left[0] < 0:
            raise RawDamaged(f"it has more than {MAX_BOXES} boxes")
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1 and end - start >= 16:
            (size,) = struct.unpack_from(">Q", data, start + 8)
            head = 16
        elif size == 0:
            size = end - start
        if size < head or start + size > end:
            if whole:
                name = kind.decode("ascii", "replace")
                raise RawDamaged(f"its part {name!r} reaches to byte {start + size}, and it has only {end}")
            return
        yield _Box(kind, start + head, start + size)
        start += size
    if whole and start != end:
        raise RawDamaged(f"{end - start} bytes follow its last part, too few for another")


def _directories(content: bytes | memoryview) -> tuple[Directory, ...]:
    """Return the directories of the TIFF in a box; none where it is damaged."""
    try:
        return tuple(read_directories(bytes(content)))
    except TiffDamaged:
        return ()


# Bytes of a box before the boxes in it.
_HEADS = {b"stsd": _TABLE_HEAD, b"CRAW": _SAMPLE_ENTRY_HEAD, b"CDI1": _FULL_BOX_HEAD}


def _inside(data: bytes | memoryview, box: _Box, left: list[int], *kinds: bytes) -> _Box | None:
    """Return the first box of each of `kinds`, one within the other; None where one is missing."""
    for kind in kinds:
        found = next((inner for inner in _boxes(data, box.start, box.end, left) if inner.kind == kind), None)
        if found is None:
            return None
        box = _Box(kind, min(found.start + _HEADS.get(kind, 0), found.end), found.end)
    return box


def _frames(data: bytes | memoryview, table: _Box, entry: _Box, left: list[int]) -> list[Stored]:
    """Return the pictures of a track of raw pixels, each a sample in a chunk of its own; none of another track."""
    described = _inside(data, entry, left, b"CMP1")
    sizes, places = _inside(data, table, left, b"stsz"), _inside(data, table, left, b"co64")
    if described is None or described.end - described.start < 16:
        return []
    columns, rows = struct.unpack_from(">II", data, described.start + 8)
    if sizes is None or places is None:
        raise RawDamaged("a track of its pixels does not say where they are")
    stsz, co64 = (bytes(data[box.start : box.end]) for box in (sizes, places))
    try:
        each, count = struct.unpack_from(">II", stsz, 4)
        (chunks,) = struct.unpack_from(">I", co64, 4)
        if not 0 < count == chunks <= _MOST_SAMPLES:
            raise RawDamaged(f"a track of its pixels has {count} samples in {chunks} chunks")
        lengths = (each,) * count if each else struct.unpack_from(f">{count}I", stsz, 12)
        offsets = struct.unpack_from(f">{count}Q", co64, 8)
    except struct.error as error:
        raise RawDamaged("a track of its pixels ends within its tables") from error
    return [Stored(rows, columns, (extent,)) for extent in zip(offsets, lengths, strict=True)]


def _black_areas(data: bytes | memoryview, entry: _Box, left: list[int]) -> tuple[Area, ...]:
    """Return the optically black areas that a track states; none for one that is not of the whole picture."""
    place = _inside(data, entry, left, b"CDI1", b"IAD1")
    if place is None:
        return ()
    if place.end - place.start < _WHOLE_AREAS:
        return ()
    numbers = struct.unpack_from(f">{_WHOLE_AREAS // 2}H", data, place.start)
    areas: list[Area] = []
    for index in (_LEFT_BLACK, _UPPER_BLACK):
        first_column, first_row, last_column, last_row = numbers[4 * index : 4 * index + 4]
        # The last row and column belong to it, as of all areas that Canon states.
        if last_column > first_column and last_row > first_row:
            areas.append(Area(first_row, first_column, last_row - first_row + 1, last_column - first_column + 1))
    return tuple(areas)
