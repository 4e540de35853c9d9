"""What raw files state of camera, lens and exposure."""

from __future__ import annotations

import struct
from dataclasses import replace

from drivers.raw.rawfile import FrameOrigin, body_and_lens
from drivers.tiff import read_directories


def canon_file(serial: int, lens: bytes) -> bytes:
    """Return a CR2's directories by hand: the first one, Exif with the maker's note alone, Canon's note in it."""

    def directory(*entries: tuple[int, int, int, int]) -> bytes:
        rows = b"".join(struct.pack("<HHII", *entry) for entry in entries)
        return struct.pack("<H", len(entries)) + rows + bytes(4)

    first, exif, note = 16, 40, 64
    text = note + len(directory((0, 0, 0, 0), (0, 0, 0, 0)))
    data = b"II*\0" + struct.pack("<I", first) + b"CR\x02\0" + bytes(4)
    data = (data + directory((34665, 4, 1, exif))).ljust(exif, b"\0")
    data = (data + directory((37500, 7, 64, note))).ljust(note, b"\0")
    return data + directory((0x000C, 4, 1, serial), (0x0095, 2, len(lens), text)) + lens


def test_serial_number_and_lens_of_a_canon_before_exif_2_3() -> None:
    data = canon_file(330101234, b"EF-S18-55mm f/3.5-5.6 IS\0")
    assert body_and_lens(data, read_directories(data)) == ("330101234", "EF-S18-55mm f/3.5-5.6 IS")


def test_a_note_that_is_cut_tells_nothing_and_breaks_nothing() -> None:
    data = canon_file(330101234, b"EF50mm f/1.8 STM\0")
    for length in range(len(data)):
        serial, lens = body_and_lens(data[:length], [])
        assert serial in ("", "330101234")
        assert "EF50mm f/1.8 STM".startswith(lens)


def test_exposure_is_what_counts_are_proportional_to() -> None:
    origin = FrameOrigin("A", "1", "", 100, 8.0, 0.5)
    assert replace(origin, iso=200).exposure == 2 * origin.exposure
    assert replace(origin, aperture=None).exposure == 50
    assert replace(origin, shutter_s=None).exposure == 0
    assert origin.exposure_text == "0.5 s, ISO 100, f/8"
