"""Half-size linear RGB, of any Bayer phase and any size; and what is drawn of cells and lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.budget import Budget, Component
from calibration.causes.gathering import PrintPlace
from calibration.comparison.comparing import CellDifferences
from calibration.comparison.report import draw_map
from calibration.report import plots
from calibration.report.plots import (
    draw_budget,
    draw_chromaticities,
    draw_course,
    draw_errors,
    draw_field,
    draw_noise,
    draw_places,
    draw_print,
    draw_reference_residuals,
    draw_registration,
    draw_residuals,
    draw_worst_cells,
    half_size,
    reference_residuals,
    viewable,
)
from calibration.sampling import PhotonTransfer
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.chart.layout import design_chart
from experiment.measures.stains import Stains

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_pictures")]


def drawn(draw: Callable[..., None], *arguments: Any) -> Any:
    """Return the figure that is drawn, which nobody renders; Matplotlib is imported where one is."""
    from matplotlib.figure import Figure

    figure: Any = Figure()
    draw(figure, *arguments)
    return figure


def empty_axes() -> Any:
    """Return axes on which nothing is drawn yet."""
    from matplotlib.figure import Figure

    return Figure().add_subplot()


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
    figure = drawn(draw_print, CHART, Stains(off, np.full_like(off, 1e-6), off, stained, np.ones_like(off), CELLS))
    (squares,) = figure.axes[0].collections
    np.testing.assert_allclose(np.asarray(squares.get_array()), 100 * deviation)


def test_what_cells_of_two_tables_differ_by_is_drawn_in_the_channel_that_differs_most() -> None:
    random = np.random.default_rng(1)
    mean, none = random.normal(0, 0.01, (len(CELLS), 3)), np.zeros((len(CELLS), 3))
    mean[7] = np.nan
    offset = np.array([0.001, -0.002, 0.0])
    count = np.ones((len(CELLS), 3), dtype=np.int64)
    cells = CellDifferences(count, mean, none, offset, 0.0, 0.0, 1.0)
    (squares,) = drawn(draw_map, CHART, cells).axes[0].collections
    left = mean - offset
    largest = [row[np.abs(row).argmax()] if np.isfinite(row).all() else 0.0 for row in left]
    np.testing.assert_allclose(np.asarray(squares.get_array()), 100 * np.array(largest))


def test_lights_are_drawn_at_their_chromaticities_in_the_triangle_of_all() -> None:
    codes = np.array([[255.0, 0, 0], [255, 255, 255], [0, 0, 0], [0, 0, 255]])
    white = np.array([[600.0, 300, 100], [200, 500, 300], [0, 0, 0], [100, 300, 600]])
    bodies = np.array([False, True, False, False])
    figure = drawn(draw_chromaticities, codes, bodies, white, "seen", 0)
    for axes, places in zip(
        figure.axes, [[(1, 0), (0, 1), (1 / 3, 1 / 3)], *[[(0.6, 0.1), (0.1, 0.6), (0.2, 0.3)]] * 2], strict=True
    ):
        # Black bodies come second; a light without light has no chromaticity.
        dots_at = np.concatenate([np.asarray(dots.get_offsets()) for dots in axes.collections])
        np.testing.assert_allclose(dots_at, places, atol=1e-9)
    drawn(draw_chromaticities, codes, bodies, white, "seen")
    drawn(draw_chromaticities, codes, bodies, white, "seen", 2)


def test_a_cell_is_outlined_at_its_corners_and_its_samples_about_its_middle() -> None:
    lines: list[list[tuple[float, float]]] = []

    def plot(x: npt.ArrayLike, y: npt.ArrayLike, **_: object) -> None:
        lines.append([(float(one), float(other)) for one, other in zip(np.asarray(x), np.asarray(y), strict=True)])

    def seen(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return 10 * points_mm

    axes: Any = empty_axes()
    axes.plot = plot
    chart: Any = SimpleNamespace(cell_mm=(4, 2), centres_mm=np.array([[6.0, 5.0], [40.0, 5.0]]))
    registration: Any = SimpleNamespace(cell_px=20, to_pixels=seen)
    picture, places = np.zeros((100, 500, 3), np.float32), np.array([[60.0, 50.0], [400.0, 50.0]])
    magnified = plots._magnified
    magnified(axes, picture, places[0], 30.0, chart, registration, places, 5)
    cell, samples = lines
    assert cell == [(40, 40), (80, 40), (80, 60), (40, 60), (40, 40)]
    assert samples == [(57.5, 47.5), (62.5, 47.5), (62.5, 52.5), (57.5, 52.5), (57.5, 47.5)]


# What each picture shows, read from what is drawn.

PAGE_W, PAGE_H = CHART.page_mm
CELL_W = CHART.cell_mm[0]
FRAME = np.random.default_rng(5).uniform(100, 900, (160, 230, 3)).astype(np.float32)


def seen(points_mm: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return 2 * np.asarray(points_mm, dtype=np.float64) + (7, 4)


def by_the_lens(points_mm: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return 1.9 * np.asarray(points_mm, dtype=np.float64)


def place_errors(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.linspace(0.01, 0.05, len(points_mm))


def registered(**more: object) -> Any:
    """Return a registration that sees millimetres twice as large, and the lens alone 1.9 times."""
    tag = SimpleNamespace(corners_px=np.array([[20.0, 20], [40, 20], [40, 41], [20, 40]]))
    found = {
        "cell_px": 2 * CELL_W,
        "to_pixels": seen,
        "lens": SimpleNamespace(to_pixels=by_the_lens),
        "framing": SimpleNamespace(tags=[tag]),
        "uncertainty_px": place_errors,
    }
    return SimpleNamespace(**found | more)


def test_a_picture_is_bright_where_paper_is() -> None:
    even = np.tile(np.arange(0.0, 1000, dtype=np.float32)[:, None, None], (1, 8, 3)) * np.array([1, 2, 4], np.float32)
    shown = viewable(even)
    white = np.percentile(np.repeat(np.arange(0, 1000, 4), 2), 99.5)
    expected = np.minimum(np.arange(1000) / white, 1) ** (1 / 2.2)
    np.testing.assert_allclose(shown, np.tile(expected[:, None, None], (1, 8, 3)), rtol=1e-5)
    assert viewable(np.full((8, 8, 3), 0.5, np.float32)) == pytest.approx(0.5 ** (1 / 2.2)), "of less than a count"


def test_the_registered_chart_is_drawn_over_its_frame() -> None:
    figure = drawn(draw_registration, FRAME, CHART, registered(), 5)
    tag, *_, edge = (np.asarray(line.get_xydata()) for line in figure.axes[0].lines)
    np.testing.assert_allclose(tag, [[20, 20], [40, 20], [40, 41], [20, 40], [20, 20]])
    page = np.array([[0, 0], [PAGE_W, 0], [PAGE_W, PAGE_H], [0, PAGE_H], [0, 0]])
    np.testing.assert_allclose(edge, 1.9 * page)


def test_worst_cells_are_drawn_in_the_order_of_their_unevenness() -> None:
    picture = np.random.default_rng(3).normal(500, 1, (400, 500, 3)).astype(np.float32)
    at = 4 * np.asarray(CHART.centres_mm) + 20
    cells = [7, 99, 300]
    for cell, more in zip(cells, (80, 120, 40), strict=True):
        x, y = np.rint(at[cell]).astype(int)
        picture[y - 1 : y + 2, x - 1 : x + 2] += more

    def larger(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return 4 * points_mm + 20

    found = registered(to_pixels=larger, cell_px=4 * CELL_W)
    figure = drawn(draw_worst_cells, picture, CHART, found, 5)
    assert len(figure.axes) == 20
    for axes, cell in zip(figure.axes, [99, 7, 300], strict=False):
        codes, score = axes.get_title().split("\n")
        assert codes.split() == [str(code) for code in CHART.rgb[cell]]
        assert float(score.removesuffix(" σ")) > 5


def test_residuals_are_arrows_where_blocks_lie_and_point_as_the_picture_does() -> None:
    blocks = SimpleNamespace(
        good=np.array([True, True, False]),
        centres_mm=np.array([[20.0, 20], [60, 20], [60, 50]]),
        residual_px=np.array([[0.03, 0.04], [0.0, -0.01], [9.0, 9.0]]),
    )

    def at(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return points[:, :1] * np.array([0.03, 0.04])

    moved = SimpleNamespace(at=at)
    figure = drawn(draw_residuals, CHART, registered(blocks=blocks, displacement=moved))
    left, right = figure.axes[:2]
    (over,) = left.collections
    # Upwards is less.
    np.testing.assert_allclose(np.column_stack([over.U, over.V]), np.column_stack([0.03 * over.X, -0.04 * over.X]))
    (arrows,) = [one for one in right.collections if hasattr(one, "U")]
    np.testing.assert_allclose(np.column_stack([arrows.X, arrows.Y]), blocks.centres_mm[:2])
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), [[0.03, -0.04], [0, 0.01]])
    assert arrows.scale == pytest.approx(20 * 0.05), "the longest a twentieth of the width"


def test_the_field_is_drawn_over_the_page_with_contours_of_two_per_cent() -> None:
    def at(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return 1 + points[:, :1] / PAGE_W * np.array([-0.1, 0.05, 0.111])

    drawn(draw_field, CHART, SimpleNamespace(at=at))


def test_errors_of_cells_are_drawn_in_per_cent_and_their_worst_ringed() -> None:
    deviation = np.linspace(-0.04, 0.03, len(CELLS))
    error, alone = np.full((len(CELLS), 3), 1e-6), np.zeros((len(CELLS), 3))
    known = np.repeat(deviation[:, None], 3, axis=1)
    stains = Stains(known, error, alone, np.zeros(len(CELLS), np.bool_), np.ones((len(CELLS), 3)), CELLS)
    table = SimpleNamespace(cells=SimpleNamespace(stains=stains), registration=registered())
    for axes, values in zip(
        drawn(draw_errors, table, CHART).axes, (100 * deviation, np.linspace(0.01, 0.05, len(CELLS))), strict=False
    ):
        (squares,) = axes.collections
        np.testing.assert_allclose(np.asarray(squares.get_array()), values)
        # Squares 4.1 inches of 72 points over the page are as wide as a cell.
        assert np.sqrt(squares.get_sizes()[0]) * PAGE_W / (72 * 4.1) == pytest.approx(CELL_W)
    table.cells.stains = replace(stains, deviation=np.full_like(known, np.nan))
    assert not drawn(draw_errors, table, CHART).axes[0].collections, "too few colours to compare"


def course(count: int = 6, colours: int = 4096) -> Any:
    """Return a session whose frames differ: every third is white."""
    frames = [
        SimpleNamespace(
            black=np.full((2, 2), 2048.0 + 3 * number),
            blur_px=0.5 + (0.2 if number == 4 else 0.01 * number),
            paper=SimpleNamespace(references=80 - 7 * (number == 2), white=np.array([4.0, 9, 2]) * (1 + number)),
            shift=SimpleNamespace(length_px=0.3 if number == 1 else 0.02 * number),
            consistency=SimpleNamespace(scatter=0.004 + 0.001 * number, block=0.03 if number == 3 else 0.0),
            record=SimpleNamespace(kind="light" if number % 3 else "white", file=f"frames/{number:04}_x.dng"),
        )
        for number in range(count)
    ]
    return SimpleNamespace(frames=frames, registration=SimpleNamespace(mismatched_cells=np.zeros(colours)))


def test_the_course_is_drawn_frame_by_frame_and_the_worst_frame_is_ringed() -> None:
    drawn(draw_course, course())


def test_a_course_in_which_nothing_happens_has_no_ring_and_one_of_few_colours_says_so() -> None:
    drawn(draw_course, course(1, 64))


def test_a_name_at_the_edge_of_a_plot_is_turned_inwards() -> None:
    for x, y, ha, text in ((0.69, 0.69, "left", (8, 8)), (0.71, 0.71, "right", (-8, -14))):
        axes: Any = empty_axes()
        axes.set(xlim=(10, 30), ylim=(-5, 5))
        place = (10 + 20 * x, -5 + 10 * y)
        plots._ring(axes, *place, "here")
        (note,) = axes.texts
        assert (note.xy, note.get_ha(), note.xyann) == (place, ha, text)


def test_the_noise_curve_is_drawn_through_its_levels() -> None:
    level = np.repeat(np.geomspace(20, 8000, 320)[:, None], 3, axis=1)
    transfer = PhotonTransfer(np.array([1.8, 3.6, 1.8]), np.full(3, 4.0), np.full(3, 0.004), np.zeros(3),
                              np.zeros(1), 9.0)  # fmt: skip
    variance = transfer.variance(level)
    variance[:, 2] = 0
    for count in (320, 20):
        drawn(draw_noise, (level[:count], variance[:count]), transfer, 25)


def test_a_budget_is_drawn_by_cause_and_the_worst_light_stands_first() -> None:
    white = np.tile([2000.0, 4000, 1000], (3, 1))
    sizes = np.array([1.0, 3, 2])[:, None, None] * np.diag([1e-6, 4e-6, 9e-6])
    causes = [
        Component("noise", "noise", False, "", sizes, np.full((4, 3), 1e-4)),
        Component("lens", "lens", True, "", 3 * sizes, np.full((4, 3), 3e-4)),
    ]
    budget, levels = Budget(tuple(causes), white), np.array([[0.05], [0.1], [0.5], [1]]) * [1, 0.9, 0.8]
    lights, _ = drawn(draw_budget, budget, levels).axes
    assert [tick.get_text() for tick in lights.get_xticklabels()] == ["1", "2", "0"]


def test_places_are_circled_and_those_of_one_circle_share_its_numbers() -> None:
    places = [("one", PrintPlace("a", 30.0, 40.0, 20.0)), ("two", PrintPlace("a", 30.0, 40.0, 20.0)),
              ("one", PrintPlace("a", 60.0, 40.0, 0.0)), ("three", PrintPlace("a", 1.0, 40.0, 20.0))]  # fmt: skip
    axes, _ = drawn(draw_places, FRAME, CHART, registered(), places).axes
    assert [text.get_text() for text in axes.texts] == ["1, 2", "1", "3"]


def test_what_the_field_leaves_is_the_mean_about_a_reference_over_field_and_white() -> None:
    places = np.array([[30.0, 40.0], [60.0, 20.0], [-3.0, 10.0], [110.5, 50.0], [111.4, 50.0], [-2.5, -1.0]])
    picture = np.full((160, 230, 3), 50.0, np.float32)
    for place, level in zip(places[:2], (880.0, 1210.0), strict=True):
        x, y = seen(place).astype(int)
        picture[y - 2 : y + 3, x - 2 : x + 3, 1] = level

    def at(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.full((len(points), 3), [9.0, 1.1, 9.0])

    paper = SimpleNamespace(white=np.array([10.0, 1000.0, 20.0]), field=SimpleNamespace(at=at))
    frame: Any = SimpleNamespace(paper=paper)
    left = reference_residuals(picture, places, registered(), frame)
    assert left[:2] == pytest.approx((880 / 1100 - 1, 1210 / 1100 - 1), abs=1e-6)
    # Two pixels beside the frame's edge are the least that is averaged.
    assert np.isfinite(left).tolist() == [True, True, False, False, False, True]


def test_what_the_field_leaves_is_drawn_on_the_page_and_by_the_distance_from_its_middle() -> None:
    places = np.array([[PAGE_W / 2, PAGE_H / 2], [PAGE_W / 2 + 30, PAGE_H / 2 + 40], [5, 5]])
    residual = np.array([0.01, -0.05, np.nan])
    figure = drawn(draw_reference_residuals, CHART, places, residual)
    (dots,) = figure.axes[0].collections
    np.testing.assert_allclose(np.ma.filled(dots.get_array(), np.nan), 100 * residual)
    assert dots.get_clim() == pytest.approx((-4.96, 4.96)), "99 of a hundred"
