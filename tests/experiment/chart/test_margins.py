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
    edge_boxes,
    star_boxes,
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


def test_a_chart_of_another_maker_without_margins_is_drawn(a7: Chart) -> None:
    high = a7.tags[-1].corners_mm[2] + 50 * PX_MM
    tight = replace(a7, page_mm=(float(high[0]) + 0.5, float(high[1]) + 0.5))
    clear_of_the_field(tight)
