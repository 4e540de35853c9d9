"""Files that claim a frame and do not hold it are refused, with that reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.raw.rawfile import read_raw
from drivers.raw.wholeness import filled_fault, size_fault
from drivers.tiff import Directory, TiffTag
from foundation.errors import FormatError
from tests.drivers.raw.raw_files import Tags, longs, shorts, write_dng

SIDE = 128


def frame() -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
    return np.random.default_rng(1).integers(60, 4000, (SIDE, 2 * SIDE)).astype(np.uint16)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({256: longs(3664), 257: longs(2754)}, "photosites"),
        ({324: longs(0xFFFFFFFF), 325: longs(9)}, "has only"),
        ({324: longs(600, 700), 325: longs(200, 200)}, "upon each other"),
        ({324: longs(600, 900), 325: longs(200)}, "2 places of its pixels and 1 sizes"),
    ],
    ids=["too few bytes", "beyond the end", "overlap", "numbers"],
)
def test_extents_that_hold_no_frame_are_refused(tmp_path: Path, more: Tags, reason: str) -> None:
    write_dng(tmp_path / "a.dng", frame(), more)
    with pytest.raises(FormatError, match=reason):
        read_raw(tmp_path / "a.dng")


def test_deflate_is_not_supported_and_no_copy_helps(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", frame(), {259: shorts(8)})
    with pytest.raises(FormatError, match="Deflate, which is not supported; convert it") as told:
        read_raw(tmp_path / "a.dng")
    assert "copy" not in str(told.value)


def test_rw2_pixels_beyond_the_end_are_refused() -> None:
    # Strips of an RW2 are 0xffffffff in whole files, too: the pixels' place is a tag of its own.
    data = b"IIU\0".ljust(12_000, b"\xff")
    for place, whole in ((0xFFFFFFFF, False), (1000, True)):
        directory = Directory({TiffTag.RW2_PIXELS: (place,), TiffTag.STRIP_OFFSETS: (0xFFFFFFFF,)})
        assert (size_fault(data, [directory], 60_000) is None) == whole
    assert size_fault(data, [], 2754 * 3664) is not None


@pytest.mark.parametrize("hole", [np.s_[100:101], np.s_[64:96, :256], np.s_[100:]], ids=["row", "tile", "end"])
def test_a_frame_that_was_filled_is_told(tmp_path: Path, hole: tuple[slice, ...]) -> None:
    counts = np.tile(frame(), (1, 2))
    write_dng(tmp_path / "a.dng", counts)
    whole = read_raw(tmp_path / "a.dng")
    assert filled_fault(whole.counts, whole.black) is None
    counts[hole] = 0
    write_dng(tmp_path / "a.dng", counts)
    cut = read_raw(tmp_path / "a.dng")
    assert "half of its black level" in (filled_fault(cut.counts, cut.black) or "")


def test_darkness_is_no_hole() -> None:
    dark = np.random.default_rng(2).normal(64, 8, (SIDE, 2 * SIDE)).clip(0).astype(np.uint16)
    dark[:, 7] = 0  # a dead column
    assert filled_fault(dark, np.full((2, 2), 64.0)) is None
    # Without a black level, zero is what darkness is.
    assert filled_fault(np.zeros_like(dark), np.zeros((2, 2))) is None
