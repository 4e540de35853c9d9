"""What small places look like that are covered, and that are not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.causes import gathering
from calibration.causes.gathering import covered_deviation


@pytest.mark.parametrize(
    ("off", "expected"),
    [
        ([-0.05, -0.06, -0.04], -0.06),  # a thin shadow
        ([-0.7, 1.4, -0.2, 0.6], -0.7),  # a finger: dark colours become as bright as it
        ([0.04, 0.06, 0.05, 0.05], 0.05),  # a glint
        ([0.3, 0.2], np.nan),  # two dark cells under a finger, or a glint
        ([-0.049, 0.042, -0.03, 0.035, 0.02, -0.02], np.nan),  # neighbours' light
        ([-0.04, 0.0, 0.0], -0.04),  # two that are too dark to be compared
        ([], np.nan),
    ],
)
def test_covered_cells_are_darker_all_or_far_off(off: list[float], expected: float) -> None:
    assert covered_deviation(np.array(off)) == pytest.approx(expected, nan_ok=True)


def test_cells_about_a_place_that_hold_a_hot_photosite() -> None:
    places = np.array([[0.0, 0], [1, 0], [2, 0], [9, 9]])
    cells = SimpleNamespace(stains=SimpleNamespace(places_mm=places))

    def share(hottest: list[float], size_mm: float) -> float:
        table: Any = SimpleNamespace(dark_frames=SimpleNamespace(hottest=np.array(hottest)), cells=cells)
        return gathering._hot_share(table, places[0], size_mm)  # pyright: ignore[reportPrivateUsage]

    assert share([5, 0, 0, 7], 3.0) == 0.5
    assert share([5, 0, 0, 7], 5.0) == pytest.approx(1 / 3)
    # Nothing is known without dark frames of these cells, or where no cell lies.
    assert np.isnan(share([], 3.0))
    assert np.isnan(share([5, 0, 0, 7], 0.0))
