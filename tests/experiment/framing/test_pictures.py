"""The picture of a frame with what of the chart was found on it, or looked for."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from drivers.raw.rawfile import read_raw
from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart
from experiment.framing.field import field_mm
from experiment.framing.finding import find_chart
from experiment.framing.pictures import annotated_png
from sim.world.room import Room
from tests.calibration.lab import hang_chart
from tests.data_files import shipped

pytestmark = pytest.mark.slow

PLAIN = paper_chart("A6", 3)


def picture(data: bytes) -> npt.NDArray[np.int64]:
    return np.asarray(cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)).astype(np.int64)


def test_a_field_found_has_its_outline_drawn(tmp_path: Path) -> None:
    lab = hang_chart(PLAIN, "Test", Room(waviness_mm=0.5))
    mosaic = lab.mosaic(tmp_path)
    seen = picture(annotated_png(mosaic, PLAIN, find_chart(mosaic, PLAIN)))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    red = seen[..., 2] - seen[..., 1] > 150
    corners = lab.truth_px(field_mm(PLAIN), mosaic)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        x, y = np.rint((start + end) / 2).astype(int)
        assert red[y - 3 : y + 4, x - 3 : x + 4].any()
    x, y = np.rint(corners.mean(axis=0)).astype(int)
    assert not red[y - 20 : y + 20, x - 20 : x + 20].any()


@pytest.mark.parametrize("chart", [PLAIN, design_chart(3)], ids=["plain", "tagged"])
def test_a_photograph_without_the_chart_says_what_was_looked_for(chart: Chart) -> None:
    mosaic = read_raw(shipped("raw/canon_eos_550d_colorchart.dng"))
    seen = picture(annotated_png(mosaic, chart, None))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    # The lines stand in amber on a black strip below.
    strip = seen[-30:]
    assert (strip.max(axis=2) < 30).mean() > 0.5
    assert (strip[..., 1] - strip[..., 0] > 100).sum() > 100
