"""Orientation of the chart in an image."""

from __future__ import annotations

import numpy as np
import pytest

from experiment.measures.pose import keystone, off_level_deg


@pytest.mark.parametrize(
    ("rotation_deg", "off", "quarters"),
    [
        (0.0, 0.0, 0),
        (-5.0, -5.0, 0),
        (44.0, 44.0, 0),
        (91.0, 1.0, 1),
        (268.0, -2.0, -1),
        (180.0, 0.0, 2),
        (-179.0, 1.0, 2),
    ],
)
def test_separates_quarter_turns(rotation_deg: float, off: float, quarters: int) -> None:
    assert off_level_deg(rotation_deg) == (pytest.approx(off), quarters)


def test_keystone_is_the_ratio_of_opposite_sides() -> None:
    # The right side is 10 % longer than the left one, the top as long as the bottom.
    corners = np.array([[0.0, 0.0], [200.0, -5.0], [200.0, 105.0], [0.0, 100.0]])
    across, down = keystone(corners)
    assert across == pytest.approx(0.1)
    assert down == pytest.approx(0)
    assert keystone(np.roll(corners, 1, axis=0)) == (pytest.approx(0), pytest.approx(0.1))
