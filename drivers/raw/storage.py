"""Where a raw file keeps the photosites of a frame, by its own account, and whether they can all be there.

Rules that hold inside:

- Pure functions of bytes: every byte sequence whatever ends in frames, `RawDamaged`, `RawUnsupported` or `NotBayer`.
- LibRaw chooses by itself which picture of a file it decodes, and reads behind the end of what is stored without a
  word. So each picture of a sensor that a file describes must be whole, and what LibRaw makes must have the size of
  one of them (`Stored.holds`). A file of whose layout neither can be told is refused.
- What the compressed codes of a maker decode to is LibRaw's to say; here a photosite only needs bits at all.
- A CR3 (EOS R, EOS M50, EOS 250D and later) is an ISO base media file, not TIFF: boxes in boxes, each a size of 32 bits
  (1: of 64 bits, behind the type; 0: up to the end), a type of four letters, and content; big-endian. Boxes are walked,
  never searched for, and at most `MAX_BOXES` of them. One that reaches beyond the file's end betrays a cut; what is
  inside a box and makes no sense is left out.

Sources: TIFF 6.0 (strips), TIFF technical note 1 and DNG 1.7.1 (tiles); Canon, CIFF 1.0 revision 4 (CRW); ISO/IEC
14496-12, 4.2 (boxes), 8.7.3 (sizes of samples) and 8.7.5 (places of chunks). For the rest, of which there is no public
standard: P. Harvey, ExifTool (PanasonicRaw.pm, FujiFilm.pm, PhaseOne.pm, CanonRaw.pm); L. Clévy, "Describing the Canon
Raw v3 (CR3) file format" (structure); and LibRaw 0.22 for which directory, size and packing it takes
(src/metadata/{tiff,identify,fuji,ciff,mediumformat}.cpp), for what CDI1 holds (src/metadata/cr3_parser.cpp) and CMP1
(src/decoders/crx.cpp).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivers.raw.lossless_jpeg import jpeg_size
from drivers.tiff import CFA, Directory, TiffDamaged, TiffTag, is_tiff, read_directories

Extent = tuple[int, int]
"""First byte, and how many."""

_LEAST_BITS = 0.25
"""Bits for each photosite below which no codec of a maker's puts a frame, since noise takes several. Chosen."""

_LOSSLESS_BITS = 1.0
"""Bits that lossless JPEG spends on a photosite at least (ITU-T T.81, annex H)."""

_UNCOMPRESSED, _OLD_JPEG, _JPEG, _SONY, _LOSSY_JPEG = 1, 6, 7, 32767, 34892
"""Compression (TIFF 6.0; DNG 1.7.1, chapter 3; Sony's own)."""

_UNSUPPORTED = {8: "Deflate", 32946: "Deflate", 9: "VC-5", 52546: "JPEG XL"}
"""Compression of DNG that LibRaw is not built with (DNG 1.7.1, chapter 3; 32946: Adobe's number of old)."""

_MAKERS = ("nikon", "sony", "pentax", "ricoh", "olympus", "om digital", "samsung", "hasselblad")
"""Beginnings of makers' names in files of TIFF of whose raw pixels TIFF's own tags say size and place."""

_TONES = (TiffTag.LINEARIZATION_TABLE, TiffTag.GRAY_RESPONSE_CURVE)
"""Tags of tables that LibRaw applies to what is stored."""

_LINEAR_RAW = 34892
"""PhotometricInterpretation of pixels that hold all colours (DNG 1.7.1)."""


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
    least_bits: float = _LEAST_BITS
    bits: int = 16
    lossless: bool = False
    spare_rows: int = 0
    directory: Directory | None = None

    def holds(self, rows: int, columns: int) -> bool:
        """Return whether that is the size of the sensor as LibRaw would make it."""
        return columns == self.columns and rows in (self.rows, self.rows + self.spare_rows)


def stored_frames(data: bytes | memoryview, directories: Sequence[Directory]) -> list[Stored]:
    """Return the frames that a file describes, the largest first; all their bytes are there.

    `data`: the file's bytes; `directories`: those of a TIFF file.
    """
    start = bytes(data[:32])
    if b"IIII" in start or b"MMMM" in start:
        frames = [_of_phase_one(data)]
    elif start.startswith(b"FUJIFILM"):
        frames = [_of_raf(data)]
    elif start[6:14] == b"HEAPCCDR":
        frames = [_of_crw(data)]
    elif start.startswith(b"IIU\0"):
        frames = [_of_rw2(data, directories)]
    elif is_tiff(data):
        frames = list(_of_tiff(data, directories))
    else:
        raise RawDamaged(
            "it begins as none of the raw files that can be checked (CR2, CR3, CRW, NEF, ARW, PEF, ORF, SRW, RW2, RAF, "
            "3FR, IIQ, DNG)"
        )
    return sorted(checked(data, frames), key=lambda frame: -frame.rows * frame.columns)


def checked(data: bytes | memoryview, frames: Sequence[Stored]) -> Sequence[Stored]:
    """Return `frames`; refuse none, and those whose bytes are not all in the file, are stored twice, or are too few."""
    if not frames:
        raise RawDamaged("it describes no pixels of a sensor")
    for frame in frames:
        if not (0 < frame.rows < 1 << 16 and 0 < frame.columns < 1 << 16):
            raise RawDamaged(f"it states a sensor of {frame.columns}×{frame.rows}")
        extents = sorted(frame.extents)
        for offset, size in extents:
            if size <= 0 or offset + size > len(data):
                raise RawDamaged(f"its pixels reach from byte {offset} to {offset + size}, and it has only {len(data)}")
        for (first, size), (following, _) in pairwise(extents):
            if first + size > following:
                raise RawDamaged(f"parts of its pixels lie upon each other, at byte {following}")
        size, photosites = sum(size for _, size in extents), frame.rows * frame.columns
        if 8 * size < photosites * frame.least_bits:
            raise RawDamaged(
                f"it holds {size} bytes of pixels for {photosites} photosites, at least {frame.least_bits:.3g} "
                "bits each expected"
            )
    return frames


def _of_tiff(data: bytes | memoryview, directories: Sequence[Directory]) -> Iterator[Stored]:
    """Yield the frames behind colour filters of a DNG, a CR2, or a maker's TIFF."""
    # A version of zeros is none to LibRaw.
    dng = any(any(one.integers(TiffTag.DNG_VERSION)) for one in directories)
    canon = bytes(data[8:10]) == b"CR" and not dng
    maker = next((name for one in directories if (name := one.text(TiffTag.MAKE))), "")
    # Olympus calls its pixels grey.
    meant = {CFA, 1} if data[2:4] in (b"RO", b"RS", b"OR") else {CFA}
    for directory in directories:
        if canon:
            found = _of_cr2(data, directory)
            if found is not None:
                yield found
            continue
        interpretation = directory.first(TiffTag.PHOTOMETRIC_INTERPRETATION)
        if dng and directory.first(TiffTag.NEW_SUBFILE_TYPE) == 0 and interpretation == _LINEAR_RAW:
            raise NotBayer("its pixels hold all colours (LinearRaw)")
        if interpretation not in meant or (dng and directory.first(TiffTag.NEW_SUBFILE_TYPE)):
            continue
        if not dng and not maker.casefold().startswith(_MAKERS):
            raise RawUnsupported(f"it is of {maker or 'an unnamed maker'}, whose layout is not checked")
        for tones in (directory.integers(tag) for tag in _TONES):
            if tones and (list(tones) != sorted(tones) or tones[0] == tones[-1]):
                raise RawDamaged("its table of tones does not rise")
        yield (_of_dng if dng else _of_maker)(data, directory, _extents(directory))


def _extents(directory: Directory) -> tuple[Extent, ...]:
    """Return the strips of a directory, or its tiles, which count where both are stated, as in Sony's files."""
    places, sizes = (
        (TiffTag.TILE_OFFSETS, TiffTag.TILE_BYTE_COUNTS)
        if directory.integers(TiffTag.TILE_OFFSETS)
        else (TiffTag.STRIP_OFFSETS, TiffTag.STRIP_BYTE_COUNTS)
    )
    numbers = directory.integers(places), directory.integers(sizes)
    if len(numbers[0]) != len(numbers[1]):
        raise RawDamaged(f"it states {len(numbers[0])} places of its pixels and {len(numbers[1])} sizes")
    return tuple(zip(*numbers, strict=True))


def _in_a_row(extents: Sequence[Extent]) -> bool:
    return all(offset + size == following for (offset, size), (following, _) in pairwise(extents))


def _of_dng(data: bytes | memoryview, directory: Directory, extents: tuple[Extent, ...]) -> Stored:
    rows, columns = directory.first(TiffTag.IMAGE_LENGTH), directory.first(TiffTag.IMAGE_WIDTH)
    compression, bits = (
        directory.first(TiffTag.COMPRESSION),
        max(directory.integers(TiffTag.BITS_PER_SAMPLE), default=0),
    )
    if directory.first(TiffTag.SAMPLES_PER_PIXEL) > 1:
        raise NotBayer(f"it has {directory.first(TiffTag.SAMPLES_PER_PIXEL)} samples for each pixel")
    if compression not in (_UNCOMPRESSED, _JPEG, _LOSSY_JPEG):
        name = _UNSUPPORTED.get(compression, f"number {compression}")
        raise RawUnsupported(f"its pixels are compressed by {name}, which is not supported")
    # A table of tones makes any number of what is stored.
    largest = 16 if any(directory.integers(tag) for tag in _TONES) else min(bits, 16)
    if not 8 <= bits <= 16 or directory.first(TiffTag.SAMPLE_FORMAT) > 1:
        raise RawUnsupported(f"its photosites are of {bits} bits or no integers, 8 to 16 bits expected")
    tiled = bool(directory.integers(TiffTag.TILE_OFFSETS))
    high = directory.first(TiffTag.TILE_LENGTH if tiled else TiffTag.ROWS_PER_STRIP)
    wide = directory.first(TiffTag.TILE_WIDTH) if tiled else columns
    high = high if tiled else min(high or rows, rows)
    if high <= 0 or wide <= 0:
        raise RawDamaged(f"its pixels are in parts of {wide}×{high}")
    across, down = -(-columns // wide), -(-rows // high)
    if len(extents) != across * down:
        raise RawDamaged(f"its pixels are in {len(extents)} parts, {across * down} expected")
    if compression == _UNCOMPRESSED:
        if not tiled and not _in_a_row(extents):
            raise RawUnsupported("its strips do not follow one another")
        for number, (_, size) in enumerate(extents):
            part = min(high, rows - number // across * high)
            if 8 * size < (high if tiled else part) * wide * bits:
                raise RawDamaged(f"part {number} of its pixels has {size} bytes for {part} rows of {wide} photosites")
        return Stored(rows, columns, extents, bits, largest, directory=directory)
    if compression == _LOSSY_JPEG:
        return Stored(rows, columns, extents, bits=largest, directory=directory)
    # LibRaw wraps rows at the sensor's edge, and takes the first strip for all.
    if wide > columns or not (tiled or len(extents) == 1):
        raise RawUnsupported("its JPEG is in several strips, or in tiles that are wider than the sensor")
    lossless = True
    for number, (offset, size) in enumerate(extents):
        left = min(high, rows - number // across * high)
        found = jpeg_size(data[offset : offset + size])
        if found is None or found.rows * found.columns not in (high * wide, left * wide):
            raise RawDamaged(f"part {number} of its pixels is no JPEG of {left} rows of {wide} photosites")
        lossless &= found.lossless
    least = _LOSSLESS_BITS if lossless else _LEAST_BITS
    return Stored(rows, columns, extents, least, largest, lossless=lossless, directory=directory)


def _of_cr2(data: bytes | memoryview, directory: Directory) -> Stored | None:
    """Return the frame of the one directory whose strip is a lossless JPEG; its size is the JPEG's."""
    if not directory.integers(TiffTag.STRIP_OFFSETS):
        return None
    offset, size = directory.first(TiffTag.STRIP_OFFSETS), directory.first(TiffTag.STRIP_BYTE_COUNTS)
    found = jpeg_size(data[offset : offset + size])
    if found is None or not found.lossless:
        if directory.integers(TiffTag.CR2_SLICES):
            raise RawDamaged(f"its pixels at byte {offset} are no lossless JPEG")
        return None
    rows, columns, components, bits, _ = found
    number, each, last = (*directory.integers(TiffTag.CR2_SLICES), 0, 0, 0)[:3]
    if components % 2 == 0 and number and number * each + last != columns:
        raise RawDamaged(f"its {number + 1} slices are {number * each + last} photosites wide, its pixels {columns}")
    if components % 2 == 0 and columns > 4 * rows:
        rows, columns = 2 * rows, columns // 2
    return Stored(rows, columns, ((offset, size),), _LOSSLESS_BITS, bits, lossless=True, directory=directory)


def _of_maker(data: bytes | memoryview, directory: Directory, extents: tuple[Extent, ...]) -> Stored:
    """Return the frame of a TIFF of any maker; Olympus calls compressed pixels of 16 bits uncompressed."""
    rows, columns = directory.first(TiffTag.IMAGE_LENGTH), directory.first(TiffTag.IMAGE_WIDTH)
    compression, bits = directory.first(TiffTag.COMPRESSION), directory.first(TiffTag.BITS_PER_SAMPLE)
    size, least, spare = sum(size for _, size in extents), _LEAST_BITS, 0
    if compression == _UNCOMPRESSED:
        if not 8 <= bits <= 16:
            raise RawDamaged(f"its photosites are of {bits} bits, 8 to 16 expected")
        if not _in_a_row(extents):
            raise RawUnsupported("its strips do not follow one another")
        grey = directory.first(TiffTag.PHOTOMETRIC_INTERPRETATION) != CFA
        # LibRaw takes grey ones for compressed from 8/7 bits each on, and reads 14 bits as 16 unless they fill just
        # their rows, of whole blocks of 16 bytes.
        in_14_bits = rows * -(-columns * 7 // 64) * 16 if columns % 4 == 0 else 0
        least = 8 / 7 if grey and bits == 16 else 16 if bits > 12 and size != in_14_bits else bits
    elif compression in (_OLD_JPEG, _JPEG):
        least = _LOSSLESS_BITS
        headers = [jpeg_size(data[offset : offset + length]) for offset, length in extents]
        if not all(header is not None and header.lossless for header in headers):
            raise RawDamaged("parts of its pixels are no lossless JPEG")
    elif compression == _SONY and size not in (rows * columns, 2 * rows * columns):
        spare = 8
    return Stored(rows, columns, extents, least, spare_rows=spare, directory=directory)


def _of_rw2(data: bytes | memoryview, directories: Sequence[Directory]) -> Stored:
    """Return the frame of an RW2 or RWL, whose pixels reach to the file's end: so many in each 16 bytes, by format."""
    first = next(iter(directories), Directory({}))
    form, bits = first.first(TiffTag.RW2_FORMAT), first.first(TiffTag.RW2_BITS)
    start = first.first(TiffTag.RW2_PIXELS) or first.first(TiffTag.STRIP_OFFSETS)
    if form in (5, 6, 7) and bits not in (12, 14):
        raise RawDamaged(f"its photosites have {bits} bits, 12 or 14 expected")
    in_block = {5: (10, 9), 6: (14, 11), 7: (10, 9)}.get(form, (14, 14))[bits > 12]
    least = _LEAST_BITS if form == 8 else 128 / in_block
    extents = ((start, len(data) - start),)
    return Stored(first.first(TiffTag.RW2_LENGTH), first.first(TiffTag.RW2_WIDTH), extents, least)


def _of_raf(data: bytes | memoryview) -> Stored:
    """Return the frame of a RAF: its header, a table of big-endian values, and a TIFF of its own around the pixels."""
    try:
        table, _, start, size = struct.unpack_from(">4I", data, 92)
        rows, columns = _raf_size(data, table)
        (kind,) = struct.unpack_from(">H", data, min(start, len(data)))
    except struct.error as error:
        raise RawDamaged("it ends within its header") from error
    if start + size > len(data):
        raise RawDamaged(f"its pixels reach from byte {start} to {start + size}, and it has only {len(data)}")
    extents, bits = ((start, size),), 16
    if is_tiff(data[start : start + 4]):
        try:
            inner = read_directories(data[start : start + size])
        except TiffDamaged as error:
            raise RawDamaged(f"the directories of its pixels are damaged: {error}") from error
        described = next((one for one in inner if one.integers(TiffTag.RAF_OFFSETS)), None)
        if described is None:
            raise RawDamaged("it describes no pixels of a sensor")
        places, sizes = described.integers(TiffTag.RAF_OFFSETS), described.integers(TiffTag.RAF_BYTE_COUNTS)
        extents = tuple((start + place, length) for place, length in zip(places, sizes, strict=False))
        rows, columns = described.first(TiffTag.RAF_LENGTH), described.first(TiffTag.RAF_WIDTH)
        bits = described.first(TiffTag.RAF_BITS)
        kind = int.from_bytes(data[extents[0][0] : extents[0][0] + 2], "big") if extents else 0
    if kind != _RAF_COMPRESSED:
        return Stored(rows, columns, extents, min(bits or 16, 16))
    return _of_compressed_raf(data, rows, columns, extents)


_RAF_COMPRESSED = int.from_bytes(b"IS", "big")
_RAF_BLOCK = 768
"""Photosites across a block of a compressed RAF (fuji_compressed.cpp takes no other)."""


def _raf_size(data: bytes | memoryview, table: int) -> tuple[int, int]:
    """Return rows and columns of the whole sensor (tag 0x100) as the table of a RAF states them; zeros where not."""
    (count,) = struct.unpack_from(">I", data, table)
    at = table + 4
    for _ in range(min(count, 255)):
        tag, size = struct.unpack_from(">HH", data, at)
        if tag == 0x100:
            rows, columns = struct.unpack_from(">HH", data, at + 4)
            return rows, columns
        at += 4 + size
    return 0, 0


def _of_compressed_raf(data: bytes | memoryview, rows: int, columns: int, extents: tuple[Extent, ...]) -> Stored:
    """Return a compressed frame, whose header has its size and how many bytes each vertical block takes."""
    offset, size = extents[0]
    try:
        _, _, _, _, high, _, wide, block, blocks, _ = struct.unpack_from(">HBBBHHHHBH", data, offset)
        sizes = struct.unpack_from(f">{blocks}I", data, offset + 16)
    except struct.error as error:
        raise RawDamaged("it ends within the header of its pixels") from error
    if (high, wide, block) != (rows, columns, _RAF_BLOCK) or blocks != -(-wide // _RAF_BLOCK) or high % 6:
        raise RawDamaged(f"its pixels are {wide}×{high} in {blocks} blocks, {columns}×{rows} are stated")
    if min(sizes) == 0 or 16 + 4 * blocks + sum(sizes) > size:
        raise RawDamaged(f"the blocks of its pixels take {sum(sizes)} bytes of {size}")
    return Stored(rows, columns, extents)


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


def _of_crw(data: bytes | memoryview) -> Stored:
    """Return the frame of a CRW: pixels (0x2005), and the sensor's size (0x1031)."""
    entries = ciff_entries(data)
    pixels, sensor = entries.get(0x2005), entries.get(0x1031)
    if pixels is None or sensor is None or sensor[0] + 6 > len(data):
        raise RawDamaged("it describes no pixels of a sensor")
    columns, rows = struct.unpack_from("<HH", data, sensor[0] + 2)
    return Stored(rows, columns, (pixels,))


def _of_phase_one(data: bytes | memoryview) -> Stored:
    """Return the frame of an IIQ: a directory of its own, places counted from where its mark stands."""
    start = bytes(data[:32])
    base = min(at for at in (start.find(b"IIII"), start.find(b"MMMM")) if at >= 0)
    order = "<" if start[base : base + 4] == b"IIII" else ">"
    try:
        mark, place = struct.unpack_from(order + "II", data, base + 4)
        (count,) = struct.unpack_from(order + "I", data, base + place)
        found = {
            tag: (value, size)
            for tag, _, size, value in (
                struct.unpack_from(order + "4I", data, base + place + 8 + 16 * number)
                for number in range(min(count, 8192))
            )
        }
    except struct.error as error:
        raise RawDamaged("it ends within its directory") from error
    if mark >> 8 != int.from_bytes(b"Raw", "big"):
        raise RawDamaged("its directory has no mark")
    (columns, _), (rows, _), (form, _), (offset, size) = (
        found.get(tag, (0, 0)) for tag in (0x108, 0x109, 0x10E, 0x10F)
    )
    return Stored(rows, columns, ((base + offset, size),), _LEAST_BITS if form > 2 else 16)


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
        raise RawDamaged("it does not begin as a CR3 does")
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
