"""How cells are put into blocks and what is told of their light; which frames' files state otherwise than most."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.checks import frame_consistency
from calibration.checks.frame_consistency import ForeignFrame, OriginFigures, origin_figures
from drivers.raw.rawfile import FrameOrigin


@pytest.mark.parametrize(
    ("across", "down", "columns", "rows"),
    # Of 32 cells each, fewer of fewer than 512 cells, and twenty at least.
    [(32, 24, 6, 4), (64, 64, 11, 11), (24, 16, 5, 3), (16, 10, 4, 2)],
)
def test_blocks_are_squares_of_as_many_cells_as_noise_asks_for(across: int, down: int, columns: int, rows: int) -> None:
    x, y = np.meshgrid(np.arange(across) * 10.0 + 5, np.arange(down) * 10.0 + 7)
    cells = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    block, middles, area = frame_consistency._blocks(cells)
    width, height = (across - 1) * 10 / columns, (down - 1) * 10 / rows
    assert area == pytest.approx(width * height)
    x, y = np.meshgrid(5 + (np.arange(columns) + 0.5) * width, 7 + (np.arange(rows) + 0.5) * height)
    np.testing.assert_allclose(middles, np.column_stack([x.ravel(), y.ravel()]))
    # Each cell lies in the block whose middle is no further than half a block along either axis.
    assert (np.abs(cells - middles[block]) <= np.array([width, height]) / 2 + 1e-6).all()
    members = frame_consistency._members(block, len(middles))
    for number, row in enumerate(members):
        assert row[row >= 0].tolist() == np.flatnonzero(block == number).tolist()
    assert members.shape[1] == np.bincount(block).max()
    values = np.where(np.arange(len(cells)) % 3 == 0, np.nan, np.arange(len(cells), dtype=np.float64))
    means, counts = frame_consistency._known_means(np.append(values, np.nan)[members])
    for number in range(len(middles)):
        own = values[block == number]
        assert (means[number], counts[number]) == pytest.approx((np.nanmean(own), np.isfinite(own).sum()))


def test_light_of_blocks_is_a_line_through_the_cells_that_are_seen() -> None:
    expected = np.linspace(100, 10_000, 200)
    top = np.percentile(expected, 99)
    seen = 0.7 * expected + 0.1 * top
    seen[::9] = 9000
    expected[5] = np.nan
    channel: Any = SimpleNamespace(expected=expected, seen=seen)
    dim: Any = SimpleNamespace(expected=np.full(200, np.nan), seen=seen)
    members = np.arange(200).reshape(10, 20)
    assert frame_consistency._light_of([channel, dim], members) == pytest.approx((0.1, 0.7), abs=2e-3)
    # Fewer than twelve cells tell nothing.
    few = np.array([[*range(6, 17), -1]])
    assert frame_consistency._light_of([channel], few) == (0, 1)
    assert frame_consistency._light_of([channel], np.append(few, [[17] + [-1] * 11], axis=0)) != (0, 1)


def frames(*origins: FrameOrigin) -> list[tuple[Any, FrameOrigin]]:
    return [(number, origin) for number, origin in enumerate(origins)]


def shot(shutter_s: float | None = 0.5, iso: int | None = 100, aperture: float | None = 8.0) -> FrameOrigin:
    return FrameOrigin(iso=iso, aperture=aperture, shutter_s=shutter_s)


@pytest.mark.parametrize(
    ("other", "ratio"),
    [
        (shot(0.504), None),
        (shot(0.506), 1.012),
        (shot(0.496), None),
        (shot(0.4), 0.8),
        (shot(iso=200), 2),
        (shot(aperture=5.6), (8 / 5.6) ** 2),
        # Without an f-number of its own the lens is as in the others.
        (shot(aperture=None), None),
        (shot(0.25, 400, None), 2),
        (shot(None), None),
        (shot(iso=None), None),
    ],
)
def test_frames_are_exposed_otherwise_from_a_hundredth_on(other: FrameOrigin, ratio: float | None) -> None:
    found = origin_figures(frames(shot(), other, shot())).other_exposure
    assert [one.ratio for one in found] == ([] if ratio is None else [pytest.approx(ratio)])
    if found:
        assert (found[0].found, found[0].expected) == (other.exposure_text, shot().exposure_text)


def test_a_difference_of_exposure_is_the_largest_up_or_down() -> None:
    record: Any = None
    found = tuple(ForeignFrame(record, "", "", ratio) for ratio in (1.2, 0.8, 1.1))
    assert OriginFigures(other_exposure=found).exposure_difference == pytest.approx(0.25)
    assert OriginFigures().exposure_difference == 0


def test_bodies_and_lenses_are_held_against_most_and_a_model_without_number_is_no_other() -> None:
    one, two = FrameOrigin("EOS", "1", "50 mm"), FrameOrigin("EOS", "2", "50 mm")
    found = origin_figures(frames(one, two, one, FrameOrigin("EOS M", "1", "35 mm"), FrameOrigin()))
    assert [(frame.record, frame.found, frame.expected) for frame in found.other_camera] == [
        (1, "EOS no. 2", "EOS no. 1"), (3, "EOS M no. 1", "EOS no. 1"),
    ]  # fmt: skip
    assert [(frame.record, frame.found) for frame in found.other_lens] == [(3, "35 mm")]
    unnumbered = origin_figures(frames(one, FrameOrigin("EOS"), two, FrameOrigin("EOS M", "1")))
    assert [(frame.record, frame.found, frame.expected) for frame in unnumbered.other_camera] == [
        (3, "EOS M no. 1", "EOS")
    ]
