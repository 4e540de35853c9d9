"""What the report shows and says of a hand in one white frame."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from calibration.causes.gathering import PrintPlace
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.report.plots import draw_places
from calibration.report.report import write_report
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from foundation.plots import draw_png
from tests.calibration.causes.rooms import HAND, nth_white, taken
from tests.calibration.lab import Lab
from tests.calibration.whole import LIMITS
from tests.pinned import Pinned
from tests.pinned.drawn import drawn

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("lens_unmeasured")
def test_the_report_names_and_circles_a_hand(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    circled: list[tuple[str, PrintPlace]] = []

    def blank(draw: Callable[..., None], *arguments: Any) -> bytes:
        # The last picture with places is that of the frame.
        circled[:] = arguments[-1] if draw is draw_places else circled
        return b"\x89PNG\r\n\x1a\n"

    monkeypatch.setattr("calibration.report.report.draw_png", blank)
    out = tmp_path / "lut"
    limits = [limit for limit in FIGURES if limit.name == "block_deviation"]
    with (
        taken(lab, tmp_path / "session", nth_white(1), situation=HAND) as session,
        pytest.raises(Exception, match=r"frames/0004_white\.dng.*a hand.*--retake bad"),
    ):
        build(session, out, report=write_report, judged_by=limits)
    page = (tmp_path / "lut.refused" / "report.html").read_text()
    assert "<b>hand or object in one frame</b>" in page
    assert "<h2>Where it is: 0004_white</h2><div class='scroll'><img" in page
    assert re.search(r"<details id='radiometry' open>.*in frames/0004_white\.dng, about \d+, \d+ mm", page, re.DOTALL)
    assert page.index("To be taken again") < page.index("<h2>Probable causes</h2>") < page.index("<details")
    (found,) = json.loads((tmp_path / "lut.refused" / "report.json").read_text())["causes"]
    assert found["cause"] == "hand or object in one frame"
    assert found["files"] == ["frames/0004_white.dng"] == [place["file"] for place in found["places"]]
    assert found["command"] == "acquire run LAB.toml SESSION --retake bad"
    assert found["evidence"]["showing"] == pytest.approx(1 / 8)
    ((label, place),) = circled
    assert label.endswith(": hand or object in one frame")
    left, top, right, bottom = HAND.blobs[0].place
    assert left < place.x_mm / lab.chart.page_mm[0] < right
    assert top < place.y_mm / lab.chart.page_mm[1] < bottom


def test_every_picture_of_a_report_is_drawn(
    session: Session, built: BuildResult, tmp_path: Path, pinned: Pinned, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, list[Any]] = {}

    def kept(draw: Callable[..., None], *arguments: Any) -> bytes:
        def drawing(figure: Figure, *given: Any) -> None:
            draw(figure, *given)
            shown.setdefault(draw.__name__, []).append(drawn(figure))

        return draw_png(drawing, *arguments)

    monkeypatch.setattr("calibration.report.report.draw_png", kept)
    write_report(built, session, tmp_path)
    # That of noise hangs on which cells are left out.
    del shown["draw_noise"]
    pinned("table of 13 lights, pictures", shown, **LIMITS)
    page = (tmp_path / "report.html").read_text()
    pictures = re.findall(r"data:image/png;base64,([^'\"]+)", page)
    assert len(pictures) == 8
    for picture in pictures:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(picture), dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        assert pixels.shape[1] > 300
        assert pixels.std() > 5, "something is on it"


def test_a_group_says_how_many_of_its_figures_are_beyond_their_limits(built: BuildResult) -> None:
    assert built.lut is not None
    page = (built.lut / "report.html").read_text()
    said = re.findall(r"(\d+) figures?, (all within|\d+ beyond) their limits", page)
    beyond = sum(one.outcome != "accept" for one in built.verdict.rows)
    assert said
    assert all(how == "all within" or int(how.removesuffix(" beyond")) for _, how in said)
    assert sum(int(how.removesuffix(" beyond")) for _, how in said if how != "all within") == beyond
    assert sum(int(count) for count, _ in said) == len(built.verdict.rows)
