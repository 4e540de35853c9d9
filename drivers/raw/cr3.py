"""What a CR3 says of itself: the camera, where its sensor is optically black, and where its pixels are stored.

A CR3 (EOS R, EOS M50, EOS 250D and later) is an ISO base media file, not TIFF: boxes in boxes, each a size of 32 bits
(1: of 64 bits, behind the type; 0: up to the end), a type of four letters, and content; big-endian.

Rules that hold inside:

- A pure function of bytes; every byte sequence whatever ends in a result or in `Cr3Damaged`. Boxes are walked, never
  searched for, and at most `MAX_BOXES` of them.
- A file whose boxes reach beyond its end was cut. What is inside a box and makes no sense is left out.
- A track of raw pixels states the size of its picture and the place of each of its samples; what they decode to is
  LibRaw's to say.

Sources: ISO/IEC 14496-12, 4.2 (boxes), 8.7.3 (sizes of samples) and 8.7.5 (places of chunks); for Canon's boxes, of
which there is no public standard: L. Clévy, "Describing the Canon Raw v3 (CR3) file format" (structure), and LibRaw
0.22, src/metadata/cr3_parser.cpp (contents of CDI1) and src/decoders/crx.cpp (contents of CMP1).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.raw.plain_dng import Area
from drivers.raw.storage import Stored
from drivers.tiff import Directory, TiffDamaged, TiffTag, read_directories

MAX_BOXES = 4096
"""Boxes that are walked; a real file has about a hundred."""

_CANON = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")
"""The uuid of the box with Canon's metadata."""
_SAMPLE_ENTRY_HEAD = 82
"""Bytes of a CRAW sample entry before the boxes in it (cr3_parser.cpp)."""
_MOST_SAMPLES = 4096
"""Samples of a track that are looked at; a roll of bursts has a few hundred."""
_UUID_LENGTH = 16
"""Bytes of a uuid, which stands before the content of such a box (ISO/IEC 14496-12, 4.2)."""
_TABLE_HEAD = 8
"""Bytes of `stsd` before its entries: version and flags, and how many (ISO/IEC 14496-12, 8.5.2)."""
_FULL_BOX_HEAD = 4
"""Bytes of version and flags in a full box (ISO/IEC 14496-12, 4.2)."""
_WHOLE_AREAS = 48
"""Bytes of `IAD1` in the track of the whole picture: six areas of four numbers; a preview's has fewer."""
_LEFT_BLACK, _UPPER_BLACK = 3, 4
"""Which of those areas are optically black (cr3_parser.cpp)."""


class Cr3Damaged(ValueError):
    """The bytes are no CR3, or end before its boxes do."""


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


def is_cr3(data: bytes | memoryview) -> bool:
    """Return whether bytes begin as a CR3 does."""
    return bytes(data[4:12]) == b"ftypcrx "


def read_cr3(data: bytes | memoryview) -> Cr3:
    """Return what a CR3 says of itself."""
    if not is_cr3(data):
        raise Cr3Damaged("it does not begin as a CR3 does")
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
                        maker, model = _camera(data[entry.start : entry.end])
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
            raise Cr3Damaged(f"it holds no {what} ({kind.decode('ascii')})")
    return Cr3(maker, model, black, exif, tuple(frames))


def _boxes(data: bytes | memoryview, start: int, end: int, left: list[int], *, whole: bool = False) -> Iterator[_Box]:
    """Yield the boxes between two places; a damaged one ends the row, or, of a `whole` file, is an error."""
    while end - start >= 8:
        left[0] -= 1
        if left[0] < 0:
            raise Cr3Damaged(f"it has more than {MAX_BOXES} boxes")
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
                raise Cr3Damaged(f"its part {name!r} reaches to byte {start + size}, and it has only {end}")
            return
        yield _Box(kind, start + head, start + size)
        start += size
    if whole and start != end:
        raise Cr3Damaged(f"{end - start} bytes follow its last part, too few for another")


def _camera(content: bytes | memoryview) -> tuple[str, str]:
    """Return maker and model of the TIFF in a box CMT1."""
    for directory in _directories(content):
        if directory.text(TiffTag.MODEL):
            return directory.text(TiffTag.MAKE), directory.text(TiffTag.MODEL)
    return "", ""


def _directories(content: bytes | memoryview) -> tuple[Directory, ...]:
    """Return the directories of the TIFF in a box; none where it is damaged."""
    try:
        return tuple(read_directories(bytes(content)))
    except TiffDamaged:
        return ()


_HEADS = {b"stsd": _TABLE_HEAD, b"CRAW": _SAMPLE_ENTRY_HEAD, b"CDI1": _FULL_BOX_HEAD}
"""Bytes of a box before the boxes in it."""


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
        raise Cr3Damaged("a track of its pixels does not say where they are")
    stsz, co64 = (bytes(data[box.start : box.end]) for box in (sizes, places))
    try:
        each, count = struct.unpack_from(">II", stsz, 4)
        (chunks,) = struct.unpack_from(">I", co64, 4)
        if not 0 < count == chunks <= _MOST_SAMPLES:
            raise Cr3Damaged(f"a track of its pixels has {count} samples in {chunks} chunks")
        lengths = (each,) * count if each else struct.unpack_from(f">{count}I", stsz, 12)
        offsets = struct.unpack_from(f">{count}Q", co64, 8)
    except struct.error as error:
        raise Cr3Damaged("a track of its pixels ends within its tables") from error
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
