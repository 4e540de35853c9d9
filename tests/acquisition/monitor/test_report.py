"""The report that stays: one file, whole, bounded, without anything from elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acquisition.cli import main
from acquisition.monitor import view
from acquisition.monitor.view import write_session_report
from experiment.session.journal import Journal
from foundation.errors import StorageError
from tests.acquisition.monitor.made_up import MadeUpRun

SCRIPT = "</script><script>alert(1)</script><!--"


@pytest.fixture
def run(tmp_path: Path) -> Iterator[MadeUpRun]:
    made = MadeUpRun.begin(tmp_path / "night <b>1")
    for step in made.steps[:5]:
        if step.number == 3:
            made.take(step, f"{SCRIPT}; close the door")
        made.take(step)
    yield made
    made.journal.close()


def data_of(path: Path) -> dict[str, Any]:
    """Return what the page of a report holds, found as a browser finds it: up to the first end of a script element."""
    found = re.search(r'<script type="application/json" id="embedded">(.*?)</script', path.read_text(), re.S)
    assert found is not None
    return json.loads(found[1])


def test_it_holds_the_session_and_its_pictures(run: MadeUpRun, tmp_path: Path) -> None:
    path = tmp_path / "out" / "night.html"
    write_session_report(run.folder, path)
    data = data_of(path)
    assert [frame["verdict"] for frame in data["frames"]].count("accepted") == 5
    assert data["frames"][3]["reason"] == f"{SCRIPT}; close the door"
    assert sorted(data["pictures"], key=int) == ["1", "2", "3", "4", "5", "6"]
    text = path.read_text()
    assert SCRIPT not in text
    assert "night &lt;b&gt;1" in text
    for elsewhere in ('src="http', 'href="http', "@import", "url(http"):
        assert elsewhere not in text


def test_a_run_that_writes_it_counts_as_ended_and_others_do_not(run: MadeUpRun) -> None:
    path = write_session_report(run.folder)
    assert path == run.folder / "report.html"
    head = data_of(path)["head"]
    assert head["state"] == "incomplete"
    assert head["sentence"] == "ended with 3 of 8 frames left; run the same command again"
    for step in run.steps[5:]:
        run.take(step)
    assert data_of(write_session_report(run.folder))["head"]["state"] == "complete"
    (run.folder / "chart.json").unlink()
    head = data_of(write_session_report(run.folder))["head"]
    assert head["state"] == "incomplete"
    assert "chart.json" in head["sentence"]


def test_the_command_writes_it_into_the_session_or_where_it_is_told(
    run: MadeUpRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(run.folder)]) == 0
    assert (run.folder / "report.html").is_file()
    assert main(["report", str(run.folder), str(tmp_path / "x.html")]) == 0
    assert f"{tmp_path / 'x.html'}: written" in capsys.readouterr().out


def test_a_full_disk_is_said_and_leaves_the_session_as_it_was(run: MadeUpRun, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: object) -> None:
        raise StorageError(f"cannot write {path}: no space")

    monkeypatch.setattr(view, "write_whole", full)
    assert main(["report", str(run.folder)]) == StorageError.exit_code
    assert not (run.folder / "report.html").exists()


def test_a_journal_without_any_attempt_makes_a_report_too(tmp_path: Path) -> None:
    made = MadeUpRun.begin(tmp_path / "empty")
    made.journal.close()
    write_session_report(made.folder, tmp_path / "x.html")
    assert data_of(tmp_path / "x.html")["head"]["done"] == 0
    Journal.open(made.folder / "journal.sqlite").close()
