"""Tiny raw files in the layouts of many makers, each with the counts that it holds.

Pixels are stored as the maker's own tags say: 16 bits each, or 12 or 14 bits packed. Previews and notes are left
out, as LibRaw does without.

CR3 are boxes alone, as none of a real body is at hand; box types, sizes and their order: L. Clévy, "Describing the
Canon Raw v3 (CR3) file format", the dump of a file of an EOS M50 (6288×4056): CRAW of 0xe4 bytes with CMP1 (0x3c), CDI1
(0x44) and IAD1 (0x38) in it. Sources of the rest: those of `drivers.raw.storage`; how photosites are packed: LibRaw
0.22, src/decoders (of 12 and 16 bits).
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from tests.drivers.raw.raw_files import Tags, cr2_bytes, dng_bytes, longs, lossless_jpeg, shorts, text, tiff_bytes

Counts = NDArray[np.uint16]

ROWS, COLUMNS = 48, 80


def counts_of(bits: int) -> Counts:
    """Return counts of `bits` bits around a dark level, (ROWS, COLUMNS)."""
    top = (1 << bits) - 1
    return np.random.default_rng(bits).integers(top // 8, top, (ROWS, COLUMNS)).astype(np.uint16)


def packed(counts: Counts, bits: int, *, least_first: bool = False) -> bytes:
    """Return counts of `bits` bits without gaps, most or least significant bit first."""
    places = np.arange(bits) if least_first else np.arange(bits - 1, -1, -1)
    stream = (counts.ravel()[:, None] >> places & 1).astype(np.uint8).ravel()
    return np.packbits(stream, bitorder="little" if least_first else "big").tobytes()


def in_words(pixels: bytes) -> bytes:
    """Return bytes as Olympus stores them: each group of four reversed."""
    return np.frombuffer(pixels, ">u4").astype("<u4").tobytes()


def in_maker_tiff(maker: str, model: str, pixels: bytes, more: Tags, magic: bytes = b"II*\0") -> bytes:
    """Return a TIFF whose first directory names the camera and describes its pixels."""
    tags: Tags = {
        254: longs(0),
        256: longs(COLUMNS),
        257: longs(ROWS),
        258: shorts(16),
        259: shorts(1),
        262: shorts(32803),
        271: text(maker),
        272: text(model),
        277: shorts(1),
        33421: shorts(2, 2),
        33422: (1, 4, b"\0\1\1\2"),
        **more,
    }
    return tiff_bytes(tags, pixels, magic)


def raf(bits: int = 16, seed: int = 14) -> tuple[bytes, Counts]:
    """Return a RAF with pixels of 16 bits in an inner TIFF."""
    counts = np.random.default_rng(seed).integers(2048, 16383, (ROWS, COLUMNS)).astype(np.uint16)
    inner = tiff_bytes(
        {0xF001: longs(COLUMNS), 0xF002: longs(ROWS), 0xF003: longs(bits), 0xF008: longs(2 * counts.size)},
        counts.astype("<u2").tobytes(),
        place_tag=0xF007,
        through=0xF000,
    )
    table = struct.pack(">IHHHH", 2, 0x100, 4, ROWS, COLUMNS) + struct.pack(">HHHH", 0x121, 4, ROWS, COLUMNS)
    table_at = 160
    start = table_at + len(table)
    head = b"FUJIFILMCCD-RAW 0201FF389501".ljust(28, b"\0") + b"FinePix X".ljust(32, b"\0") + b"0100"
    head = head.ljust(84, b"\0") + struct.pack(">6I", 0, 0, table_at, len(table), start, len(inner))
    return head.ljust(table_at, b"\0") + table + inner, counts


CANON = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")
# Invented: first column, first row, last column, last row.
LEFT, UPPER = (0, 0, 255, 4055), (264, 0, 6287, 27)


def box(kind: bytes, *content: bytes) -> bytes:
    data = b"".join(content)
    return struct.pack(">I4s", 8 + len(data), kind) + data


def large_box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4sQ", 1, kind, 16 + len(content)) + content


def ifd(maker: str, model: str) -> bytes:
    """Return a TIFF of one directory with two texts."""
    texts = [name.encode() + b"\0" for name in (maker, model)]
    place = 8 + 2 + 12 * 2 + 4
    data = b"II*\0" + struct.pack("<IH", 8, 2)
    for tag, name in zip((271, 272), texts, strict=True):
        data += struct.pack("<HHII", tag, 2, len(name), place)
        place += len(name)
    return data + bytes(4) + b"".join(texts)


def areas(left: tuple[int, ...] = LEFT, upper: tuple[int, ...] = UPPER) -> bytes:
    crop, active = (276, 48, 6275, 4047), (264, 36, 6287, 4055)
    return struct.pack(">24H", *(6288, 4056, 0, 0), *(0,) * 4, *crop, *left, *upper, *active)


SIDES = 6288, 4056
# Stated bytes of pixels, which no file contains; checks of boxes do not read them.
PIXELS = 5_000_000


def track(iad1: bytes, entry: bytes = b"CRAW", size: tuple[int, int] = SIDES, *places: bytes) -> bytes:
    """Return a track; its sample entry has 82 bytes and the boxes CMP1 and CDI1 with IAD1."""
    cmp1 = (bytes(8) + struct.pack(">II", *size)).ljust(0x34, b"\0")
    sample = box(
        entry, bytes(82), box(b"CMP1", cmp1), box(b"CDI1", bytes(4), box(b"IAD1", iad1)), box(b"free", b"\0\0")
    )
    samples = places or (box(b"stsz", struct.pack(">III", 0, PIXELS, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 900)))
    table = box(b"stbl", box(b"stsd", bytes(4), struct.pack(">I", 1), sample), *samples)
    return box(
        b"trak",
        box(b"tkhd", bytes(84)),
        box(b"mdia", box(b"hdlr", bytes(24)), box(b"minf", box(b"vmhd", bytes(12)), table)),
    )


def cr3(model: str = "Canon EOS M50", *tracks: bytes, pixels: bytes = bytes(64)) -> bytes:
    metadata = box(
        b"uuid",
        CANON,
        box(b"CNCV", b"CanonCR3_001/00.09.00/00.00.00"),
        box(b"CMT1", ifd("Canon", model)),
        box(b"THMB", bytes(40)),
    )
    movie = box(b"moov", metadata, box(b"mvhd", bytes(100)), *(tracks or (track(areas()[:32]), track(areas()))))
    brand = box(b"ftyp", b"crx ", struct.pack(">I", 1), b"crx ", b"isom")
    return brand + movie + box(b"uuid", bytes(16), b"xpacket") + large_box(b"mdat", pixels)


def maker_files() -> dict[str, tuple[bytes, Counts]]:
    """Return a file of each checked layout with its counts, by name."""
    full, wide, tones = counts_of(14), counts_of(16), counts_of(12)
    plain, twelve = full.astype("<u2").tobytes(), packed(tones, 12)
    rows_of_blocks = b"".join(packed(row, 14, least_first=True).ljust(144, b"\0") for row in full)
    strip = lossless_jpeg(full)
    ljpeg = {259: shorts(7), 258: shorts(14), 279: longs(len(strip)), 50714: shorts(512), 50717: longs(16383)}
    return {
        "dng": (dng_bytes(tones), tones),
        "dng 12 bits": (dng_bytes(tones, {258: shorts(12), 279: longs(len(twelve))}, twelve), tones),
        "dng lossless": (dng_bytes(full, ljpeg, strip), full),
        "cr2": (cr2_bytes(full, "Canon EOS 550D"), full),
        "nef": (in_maker_tiff("NIKON CORPORATION", "NIKON D3", plain, {258: shorts(14)}), full),
        "nef 12 bits": (in_maker_tiff("NIKON CORPORATION", "NIKON D3", twelve, {258: shorts(12)}), tones),
        "nef 14 bits packed": (
            in_maker_tiff("NIKON CORPORATION", "NIKON Z 6", rows_of_blocks, {258: shorts(14)}),
            full,
        ),
        "arw": (in_maker_tiff("SONY", "ILCE-7M3", plain, {258: shorts(14)}), full),
        "pef": (in_maker_tiff("PENTAX", "PENTAX K-1", wide.astype("<u2").tobytes(), {}), wide),
        "orf": (in_maker_tiff("OLYMPUS IMAGING CORP.", "E-410", in_words(twelve), {258: shorts(12)}, b"IIRO"), tones),
        "srw": (in_maker_tiff("SAMSUNG", "NX99", plain, {258: shorts(14)}), full),
        "3fr": (in_maker_tiff("Hasselblad", "Hasselblad H3D", wide.astype("<u2").tobytes(), {}), wide),
    }
