"""Pixels of a cell in the paper's cameras, against the facts of a full-size chart, and the warning."""

from __future__ import annotations

import pytest

from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart
from experiment.framing.pictures import apparent_sizes, small_parts_warning

pytestmark = pytest.mark.slow


def test_the_paper_s_chart_in_both_cameras(a0: Chart) -> None:
    # 1.94 and 2.34 px a millimetre on A0, hence 10.2 and 12.4 px a cell, and 4.1 px a module.
    small, large = apparent_sizes(a0)
    assert small.camera == "EOS 550D"
    assert small.cell_px == pytest.approx(1732 * 0.94 / 841 * 125 * 25.4 / 600, rel=1e-6)
    assert small.cell_px == pytest.approx(10.2, abs=0.06)
    assert large.cell_px == pytest.approx(12.4, abs=0.06)
    assert small.module_px == pytest.approx(4.1, abs=0.02)
    assert small_parts_warning(a0) is None


def test_smaller_sheets_are_as_visible_and_long_ones_are_not() -> None:
    assert small_parts_warning(design_chart(5, "A2")) is None
    long = design_chart(5, (1200.0, 300.0))
    text = small_parts_warning(long)
    assert text is not None
    assert "EOS 550D" in text
    assert "EOS 6D Mark II" in text
    assert "8 px a cell and 3 px a tag module" in text
    assert f"{apparent_sizes(long)[0].cell_px:.1f} px a cell" in text
    assert "\n" not in text


def test_a_portrait_is_photographed_upright() -> None:
    wide, high = (design_chart(2, page) for page in ((210.0, 148.0), (148.0, 210.0)))
    assert [one.cell_px for one in apparent_sizes(wide)] == pytest.approx([one.cell_px for one in apparent_sizes(high)])


def test_the_paper_s_grid_has_no_modules() -> None:
    small, large = apparent_sizes(paper_chart())
    assert small.module_px is large.module_px is None
    # The narrower side decides: 4.57 mm at 1.94 px a millimetre.
    assert small.cell_px == pytest.approx(8.85, abs=0.03)
    assert small_parts_warning(paper_chart()) is None
