"""Output of `acquire status` for active, paused, killed and complete sessions."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.status import MEANINGS
from experiment.session.heartbeat import RunState
from experiment.session.journal import Journal
from tests.acquisition.monitor.made_up import MadeUpRun

# A process that gives a sign of life and ends without a note; the next sign would be due in an hour.
ENDED = """
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from experiment.session.journal import Journal
journal = Journal.open_for_run(Path(sys.argv[1]) / "journal.sqlite")
journal.beat("running", "taking frames", datetime.now(UTC) + timedelta(hours=1))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a session of eight frames of 5 s, of which four are there and one was refused once, once for good."""
    run = MadeUpRun.begin(tmp_path / "night")
    try:
        for number, step in enumerate(run.steps[:5]):
            if number == 2:
                run.take(step, "the light is 8.2 % off", value=8.2)
            if number == 4:
                run.take(step, "the chart has moved by 3.1 px, 0.5 px allowed", check="movement", value=3.1)
            else:
                run.take(step)
    finally:
        run.journal.close()
    return tmp_path / "night"


def say(folder: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> str:
    assert main(["status", str(folder)]) == code
    return capsys.readouterr().out


def test_reports_active_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = say(folder, capsys)
    assert "state       running: taking 8 frames\n" in output
    assert "frames      4 of 8\nilluminants 2 of 4\n" in output
    # Six attempts of 5 s gave four frames, so that the remaining four frames need six more attempts.
    assert "left        30 s" in output
    assert "refused     2, failed 0, voided 0\n" in output
    assert "  movement 3.1 px, at most 0.5 px (distance of the chart from its rest position)\n" in output
    assert "frames/0004_light" in output.split("without an accepted frame:")[1].split("last events:")[0]
    assert "refused: the light is 8.2 % off" in output.split("last verdicts:")[1]
    assert "8.2 %" not in output.split("without an accepted frame:")[1], "that light was taken again"


def test_hanging_run_is_failure(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        journal.beat("running", "frames are taken", datetime.now(UTC) - timedelta(minutes=5))
    assert main(["status", str(folder)]) == 3
    captured = capsys.readouterr()
    assert "state       silent: no sign of life since" in captured.out
    assert "last report: frames are taken" in captured.err


@pytest.mark.slow
def test_killed_run_has_no_remaining_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    subprocess.run([sys.executable, "-c", ENDED, str(folder)], check=True)
    output = say(folder, capsys, code=3)
    assert "state       stopped at 20" in output
    assert "killed or power lost: run the same command again\n" in output
    assert "left        4 frames; no run is active\n" in output
    assert main(["status", "--json", str(folder)]) == 3
    values = json.loads(capsys.readouterr().out)
    assert (values["state"], values["alive"], values["remaining_s"]) == ("stopped", False, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "sentence", "code"),
    [
        ("paused", "the camera: no camera on USB", 3),
        ("paused", "the frames: light 3: another light is seen", 4),
        ("paused", "the disk: No space left on device", 5),
        ("ended", "the camera: no camera on USB; the run waited 10 min 00 s", 3),
        ("ended", "4 of 8 frames left; light 3: the chart has moved", 4),
        ("ended", "interrupted; run the same command again", 4),
        ("ended", "the disk: No space left on device", 5),
    ],
)
def test_paused_or_incomplete_run_is_failure(
    folder: Path, state: RunState, sentence: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        journal.beat(state, sentence, datetime.now(UTC) + timedelta(minutes=5))
        output = say(folder, capsys, code)
    assert (f"state       paused: {sentence}" if state == "paused" else "state       incomplete") in output


def test_keeps_doubts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        for what in ("doubt", "doubt", *["moved"] * 10):
            journal.note(datetime.now(UTC), what, f"a {what} of the night")
    assert "warnings:\n  a doubt of the night\nlast" in say(folder, capsys)


def test_copy_is_no_active_run(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "backup" / "night"
    shutil.copytree(folder, copy)
    output = say(copy, capsys)
    assert f"state       copied from {folder.resolve()} at 20" in output
    assert "or later, and the run continues there; use" in output
    assert "left        4 frames; no run is active in this copy\n" in output
    assert main(["status", "--json", str(copy)]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["state"], values["alive"], values["remaining_s"]) == ("copy", False, None)
    assert "state       running" in say(folder.rename(tmp_path / "renamed"), capsys)


def test_is_read_only(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    say(folder, capsys)
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before


def test_refuses_folder_without_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", str(tmp_path)]) == 2
    assert "journal.sqlite" in capsys.readouterr().err


def test_every_check_has_a_meaning() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "judge.md").read_text("utf-8")
    table = page.partition("| check | question | limit |")[2].partition("\n\n")[0]
    named = {name for row in table.splitlines()[2:] for name in re.findall(r"`([a-z_]+)`", row.split("|")[1])}
    assert named - {"other_camera", "settings"} == set(MEANINGS)
