"""What small places look like that are covered, and that are not."""

from __future__ import annotations

import numpy as np
import pytest

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
