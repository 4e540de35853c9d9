"""Cells that have not the chart's colours, and parts of a field that have their neighbours'."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.colours import ColourModel, agreement, mismatched, slipped_parts
from experiment.chart.layout import A_SERIES_MM, design_chart

PAPER = np.array([8000.0, 9000.0, 7000.0])
ROWS, COLUMNS = 32, 48

_Array = npt.NDArray[np.float64]


def test_a_cover_is_found_with_the_cells_amid_it() -> None:
    chart = design_chart(3, A_SERIES_MM["A5"], 1)
    random = np.random.default_rng(3)
    expected = random.uniform(0.05, 1, (chart.colour_count, 3)) * PAPER
    seen = expected * random.normal(1, 0.005, expected.shape)
    middle = chart.centres_mm.mean(axis=0)
    covered = np.linalg.norm(chart.centres_mm - middle, axis=1) < 4 * max(chart.cell_mm)
    # A cover of mid grey, which some cells' colours are.
    seen[covered] = 0.5 * PAPER
    amid = np.flatnonzero(covered)[:3]
    expected[amid] = 0.5 * PAPER
    found = mismatched(seen, expected, PAPER, chart)
    assert found[covered].mean() > 0.9
    far = np.linalg.norm(chart.centres_mm - middle, axis=1) > 8 * max(chart.cell_mm)
    assert not found[far].any()


def test_few_colours_are_no_judges_of_one() -> None:
    chart = design_chart(1, A_SERIES_MM["A7"], 1)
    seen = np.full((chart.colour_count, 3), 100.0)
    assert not mismatched(seen, 10 * seen, PAPER, chart).any()


def test_agreement_leaves_dark_channels_out() -> None:
    random = np.random.default_rng(4)
    expected = random.uniform(0.1, 1, (300, 3)) * [8000, 6000, 20]
    seen = expected + random.normal(0, 30, expected.shape)
    assert agreement(seen, expected) > 0.99


def smooth_colours() -> _Array:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    waves = [0.5 + 0.4 * np.sin(0.5 * x + phase) * np.cos(0.4 * y + 2 * phase) for phase in range(3)]
    return np.stack(waves, axis=-1) * PAPER


@pytest.mark.parametrize("slipped", [False, True])
def test_a_part_with_the_colours_of_its_neighbours_is_found(slipped: bool) -> None:
    colours = smooth_colours()
    seen = colours + np.random.default_rng(5).normal(0, 8, colours.shape)
    if slipped:
        seen[16:, :16] = np.roll(colours, -1, axis=1)[16:, :16]
    row, column = (places.ravel() for places in np.mgrid[:ROWS, :COLUMNS])
    places, parts = slipped_parts(
        seen.reshape(-1, 3),
        colours.reshape(-1, 3),
        PAPER,
        np.zeros(ROWS * COLUMNS, dtype=np.bool_),
        (row, column),
        (ROWS, COLUMNS),
    )
    assert places.tolist() == ([[8.0, 24.0]] if slipped else [])
    # Parts at the rim lack a neighbour to compare with.
    assert 1 <= parts <= 6


def test_light_on_the_page_is_a_polynomial_of_second_order() -> None:
    light = np.arange(18.0).reshape(6, 3)
    points = np.array([[25.0, 150.0], [80.0, 60.0]])
    # A page of 100 x 200 mm: -1 at its left and upper edge, 1 at the others.
    x, y = np.array([-0.5, 0.6]), np.array([0.5, -0.4])
    expected = light[0] + np.outer(x, light[1]) + np.outer(y, light[2])
    expected += np.outer(x**2, light[3]) + np.outer(x * y, light[4]) + np.outer(y**2, light[5])
    model = ColourModel(1, np.zeros((4, 3)), light, (100.0, 200.0))
    np.testing.assert_allclose(model.light_at(points), expected)
