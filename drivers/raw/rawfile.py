"""Raw files become mosaics: the sensor's counts as the camera stored them, what the file says, and planes of a colour.

Rules that hold inside:

- Nothing is subtracted, scaled, rotated or interpolated: `Mosaic.counts` equals what ``dcraw -D -4 -T`` writes, but for
  the rotation that dcraw applies.
- Whatever the bytes, the outcome is a `Mosaic` or one `FormatError`. LibRaw fills what is missing, and reads behind the
  end of what is stored, without a word: so each picture of a sensor that a file describes must be whole, and what
  LibRaw makes must have the size of one of them (`Stored.holds`). Of a file that is neither TIFF nor CR3
  (`layout_is_known`) it is only checked that it has bytes enough, and that no part of the frame is empty.
- LibRaw is called here and nowhere else in the suite. A DNG that holds its counts as memory does needs none: it is read
  as LibRaw would. LibRaw's table of colour matrices is asked by opening a raw file of nothing but a camera's name.

Sources: TIFF 6.0 (strips), TIFF technical note 1 and DNG 1.7.1 (tiles, CameraSerialNumber; ActiveArea, from whose
corner colour filters and black levels count); LibRaw 0.22 for which directory, size and packing it takes
(src/metadata/tiff.cpp); Exif 2.32, section 4.6.5 (BodySerialNumber, LensModel). Canon's note, which bodies before Exif
2.3 have instead, is a TIFF directory without a standard, whose offsets count from the file's beginning: P. Harvey,
ExifTool, lib/Image/ExifTool/Canon.pm (0x000c SerialNumber, 0x0095 LensModel).
"""

from __future__ import annotations

import ctypes
import io
import struct
import sys
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.raw.lossless_jpeg import jpeg_size, lossless_fault
from drivers.raw.storage import (
    LEAST_BITS,
    Area,
    Cr3,
    Extent,
    NotBayer,
    RawDamaged,
    RawUnsupported,
    Stored,
    ciff_entries,
    read_cr3,
)
from drivers.tiff import CFA, Directory, Tags, TiffDamaged, TiffTag, ValueType, head, is_tiff, read_directories, text
from foundation.errors import FormatError
from foundation.files import read_buffer
from foundation.robust import MAD_TO_SIGMA

if TYPE_CHECKING:
    from rawpy import RawPy


# Tags (Exif 2.32): of the Exif directory in the first one, and of the maker's note in that.
_EXIF_POINTER, _NOTE = int(TiffTag.EXIF_IFD_POINTER), 37500

_CANON_SERIAL, _CANON_LENS = 0x000C, 0x0095  # Tags of Canon's note

_MOST_ENTRIES = 512  # Entries of a directory that are looked at; Canon's notes have about sixty

_MOST_TEXT = 128  # Bytes of a lens's name that are read; Canon's take seventy


@dataclass(frozen=True)
class FrameOrigin:
    """What a raw file states of camera, lens and exposure.

    - `camera`: maker and model, ``Canon EOS 550D``; empty where the file does not say.
    - `serial`: serial number of the body; empty where the file does not say.
    - `lens`: the lens's model; empty where the file does not say, as without contacts.
    - `iso`, `aperture`, `shutter_s`: ISO speed, f-number and exposure time in seconds; None where the file does not
      say.
    """

    camera: str = ""
    serial: str = ""
    lens: str = ""
    iso: int | None = None
    aperture: float | None = None
    shutter_s: float | None = None

    @property
    def exposure(self) -> float:
        """Shutter time × ISO speed / f-number², s, to which counts are proportional; 0 where it is not stated."""
        if self.shutter_s is None or self.iso is None:
            return 0.0
        # A lens without contacts has no f-number, and keeps the one that it has.
        return self.shutter_s * self.iso / (self.aperture or 1.0) ** 2

    @property
    def exposure_text(self) -> str:
        """The exposure for people, ``0.5 s, ISO 100, f/8``."""
        if self.shutter_s is None or self.iso is None:
            return "no exposure stated"
        shutter = f"{self.shutter_s:.3g} s" if self.shutter_s >= 0.3 else f"1/{1 / max(self.shutter_s, 1e-6):.0f} s"
        return f"{shutter}, ISO {self.iso}" + (f", f/{self.aperture:.3g}" if self.aperture else "")


def body_and_lens(data: bytes | memoryview, directories: Sequence[Directory]) -> tuple[str, str]:
    """Return serial number of the body and model of the lens as a file states them; each empty where it does not.

    `data`: the file's bytes.
    """
    serial = _first(directories, (TiffTag.BODY_SERIAL_NUMBER, TiffTag.CAMERA_SERIAL_NUMBER))
    lens = _first(directories, (TiffTag.LENS_MODEL,))
    if serial and lens:
        return serial, lens
    noted_serial, noted_lens = _canon_note(data)
    return serial or noted_serial, lens or noted_lens


def _ciff_camera(data: bytes | memoryview) -> tuple[str, str]:
    """Return maker and model from Canon's CRW heap (0x080A); two empty strings for any other file."""
    start, size = ciff_entries(data).get(0x080A, (0, 0))
    maker, model, *_ = (*bytes(data[start : start + size]).split(b"\0"), b"", b"")
    return maker.decode("ascii", "replace"), model.decode("ascii", "replace")


def _first(directories: Sequence[Directory], tags: Sequence[TiffTag]) -> str:
    texts = (directory.text(tag) for tag in tags for directory in directories)
    return next((text for text in texts if text), "")


def _canon_note(data: bytes | memoryview) -> tuple[str, str]:
    """Return serial number and lens of Canon's note in a CR2; two empty strings where there is none."""
    if bytes(data[:2]) not in (b"II", b"MM") or bytes(data[8:10]) != b"CR":
        return "", ""
    order = "<" if bytes(data[:2]) == b"II" else ">"
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        for tag in (_EXIF_POINTER, _NOTE):
            entry = _entries(data, order, at).get(tag)
            if entry is None:
                return "", ""
            at = entry[1]
        note = _entries(data, order, at)
    except struct.error:
        return "", ""
    number, text = note.get(_CANON_SERIAL), note.get(_CANON_LENS)
    serial = "" if number is None or number[0] != 1 or number[1] == 0 else str(number[1])
    if text is None or text[0] <= 4:
        return serial, ""
    name = bytes(data[text[1] : text[1] + min(text[0], _MOST_TEXT)])
    return serial, name.split(b"\0")[0].decode("ascii", "replace").strip()


def _entries(data: bytes | memoryview, order: str, at: int) -> dict[int, tuple[int, int]]:
    """Return the entries of a directory by tag: how many values, and the value or where the values are."""
    (count,) = struct.unpack_from(order + "H", data, at)
    found: dict[int, tuple[int, int]] = {}
    for number in range(min(count, _MOST_ENTRIES)):
        tag, _, values, place = struct.unpack_from(order + "HHII", data, at + 2 + 12 * number)
        found[tag] = values, place
    return found


# Three rows R, G, B of three numbers: from CIE XYZ (D65, Y = 1) to linear camera RGB.
Matrix = tuple[tuple[float, float, float], ...]

_SIDE = 32  # Photosites along a side of the file that is opened; LibRaw opens none below 22


@lru_cache(maxsize=64)
def camera_matrix(camera: str) -> Matrix | None:
    """Return the matrix of `camera`, maker and model as ``Canon EOS 550D``; None if LibRaw does not know it."""
    maker, _, model = camera.strip().partition(" ")
    if not model or not camera.isascii():
        return None
    import rawpy

    tags: Tags = {
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [_SIDE]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [_SIDE]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.MAKE: text(maker),
        TiffTag.MODEL: text(camera),
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [1]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [_SIDE]),
        TiffTag.CFA_REPEAT_PATTERN_DIM: (ValueType.SHORT, [2, 2]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, [0, 1, 1, 2]),
        TiffTag.DNG_VERSION: (ValueType.BYTE, [1, 4, 0, 0]),
        TiffTag.UNIQUE_CAMERA_MODEL: text(camera),
    }
    pixels = bytes(2 * _SIDE * _SIDE)
    try:
        with rawpy.imread(io.BytesIO(head(tags, len(pixels)) + pixels)) as raw:
            rows = [tuple(float(number) for number in row) for row in raw.rgb_xyz_matrix[:3]]
    except rawpy.LibRawError:
        return None
    matrix = tuple((row[0], row[1], row[2]) for row in rows)
    return matrix if any(any(row) for row in matrix) else None


_SKIPPED_COLUMNS = 4  # The first columns of a masked area are disturbed by the readout of the row (seen on the 550D)

_LEAST_MASKED = 256  # Photosites per phase below which a masked mean is less certain than the metadata

# Photosites at a frame's highest count from which on that count is saturation: noise does not pile up so at one.
_PLATEAU = 64


@dataclass(frozen=True, eq=False)
class Mosaic:
    """One raw frame as the sensor gave it; every array is read-only.

    - `counts`: (H, W) uint16, the visible area, unprocessed counts, not rotated; a view into `sensor`. H and W may be
      odd.
    - `pattern`: colours of the 2×2 block at the visible top-left, row by row: one of `BAYER_PATTERNS`.
    - `black`: (2, 2) float64, counts, the black level for each position of that block, as the file's metadata states it
      or, for Canon's own formats, as LibRaw finds it in the borders, cut to an integer.
    - `white_level`: counts, as the metadata or LibRaw's table states it. It is not the saturation: 15 831 is stated for
      a 550D that saturates at 13 584 (ISO 100); see `saturation`.
    - `camera`: maker and model, ``Canon EOS 550D``; empty where the file does not say.
    - `sensor`: (RH, RW) uint16, the whole sensor with its masked borders.
    - `visible`: where `counts` lies on the sensor.
    - `masked`: optically black areas in sensor coordinates; empty if none is known.
    - `iso`, `aperture`, `shutter_s`: the exposure as the file states it: ISO speed, f-number, seconds; None where it
      does not.
    - `serial`, `lens`: serial number of the body and model of the lens; empty where the file does not state them.
    """

    counts: NDArray[np.uint16]
    pattern: str
    black: NDArray[np.float64]
    white_level: int
    camera: str
    sensor: NDArray[np.uint16]
    visible: Area
    masked: tuple[Area, ...]
    iso: int | None = None
    aperture: float | None = None
    shutter_s: float | None = None
    serial: str = ""
    lens: str = ""

    @property
    def origin(self) -> FrameOrigin:
        """Camera, lens and exposure as the file states them."""
        return FrameOrigin(self.camera, self.serial, self.lens, self.iso, self.aperture, self.shutter_s)

    def masked_black(self) -> NDArray[np.float64] | None:
        """Return the black level measured in the masked areas.

        Returns (2, 2) float64 counts, the mean for each position of the visible top-left block, over photosites within
        six robust standard deviations of the median; the first four columns of each area are left out. None where no
        masked area is known or it is too small. A float: an integer would lose up to one count (LibRaw's 2047 for
        2047.98).
        """
        means = np.empty((2, 2))
        for row in range(2):
            for column in range(2):
                found = [self._masked_phase(area, row, column) for area in self.masked]
                # Counts are few different numbers, so a histogram is enough, and fast.
                numbers = np.bincount(np.concatenate(found)) if found else np.zeros(0, dtype=np.int64)
                if numbers.sum() < _LEAST_MASKED:
                    return None
                values = np.flatnonzero(numbers).astype(np.float64)
                numbers = numbers[numbers > 0]
                median = _median(values, numbers)
                spread = MAD_TO_SIGMA * _median(np.abs(values - median), numbers)
                kept = np.abs(values - median) <= 6 * max(spread, 1.0)
                means[row, column] = (values * numbers)[kept].sum() / numbers[kept].sum()
        return means

    def saturation(self) -> int:
        """Return the raw count at which the sensor saturates, as far as this frame shows it.

        What the metadata state, or what the frame shows if that is lower: a plateau of at least 64 photosites at its
        highest count. A session without one clipped photosite keeps the stated value and its clipping limit lies too
        high; it does no harm there, as nothing came near.
        """
        top = int(self.counts.max())
        is_shown = top < self.white_level and int(np.count_nonzero(self.counts == top)) >= _PLATEAU
        return top if is_shown else self.white_level

    def block_planes(self) -> NDArray[np.uint16]:
        """Return the four positions of the 2×2 blocks as planes, (2, 2, H/2, W/2).

        ``[r, c, i, j]`` is ``counts[2 i + r, 2 j + c]``; a view, nothing is copied. An odd last row or column
        is left out.
        """
        height, width = (size // 2 for size in self.counts.shape)
        down, right = self.counts.strides
        return np.lib.stride_tricks.as_strided(
            self.counts, (2, 2, height, width), (down, right, 2 * down, 2 * right), writeable=False
        )

    def _masked_phase(self, area: Area, row: int, column: int) -> NDArray[np.uint16]:
        """Return the masked photosites of `area` that lie in phase with (`row`, `column`) of the visible block."""
        top, left = area.top, area.left + _SKIPPED_COLUMNS
        top += (self.visible.top + row - top) % 2
        left += (self.visible.left + column - left) % 2
        block = self.sensor[top : area.top + area.height : 2, left : area.left + area.width : 2]
        return block.ravel()


def _median(values: NDArray[np.float64], numbers: NDArray[np.int64]) -> float:
    """Return the median of `values`, each repeated as often as `numbers` has it."""
    order = np.argsort(values)
    upto = np.cumsum(numbers[order])
    middle = np.searchsorted(upto, ((upto[-1] - 1) // 2, upto[-1] // 2), side="right")
    return float(values[order][middle].mean())


# Sensors, with LibRaw's visible area, of which dcraw shows one row more at the top. LibRaw makes the odd top margin
# of a Canon even. Found with dcraw 9.28 and LibRaw 0.22 on CR2 files of, in this order, the 50D; 1D Mark IV; 550D,
# 600D and 60D; 7D; 5D Mark II.
_ONE_ROW_MORE = {
    ((3228, 4832), Area(52, 62, 3176, 4770)),
    ((3318, 5120), Area(46, 142, 3272, 4916)),
    ((3516, 5344), Area(52, 142, 3464, 5202)),
    ((3516, 5360), Area(52, 158, 3464, 5202)),
    ((3804, 5792), Area(52, 158, 3752, 5634)),
}

# Columns at the left of a sensor that are not black all the same: so many at its edge, so many beside the picture.
# From LibRaw 0.22 (src/metadata/identify.cpp, table of Canon's sensors). Of all other Canons with masked columns it
# takes all but the outermost.
_BLACK_COLUMNS = {
    "Canon EOS R10": (16, 48),
    "Canon EOS R6m2": (16, 48),
    "Canon EOS R6 Mark II": (16, 48),
    "Canon EOS R5m2": (128, 4),
    "Canon EOS R5 Mark II": (128, 4),
}

# Optically black areas by camera and sensor, from rawspeed's cameras.xml; the corner that two share counts once.
_MASKED = {
    ("Canon EOS 550D", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS REBEL T2i", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS Kiss X4", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS 6D Mark II", (4224, 6384)): (Area(0, 2, 4224, 116), Area(8, 118, 32, 6266)),
}


def read_raw(path: Path) -> Mosaic:
    """Read a camera's raw file: CR2, CR3, CRW, DNG or whatever else LibRaw reads, with a Bayer sensor."""
    return decode_raw(_read_bytes(path), path)


def decode_raw(data: bytes | memoryview, path: Path, *, known_whole: bool = False) -> Mosaic:
    """Return the mosaic of a raw file's bytes, for those who have read them already; `path` names it in messages.

    `known_whole`: whether the same bytes were decoded before, so that its lossless JPEG needs not be looked at again.
    """
    if not data:
        raise _unreadable(path, "it is empty")
    contents = _examined(path, data)
    plain = _plain_mosaic(path, data, contents)
    if plain is not None:
        return plain
    with ThreadPoolExecutor(1, "LibRaw") as beside:
        # LibRaw decodes without the interpreter's lock, so that both together take no longer than one.
        mosaic = beside.submit(_by_libraw, path, data, contents)
        fault = None if known_whole else _lossless_fault(data, contents)
    if fault is not None:
        raise _unreadable(path, fault)
    return mosaic.result()


def _lossless_fault(data: bytes | memoryview, contents: _Contents) -> str | None:
    """Return why a lossless JPEG in which frames are stored is damaged; None where none is."""
    parts = {part for frame in contents.frames if frame.lossless for part in frame.extents}
    faults = (lossless_fault(data[offset : offset + size]) for offset, size in parts)
    return next((fault for fault in faults if fault is not None), None)


def _by_libraw(path: Path, data: bytes | memoryview, contents: _Contents) -> Mosaic:
    import rawpy

    with _libraw_silenced():
        try:
            # Not closed: the mosaic's counts lie in LibRaw's memory, which is freed with the last view of it.
            return _mosaic(path, rawpy.imread(io.BytesIO(data)), data, contents)
        except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
            raise _unreadable(path, f"LibRaw says {_reason(error)}") from error
        except (MemoryError, NotImplementedError, RuntimeError, ValueError) as error:
            raise _unreadable(path, str(error) or type(error).__name__) from error


_LOSSLESS_BITS = 1.0  # Bits that lossless JPEG spends on a photosite at least (ITU-T T.81, annex H)

# Compression (TIFF 6.0; DNG 1.7.1, chapter 3; Sony's own).
_UNCOMPRESSED, _OLD_JPEG, _JPEG, _SONY, _LOSSY_JPEG = 1, 6, 7, 32767, 34892

# Compression of DNG that LibRaw is not built with (DNG 1.7.1, chapter 3; 32946: Adobe's number of old).
_UNSUPPORTED = {8: "Deflate", 32946: "Deflate", 9: "VC-5", 52546: "JPEG XL"}

# Beginnings of makers' names in files of TIFF of whose raw pixels TIFF's own tags say size and place.
_MAKERS = ("nikon", "sony", "pentax", "ricoh", "olympus", "om digital", "samsung", "hasselblad")

# Tags of tables that LibRaw applies to what is stored.
_TONES = (TiffTag.LINEARIZATION_TABLE, TiffTag.GRAY_RESPONSE_CURVE)

_LINEAR_RAW = 34892  # PhotometricInterpretation of pixels that hold all colours (DNG 1.7.1)


LAYOUT_START = 12  # Bytes at the beginning of a file that say which layout it has


def layout_is_known(start: bytes | memoryview) -> bool:
    """Return whether a file that begins so says where its photosites lie, in a way that is checked: TIFF and CR3.

    `start`: at least the first `LAYOUT_START` bytes.
    """
    # Panasonic's files begin nearly as TIFF does, and their tags of the pixels mean something else.
    return bytes(start[4:12]) == _CR3_START or (is_tiff(start) and start[:4] != b"IIU\0")


_CR3_START = b"ftypcrx "  # Type and brand of the first box of a CR3, behind its size


def stored_frames(data: bytes | memoryview, directories: Sequence[Directory]) -> list[Stored]:
    """Return the frames that a TIFF file describes, the largest first; all their bytes are there.

    `data`: the file's bytes; `directories`: its directories.
    """
    frames = list(_of_tiff(data, directories))
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
    least = _LOSSLESS_BITS if lossless else LEAST_BITS
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
    # TIFF 6.0: uncompressed where nothing is said.
    compression = directory.first(TiffTag.COMPRESSION) or _UNCOMPRESSED
    bits = directory.first(TiffTag.BITS_PER_SAMPLE)
    size, least, spare = sum(size for _, size in extents), LEAST_BITS, 0
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


def _mosaic(path: Path, raw: RawPy, data: bytes | memoryview, contents: _Contents) -> Mosaic:
    import rawpy

    pattern = raw.raw_pattern
    if raw.raw_type is not rawpy.RawType.Flat or pattern is None or pattern.shape != (2, 2):
        raise _not_bayer(path, "its pixels do not follow a 2×2 pattern of colour filters")
    sizes = raw.sizes
    size = sizes.raw_height, sizes.raw_width
    if contents.frames:
        stored = next((frame for frame in contents.frames if frame.holds(*size)), None)
    else:
        (stored,) = checked(data, [Stored(*size, ((0, len(data)),))])
    if stored is None:
        raise _unsupported(
            path,
            f"LibRaw makes {size[1]}×{size[0]} photosites of it, and "
            f"{contents.frames[0].columns}×{contents.frames[0].rows} are stored",
        )
    sensor = raw.raw_image
    # A view that kept LibRaw's object alive no longer would show freed memory.
    if sensor.base is not raw or sensor.dtype != np.uint16:
        sensor = np.array(sensor, dtype=np.uint16)
    sensor.setflags(write=False)
    # LibRaw leaves what it does not decode as memory was before.
    if stored.bits < 16 and int(sensor.max()) >> stored.bits:
        raise _unreadable(path, f"its counts reach {sensor.max()}, and have {stored.bits} bits")
    framed = Area(sizes.top_margin, sizes.left_margin, sizes.height, sizes.width)
    rows, columns = sensor.shape
    if (
        framed.top + framed.height > rows
        or framed.left + framed.width > columns
        or min(framed.height, framed.width) < 2
    ):
        raise _unreadable(path, f"its visible area {framed} does not lie on its {columns}×{rows} sensor")
    pixels = stored.directory
    visible = _active_area(pixels, (rows, columns)) or _dcraw_frame((rows, columns), framed)
    # rawpy's pattern is aligned with the sensor's corner, whatever the margins; ours with the visible one.
    colours = np.roll(pattern, (-visible.top, -visible.left), axis=(0, 1))
    names = raw.color_desc.decode("ascii", "replace")
    letters = "".join(names[index] for index in colours.ravel())
    if letters not in BAYER_PATTERNS:
        raise _not_bayer(path, f"its colour filters are {letters}")
    black = np.array(raw.black_level_per_channel, dtype=np.float64)[colours]
    stated = _stated_black(pixels)
    if stated is not None:
        black = stated
    white = () if pixels is None else pixels.numbers(TiffTag.WHITE_LEVEL)
    for level in (raw.white_level, *white):
        _require_levels(path, black, level, stored.bits)
    black.setflags(write=False)
    exposure = raw.other.iso_speed, raw.other.aperture, raw.other.shutter_speed
    mosaic = _made(data, contents, stored, sensor, visible, letters, black, int(raw.white_level), exposure)
    # LibRaw takes any file of 123 known sizes for a frame, zeros too.
    fault = None if contents.frames else filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    if fault is not None:
        raise _unreadable(path, fault)
    return mosaic


def _made(
    data: bytes | memoryview,
    contents: _Contents,
    stored: Stored,
    sensor: NDArray[np.uint16],
    visible: Area,
    pattern: str,
    black: NDArray[np.float64],
    white_level: int,
    exposure: tuple[float, float, float],
) -> Mosaic:
    """Return the mosaic of a sensor; `exposure`: ISO speed, f-number and seconds, 0 where the file does not say."""
    directories, cr3 = contents.directories, contents.cr3
    camera = _camera_name(data, directories) if cr3 is None else _joined(cr3.maker, cr3.model)
    serial, lens = body_and_lens(data, directories if cr3 is None else cr3.exif)
    iso, aperture, shutter_s = exposure
    # LibRaw makes up 1 s at f/1 for a file that states nothing; such a file has no ISO speed either.
    stated = iso > 0
    return Mosaic(
        counts=sensor[visible.top : visible.top + visible.height, visible.left : visible.left + visible.width],
        pattern=pattern,
        black=black,
        white_level=white_level,
        camera=camera,
        sensor=sensor,
        visible=visible,
        masked=_masked_areas(stored.directory, camera, visible, (sensor.shape[0], sensor.shape[1]), cr3),
        iso=round(iso) if stated else None,
        aperture=(round(aperture, 4) or None) if stated else None,
        shutter_s=(shutter_s or None) if stated else None,
        serial=serial,
        lens=lens,
    )


def _read_bytes(path: Path) -> memoryview:
    try:
        data = read_buffer(path)
    except FileNotFoundError as error:
        raise FormatError(f"there is no raw file {path}; check the name") from error
    except IsADirectoryError as error:
        raise FormatError(f"{path} is a folder, a raw file was expected; name one file") from error
    except OSError as error:
        raise FormatError(
            f"cannot read {path}: {error.strerror or error}; check its permissions and the disk"
        ) from error
    return data


@dataclass(frozen=True)
class _Contents:
    """What a file says of itself: TIFF directories, the boxes of a CR3, and the frames that are stored in it.

    No frames are known of a layout that is not checked.
    """

    directories: list[Directory]
    cr3: Cr3 | None
    frames: Sequence[Stored]


def _examined(path: Path, data: bytes | memoryview) -> _Contents:
    """Return what a file says of itself; refuse one that cannot hold the frame that it claims."""
    try:
        cr3 = read_cr3(data) if bytes(data[4:12]) == _CR3_START else None
        directories = read_directories(data) if is_tiff(data) else []
        frames: Sequence[Stored] = ()
        if layout_is_known(data):
            frames = stored_frames(data, directories) if cr3 is None else checked(data, cr3.frames)
    except (TiffDamaged, RawDamaged) as error:
        raise _unreadable(path, str(error)) from error
    except RawUnsupported as error:
        raise _unsupported(path, str(error)) from error
    except NotBayer as error:
        raise _not_bayer(path, str(error)) from error
    return _Contents(directories, cr3, frames)


def _camera_name(data: bytes | memoryview, directories: list[Directory]) -> str:
    for directory in directories:
        maker, model = directory.text(TiffTag.MAKE), directory.text(TiffTag.MODEL)
        if model:
            return _joined(maker, model)
    for directory in directories:
        if directory.text(TiffTag.UNIQUE_CAMERA_MODEL):
            return directory.text(TiffTag.UNIQUE_CAMERA_MODEL)
    return _joined(*_ciff_camera(data))


def _joined(maker: str, model: str) -> str:
    """Return maker and model without saying the maker twice, as ``Canon`` with ``Canon EOS 550D`` would."""
    if not maker or model.split(" ")[0].casefold() == maker.split(" ")[0].casefold():
        return model
    return f"{maker} {model}"


def _dcraw_frame(sensor: tuple[int, int], framed: Area) -> Area:
    if (sensor, framed) in _ONE_ROW_MORE:
        return Area(framed.top - 1, framed.left, framed.height + 1, framed.width)
    return framed


def _masked_areas(
    pixels: Directory | None, camera: str, visible: Area, sensor: tuple[int, int], cr3: Cr3 | None = None
) -> tuple[Area, ...]:
    """Return the optically black areas that the file states, that are known of the sensor, or that Canon always has.

    Those that a CR3 states, in a box whose meaning no standard confirms, narrow down what is known of Canon's sensors,
    and add nothing to it.
    """
    stated = _stated_areas(pixels, TiffTag.MASKED_AREAS, sensor)
    if stated:
        return stated
    if (camera, sensor) in _MASKED:
        return _MASKED[camera, sensor]
    # Every Canon sensor has black columns at its left; the four beside the picture are left out, lest light leaks in.
    outer, inner = _BLACK_COLUMNS.get(camera, (0, 4))
    if not camera.startswith("Canon") or visible.left - outer - inner < _SKIPPED_COLUMNS + 2:
        return ()
    area = Area(visible.top, outer, visible.height, visible.left - outer - inner)
    stated_left = next((black for black in cr3.black if black.left < visible.left), None) if cr3 is not None else None
    if stated_left is not None and stated_left.left + stated_left.width <= visible.left:
        area = _common(area, stated_left)
    return (area,) if area.width >= _SKIPPED_COLUMNS + 2 and area.height >= 2 else ()


def _common(first: Area, second: Area) -> Area:
    """Return what two areas have in common; without rows or columns where that is nothing."""
    top, left = max(first.top, second.top), max(first.left, second.left)
    bottom = min(first.top + first.height, second.top + second.height)
    right = min(first.left + first.width, second.left + second.width)
    return Area(top, left, max(bottom - top, 0), max(right - left, 0))


def _unreadable(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} cannot be read as a raw file: {reason}; expected a camera's complete raw file such as CR2 or DNG: "
        "copy it from the camera again, or take the frame again"
    )


def _unsupported(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} cannot be read as a raw file: {reason}; expected a camera's own raw file such as CR2, CR3 or NEF, "
        "or a DNG of lossless JPEG, as Adobe's DNG Converter and dnglab make it: convert it to such a DNG"
    )


def _not_bayer(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} is not of a Bayer sensor: {reason}; expected a 2×2 pattern of red, green, green and blue: "
        "use a camera with a Bayer sensor, and its full raw format"
    )


def _reason(error: Exception) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return repr(text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text))


_silence = threading.Lock()
_silenced = 0
_kept_stream: int | None = None


@contextmanager
def _libraw_silenced() -> Generator[None]:
    """Keep LibRaw's remarks on damaged data off the terminal; they come back as an error anyway.

    LibRaw prints through C's ``stderr`` and rawpy gives no handle on it. Here that stream alone is turned to
    ``/dev/null`` while any thread decodes; Python's own stderr, a progress display on it included, is not touched.
    Where the C library has no variable of that name, nothing is done.
    """
    _turn_c_stderr(1)
    try:
        yield
    finally:
        _turn_c_stderr(-1)


def _turn_c_stderr(step: int) -> None:
    global _silenced, _kept_stream
    with _silence:
        _silenced += step
        try:
            stream = ctypes.c_void_p.in_dll(ctypes.CDLL(None), "stderr")
        except (OSError, ValueError, TypeError):
            return
        if step > 0 and _silenced == 1 and (null := _null_stream()):
            _kept_stream, stream.value = stream.value, null
        elif _silenced == 0 and _kept_stream is not None:
            stream.value, _kept_stream = _kept_stream, None


@cache
def _null_stream() -> int | None:
    """Return C's stream that forgets what is written; None if there is none.

    It is never closed: a C++ library that is loaded while ``stderr`` leads there writes to it until the program's end.
    """
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    return libc.fopen(b"/dev/null", b"w")


BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


# What a plain file states, or does not state.
_PLAIN: dict[TiffTag, tuple[tuple[int, ...], ...]] = {
    TiffTag.COMPRESSION: ((1,),),
    TiffTag.PHOTOMETRIC_INTERPRETATION: ((CFA,),),
    TiffTag.BITS_PER_SAMPLE: ((16,),),
    TiffTag.SAMPLES_PER_PIXEL: ((1,), ()),
    TiffTag.CFA_REPEAT_PATTERN_DIM: ((2, 2),),
    TiffTag.CFA_PLANE_COLOR: ((0, 1, 2), ()),
    TiffTag.CFA_LAYOUT: ((1,), ()),
    TiffTag.LINEARIZATION_TABLE: ((),),
    TiffTag.GRAY_RESPONSE_CURVE: ((),),
    TiffTag.TILE_OFFSETS: ((),),
}


def _plain_mosaic(path: Path, data: bytes | memoryview, contents: _Contents) -> Mosaic | None:
    """Return the mosaic of a DNG that holds its counts as memory does; None for any other file.

    LibRaw copies such counts one by one, which takes longer than all that is done with a frame afterwards.
    """
    stored, directories = next(iter(contents.frames), None), contents.directories
    pixels = None if stored is None else stored.directory
    if stored is None or pixels is None or data[:2] != b"II" or sys.byteorder != "little":
        return None
    if any(pixels.integers(tag) not in allowed for tag, allowed in _PLAIN.items()):
        return None
    size = stored.rows, stored.columns
    pattern = pixels.integers(TiffTag.CFA_PATTERN)
    white, black = pixels.numbers(TiffTag.WHITE_LEVEL), _stated_black(pixels)
    letters = "".join("RGB"[index] for index in pattern if 0 <= index < 3)
    if letters not in BAYER_PATTERNS or len(white) != 1 or black is None:
        return None
    visible, start = _active_area(pixels, size), stored.extents[0][0]
    enough = sum(length for _, length in stored.extents) == 2 * size[0] * size[1]
    if visible is None or not enough or start % 2:
        return None
    _require_levels(path, black, int(white[0]), 16)
    sensor = np.frombuffer(data, dtype=np.uint16, count=size[0] * size[1], offset=start).reshape(size)
    iso, aperture, shutter = (
        _exposure(directories, tag)
        for tag in (TiffTag.PHOTOGRAPHIC_SENSITIVITY, TiffTag.F_NUMBER, TiffTag.EXPOSURE_TIME)
    )
    return _made(data, contents, stored, sensor, visible, letters, black, int(white[0]), (iso, aperture, shutter))


def _exposure(directories: Sequence[Directory], tag: TiffTag) -> float:
    """Return the first number of `tag` in any directory, 0 if none has it."""
    found = (directory.numbers(tag) for directory in directories)
    return next((numbers[0] for numbers in found if numbers), 0.0)


def _stated_black(pixels: Directory | None) -> NDArray[np.float64] | None:
    """Return DNG's BlackLevel for the visible block, (2, 2) float64; None where LibRaw is needed for it.

    LibRaw cuts the level to an integer. The rows and columns of BlackLevel count from the active area's corner
    (DNG 1.7, BlackLevel); deltas per row and column enter by their mean, as in LibRaw.
    """
    if pixels is None or not pixels.numbers(TiffTag.BLACK_LEVEL):
        return None
    levels = np.array(pixels.numbers(TiffTag.BLACK_LEVEL), dtype=np.float64)
    shape = pixels.integers(TiffTag.BLACK_LEVEL_REPEAT_DIM) or (1, 1)
    if shape not in ((1, 1), (1, 2), (2, 1), (2, 2)) or levels.size != shape[0] * shape[1]:
        return None
    deltas = [pixels.numbers(tag) for tag in (TiffTag.BLACK_LEVEL_DELTA_H, TiffTag.BLACK_LEVEL_DELTA_V)]
    extra = sum(float(np.mean(delta)) for delta in deltas if delta)
    black = np.broadcast_to(levels.reshape(shape), (2, 2)) + extra
    black.setflags(write=False)
    return black


def _active_area(pixels: Directory | None, sensor: tuple[int, int]) -> Area | None:
    """Return the visible area that a DNG states; LibRaw would make its top even for a Canon, dcraw does not."""
    areas = _stated_areas(pixels, TiffTag.ACTIVE_AREA, sensor)
    return areas[0] if areas and min(areas[0].height, areas[0].width) >= 2 else None


def _stated_areas(pixels: Directory | None, tag: TiffTag, sensor: tuple[int, int]) -> tuple[Area, ...]:
    """Return the rectangles of `tag`, stored as top, left, bottom, right, that lie on the sensor."""
    edges = () if pixels is None else pixels.integers(tag)
    return tuple(
        Area(top, left, bottom - top, right - left)
        for top, left, bottom, right in zip(*(iter(edges),) * 4, strict=False)
        if 0 <= top < bottom <= sensor[0] and 0 <= left < right <= sensor[1]
    )


# Counts of black from which on a photosite that is far below it is none; cameras without such a level cut at zero.
_LEAST_BLACK = 16

_TILE = (32, 256)  # Rows and columns of the smallest part that is looked at: the least that is stored by itself

_LARGEST = 65535  # The largest count: what ones are read as


def _require_levels(path: Path, black: NDArray[np.float64], white_level: float, bits: int) -> None:
    """Refuse a file whose black and white level are none of a sensor of so many `bits`.

    `black`: (2, 2) counts. A mean of deltas may take a black level of zero below it, by a part of a count.
    """
    if not 0 < white_level <= 1 << bits:
        raise _unreadable(path, f"its white level is {white_level:g}, 1 to {1 << bits} expected of {bits} bits")
    if not -1 < black.min() <= black.max() < white_level:
        raise _unreadable(
            path,
            f"its black level is {black.min():g} to {black.max():g}, 0 to its white level of {white_level:g} expected",
        )


def filled_fault(counts: NDArray[np.uint16], black: NDArray[np.float64], white_level: int) -> str | None:
    """Return which part of a frame is no exposure, as of a file that was cut and filled up; None if none is.

    `counts`: (H, W) of the visible area; `black`: (2, 2) counts. A row, or a tile of 32×256, in which no photosite
    reaches half of the black level is none that a sensor gives, whose dark is that level and noise about it; where it
    has no such level, one of nothing but zeros. Nor is one of nothing but ones, where white is far below them.
    """
    level = float(black.min())
    floor = level / 2 if level >= _LEAST_BLACK else 1
    reached = f"half of its black level of {level:g} counts" if level >= _LEAST_BLACK else "one count"
    brightest, brightest_of_tiles = _of_rows_and_tiles(np.maximum, counts)
    low = _extent_text(np.flatnonzero(brightest < floor), counts.shape)
    if low is None:
        low = _extent_text(np.argwhere(brightest_of_tiles < floor), counts.shape)
    if low is not None:
        return f"{low} do not reach {reached}, as where a cut file was filled with zeros"
    if white_level > _LARGEST // 2 or brightest.max() < _LARGEST:
        return None
    darkest, darkest_of_tiles = _of_rows_and_tiles(np.minimum, counts)
    high = _extent_text(np.flatnonzero(darkest == _LARGEST), counts.shape)
    if high is None:
        high = _extent_text(np.argwhere(darkest_of_tiles == _LARGEST), counts.shape)
    return None if high is None else f"{high} have nothing but the count {_LARGEST}, as where lost bytes are all ones"


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    return min(_TILE[0], shape[0]), min(_TILE[1], shape[1])


def _of_rows_and_tiles(extreme: np.ufunc, counts: NDArray[np.uint16]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return the largest or least count of each row and each tile; what is left at the edges belongs to the last."""
    height, width = _tile_size(counts.shape)
    # Along the rows first: `reduceat` across those of a whole frame takes 45 times as long.
    parts = extreme.reduceat(counts, range(0, counts.shape[1] - width + 1, width), axis=1)
    tiles = extreme.reduceat(parts, range(0, counts.shape[0] - height + 1, height), axis=0)
    return extreme.reduce(parts, axis=1), tiles


def _extent_text(found: NDArray[np.intp], shape: tuple[int, ...]) -> str | None:
    """Return in words which rows, or which tiles, were found; None where none was."""
    if not len(found):
        return None
    if found.ndim == 1:
        return f"{len(found)} of its {shape[0]} rows, from row {found[0]},"
    height, width = _tile_size(shape)
    return f"{len(found)} parts of {height}×{width}, from row {found[0][0] * height}, column {found[0][1] * width},"


Channel = Literal["R", "G", "B"]
CHANNELS: tuple[Channel, Channel, Channel] = ("R", "G", "B")

# Counts above this share of saturation are treated as clipped (judgement: the knee of the response lies above).
CLIPPING_SHARE = 0.98

# Percentile of the counts that stands for paper: bare paper is more than a fiftieth of a picture, hot photosites and
# highlights are less.
PAPER_PERCENTILE = 98


@dataclass(frozen=True, eq=False)
class Plane:
    """One colour of a mosaic: `values` (H // 2, W // 2) float32, counts above black; `offset_px` (x, y).

    The element [i, j] was measured at the half-size place x = j + offset_px[0], y = i + offset_px[1]. A half-size
    pixel is a 2×2 block of photosites; x to the right, y down, centres at whole numbers.
    """

    channel: Channel
    values: NDArray[np.float32]
    offset_px: tuple[float, float]


def phases(mosaic: Mosaic) -> dict[Channel, tuple[tuple[int, int], ...]]:
    """Return which (row, column) of the 2×2 block carry each colour."""
    found: dict[Channel, tuple[tuple[int, int], ...]] = {}
    for channel in CHANNELS:
        found[channel] = tuple(divmod(place, 2) for place, letter in enumerate(mosaic.pattern) if letter == channel)
    return found


def channel_offset_px(places: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return where photosites at `places` of the block lie from its centre, half-size px (x, y): 0 or ±0.25."""
    rows, columns = np.mean(np.asarray(places, dtype=np.float64), axis=0)
    return (float(columns) - 0.5) / 2, (float(rows) - 0.5) / 2


def frame_black(mosaic: Mosaic) -> NDArray[np.float64]:
    """Return the black level (2, 2) float64 of each position of the block: measured in the masked border, or stated."""
    measured = mosaic.masked_black()
    return mosaic.black if measured is None else measured


def plane_of(mosaic: Mosaic, channel: Channel, black: NDArray[np.float64] | None = None) -> Plane:
    """Return one colour of a mosaic above `black`, (2, 2) float64 counts, by default measured from the frame."""
    black = frame_black(mosaic) if black is None else black
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = float(np.mean([black[place] for place in places]))
    values = blocks[places[0]].astype(np.float32)
    for place in places[1:]:
        values += blocks[place]
    values /= len(places)
    values -= level
    return Plane(channel, values, channel_offset_px(places))


def strongest_plane(mosaic: Mosaic, black: NDArray[np.float64] | None = None) -> Plane:
    """Return the colour with the brightest paper; `black` (2, 2) float64 counts as in `plane_of`."""
    black = frame_black(mosaic) if black is None else black
    return plane_of(mosaic, strongest_channel(mosaic, black, every=8), black)


def strongest_channel(mosaic: Mosaic, black: NDArray[np.float64], every: int = 16) -> Channel:
    """Return the colour with the brightest paper, from one block in `every` along rows and columns.

    `black` (2, 2) float64 counts.
    """
    blocks = mosaic.block_planes()[:, :, ::every, ::every]
    levels = [
        max(float(np.percentile(blocks[place], PAPER_PERCENTILE) - black[place]) for place in places)
        for places in phases(mosaic).values()
    ]
    return CHANNELS[int(np.argmax(levels))]
