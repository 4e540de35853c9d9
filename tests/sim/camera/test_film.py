"""Raw files of the simulated cameras follow DNG 1.4 and Exif 2.32, and raw converters read the counts unchanged."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import rawpy
import tifffile
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from drivers.raw.rawfile import read_raw
from sim.camera.film import write_dng
from sim.world.sensors import BODIES, Body

pytestmark = pytest.mark.slow

TAKEN_AT = datetime(2021, 3, 14, 15, 9, 26, tzinfo=UTC)
SETTINGS = ExposureSettings(iso=400, aperture=5.6, shutter_s=0.5)


def mosaic(body: Body) -> NDArray[np.uint16]:
    """Return counts of all sizes, with black borders."""
    rng = np.random.default_rng(8)
    counts = rng.integers(0, 1 << body.bits, body.sensor, dtype=np.uint16)
    for area in body.masked:
        counts[area.top : area.top + area.height, area.left : area.left + area.width] = body.black
    return counts


def dng(body: Body, counts: NDArray[np.uint16] | None = None, taken_at: datetime = TAKEN_AT) -> bytes:
    stream = io.BytesIO()
    counts = mosaic(body) if counts is None else counts
    write_dng(stream, counts, body, settings=SETTINGS, taken_at=taken_at, serial="062031400123")
    return stream.getvalue()


def visible(counts: NDArray[np.uint16], body: Body) -> NDArray[np.uint16]:
    area = body.visible
    return counts[area.top : area.top + area.height, area.left : area.left + area.width]


@pytest.fixture(scope="module", params=BODIES)
def body(request: pytest.FixtureRequest) -> Body:
    return BODIES[request.param]


@pytest.fixture(scope="module")
def counts(body: Body) -> NDArray[np.uint16]:
    return mosaic(body)


@pytest.fixture(scope="module")
def file(body: Body, counts: NDArray[np.uint16], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dng") / "IMG_0001.dng"
    path.write_bytes(dng(body, counts))
    return path


# Code: TIFF type, number of values, value; DNG 1.4 chapter 4, TIFF 6.0 section 8. Of a 550D file.
GOLDEN = {
    254: (4, 1, 0),
    256: (4, 1, 5344),
    257: (4, 1, 3516),
    258: (3, 1, 16),
    259: (3, 1, 1),
    262: (3, 1, 32803),
    271: (2, 6, "Canon"),
    272: (2, 15, "Canon EOS 550D"),
    274: (3, 1, 1),
    277: (3, 1, 1),
    278: (4, 1, 3516),
    279: (4, 1, (5344 * 3516 * 2,)),
    284: (3, 1, 1),
    305: (2, 22, "CroP simulated camera"),
    306: (2, 20, "2021:03:14 15:09:26"),
    33421: (3, 2, (2, 2)),
    33422: (1, 4, bytes([0, 1, 1, 2])),
    50706: (1, 4, bytes([1, 4, 0, 0])),
    50707: (1, 4, bytes([1, 1, 0, 0])),
    50708: (2, 15, "Canon EOS 550D"),
    50710: (1, 3, bytes([0, 1, 2])),
    50711: (3, 1, 1),
    50714: (3, 1, 2048),
    50717: (3, 1, 13584),
    50735: (2, 13, "062031400123"),
    50778: (3, 1, 21),
    50829: (4, 4, (51, 142, 3516, 5344)),
    50830: (4, 4, (0, 0, 3516, 140)),
}


def tags_of(data: bytes) -> dict[int, tuple[int, int, Any]]:
    """Return type, number of values and value of each tag of the only image, as read by tifffile."""
    with tifffile.TiffFile(io.BytesIO(data)) as tiff:
        assert len(tiff.pages) == 1
        page = cast("tifffile.TiffPage", tiff.pages[0])
        return {tag.code: (int(tag.dtype), tag.count, tag.value) for tag in page.tags}


def fractions(value: Sequence[int]) -> NDArray[np.float64]:
    return np.array(value[::2], dtype=np.float64) / np.array(value[1::2], dtype=np.float64)


def test_tags_follow_the_standard() -> None:
    tags = tags_of(dng(BODIES["EOS 550D"]))
    for code, golden in GOLDEN.items():
        assert tags[code] == golden, code
    assert set(tags) - set(GOLDEN) == {273, 34665, 50721, 50728}
    # ColorMatrix1 as Adobe has it for the 600D, signed rationals; AsShotNeutral is what it makes of D65, green largest.
    value_type, count, value = tags[50721]
    assert (value_type, count) == (10, 9)
    matrix = fractions(value).reshape(3, 3)
    np.testing.assert_allclose(matrix[0], [0.6461, -0.0907, -0.0882])
    value_type, count, value = tags[50728]
    assert (value_type, count) == (5, 3)
    neutral = matrix @ [0.9505, 1, 1.089]
    np.testing.assert_allclose(fractions(value), neutral / neutral[1], rtol=1e-3)


def test_libraw_reads_counts_and_exposure(file: Path, body: Body, counts: NDArray[np.uint16]) -> None:
    area = body.visible
    with rawpy.imread(str(file)) as raw:
        np.testing.assert_array_equal(raw.raw_image, counts)
        # LibRaw leaves out the first row of a picture whose top margin is odd, as it does with the 550D's own files.
        top = area.top + area.top % 2
        assert (raw.sizes.top_margin, raw.sizes.left_margin) == (top, area.left)
        np.testing.assert_array_equal(
            raw.raw_image_visible, counts[top : area.top + area.height, area.left : area.left + area.width]
        )
        block = raw.raw_colors[area.top : area.top + 2, area.left : area.left + 2]
        assert [chr(raw.color_desc[i]) for i in block.ravel()] == list(body.pattern)
        assert raw.black_level_per_channel == [body.black] * 4
        assert raw.white_level == body.saturation
        assert (raw.other.iso_speed, raw.other.shutter_speed) == (400, pytest.approx(0.5))
        assert raw.other.aperture == pytest.approx(5.6)


def test_our_reader_has_the_visible_frame(file: Path, body: Body, counts: NDArray[np.uint16]) -> None:
    read = read_raw(file)
    np.testing.assert_array_equal(read.counts, visible(counts, body))
    assert read.pattern == body.pattern
    assert (read.iso, read.aperture, read.shutter_s) == (400, pytest.approx(5.6), pytest.approx(0.5))
    np.testing.assert_array_equal(read.masked_black(), np.full((2, 2), body.black))


def test_dcraw_has_the_visible_frame(file: Path, body: Body, counts: NDArray[np.uint16]) -> None:
    dcraw = shutil.which("dcraw")
    if dcraw is None:
        pytest.skip("dcraw is not installed")
    subprocess.run([dcraw, "-D", "-4", "-T", str(file)], check=True, timeout=60)
    np.testing.assert_array_equal(tifffile.imread(file.with_suffix(".tiff")), visible(counts, body))
    text = subprocess.run([dcraw, "-i", "-v", str(file)], check=True, timeout=60, capture_output=True, text=True).stdout
    assert f"Camera: Canon {body.model.removeprefix('Canon ')}" in text
    assert "ISO speed: 400" in text
    assert "Shutter: 1/2.0 sec" in text
    assert "Aperture: f/5.6" in text
    assert "Filter pattern: RG/GB" in text
