"""The margins' marks: where they say, clear of the field, and readable."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.margins import (
    GAP_PX,
    Margins,
    Side,
    bar_boxes,
    edge_boxes,
    margin_marks,
    number_every_mm,
    ruler_ticks,
    star_boxes,
    target_boxes,
    text_boxes,
    whole_px,
)
from experiment.chart.model import Chart
from experiment.chart.printing import drawing, field_drawing

pytestmark = pytest.mark.slow

PX_MM = 25.4 / 600
design = cache(design_chart)
charts = st.builds(design, bits=st.integers(1, 3), page=st.none(), seed=st.integers(0, 2**32)) | st.builds(
    design,
    bits=st.sampled_from([1, 2]),
    page=st.tuples(st.floats(60, 400), st.floats(60, 400)),
    seed=st.just(1),
)


def marks_px(chart: Chart) -> npt.NDArray[np.int64]:
    """(N, 4) marks of a sheet, which are whole pixels at 600 dpi."""
    sheet = drawing(chart)
    marks = len(sheet.rgb) - len(field_drawing(chart).rgb)
    exact = sheet.rectangles_mm[:marks] / PX_MM
    assert (sheet.rgb[:marks] == 0).all()
    assert np.abs(exact - np.rint(exact)).max(initial=0) < 1e-6
    return np.rint(exact).astype(np.int64)


def clear_of_the_field(chart: Chart) -> npt.NDArray[np.int64]:
    """Check that no mark leaves the sheet or comes nearer to the field than 1.5 mm; return the marks."""
    marks = marks_px(chart)
    parts = field_drawing(chart).rectangles_mm / PX_MM
    low, high = parts[:, :2].min(axis=0), parts[:, 2:].max(axis=0)
    assert (marks[:, :2] >= 0).all()
    assert (marks[:, 2:] * PX_MM <= np.array(chart.page_mm)).all()
    assert not ((marks[:, 2:] > low - 34.9) & (marks[:, :2] < high + 34.9)).all(axis=1).any()
    return marks


@settings(max_examples=12)
@given(charts)
def test_marks_never_touch_the_field_or_leave_the_sheet(chart: Chart) -> None:
    assert len(clear_of_the_field(chart)) > 500


@pytest.mark.parametrize("page", ["A0", "A1"])
def test_marks_keep_clear_of_the_whites_in_the_margin_of_the_paper_s_grid(page: str) -> None:
    chart = paper_chart(page)
    marks = marks_px(chart)
    assert len(marks) > 4000
    away = np.array(chart.cell_mm) / 2 / PX_MM + 34.9
    low, high = (extreme / PX_MM for extreme in (chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)))
    assert not ((marks[:, 2:] > low - away) & (marks[:, :2] < high + away)).all(axis=1).any()
    for reference in chart.references:
        low = (np.array(reference.centre_mm) - np.array(reference.size_mm) / 2) / PX_MM
        high = low + np.array(reference.size_mm) / PX_MM
        assert not ((marks[:, 2:] > low) & (marks[:, :2] < high)).all(axis=1).any()


@pytest.mark.parametrize("chart", [design_chart(2), design_chart(3, "A3")], ids=["A7", "A3"])
def test_the_rulers_ticks_are_true(chart: Chart) -> None:
    marks = marks_px(chart)
    field = field_drawing(chart).rectangles_mm / PX_MM
    (left, top), (right, bottom) = np.rint(field[:, :2].min(axis=0)), np.rint(field[:, 2:].max(axis=0))
    below = marks[(marks[:, 1] == bottom + 35) & (marks[:, 2] - marks[:, 0] == 4)]
    beside = marks[(marks[:, 2] == left - 35) & (marks[:, 3] - marks[:, 1] == 4)]
    for ticks, start, end, axis in ((below, left, right, 0), (beside, top, bottom, 1)):
        places = np.sort(ticks[:, axis]) - start
        assert len(places) >= int((end - start) * PX_MM)
        millimetres = np.arange(len(places))
        # No error adds up: each tick is the whole pixel nearest to its millimetre; 127 mm are 3000 pixels exactly.
        assert np.abs(places * PX_MM - millimetres).max() <= 25.4 / 600 / 2 + 1e-9
        if len(places) > 127:
            assert places[127] == 3000
    lengths = {
        int(place - left): int(length) for place, length in zip(below[:, 0], below[:, 3] - below[:, 1], strict=True)
    }
    assert lengths[0] > lengths[round(10 / PX_MM)] > lengths[round(5 / PX_MM)] > lengths[round(1 / PX_MM)]


def test_every_hundred_millimetres_of_the_paper_s_chart_are_numbered(a0: Chart) -> None:
    marks = marks_px(a0)
    field = field_drawing(a0).rectangles_mm / PX_MM
    (left, _), (_, bottom) = np.rint(field[:, :2].min(axis=0)), np.rint(field[:, 2:].max(axis=0))
    numbers = marks[(marks[:, 1] >= bottom + 100) & (marks[:, 3] <= bottom + 140)]
    for mm in range(0, 1200, 100):
        expected = text_boxes(str(mm))
        here = numbers[np.abs((numbers[:, 0] + numbers[:, 2]) / 2 - left - mm / PX_MM) < 80]
        # Below the middle of its tick, which is 4 px wide.
        first = left + round(mm / PX_MM) + 2 - expected[:, 2].max() // 2
        assert here[:, 0].min() == first + expected[:, 0].min()
        assert sorted((here - here[:, :2].min(axis=0)[[0, 1, 0, 1]]).tolist()) == sorted(
            (expected - expected[:, :2].min(axis=0)[[0, 1, 0, 1]]).tolist()
        )


def test_bars_are_as_wide_as_their_gaps() -> None:
    bars = bar_boxes().reshape(-1, 3, 4)
    for group in bars:
        width = group[0, 2] - group[0, 0]
        assert group[:, 2].tolist() == (group[:, 0] + width).tolist()
        assert np.diff(group[:, 0]).tolist() == [2 * width, 2 * width]
    # As far from the next group as a bar is wide, and 12 px at least.
    apart = bars[1:, 0, 0] - bars[:-1, -1, 2]
    assert apart.tolist() == [max(int(group[0, 2] - group[0, 0]), 12) for group in bars[:-1]]
    assert [int(group[0, 2] - group[0, 0]) for group in bars] == [30, 20, 15, 12, 10, 8, 6, 5, 4, 3, 2, 1]
    # 3.2 mm long: several pixels of a half-size image of A0.
    assert {*(bars[..., 3] - bars[..., 1]).ravel().tolist()} == {75}
    # 12 px are 0.98 line pairs a millimetre, 6 px twice as many: what the proof page names.
    assert abs(600 / 25.4 / 24 - 0.98) < 0.01


def test_the_edge_falls_by_one_in_twelve_and_the_star_has_twelve_spokes() -> None:
    edge = edge_boxes()
    for u in (0, 6, 150, 287):
        covering = edge[(edge[:, 0] <= u) & (u < edge[:, 2])]
        assert covering[:, 3].max() == 60 + u // 12
    picture = np.zeros((120, 120), dtype=np.int64)
    for left, top, right, bottom in star_boxes().tolist():
        picture[top:bottom, left:right] += 1
    assert picture.max() == 1
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    ring = picture[np.rint(59.5 + 45 * np.sin(angle)).astype(int), np.rint(59.5 + 45 * np.cos(angle)).astype(int)]
    assert np.count_nonzero(np.diff(ring, append=ring[:1]) == 1) == 12
    assert picture.mean() == pytest.approx(np.pi / 8, abs=0.02)


@pytest.mark.parametrize(("apart", "free"), [(19, False), (20, True)])
def test_marks_have_air_between_them(apart: int, free: bool) -> None:
    """Of .85 mm, 20 px, also where what is there lies beside the box about all that is to be put."""
    mark = np.array([[0, 40, 10, 60]])
    there = np.array([[110 + apart, 1940, 150, 1960]])
    margins = Margins(np.array([100, 100, 1900, 1900]), (2000, 2000), there)
    assert margins.put("bottom", mark) is free


NOTHING = np.empty((0, 4), dtype=np.int64)
FIELD = np.array([500, 600, 2500, 2000])
"""A field on a sheet of 3000 × 2600 px, with as much margin on all sides as anything needs."""


def picture_of(boxes: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return what boxes print on that sheet, (2600, 3000) bool."""
    seen = np.zeros((2600, 3000), bool)
    for left, top, right, bottom in boxes.tolist():
        assert left < right
        assert top < bottom
        seen[top:bottom, left:right] = True
    return seen


@pytest.mark.parametrize(
    ("side", "expected"),
    [
        ("bottom", [[510, 2040, 530, 2090], [510, 2040, 570, 2050]]),
        ("top", [[510, 510, 530, 560], [510, 550, 570, 560]]),
        ("left", [[410, 610, 460, 630], [450, 610, 460, 670]]),
        ("right", [[2540, 610, 2590, 630], [2540, 610, 2550, 670]]),
    ],
)
def test_a_margin_runs_along_the_field_and_outwards(side: Side, expected: list[list[int]]) -> None:
    margins = Margins(FIELD, (3000, 2600), NOTHING)
    # An L whose long stroke leads away from the field, the short one along it.
    assert margins.put(side, np.array([[10, 40, 30, 90], [10, 40, 70, 50]]))
    assert margins.boxes.tolist() == expected
    assert margins.length(side) == (2000 if side in ("top", "bottom") else 1400)
    # As near to the field as 35 px, and no nearer.
    near = [Margins(FIELD, (3000, 2600), NOTHING).put(side, np.array([[0, v, 10, 90]])) for v in (34, 35)]
    assert near == [False, True]


def test_rulers_are_read_from_below_and_from_the_right() -> None:
    margins = Margins(FIELD, (3000, 2600), NOTHING)
    assert margins.ruler("bottom")
    assert margins.ruler("left")
    seen = picture_of(margins.boxes)
    number = np.zeros((60, 60), bool)
    for left, top, right, bottom in text_boxes("20").tolist():
        number[top:bottom, left:right] = True
    high, wide = (int(end) for end in text_boxes("20")[:, [3, 2]].max(axis=0))
    number = number[:high, :wide]
    # 20 mm are 472 px; the middle of the number is that of the tick, which is 4 px wide.
    first = 472 + 2 - wide // 2
    np.testing.assert_array_equal(seen[2100 : 2100 + high, 500 + first : 500 + first + wide], number)
    down = 600 + first
    # Turned so that it is read upwards, its foot towards the field.
    np.testing.assert_array_equal(seen[down : down + wide, 400 - high : 400], np.rot90(number))
    ticks = {mm: int(seen[2035:2100, 500 + round(mm / PX_MM) + 1].sum()) for mm in (0, 1, 5, 10, 15, 20)}
    assert ticks == {0: 60, 1: 24, 5: 36, 10: 47, 15: 36, 20: 47}


def test_a_long_ruler_has_a_number_at_every_hundred_millimetres() -> None:
    # 300 mm are 7086.6 px.
    assert [number_every_mm(length) for length in (100, 7086, 7087, 30000)] == [10, 10, 100, 100]
    # A tick that does not find room whole is left out: that of 10 mm begins at 236.
    assert [len(ruler_ticks(length)) for length in (3, 4, 239, 240)] == [0, 1, 10, 11]


def test_the_sheet_is_cut_along_its_edges() -> None:
    margins = Margins(FIELD, (3000, 2600), NOTHING)
    margins.crop_marks()
    seen = picture_of(margins.boxes)
    corner = np.zeros((1300, 1500), bool)
    corner[:5, :120] = corner[:120, :5] = True
    np.testing.assert_array_equal(seen[:1300, :1500], corner)
    for turned in (seen[::-1], seen[:, ::-1]):
        np.testing.assert_array_equal(turned, seen)


def test_targets_stand_at_both_ends_and_in_the_middle() -> None:
    targets, field = target_boxes(), np.array([500, 600, 7500, 6600])
    long = int(targets[:, 2].max())
    marks = margin_marks(field, (8000, 7200), NOTHING, ())
    right = marks[(marks[:, 0] >= 7535) & (marks[:, 1] >= 600) & (marks[:, 3] <= 6600)]
    pieces = np.split(right, len(right) // len(targets))
    assert len(pieces) == 3
    starts = [int(piece[:, 1].min()) - 600 for piece in pieces]
    # The last where the first free place is from the end less the targets and 35 px of air on.
    assert starts == [0, (6000 - long - 35) // 2, 6000 - long - 35]
    for piece, start in zip(pieces, starts, strict=True):
        turned = np.stack(
            [7500 + targets[:, 1], 600 + start + targets[:, 0], 7500 + targets[:, 3], 600 + start + targets[:, 2]], 1
        )
        np.testing.assert_array_equal(piece, turned)
    above = marks[(marks[:, 3] <= 565) & (marks[:, 0] >= 500) & (marks[:, 2] <= 7500)]
    assert len(above) == 3 * len(targets)
    assert (int(above[:, 0].min()), int(above[:, 2].max())) == (500, 7500 - 35)


def test_what_finds_no_room_is_left_out_and_the_rest_stays() -> None:
    field = np.array([100, 30, 2000, 1900])
    nothing = np.empty((0, 4), dtype=np.int64)
    # Room only on the left and below, and only just.
    narrow = margin_marks(field, (2060, 2040), nothing, ("a line",))
    assert len(narrow) > 50
    assert (narrow[:, 1] >= 1900 + 35).all(), "the left margin is too narrow for numbers, those above and right for all"
    assert len(margin_marks(np.array([0, 0, 2000, 2000]), (2000, 2000), nothing, ("a line",))) == 0


def test_boxes_in_millimetres_become_the_pixels_that_hold_them() -> None:
    assert whole_px([[1 / 600 * 25.4, 2.4 / 600 * 25.4, 3 / 600 * 25.4, 3.2 / 600 * 25.4]]).tolist() == [[1, 2, 3, 4]]


def test_a_chart_of_another_maker_without_margins_is_drawn(a7: Chart) -> None:
    high = a7.tags[-1].corners_mm[2] + 50 * PX_MM
    tight = replace(a7, page_mm=(float(high[0]) + 0.5, float(high[1]) + 0.5))
    clear_of_the_field(tight)


def test_targets_begin_at_the_corner_that_they_are_put_to() -> None:
    for boxes in (star_boxes(), edge_boxes(), bar_boxes()):
        assert boxes[:, :2].min(axis=0).tolist() == [0, 0]
    (left, top, _, _), (right, _) = (target_boxes().min(axis=0), target_boxes().max(axis=0)[2:])
    assert (left, top) == (0, GAP_PX)
    assert right / 600 * 25.4 == pytest.approx(52, abs=1)
