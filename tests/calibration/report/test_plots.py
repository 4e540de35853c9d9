"""Half-size linear RGB, of any Bayer phase and any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.report.plots import half_size
from drivers.raw.plain_dng import Area
from drivers.raw.rawfile import Mosaic


def mosaic_of(
    counts: np.ndarray[tuple[int, int], np.dtype[np.uint16]], pattern: str, masked: tuple[Area, ...] = ()
) -> Mosaic:
    """Return a mosaic of which `counts` is the whole sensor; masked columns are cut off the visible area."""
    left = max((area.left + area.width for area in masked), default=0)
    visible = Area(0, left, counts.shape[0], counts.shape[1] - left)
    return Mosaic(
        counts=counts[:, left:],
        pattern=pattern,
        black=np.array([[100.0, 101.0], [102.0, 103.0]]),
        white_level=4095,
        camera="Test",
        sensor=counts,
        visible=visible,
        masked=masked,
    )


@given(
    st.sampled_from(["RGGB", "BGGR", "GRBG", "GBRG"]), st.integers(2, 7), st.integers(2, 7), st.integers(0, 2**32 - 1)
)
def test_every_pixel_is_its_block(pattern: str, height: int, width: int, seed: int) -> None:
    counts = np.random.default_rng(seed).integers(0, 4096, (height, width)).astype(np.uint16)
    image = half_size(mosaic_of(counts, pattern))
    assert image.shape == (height // 2, width // 2, 3)
    for i in range(height // 2):
        for j in range(width // 2):
            light: dict[str, list[float]] = {"R": [], "G": [], "B": []}
            for place, letter in enumerate(pattern):
                row, column = divmod(place, 2)
                light[letter].append(float(counts[2 * i + row, 2 * j + column]) - (100 + place))
            expected = [np.mean(light[letter]) for letter in "RGB"]
            assert image[i, j] == pytest.approx(expected)


def test_the_masked_border_overrules_the_metadata() -> None:
    counts = np.full((200, 60), 1000, dtype=np.uint16)
    counts[:, :20] = 128
    image = half_size(mosaic_of(counts, "RGGB", (Area(0, 0, 200, 20),)))
    assert image == pytest.approx(872)
