"""Half-size linear RGB, of any Bayer phase and any size; and what is drawn of cells and lights."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.comparison.comparing import CellDifferences
from calibration.comparison.report import draw_map
from calibration.report import plots
from calibration.report.plots import draw_chromaticities, draw_print, half_size
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.chart.layout import design_chart
from experiment.measures.stains import Stains


def new_figure() -> Any:
    """Return an empty figure: Matplotlib is imported where one is drawn."""
    from matplotlib.figure import Figure

    return Figure()


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


CHART = design_chart(3, "A7")
CELLS = CHART.centres_mm[CHART.cell_of_colour]


def test_what_a_print_is_off_by_is_drawn_in_per_cent_where_its_cells_lie() -> None:
    deviation = np.linspace(-0.02, 0.03, len(CELLS))
    off = np.stack([deviation, deviation / 2, 0 * deviation], axis=-1)
    stained = np.arange(len(CELLS)) == 5
    figure = new_figure()
    draw_print(figure, CHART, Stains(off, np.full_like(off, 1e-6), off, stained, np.ones_like(off), CELLS))
    axes = figure.axes[0]
    (squares,) = axes.collections
    np.testing.assert_allclose(np.asarray(squares.get_offsets()), CELLS)
    np.testing.assert_allclose(np.asarray(squares.get_array()), 100 * deviation)
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_xydata()), CELLS[5:6])
    # The page's first row is at the top.
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, CHART.page_mm[0]), (CHART.page_mm[1], 0))


def test_what_cells_of_two_tables_differ_by_is_drawn_in_the_channel_that_differs_most() -> None:
    random = np.random.default_rng(1)
    mean, none = random.normal(0, 0.01, (len(CELLS), 3)), np.zeros((len(CELLS), 3))
    mean[7] = np.nan
    offset = np.array([0.001, -0.002, 0.0])
    count = np.ones((len(CELLS), 3), dtype=np.int64)
    cells = CellDifferences(count, mean, none, none, none, count, none, (), (), 1.0, 0.0, 0.0, offset)
    figure = new_figure()
    draw_map(figure, CHART, cells)
    axes = figure.axes[0]
    (squares,) = axes.collections
    left = mean - offset
    largest = [row[np.abs(row).argmax()] if np.isfinite(row).all() else 0.0 for row in left]
    np.testing.assert_allclose(np.asarray(squares.get_offsets()), CELLS)
    np.testing.assert_allclose(np.asarray(squares.get_array()), 100 * np.array(largest))
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, CHART.page_mm[0]), (CHART.page_mm[1], 0))


def test_lights_are_drawn_at_their_chromaticities_in_the_triangle_of_all() -> None:
    codes = np.array([[255.0, 0, 0], [255, 255, 255], [0, 0, 0], [0, 0, 255]])
    white = np.array([[600.0, 300, 100], [200, 500, 300], [0, 0, 0], [100, 300, 600]])
    figure = new_figure()
    draw_chromaticities(figure, codes, np.array([False, True, False, False]), white, "seen", worst=0)
    for axes, places in zip(
        figure.axes, [[(1, 0), (0, 1), (1 / 3, 1 / 3)], *[[(0.6, 0.1), (0.1, 0.6), (0.2, 0.3)]] * 2], strict=True
    ):
        assert np.unique(np.asarray(axes.lines[0].get_xydata()), axis=0).tolist() == [[0, 0], [0, 1], [1, 0]]
        # Black bodies come second; a light without light has no chromaticity.
        drawn = np.concatenate([np.asarray(dots.get_offsets()) for dots in axes.collections])
        np.testing.assert_allclose(drawn, places, atol=1e-9)


def test_a_cell_is_outlined_at_its_corners_and_its_samples_about_its_middle() -> None:
    drawn: list[list[tuple[float, float]]] = []

    def plot(x: npt.ArrayLike, y: npt.ArrayLike, **_: object) -> None:
        drawn.append([(float(one), float(other)) for one, other in zip(np.asarray(x), np.asarray(y), strict=True)])

    def seen(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return 10 * points_mm

    axes: Any = new_figure().add_subplot()
    axes.plot = plot
    chart: Any = SimpleNamespace(cell_mm=(4, 2), centres_mm=np.array([[6.0, 5.0], [40.0, 5.0]]))
    registration: Any = SimpleNamespace(cell_px=20, to_pixels=seen)
    picture, places = np.zeros((100, 500, 3), np.float32), np.array([[60.0, 50.0], [400.0, 50.0]])
    magnified = plots._magnified  # pyright: ignore[reportPrivateUsage]
    magnified(axes, picture, places[0], 30.0, chart, registration, places, 5)
    cell, samples = drawn
    assert cell == [(40, 40), (80, 40), (80, 60), (40, 60), (40, 40)]
    assert samples == [(57.5, 47.5), (62.5, 47.5), (62.5, 52.5), (57.5, 52.5), (57.5, 47.5)]
