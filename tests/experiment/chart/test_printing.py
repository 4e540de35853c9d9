"""The print: every edge on its pixel, every colour exact, true size, and tags that an independent library reads.

The proof page and the instructions: true size, readable tags, greys of the right codes.
"""

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


def drawn(path: Path, dpi: int, *options: str) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB of a PDF's page as poppler draws it."""
    renderer = shutil.which("pdftoppm")
    if renderer is None:
        pytest.skip("pdftoppm (poppler) is not installed, and nothing else here draws a PDF")
    picture = path.with_suffix("")
    subprocess.run([renderer, "-r", str(dpi), *options, "-singlefile", "-png", path, picture], check=True)
    image = cv2.imread(str(picture.with_suffix(".png")))
    assert image is not None
    return image[:, :, ::-1].astype(np.uint8)


def test_the_proof_is_one_a4_page_with_tags_at_true_size(a0: Chart, tmp_path: Path) -> None:
    path = tmp_path / "proof.pdf"
    save_proof(a0, path)
    box = re.search(rb"/MediaBox \[([\d. ]+)\]", path.read_bytes())
    assert box is not None
    # ISO 216: 297 × 210 mm.
    assert [float(value) * 25.4 / 72 for value in box[1].split()] == pytest.approx([0, 0, 297, 210], abs=1e-3)
    assert len(re.findall(rb"/Type /Page\b", path.read_bytes())) == 1
    assert b"/ICCBased" not in path.read_bytes()
    picture = drawn(path, 200)
    assert abs(picture.shape[1] - 297 * 200 / 25.4) <= 1
    found = detect(picture)
    assert sorted(found) == [0, 1]
    shift = found[0][0] * 25.4 / 200 - a0.tags[0].corners_mm[0]
    for number in (0, 1):
        np.testing.assert_allclose(found[number] * 25.4 / 200 - shift, a0.tags[number].corners_mm, atol=0.1)
    # 33 greys of 8 mm from 15.24 mm on, bare paper the last: the upper half drawn, the lower an image.
    middles = ((15.24 + 4 + 8 * np.arange(33)) * 200 / 25.4).astype(int)
    for down_mm in (140, 146):
        greys = picture[round(down_mm * 200 / 25.4), middles]
        np.testing.assert_array_equal(greys, np.repeat([*range(0, 256, 8), 255], 3).reshape(-1, 3))


def detect(picture: npt.NDArray[np.uint8]) -> dict[int, npt.NDArray[np.float64]]:
    """Corners of the tags that the AprilTag authors' library finds, clockwise from the print's top-left, px.

    Its pixel corners stand at integers, as they do when millimetres are multiplied by pixels a millimetre.
    """
    detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    grey = picture.mean(axis=2).astype(np.uint8)
    return {found.tag_id: found.corners[[1, 0, 3, 2]] for found in detector.detect(grey)}


def painted(chart: Chart, dpi: int) -> npt.NDArray[np.uint8]:
    """Cells and references painted one by one; the tags' squares stay as they are for `detect` to judge."""
    width, height = (round(side * dpi / 25.4) for side in chart.page_mm)
    picture = np.full((height, width, 3), 255, dtype=np.uint8)
    side = dpi * 125 // 600
    places = [*chart.centres_mm.tolist(), *(reference.centre_mm for reference in chart.references)]
    codes = [*chart.rgb.tolist(), *(reference.rgb for reference in chart.references)]
    for (x, y), code in zip(places, codes, strict=True):
        left, top = round(x * dpi / 25.4 - side / 2), round(y * dpi / 25.4 - side / 2)
        picture[top : top + side, left : left + side] = code
    return picture


def field_of(chart: Chart, dpi: int) -> tuple[slice, slice]:
    """Rows and columns from the first to the last tag, rims included."""
    rim = 50 * 25.4 / 600
    low = (chart.tags[0].corners_mm[0] - rim) * dpi / 25.4
    high = (chart.tags[-1].corners_mm[2] + rim) * dpi / 25.4
    return slice(round(low[1]), round(high[1])), slice(round(low[0]), round(high[0]))


@pytest.fixture(scope="module")
def tiff(a7: Chart, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("print") / "chart.tif"
    save_tiff(a7, path)
    return path


def test_the_tiff_is_the_chart_pixel_by_pixel(a7: Chart, tiff: Path) -> None:
    picture = tifffile.imread(tiff)
    expected = painted(a7, 600)
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
    rows, columns = field_of(a7, 600)
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


def test_an_independent_library_reads_the_tags_of_the_tiff(a7: Chart, tiff: Path) -> None:
    found = detect(tifffile.imread(tiff))
    assert sorted(found) == [0, 1, 2, 3]
    for tag in a7.tags:
        np.testing.assert_allclose(found[tag.id], tag.corners_mm * 600 / 25.4, atol=0.5)


def test_an_independent_library_reads_all_tags_of_the_paper_s_chart(a0: Chart) -> None:
    picture = preview(a0, 1600)
    assert picture.shape == (1132, 1600, 3)
    found = detect(picture)
    assert sorted(found) == list(range(35))
    for tag in a0.tags:
        np.testing.assert_allclose(found[tag.id], tag.corners_mm * 1600 / 1189, atol=0.15)


def test_the_pdf_shows_what_the_tiff_shows(a7: Chart, tiff: Path, tmp_path: Path) -> None:
    save_pdf(a7, tmp_path / "chart.pdf")
    seen, expected = drawn(tmp_path / "chart.pdf", 600, "-aa", "no", "-aaVector", "no"), tifffile.imread(tiff)
    # Every pixel, marks too: nothing is shifted, and no hairline of paper shows between cells.
    np.testing.assert_array_equal(seen[: expected.shape[0], : expected.shape[1]], expected)
    assert sorted(detect(seen)) == [0, 1, 2, 3]


def test_a_tag_that_leans_cannot_be_printed(a7: Chart) -> None:
    corners = a7.tags[0].corners_mm
    for wrong in (np.roll(corners, 1, axis=0), corners + np.array([[0, 0], [0, 0.1], [0, 0], [0, 0]])):
        leaning = replace(a7, tags=(Tag("36h11", 0, wrong),))
        with pytest.raises(InputError):
            drawing(leaning)


def test_a_full_disk_leaves_what_was_there(a7: Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "chart"
    path.write_text("the print of before")
    monkeypatch.setattr(os, "fsync", full)
    for save in (save_tiff, save_pdf, save_preview):
        with pytest.raises(StorageError):
            save(a7, path)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("chart", "the print of before")]
