"""The proof page and the instructions: true size, readable tags, greys of the right codes."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from pyapriltags import Detector

from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart
from experiment.chart.printing import drawing, field_px
from experiment.chart.proof import WEDGE_CODES, instructions, proof_drawing, save_proof

pytestmark = pytest.mark.slow

PX_MM = 25.4 / 600


def drawn(path: Path, dpi: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB of a PDF's page as poppler draws it."""
    renderer = shutil.which("pdftoppm")
    if renderer is None:
        pytest.skip("pdftoppm (poppler) is not installed, and nothing else here draws a PDF")
    picture = path.with_suffix("")
    subprocess.run([renderer, "-r", str(dpi), "-singlefile", "-png", path, picture], check=True)
    image = cv2.imread(str(picture.with_suffix(".png")))
    assert image is not None
    return image[:, :, ::-1].astype(np.uint8)


def detect(picture: npt.NDArray[np.uint8]) -> dict[int, npt.NDArray[np.float64]]:
    detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    found = detector.detect(picture.mean(axis=2).astype(np.uint8))
    return {tag.tag_id: tag.corners[[1, 0, 3, 2]] for tag in found}


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


def test_both_halves_of_the_greys_have_the_codes(a7: Chart, tmp_path: Path) -> None:
    save_proof(a7, tmp_path / "proof.pdf")
    picture = drawn(tmp_path / "proof.pdf", 254)
    middles = (360 * PX_MM + 8 * (np.arange(len(WEDGE_CODES)) + 0.5)) * 10
    for y_mm in (140, 146):
        row = picture[y_mm * 10, np.rint(middles).astype(int)]
        np.testing.assert_array_equal(row, np.array(WEDGE_CODES)[:, None].repeat(3, axis=1))


@pytest.mark.parametrize("chart", [design_chart(1), design_chart(5, "A2"), paper_chart()], ids=["A7", "A2", "paper"])
def test_the_piece_is_the_sheet_s_own(chart: Chart) -> None:
    proof, sheet = proof_drawing(chart), drawing(chart)
    assert (proof.rectangles_mm >= 0).all()
    assert (proof.rectangles_mm[:, 2:] <= proof.page_mm).all()
    assert proof.tiles > 0
    shift = (np.array([360, 330]) - field_px(chart)[:2]) * PX_MM
    known = {(*box, *code) for box, code in zip(sheet.rectangles_mm.round(3).tolist(), sheet.rgb.tolist(), strict=True)}
    tiles = (proof.rectangles_mm[-proof.tiles :] - np.tile(shift, 2)).round(3)
    assert all(
        (*box, *code) in known for box, code in zip(tiles.tolist(), proof.rgb[-proof.tiles :].tolist(), strict=True)
    )
    # The piece does not reach the greys below it.
    assert proof.rectangles_mm[-proof.tiles :, 3].max() < 130


def test_the_instructions_tell_the_sheet_s_own_sizes(a0: Chart, a7: Chart) -> None:
    text = instructions(a0)
    assert "1189 × 841 mm" in text
    assert "28087 × 19866 pixels" in text
    assert "0 and 1100 below the field are 1100 mm apart, 0 and 800 on its left 800 mm" in text
    assert a0.sha256[:16] in text
    for word in ("NO COLOUR MANAGEMENT", "100 %", "Matte", "no varnish, no lamination", "Flat"):
        assert word in text
    assert "chart.tif" not in instructions(a0, tiff=False)
    assert "as their numbers say" in instructions(a7)
    assert max(len(line) for line in text.splitlines()) <= 120
