"""What every kind of raw file, whole or damaged, is read as, and what is written of one, byte by byte."""

from __future__ import annotations

import io
import random
import struct
from collections.abc import Callable
from dataclasses import fields, replace
from datetime import UTC, datetime
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import tiff
from drivers.camera import ExposureSettings
from drivers.raw import rawfile
from drivers.raw.lossless_jpeg import jpeg_size, lossless_fault
from drivers.raw.rawfile import CHANNELS, FrameOrigin, Mosaic, decode_raw, filled_fault, frame_black, plane_of
from drivers.raw.storage import Area, Cr3, Stored, ciff_entries, read_cr3
from drivers.tiff import TiffDamaged, TiffTag, ValueType, read_directories
from foundation.errors import FormatError
from sim.camera.film import write_dng
from sim.world.sensors import BODIES, FACTS, Rectangle
from tests.data_files import shipped
from tests.drivers.raw.maker_files import areas, box, counts_of, cr3, maker_files, packed, track
from tests.drivers.raw.raw_files import Tags, cr2_bytes, dng_bytes, longs, lossless_jpeg, ratios, shorts, text
from tests.fuzz.raw import changed, entries
from tests.pinned import Pinned

REAL = {
    name: shipped(f"raw/{name}").read_bytes() for name in ("canon_eos_550d_colorchart.dng", "canon_powershot_g2.crw")
}
TONES, FULL = counts_of(12), counts_of(14)
PLACES = box(b"stsz", struct.pack(">III", 0, 4000, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 700))
BOXES = cr3("Canon EOS R", track(areas(), b"CRAW", (80, 48), *PLACES), pixels=np.random.default_rng(1).bytes(4000))


def said(ask: Callable[[], Any]) -> Any:
    """Return an answer, or that there is none."""
    try:
        return ask()
    except (FormatError, TiffDamaged):
        return {"refused": 1}


def stored(frame: Stored) -> dict[str, Any]:
    """Return the fields of a stored frame without its directory."""
    return {one.name: getattr(frame, one.name) for one in fields(frame) if one.name != "directory"}


def contents(data: bytes) -> Any:
    """Return the numbers of a file's frames and directories."""

    def ask() -> Any:
        found = rawfile._examined(Path("case"), data)
        fault = rawfile._lossless_fault(data, found)
        if fault is not None:
            raise rawfile._unreadable(Path("case"), fault)
        values = [value for one in found.directories for _, value in sorted(one.values.items())]
        return {"frames": [*map(stored, found.frames)], "values": values}

    return said(ask)


def seen(mosaic: Mosaic) -> dict[str, Any]:
    """Return all that is asked of a frame."""
    black = frame_black(mosaic)
    planes = [plane_of(mosaic, channel) for channel in CHANNELS]

    def lean(found: Any) -> Any:
        """Return an array, of a large one every so many a value."""
        shape: tuple[int, ...] = getattr(found, "shape", ())
        return found[::13, ::11] if np.prod(shape) > 100_000 else found

    return {
        **{one.name: lean(getattr(mosaic, one.name)) for one in fields(mosaic) if one.name != "sensor"},
        "beside": lean(mosaic.sensor) if mosaic.masked else mosaic.sensor.shape,
        "masked black": mosaic.masked_black(),
        "saturation": mosaic.saturation(),
        "exposure": mosaic.origin.exposure,
        "strongest": [rawfile.strongest_channel(mosaic, black, every) for every in (1, 8, 16)],
        "planes": np.stack([lean(plane.values) for plane in planes]),
        "offsets": [plane.offset_px for plane in planes],
        "filled": filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None,
    }


@pytest.mark.slow
def test_files_of_every_maker_are_read_as_before(pinned: Pinned) -> None:
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
        {name: said(lambda data=data: seen(decode_raw(data, Path("case")))) for name, data in files.items()},
    )


@pytest.mark.slow
def test_damaged_files_are_told_as_before(pinned: Pinned) -> None:
    files = {name: data for name, (data, _) in maker_files().items()} | {"cr3": BOXES}
    files["dng, active area"] = dng_bytes(TONES, {50829: longs(2, 4, 48, 80), 50830: longs(0, 0, 48, 4)})
    found: dict[str, Any] = {}
    for name, data in files.items():
        where, chance = entries(data), random.Random(name)
        found[name] = ["refused" in contents(changed(chance, data, where)) for _ in range(16)]
    pinned("raw files with damage", found)


@pytest.mark.slow
def test_tags_at_their_limits_are_told_as_before(pinned: Pinned) -> None:
    strip, size = lossless_jpeg(FULL), 2 * TONES.size
    packed_dng = {bits: {258: shorts(bits), 279: longs(48 * 80 * bits // 8)} for bits in (8, 12, 14)}
    changes: list[tuple[Tags, bytes | None]] = [({}, None)]
    changes += [(dict(one), packed(TONES % (1 << bits), bits)) for bits, one in packed_dng.items()]
    changes += [
        ({tag: longs(value)}, None) for tag in (256, 257, 278) for value in (0, 1, 2, 47, 48, 49, 80, 81, 65535, 65536)
    ]
    changes += [({258: shorts(bits)}, None) for bits in (0, 7, 8, 15, 16, 17)]
    changes += [({259: shorts(one)}, None) for one in (0, 6, 8, 9, 32767, 32946, 34892, 52546)]
    changes += [({277: shorts(one)}, None) for one in (0, 2)] + [({339: shorts(one)}, None) for one in (1, 2)]
    changes += [({262: shorts(one), 254: longs(kind)}, None) for one, kind in product((1, 2, 32803, 34892), (0, 1))]
    changes += [({279: longs(one)}, None) for one in (0, size - 1, size, size + 1)]
    changes += [({50706: (1, 4, version)}, None) for version in (b"\0\0\0\0", b"\1\0\0\0")]
    changes += [({50712: shorts(*tones)}, None) for tones in ((0, 1), (1, 1), (2, 1), (5,), (1, 2, 2))]
    changes += [({33422: (1, 4, bytes(one))}, None) for one in ((0, 1, 1, 2), (2, 1, 1, 0), (0, 0, 1, 2), (1, 3, 2, 1))]
    changes += [
        ({50714: shorts(one), 50717: longs(white)}, None)
        for one, white in ((0, 1), (64, 64), (63, 64), (9, 65536), (9, 65535), (9, 0))
    ]
    changes += [
        ({50715: ratios((3, 1)), 50716: ratios((1, 4)), 50713: shorts(*of)}, None) for of in ((1, 1), (2, 1), (3, 1))
    ]
    changes += [
        ({50829: longs(*of)}, None)
        for of in ((0, 0, 48, 80), (0, 0, 1, 80), (5, 7, 49, 80), (1, 1, 3, 3), (9, 9, 9, 80))
    ]
    lossless: Tags = {259: shorts(7), 258: shorts(14), 279: longs(len(strip)), 50717: longs(16383)}
    changes += [
        ({**lossless, **more}, strip)
        for more in ({}, {257: longs(49)}, {256: longs(78)}, {278: longs(24)}, {258: shorts(8)})
    ]
    changes += [
        ({**lossless, 324: longs(0), 325: longs(len(strip)), 322: longs(wide), 323: longs(high)}, strip)
        for wide, high in ((80, 48), (96, 48), (80, 64), (0, 48))
    ]
    found: list[Any] = []
    for more, pixels in changes:
        data = dng_bytes(TONES, {50829: longs(2, 4, 48, 80), **more}, pixels)
        mosaic = said(
            lambda data=data: rawfile._plain_mosaic(Path("case"), data, rawfile._examined(Path("case"), data))
        )
        told = (
            [mosaic.black, mosaic.white_level, mosaic.pattern, mosaic.visible] if isinstance(mosaic, Mosaic) else mosaic
        )
        found.append([contents(data), told])
    pinned(
        "raw files with tags at their limits",
        {
            "refused": ["refused" in one for one, _ in found],
            "read": found,
        },
    )


def test_boxes_and_heaps_are_read_as_before(pinned: Pinned) -> None:
    def record(data: bytes) -> Any:
        found: Cr3 = read_cr3(data)
        return {"black": found.black, "frames": [stored(one) for one in found.frames]}

    sizes, places = struct.pack(">III3I", 0, 0, 3, 9, 8, 7), struct.pack(">II3Q", 0, 3, 10, 30, 50)
    many = box(b"stsz", sizes), box(b"co64", places)
    tracks = {
        "two": cr3(),
        "one": BOXES,
        "of many samples": cr3("Canon EOS R", track(areas((0, 0, 0, 0), (1, 2, 3, 4)), b"CRAW", (64, 64), *many)),
    }
    pinned(
        "boxes of raw files",
        {**{name: record(data) for name, data in tracks.items()}, "heap": ciff_entries(REAL["canon_powershot_g2.crw"])},
    )


def test_lossless_jpegs_are_told_as_before(pinned: Pinned) -> None:
    counts = (2048 + np.random.default_rng(3).poisson(900, (12, 16))).astype(np.uint16)
    stream = lossless_jpeg(counts)
    begin = stream.index(b"\xff\xda") + 14
    flipped = [bytes([*stream[:at], stream[at] ^ bit, *stream[at + 1 :]]) for at in range(begin) for bit in (1, 16)]
    damaged = [stream[:at] + stream[at + 1 :] for at in range(begin, len(stream), 9)]
    more = (b"", bytes(4), bytes(5), b"\1\1\1\1\1\1", b"\1\1\1\1\2", bytes(17) + b"\xff\xd9")
    behind = [stream[:-2] + one for one in (*more, b"\1\1\1\1\1\1\1\1\2", b"\1\2\3")]
    every = [stream, *flipped, *damaged, *behind]
    found = {
        "faulty": [lossless_fault(one) is not None for one in every],
        "sizes": [[*(jpeg_size(one) or ())] for one in every],
    }
    pinned("streams of lossless JPEG", found)


def test_directories_of_all_types_are_read_as_before(pinned: Pinned) -> None:
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
        read = said(lambda data=data: [list(one.values.values()) for one in read_directories(data)])
        found.setdefault(f"{order}{tag.name}", []).append(read)
    pinned("directories of all types", found)


@pytest.mark.slow
def test_bytes_of_raw_files_are_what_they_were(pinned: Pinned) -> None:
    tiny = {
        "sensor": (30, 44),
        "visible": Rectangle(4, 8, 25, 33),
        "masked": (Rectangle(0, 0, 30, 6), Rectangle(0, 8, 2, 33)),
    }
    found: dict[str, Any] = {}
    for name, body in (*BODIES.items(), *FACTS.items(), ("unknown", replace(BODIES["Test"], sensitivities="nobody's"))):
        stream = io.BytesIO()
        counts = np.arange(30 * 44, dtype=np.uint16).reshape(30, 44) + np.uint16(body.black)
        settings = ExposureSettings(400, None if name == "Test" else 5.6, 1 / 60)
        write_dng(
            stream, counts, replace(body, **tiny), settings=settings, taken_at=datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)
        )  # names from above
        data = stream.getvalue()
        found[name] = [data, seen(decode_raw(data, Path("case")))["masked black"], rawfile.camera_matrix(body.camera)]
    tags: tiff.Tags = {
        TiffTag.MODEL: tiff.text("né"),
        TiffTag.WHITE_LEVEL: (ValueType.LONG, [1, 2]),
        TiffTag.COLOR_MATRIX_1: (ValueType.SRATIONAL, [-1, 3]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, [1, 2, 3]),
    }
    heads = [tiff.head(tags, 10), tiff.head(tags, 10, {}), tiff.head({}, 0, tags)]
    found["heads"] = heads
    found["rationals"] = tiff.rationals(1 / 3, 0.1, Fraction(2, 7), 3.14159265, 0)
    pinned("bytes of raw files", found)


def test_what_is_known_of_sensors_is_as_before(pinned: Pinned) -> None:
    frames = [(size, frame) for size, frame in sorted(rawfile._ONE_ROW_MORE, key=str)]
    cameras = (
        "Canon EOS 550D", "Canon EOS 6D Mark II", "Canon EOS R10", "Canon EOS R5 Mark II", "Canon EOS 5D", "Nikon D3",
        "",
    )  # fmt: skip
    sizes = ((3516, 5344), (4224, 6384), (100, 200))
    masked = {
        camera: [
            [size, left, *rawfile._masked_areas(None, camera, Area(3, left, 90, 90), size)]
            for size, left in product(sizes, (0, 9, 10, 69, 70, 140))
        ]
        for camera in cameras
    }
    origins = [
        FrameOrigin(iso=iso, aperture=aperture, shutter_s=shutter)
        for iso, aperture, shutter in product((None, 100, 640), (None, 5.6), (None, 0.3, 0.299, 1 / 60, 0.0, 2.0))
    ]
    whole = np.full((70, 520), 4000, np.uint16)
    holes: list[Any] = []
    for place, value in product(
        (
            (slice(3, 4), slice(None)),
            (slice(32, 64), slice(256, 512)),
            (slice(0, 32), slice(0, 256)),
            (slice(0, 31), slice(0, 256)),
        ),
        (0, 7, 8, 1023, 1024, 65535),
    ):
        for black, white in ((2048.0, 15000), (15.0, 15000), (16.0, 40000), (0.0, 32767), (0.0, 32768)):
            counts = whole.copy()
            counts[place] = value
            holes.append(None is not filled_fault(counts, np.full((2, 2), black), white))
    for rows, columns, part in product((32, 64, 65), (256, 512, 513), (1, 33)):
        counts = np.full((rows, columns), 4000, np.uint16)
        counts[-part:, -256:] = 3
        holes.append(None is not filled_fault(counts, np.full((2, 2), 2048.0), 15000))
    common = [
        rawfile._common(Area(2, 3, 10, 20), other)
        for other in (Area(0, 0, 5, 5), Area(4, 5, 3, 30), Area(50, 50, 2, 2))
    ]
    found = {
        "frames": [rawfile._dcraw_frame(*frame) for frame in frames],
        "masked": masked,
        "origins": [one.exposure for one in origins],
        "holes": holes,
        "common": common,
        "offsets": [rawfile.channel_offset_px(one) for one in (((0, 0),), ((0, 1), (1, 0)), ((1, 1),))],
    }
    pinned("what is known of sensors", found)
