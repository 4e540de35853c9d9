"""Times that a journal may hold: those that every reader of it can read and compare, and no others."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from experiment.session.journal import time_text
from experiment.session.journal_file import JOURNAL_VERSION, create_file, require_sound_rows
from foundation.errors import FormatError


@pytest.fixture
def journal(tmp_path: Path) -> Generator[sqlite3.Connection]:
    with closing(create_file(tmp_path / "journal.sqlite")) as connection:
        yield connection


def require_time(journal: sqlite3.Connection, text: str) -> None:
    journal.execute("INSERT INTO events (at, what, detail) VALUES (?, 'start', '')", (text,))
    require_sound_rows(Path("journal.sqlite"), journal, JOURNAL_VERSION)


@pytest.mark.parametrize("zone", [UTC, timezone(timedelta(hours=5, minutes=45)), timezone(timedelta(hours=-8))])
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
        "2026-02-30T00:00:06.000000+00:00",
        "2026-01-01T24:00:06.000000+00:00",
        "2026-01-01T00:00:06.000000+25:00",
        "0000-01-01T00:00:06.000000+00:00",
        "9999-12-31T23:59:59.000000-08:00",
        "2026-01-01",
        "",
    ],
)
def test_times_that_a_reader_could_not_compare_are_refused(journal: sqlite3.Connection, text: str) -> None:
    with pytest.raises(FormatError, match="1 rows of events hold values that no run writes"):
        require_time(journal, text)
