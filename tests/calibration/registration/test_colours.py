"""Detection of mismatched patches and of displaced areas, and the colour model."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.colours import agreement, displaced_areas, fit_colours, mismatched
from experiment.chart.layout import A_SERIES_MM, design_chart

PAPER = np.array([8000.0, 9000.0, 7000.0])
ROWS, COLUMNS = 32, 48

_Array = npt.NDArray[np.float64]


def test_detects_cover_and_patches_amid_it() -> None:
    chart = design_chart(3, A_SERIES_MM["A5"], 1)
    random = np.random.default_rng(3)
    expected = random.uniform(0.05, 1, (chart.colour_count, 3)) * PAPER
    measured = expected * random.normal(1, 0.005, expected.shape)
    middle = chart.centres_mm.mean(axis=0)
    covered = np.linalg.norm(chart.centres_mm - middle, axis=1) < 4 * max(chart.cell_mm)
    # a cover of mid grey, the colour of some patches
    measured[covered] = 0.5 * PAPER
    amid = np.flatnonzero(covered)[:3]
    expected[amid] = 0.5 * PAPER
    detected = mismatched(measured, expected, PAPER, chart)
    assert detected[covered].mean() > 0.9
    is_far = np.linalg.norm(chart.centres_mm - middle, axis=1) > 8 * max(chart.cell_mm)
    assert not detected[is_far].any()


def test_agreement_ignores_dark_channels() -> None:
    random = np.random.default_rng(4)
    expected = random.uniform(0.1, 1, (300, 3)) * [8000, 6000, 20]
    measured = expected + random.normal(0, 30, expected.shape)
    assert agreement(measured, expected) > 0.99


def smooth_colours() -> _Array:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    waves = [0.5 + 0.4 * np.sin(0.5 * x + phase) * np.cos(0.4 * y + 2 * phase) for phase in range(3)]
    return np.stack(waves, axis=-1) * PAPER


@pytest.mark.parametrize("slipped", [False, True])
def test_detects_displaced_area(slipped: bool) -> None:
    colours = smooth_colours()
    measured = colours + np.random.default_rng(5).normal(0, 8, colours.shape)
    if slipped:
        measured[16:, :16] = np.roll(colours, -1, axis=1)[16:, :16]
    row, column = (centres.ravel() for centres in np.mgrid[:ROWS, :COLUMNS])
    centres, area_count = displaced_areas(
        measured.reshape(-1, 3),
        colours.reshape(-1, 3),
        PAPER,
        np.zeros(ROWS * COLUMNS, dtype=np.bool_),
        (row, column),
        (ROWS, COLUMNS),
    )
    assert centres.tolist() == ([[8.0, 24.0]] if slipped else [])
    # Areas at the rim have no neighbour to compare with.
    assert 1 <= area_count <= 6


@pytest.mark.parametrize("axis", [0, 1])
def test_accepts_area_displaced_by_third_of_patch(axis: int) -> None:
    colours = smooth_colours()
    measured = colours.copy()
    measured[16:, 16:32] = ((2 * colours + np.roll(colours, -1, axis=axis)) / 3)[16:, 16:32]
    row, column = (centres.ravel() for centres in np.mgrid[:ROWS, :COLUMNS])

    colours, ignored = colours.reshape(-1, 3), np.zeros(ROWS * COLUMNS, np.bool_)
    centres, _ = displaced_areas(measured.reshape(-1, 3), colours, PAPER, ignored, (row, column), (ROWS, COLUMNS))
    assert not centres.size


@pytest.mark.slow
@pytest.mark.parametrize(
    ("patches", "is_fine", "degree"),
    [(59, False, 1), (60, False, 2), (199, False, 2), (200, False, 3), (1999, True, 3), (2000, True, 6),
     (3999, True, 6), (4000, True, 8), (4000, False, 3)],
)  # fmt: skip
def test_fits_polynomial_and_illumination(patches: int, is_fine: bool, degree: int) -> None:
    random = np.random.default_rng(6)
    page = (300.0, 200.0)
    rgb, points = random.uniform(0, 255, (patches, 3)), random.uniform(0, 1, (patches, 2)) * page
    r, g, b = (rgb / 255).T
    flat = np.stack([900 + 4000 * r + 300 * g, 500 + 300 * r + 5000 * g + 200 * b, 300 + 100 * g + 3000 * b], axis=1)
    x, y = (2 * points / page - 1).T
    light = 1 + 0.1 * x - 0.05 * y + 0.03 * x * y - 0.04 * x**2
    clean = flat * light[:, None] * (1, 1.2, 0.8)
    measured = clean.copy()
    measured[::25] *= 0.3
    model = fit_colours(rgb, points, measured, page, is_fine)
    assert model.degree == degree
    np.testing.assert_allclose(model.predict(rgb, points), clean, rtol=0.02)
    # The mean illumination at the patches is 1.
    np.testing.assert_allclose(model.light_at(points).mean(axis=0), 1, rtol=1e-9)
    np.testing.assert_allclose(model.predict_flat(rgb) * model.light_at(points), model.predict(rgb, points))
