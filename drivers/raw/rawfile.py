"""Read raw files: the unprocessed counts of the sensor with metadata (`Mosaic`), and planes of one colour (`Plane`).

- Nothing is subtracted, scaled, rotated or interpolated. `Mosaic.counts` equals the output of ``dcraw -D -4 -T``, but
  without rotation.
- Any bytes give a `Mosaic` or raise one `FormatError`. LibRaw reports no error if pixels are missing. Therefore we
  check that each sensor image in the file is complete, and that LibRaw's result has the size of one of them. In files
  other than TIFF and CR3 (see `layout_is_known`), only the size and empty parts of the frame are checked.
- LibRaw is called only here. DNG files whose counts are stored as in memory are read without it, with the same result.

Sources: TIFF 6.0 (strips), TIFF technical note 1 and DNG 1.7.1 (tiles; CameraSerialNumber; ActiveArea, the origin of
colour filters and black levels). LibRaw 0.22, src/metadata/tiff.cpp, for the selected directory, size and packing. Exif
2.32, section 4.6.5 (BodySerialNumber, LensModel). Canon bodies before Exif 2.3 write a maker note that no standard
defines. It is a TIFF directory with offsets from the start of the file. Its source is P. Harvey, ExifTool,
lib/Image/ExifTool/Canon.pm (0x000c SerialNumber, 0x0095 LensModel).
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

from drivers.camera import camera_name
from drivers.raw.lossless_jpeg import jpeg_size, lossless_fault
from drivers.raw.storage import (
    LEAST_BITS,
    Area,
    Cr3,
    Extent,
    NotBayer,
    RawDamaged,
    RawUnsupported,
    StoredFrame,
    ciff_entries,
    read_cr3,
)
from drivers.tiff import CFA, Directory, Tags, TiffDamaged, TiffTag, ValueType, head, is_tiff, read_directories, text
from foundation.errors import FormatError
from foundation.files import read_buffer
from foundation.robust import MAD_TO_SIGMA

if TYPE_CHECKING:
    from rawpy import RawPy


# Tags of the Exif directory, and of the maker note in this directory (Exif 2.32).
_EXIF_POINTER, _MAKER_NOTE = int(TiffTag.EXIF_IFD_POINTER), 37500

_CANON_SERIAL, _CANON_LENS = 0x000C, 0x0095  # Tags of Canon's maker note

_MAX_ENTRIES = 512  # Most entries that are read from a directory; Canon's maker notes have about 60

_MAX_TEXT = 128  # Longest lens name that is read, bytes; Canon's names have at most 70


@dataclass(frozen=True)
class FrameOrigin:
    """Camera, lens and exposure that a raw file states.

    - `camera`: maker and model, ``Canon EOS 550D``; empty if not stated.
    - `serial`: serial number of the body; empty if not stated.
    - `lens`: lens model; empty if not stated, as for a lens without contacts.
    - `iso`, `aperture`, `shutter_s`: ISO speed, f-number and exposure time in seconds; None if not stated.
    """

    camera: str = ""
    serial: str = ""
    lens: str = ""
    iso: int | None = None
    aperture: float | None = None
    shutter_s: float | None = None

    @property
    def exposure(self) -> float:
        """Shutter time × ISO speed / f-number², seconds, to which the counts are proportional; 0 if not stated."""
        if self.shutter_s is None or self.iso is None:
            return 0.0
        # For a lens without contacts no f-number is stated, but its aperture does not change.
        return self.shutter_s * self.iso / (self.aperture or 1.0) ** 2

    @property
    def exposure_text(self) -> str:
        """The exposure as text, such as ``1/60 s, ISO 100, f/8``."""
        if self.shutter_s is None or self.iso is None:
            return "no exposure recorded"
        shutter = f"{self.shutter_s:.3g} s" if self.shutter_s >= 0.3 else f"1/{1 / max(self.shutter_s, 1e-6):.0f} s"
        return f"{shutter}, ISO {self.iso}" + (f", f/{self.aperture:.3g}" if self.aperture else "")


def read_serial_and_lens(data: bytes | memoryview, directories: Sequence[Directory]) -> tuple[str, str]:
    """Return the serial number of the body and the lens model from the bytes of a file; empty if not stated."""
    serial = _first_text(directories, (TiffTag.BODY_SERIAL_NUMBER, TiffTag.CAMERA_SERIAL_NUMBER))
    lens = _first_text(directories, (TiffTag.LENS_MODEL,))
    if serial and lens:
        return serial, lens
    canon_serial, canon_lens = _read_canon_note(data)
    return serial or canon_serial, lens or canon_lens


def _read_ciff_camera(data: bytes | memoryview) -> tuple[str, str]:
    """Return maker and model of a Canon CRW (heap 0x080A); empty for other files."""
    start, size = ciff_entries(data).get(0x080A, (0, 0))
    maker, model, *_ = (*bytes(data[start : start + size]).split(b"\0"), b"", b"")
    return maker.decode("ascii", "replace"), model.decode("ascii", "replace")


def _first_text(directories: Sequence[Directory], tags: Sequence[TiffTag]) -> str:
    texts = (directory.text(tag) for tag in tags for directory in directories)
    return next((text for text in texts if text), "")


def _read_canon_note(data: bytes | memoryview) -> tuple[str, str]:
    """Return the serial number and lens model from Canon's maker note in a CR2; empty if not stated."""
    if bytes(data[:2]) not in (b"II", b"MM") or bytes(data[8:10]) != b"CR":
        return "", ""
    order = "<" if bytes(data[:2]) == b"II" else ">"
    try:
        (offset,) = struct.unpack_from(order + "I", data, 4)
        for tag in (_EXIF_POINTER, _MAKER_NOTE):
            entry = _read_entries(data, order, offset).get(tag)
            if entry is None:
                return "", ""
            offset = entry[1]
        note = _read_entries(data, order, offset)
    except struct.error:
        return "", ""
    serial_entry, lens_entry = note.get(_CANON_SERIAL), note.get(_CANON_LENS)
    serial = "" if serial_entry is None or serial_entry[0] != 1 or serial_entry[1] == 0 else str(serial_entry[1])
    if lens_entry is None or lens_entry[0] <= 4:
        return serial, ""
    name = bytes(data[lens_entry[1] : lens_entry[1] + min(lens_entry[0], _MAX_TEXT)])
    return serial, name.split(b"\0")[0].decode("ascii", "replace").strip()


def _read_entries(data: bytes | memoryview, order: str, start: int) -> dict[int, tuple[int, int]]:
    """Return the entries of a directory by tag: number of values, and the value or its offset."""
    (count,) = struct.unpack_from(order + "H", data, start)
    entries: dict[int, tuple[int, int]] = {}
    for number in range(min(count, _MAX_ENTRIES)):
        tag, _, value_count, value = struct.unpack_from(order + "HHII", data, start + 2 + 12 * number)
        entries[tag] = value_count, value
    return entries


# Matrix from CIE XYZ (D65, Y = 1) to linear camera RGB, three rows of three numbers.
Matrix = tuple[tuple[float, float, float], ...]

_SIDE = 32  # Height and width of the raw file in `camera_matrix`, photosites; LibRaw requires at least 22


@lru_cache(maxsize=64)
def camera_matrix(camera: str) -> Matrix | None:
    """Return the colour matrix that LibRaw has for a camera, such as ``Canon EOS 550D``; None if it has none."""
    # LibRaw gives the matrix only for a file, so a small raw file with the camera's name is made.
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


_SKIPPED_COLUMNS = 4  # First columns of a masked area, which the readout of a row disturbs (observed on the 550D)

_MIN_MASKED = 256  # Fewest masked photosites for each position of the 2×2 block, for a reliable mean

# If at least this number of photosites has the highest count, it is the saturation level. Noise gives fewer equal
# counts.
_PLATEAU_PHOTOSITES = 64


@dataclass(frozen=True, eq=False)
class Mosaic:
    """One raw frame as the sensor recorded it; all arrays are read-only.

    - `counts`: (H, W) uint16, unprocessed counts of the visible area, a view into `sensor`. H and W may be odd.
    - `pattern`: colours of the 2×2 block at the top left of the visible area, row by row; one of `BAYER_PATTERNS`.
    - `black`: (2, 2) float64, black level of each position of that block, counts, from the metadata. For Canon's own
      formats, LibRaw measures it in the masked borders and truncates it to an integer.
    - `white_level`: counts, from the metadata or LibRaw. The real saturation level may be lower, see `saturation`. An
      EOS 550D states 15 831 and saturates at 13 584 (ISO 100).
    - `camera`: maker and model, ``Canon EOS 550D``; empty if not stated.
    - `sensor`: (RH, RW) uint16, counts of the whole sensor with its masked borders.
    - `visible`: area of `counts` on the sensor.
    - `masked`: optically black areas in sensor coordinates; empty if none is known.
    - `iso`, `aperture`, `shutter_s`: stated ISO speed, f-number and shutter time in seconds; None if not stated.
    - `serial`, `lens`: serial number of the body and lens model; empty if not stated.
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
        """Camera, lens and exposure as stated in the file."""
        return FrameOrigin(self.camera, self.serial, self.lens, self.iso, self.aperture, self.shutter_s)

    def masked_black(self) -> NDArray[np.float64] | None:
        """Return the black level measured in the masked areas.

        Returns
        -------
        (2, 2) float64, counts, or None
            Mean for each position of the top left visible block, not truncated to an integer. The mean excludes the
            first four columns of each area, and photosites more than six robust standard deviations from the median.
            None if the masked areas are too small.
        """
        means = np.empty((2, 2))
        for row in range(2):
            for column in range(2):
                phase_counts = [self._masked_phase(area, row, column) for area in self.masked]
                # A histogram is faster, because there are few different counts.
                frequencies = np.bincount(np.concatenate(phase_counts)) if phase_counts else np.zeros(0, dtype=np.int64)
                if frequencies.sum() < _MIN_MASKED:
                    return None
                values = np.flatnonzero(frequencies).astype(np.float64)
                frequencies = frequencies[frequencies > 0]
                median = _median(values, frequencies)
                spread = MAD_TO_SIGMA * _median(np.abs(values - median), frequencies)
                inliers = np.abs(values - median) <= 6 * max(spread, 1.0)
                means[row, column] = (values * frequencies)[inliers].sum() / frequencies[inliers].sum()
        return means

    def saturation(self) -> int:
        """Return the saturation level of this frame, counts.

        It is the stated white level, or the highest count if this is lower and at least 64 photosites have it. In a
        frame without clipped photosites, the stated level may be too high. This does no harm, because no count is near
        it.
        """
        top = int(self.counts.max())
        has_plateau = top < self.white_level and int(np.count_nonzero(self.counts == top)) >= _PLATEAU_PHOTOSITES
        return top if has_plateau else self.white_level

    def block_planes(self) -> NDArray[np.uint16]:
        """Return the four positions of the 2×2 blocks as planes, (2, 2, H/2, W/2), a view of `counts`.

        ``[r, c, i, j]`` is ``counts[2 i + r, 2 j + c]``. If H or W is odd, the last row or column is left out.
        """
        height, width = (size // 2 for size in self.counts.shape)
        down, right = self.counts.strides
        return np.lib.stride_tricks.as_strided(
            self.counts, (2, 2, height, width), (down, right, 2 * down, 2 * right), writeable=False
        )

    def _masked_phase(self, area: Area, row: int, column: int) -> NDArray[np.uint16]:
        """Return the photosites of a masked area with the colour filter of position (`row`, `column`) of the block."""
        top, left = area.top, area.left + _SKIPPED_COLUMNS
        top += (self.visible.top + row - top) % 2
        left += (self.visible.left + column - left) % 2
        block = self.sensor[top : area.top + area.height : 2, left : area.left + area.width : 2]
        return block.ravel()


def _median(values: NDArray[np.float64], frequencies: NDArray[np.int64]) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(frequencies[order])
    middle = np.searchsorted(cumulative, ((cumulative[-1] - 1) // 2, cumulative[-1] // 2), side="right")
    return float(values[order][middle].mean())


# Sensor size and LibRaw's visible area of Canon cameras for which dcraw has one more row at the top, because LibRaw
# makes an odd top margin even. Measured with dcraw 9.28 and LibRaw 0.22 on CR2 files. Cameras in this order: 50D;
# 1D Mark IV; 550D, 600D and 60D; 7D; 5D Mark II.
_AREAS_WITH_EXTRA_ROW = {
    ((3228, 4832), Area(52, 62, 3176, 4770)),
    ((3318, 5120), Area(46, 142, 3272, 4916)),
    ((3516, 5344), Area(52, 142, 3464, 5202)),
    ((3516, 5360), Area(52, 158, 3464, 5202)),
    ((3804, 5792), Area(52, 158, 3752, 5634)),
}

# Number of masked columns at the left that are not black: at the edge of the sensor, and next to the visible area.
# Source: LibRaw 0.22, src/metadata/identify.cpp, table of Canon's sensors.
_UNUSABLE_BLACK_COLUMNS = {
    "Canon EOS R10": (16, 48),
    "Canon EOS R6m2": (16, 48),
    "Canon EOS R6 Mark II": (16, 48),
    "Canon EOS R5m2": (128, 4),
    "Canon EOS R5 Mark II": (128, 4),
}

# Optically black areas by camera and sensor size, from rawspeed's cameras.xml. The areas do not overlap.
_MASKED_AREAS = {
    ("Canon EOS 550D", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS REBEL T2i", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS Kiss X4", (3516, 5344)): (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204)),
    ("Canon EOS 6D Mark II", (4224, 6384)): (Area(0, 2, 4224, 116), Area(8, 118, 32, 6266)),
}


def read_raw(path: Path) -> Mosaic:
    """Read a raw file of a Bayer sensor: CR2, CR3, CRW, DNG, or another format of LibRaw."""
    return decode_raw(_read_bytes(path), path)


def decode_raw(data: bytes | memoryview, path: Path, *, is_verified: bool = False) -> Mosaic:
    """Return the mosaic of the bytes of a raw file; `path` is the file in messages.

    `is_verified`: whether the same bytes were decoded before; the lossless JPEG is then not checked again.
    """
    if not data:
        raise _unreadable_error(path, "it is empty")
    contents = _read_contents(path, data)
    plain_mosaic = _plain_mosaic(path, data, contents)
    if plain_mosaic is not None:
        return plain_mosaic
    with ThreadPoolExecutor(1, "LibRaw") as executor:
        # LibRaw releases Python's interpreter lock, so it decodes while this thread checks.
        mosaic = executor.submit(_decode_with_libraw, path, data, contents)
        fault = None if is_verified else _lossless_fault(data, contents)
    if fault is not None:
        raise _unreadable_error(path, fault)
    return mosaic.result()


def _lossless_fault(data: bytes | memoryview, contents: _Contents) -> str | None:
    extents = {extent for frame in contents.frames if frame.lossless for extent in frame.extents}
    faults = (lossless_fault(data[offset : offset + size]) for offset, size in extents)
    return next((fault for fault in faults if fault is not None), None)


def _decode_with_libraw(path: Path, data: bytes | memoryview, contents: _Contents) -> Mosaic:
    import rawpy

    with _libraw_silenced():
        try:
            # The file is not closed, because the counts are in LibRaw's memory. The last view of them frees it.
            return _mosaic_from_libraw(path, rawpy.imread(io.BytesIO(data)), data, contents)
        except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
            raise _unreadable_error(path, f"LibRaw reports {_reason(error)}") from error
        except (MemoryError, NotImplementedError, RuntimeError, ValueError) as error:
            raise _unreadable_error(path, str(error) or type(error).__name__) from error


_LOSSLESS_BITS = 1.0  # Fewest bits per photosite in a lossless JPEG (ITU-T T.81, annex H)

# Codes of the tag Compression (TIFF 6.0; DNG 1.7.1, chapter 3; _SONY is Sony's own).
_UNCOMPRESSED, _OLD_JPEG, _JPEG, _SONY, _LOSSY_JPEG = 1, 6, 7, 32767, 34892

# Compressions of DNG that our LibRaw does not support (DNG 1.7.1, chapter 3; 32946 is Adobe's older code).
_UNSUPPORTED = {8: "Deflate", 32946: "Deflate", 9: "VC-5", 52546: "JPEG XL"}

# Starts of the names of makers whose TIFF files state size and position of the raw pixels in standard tags.
_MAKERS = ("nikon", "sony", "pentax", "ricoh", "olympus", "om digital", "samsung", "hasselblad")

# Tags of tables through which LibRaw maps the stored values.
_TONE_TABLES = (TiffTag.LINEARIZATION_TABLE, TiffTag.GRAY_RESPONSE_CURVE)

_LINEAR_RAW = 34892  # PhotometricInterpretation of pixels with all colours (DNG 1.7.1)


LAYOUT_START = 12  # Number of bytes at the start of a file that identify its layout


def layout_is_known(start: bytes | memoryview) -> bool:
    """Return whether a file is a TIFF or CR3, whose storage can be checked; `start`: first `LAYOUT_START` bytes."""
    # Panasonic's files are almost TIFF, but their pixel tags have other meanings.
    return bytes(start[4:12]) == _CR3_START or (is_tiff(start) and start[:4] != b"IIU\0")


_CR3_START = b"ftypcrx "  # Type and brand of the first box of a CR3, after its size


def stored_frames(data: bytes | memoryview, directories: Sequence[Directory]) -> list[StoredFrame]:
    """Return the frames of a TIFF file with these directories, the largest first; see `check_frames`."""
    frames = list(_tiff_frames(data, directories))
    return sorted(check_frames(data, frames), key=lambda frame: -frame.rows * frame.columns)


def check_frames(data: bytes | memoryview, frames: Sequence[StoredFrame]) -> Sequence[StoredFrame]:
    """Return `frames`; raise RawDamaged if there are none, or if one has missing, overlapping or too few bytes."""
    if not frames:
        raise RawDamaged("it describes no sensor pixels")
    for frame in frames:
        if not (0 < frame.rows < 1 << 16 and 0 < frame.columns < 1 << 16):
            raise RawDamaged(f"it records a sensor of {frame.columns}×{frame.rows} px, expected 1 to 65535 px")
        extents = sorted(frame.extents)
        for offset, size in extents:
            if size <= 0 or offset + size > len(data):
                raise RawDamaged(f"its pixels are at bytes {offset} to {offset + size}, the file has {len(data)}")
        for (first, size), (following, _) in pairwise(extents):
            if first + size > following:
                raise RawDamaged(f"parts of its pixels overlap at byte {following}")
        size, photosites = sum(size for _, size in extents), frame.rows * frame.columns
        if 8 * size < photosites * frame.least_bits:
            raise RawDamaged(
                f"it has {size} bytes for {photosites} photosites, expected at least {frame.least_bits:.3g} bits per "
                "photosite"
            )
    return frames


def _tiff_frames(data: bytes | memoryview, directories: Sequence[Directory]) -> Iterator[StoredFrame]:
    # LibRaw treats a DNG version of only zeros as missing.
    is_dng = any(any(directory.integers(TiffTag.DNG_VERSION)) for directory in directories)
    is_canon = bytes(data[8:10]) == b"CR" and not is_dng
    maker = next((name for directory in directories if (name := directory.text(TiffTag.MAKE))), "")
    # Olympus files state photometric interpretation 1, grey, for their raw pixels.
    interpretations = {CFA, 1} if data[2:4] in (b"RO", b"RS", b"OR") else {CFA}
    for directory in directories:
        if is_canon:
            frame = _cr2_frame(data, directory)
            if frame is not None:
                yield frame
            continue
        interpretation = directory.first(TiffTag.PHOTOMETRIC_INTERPRETATION)
        if is_dng and directory.first(TiffTag.NEW_SUBFILE_TYPE) == 0 and interpretation == _LINEAR_RAW:
            raise NotBayer("its pixels have all colours (LinearRaw)")
        if interpretation not in interpretations or (is_dng and directory.first(TiffTag.NEW_SUBFILE_TYPE)):
            continue
        if not is_dng and not maker.casefold().startswith(_MAKERS):
            raise RawUnsupported(f"the layout of files by {maker or 'an unnamed maker'} cannot be checked")
        for table in (directory.integers(tag) for tag in _TONE_TABLES):
            if table and (list(table) != sorted(table) or table[0] == table[-1]):
                raise RawDamaged("its linearisation table does not rise")
        yield (_dng_frame if is_dng else _maker_frame)(data, directory, _read_extents(directory))


def _read_extents(directory: Directory) -> tuple[Extent, ...]:
    """Return the strips or tiles of a directory; if both are stated, as in Sony's files, the tiles."""
    offsets_tag, sizes_tag = (
        (TiffTag.TILE_OFFSETS, TiffTag.TILE_BYTE_COUNTS)
        if directory.integers(TiffTag.TILE_OFFSETS)
        else (TiffTag.STRIP_OFFSETS, TiffTag.STRIP_BYTE_COUNTS)
    )
    offsets, sizes = directory.integers(offsets_tag), directory.integers(sizes_tag)
    if len(offsets) != len(sizes):
        raise RawDamaged(f"it lists {len(offsets)} offsets and {len(sizes)} sizes, expected equal numbers")
    return tuple(zip(offsets, sizes, strict=True))


def _are_contiguous(extents: Sequence[Extent]) -> bool:
    return all(offset + size == following for (offset, size), (following, _) in pairwise(extents))


def _dng_frame(data: bytes | memoryview, directory: Directory, extents: tuple[Extent, ...]) -> StoredFrame:
    rows, columns = directory.first(TiffTag.IMAGE_LENGTH), directory.first(TiffTag.IMAGE_WIDTH)
    compression, bits = (
        directory.first(TiffTag.COMPRESSION),
        max(directory.integers(TiffTag.BITS_PER_SAMPLE), default=0),
    )
    if directory.first(TiffTag.SAMPLES_PER_PIXEL) > 1:
        raise NotBayer(f"it has {directory.first(TiffTag.SAMPLES_PER_PIXEL)} samples per pixel, expected 1")
    if compression not in (_UNCOMPRESSED, _JPEG, _LOSSY_JPEG):
        name = _UNSUPPORTED.get(compression, f"number {compression}")
        raise RawUnsupported(f"its compression is {name}, which is not supported")
    # With a linearisation table, all counts of 16 bits are possible.
    count_bits = 16 if any(directory.integers(tag) for tag in _TONE_TABLES) else min(bits, 16)
    if not 8 <= bits <= 16 or directory.first(TiffTag.SAMPLE_FORMAT) > 1:
        raise RawUnsupported(f"its photosites have {bits} bits or are not integers, expected integers of 8 to 16 bits")
    is_tiled = bool(directory.integers(TiffTag.TILE_OFFSETS))
    part_height = directory.first(TiffTag.TILE_LENGTH if is_tiled else TiffTag.ROWS_PER_STRIP)
    part_width = directory.first(TiffTag.TILE_WIDTH) if is_tiled else columns
    part_height = part_height if is_tiled else min(part_height or rows, rows)
    if part_height <= 0 or part_width <= 0:
        raise RawDamaged(f"its strips or tiles have {part_width}×{part_height} px, expected at least 1×1 px")
    across, down = -(-columns // part_width), -(-rows // part_height)
    if len(extents) != across * down:
        raise RawDamaged(f"its pixels have {len(extents)} strips or tiles, expected {across * down}")
    if compression == _UNCOMPRESSED:
        if not is_tiled and not _are_contiguous(extents):
            raise RawUnsupported("its strips are not contiguous")
        for number, (_, size) in enumerate(extents):
            row_count = min(part_height, rows - number // across * part_height)
            if 8 * size < (part_height if is_tiled else row_count) * part_width * bits:
                raise RawDamaged(f"strip or tile {number} has {size} bytes for {row_count} rows of {part_width} px")
        return StoredFrame(rows, columns, extents, bits, count_bits, directory=directory)
    if compression == _LOSSY_JPEG:
        return StoredFrame(rows, columns, extents, bits=count_bits, directory=directory)
    # LibRaw decodes only the first strip, and continues a tile that is too wide in the next row.
    if part_width > columns or not (is_tiled or len(extents) == 1):
        raise RawUnsupported("its JPEG has several strips, or tiles wider than the sensor")
    is_lossless = True
    for number, (offset, size) in enumerate(extents):
        row_count = min(part_height, rows - number // across * part_height)
        jpeg = jpeg_size(data[offset : offset + size])
        if jpeg is None or jpeg.rows * jpeg.columns not in (part_height * part_width, row_count * part_width):
            raise RawDamaged(f"strip or tile {number} is not a JPEG of {row_count} rows of {part_width} px")
        is_lossless &= jpeg.lossless
    least_bits = _LOSSLESS_BITS if is_lossless else LEAST_BITS
    return StoredFrame(rows, columns, extents, least_bits, count_bits, lossless=is_lossless, directory=directory)


def _cr2_frame(data: bytes | memoryview, directory: Directory) -> StoredFrame | None:
    """Return the frame of a CR2 directory with a lossless JPEG, from its size; None for other directories."""
    if not directory.integers(TiffTag.STRIP_OFFSETS):
        return None
    offset, size = directory.first(TiffTag.STRIP_OFFSETS), directory.first(TiffTag.STRIP_BYTE_COUNTS)
    jpeg = jpeg_size(data[offset : offset + size])
    if jpeg is None or not jpeg.lossless:
        if directory.integers(TiffTag.CR2_SLICES):
            raise RawDamaged(f"its pixels at byte {offset} are not a lossless JPEG")
        return None
    rows, columns, components, bits, _ = jpeg
    slice_count, slice_width, last_width = (*directory.integers(TiffTag.CR2_SLICES), 0, 0, 0)[:3]
    width = slice_count * slice_width + last_width
    if components % 2 == 0 and slice_count and width != columns:
        raise RawDamaged(f"its {slice_count + 1} slices have {width} columns, expected {columns}")
    if components % 2 == 0 and columns > 4 * rows:
        rows, columns = 2 * rows, columns // 2
    return StoredFrame(rows, columns, ((offset, size),), _LOSSLESS_BITS, bits, lossless=True, directory=directory)


def _maker_frame(data: bytes | memoryview, directory: Directory, extents: tuple[Extent, ...]) -> StoredFrame:
    rows, columns = directory.first(TiffTag.IMAGE_LENGTH), directory.first(TiffTag.IMAGE_WIDTH)
    # Pixels are uncompressed if no compression is stated (TIFF 6.0). Olympus states uncompressed for compressed pixels
    # of 16 bits.
    compression = directory.first(TiffTag.COMPRESSION) or _UNCOMPRESSED
    bits = directory.first(TiffTag.BITS_PER_SAMPLE)
    size, least_bits, spare_rows = sum(size for _, size in extents), LEAST_BITS, 0
    if compression == _UNCOMPRESSED:
        if not 8 <= bits <= 16:
            raise RawDamaged(f"its photosites have {bits} bits, expected 8 to 16")
        if not _are_contiguous(extents):
            raise RawUnsupported("its strips are not contiguous")
        is_grey = directory.first(TiffTag.PHOTOMETRIC_INTERPRETATION) != CFA
        # LibRaw accepts compressed grey pixels from 8/7 bits per photosite on. It reads 16 bits for each photosite of
        # 14 bits, unless the pixels have exactly the size of packed rows that are padded to blocks of 16 bytes.
        size_of_14_bits = rows * -(-columns * 7 // 64) * 16 if columns % 4 == 0 else 0
        least_bits = 8 / 7 if is_grey and bits == 16 else 16 if bits > 12 and size != size_of_14_bits else bits
    elif compression in (_OLD_JPEG, _JPEG):
        least_bits = _LOSSLESS_BITS
        headers = [jpeg_size(data[offset : offset + length]) for offset, length in extents]
        if not all(header is not None and header.lossless for header in headers):
            raise RawDamaged("some of its strips or tiles are not a lossless JPEG")
    elif compression == _SONY and size not in (rows * columns, 2 * rows * columns):
        spare_rows = 8
    return StoredFrame(rows, columns, extents, least_bits, spare_rows=spare_rows, directory=directory)


def _mosaic_from_libraw(path: Path, raw: RawPy, data: bytes | memoryview, contents: _Contents) -> Mosaic:
    import rawpy

    pattern = raw.raw_pattern
    if raw.raw_type is not rawpy.RawType.Flat or pattern is None or pattern.shape != (2, 2):
        raise _not_bayer_error(path, "its colour filters have no 2×2 pattern")
    sizes = raw.sizes
    size = sizes.raw_height, sizes.raw_width
    if contents.frames:
        stored = next((frame for frame in contents.frames if frame.has_size(*size)), None)
    else:
        (stored,) = check_frames(data, [StoredFrame(*size, ((0, len(data)),))])
    if stored is None:
        raise _unsupported_error(
            path,
            f"LibRaw returns {size[1]}×{size[0]} photosites, "
            f"{contents.frames[0].columns}×{contents.frames[0].rows} are stored",
        )
    sensor = raw.raw_image
    # The counts are in the memory of LibRaw's object. If the view does not keep this object alive, copy them.
    if sensor.base is not raw or sensor.dtype != np.uint16:
        sensor = np.array(sensor, dtype=np.uint16)
    sensor.setflags(write=False)
    # If LibRaw decodes nothing, its memory holds random values.
    if stored.bits < 16 and int(sensor.max()) >> stored.bits:
        raise _unreadable_error(path, f"its counts reach {sensor.max()}, expected at most {stored.bits} bits")
    libraw_area = Area(sizes.top_margin, sizes.left_margin, sizes.height, sizes.width)
    rows, columns = sensor.shape
    if (
        libraw_area.top + libraw_area.height > rows
        or libraw_area.left + libraw_area.width > columns
        or min(libraw_area.height, libraw_area.width) < 2
    ):
        raise _unreadable_error(path, f"its visible area {libraw_area} is not inside its {columns}×{rows} sensor")
    directory = stored.directory
    visible = _active_area(directory, (rows, columns)) or _dcraw_frame((rows, columns), libraw_area)
    # rawpy's pattern starts at the corner of the sensor, ours at the corner of the visible area.
    colours = np.roll(pattern, (-visible.top, -visible.left), axis=(0, 1))
    names = raw.color_desc.decode("ascii", "replace")
    letters = "".join(names[index] for index in colours.ravel())
    if letters not in BAYER_PATTERNS:
        raise _not_bayer_error(path, f"its colour filters are {letters}")
    black = np.array(raw.black_level_per_channel, dtype=np.float64)[colours]
    stated_black = _stated_black(directory)
    if stated_black is not None:
        black = stated_black
    white_levels = () if directory is None else directory.numbers(TiffTag.WHITE_LEVEL)
    for level in (raw.white_level, *white_levels):
        _require_levels(path, black, level, stored.bits)
    black.setflags(write=False)
    exposure = raw.other.iso_speed, raw.other.aperture, raw.other.shutter_speed
    mosaic = _assemble_mosaic(data, contents, stored, sensor, visible, letters, black, int(raw.white_level), exposure)
    # LibRaw knows some formats only by the size of the file, so it also accepts a file of zeros.
    fault = None if contents.frames else filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    if fault is not None:
        raise _unreadable_error(path, fault)
    return mosaic


def _assemble_mosaic(
    data: bytes | memoryview,
    contents: _Contents,
    stored: StoredFrame,
    sensor: NDArray[np.uint16],
    visible: Area,
    pattern: str,
    black: NDArray[np.float64],
    white_level: int,
    exposure: tuple[float, float, float],
) -> Mosaic:
    """Return the mosaic of a sensor; `exposure`: ISO speed, f-number and shutter time in seconds, 0 if not stated."""
    directories, cr3 = contents.directories, contents.cr3
    camera = _camera_name(data, directories) if cr3 is None else camera_name(cr3.maker, cr3.model)
    serial, lens = read_serial_and_lens(data, directories if cr3 is None else cr3.exif)
    iso, aperture, shutter_s = exposure
    # If a file states no exposure, LibRaw returns 1 s at f/1, but no ISO speed.
    is_stated = iso > 0
    return Mosaic(
        counts=sensor[visible.top : visible.top + visible.height, visible.left : visible.left + visible.width],
        pattern=pattern,
        black=black,
        white_level=white_level,
        camera=camera,
        sensor=sensor,
        visible=visible,
        masked=_masked_areas(stored.directory, camera, visible, (sensor.shape[0], sensor.shape[1]), cr3),
        iso=round(iso) if is_stated else None,
        aperture=(round(aperture, 4) or None) if is_stated else None,
        shutter_s=(shutter_s or None) if is_stated else None,
        serial=serial,
        lens=lens,
    )


def _read_bytes(path: Path) -> memoryview:
    try:
        data = read_buffer(path)
    except FileNotFoundError as error:
        raise FormatError(f"raw file {path} does not exist; check the name") from error
    except IsADirectoryError as error:
        raise FormatError(f"{path} is a folder, expected a raw file; give one file") from error
    except OSError as error:
        raise FormatError(
            f"cannot read {path}: {error.strerror or error}; check its permissions and the disk"
        ) from error
    return data


@dataclass(frozen=True)
class _Contents:
    """Structure of a file: TIFF directories, content of a CR3, stored frames (none if the layout is not known)."""

    directories: list[Directory]
    cr3: Cr3 | None
    frames: Sequence[StoredFrame]


def _read_contents(path: Path, data: bytes | memoryview) -> _Contents:
    """Return the structure of a file; raise a FormatError if the file cannot hold its stated frames."""
    try:
        cr3 = read_cr3(data) if bytes(data[4:12]) == _CR3_START else None
        directories = read_directories(data) if is_tiff(data) else []
        frames: Sequence[StoredFrame] = ()
        if layout_is_known(data):
            frames = stored_frames(data, directories) if cr3 is None else check_frames(data, cr3.frames)
    except (TiffDamaged, RawDamaged) as error:
        raise _unreadable_error(path, str(error)) from error
    except RawUnsupported as error:
        raise _unsupported_error(path, str(error)) from error
    except NotBayer as error:
        raise _not_bayer_error(path, str(error)) from error
    return _Contents(directories, cr3, frames)


def _camera_name(data: bytes | memoryview, directories: list[Directory]) -> str:
    for directory in directories:
        maker, model = directory.text(TiffTag.MAKE), directory.text(TiffTag.MODEL)
        if model:
            return camera_name(maker, model)
    for directory in directories:
        if directory.text(TiffTag.UNIQUE_CAMERA_MODEL):
            return directory.text(TiffTag.UNIQUE_CAMERA_MODEL)
    return camera_name(*_read_ciff_camera(data))


def _dcraw_frame(sensor: tuple[int, int], libraw_area: Area) -> Area:
    if (sensor, libraw_area) in _AREAS_WITH_EXTRA_ROW:
        return Area(libraw_area.top - 1, libraw_area.left, libraw_area.height + 1, libraw_area.width)
    return libraw_area


def _masked_areas(
    directory: Directory | None, camera: str, visible: Area, sensor: tuple[int, int], cr3: Cr3 | None = None
) -> tuple[Area, ...]:
    """Return the optically black areas: from the file, from `_MASKED_AREAS`, or the usual area of a Canon sensor."""
    stated_areas = _stated_areas(directory, TiffTag.MASKED_AREAS, sensor)
    if stated_areas:
        return stated_areas
    if (camera, sensor) in _MASKED_AREAS:
        return _MASKED_AREAS[camera, sensor]
    # Every Canon sensor has black columns at its left. The four columns next to the visible area may receive light.
    outer, inner = _UNUSABLE_BLACK_COLUMNS.get(camera, (0, 4))
    if not camera.startswith("Canon") or visible.left - outer - inner < _SKIPPED_COLUMNS + 2:
        return ()
    area = Area(visible.top, outer, visible.height, visible.left - outer - inner)
    # No standard describes the areas in a CR3, so they may only reduce the usual area of Canon sensors.
    stated_left = next((black for black in cr3.black if black.left < visible.left), None) if cr3 is not None else None
    if stated_left is not None and stated_left.left + stated_left.width <= visible.left:
        area = _intersection(area, stated_left)
    return (area,) if area.width >= _SKIPPED_COLUMNS + 2 and area.height >= 2 else ()


def _intersection(first: Area, second: Area) -> Area:
    top, left = max(first.top, second.top), max(first.left, second.left)
    bottom = min(first.top + first.height, second.top + second.height)
    right = min(first.left + first.width, second.left + second.width)
    return Area(top, left, max(bottom - top, 0), max(right - left, 0))


def _unreadable_error(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} cannot be read as a raw file: {reason}, expected a camera's complete raw file such as CR2 or DNG; "
        "copy it from the camera again, or repeat the frame"
    )


def _unsupported_error(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} cannot be read as a raw file: {reason}, expected a camera's own raw file such as CR2, CR3 or NEF, "
        "or a DNG with lossless JPEG (from Adobe's DNG Converter or dnglab); convert it to such a DNG"
    )


def _not_bayer_error(path: Path, reason: str) -> FormatError:
    return FormatError(
        f"{path} is not from a Bayer sensor: {reason}, expected a 2×2 pattern of red, green, green and blue; "
        "use a camera with a Bayer sensor, and its full raw format"
    )


def _reason(error: Exception) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return repr(text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text))


_silence_lock = threading.Lock()
_silence_count = 0
_saved_stream: int | None = None


@contextmanager
def _libraw_silenced() -> Generator[None]:
    """Suppress LibRaw's messages about damaged data on stderr; errors are still raised."""
    # LibRaw prints to the stream `stderr` of C, which rawpy cannot redirect. This stream is set to /dev/null while any
    # thread decodes; Python's own stderr is not changed. Without a variable `stderr` in C, nothing is done.
    _count_silencers(1)
    try:
        yield
    finally:
        _count_silencers(-1)


def _count_silencers(step: int) -> None:
    global _silence_count, _saved_stream
    with _silence_lock:
        _silence_count += step
        try:
            stream = ctypes.c_void_p.in_dll(ctypes.CDLL(None), "stderr")
        except (OSError, ValueError, TypeError):
            return
        if step > 0 and _silence_count == 1 and (null := _null_stream()):
            _saved_stream, stream.value = stream.value, null
        elif _silence_count == 0 and _saved_stream is not None:
            stream.value, _saved_stream = _saved_stream, None


@cache
def _null_stream() -> int | None:
    # The stream is never closed, because a C++ library that is loaded meanwhile may use it until the program ends.
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    return libc.fopen(b"/dev/null", b"w")


BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


# Permitted values of tags in a DNG whose counts are stored as in memory.
_PLAIN_TAG_VALUES: dict[TiffTag, tuple[tuple[int, ...], ...]] = {
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
    """Return the mosaic of a DNG whose counts are stored as in memory; None for other files."""
    # LibRaw would copy these counts one by one, which takes longer than all later processing of a frame.
    stored, directories = next(iter(contents.frames), None), contents.directories
    directory = None if stored is None else stored.directory
    if stored is None or directory is None or data[:2] != b"II" or sys.byteorder != "little":
        return None
    if any(directory.integers(tag) not in allowed for tag, allowed in _PLAIN_TAG_VALUES.items()):
        return None
    size = stored.rows, stored.columns
    pattern = directory.integers(TiffTag.CFA_PATTERN)
    white, black = directory.numbers(TiffTag.WHITE_LEVEL), _stated_black(directory)
    letters = "".join("RGB"[index] for index in pattern if 0 <= index < 3)
    if letters not in BAYER_PATTERNS or len(white) != 1 or black is None:
        return None
    visible, start = _active_area(directory, size), stored.extents[0][0]
    is_complete = sum(length for _, length in stored.extents) == 2 * size[0] * size[1]
    if visible is None or not is_complete or start % 2:
        return None
    _require_levels(path, black, int(white[0]), 16)
    sensor = np.frombuffer(data, dtype=np.uint16, count=size[0] * size[1], offset=start).reshape(size)
    iso, aperture, shutter = (
        _first_number(directories, tag)
        for tag in (TiffTag.PHOTOGRAPHIC_SENSITIVITY, TiffTag.F_NUMBER, TiffTag.EXPOSURE_TIME)
    )
    exposure = (iso, aperture, shutter)
    return _assemble_mosaic(data, contents, stored, sensor, visible, letters, black, int(white[0]), exposure)


def _first_number(directories: Sequence[Directory], tag: TiffTag) -> float:
    values = (directory.numbers(tag) for directory in directories)
    return next((numbers[0] for numbers in values if numbers), 0.0)


def _stated_black(directory: Directory | None) -> NDArray[np.float64] | None:
    """Return BlackLevel of a DNG for the visible block, (2, 2) float64; None if LibRaw's level must be used."""
    if directory is None or not directory.numbers(TiffTag.BLACK_LEVEL):
        return None
    # LibRaw would truncate the level to an integer. The pattern starts at the corner of the active area (DNG 1.7,
    # BlackLevel). The mean of the deltas per row and per column is added, as in LibRaw.
    levels = np.array(directory.numbers(TiffTag.BLACK_LEVEL), dtype=np.float64)
    shape = directory.integers(TiffTag.BLACK_LEVEL_REPEAT_DIM) or (1, 1)
    if shape not in ((1, 1), (1, 2), (2, 1), (2, 2)) or levels.size != shape[0] * shape[1]:
        return None
    deltas = [directory.numbers(tag) for tag in (TiffTag.BLACK_LEVEL_DELTA_H, TiffTag.BLACK_LEVEL_DELTA_V)]
    mean_delta = sum(float(np.mean(delta)) for delta in deltas if delta)
    black = np.broadcast_to(levels.reshape(shape), (2, 2)) + mean_delta
    black.setflags(write=False)
    return black


def _active_area(directory: Directory | None, sensor: tuple[int, int]) -> Area | None:
    """Return the visible area that a DNG states; for Canon, LibRaw would change its top to an even row."""
    areas = _stated_areas(directory, TiffTag.ACTIVE_AREA, sensor)
    return areas[0] if areas and min(areas[0].height, areas[0].width) >= 2 else None


def _stated_areas(directory: Directory | None, tag: TiffTag, sensor: tuple[int, int]) -> tuple[Area, ...]:
    """Return the rectangles in `tag` (top, left, bottom, right) that are inside the sensor."""
    edges = () if directory is None else directory.integers(tag)
    return tuple(
        Area(top, left, bottom - top, right - left)
        for top, left, bottom, right in zip(*(iter(edges),) * 4, strict=False)
        if 0 <= top < bottom <= sensor[0] and 0 <= left < right <= sensor[1]
    )


# Least black level, counts, at which every photosite has at least half of it. Noise clips lower levels at zero.
_MIN_BLACK = 16

_TILE = (32, 256)  # Rows and columns of the smallest part that is checked; files store no smaller parts

_LARGEST = 65535  # Largest count of 16 bits


def _require_levels(path: Path, black: NDArray[np.float64], white_level: float, bits: int) -> None:
    """Raise a FormatError if levels are impossible for counts of `bits`; `black`: (2, 2) counts."""
    if not 0 < white_level <= 1 << bits:
        raise _unreadable_error(path, f"its white level is {white_level:g}, expected 1 to {1 << bits} for {bits} bits")
    # The mean of the deltas may reduce a black level of 0 by less than one count.
    if not -1 < black.min() <= black.max() < white_level:
        raise _unreadable_error(
            path,
            f"its black level is {black.min():g} to {black.max():g}, expected 0 to its white level of {white_level:g}",
        )


def filled_fault(counts: NDArray[np.uint16], black: NDArray[np.float64], white_level: int) -> str | None:
    """Describe the part of a frame that was filled with equal bytes, as after a truncation; None if there is none.

    `counts`: (H, W) of the visible area; `black`: (2, 2) counts. Rows, and tiles of 32×256 photosites, are checked.
    Each measured row or tile has a count of at least half of the black level, or 1 if the black level is near zero. If
    the white level is at most half of 65535, it also has a count below 65535.
    """
    level = float(black.min())
    floor = level / 2 if level >= _MIN_BLACK else 1
    floor_text = f"half of its black level of {level:g} counts" if level >= _MIN_BLACK else "one count"
    brightest, brightest_of_tiles = _row_tile_extremes(np.maximum, counts)
    dark_part = _extent_text(np.flatnonzero(brightest < floor), counts.shape)
    if dark_part is None:
        dark_part = _extent_text(np.argwhere(brightest_of_tiles < floor), counts.shape)
    if dark_part is not None:
        return f"{dark_part} do not reach {floor_text}, as in a truncated file that was padded with zeros"
    if white_level > _LARGEST // 2 or brightest.max() < _LARGEST:
        return None
    darkest, darkest_of_tiles = _row_tile_extremes(np.minimum, counts)
    bright_part = _extent_text(np.flatnonzero(darkest == _LARGEST), counts.shape)
    if bright_part is None:
        bright_part = _extent_text(np.argwhere(darkest_of_tiles == _LARGEST), counts.shape)
    return None if bright_part is None else f"{bright_part} have only the count {_LARGEST}, as if bytes were lost"


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    return min(_TILE[0], shape[0]), min(_TILE[1], shape[1])


def _row_tile_extremes(extreme: np.ufunc, counts: NDArray[np.uint16]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return the largest or smallest count of each row and of each tile; the last tiles include the remainder."""
    height, width = _tile_size(counts.shape)
    # Reduce along the rows first, because `reduceat` across the rows of a whole frame is 45 times slower.
    segments = extreme.reduceat(counts, range(0, counts.shape[1] - width + 1, width), axis=1)
    tiles = extreme.reduceat(segments, range(0, counts.shape[0] - height + 1, height), axis=0)
    return extreme.reduce(segments, axis=1), tiles


def _extent_text(indices: NDArray[np.intp], shape: tuple[int, ...]) -> str | None:
    if not len(indices):
        return None
    if indices.ndim == 1:
        return f"{len(indices)} of its {shape[0]} rows, from row {indices[0]},"
    height, width = _tile_size(shape)
    row, column = indices[0][0] * height, indices[0][1] * width
    return f"{len(indices)} parts of {height}×{width}, from row {row}, column {column},"


Channel = Literal["R", "G", "B"]
CHANNELS: tuple[Channel, Channel, Channel] = ("R", "G", "B")

# Counts above this fraction of the saturation level are treated as clipped. Chosen; the response is linear below it.
CLIPPING_SHARE = 0.98

# Percentile of the counts that represents white paper, which covers more of a frame than hot photosites and highlights.
PAPER_PERCENTILE = 98


@dataclass(frozen=True, eq=False)
class Plane:
    """One colour of a mosaic.

    - `values`: (H // 2, W // 2) float32, counts above black.
    - `offset_px`: mean offset (x, y) of the photosites from the centre of their 2×2 block, in half-size pixels. Element
      [i, j] was measured at x = j + offset_px[0] (to the right), y = i + offset_px[1] (down).
    """

    channel: Channel
    values: NDArray[np.float32]
    offset_px: tuple[float, float]


def phases(mosaic: Mosaic) -> dict[Channel, tuple[tuple[int, int], ...]]:
    """Return the positions (row, column) of each colour in the 2×2 block."""
    positions: dict[Channel, tuple[tuple[int, int], ...]] = {}
    for channel in CHANNELS:
        positions[channel] = tuple(divmod(index, 2) for index, letter in enumerate(mosaic.pattern) if letter == channel)
    return positions


def channel_offset_px(positions: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return the mean offset (x, y) of block positions from the block centre, in half-size px: 0 or ±0.25."""
    rows, columns = np.mean(np.asarray(positions, dtype=np.float64), axis=0)
    return (float(columns) - 0.5) / 2, (float(rows) - 0.5) / 2


def frame_black(mosaic: Mosaic) -> NDArray[np.float64]:
    """Return the black level (2, 2) float64 of each block position, measured in the masked border or else as stated."""
    measured = mosaic.masked_black()
    return mosaic.black if measured is None else measured


def plane_of(mosaic: Mosaic, channel: Channel, black: NDArray[np.float64] | None = None) -> Plane:
    """Return one colour of a mosaic above `black`, (2, 2) float64 counts; by default `frame_black`."""
    black = frame_black(mosaic) if black is None else black
    positions = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = float(np.mean([black[position] for position in positions]))
    values = blocks[positions[0]].astype(np.float32)
    for position in positions[1:]:
        values += blocks[position]
    values /= len(positions)
    values -= level
    return Plane(channel, values, channel_offset_px(positions))


def strongest_plane(mosaic: Mosaic, black: NDArray[np.float64] | None = None) -> Plane:
    """Return the plane of the colour with the brightest paper; `black` as in `plane_of`."""
    black = frame_black(mosaic) if black is None else black
    return plane_of(mosaic, strongest_channel(mosaic, black, every=8), black)


def strongest_channel(mosaic: Mosaic, black: NDArray[np.float64], every: int = 16) -> Channel:
    """Return the colour with the brightest paper, using each `every`-th block; `black` (2, 2) float64 counts."""
    blocks = mosaic.block_planes()[:, :, ::every, ::every]
    levels = [
        max(float(np.percentile(blocks[position], PAPER_PERCENTILE) - black[position]) for position in positions)
        for positions in phases(mosaic).values()
    ]
    return CHANNELS[int(np.argmax(levels))]
