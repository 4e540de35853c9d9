"""Pinned results for every kind of raw file, complete or damaged."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.raw import rawfile
from drivers.raw.rawfile import CHANNELS, Mosaic, decode_raw, filled_fault, frame_black, plane_of
from drivers.raw.storage import StoredFrame
from drivers.tiff import TiffDamaged, TiffTag, read_directories
from foundation.errors import FormatError
from tests.data_files import shipped
from tests.drivers.raw.maker_files import areas, box, counts_of, cr3, maker_files, track
from tests.drivers.raw.raw_files import cr2_bytes, dng_bytes, longs, ratios, shorts, text
from tests.fuzz.raw import changed, entries
from tests.pinned import Pinned

REAL = {
    name: shipped(f"raw/{name}").read_bytes() for name in ("canon_eos_550d_colorchart.dng", "canon_powershot_g2.crw")
}
TONES, FULL = counts_of(12), counts_of(14)
PLACES = box(b"stsz", struct.pack(">III", 0, 4000, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 700))
BOXES = cr3("Canon EOS R", track(areas(), b"CRAW", (80, 48), *PLACES), pixels=np.random.default_rng(1).bytes(4000))


def result(read: Callable[[], Any]) -> Any:
    """Return the result, or a record of the refusal."""
    try:
        return read()
    except (FormatError, TiffDamaged):
        return {"refused": 1}


def stored(frame: StoredFrame) -> dict[str, Any]:
    """Return the fields of a stored frame without its directory."""
    return {item.name: getattr(frame, item.name) for item in fields(frame) if item.name != "directory"}


def contents(data: bytes) -> Any:
    """Return the frames and directory values of a file."""

    def read() -> Any:
        structure = rawfile._read_contents(Path("case"), data)
        fault = rawfile._lossless_fault(data, structure)
        if fault is not None:
            raise rawfile._unreadable_error(Path("case"), fault)
        values = [value for directory in structure.directories for _, value in sorted(directory.values.items())]
        return {"frames": [*map(stored, structure.frames)], "values": values}

    return result(read)


def measured(mosaic: Mosaic) -> dict[str, Any]:
    """Return all results computed from a frame."""
    black = frame_black(mosaic)
    planes = [plane_of(mosaic, channel) for channel in CHANNELS]

    def thinned(value: Any) -> Any:
        """Return an array; of a large one only some elements."""
        shape: tuple[int, ...] = getattr(value, "shape", ())
        return value[::13, ::11] if np.prod(shape) > 100_000 else value

    return {
        **{item.name: thinned(getattr(mosaic, item.name)) for item in fields(mosaic) if item.name != "sensor"},
        "beside": thinned(mosaic.sensor) if mosaic.masked else mosaic.sensor.shape,
        "masked black": mosaic.masked_black(),
        "saturation": mosaic.saturation(),
        "exposure": mosaic.origin.exposure,
        "strongest": [rawfile.strongest_channel(mosaic, black, every) for every in (1, 8, 16)],
        "planes": np.stack([thinned(plane.values) for plane in planes]),
        "offsets": [plane.offset_px for plane in planes],
        "filled": filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None,
    }


@pytest.mark.slow
def test_files_of_every_maker_match_the_pins(pinned: Pinned) -> None:
    files = {name: data for name, (data, _) in maker_files().items()} | REAL
    files["cr2 in slices"] = cr2_bytes(FULL, "Canon EOS 6D", 400, (2, 30, 20))
    files["dng, active and masked"] = dng_bytes(
        TONES,
        {
            50829: longs(3, 17, 48, 80), 50830: longs(0, 0, 48, 16, 0, 16, 2, 80), 50713: shorts(2, 2),
            50714: ratios((100, 1), (201, 2), (102, 1), (103, 1)), 50716: ratios((1, 2), (3, 2)), 50717: longs(4000),
            271: text("Canon"), 272: text("Canon EOS 5D Mark II"), 33434: ratios((1, 60)), 33437: ratios((56, 10)),
            34855: shorts(640), 42033: text("00123"), 42036: text("EF50mm f/1.8"),
        },
    )  # fmt: skip
    files["dng of tones"] = dng_bytes(TONES, {50712: shorts(*range(0, 65536, 16)), 50717: longs(65535)})
    files["dng in tiles of nothing"] = dng_bytes(np.zeros((40, 300), np.uint16))
    pinned(
        "raw files",
        {name: result(lambda data=data: measured(decode_raw(data, Path("case")))) for name, data in files.items()},
    )


@pytest.mark.slow
def test_damaged_files_match_the_pins(pinned: Pinned) -> None:
    files = {name: data for name, (data, _) in maker_files().items()} | {"cr3": BOXES}
    files["dng, active area"] = dng_bytes(TONES, {50829: longs(2, 4, 48, 80), 50830: longs(0, 0, 48, 4)})
    found: dict[str, Any] = {}
    for name, data in files.items():
        where, chance = entries(data), random.Random(name)
        found[name] = ["refused" in contents(changed(chance, data, where)) for _ in range(16)]
    pinned("raw files with damage", found)


def test_directories_of_all_types_match_the_pins(pinned: Pinned) -> None:
    def one(order: str, tag: int, kind: int, count: int, value: bytes) -> bytes:
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(order + "I", 26)
        head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIHHHI", 42, 8, 1, tag, kind, count)
        return head + place + bytes(4) + value * (len(value) > 4)

    value = bytes([0, 1, 0, 2, 0, 3, 0, 9]) * 3
    tags = (
        TiffTag.BLACK_LEVEL, TiffTag.IMAGE_WIDTH, TiffTag.MODEL, TiffTag.EXPOSURE_TIME, TiffTag.WHITE_LEVEL,
        TiffTag.SUB_IFDS,
    )  # fmt: skip
    found: dict[str, Any] = {}
    for order, tag, kind, count in product("<>", tags, range(14), (1, 2)):
        data = one(order, tag, kind, count, value)
        read = result(lambda data=data: [list(one.values.values()) for one in read_directories(data)])
        found.setdefault(f"{order}{tag.name}", []).append(read)
    pinned("directories of all types", found)
