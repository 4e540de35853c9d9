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
    Margins,
    Side,
    edge_boxes,
    margin_marks,
    number_every_mm,
    ruler_ticks,
    star_boxes,
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


# Multiples of 4, so that things often lie just as far apart as they must.
@settings(max_examples=100)
@given(
    st.sampled_from(("bottom", "top", "left", "right")),
    st.lists(st.tuples(*[st.integers(0, 650).map(lambda n: 4 * n)] * 2, *[st.integers(1, 75)] * 2), max_size=30),
    st.integers(-3, 350).map(lambda n: 4 * n),
)
def test_the_place_found_is_the_first_of_those_where_there_is_room(
    side: Side, there: list[tuple[int, int, int, int]], start: int
) -> None:
    boxes = [(x, y, x + 4 * width, y + 4 * height) for x, y, width, height in there]
    taken = np.array(boxes, dtype=np.int64).reshape(-1, 4)
    mark = np.array([[0, 40, 200, 90], [0, 40, 20, 160], [300, 60, 310, 70]])
    found = Margins(FIELD, (3000, 2600), taken)
    expected = Margins(FIELD, (3000, 2600), taken)
    places = range(max(0, start), found.length(side) - 310 + 1, 24)
    assert found.put_somewhere(side, mark, start) == any(
        expected.put(side, mark + np.array([u, 0, u, 0])) for u in places
    )
    assert found.boxes.tolist() == expected.boxes.tolist()


def test_a_long_ruler_has_a_number_at_every_hundred_millimetres() -> None:
    # 300 mm are 7086.6 px.
    assert [number_every_mm(length) for length in (100, 7086, 7087, 30000)] == [10, 10, 100, 100]
    # A tick that does not find room whole is left out: that of 10 mm begins at 236.
    assert [len(ruler_ticks(length)) for length in (3, 4, 239, 240)] == [0, 1, 10, 11]


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
