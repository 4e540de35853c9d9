"""The print: exact edges and colours, true size, readable tags, and the proof page."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from pyapriltags import Detector

from experiment.chart.model import Chart, Tag
from experiment.chart.printing import (
    drawing,
    preview,
    save_pdf,
    save_preview,
    save_tiff,
)
from experiment.chart.proof import save_proof
from foundation.errors import InputError, StorageError

pytestmark = pytest.mark.slow


def render_pdf(path: Path, dpi: int, *options: str) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB of a PDF page, rendered by poppler."""
    renderer = shutil.which("pdftoppm")
    if renderer is None:
        pytest.skip("pdftoppm (poppler) is not installed, and nothing else here draws a PDF")
    picture = path.with_suffix("")
    subprocess.run([renderer, "-r", str(dpi), *options, "-singlefile", "-png", path, picture], check=True)
    image = cv2.imread(str(picture.with_suffix(".png")))
    assert image is not None
    return image[:, :, ::-1].astype(np.uint8)


def test_proof_is_one_a4_page_of_true_size(a0: Chart, tmp_path: Path) -> None:
    path = tmp_path / "proof.pdf"
    save_proof(a0, path)
    box = re.search(rb"/MediaBox \[([\d. ]+)\]", path.read_bytes())
    assert box is not None
    # ISO 216: 297 × 210 mm.
    assert [float(value) * 25.4 / 72 for value in box[1].split()] == pytest.approx([0, 0, 297, 210], abs=1e-3)
    assert len(re.findall(rb"/Type /Page\b", path.read_bytes())) == 1
    assert b"/ICCBased" not in path.read_bytes()
    picture = render_pdf(path, 200)
    assert abs(picture.shape[1] - 297 * 200 / 25.4) <= 1
    corners = detect_tags(picture)
    assert sorted(corners) == [0, 1]
    shift = corners[0][0] * 25.4 / 200 - a0.tags[0].corners_mm[0]
    for number in (0, 1):
        np.testing.assert_allclose(corners[number] * 25.4 / 200 - shift, a0.tags[number].corners_mm, atol=0.1)
    # 33 greys of 8 mm from 15.24 mm, the last bare paper: the upper half drawn, the lower an image.
    centres = ((15.24 + 4 + 8 * np.arange(33)) * 200 / 25.4).astype(int)
    for down_mm in (140, 146):
        greys = picture[round(down_mm * 200 / 25.4), centres]
        np.testing.assert_array_equal(greys, np.repeat([*range(0, 256, 8), 255], 3).reshape(-1, 3))


def detect_tags(picture: npt.NDArray[np.uint8]) -> dict[int, npt.NDArray[np.float64]]:
    """Corners of the tags detected by the library of the AprilTag authors, clockwise from the printed top-left, px.

    Its corners of pixels are whole numbers, as are millimetres multiplied by pixels per millimetre.
    """
    detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    grey = picture.mean(axis=2).astype(np.uint8)
    return {found.tag_id: found.corners[[1, 0, 3, 2]] for found in detector.detect(grey)}


def paint_patches(chart: Chart, dpi: int) -> npt.NDArray[np.uint8]:
    """Patches and references, painted one by one; tags are left white."""
    width, height = (round(side * dpi / 25.4) for side in chart.page_mm)
    picture = np.full((height, width, 3), 255, dtype=np.uint8)
    side = dpi * 125 // 600
    centres = [*chart.centres_mm.tolist(), *(reference.centre_mm for reference in chart.references)]
    codes = [*chart.rgb.tolist(), *(reference.rgb for reference in chart.references)]
    for (x, y), code in zip(centres, codes, strict=True):
        left, top = round(x * dpi / 25.4 - side / 2), round(y * dpi / 25.4 - side / 2)
        picture[top : top + side, left : left + side] = code
    return picture


def tag_area(chart: Chart, dpi: int) -> tuple[slice, slice]:
    """Rows and columns from the first to the last tag with rims."""
    rim = 50 * 25.4 / 600
    low = (chart.tags[0].corners_mm[0] - rim) * dpi / 25.4
    high = (chart.tags[-1].corners_mm[2] + rim) * dpi / 25.4
    return slice(round(low[1]), round(high[1])), slice(round(low[0]), round(high[0]))


@pytest.fixture(scope="module")
def tiff(a7: Chart, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("print") / "chart.tif"
    save_tiff(a7, path)
    return path


def test_tiff_matches_the_chart_pixel_by_pixel(a7: Chart, tiff: Path) -> None:
    picture = tifffile.imread(tiff)
    expected = paint_patches(a7, 600)
    # A7 is 105 × 74 mm: 2480.3 × 1748.0 pixels.
    assert picture.shape == expected.shape == (1748, 2480, 3)
    assert picture.dtype == np.uint8
    for tag in a7.tags:
        (left, top), (right, bottom) = np.rint(tag.corners_mm[[0, 2]] * 600 / 25.4).astype(int)
        assert right - left == bottom - top == 400
        modules = picture[top - 50 : bottom + 50, left - 50 : right + 50].reshape(10, 50, 10, 50, 3)
        assert (modules == modules[:, :1, :, :1]).all(), "each module is one colour, 50 × 50 pixels"
        assert (modules[[0, -1]] == 255).all()
        assert (modules[:, :, [0, -1]] == 255).all()
        assert (modules[[1, -2], :, 1:-1] == 0).all()
        assert (modules[1:-1, :, [1, -2]] == 0).all()
        picture[top - 50 : bottom + 50, left - 50 : right + 50] = 255
    rows, columns = tag_area(a7, 600)
    np.testing.assert_array_equal(picture[rows, columns], expected[rows, columns])
    near = picture[rows.start - 34 : rows.stop + 34, columns.start - 34 : columns.stop + 34].copy()
    near[34:-34, 34:-34] = 255
    assert (near == 255).all(), "around the field the paper is bare"
    for margin in (
        picture[: rows.start],
        picture[rows.stop :],
        picture[:, : columns.start],
        picture[:, columns.stop :],
    ):
        assert (margin == 0).any(), "every margin has marks"
        assert ((margin == 0) | (margin == 255)).all(), "in black"


def test_independent_library_detects_tags_of_the_tiff(a7: Chart, tiff: Path) -> None:
    corners = detect_tags(tifffile.imread(tiff))
    assert sorted(corners) == [0, 1, 2, 3]
    for tag in a7.tags:
        np.testing.assert_allclose(corners[tag.id], tag.corners_mm * 600 / 25.4, atol=0.5)


def test_independent_library_detects_all_tags_on_a0(a0: Chart) -> None:
    picture = preview(a0, 1600)
    assert picture.shape == (1132, 1600, 3)
    corners = detect_tags(picture)
    assert sorted(corners) == list(range(35))
    for tag in a0.tags:
        np.testing.assert_allclose(corners[tag.id], tag.corners_mm * 1600 / 1189, atol=0.15)


def test_pdf_matches_the_tiff(a7: Chart, tiff: Path, tmp_path: Path) -> None:
    save_pdf(a7, tmp_path / "chart.pdf")
    rendered, expected = render_pdf(tmp_path / "chart.pdf", 600, "-aa", "no", "-aaVector", "no"), tifffile.imread(tiff)
    # Every pixel and mark: nothing is shifted, and no hairline of paper shows between patches.
    np.testing.assert_array_equal(rendered[: expected.shape[0], : expected.shape[1]], expected)
    assert sorted(detect_tags(rendered)) == [0, 1, 2, 3]


def test_refuses_rotated_tags(a7: Chart) -> None:
    corners = a7.tags[0].corners_mm
    for rotated_corners in (np.roll(corners, 1, axis=0), corners + np.array([[0, 0], [0, 0.1], [0, 0], [0, 0]])):
        rotated = replace(a7, tags=(Tag("36h11", 0, rotated_corners),))
        with pytest.raises(InputError):
            drawing(rotated)


def test_full_disk_keeps_the_previous_file(a7: Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "chart"
    path.write_text("the print of before")
    monkeypatch.setattr(os, "fsync", full)
    for save in (save_tiff, save_pdf, save_preview):
        with pytest.raises(StorageError):
            save(a7, path)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("chart", "the print of before")]
