"""The journal of a session: durability, refusal of foreign contents, and a model of all operations."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session import opening
from experiment.session.journal import Journal, ReceivedFile, time_text
from experiment.session.opening import create_file, require_sound_rows
from experiment.session.records import (
    AttemptDetails,
    Check,
    Judgement,
    SessionStep,
    link_steps,
    plan_steps,
)
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
def test_accepts_written_times(journal: sqlite3.Connection, zone: timezone, microsecond: int) -> None:
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
def test_refuses_times_that_cannot_be_compared(journal: sqlite3.Connection, text: str) -> None:
    with pytest.raises(FormatError, match="1 row of events"):
        require_time(journal, text)


@pytest.mark.parametrize("text", ["0" * 63 + "g", "ab\x00zz", "0" * 65, "A" * 64])
def test_refuses_wrong_hashes(journal: sqlite3.Connection, text: str) -> None:
    journal.execute(
        "INSERT INTO attempts (step, kind, file, started_at, taken_at, exposure_s, size, sha256, verdict) VALUES"
        " (0, 'white', 'frames/a.cr2', ?, ?, 0.5, 1, ?, 'accepted')",
        (*[time_text(datetime(2026, 1, 1, tzinfo=UTC))] * 2, text),
    )
    with pytest.raises(FormatError, match="1 row of attempts"):
        require_sound_rows(Path("journal.sqlite"), journal)


LIGHTS = (Illuminant(0, "uniform", None, Colour(255, 0, 0)),)
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


def test_snapshot_is_consistent(path: Path) -> None:
    with closing(Journal.open_for_run(path)) as run:
        run.note(NOW, "start")
        with closing(Journal.open(path)) as reader:
            with reader.snapshot():
                assert len(reader.events()) == 1
                run.note(NOW, "stop")
                assert len(reader.events()) == 1
            assert [event.what for event in reader.events()] == ["start", "stop"]


def test_reports_a_read_only_journal(path: Path) -> None:
    with (
        closing(Journal.open(path)) as journal,
        pytest.raises(StorageError, match=r"journal\.sqlite: .* readonly"),
    ):
        journal.note(NOW, "start")


def test_refuses_a_damaged_journal(path: Path) -> None:
    path.write_bytes(b"not a database at all" * 100)
    with pytest.raises(FormatError):
        Journal.open(path)


def test_missing_permission_is_not_damage(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(file: Path, mode: str) -> None:
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(FormatError, match=r"journal\.sqlite.*permissions"):
        Journal.open(path)


def test_held_journal_is_not_damage(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "READING_LIMIT_S", 0)
    with closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(FormatError):
            Journal.open(path)


@pytest.mark.parametrize("version", [1, 3])
def test_refuses_another_version(tmp_path: Path, version: int) -> None:
    path = tmp_path / "journal.sqlite"
    Journal.create(path, ())
    with closing(sqlite3.connect(path)) as journal:
        journal.execute(f"PRAGMA user_version = {version}")
    for opened in (Journal.open, Journal.open_for_run):
        with pytest.raises(FormatError, match=f"version {version}, expected 2; use the software"):
            opened(path)


def test_names_an_unknown_kind_of_frame(tmp_path: Path) -> None:
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


MODEL_STEPS = plan_steps((Illuminant(0, "uniform", None, Colour(255, 0, 0)),), 2)
BEGUN = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)
NUMBER = st.floats(allow_nan=False, allow_infinity=False)
LIMIT = NUMBER | st.none()
REASON = st.sampled_from(["", "too dark; light it", "moved"])
CHECK = st.builds(Check, st.text(min_size=1, max_size=9), LIMIT, LIMIT, LIMIT, st.text(max_size=3), REASON)
JUDGEMENT = st.builds(
    Judgement,
    st.lists(CHECK, max_size=3).map(tuple),
    st.tuples(NUMBER, NUMBER, NUMBER) | st.none(),
    st.binary(max_size=9),
)


@dataclass
class Row:
    """An attempt in the model."""

    step: SessionStep
    verdict: str | None = None
    reason: str = ""
    judgement: Judgement | None = None


@dataclass
class Model:
    """Contents of a journal as plain lists."""

    rows: list[Row] = field(default_factory=list[Row])
    steps: list[SessionStep] = field(default_factory=lambda: list(MODEL_STEPS))
    records: dict[str, str] = field(default_factory=dict[str, str])
    events: list[str] = field(default_factory=list[str])
    state: str | None = None


OPERATION = st.one_of(
    st.tuples(st.just("begin"), st.integers(0, len(MODEL_STEPS) - 1)),
    st.tuples(st.just("commit"), JUDGEMENT),
    st.tuples(st.just("fail"), st.text(max_size=9)),
    st.tuples(st.just("void"), st.lists(st.integers(1, 8), max_size=4)),
    st.tuples(st.just("note"), st.text(max_size=9)),
    st.tuples(st.just("record"), st.tuples(st.sampled_from(["camera", "seed"]), st.text(max_size=9))),
    st.tuples(st.just("beat"), st.sampled_from(["running", "paused", "ended"])),
    st.tuples(st.just("add"), st.none()),
    st.tuples(st.just("reopen"), st.none()),
)


def apply(operation: str, value: Any, journal: Journal, model: Model, at: datetime) -> None:
    """Apply one operation to the journal and to the model."""
    open_rows = [number for number, row in enumerate(model.rows, 1) if row.verdict is None]
    if operation == "begin":
        step = model.steps[int(value)]
        assert journal.begin(step, f"frames/{len(model.rows)}", at) == len(model.rows) + 1
        model.rows.append(Row(step))
    elif operation == "commit" and open_rows:
        number = open_rows[-1]
        path = journal.path.parent / f"frames/{number}.cr2"
        received = ReceivedFile(path, number, f"{number:064d}", CapturedFrame("a.cr2", number, at))
        journal.commit(number, received, value, {"settle": float(number)}, exposure_s=0.5, ended_at=at)
        row = model.rows[number - 1]
        row.judgement = value
        row.reason = next((check.reason for check in value.checks if check.reason), "")
        row.verdict = "refused" if row.reason else "accepted"
    elif operation == "fail" and open_rows:
        journal.fail(open_rows[-1], at, value)
        model.rows[open_rows[-1] - 1].verdict, model.rows[open_rows[-1] - 1].reason = "failed", value
    elif operation == "void":
        journal.void(value, at, "the white frame moved")
        voided = [row for number, row in enumerate(model.rows, 1) if number in value and row.verdict == "accepted"]
        for row in voided:
            row.verdict, row.reason = "voided", "the white frame moved"
        if voided:
            model.events.append("voided")
    elif operation == "note":
        journal.note(at, value)
        model.events.append(value)
    elif operation == "record":
        journal.record(*value)
        model.records[value[0]] = value[1]
    elif operation == "beat":
        journal.beat(value, "", at)
        model.state = value
    elif operation == "add":
        new_steps = link_steps(len(model.steps))
        journal.add_steps(new_steps)
        model.steps += new_steps


def check(journal: Journal, model: Model) -> None:
    """Compare everything that a journal returns with the model."""
    assert list(journal.steps()) == model.steps
    attempts = journal.attempts()
    assert [(item.verdict, item.reason) for item in attempts] == [(row.verdict, row.reason) for row in model.rows]
    judged = {number: row for number, row in enumerate(model.rows, 1) if row.judgement is not None}
    assert journal.details() == {
        number: AttemptDetails(row.judgement.seen, row.judgement.checks, {"settle": float(number)})
        for number, row in judged.items()
        if row.judgement
    }
    selected = sorted(judged)[::2]
    assert journal.details(selected) == {number: journal.details()[number] for number in selected}
    assert journal.details([]) == {}
    assert list(journal.measurements()) == [
        (row.step, number, row.judgement.measurement, row.verdict == "accepted")
        for number, row in judged.items()
        if row.judgement and row.judgement.measurement
    ]
    assert [item.attempt for item in journal.accepted_files()] == [
        number for number, row in judged.items() if row.verdict == "accepted"
    ]
    newest = {row.step.number: number for number, row in judged.items() if row.verdict == "accepted"}
    assert {frame.file for frame in journal.frames() if frame.accepted} == {
        f"frames/{number}.cr2" for number in newest.values()
    }
    assert len(journal.frames()) == len(judged)
    assert journal.records() == model.records
    assert [event.what for event in journal.events()] == model.events
    beat = journal.heartbeat()
    assert (None if beat is None else beat.state) == model.state


@pytest.mark.slow
@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(OPERATION, max_size=14))
def test_journal_matches_the_model(operations: list[tuple[str, Any]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, model = Path(folder) / "journal.sqlite", Model()
        Journal.create(path, MODEL_STEPS)
        journal = Journal.open_for_run(path)
        try:
            for second, (operation, value) in enumerate(operations):
                if operation == "reopen":
                    journal.close()
                    journal = Journal.open_for_run(path)
                apply(operation, value, journal, model, BEGUN + timedelta(seconds=second))
            check(journal, model)
            with closing(Journal.open(path)) as reader:
                check(reader, model)
        finally:
            journal.close()
        with closing(Journal.open(path)) as reader:
            check(reader, model)


# Writes a short night and is killed before the n-th, 2n-th … SQLite statement, until one process survives; each in a
# fork, because imports take longer than the night.
KILLED = """
import itertools, os, signal, sqlite3, sys
from pathlib import Path
from experiment.session.journal import Journal
from tests.experiment.session.test_journal import MODEL_STEPS, night

statements = 0
connect = sqlite3.connect

def watched(*arguments, **keywords):
    connection = connect(*arguments, **keywords)
    connection.set_trace_callback(deadly)
    return connection

def deadly(statement):
    global statements
    statements += 1
    if statements == number:
        os.kill(os.getpid(), signal.SIGKILL)

for number in itertools.count(int(sys.argv[2]), int(sys.argv[2])):
    path = Path(sys.argv[1]) / str(number) / "journal.sqlite"
    path.parent.mkdir()
    Journal.create(path, MODEL_STEPS)
    if not (pid := os.fork()):
        sqlite3.connect = watched
        journal = Journal.open_for_run(path)
        for done, act in enumerate(night(journal), 1):
            act()
            path.with_name("done").write_text(str(done))
        journal.close()
        os._exit(0)
    ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    print(number, ended, flush=True)
    if ended != -signal.SIGKILL:
        break
"""

GOOD = Judgement((Check("light", 0.1, None, 1.0, "%"), Check("movement", 0.0, None, 0.5, "px")), (1.0, 2.0, 3.0), b"m")


def night(journal: Journal) -> list[Callable[[], object]]:
    """Return the operations of a short night, one transaction each."""

    def commit(number: int) -> None:
        path = journal.path.parent / f"frames/{number}.cr2"
        received = ReceivedFile(path, 1, "0" * 64, CapturedFrame("a.cr2", 1, BEGUN))
        journal.commit(number, received, GOOD, {"settle": 1.0}, exposure_s=0.5, ended_at=BEGUN)

    return [
        lambda: journal.begin(MODEL_STEPS[0], "frames/0", BEGUN),
        lambda: commit(1),
        lambda: journal.begin(MODEL_STEPS[1], "frames/1", BEGUN),
        lambda: commit(2),
        lambda: journal.void([1], BEGUN, "moved"),
        lambda: journal.add_steps(link_steps(len(MODEL_STEPS))),
    ]


def state_after(journal: Journal) -> tuple[object, ...]:
    """Return the contents of a journal without times."""
    attempts = [(item.id, item.verdict, item.has_frame) for item in journal.attempts()]
    events = [item.what for item in journal.events()]
    return len(journal.steps()), attempts, journal.details(), events


@pytest.mark.slow
def test_kill_loses_at_most_one_transaction(tmp_path: Path) -> None:
    Journal.create(tmp_path / "model.sqlite", MODEL_STEPS)
    with closing(Journal.open_for_run(tmp_path / "model.sqlite")) as model:
        states = [state_after(model)]
        for act in night(model):
            act()
            states.append(state_after(model))
    # Every seventh of some ninety: all kinds of statements of a commit occur in all positions.
    output = subprocess.check_output([sys.executable, "-c", KILLED, str(tmp_path), "7"], text=True)
    *killed, (last, code) = ([int(word) for word in line.split()] for line in output.splitlines())
    assert {ended for _, ended in killed} == {-signal.SIGKILL}
    assert code == 0
    assert last > 35
    for number, _ in killed:
        path = tmp_path / f"{number}" / "journal.sqlite"
        done_file = path.with_name("done")
        finished = int(done_file.read_text() or 0) if done_file.exists() else 0
        with closing(Journal.open(path)) as reader:
            state = state_after(reader)
        assert state in states[finished : finished + 2], f"killed at statement {number}, after {finished} transactions"
        with closing(Journal.open_for_run(path)) as again:
            assert state_after(again) == state
        with closing(sqlite3.connect(path)) as bare:
            assert bare.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert {file.name for file in path.parent.iterdir()} - {"done"} == {"journal.sqlite"}
