"""Sort names, decode images and subtract black levels."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import rawpy
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.datasets.files import chart_mask, decode_image, read_rows, subtract_black
from foundation.errors import FormatError
from tests.data_files import shipped
from tests.evaluation.datasets.made_up import image_of, write_png, write_tiff

IMAGES = arrays(np.uint16, st.tuples(st.integers(1, 5), st.integers(1, 5), st.just(3)))


@pytest.mark.slow
@given(IMAGES, st.one_of(st.integers(0, 70000), st.floats(0, 70000)))
def test_subtracts_black_and_clips_at_zero(
    image: np.ndarray[tuple[int, ...], np.dtype[np.uint16]], black: float
) -> None:
    lower = subtract_black(image.copy(), black)
    expected = np.maximum(image.astype(np.float64) - black, 0)
    np.testing.assert_allclose(lower, expected, rtol=1e-6, atol=5e-3)
    assert lower.dtype == (np.uint16 if float(black).is_integer() else np.float32)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_keeps_dtype_of_floats(dtype: type[np.float32]) -> None:
    image = np.array([[[0.5, 0.25, 2.0], [-1, 0, 1]]], dtype)
    assert subtract_black(image.copy(), 0)[0, 1].tolist() == [0, 0, 1]
    lower = subtract_black(image, 0.25)
    assert lower.dtype == dtype
    assert lower.tolist() == [[[0.25, 0, 1.75], [0, 0, 0.75]]]


def test_decodes_red_first_in_every_format(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", image_of(3, 4))
    write_tiff(tmp_path / "a.tif", image_of(3, 4))
    np.save(tmp_path / "a.npy", image_of(3, 4))
    for ending in ("png", "tif", "npy"):
        np.testing.assert_array_equal(decode_image(str(tmp_path / f"a.{ending}")), image_of(3, 4))


def test_refuses_unsuitable_images(tmp_path: Path) -> None:
    cases = {
        "grey.npy": (np.zeros((3, 4), np.uint16), r"\(3, 4\), expected \(height, width, 3\)"),
        "alpha.npy": (np.zeros((3, 4, 4), np.uint16), r"\(3, 4, 4\), expected"),
        "ints.npy": (np.zeros((3, 4, 3), np.int64), "int64, expected uint16"),
        "nan.npy": (np.full((3, 4, 3), np.nan), "expected finite"),
        "objects.npy": (np.array([[["a", "b", "c"]]], object), "cannot be read"),
    }
    for name, (values, message) in cases.items():
        np.save(tmp_path / name, values, allow_pickle=True)
        with pytest.raises(FormatError, match=message) as refusal:
            decode_image(str(tmp_path / name))
        assert name in str(refusal.value)
    (tmp_path / "a.exr").write_bytes(b"")
    with pytest.raises(FormatError, match=r"a\.exr.*'\.exr'"):
        decode_image(str(tmp_path / "a.exr"))
    (tmp_path / "grey.png").write_bytes(imagecodecs.png_encode(np.zeros((3, 4), np.uint16)))
    with pytest.raises(FormatError, match=r"grey\.png.*3.*4"):
        decode_image(str(tmp_path / "grey.png"))


def test_refuses_image_with_one_wrong_byte(tmp_path: Path) -> None:
    noisy = np.random.default_rng(0).integers(0, 65536, (40, 40, 3)).astype(np.uint16)
    write_png(tmp_path / "a.png", noisy)
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(FormatError):
        decode_image(str(tmp_path / "a.png"))


def test_chart_mask_does_not_depend_on_corner_order() -> None:
    corners = np.array([[1.0, 1], [6, 2], [5, 6], [0, 5]])
    mask = chart_mask((8, 8), corners, "a.png")
    np.testing.assert_array_equal(mask, chart_mask((8, 8), corners[::-1], "a.png"))
    assert mask[3, 3]
    assert not mask[0, 7]


@pytest.mark.parametrize("x", [16.0, -16.0, 1e12, np.inf, np.nan])
def test_refuses_chart_far_outside_image(x: float) -> None:
    corners = np.array([[1.0, 1], [15.9, 2], [5, -15.9], [0, 5]])
    assert chart_mask((5, 8), corners, "a.png").any()
    corners[2, 0] = x
    with pytest.raises(FormatError, match=r"chart of a\.png .*8 × 5"):
        chart_mask((5, 8), corners, "a.png")


def test_suggested_dcraw_options_give_colours_of_mosaic(tmp_path: Path) -> None:
    # Without -D dcraw writes white-balanced sRGB of 16 bits, which cannot be distinguished from camera RGB.
    write_png(tmp_path / "eight.png", image_of(4, 4).astype(np.uint8))
    with pytest.raises(FormatError) as refusal:
        decode_image(str(tmp_path / "eight.png"))
    advice = re.search(r"dcraw((?: -\w)+)", str(refusal.value))
    assert advice is not None
    assert advice[1].split() == ["-h", "-D", "-4", "-T"]
    dcraw = shutil.which("dcraw")
    if dcraw is None:
        return
    raw, tiff = str(shipped("raw/canon_eos_550d_colorchart.dng")), tmp_path / "raw.tiff"
    process = subprocess.run([dcraw, "-c", *advice[1].split(), raw], check=True, capture_output=True, timeout=60)
    tiff.write_bytes(process.stdout)
    means = subtract_black(decode_image(str(tiff)), 2056).mean(axis=(0, 1))
    with rawpy.imread(raw) as opened:
        levels, colours = opened.raw_image_visible.astype(float) - 2056, opened.raw_colors_visible
        red, green, blue, second_green = (np.maximum(levels[colours == colour], 0).mean() for colour in range(4))
    expected = np.array([red, (green + second_green) / 2, blue])
    np.testing.assert_allclose(means / means.sum(), expected / expected.sum(), atol=1e-3)


@pytest.mark.parametrize(
    ("text", "reason"), [(b"a,b\n\xff,1\n", "byte 0xff"), (b"a,b\n" + b"x" * 200_000, "field larger")]
)
def test_refuses_unreadable_table(tmp_path: Path, text: bytes, reason: str) -> None:
    (tmp_path / "gt.csv").write_bytes(text)
    with pytest.raises(FormatError, match=f"gt.csv.*{reason}"):
        assert not list(read_rows(tmp_path / "gt.csv", ["a", "b"]))
    with pytest.raises(FormatError, match="restore it"):
        next(read_rows(tmp_path / "none.csv", ["a"]))
