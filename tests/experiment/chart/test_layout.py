"""Layout of the chart: no overlap, every colour once, positions of tags and references."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiment.chart.layout import (
    GREY_CODES,
    LEAST_WHITES,
    design_chart,
    paper_chart,
)
from experiment.chart.model import Chart
from foundation.errors import InputError

pytestmark = pytest.mark.slow

PX_MM = 25.4 / 600
MARGIN_MM = 8.0

# Charts of 4 and 5 bits are large, so one seed is enough.
charts = st.builds(
    cache(design_chart),
    bits=st.sampled_from([1, 2, 3]),
    page=st.just(None),
    seed=st.integers(0, 2**32),
) | st.builds(cache(design_chart), bits=st.sampled_from([4, 5]), page=st.just(None), seed=st.just(1))


def slots_px(chart: Chart) -> npt.NDArray[np.int64]:
    """(N, 4) left, top, right, bottom of patches, references and tags with rims, pixels at 600 dpi."""
    boxes = [np.concatenate([chart.centres_mm - 125 / 2 * PX_MM, chart.centres_mm + 125 / 2 * PX_MM], axis=1)]
    for reference in chart.references:
        centre, half = np.array(reference.centre_mm), np.array(reference.size_mm) / 2
        boxes.append(np.concatenate([centre - half, centre + half])[None])
    rim = 50 * PX_MM
    boxes += [np.concatenate([tag.corners_mm[0] - rim, tag.corners_mm[2] + rim])[None] for tag in chart.tags]
    exact = np.concatenate(boxes) / PX_MM
    assert np.abs(exact - np.rint(exact)).max() < 1e-6, "every edge is a whole pixel at 600 dpi"
    return np.rint(exact).astype(np.int64)


@settings(max_examples=25)
@given(charts)
def test_slots_cover_the_area_once(chart: Chart) -> None:
    boxes = slots_px(chart)
    (x0, y0), (x1, y1) = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    covered = np.zeros((int(y1 - y0) // 125, int(x1 - x0) // 125), dtype=np.int64)
    for left, top, right, bottom in (boxes - [x0, y0, x0, y0]).tolist():
        assert left % 125 == top % 125 == right % 125 == bottom % 125 == 0
        covered[top // 125 : bottom // 125, left // 125 : right // 125] += 1
    assert (covered == 1).all()
    page = np.array(chart.page_mm)
    assert (np.array([x0, y0]) * PX_MM >= MARGIN_MM).all()
    assert (np.array([x1, y1]) * PX_MM <= page - MARGIN_MM).all()
    centre = np.array([x0 + x1, y0 + y1]) / 2 * PX_MM
    assert np.abs(centre - page / 2).max() <= PX_MM, "the field is centred to a pixel"


@settings(max_examples=25)
@given(charts)
def test_every_colour_once_and_every_grey_in_every_quarter(chart: Chart) -> None:
    """Except for greys with fewer than four references."""
    assert sorted(chart.colours.tolist()) == list(range(8**chart.bits))
    levels = Counter(reference.rgb for reference in chart.references)
    assert set(levels) == {(code, code, code) for code in (*GREY_CODES, 255)}
    assert abs(levels[(255, 255, 255)] - len(chart.references) / 2) < 5
    middle = np.array(chart.page_mm) / 2
    quarters = Counter(
        (reference.rgb, reference.centre_mm[0] > middle[0], reference.centre_mm[1] > middle[1])
        for reference in chart.references
    )
    assert levels[(255, 255, 255)] >= LEAST_WHITES
    scarce = [level for level in levels if levels[level] < 4]
    assert len(quarters) == 4 * len(levels) - len(scarce)
    assert not scarce or chart.bits == 2


@settings(max_examples=25)
@given(charts)
def test_order_and_distances_of_tags(chart: Chart) -> None:
    corners = np.array([tag.corners_mm for tag in chart.tags])
    assert [tag.id for tag in chart.tags] == list(range(len(chart.tags)))
    assert len(chart.tags) >= 4
    side = 8 * 50 * PX_MM
    np.testing.assert_allclose(
        corners - corners[:, :1],
        np.tile([[[0, 0], [side, 0], [side, side], [0, side]]], (len(corners), 1, 1)),
        atol=1e-9,
    )
    places = corners[:, 0]
    assert (np.lexsort((places[:, 0], places[:, 1])) == np.arange(len(places))).all()
    boxes = slots_px(chart)
    tags = boxes[-len(chart.tags) :]
    assert (tags[:, :2].min(axis=0) == boxes[:, :2].min(axis=0)).all()
    assert (tags[:, 2:].max(axis=0) == boxes[:, 2:].max(axis=0)).all()
    for axis in (0, 1):
        steps = np.diff(np.unique(tags[:, axis]))
        assert steps.min() >= 4 * 125
        assert steps.max() <= 38 * 125


def test_default_chart_on_a0() -> None:
    chart = design_chart()
    boxes = slots_px(chart)
    assert ((boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)) / 125).tolist() == [221, 155]
    assert chart.page_mm == (1189, 841)
    assert (chart.colour_count, len(chart.tags), len(chart.references)) == (32768, 35, 927)
    assert len(np.unique([tag.corners_mm[0, 0] for tag in chart.tags])) == 7
    assert Counter(reference.name for reference in chart.references) == {
        "white": 467,
        **{f"grey {code}": 115 for code in GREY_CODES},
    }


def test_greys_are_stops_and_no_colours_of_the_chart() -> None:
    # IEC 61966-2-1: code 188 is linear 0.5029, and so on by hand.
    for code, linear in zip(GREY_CODES, (0.5, 0.25, 0.125, 0.0625), strict=True):
        assert ((code / 255 + 0.055) / 1.055) ** 2.4 == pytest.approx(linear, rel=0.01)
        assert code % 8 != 0


@pytest.mark.parametrize(
    ("bits", "page", "seed", "message"),
    [
        (0, None, 1, "expected 1 to 5"),
        (5, None, -1, "seed is -1"),
        (
            5,
            "A5",
            1,
            r"210 × 148 mm .*32768 .*1\.06 mm.* A4 .* A0",
        ),
        (4, "A8", 1, r"A7 \(105 × 74 mm\).* A2"),
        (2, (18.0, 500.0), 1, "A8"),
        (2, (0.0, 500.0), 1, "above 0"),
        (2, (float("nan"), 500.0), 1, "above 0"),
        (2, "Letter", 1, "the page is 'Letter', expected one of A0"),
        (5, (6000.0, 6000.0), 1, "family 36h11 has 587"),
    ],
)
def test_refuses_impossible_charts(bits: int, page: str | tuple[float, float] | None, seed: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        design_chart(bits, page, seed)


def test_paper_chart_is_a_plain_grid() -> None:
    chart = paper_chart()
    assert chart.page_mm == (1189, 841)
    assert chart.cell_mm == pytest.approx((4.58, 6.45), abs=0.02)
    assert chart.tags == ()
    assert sorted(chart.colours.tolist()) == list(range(32768))
    corner = (chart.centres_mm - np.array(chart.cell_mm) / 2) / PX_MM
    assert np.abs(corner - np.rint(corner)).max() < 1e-6
    xs, ys = (np.unique(chart.centres_mm[:, axis].round(6)) for axis in (0, 1))
    assert (len(xs), len(ys)) == (256, 128)
    assert np.diff(xs) == pytest.approx(chart.cell_mm[0])
    assert np.diff(ys) == pytest.approx(chart.cell_mm[1])
    assert min(xs[0] - chart.cell_mm[0] / 2, ys[0] - chart.cell_mm[1] / 2) >= MARGIN_MM
    # The documented order: neighbours differ by one step, except for blue between blocks above each other.
    codes = chart.rgb.reshape(128, 256, 3).astype(int)
    across, down = np.abs(np.diff(codes, axis=1)), np.abs(np.diff(codes, axis=0))
    assert (across.sum(axis=2) == 8).all()
    assert (np.delete(down, [31, 63, 95], axis=0).sum(axis=2) == 8).all()
    assert (down[:, :, :2].sum(axis=2)[[31, 63, 95]] == 0).all()
    assert codes[0, 0].tolist() == [0, 0, 0]
    assert codes[0, 31].tolist() == [248, 0, 0]
    assert codes[31, 0].tolist() == [0, 248, 0]
    assert codes[0, 255].tolist() == [0, 0, 56]
