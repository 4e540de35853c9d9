"""Cells that have not the chart's colours, and parts of a field that have their neighbours'."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.colours import agreement, fit_colours, mismatched, slipped_parts
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


@pytest.mark.parametrize("axis", [0, 1])
def test_a_part_that_is_off_by_a_third_of_a_cell_has_not_slipped(axis: int) -> None:
    colours = smooth_colours()
    seen = colours.copy()
    seen[16:, 16:32] = ((2 * colours + np.roll(colours, -1, axis=axis)) / 3)[16:, 16:32]
    row, column = (places.ravel() for places in np.mgrid[:ROWS, :COLUMNS])
    cells = ROWS * COLUMNS
    places, _ = slipped_parts(
        seen.reshape(-1, 3), colours.reshape(-1, 3), PAPER, np.zeros(cells, np.bool_), (row, column), (ROWS, COLUMNS)
    )
    assert not places.size


@pytest.mark.slow
@pytest.mark.parametrize(
    ("patches", "finely", "degree"),
    [(59, False, 1), (60, False, 2), (199, False, 2), (200, False, 3), (1999, True, 3), (2000, True, 6),
     (3999, True, 6), (4000, True, 8), (4000, False, 3)],
)  # fmt: skip
def test_colours_are_a_polynomial_that_patches_suffice_for_times_a_light(
    patches: int, finely: bool, degree: int
) -> None:
    random = np.random.default_rng(6)
    page = (300.0, 200.0)
    rgb, points = random.uniform(0, 255, (patches, 3)), random.uniform(0, 1, (patches, 2)) * page
    r, g, b = (rgb / 255).T
    flat = np.stack([900 + 4000 * r + 300 * g, 500 + 300 * r + 5000 * g + 200 * b, 300 + 100 * g + 3000 * b], axis=1)
    x, y = (2 * points / page - 1).T
    light = 1 + 0.1 * x - 0.05 * y + 0.03 * x * y - 0.04 * x**2
    seen = flat * light[:, None] * (1, 1.2, 0.8)
    spoilt = seen.copy()
    spoilt[::25] *= 0.3
    model = fit_colours(rgb, points, spoilt, page, finely)
    assert model.degree == degree
    np.testing.assert_allclose(model.seen(rgb, points), seen, rtol=0.02)
    # The light's mean is 1 where patches are; what is left is colour.
    np.testing.assert_allclose(model.light_at(points).mean(axis=0), 1, rtol=1e-9)
    np.testing.assert_allclose(model.flat(rgb) * model.light_at(points), model.seen(rgb, points))
