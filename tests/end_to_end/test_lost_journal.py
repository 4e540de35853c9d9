"""What is deleted, replaced or cut under a run is noticed, and nothing is lost: the facts stand in a second place."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.monitor.view import LOOK_AGAIN_S, SessionWatch, read_session
from acquisition.run.pipeline import Taken
from acquisition.run.run import RunOutcome, take_session
from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session.folder import Session, rebuild_journal, session_exists
from experiment.session.journal import Journal, LostJournalError, Rows, ledger_path, read_ledger, rows_of, thread_beat
from experiment.session.opening import open_to_read
from experiment.session.records import ACCEPTED
from foundation.clock import SimulatedClock
from foundation.errors import FormatError, StorageError
from tests.acquisition.run.scripted import SETTINGS, Lab

pytestmark = pytest.mark.slow

LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 30 * n, 0)) for n in range(6))


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path / "session", lights=LIGHTS, reference_every=3)


def run(lab: Lab, after: int = 0, happens: Callable[[Path], object] = lambda folder: None) -> RunOutcome:
    """Take the session; `happens` is called once when so many frames were judged."""
    judged = 0

    def observe(taken: Taken) -> None:
        nonlocal judged
        judged += 1
        if judged == after:
            happens(lab.session.folder)

    return take_session(lab.session, lab.devices, SETTINGS, observe=observe)


def deleted(folder: Path) -> None:
    (folder / "journal.sqlite").unlink()


def cut(folder: Path) -> None:
    path = folder / "journal.sqlite"
    os.truncate(path, path.stat().st_size // 2)


def emptied(folder: Path) -> None:
    os.truncate(folder / "journal.sqlite", 0)


def replaced(folder: Path) -> None:
    copy = folder / "copy"
    shutil.copyfile(folder / "journal.sqlite", copy)
    copy.replace(folder / "journal.sqlite")


def overwritten(folder: Path) -> None:
    path = folder / "journal.sqlite"
    with path.open("r+b") as stream:
        stream.write(bytes(path.stat().st_size))


def overwritten_by_another(folder: Path) -> None:
    other = folder.parent / "other.sqlite"
    Journal.create(other, ())
    other.write_bytes(other.read_bytes().ljust((folder / "journal.sqlite").stat().st_size, b"\0"))
    with (folder / "journal.sqlite").open("r+b") as stream:
        stream.write(other.read_bytes())


def log_deleted(folder: Path) -> None:
    (folder / "journal.sqlite-wal").unlink()


def log_cut(folder: Path) -> None:
    os.truncate(folder / "journal.sqlite-wal", 40)


def both_deleted(folder: Path) -> None:
    ledger_path(folder).unlink()
    deleted(folder)


MISHAPS = (both_deleted, deleted, cut, emptied, replaced, overwritten, overwritten_by_another, log_deleted, log_cut)


def facts(folder: Path) -> Rows:
    """Return what the journal says, as every reader sees it."""
    with closing(open_to_read(folder / "journal.sqlite")) as connection:
        return rows_of(connection)


@pytest.mark.parametrize(
    ("happens", "frame"),
    [*zip(MISHAPS, itertools.cycle((2, 7, 12)), strict=False), (deleted, 12), (log_deleted, 12)],
)
def test_a_lost_journal_ends_the_run_and_is_made_anew(lab: Lab, happens: Callable[[Path], object], frame: int) -> None:
    folder = lab.session.folder
    assert len(lab.session.steps) == 12, "after the last frame it happens, too"
    with pytest.raises(LostJournalError, match="acquire rebuild"):
        run(lab, frame, happens)
    assert lab.camera.captures <= frame + 2, "noticed at the next frame"
    lab.session.close()
    known = read_ledger(ledger_path(folder))
    accepted = [row for row in known["attempts"].values() if row["verdict"] == ACCEPTED]
    assert len(accepted) >= frame
    assert all((folder / row["file"]).stat().st_size == row["size"] for row in accepted)
    # Of a log that is cut SQLite cannot read which number the event would have.
    assert happens is log_cut or any(row["what"] == "ended" for row in known["events"].values())
    assert main(["rebuild", str(folder)]) == 0
    assert facts(folder) == known
    assert main(["status", str(folder)]) == 0
    assert read_session(folder).head(lab.clock.now()).done == len(accepted)
    lab.session = Session.open_for_run(folder)
    assert run(lab).complete
    assert {row["sha256"] for row in accepted} <= {frame.sha256 for frame in lab.session.frames() if frame.accepted}
    lab.session.close()


def test_the_ledger_equals_the_journal_after_every_kind_of_end(lab: Lab) -> None:
    lab.camera.script |= {2: b"no raw file", 5: StorageError("lost")}
    with pytest.raises(StorageError):
        run(lab)
    lab.session.close()
    folder = lab.session.folder
    assert facts(folder) == read_ledger(ledger_path(folder))
    lab.session = Session.open_for_run(folder)
    lab.camera.script.clear()
    assert run(lab).complete
    lab.session.retake("1")
    lab.session.journal.record("camera", "one")
    lab.session.journal.record("camera", "another")
    lab.session.close()
    before = facts(folder)
    assert before == read_ledger(ledger_path(folder))
    (folder / "journal.sqlite").unlink()
    rebuild_journal(folder)
    assert facts(folder) == before


def test_the_same_command_makes_a_journal_anew_that_is_gone(lab: Lab) -> None:
    run(lab)
    lab.session.close()
    folder = lab.session.folder
    before, said = facts(folder), list[str]()
    deleted(folder)
    with pytest.raises(FormatError, match="acquire rebuild") as refused:
        Session.open(folder)
    assert "remove" not in str(refused.value)
    assert session_exists(folder)
    with Session.open_for_run(folder, announce=said.append):
        assert facts(folder) == before
    assert [sentence.split(":")[0] for sentence in said] == ["journal"]


def test_a_session_of_older_software_without_its_journal_is_not_to_be_removed(lab: Lab) -> None:
    lab.session.close()
    folder = lab.session.folder
    deleted(folder)
    ledger_path(folder).unlink()
    with pytest.raises(FormatError) as refused:
        session_exists(folder)
    assert "remove" not in str(refused.value)


def test_an_older_journal_in_its_place_is_refused_and_kept(lab: Lab) -> None:
    folder = lab.session.folder
    lab.session.close()
    older = (folder / "journal.sqlite").read_bytes()
    lab.session = Session.open_for_run(folder)
    run(lab)
    lab.session.close()
    known = read_ledger(ledger_path(folder))
    (folder / "journal.sqlite").write_bytes(older)
    with pytest.raises(FormatError, match="lacks 12 frames"):
        Session.open_for_run(folder)
    assert main(["rebuild", str(folder)]) == 0
    assert facts(folder) == known
    assert (folder / "journal.sqlite.1.lost").is_file()


def test_a_ledger_that_is_gone_is_written_again(lab: Lab) -> None:
    path = ledger_path(lab.session.folder)
    assert run(lab, 4, lambda folder: path.unlink()).complete
    lab.session.close()
    assert read_ledger(path) == facts(lab.session.folder)


def test_a_ledger_that_was_cut_off_by_a_crash_follows_the_journal(lab: Lab) -> None:
    run(lab)
    lab.session.close()
    path = ledger_path(lab.session.folder)
    os.truncate(path, path.stat().st_size - 9)
    Session.open_for_run(lab.session.folder).close()
    assert read_ledger(path) == facts(lab.session.folder)


def test_a_transaction_that_never_was_is_no_fact(lab: Lab) -> None:
    """Power went when the ledger had a line, and the journal had not committed it."""
    lab.session.close()
    path = ledger_path(lab.session.folder)
    begun = {"id": 1, "step": 0, "kind": "white", "illumination": None, "file": "frames/a", "started_at": "2026-01-01"}
    with path.open("a") as stream:
        stream.write(json.dumps({"attempts": [begun | {"sha256": "00", "verdict": ACCEPTED}]}) + "\n")
    lab.session = Session.open_for_run(lab.session.folder)
    assert read_ledger(path) == facts(lab.session.folder)
    assert run(lab).complete


@pytest.mark.parametrize("line", ['{"attempts": [{"id": 1, "x y": 2}]}', "[]", '{"heartbeat": [{"id": 1}]}', "no"])
def test_a_ledger_of_a_stranger_becomes_no_statement(lab: Lab, line: str) -> None:
    lab.session.close()
    path = ledger_path(lab.session.folder)
    path.write_text(line + "\n" + path.read_text())
    with pytest.raises(FormatError, match="line 1, is damaged"):
        rebuild_journal(lab.session.folder)


@pytest.mark.parametrize(("mishap", "after"), [(Path.unlink, 4), (lambda path: os.truncate(path, 9), 12)])  # type: ignore[misc]
def test_a_frame_that_is_deleted_or_cut_is_taken_again(lab: Lab, mishap: Callable[[Path], object], after: int) -> None:
    folder = lab.session.folder
    assert run(lab, after, lambda folder: mishap(folder / "frames" / "0002_light_000.dng")).complete
    assert len(lab.session.done_steps()) == len(lab.session.steps)
    assert lab.verdicts().count("voided") == 1
    assert not lab.session.verify()
    assert (folder / "frames" / "0002_light_000_try2.dng").is_file()


def test_a_program_that_writes_the_journal_and_leaves_its_facts_alone_ends_no_run(lab: Lab) -> None:
    folder = lab.session.folder

    def beat(folder: Path) -> None:
        thread_beat(folder / "journal.sqlite", "late", "the camera hangs", datetime.now(UTC))

    assert run(lab, 5, beat).complete
    lab.session.close()
    assert facts(folder) == read_ledger(ledger_path(folder))


def test_no_command_believes_a_journal_that_the_ledger_contradicts(
    lab: Lab, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is whole, sound, and says that the session is complete: by a frame that must not be used any more."""
    older = lab.session.folder
    run(lab)
    lab.session.close()
    journal = (older / "journal.sqlite").read_bytes()
    lab.session = Session.open_for_run(older)
    lab.session.retake("1")
    assert run(lab).complete
    lab.session.close()
    (older / "journal.sqlite").write_bytes(journal)
    (older.parent / "LAB.toml").write_text(SETTINGS.to_toml())
    monkeypatch.chdir(older.parent)
    for command in (["status"], ["report"], ["run", "LAB.toml"]):
        assert main([*command, str(older)]) == 2
        assert "acquire rebuild" in capsys.readouterr().err, command
    with pytest.raises(FormatError, match="lacks 4 frames"):
        Session.open(older)
    watch = SessionWatch(older)
    assert (watch.head().state, "acquire rebuild" in watch.head().sentence) == ("unreadable", True)


def test_a_page_without_its_journal_names_what_makes_it_anew(lab: Lab) -> None:
    watch = SessionWatch(lab.session.folder)
    assert watch.head().total
    deleted(lab.session.folder)
    assert "acquire rebuild" in watch.head().sentence


@pytest.mark.parametrize("mishap", [Path.unlink, lambda path: os.truncate(path, 9)])  # type: ignore[misc]
def test_a_complete_session_whose_files_go_is_complete_no_more(
    lab: Lab, mishap: Callable[[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lab.session.folder
    run(lab)
    lab.session.close()
    clock = SimulatedClock()
    watch = SessionWatch(folder, clock.monotonic)
    assert watch.head().state == "complete"
    mishap(folder / "frames" / "0002_light_000.dng")
    clock.sleep(LOOK_AGAIN_S)
    assert watch.head().state == "incomplete", "a page that is open looks again"
    assert main(["status", str(folder)]) == 4
    assert "incomplete: frames/0002_light_000.dng: deleted or truncated" in capsys.readouterr().out
    assert read_session(folder).head(lab.clock.now()).done == len(lab.session.steps) - 1


@pytest.mark.parametrize(
    ("name", "mishap"),
    [("chart.json", Path.unlink), ("illuminations.csv", lambda path: os.truncate(path, 9))],  # type: ignore[misc]
)
def test_a_complete_session_without_its_chart_or_lights_says_what_is_lost(
    lab: Lab, name: str, mishap: Callable[[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    """All frames are there, and no table can be made of them."""
    folder = lab.session.folder
    run(lab)
    lab.session.close()
    kept = (folder / name).read_bytes()
    mishap(folder / name)
    assert main(["status", str(folder)]) == 4
    said = capsys.readouterr()
    assert "incomplete" in said.out
    assert str(folder / name) in said.err
    assert "restore it from a copy" in said.err
    (folder / name).write_bytes(kept)
    assert main(["status", str(folder)]) == 0
