"""A table carries its verdict; a refused one leaves its report, and nothing else."""

from __future__ import annotations

import html
import json
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import pytest

from calibration.cli import main
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build, check, refused_folder
from calibration.report.report import write_report
from calibration.verdict import BuildResult, judged_values
from experiment.session.folder import Session
from foundation.errors import QualityError
from tests.calibration.lab import LIGHTS, Lab, hang, take
from tests.json_of import json_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn", "lens_unmeasured")]

STRICT = (replace(next(limit for limit in FIGURES if limit.name == "cell_px"), refuse=60_000.0),)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Generator[Session]:
    """Lend a session of few colours: of these the lens is not measured, which takes longer than the rest."""
    with take(hang(2, "A6"), tmp_path_factory.mktemp("short") / "session", LIGHTS[:2]) as session:
        yield session


def test_a_table_carries_its_verdict(built: BuildResult) -> None:
    assert built.lut is not None
    report = json.loads((built.lut / "report.json").read_text())
    assert report["format"] == "crop.report"
    assert report["verdict"] == built.verdict.outcome != "refuse"
    assert report["figures"].keys() == judged_values(built.figures).keys()
    assert {limit["name"] for limit in report["limits"]} == report["figures"].keys()
    # No drift was to be taken out, no dark light subtracted, and what so small a chart does not show of the lens is in
    # the uncertainty.
    unknown = {"too_dark", "drift_left", "correction_residual", "correction_worst"}
    assert report["figures"].keys() == {limit.name for limit in FIGURES} - unknown
    page = (built.lut / "report.html").read_text()
    assert "class='verdict " in page
    for limit in report["limits"]:
        assert limit["title"] in html.unescape(page)


def test_a_refused_table_leaves_its_report_alone(short: Session, tmp_path: Path) -> None:
    with pytest.raises(QualityError, match=STRICT[0].title):
        build(short, tmp_path / "lut", report=write_report, judged_by=STRICT)
    assert list(tmp_path.iterdir()) == [tmp_path / "lut.refused"] == [refused_folder(tmp_path / "lut")]
    assert "The table can be used" not in (tmp_path / "lut.refused" / "report.html").read_text()
    kept = sorted(path.name for path in (tmp_path / "lut.refused").iterdir())
    assert kept == ["report.html", "report.json"]
    assert json.loads((tmp_path / "lut.refused" / "report.json").read_text())["verdict"] == "refuse"


def test_a_check_is_judged_by_the_same_limits(short: Session) -> None:
    assert check(short).verdict.outcome != "refuse"
    assert [row.figure for row in check(short, judged_by=STRICT).verdict.refused] == list(STRICT)


def test_the_command_ends_with_the_exit_code_of_a_refusal(
    lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A window of nine pixels does not fit into the cells of a larger chart."""
    take(lab, tmp_path / "session", LIGHTS[:1]).close()
    found = json_of(main, ["--window", "9", tmp_path / "session", tmp_path / "lut"], capsys, code=4)
    assert (found["command"], found["verdict"]) == ("build-lut", "refuse")
    assert found["figures"]
    assert found["channels"]["window"] == 9
    assert not (tmp_path / "lut").exists()
