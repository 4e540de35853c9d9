"""The journal of a session: what is written is there after the program, and what is no journal is said to be none.

Times that a journal may hold: those that every reader of it can read and compare, and no others.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.lights import Illumination
from experiment.session import opening
from experiment.session.journal import Journal, ReceivedFile, time_text
from experiment.session.opening import create_file, require_sound_rows
from experiment.session.records import ACCEPTED, FAILED, AcceptedFile, Judgement, SessionEvent, plan_steps
from foundation.errors import FormatError, StorageError


@pytest.fixture
def journal(tmp_path: Path) -> Generator[sqlite3.Connection]:
    with closing(create_file(tmp_path / "journal.sqlite")) as connection:
        yield connection


def require_time(journal: sqlite3.Connection, text: str) -> None:
    journal.execute("INSERT INTO events (at, what, detail) VALUES (?, 'start', '')", (text,))
    require_sound_rows(Path("journal.sqlite"), journal)


@pytest.mark.parametrize("zone", [UTC, timezone(timedelta(hours=5, minutes=45))])
@pytest.mark.parametrize("microsecond", [0, 1, 250000])
def test_times_that_are_written_may_stand_in_a_journal(
    journal: sqlite3.Connection, zone: timezone, microsecond: int
) -> None:
    at = datetime(2028, 2, 29, 23, 59, 59, microsecond, zone)
    require_time(journal, time_text(at))
    require_time(journal, at.replace(microsecond=0).isoformat())


@pytest.mark.parametrize(
    "text",
    [
        "2026-01-01T00:00:06.000000",
        "2026-01-01T00:00:06.00\x00000+00:00",
        "2026-01-01T00:00:06.000000+00:00\x00",
        "2026-01-01T00:00:06.12    +00:00",
        "2026-02-30T00:00:06.000000+00:00",
        "2026-04-31T00:00:06.000000+00:00",
        "2026-13-01T00:00:06.000000+00:00",
        "2026-01-01T24:00:00.000000+00:00",
        "2026-01-01T00:00:6x.000000+00:00",
        "9999-12-31T23:59:59.000000-08:00",
        "2026-01-01",
        "",
    ],
)
def test_times_that_a_reader_could_not_compare_are_refused(journal: sqlite3.Connection, text: str) -> None:
    with pytest.raises(FormatError, match="1 rows of events"):
        require_time(journal, text)


@pytest.mark.parametrize("text", ["0" * 63 + "g", "ab\x00zz", "0" * 65, "A" * 64])
def test_hashes_that_are_none_are_refused(journal: sqlite3.Connection, text: str) -> None:
    journal.execute(
        "INSERT INTO attempts (step, kind, file, started_at, taken_at, exposure_s, size, sha256, verdict) VALUES"
        " (0, 'white', 'frames/a.cr2', ?, ?, 0.5, 1, ?, 'accepted')",
        (*[time_text(datetime(2026, 1, 1, tzinfo=UTC))] * 2, text),
    )
    with pytest.raises(FormatError, match="1 rows of attempts"):
        require_sound_rows(Path("journal.sqlite"), journal)


LIGHTS = (Illumination(0, "uniform", None, Colour(255, 0, 0)),)
STEPS = plan_steps(LIGHTS, 2)
NOW = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Journal.create(tmp_path / "journal.sqlite", STEPS)
    return tmp_path / "journal.sqlite"


def commit(journal: Journal, attempt: int, reason: str = "") -> None:
    received = ReceivedFile(
        journal.path.parent / f"frames/{attempt}.cr2", 10 * attempt, "00", CapturedFrame("a.cr2", 10 * attempt, NOW)
    )
    judgement = Judgement.of_reason("exposure", reason or None)
    journal.commit(attempt, received, judgement, exposure_s=0.5, ended_at=NOW + timedelta(seconds=2))


def test_what_is_written_is_read_again(path: Path) -> None:
    with closing(Journal.open_for_run(path)) as journal:
        white, dark = (journal.begin(step, f"frames/{step.stem}", NOW) for step in STEPS[:2])
        commit(journal, white)
        journal.fail(dark, NOW, "the cable came off")
        journal.note(NOW, "start", "4 of 4 frames to take")
    with closing(Journal.open_for_run(path)) as journal:
        assert journal.steps() == STEPS
        attempts = journal.attempts()
        assert [(attempt.step, attempt.verdict, attempt.has_frame) for attempt in attempts] == [
            (0, ACCEPTED, True),
            (1, FAILED, False),
        ]
        assert attempts[0].ended_at == NOW + timedelta(seconds=2)
        assert attempts[1].reason == "the cable came off"
        assert journal.accepted_files() == [AcceptedFile(1, 0, None, "frames/1.cr2", 10, "00")]
        assert journal.events() == [SessionEvent(NOW, "start", "4 of 4 frames to take", 1)]


def test_what_is_read_at_one_moment_fits_together(path: Path) -> None:
    with closing(Journal.open_for_run(path)) as run:
        run.note(NOW, "start")
        with closing(Journal.open(path)) as reader:
            with reader.one_moment():
                assert len(reader.events()) == 1
                run.note(NOW, "stop")
                assert len(reader.events()) == 1
            assert [event.what for event in reader.events()] == ["start", "stop"]


def test_a_journal_that_cannot_be_written_says_what_helps(path: Path) -> None:
    with (
        closing(Journal.open(path)) as journal,
        pytest.raises(StorageError, match=r"journal\.sqlite: .* readonly"),
    ):
        journal.note(NOW, "start")


def test_a_damaged_journal(path: Path) -> None:
    path.write_bytes(b"not a database at all" * 100)
    with pytest.raises(FormatError):
        Journal.open(path)


def test_a_journal_that_may_not_be_read_is_not_damaged(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(file: Path, mode: str) -> None:
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(FormatError, match=r"journal\.sqlite.*permissions"):
        Journal.open(path)


def test_a_journal_that_another_holds_is_not_damaged(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "READING_LIMIT_S", 0)
    with closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(FormatError):
            Journal.open(path)


@pytest.mark.parametrize("version", [1, 3])
def test_a_journal_of_another_version_is_refused_by_one_sentence(tmp_path: Path, version: int) -> None:
    path = tmp_path / "journal.sqlite"
    Journal.create(path, ())
    with closing(sqlite3.connect(path)) as journal:
        journal.execute(f"PRAGMA user_version = {version}")
    for opened in (Journal.open, Journal.open_for_run):
        with pytest.raises(FormatError, match=f"version {version}, this software reads version 2; use the software"):
            opened(path)


def test_a_kind_of_frame_that_is_not_known_is_named(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    Journal.create(path, plan_steps([], 1))
    with closing(Journal.open_for_run(path)) as journal:
        journal.begin(journal.steps()[0], "frames/a", datetime.now(UTC))
    with closing(sqlite3.connect(path)) as file, file:
        file.execute("UPDATE plan SET kind = 'flat'")
        file.execute("UPDATE attempts SET kind = 'flat'")
    with closing(Journal.open(path)) as journal:
        for read in (journal.steps, journal.attempts, journal.verdicts):
            with pytest.raises(FormatError, match=r"'flat'.*light, white, dark, resp"):
                read()
