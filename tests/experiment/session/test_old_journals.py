"""Journals of version 1, as the software before wrote them: read, taken up, and taken again."""

from __future__ import annotations

import hashlib
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from acquisition.cli import main
from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illumination, save_illuminations
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement
from foundation.errors import FormatError

NOW = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)
LIGHTS = (Illumination(0, "uniform", None, Colour(255, 0, 0)), Illumination(1, "uniform", None, Colour(0, 255, 0)))

# The tables as version 1 made them, and a session in which the frame of light 0 was cut off after it was taken: it was
# taken again, and both rows stayed accepted. The light that was last under way was cut off with the power.
SCHEMA = """
CREATE TABLE attempts (
    id INTEGER PRIMARY KEY, step INTEGER NOT NULL, kind TEXT NOT NULL, illumination INTEGER, file TEXT NOT NULL,
    started_at TEXT NOT NULL, ended_at TEXT, taken_at TEXT, exposure_s REAL, size INTEGER, sha256 TEXT, verdict TEXT,
    reason TEXT NOT NULL DEFAULT ''
);
CREATE TABLE plan (
    step INTEGER PRIMARY KEY, kind TEXT NOT NULL, illumination INTEGER,
    red INTEGER NOT NULL, green INTEGER NOT NULL, blue INTEGER NOT NULL
);
CREATE TABLE events (id INTEGER PRIMARY KEY, at TEXT NOT NULL, what TEXT NOT NULL, detail TEXT NOT NULL);
INSERT INTO plan VALUES (0, 'white', NULL, 255, 255, 255), (1, 'dark', NULL, 0, 0, 0), (2, 'light', 0, 255, 0, 0),
    (3, 'light', 1, 0, 255, 0), (4, 'white', NULL, 255, 255, 255), (5, 'dark', NULL, 0, 0, 0);
INSERT INTO events (at, what, detail) VALUES ('2026-01-01T09:00:00.000000+00:00', 'start', '6 of 6 frames to take');
PRAGMA user_version = 1;
"""
ROWS = (
    (0, "white", None, "0000_white.cr2", "accepted", ""),
    (1, "dark", None, "0001_dark.cr2", "refused", "light"),
    (1, "dark", None, "0001_dark_try2.cr2", "accepted", ""),
    (2, "light", 0, "0002_light_000.cr2", "accepted", ""),
    (2, "light", 0, "0002_light_000_try2.cr2", "accepted", ""),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "old"
    (folder / "frames").mkdir(parents=True)
    (folder / "session.toml").write_text("")
    design_chart(bits=1).save(folder / "chart.json")
    save_illuminations(LIGHTS, folder / "illuminations.csv")
    with closing(sqlite3.connect(folder / "journal.sqlite")) as journal, journal:
        journal.executescript(SCHEMA)
        for number, (step, kind, light, name, verdict, reason) in enumerate(ROWS, 1):
            data = f"frame {name}".encode()
            (folder / "frames" / name).write_bytes(data)
            at = f"2026-01-01T09:00:{number:02d}.000000+00:00"
            row = (step, kind, light, f"frames/{name}", at, at, at, 0.5, len(data), hashlib.sha256(data).hexdigest())
            journal.execute(f"INSERT INTO attempts VALUES (NULL, {'?, ' * 11}?)", (*row, verdict, reason))
        journal.execute(
            "INSERT INTO attempts (step, kind, illumination, file, started_at) VALUES (3, 'light', 1, "
            "'frames/0003_light_001', '2026-01-01T09:00:06.000000+00:00')"
        )
    (folder / "frames" / "0002_light_000.cr2").write_bytes(b"fra")
    return folder


def version(folder: Path) -> int:
    with closing(sqlite3.connect(folder / "journal.sqlite")) as journal:
        return journal.execute("PRAGMA user_version").fetchone()[0]


def test_it_is_read_and_not_changed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "journal.sqlite").read_bytes()
    with Session.open(folder) as session:
        assert [frame.file for frame in session.frames() if frame.accepted] == [
            "frames/0000_white.cr2",
            "frames/0001_dark_try2.cr2",
            "frames/0002_light_000_try2.cr2",
        ], "a light's newest frame counts once"
        assert session.done_steps() == {0, 1, 2}
        assert session.journal.details() == session.journal.details([1]) == session.journal.records() == {}
        assert list(session.journal.measurements()) == []
        assert session.journal.heartbeat() is None
    assert main(["status", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "frames  3 of 6" in told
    assert "left    3 frames; no run is at work" in told
    assert (folder / "journal.sqlite").read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {
        "chart.json", "frames", "illuminations.csv", "journal.sqlite", "session.toml",
    }  # fmt: skip


def test_it_is_taken_up(folder: Path) -> None:
    with Session.open_for_run(folder) as session:
        assert session.verify() == ("frames/0002_light_000.cr2 has 3 of 24 bytes; it is taken again",)
        assert session.set_aside_strays() == []
        for step in session.steps:
            if step.number not in session.done_steps():
                attempt = session.journal.begin(step, f"frames/{step.stem}", NOW)
                received = session.receive(
                    step.stem, lambda into, name=step.stem: CapturedFrame("a.cr2", into.write(name.encode()), NOW)
                )
                session.journal.commit(attempt, received, Judgement(()), {"settle": 0.2}, exposure_s=0.5, ended_at=NOW)
        session.write_frames_csv()
        assert session.done_steps() == set(range(6))
    assert version(folder) == 2
    with Session.open(folder) as session:
        assert [frame.file for frame in session.frames() if frame.accepted and frame.kind == "light"] == [
            "frames/0002_light_000_try2.cr2",
            "frames/0003_light_001.cr2",
        ]
        settled = {number: details.timings for number, details in session.journal.details().items()}
        assert settled == {7: {"settle": 0.2}, 8: {"settle": 0.2}, 9: {"settle": 0.2}}
    rows = (folder / "frames.csv").read_text().splitlines()
    assert len([row for row in rows if row.endswith(",accepted")]) == 6


def test_a_light_of_it_is_taken_again(folder: Path) -> None:
    with Session.open_for_run(folder) as session:
        assert session.retake("0") == (0,)
        assert session.done_steps() == {0, 1}


def test_frames_csv_is_complete_as_soon_as_a_run_begins(folder: Path) -> None:
    with Session.open_for_run(folder):
        assert len((folder / "frames.csv").read_text().splitlines()) == 1 + len(ROWS)


def test_a_kind_of_frame_that_is_not_known_is_named(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE plan SET kind = 'flat' WHERE step = 1")
    with pytest.raises(FormatError, match=r"'flat'.*light, white, dark, resp"):
        Session.open(folder)


def test_a_kind_of_attempt_that_is_not_known_is_named_however_the_attempts_are_read(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "journal.sqlite")) as file, file:
        file.execute("UPDATE attempts SET kind = 'flat' WHERE id = 1")
    with closing(Journal.open(folder / "journal.sqlite")) as journal:
        for read in (journal.attempts, journal.verdicts, journal.frames):
            with pytest.raises(FormatError, match=r"'flat'.*light, white, dark, resp"):
                read()
