"""The report of a session with a hand in one white frame."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from calibration.causes.gathering import PrintPosition
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.report.plots import draw_positions
from calibration.report.report import write_report
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from foundation.plots import draw_panels
from tests.calibration.causes.rooms import HAND, nth_white, taken
from tests.calibration.lab import Lab
from tests.calibration.whole import LIMITS
from tests.pinned import Pinned
from tests.pinned.drawn import drawn

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("lens_unmeasured")
def test_report_names_and_circles_hand(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    circled: list[tuple[str, PrintPosition]] = []

    def blank(draw: Callable[..., None], *arguments: Any, inches: object) -> tuple[bytes, ...]:
        # The last picture with places is that of the frame.
        circled[:] = arguments[-1] if draw is draw_positions else circled
        return (b"<svg></svg>",)

    monkeypatch.setattr("calibration.report.report.draw_panels", blank)
    out = tmp_path / "lut"
    limits = [limit for limit in FIGURES if limit.name == "block_deviation"]
    with (
        taken(lab, tmp_path / "session", nth_white(1), situation=HAND) as session,
        pytest.raises(Exception, match=r"frames/0004_white\.dng.*a hand.*--retake bad"),
    ):
        build(session, out, report=write_report, judged_by=limits)
    page = (tmp_path / "lut.refused" / "report.html").read_text()
    assert "<b>hand or object in one frame</b>" in page
    assert "<h2>Position: 0004_white</h2><div class='panels'><div class='scroll'><svg" in page
    assert re.search(r"registered first\. 1: [^;<]+: hand or object in one frame", page)
    assert re.search(r"<details id='radiometry' open>.*in frames/0004_white\.dng, about \d+, \d+ mm", page, re.DOTALL)
    assert page.index("Take 1 frame again: ") < page.index("<h2>Probable causes</h2>") < page.index("<details")
    (result,) = json.loads((tmp_path / "lut.refused" / "report.json").read_text())["causes"]
    assert result["cause"] == "hand or object in one frame"
    assert result["files"] == ["frames/0004_white.dng"] == [place["file"] for place in result["places"]]
    assert result["command"] == "acquire run LAB.toml SESSION --retake bad"
    assert result["evidence"]["showing"] == pytest.approx(1 / 8)
    ((label, place),) = circled
    assert label.endswith(": hand or object in one frame")
    left, top, right, bottom = HAND.blobs[0].place
    assert left < place.x_mm / lab.chart.page_mm[0] < right
    assert top < place.y_mm / lab.chart.page_mm[1] < bottom


def test_draws_all_report_pictures(
    session: Session, built: BuildResult, tmp_path: Path, pinned: Pinned, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, list[Any]] = {}

    svgs: list[bytes] = []

    def kept(draw: Callable[..., None], *arguments: Any, inches: Sequence[tuple[float, float]]) -> tuple[bytes, ...]:
        def drawing(panels: Sequence[Any], *given: Any) -> None:
            draw(panels, *given)
            shown.setdefault(draw.__name__, []).extend(drawn(axes.figure) for axes in panels)

        drawings = draw_panels(drawing, *arguments, inches=inches)
        svgs.extend(drawings)
        return drawings

    monkeypatch.setattr("calibration.report.report.draw_panels", kept)
    write_report(built, session, tmp_path)
    # That of noise hangs on which cells are left out.
    del shown["draw_noise"]
    pinned("table of 13 lights, pictures", shown, **LIMITS)
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg role='img'") == len(svgs) == 6 + 2 + 2 + 2 + 2 + 3 + 6 + 2
    identifiers = re.findall(r'\bid="([0-9a-f]{8}-\w+)"', page)
    assert len(identifiers) == len(set(identifiers)), "a reference leads into its own drawing"
    assert all(b"var(--" in svg for svg in svgs), "in the colours of the page"


def test_group_counts_figures_beyond_limits(built: BuildResult) -> None:
    assert built.lut is not None
    page = (built.lut / "report.html").read_text()
    summaries = re.findall(r"(\d+) figures?, (all within|\d+ beyond) their limits", page)
    beyond = sum(one.outcome != "accept" for one in built.verdict.rows)
    assert summaries
    assert all(how == "all within" or int(how.removesuffix(" beyond")) for _, how in summaries)
    assert sum(int(how.removesuffix(" beyond")) for _, how in summaries if how != "all within") == beyond
    assert sum(int(count) for count, _ in summaries) == len(built.verdict.rows)
