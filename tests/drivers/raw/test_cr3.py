"""What a CR3 says of itself; the files are built here after published descriptions, as none of a real body is at hand.

Box types, sizes and their order: L. Clévy, "Describing the Canon Raw v3 (CR3) file format", the dump of a file of an
EOS M50 (6288×4056): CRAW of 0xe4 bytes with CMP1 (0x3c), CDI1 (0x44) and IAD1 (0x38) in it.
"""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.raw import rawfile
from drivers.raw.cr3 import Cr3, Cr3Damaged, is_cr3, read_cr3
from drivers.raw.plain_dng import Area
from drivers.raw.rawfile import read_raw
from foundation.errors import FormatError

CANON = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")
LEFT, UPPER = (0, 0, 255, 4055), (264, 0, 6287, 27)
"""Made up: first column, first row, last column, last row."""


def box(kind: bytes, *content: bytes) -> bytes:
    data = b"".join(content)
    return struct.pack(">I4s", 8 + len(data), kind) + data


def large_box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4sQ", 1, kind, 16 + len(content)) + content


def ifd(maker: str, model: str) -> bytes:
    """Return a TIFF of one directory with two texts."""
    texts = [text.encode() + b"\0" for text in (maker, model)]
    place = 8 + 2 + 12 * 2 + 4
    data = b"II*\0" + struct.pack("<IH", 8, 2)
    for tag, text in zip((271, 272), texts, strict=True):
        data += struct.pack("<HHII", tag, 2, len(text), place)
        place += len(text)
    return data + bytes(4) + b"".join(texts)


def areas(left: tuple[int, ...] = LEFT, upper: tuple[int, ...] = UPPER) -> bytes:
    crop, active = (276, 48, 6275, 4047), (264, 36, 6287, 4055)
    return struct.pack(">24H", *(6288, 4056, 0, 0), *(0,) * 4, *crop, *left, *upper, *active)


def track(iad1: bytes, entry: bytes = b"CRAW") -> bytes:
    """Return a track; IAD1 stands in CDI1, behind CMP1, in a sample entry of 82 bytes and boxes."""
    sample = box(
        entry, bytes(82), box(b"CMP1", bytes(0x34)), box(b"CDI1", bytes(4), box(b"IAD1", iad1)), box(b"free", b"\0\0")
    )
    table = box(b"stbl", box(b"stsd", bytes(4), struct.pack(">I", 1), sample), box(b"stsz", bytes(12)))
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


def test_the_camera_and_where_its_sensor_is_black() -> None:
    assert is_cr3(cr3())
    said = read_cr3(cr3())
    assert (said.maker, said.model) == ("Canon", "Canon EOS M50")
    assert said.black == (Area(0, 0, 4056, 256), Area(0, 264, 28, 6024))


def test_areas_that_a_body_leaves_empty_are_none() -> None:
    assert read_cr3(cr3("Canon EOS R", track(areas((0, 0, 0, 0), (0, 0, 0, 0))))).black == ()
    assert read_cr3(cr3("Canon EOS R", track(areas((0, 0, 0, 0))))).black == (Area(0, 264, 28, 6024),)


def test_what_is_not_there_is_not_said() -> None:
    assert read_cr3(cr3("Canon EOS R", track(areas()[:32]))).black == (), "a preview's areas are fewer, and others"
    assert read_cr3(cr3("Canon EOS R", track(areas(), b"JPEG"))).black == ()
    begun = box(b"ftyp", b"crx ", bytes(4)) + box(b"mdat")
    assert read_cr3(begun + box(b"moov", box(b"uuid", CANON))) == Cr3()
    assert read_cr3(begun + box(b"moov", box(b"uuid", CANON, box(b"CMT1", b"II*\0nonsense")))) == Cr3()
    assert read_cr3(begun + box(b"moov", box(b"uuid", bytes(16), box(b"CMT1", ifd("Canon", "Other"))))) == Cr3()


@pytest.mark.parametrize("size", [0, 1])
def test_the_last_box_may_reach_to_the_end_or_have_a_long_size(size: int) -> None:
    data = cr3()
    start = data.rindex(b"mdat") - 4
    last = struct.pack(">I4s", 0, b"mdat") + bytes(64) if size == 0 else large_box(b"mdat", bytes(64))
    assert read_cr3(data[:start] + last).model == "Canon EOS M50"


def test_a_file_cut_anywhere_is_damaged() -> None:
    data = cr3()
    for length in range(len(data)):
        with pytest.raises(Cr3Damaged):
            read_cr3(data[:length])


def test_boxes_without_end_are_refused() -> None:
    brand = box(b"ftyp", b"crx ", bytes(4))
    with pytest.raises(Cr3Damaged, match="more than 4096 boxes"):
        read_cr3(brand + box(b"moov", 10_000 * box(b"free")))


@given(st.binary(max_size=300), st.integers(0, 900))
def test_whatever_the_bytes_it_is_read_or_damaged(noise: bytes, place: int) -> None:
    data = bytearray(cr3())
    data[place : place + len(noise)] = noise
    for candidate in (bytes(data), b"\0\0\0\x18ftypcrx " + noise):
        try:
            said = read_cr3(candidate)
        except Cr3Damaged:
            continue
        assert len(said.black) <= 2


def masked(model: str, left: int, stated: Cr3 | None, rows: int = 4056) -> tuple[Area, ...]:
    """Return what is taken for black of a sensor whose picture begins at column `left`."""
    visible = Area(36, left, rows - 36, 6288 - left)
    return rawfile._masked_areas(None, model, visible, (rows, 6288), stated)  # pyright: ignore[reportPrivateUsage]


def test_masked_columns_of_a_cr3() -> None:
    assert masked("Canon EOS M50", 264, Cr3()) == (Area(36, 0, 4020, 260),)
    # What the file states narrows that down, and adds nothing.
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 0, 4056, 256), Area(0, 264, 28, 6024)))) == (
        Area(36, 0, 4020, 256),
    )
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 40, 4000, 400),))) == (Area(36, 0, 4020, 260),), (
        "it is not black there"
    )
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 0, 4056, 3),))) == ()


def test_columns_at_the_edge_that_are_not_black_are_left_out() -> None:
    # LibRaw's table: EOS R10 168 columns, of which the first 16 and the last 48 are none; R5 Mark II 258, 128.
    assert masked("Canon EOS R10", 168, Cr3()) == (Area(36, 16, 4020, 104),)
    assert masked("Canon EOS R5m2", 258, Cr3()) == (Area(36, 128, 4020, 126),)


def test_a_sensor_without_columns_beside_its_picture_has_none() -> None:
    assert masked("Canon EOS R", 8, Cr3()) == ()
    assert masked("Canon EOS R10", 69, Cr3()) == ()
    assert masked("", 264, Cr3()) == (), "of a camera without a name nothing is known"


def test_a_file_that_libraw_cannot_decode_is_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, data, says in (
        ("whole.CR3", cr3(), "LibRaw says"),
        ("cut.CR3", cr3()[:-10], "its part 'mdat' reaches to byte"),
        ("head.CR3", cr3()[:40], "cannot be read as a raw file"),
        ("brand.CR3", b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "no description of its pictures"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(FormatError, match=says):
            read_raw(path)
    assert capfd.readouterr() == ("", "")
