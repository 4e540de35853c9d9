"""Generated raw files as LibRaw and dcraw open them: the image's own values, and neutral where the scene is."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rawpy
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.raw.rawfile import camera_matrix, decode_raw
from generator import files
from generator.files import ImageMetadata, decode_image, encode_image

WHITES = {
    "candle": (1945.3, 492.3, 105.1),
    "blue projector": (103.0, 1092.0, 4418.0),
    "green": (1064.0, 5498.0, 839.0),
    "daylight": (2804.0, 6411.0, 5254.0),
}
CAMERAS = ("Canon EOS 550D", "Canon EOS 6D Mark II", "Benchmark", "Ένας")


def grey_scene(white: tuple[float, float, float]) -> npt.NDArray[np.uint16]:
    """Return a grey ramp under a light, with shot noise; its brightest place reflects 90 %."""
    reflectance = np.linspace(0.15, 0.9, 96)[None, :, None]
    return np.random.default_rng(3).poisson(np.full((64, 1, 1), 1.0) * reflectance * white).astype(np.uint16)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("light", WHITES)
def test_what_libraw_shows_is_neutral_where_the_scene_is(light: str, camera: str) -> None:
    white = WHITES[light]
    # Saturation far enough above the white that no channel clips when LibRaw multiplies it by its balance.
    metadata = ImageMetadata(white_level=12000, white=white, camera=camera)
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(white), "dng", metadata))) as raw:
        shown = raw.postprocess(
            use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1), highlight_mode=rawpy.HighlightMode(1)
        )
    means = shown[8:-8, 8:-8].reshape(-1, 3).mean(axis=0, dtype=np.float64)
    # The mean of some 3800 pixels of the dimmest channel (some 55 DN) is known to .3 %; six of that are allowed.
    np.testing.assert_allclose(means / means[1], 1, atol=0.02)


def test_without_the_ground_truth_it_is_not_neutral() -> None:
    """So that the test above can fail: the same scene, the balance of another light."""
    metadata = ImageMetadata(white_level=12000, white=WHITES["daylight"], camera="Canon EOS 550D")
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(WHITES["candle"]), "dng", metadata))) as raw:
        shown = raw.postprocess(use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1))
    means = shown.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    assert abs(means[0] / means[1] - 1) > 0.5


@pytest.mark.slow
@settings(max_examples=40)
@given(height=st.integers(22, 41), width=st.integers(22, 41), seed=st.integers(0, 99))
def test_each_photosite_is_its_own_channel_of_its_pixel(height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 65536, (height, width, 3)).astype(np.uint16)
    data = encode_image(image, "dng", ImageMetadata(65535, (1.0, 1.0, 1.0), "Canon EOS 550D"))
    mosaic = decode_raw(data, Path("image.dng"))
    assert (mosaic.pattern, mosaic.white_level, mosaic.black.tolist()) == ("RGGB", 65535, [[0, 0], [0, 0]])
    rows, columns = np.indices((height, width)) % 2
    np.testing.assert_array_equal(mosaic.counts, np.take_along_axis(image, (rows + columns)[..., None], 2)[..., 0])
    blocks = mosaic.counts[: height // 2 * 2, : width // 2 * 2].reshape(height // 2, 2, width // 2, 2)
    half = decode_image(data, "dng", "image.dng")
    np.testing.assert_array_equal(half[..., 0], blocks[:, 0, :, 0])
    np.testing.assert_array_equal(half[..., 1], np.ceil((blocks[:, 0, :, 1] + 0.0 + blocks[:, 1, :, 0]) / 2))
    np.testing.assert_array_equal(half[..., 2], blocks[:, 1, :, 1])


def test_dcraw_sees_the_same_counts_and_balance(tmp_path: Path) -> None:
    dcraw = shutil.which("dcraw")
    if dcraw is None:
        pytest.skip("dcraw is not installed")
    white = WHITES["candle"]
    image = grey_scene(white)
    path = tmp_path / "image.dng"
    path.write_bytes(encode_image(image, "dng", ImageMetadata(12000, white, "Canon EOS 550D")))
    subprocess.run([dcraw, "-D", "-4", "-T", str(path)], check=True, timeout=60)
    counts = decode_raw(path.read_bytes(), path).counts
    np.testing.assert_array_equal(tifffile.imread(path.with_suffix(".tiff")), counts)
    subprocess.run([dcraw, "-w", "-4", "-H", "1", "-T", str(path)], check=True, timeout=60)
    means = tifffile.imread(path.with_suffix(".tiff"))[8:-8, 8:-8].reshape(-1, 3).mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(means / means[1], 1, atol=0.02)


def test_the_tags_are_those_of_the_standard() -> None:
    image = np.zeros((30, 40, 3), np.uint16)
    metadata = ImageMetadata(11536, (500.0, 2000.0, 1000.0), "Canon EOS 550D")
    with tifffile.TiffFile(io.BytesIO(encode_image(image, "dng", metadata))) as file:
        tags = {tag.code: tag.value for tag in file.pages.first.tags}
    (start,) = tags.pop(273)
    assert tags.pop(279) == (30 * 40 * 2,)
    assert start % 16 == 0
    assert json.loads(tags.pop(270))["white"] == [500, 2000, 1000]
    neutral = np.array(tags.pop(50728), dtype=float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [0.25, 1, 0.5])
    matrix = np.array(tags.pop(50721), dtype=float).reshape(3, 3, 2)
    known = camera_matrix("Canon EOS 550D")
    assert known is not None
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], known, atol=5e-5)
    # TIFF 6.0, sections 8 and 4: one uncompressed picture, pixel by pixel. TIFF/EP: blocks of RGGB. DNG 1.7.1, chapter
    # 4: a file of 1.4 that readers from 1.1 on can read, planes red, green and blue, sites in rows, daylight.
    assert tags == {
        254: 0, 256: 40, 257: 30, 258: 16, 259: 1, 262: 32803, 274: 1, 277: 1, 278: 30, 284: 1,
        271: "CroP", 272: "Canon EOS 550D generated", 50708: "CroP Canon EOS 550D generated",
        33421: (2, 2), 33422: bytes([0, 1, 1, 2]), 50706: bytes([1, 4, 0, 0]), 50707: bytes([1, 1, 0, 0]),
        50710: bytes([0, 1, 2]), 50711: 1, 50714: 0, 50717: 11536, 50778: 21,
    }  # fmt: skip


def test_the_matrix_of_srgb_is_the_inverse_of_the_standards() -> None:
    # Of IEC 61966-2-1, which gives it to four decimals beside its inverse.
    inverse = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    np.testing.assert_allclose(np.array(files._SRGB) @ inverse, np.eye(3), atol=3e-4)
