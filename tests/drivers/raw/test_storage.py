"""Content of CR3 files, built from published descriptions, because no real file is available."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.raw import rawfile
from drivers.raw.rawfile import read_raw
from drivers.raw.storage import Area, Cr3, RawDamaged, StoredFrame, read_cr3
from foundation.errors import FormatError
from tests.drivers.raw.maker_files import PIXELS, SIDES, areas, box, cr3, large_box, track


def test_reads_camera_and_black_areas() -> None:
    content = read_cr3(cr3())
    assert (content.maker, content.model) == ("Canon", "Canon EOS M50")
    assert content.black == (Area(0, 0, 4056, 256), Area(0, 264, 28, 6024))
    assert content.frames == (StoredFrame(4056, 6288, ((900, PIXELS),)),) * 2


@pytest.mark.parametrize(
    ("places", "frames"),
    [
        ((struct.pack(">III", 0, 70, 2), struct.pack(">IIQQ", 0, 2, 900, 1000)), (((900, 70),), ((1000, 70),))),
        ((struct.pack(">5I", 0, 0, 2, 7, 8), struct.pack(">IIQQ", 0, 2, 900, 1 << 40)), (((900, 7),), ((1 << 40, 8),))),
        ((struct.pack(">III", 0, 70, 2), struct.pack(">IIQ", 0, 1, 900)), "2 samples in 1 chunks"),
        ((struct.pack(">III", 0, 70, 1 << 31), struct.pack(">IIQ", 0, 1 << 31, 900)), "samples in"),
        ((struct.pack(">III", 0, 0, 0), struct.pack(">II", 0, 0)), "0 samples"),
        ((struct.pack(">III", 0, 0, 2), struct.pack(">IIQQ", 0, 2, 900, 1000)), "ends within"),
        ((struct.pack(">III", 0, 70, 1), b""), "ends within"),
    ],
)
def test_reads_sample_positions_of_a_track(
    places: tuple[bytes, bytes], frames: str | tuple[tuple[tuple[int, int]], ...]
) -> None:
    data = cr3("Canon EOS R", track(areas(), b"CRAW", SIDES, box(b"stsz", places[0]), box(b"co64", places[1])))
    if isinstance(frames, str):
        with pytest.raises(RawDamaged, match=frames):
            read_cr3(data)
    else:
        assert [frame.extents for frame in read_cr3(data).frames] == list(frames)


def test_ignores_empty_areas() -> None:
    assert read_cr3(cr3("Canon EOS R", track(areas((0, 0, 0, 0), (0, 0, 0, 0))))).black == ()
    assert read_cr3(cr3("Canon EOS R", track(areas((0, 0, 0, 0))))).black == (Area(0, 264, 28, 6024),)


@pytest.mark.parametrize("size", [0, 1])
def test_last_box_may_be_open_or_have_a_long_size(size: int) -> None:
    data = cr3()
    start = data.rindex(b"mdat") - 4
    last = struct.pack(">I4s", 0, b"mdat") + bytes(64) if size == 0 else large_box(b"mdat", bytes(64))
    assert read_cr3(data[:start] + last).model == "Canon EOS M50"


def test_refuses_a_file_truncated_anywhere() -> None:
    data = cr3()
    for length in range(len(data)):
        with pytest.raises(RawDamaged):
            read_cr3(data[:length])


@given(st.binary(max_size=300), st.integers(0, 900))
def test_any_bytes_are_read_or_refused(noise: bytes, position: int) -> None:
    data = bytearray(cr3())
    data[position : position + len(noise)] = noise
    for candidate in (bytes(data), b"\0\0\0\x18ftypcrx " + noise):
        try:
            content = read_cr3(candidate)
        except RawDamaged:
            continue
        assert len(content.black) <= 2


def masked(model: str, left: int, stated: Cr3 | None, rows: int = 4056) -> tuple[Area, ...]:
    """Return the masked areas of a sensor whose visible area starts at column `left`."""
    visible = Area(36, left, rows - 36, 6288 - left)
    return rawfile._masked_areas(None, model, visible, (rows, 6288), stated)


def test_masked_columns_of_a_cr3() -> None:
    assert masked("Canon EOS M50", 264, Cr3()) == (Area(36, 0, 4020, 260),)
    # Stated areas can only reduce the known area.
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 0, 4056, 256), Area(0, 264, 28, 6024)))) == (
        Area(36, 0, 4020, 256),
    )
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(40, 40, 4000, 100),))) == (Area(40, 40, 4000, 100),)
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 40, 4000, 400),))) == (Area(36, 0, 4020, 260),), (
        "the stated area is not black"
    )
    assert masked("Canon EOS M50", 264, Cr3(black=(Area(0, 0, 4056, 3),))) == ()


def test_leaves_out_columns_that_are_not_black() -> None:
    # LibRaw's table: EOS R10 168 columns, without the first 16 and the last 48; R5 Mark II 258, 128.
    for camera in ("Canon EOS R10", "Canon EOS R6m2", "Canon EOS R6 Mark II"):
        assert masked(camera, 168, Cr3()) == (Area(36, 16, 4020, 104),)
    for camera in ("Canon EOS R5m2", "Canon EOS R5 Mark II"):
        assert masked(camera, 258, Cr3()) == (Area(36, 128, 4020, 126),)


SMALL = box(b"stsz", struct.pack(">III", 0, 400, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 400))


def test_refuses_files_that_libraw_cannot_decode(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, data, reason in (
        ("whole.CR3", cr3("R", track(areas(), b"CRAW", (64, 48), *SMALL)), "LibRaw reports"),
        ("stub.CR3", cr3(), "its pixels are at bytes 900 to 5000900"),
        ("cut.CR3", cr3()[:-10], "its box 'mdat' extends to byte"),
        ("head.CR3", cr3()[:40], "cannot be read as a raw file"),
        ("brand.CR3", b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "no description of its images"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(FormatError, match=reason):
            read_raw(path)
    assert capfd.readouterr() == ("", "")
