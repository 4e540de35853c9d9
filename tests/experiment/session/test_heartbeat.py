"""Signs of life: whose they are, and when a run is given up."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from experiment.session import heartbeat
from experiment.session.heartbeat import Heartbeat, Process, SessionPlace
from experiment.session.journal import Journal

NOW = datetime(2026, 1, 1, 23, 30, tzinfo=UTC)
SELF = Process.own()


def beat(state: heartbeat.RunState = "running", until_s: float = 10) -> Heartbeat:
    return Heartbeat(NOW, SELF, state, "taking 8 frames", NOW + timedelta(seconds=until_s))


def test_this_process_lives() -> None:
    assert SELF.is_alive() is True
    assert SELF.pid == os.getpid()
    assert SELF.host == socket.gethostname()


def test_a_number_that_another_process_bears_now_is_not_the_run() -> None:
    assert replace(SELF, started="1").is_alive() is False
    assert replace(SELF, started="").is_alive() is False


def test_a_process_that_is_gone_is_dead_and_so_is_what_is_left_of_it() -> None:
    program = "from experiment.session.heartbeat import *\nprint(Process.own().started, flush=True)\ninput()"
    other = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with other:
        assert other.stdout is not None
        process = replace(SELF, pid=other.pid, started=other.stdout.readline().strip())
        assert process.is_alive() is True
        other.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
        assert process.is_alive() is False, "killed, and its parent has not looked yet"
    assert process.is_alive() is False


def test_without_proc_the_list_of_processes_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As macOS has it: ps(1) says when a process began."""

    def no_file(path: Path, **_: object) -> str:
        raise FileNotFoundError(2, "No such file or directory", str(path))

    at_ten = "Mon Jan  1 10:00:00 2026"
    listed = {os.getpid(): f"S {at_ten}", 1: "S Mon Jan  1 09:00:00 2026", 5: f"Z {at_ten}"}

    def absent(_: Path) -> bool:
        return False

    def run(arguments: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        text = listed.get(int(arguments[-1]), "")
        return subprocess.CompletedProcess(arguments, 0 if text else 1, f"{text}\n", "")

    monkeypatch.setattr(Path, "read_text", no_file)
    monkeypatch.setattr(Path, "exists", absent)
    monkeypatch.setattr(subprocess, "run", run)
    own = Process.own()
    assert (own.started, own.boot) == ("Mon Jan 1 10:00:00 2026", "Mon Jan 1 09:00:00 2026")
    assert own.is_alive() is True
    assert replace(own, pid=4).is_alive() is False
    assert replace(own, pid=5).is_alive() is False


def test_a_run_whose_process_is_gone_is_dead_at_once_however_long_it_meant_to_be_silent() -> None:
    assert beat(until_s=3600).is_dead(NOW, alive=False)
    assert not beat(until_s=-3600).is_dead(NOW, alive=True), "a process that is there is waited for"


def test_a_journal_keeps_the_newest_sign_of_life(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    Journal.create(path, [])
    with closing(Journal.open_for_run(path)) as journal:
        assert journal.heartbeat() is None
        for state in ("running", "paused"):
            journal.beat(state, f"it is {state}", NOW)
    with closing(Journal.open(path)) as journal:
        found = journal.heartbeat()
    assert found is not None
    assert (found.state, found.sentence, found.until, found.process) == ("paused", "it is paused", NOW, SELF)
    assert abs(found.at - datetime.now(UTC)) < timedelta(minutes=5)


class TestPlace:
    """Whose folder a sign of life was given for; a copy holds the same sign."""

    @pytest.fixture
    def run(self) -> Iterator[Path]:
        """Return a session's folder in which a run has said that it takes frames, and still says so.

        On the disk for temporary files, whose file system mostly tells folders of one number apart; one in memory
        does not.
        """
        with TemporaryDirectory() as place:
            folder = Path(place) / "night"
            folder.mkdir()
            Journal.create(folder / "journal.sqlite", ())
            with closing(Journal.open_for_run(folder / "journal.sqlite")) as journal:
                journal.beat("running", "frames are taken", NOW)
            yield folder

    @staticmethod
    def of(folder: Path) -> tuple[Heartbeat, SessionPlace]:
        here = SessionPlace.of(folder / "journal.sqlite")
        with closing(Journal.open(folder / "journal.sqlite")) as journal:
            told = journal.heartbeat()
            assert journal.records() == {}, "the place is no device"
        assert told is not None
        assert here is not None
        return told, here

    def test_it_is_that_of_the_folder_also_when_it_was_renamed(self, run: Path) -> None:
        told, here = self.of(run)
        assert told.is_of(here) is True
        told, here = self.of(run.rename(run.with_name("moved")))
        assert told.is_of(here) is True

    def test_a_copy_and_a_restored_backup_are_others(self, run: Path) -> None:
        backup = run.with_name("backup")
        shutil.copytree(run, backup)
        told, here = self.of(backup)
        assert told.is_of(here) is False
        shutil.rmtree(run)
        shutil.copytree(backup, run)
        told, here = self.of(run)
        if here.generation:  # Else numbers may be given anew, and nothing tells.
            assert told.is_of(here) is False

    def test_the_journal_of_a_backup_in_the_folder_of_the_run_is_another(self, run: Path) -> None:
        _, before = self.of(run)
        shutil.copy(run / "journal.sqlite", run / "copy")
        (run / "copy").replace(run / "journal.sqlite")
        _, here = self.of(run)
        assert here.inode == before.inode
        assert here.journal != before.journal

    def test_a_folder_that_bears_the_number_of_one_that_is_gone_is_another(self, run: Path) -> None:
        told, here = self.of(run)
        said = replace(told, place=replace(here, generation=7))
        assert said.is_of(replace(here, generation=8)) is False
        assert said.is_of(replace(here, generation=0)) is True, "over NFS it is not told"

    def test_a_snapshot_of_a_file_system_has_the_same_numbers_and_another_device(self, run: Path) -> None:
        told, here = self.of(run)
        assert told.is_of(replace(here, device=here.device + 1)) is False

    def test_over_nfs_the_device_is_another_and_the_numbers_are_the_servers(self, run: Path) -> None:
        told, here = self.of(run)
        elsewhere = replace(told, process=replace(SELF, host="another"))
        assert elsewhere.is_of(replace(here, device=here.device + 1, folder="/mnt/night")) is True
        assert elsewhere.is_of(replace(here, inode=here.inode + 1)) is False

    def test_after_a_boot_the_device_may_have_another_number(self, run: Path) -> None:
        told, here = self.of(run)
        before = replace(told, process=replace(SELF, boot="the one before"))
        assert before.is_of(replace(here, device=here.device + 1)) is True

    @pytest.mark.parametrize("kind", ["fuse.sshfs", "cifs", "virtiofs"])
    def test_where_numbers_are_made_up_they_say_nothing(
        self, run: Path, kind: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told, here = self.of(run)
        monkeypatch.setattr(heartbeat, "file_system_of", lambda path: kind)  # pyrefly: ignore[implicit-any-lambda]
        mounted = SessionPlace.of(run / "journal.sqlite")
        assert mounted is not None
        assert mounted.folder == here.folder
        assert told.is_of(mounted) is None

    def test_older_signs_and_damaged_ones_say_nothing(self, run: Path) -> None:
        told, here = self.of(run)
        assert replace(told, place=None).is_of(here) is None
        assert told.is_of(None) is None
        for text in (
            "",
            "null",
            "{}",
            '["/night"]',
            '["/night", 1, 2]',
            '["/night", 1, 2, "x"]',
            '["/night", 1, 2, null]',
        ):
            assert SessionPlace.from_text(text) is None
        assert SessionPlace.from_text(here.to_text()) == here


def test_a_frame_is_a_sign_of_life(tmp_path: Path) -> None:
    Journal.create(tmp_path / "journal.sqlite", ())
    with closing(Journal.open_for_run(tmp_path / "journal.sqlite")) as journal:
        journal.beat("running", "frames are taken", NOW)
        before = journal.heartbeat()
        journal.note(NOW, "refused", "a frame")
        after = journal.heartbeat()
        assert before is not None
        assert after is not None
        assert after.at > before.at
        assert replace(after, at=before.at) == before
        journal.beat("ended", "", NOW)
        last = journal.heartbeat()
        journal.note(NOW, "complete", "what is written behind the end is none")
        assert journal.heartbeat() == last
