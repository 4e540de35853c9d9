"""Where a check looks: the map of a chart in a frame against the simulated room, and what it reads there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.check import places
from acquisition.check.places import levels, place_chart, window_px
from experiment.chart.layout import paper_chart
from experiment.chart.model import Chart
from experiment.framing.finding import find_chart
from sim.world.world import Room
from tests.calibration.lab import Lab, Paint, hang, hang_chart

WAVING = Room(waviness_mm=5.0, seed=5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hung", "rms_px", "worst_px"),
    [
        (lambda: hang(room=WAVING), 0.085, 0.25),
        (lambda: hang(2, "A6", room=Room(waviness_mm=1.0, roll_deg=180.0)), 0.11, 0.27),
        (lambda: hang_chart(paper_chart("A6", 3), "Test", Room(waviness_mm=0.5)), 1.0, 1.3),
    ],
    ids=["waves", "upside down", "without tags"],
)
def test_cells_lie_where_the_room_shows_them(
    hung: Callable[[], Lab], rms_px: float, worst_px: float, tmp_path: Path
) -> None:
    lab = hung()
    mosaic = lab.mosaic(tmp_path)
    place = place_chart(find_chart(mosaic, lab.chart, corners=lab.corners_px(mosaic)), lab.chart)
    points = lab.chart.centres_mm
    off = np.asarray(place.to_pixels(points) - lab.truth_px(points, mosaic), dtype=np.float64)
    error: npt.NDArray[np.float64] = np.sqrt((off**2).sum(axis=1))
    assert np.sqrt(np.mean(error**2)) < rms_px
    assert error.max() < worst_px
    if lab.chart.tags:
        assert place.matched > 0.9
        # By the tags alone, a print that waves is further off.
        assert np.abs(place.shifts).max() > 0.2
    along = [
        lab.truth_px(points + 0.5 * unit, mosaic) - lab.truth_px(points - 0.5 * unit, mosaic) for unit in np.eye(2)
    ]
    true = np.stack([np.linalg.norm(each, axis=1) for each in along], axis=1)
    # Waves stretch the print by a per cent here and there.
    np.testing.assert_allclose(place.scale(points), true, rtol=0.03)
    assert abs(float((place.scale(points) / true).mean()) - 1) < 0.003


def test_a_peak_is_that_of_the_parabola_and_stays_at_the_rim() -> None:
    rows, columns = np.mgrid[:5, :6].astype(np.float64)
    peak = places._peak
    np.testing.assert_allclose(peak(-((columns - 2.3) ** 2) - 2 * (rows - 1.6) ** 2, 2, 2), [2.3, 1.6])
    np.testing.assert_array_equal(peak(-columns - rows, 0, 0), [0, 0])
    np.testing.assert_array_equal(peak(columns + rows, 5, 4), [5, 4])
    # Nowhere higher than beside: no part of a pixel is made up.
    np.testing.assert_array_equal(peak(np.zeros((5, 6)), 2, 2), [2, 2])


def test_a_shift_that_its_neighbours_do_not_share_is_theirs() -> None:
    settled = places._settled
    found = np.tile([0.5, -1.0], (4, 5, 1))
    good = np.ones((4, 5), dtype=np.bool_)
    found[1, 2] = [0.5 + 1.1 * places.SHIFT_SPREAD_PX, -1.0]
    found[3, 4] = [0.5, -1.0 - 0.9 * places.SHIFT_SPREAD_PX]
    found[2, 0], good[2, 0] = [7.0, 7.0], False
    result = settled(found, good)
    expected = np.tile([0.5, -1.0], (4, 5, 1))
    expected[3, 4] = found[3, 4]
    np.testing.assert_allclose(result, expected)
    np.testing.assert_array_equal(settled(found, np.zeros_like(good)), 0)


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "page", "window"), [(3, "A5", 5), (2, "A7", 9)])
def test_the_window_is_half_of_the_smallest_patch(bits: int, page: str, window: int, tmp_path: Path) -> None:
    lab = hang(bits, page)
    assert window_px(lab.chart, placed(lab, tmp_path)) == window


@pytest.mark.slow
def test_levels_are_means_about_the_points_and_tell_what_clips(tmp_path: Path) -> None:
    lab = hang()
    place = placed(lab, tmp_path)
    whites = np.array([reference.centre_mm for reference in lab.chart.white_references])
    beyond = np.array([[-40.0, -40.0]])
    visible = lab.world.body.visible
    victim = np.rint(lab.world.project(whites[3:4])[0]).astype(int)

    def shown(reach: int) -> Paint:
        def paint(counts: np.ndarray[tuple[int, int], np.dtype[np.uint16]]) -> None:
            counts[visible.top : visible.top + visible.height, visible.left : visible.left + visible.width] = 3048
            counts[visible.top + 2 * victim[1], visible.left + 2 * (victim[0] + reach)] = 13584

        return paint

    for reach, clips in ((0, True), (2, True), (5, False)):
        mosaic = lab.mosaic(tmp_path, key=10 + reach, paint=shown(reach))
        found = levels(mosaic, place, np.concatenate([whites, beyond]), 5, 13584)
        assert found.clipped[3] == clips
        assert found.clipped.sum() <= clips
        assert np.isnan(found.mean[-1]).all()
        # One photosite of red is high: a fifth of a twenty-fifth of the window, and nothing of the other channels.
        np.testing.assert_allclose(found.mean[:-1, 1:], 1000, rtol=0.02)
        assert (found.mean[3, 0] > 1300) == clips


@pytest.mark.slow
def test_a_window_that_is_cut_by_the_frame_is_not_read(tmp_path: Path) -> None:
    """By a map of which a millimetre is a pixel."""
    lab = hang()
    mosaic = lab.mosaic(tmp_path)
    height, width = mosaic.block_planes().shape[-2:]
    plain = places.ChartMap((1e4, 1e4), np.eye(3), np.zeros((1, 2)), np.zeros((1, 1, 2)), 1.0)
    inner = np.array([[2.0, 2.0], [width - 3.0, 2.0], [2.0, height - 3.0], [width - 3.0, height - 3.0]])
    outer = inner + np.array([[-0.01, 0], [0.01, 0], [0, 0.01], [0, 0.01]])
    read = np.isfinite(levels(mosaic, plain, np.concatenate([inner, outer]), 5, 13584).mean).all(axis=1)
    np.testing.assert_array_equal(read, [True] * 4 + [False] * 4)


def placed(lab: Lab, folder: Path) -> places.ChartMap:
    chart: Chart = lab.chart
    return place_chart(find_chart(lab.mosaic(folder), chart), chart)
