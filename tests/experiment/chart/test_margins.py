"""Marks in the margins: positions, distance to the patches, and shape."""

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
    """(N, 4) marks of a sheet, checked to be whole pixels at 600 dpi."""
    sheet = drawing(chart)
    marks = len(sheet.rgb) - len(field_drawing(chart).rgb)
    exact = sheet.rectangles_mm[:marks] / PX_MM
    assert (sheet.rgb[:marks] == 0).all()
    assert np.abs(exact - np.rint(exact)).max(initial=0) < 1e-6
    return np.rint(exact).astype(np.int64)


def require_clear_marks(chart: Chart) -> npt.NDArray[np.int64]:
    """Check that all marks are on the sheet and at least 1.5 mm from the patches; return the marks."""
    marks = marks_px(chart)
    parts = field_drawing(chart).rectangles_mm / PX_MM
    low, high = parts[:, :2].min(axis=0), parts[:, 2:].max(axis=0)
    assert (marks[:, :2] >= 0).all()
    assert (marks[:, 2:] * PX_MM <= np.array(chart.page_mm)).all()
    assert not ((marks[:, 2:] > low - 34.9) & (marks[:, :2] < high + 34.9)).all(axis=1).any()
    return marks


@settings(max_examples=12)
@given(charts)
def test_marks_keep_clear_of_patches_and_stay_on_the_sheet(chart: Chart) -> None:
    assert len(require_clear_marks(chart)) > 500


@pytest.mark.parametrize("page", ["A0", "A1"])
def test_marks_keep_clear_of_references_in_the_margin(page: str) -> None:
    chart = paper_chart(page)
    marks = marks_px(chart)
    assert len(marks) > 4000
    distance = np.array(chart.cell_mm) / 2 / PX_MM + 34.9
    low, high = (extreme / PX_MM for extreme in (chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)))
    assert not ((marks[:, 2:] > low - distance) & (marks[:, :2] < high + distance)).all(axis=1).any()
    for reference in chart.references:
        low = (np.array(reference.centre_mm) - np.array(reference.size_mm) / 2) / PX_MM
        high = low + np.array(reference.size_mm) / PX_MM
        assert not ((marks[:, 2:] > low) & (marks[:, :2] < high)).all(axis=1).any()


@pytest.mark.parametrize("chart", [design_chart(2), design_chart(3, "A3")], ids=["A7", "A3"])
def test_ticks_of_the_rulers_are_accurate(chart: Chart) -> None:
    marks = marks_px(chart)
    field = field_drawing(chart).rectangles_mm / PX_MM
    (left, top), (right, bottom) = np.rint(field[:, :2].min(axis=0)), np.rint(field[:, 2:].max(axis=0))
    bottom_ticks = marks[(marks[:, 1] == bottom + 35) & (marks[:, 2] - marks[:, 0] == 4)]
    left_ticks = marks[(marks[:, 2] == left - 35) & (marks[:, 3] - marks[:, 1] == 4)]
    for ticks, start, end, axis in ((bottom_ticks, left, right, 0), (left_ticks, top, bottom, 1)):
        positions = np.sort(ticks[:, axis]) - start
        assert len(positions) >= int((end - start) * PX_MM)
        millimetres = np.arange(len(positions))
        # Errors do not accumulate: each tick is the whole pixel closest to its millimetre; 127 mm are 3000 pixels
        # exactly.
        assert np.abs(positions * PX_MM - millimetres).max() <= 25.4 / 600 / 2 + 1e-9
        if len(positions) > 127:
            assert positions[127] == 3000
    lengths = {
        int(position - left): int(length)
        for position, length in zip(bottom_ticks[:, 0], bottom_ticks[:, 3] - bottom_ticks[:, 1], strict=True)
    }
    assert lengths[0] > lengths[round(10 / PX_MM)] > lengths[round(5 / PX_MM)] > lengths[round(1 / PX_MM)]


def test_slope_of_the_edge_and_spokes_of_the_star() -> None:
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


def test_draws_a_chart_without_margins(a7: Chart) -> None:
    high = a7.tags[-1].corners_mm[2] + 50 * PX_MM
    tight = replace(a7, page_mm=(float(high[0]) + 0.5, float(high[1]) + 0.5))
    require_clear_marks(tight)
