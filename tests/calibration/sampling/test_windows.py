"""The light of neighbouring cells in a window, and the windows that cells allow."""

from __future__ import annotations

import pytest

from calibration.sampling import WINDOWS, bleed, largest_window

pytestmark = pytest.mark.slow


def test_the_bleed_is_that_of_the_table_of_arrangements() -> None:
    """Rendered pixel by pixel: 8.6 px cells and 0.7 px blur give 1.3 %, 0.5 px blur 0.1 %; 10.2 px cells 0.07 %."""
    assert bleed(8.6, 0.7) == pytest.approx(0.013, rel=0.1)
    assert bleed(8.6, 0.5) == pytest.approx(0.001, rel=0.1)
    assert bleed(10.2, 0.7) < 0.0008


def test_the_largest_windows_are_those_of_the_table_of_arrangements() -> None:
    """Found by rendering: 5×5 on the EOS 550D and 7×7 on the 6D Mark II below 0.2 % at a blur of 0.7 px."""
    assert largest_window(10.2, 0.7) == 5
    assert largest_window(12.4, 0.7) == 7
    assert largest_window(4.0, 0.7) == 0
    assert [bleed(10.2, 0.7, window) for window in WINDOWS] == sorted(bleed(10.2, 0.7, window) for window in WINDOWS)
