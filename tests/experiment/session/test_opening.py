"""Access to a journal by readers, other writers and the run."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session import opening
from experiment.session.journal import Journal
from experiment.session.records import plan_steps
from foundation.errors import FormatError, StorageError

pytestmark = pytest.mark.slow

STEPS = plan_steps((Illuminant(0, "uniform", None, Colour(255, 0, 0)),), 2)
NOW = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)

# Another program: executes statements on the journal and holds it until its input ends.
HOLDER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
for statement in sys.argv[2:]:
    connection.execute(statement).fetchall()
print("held", flush=True)
sys.stdin.read()
"""

READER = ("BEGIN", "SELECT * FROM events")
WRITER = ("BEGIN IMMEDIATE", "INSERT INTO events (at, what, detail) VALUES ('2026-01-01T00:00:00+00:00', 'other', '')")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Journal.create(tmp_path / "journal.sqlite", STEPS)
    return tmp_path / "journal.sqlite"


@contextmanager
def another_program(path: Path, *statements: str) -> Generator[subprocess.Popen[str]]:
    """Run a program that holds the journal until its input is closed, at the latest at the end of the block."""
    program = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), *statements],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with program:
        assert program.stdout is not None
        assert program.stdout.readline() == "held\n"
        yield program
        release(program)


def release(program: subprocess.Popen[str]) -> None:
    assert program.stdin is not None
    program.stdin.close()
    program.wait()


def files(path: Path) -> dict[str, bytes]:
    """Return the files in the folder of the journal; SQLite's shared memory is not read."""
    return {
        file.name: b"" if file.name.endswith("-shm") else file.read_bytes() for file in sorted(path.parent.iterdir())
    }


def event_names(path: Path) -> list[str]:
    with closing(Journal.open(path)) as journal:
        return [event.what for event in journal.events()]


def test_reader_does_not_block_a_run(path: Path) -> None:
    with (
        closing(Journal.open_for_run(path, 0)) as journal,
        another_program(path, *READER),
    ):
        for _ in range(30):
            journal.note(NOW, "written")
        assert event_names(path) == ["written"] * 30
    assert set(files(path)) >= {"journal.sqlite"}
    with closing(Journal.open_for_run(path, 0)) as journal:
        assert len(journal.events()) == 30
    assert set(files(path)) == {"journal.sqlite"}, "the next run leaves one file again"


def test_earlier_reader_does_not_block_a_run(path: Path) -> None:
    with another_program(path, *READER), closing(Journal.open_for_run(path, 0)) as journal:
        journal.note(NOW, "written")
        assert event_names(path) == ["written"]
    assert event_names(path) == ["written"]
    assert set(files(path)) == {"journal.sqlite"}


@pytest.mark.parametrize("at_start", [True, False])
def test_waits_for_another_writer(path: Path, at_start: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "TRY_S", 0.01)
    messages: list[str] = []

    def announce(sentence: str) -> None:
        messages.append(sentence)
        release(program)

    running = None if at_start else Journal.open_for_run(path)
    with another_program(path, *WRITER) as program:
        journal = running or Journal.open_for_run(path, 60, announce)
        with closing(journal):
            if running:
                journal.retry_locked(60, announce)
            journal.note(NOW, "written")
    assert messages == [f"another program is using {path}; the run resumes automatically when the file is free"]
    assert event_names(path) == ["written"]


def test_waiting_ends_with_an_error_and_no_loss(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "TRY_S", 0.01)
    with closing(Journal.open_for_run(path, 0.05)) as journal:
        with (
            another_program(path, *WRITER),
            pytest.raises(StorageError),
        ):
            journal.note(NOW, "not written")
        journal.note(NOW, "written")
    assert event_names(path) == ["written"]


def test_waits_for_readers_on_network_file_systems(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "TRY_S", 0.01)

    def shared(_: Path) -> bool:
        return True

    monkeypatch.setattr(opening, "_on_network", shared)
    messages: list[str] = []
    with closing(Journal.open_for_run(path, 60)) as journal:
        assert set(files(path)) == {"journal.sqlite"}
        with another_program(path, *READER) as reader:

            def announce(sentence: str) -> None:
                messages.append(sentence)
                release(reader)

            journal.retry_locked(60, announce)
            journal.note(NOW, "written")
    assert len(messages) == 1
    assert event_names(path) == ["written"]


def kill_a_run(path: Path) -> None:
    """Leave the files of a killed run, with its last commits in the side file."""
    program = (
        "import os, sys, signal\nfrom datetime import datetime, UTC\nfrom pathlib import Path\n"
        "from experiment.session.journal import Journal\n"
        "journal = Journal.open_for_run(Path(sys.argv[1]))\n"
        "journal.note(datetime.now(UTC), 'last')\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", program, str(path)], check=False).returncode == -9
    assert set(files(path)) == {"journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm"}


def test_reads_and_resumes_a_killed_run(path: Path) -> None:
    kill_a_run(path)
    before = files(path)
    assert event_names(path) == ["last"]
    assert files(path) == before
    Journal.open_for_run(path).close()
    assert event_names(path) == ["last"]
    assert set(files(path)) == {"journal.sqlite"}


@pytest.mark.parametrize("copied_suffixes", [("", "-wal"), ("", "-wal", "-shm"), ("",)])
def test_reads_a_copied_journal(path: Path, tmp_path: Path, copied_suffixes: tuple[str, ...]) -> None:
    kill_a_run(path)
    copy = tmp_path / "copy" / "journal.sqlite"
    copy.parent.mkdir()
    for suffix in copied_suffixes:
        shutil.copy(f"{path}{suffix}", f"{copy}{suffix}")
    files_before = files(copy)
    assert event_names(copy) == (["last"] if "-wal" in copied_suffixes else []), (
        "without its -wal the last commits are missing"
    )
    assert files(copy) == files_before, "a reader creates nothing"
    Journal.open_for_run(copy).close()
    assert set(files(copy)) == {"journal.sqlite"}


def test_reader_undoes_an_interrupted_commit_in_a_copy(path: Path) -> None:
    """The state of version 1 after a power cut: a hot rollback journal."""
    program = (
        "import os, signal, sqlite3, sys\nconnection = sqlite3.connect(sys.argv[1], "
        "isolation_level=None)\nconnection.execute('PRAGMA cache_size = 1')\nconnection.execute('PRAGMA cache_spill = "
        "1')\nconnection.execute('BEGIN IMMEDIATE')\nfor number in range(2000):\n    connection.execute(\"INSERT INTO "
        "events (at, what, detail) VALUES ('x', 'lost', ?)\", ('a' * 200,))\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", program, str(path)], check=False).returncode == -9
    assert set(files(path)) == {"journal.sqlite", "journal.sqlite-journal"}
    before = files(path)
    assert event_names(path) == []
    assert files(path) == before
    Journal.open_for_run(path).close()
    assert set(files(path)) == {"journal.sqlite"}


@contextmanager
def without_permissions(folder: Path) -> Generator[None]:
    """Work without permissions in a folder; root becomes another user."""
    root = os.geteuid() == 0
    for file in folder.iterdir():
        file.chmod(0o444)
    folder.chmod(0o555)
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(0o755)


@pytest.fixture
def public() -> Generator[Path]:
    """Lend a journal in a folder for all users; those of pytest are for one user."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        folder = Path(name) / "s"
        folder.mkdir()
        Journal.create(folder / "journal.sqlite", STEPS)
        yield folder / "journal.sqlite"


@pytest.mark.parametrize("state", ["at rest", "killed", "killed and copied"])
def test_reads_in_a_folder_without_write_permission(public: Path, state: str) -> None:
    if state.startswith("killed"):
        kill_a_run(public)
        if state.endswith("copied"):
            public.with_name("journal.sqlite-shm").unlink()
    before = files(public)
    with without_permissions(public.parent):
        assert event_names(public) == (["last"] if state.startswith("killed") else [])
    assert files(public) == before


def test_warns_of_a_file_system_without_locks(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """SQLite reports ENOLCK as `database is locked`, and EINVAL as `disk I/O error`."""
    real = opening._connect_with

    def connect(path: Path, parameters: str) -> sqlite3.Connection:
        if "nolock" not in parameters:
            raise sqlite3.OperationalError("database is locked")
        return real(path, parameters)

    monkeypatch.setattr(opening, "_connect_with", connect)

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    with monkeypatch.context() as refused:
        refused.setattr(fcntl, "lockf", no_locks)
        with closing(Journal.open_for_run(path, 0)) as journal:
            journal.note(NOW, "written")
        assert event_names(path) == ["written"]
    assert "this file system has no locks" in caplog.text
    with pytest.raises(FormatError):
        Journal.open(path)
