"""What `acquire status` says: of a run at work, one that paused, one that was killed, one that is complete."""

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

ENDED = """
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from experiment.session.journal import Journal
journal = Journal.open_for_run(Path(sys.argv[1]) / "journal.sqlite")
journal.beat("running", "taking frames", datetime.now(UTC) + timedelta(hours=1))
"""
"""A run that gives a sign of life and is gone without a word; the next sign would be due in an hour."""


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


def test_a_run_at_work(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = say(folder, capsys)
    assert "state   running: taking 8 frames\n" in told
    assert "frames  4 of 8\nlights  2 of 4\n" in told
    # Six attempts, 5 s each, gave four frames, so that the four that are left take six more.
    assert "left    30 s" in told
    assert "refused 2, failed 0, voided 0\n" in told
    assert "  movement 3.1 px, at most 0.5 px (of the chart, from where it lies at rest)\n" in told
    assert "frames/0004_light" in told.split("without an accepted frame:")[1].split("last events:")[0]
    assert "refused: the light is 8.2 % off" in told.split("last verdicts:")[1]
    assert "8.2 %" not in told.split("without an accepted frame:")[1], "that light was taken again"


def test_a_run_that_hangs_is_no_success(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        journal.beat("running", "frames are taken", datetime.now(UTC) - timedelta(minutes=5))
    assert main(["status", str(folder)]) == 3
    said = capsys.readouterr()
    assert "state   silent: no sign since" in said.out
    assert "then: frames are taken" in said.err


@pytest.mark.slow
def test_a_killed_run_has_no_time_left(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    subprocess.run([sys.executable, "-c", ENDED, str(folder)], check=True)
    told = say(folder, capsys, code=3)
    assert "state   stopped at 20" in told
    assert "killed or power lost: run the same command again\n" in told
    assert "left    4 frames; no run is at work\n" in told
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
def test_a_run_that_pauses_or_ended_with_frames_left_is_no_success(
    folder: Path, state: RunState, sentence: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        journal.beat(state, sentence, datetime.now(UTC) + timedelta(minutes=5))
        told = say(folder, capsys, code)
    assert (f"state   paused: {sentence}" if state == "paused" else "state   incomplete") in told


def test_what_is_to_be_seen_in_the_morning_stays(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
        for what in ("doubt", "doubt", *["moved"] * 10):
            journal.note(datetime.now(UTC), what, f"a {what} of the night")
    assert "doubts:\n  a doubt of the night\nlast" in say(folder, capsys)


def test_a_copy_of_a_session_at_work_is_no_run(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "backup" / "night"
    shutil.copytree(folder, copy)
    told = say(copy, capsys)
    assert f"state   copied from {folder.resolve()} at 20" in told
    assert "or later, and the run there continues; use" in told
    assert "left    4 frames; this copy gets none\n" in told
    assert main(["status", "--json", str(copy)]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["state"], values["alive"], values["remaining_s"]) == ("copy", False, None)
    assert "state   running" in say(folder.rename(tmp_path / "renamed"), capsys)


def test_status_changes_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    say(folder, capsys)
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before


def test_what_is_no_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", str(tmp_path)]) == 2
    assert "journal.sqlite" in capsys.readouterr().err


def test_every_number_of_the_judge_says_what_it_is() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "judge.md").read_text("utf-8")
    table = page.partition("| check | question | limit |")[2].partition("\n\n")[0]
    named = {name for row in table.splitlines()[2:] for name in re.findall(r"`([a-z_]+)`", row.split("|")[1])}
    assert named - {"other_camera", "settings"} == set(MEANINGS)
