"""How well places are known: what an outline tells of places beside it and inside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.matching import unfollowed_px

WIDTH, HEIGHT, REACH = 200.0, 100.0, 20.0


def outline(step: float = 1.0) -> npt.NDArray[np.float64]:
    x, y = np.arange(0, WIDTH + step, step), np.arange(0, HEIGHT + step, step)
    sides = [(x, 0 * x), (x, 0 * x + HEIGHT), (0 * y, y), (0 * y + WIDTH, y)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def test_inside_it_is_what_the_outline_shows_and_more_beside_a_part_that_waves() -> None:
    marks = outline()
    residual = np.full_like(marks, 0.01 / np.sqrt(2))
    waves = (marks[:, 1] == 0) & (np.abs(marks[:, 0] - 100) < 20)
    residual[waves] = 0.3 / np.sqrt(2)
    inside, beside, elsewhere = unfollowed_px(np.array([(100, 50), (100, 5), (30, 95.0)]), marks, residual, 5.0, REACH)
    usual = np.sqrt((residual**2).sum(axis=1).mean())
    assert inside == elsewhere == pytest.approx(2 * usual)
    assert beside == pytest.approx(0.6)


def test_at_a_corner_that_was_not_found_it_is_how_far_the_sheet_is_off_a_plane() -> None:
    marks = outline()
    lost = (marks[:, 1] == 0) & (marks[:, 0] < 60)
    marks = marks[~lost]
    places = np.array([(5, 5), (30, 5), (55, 5), (30, 95), (150, 5), (100, 50.0)])
    found = unfollowed_px(places, marks, np.full_like(marks, 0.01), 0.8, REACH)
    assert found == pytest.approx([0.8, 0.8, 0.02 * np.sqrt(2), 0.02 * np.sqrt(2), *[0.02 * np.sqrt(2)] * 2])
