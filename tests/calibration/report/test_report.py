"""What the report shows and says of a hand in one white frame."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.causes.gathering import PrintPlace
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.report.plots import draw_places, draw_reference_residuals, half_size, reference_residuals
from calibration.report.report import write_report
from calibration.verdict import BuildResult
from drivers.raw.rawfile import read_raw
from experiment.session.folder import Session
from foundation.plots import png_of
from tests.calibration.causes.rooms import HAND, nth_white, taken
from tests.calibration.lab import Lab

pytestmark = pytest.mark.slow


def test_the_report_names_and_circles_a_hand(lab: Lab, tmp_path: Path) -> None:
    out = tmp_path / "lut"
    limits = [limit for limit in FIGURES if limit.name == "unlike_block"]
    with (
        taken(lab, tmp_path / "session", nth_white(1), situation=HAND) as session,
        pytest.raises(Exception, match=r"in frames/0004_white\.dng, about .* probably a hand.* --retake bad"),
    ):
        build(session, out, report=write_report, judged_by=limits)
    page = (tmp_path / "lut.refused" / "report.html").read_text()
    assert "<b>hand or object in one frame</b>" in page
    assert "<h2>Where it is: 0004_white</h2><div class='scroll'><img" in page
    assert "<h2>What the field leaves</h2><div class='scroll'><img" in page
    assert re.search(r"<details id='radiometry' open>.*worst: frames/0004_white\.dng, \d+, \d+ mm", page, re.DOTALL)
    assert page.index("To be taken again") < page.index("<h2>Probable causes</h2>") < page.index("<details")
    (found,) = json.loads((tmp_path / "lut.refused" / "report.json").read_text())["causes"]
    assert found["cause"] == "hand or object in one frame"
    assert found["files"] == ["frames/0004_white.dng"] == [place["file"] for place in found["places"]]
    assert found["command"] == "acquire run LAB.toml SESSION --retake bad"
    assert found["evidence"]["showing"] == pytest.approx(1 / 8)


def test_every_picture_of_a_report_is_drawn(session: Session, built: BuildResult, tmp_path: Path) -> None:
    write_report(built, session, tmp_path)
    page = (tmp_path / "report.html").read_text()
    pictures = re.findall(r"data:image/png;base64,([^'\"]+)", page)
    assert len(pictures) == 12
    for picture in pictures:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(picture), dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        assert pixels.shape[1] > 300
        assert pixels.std() > 5, "something is on it"


def test_pictures_are_drawn_of_many_places_and_of_residuals(lab: Lab, tmp_path: Path) -> None:
    with taken(lab, tmp_path / "session", lambda step: False) as session:
        figures = build(session, tmp_path / "lut").figures
        first = figures.registered_frame
        picture = half_size(read_raw(session.folder / first.record.file))
    whites = np.array([reference.centre_mm for reference in lab.chart.white_references])
    residual = reference_residuals(picture, whites, figures.registration, first)
    # Those of the pixels that the frame's own figure is made from.
    assert np.sqrt(np.nanmean(residual**2)) == pytest.approx(float(first.paper.spread.max()), rel=0.4)
    beyond = reference_residuals(picture, np.array([[-500.0, 0.0]]), figures.registration, first)
    assert np.isnan(beyond).all()
    places = [("one thing", PrintPlace("a", 20.0 * k, 40.0, 0.0)) for k in range(1, 5)]
    places += [("another", PrintPlace("a", 100.0, 70.0, 30.0)), ("a third", PrintPlace("a", 100.0, 70.0, 30.0))]
    drawn = png_of(draw_places, picture, lab.chart, figures.registration, places)
    bare = png_of(draw_places, picture, lab.chart, figures.registration, places[:1])
    assert drawn[:8] == bare[:8] == b"\x89PNG\r\n\x1a\n"
    assert drawn != bare
    assert png_of(draw_reference_residuals, lab.chart, whites, residual)[:4] == b"\x89PNG"
