"""Which camera, lens and exposure a raw file says that it comes from.

Rules that hold inside:

- A pure function of bytes; what a file does not state, or states in a damaged place, is empty or None.
- Exif counts before Canon's own note, which bodies before Exif 2.3 (such as the 550D) have instead.

Sources: Exif 2.32, section 4.6.5 (BodySerialNumber, LensModel); DNG 1.7.1 (CameraSerialNumber). Canon's note is a TIFF
directory without a standard: P. Harvey, ExifTool, lib/Image/ExifTool/Canon.pm (0x000c SerialNumber, 0x0095 LensModel),
whose offsets count from the file's beginning.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.tiff.reading import Directory
from drivers.tiff.tags import TiffTag

_EXIF_POINTER, _NOTE = int(TiffTag.EXIF_IFD_POINTER), 37500
"""Tags (Exif 2.32): of the Exif directory in the first one, and of the maker's note in that."""

_CANON_SERIAL, _CANON_LENS = 0x000C, 0x0095
"""Tags of Canon's note."""

_MOST_ENTRIES = 512
"""Entries of a directory that are looked at; Canon's notes have about sixty."""

_MOST_TEXT = 128
"""Bytes of a lens's name that are read; Canon's take seventy."""


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


def ciff_camera(data: bytes | memoryview) -> tuple[str, str]:
    """Return maker and model from Canon's CRW heap; two empty strings for any other file.

    Source: Canon, CIFF 1.0 revision 4: a heap ends with the offset of its table; 0x300A is the heap of the
    picture's properties, 0x2807 in it that of the camera, 0x080A in that the text of maker and model.
    """
    if data[6:14] != b"HEAPCCDR":
        return "", ""
    try:
        start, end = struct.unpack_from("<I", data, 2)[0], len(data)
        for wanted in (0x300A, 0x2807, 0x080A):
            table = start + struct.unpack_from("<I", data, end - 4)[0]
            (count,) = struct.unpack_from("<H", data, table)
            for number in range(count):
                kind, size, offset = struct.unpack_from("<HII", data, table + 2 + 10 * number)
                if kind == wanted:
                    start, end = start + offset, start + offset + size
                    break
            else:
                return "", ""
        maker, model, *_ = bytes(data[start:end]).split(b"\0")
    except (struct.error, ValueError):
        return "", ""
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
