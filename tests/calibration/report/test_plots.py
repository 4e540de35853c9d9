"""Half-size linear RGB of any Bayer phase and size, and the plots of cells and lights."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.causes.gathering import PrintPosition
from calibration.comparison.comparing import CellDifferences
from calibration.comparison.report import draw_map
from calibration.report import plots
from calibration.report.plots import (
    draw_chromaticities,
    draw_positions,
    half_size,
    numbered_labels,
    viewable,
)
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.chart.layout import design_chart

pytestmark = pytest.mark.slow


def drawn(draw: Callable[..., None], count: int, *arguments: Any) -> list[Any]:
    """Return panels that are drawn but not rendered."""
    panels = [empty_axes() for _ in range(count)]
    draw(panels, *arguments)
    return panels


def empty_axes() -> Any:
    """Return empty axes."""
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def mosaic_of(
    counts: np.ndarray[tuple[int, int], np.dtype[np.uint16]], pattern: str, masked: tuple[Area, ...] = ()
) -> Mosaic:
    """Return a mosaic of a sensor with these counts; masked columns are outside the visible area."""
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
def test_half_size_pixel_is_its_block(pattern: str, height: int, width: int, seed: int) -> None:
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


def test_masked_border_overrides_metadata() -> None:
    counts = np.full((200, 60), 1000, dtype=np.uint16)
    counts[:, :20] = 128
    image = half_size(mosaic_of(counts, "RGGB", (Area(0, 0, 200, 20),)))
    assert image == pytest.approx(872)


CHART = design_chart(3, "A7")
CELLS = CHART.centres_mm[CHART.cell_of_colour]


def test_map_shows_channel_with_largest_difference() -> None:
    random = np.random.default_rng(1)
    mean, none = random.normal(0, 0.01, (len(CELLS), 3)), np.zeros((len(CELLS), 3))
    mean[7] = np.nan
    offset = np.array([0.001, -0.002, 0.0])
    count = np.ones((len(CELLS), 3), dtype=np.int64)
    cells = CellDifferences(count, mean, none, offset, 0.0, 0.0, 1.0)
    (squares,) = drawn(draw_map, 1, CHART, cells)[0].collections
    left = mean - offset
    largest = [row[np.abs(row).argmax()] if np.isfinite(row).all() else 0.0 for row in left]
    np.testing.assert_allclose(np.asarray(squares.get_array()), 100 * np.array(largest))


def test_draws_lights_at_their_chromaticities() -> None:
    codes = np.array([[255.0, 0, 0], [255, 255, 255], [0, 0, 0], [0, 0, 255]])
    white = np.array([[600.0, 300, 100], [200, 500, 300], [0, 0, 0], [100, 300, 600]])
    kelvins = np.array([np.nan, 6500, np.nan, np.nan])
    panels = drawn(draw_chromaticities, 2, codes, kelvins, white, 0)
    expected = [[(1, 0), (0, 1), (1 / 3, 1 / 3)], [(0.6, 0.1), (0.1, 0.6), (0.2, 0.3)]]
    for axes, places in zip(panels, expected, strict=True):
        # Black bodies come second; a light without light has no chromaticity.
        dots_at = np.concatenate([np.asarray(dots.get_offsets()) for dots in axes.collections])
        np.testing.assert_allclose(dots_at, places, atol=1e-9)
        assert [text.get_text() for text in axes.texts] == ["6500 K", "illuminant 0"]
    drawn(draw_chromaticities, 2, codes, kelvins, white)
    drawn(draw_chromaticities, 2, codes, kelvins, white, 2)


# What each picture shows, read from what is drawn.

CELL_W = CHART.cell_mm[0]
FRAME = np.random.default_rng(5).uniform(100, 900, (160, 230, 3)).astype(np.float32)


def seen(points_mm: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return 2 * np.asarray(points_mm, dtype=np.float64) + (7, 4)


def by_the_lens(points_mm: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return 1.9 * np.asarray(points_mm, dtype=np.float64)


def place_errors(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.linspace(0.01, 0.05, len(points_mm))


def registered(**more: object) -> Any:
    """Return a registration with 2 px per mm, and 1.9 px per mm by the lens alone."""
    tag = SimpleNamespace(corners_px=np.array([[20.0, 20], [40, 20], [40, 41], [20, 40]]))
    result = {
        "cell_px": 2 * CELL_W,
        "to_pixels": seen,
        "lens": SimpleNamespace(to_pixels=by_the_lens),
        "framing": SimpleNamespace(tags=[tag]),
        "uncertainty_px": place_errors,
    }
    return SimpleNamespace(**result | more)


def test_viewable_image_shows_paper_bright() -> None:
    even = np.tile(np.arange(0.0, 1000, dtype=np.float32)[:, None, None], (1, 8, 3)) * np.array([1, 2, 4], np.float32)
    shown = viewable(even)
    white = np.percentile(np.repeat(np.arange(0, 1000, 4), 2), 99.5)
    expected = np.minimum(np.arange(1000) / white, 1) ** (1 / 2.2)
    np.testing.assert_allclose(shown, np.tile(expected[:, None, None], (1, 8, 3)), rtol=1e-5)
    assert viewable(np.full((8, 8, 3), 0.5, np.float32)) == pytest.approx(0.5 ** (1 / 2.2)), "of less than a count"


def test_labels_at_edge_point_inwards() -> None:
    for x, y, ha, text in ((0.69, 0.69, "left", (8, 8)), (0.71, 0.71, "right", (-8, -14))):
        axes: Any = empty_axes()
        axes.set(xlim=(10, 30), ylim=(-5, 5))
        place = (10 + 20 * x, -5 + 10 * y)
        plots._ring(axes, *place, "here")
        (note,) = axes.texts
        assert (note.xy, note.get_ha(), note.xyann) == (place, ha, text)


def test_draws_shared_circles_once() -> None:
    places = [("one", PrintPosition("a", 30.0, 40.0, 20.0)), ("two", PrintPosition("a", 30.0, 40.0, 20.0)),
              ("one", PrintPosition("a", 60.0, 40.0, 0.0)), ("three", PrintPosition("a", 1.0, 40.0, 20.0))]  # fmt: skip
    (axes,) = drawn(draw_positions, 1, FRAME, CHART, registered(), places)
    assert numbered_labels(places) == {"one": 1, "two": 2, "three": 3}
    assert [text.get_text() for text in axes.texts] == ["1, 2", "1", "3"]
