"""Signs of life: identity of their run, and detection of its end."""

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


def test_this_process_is_alive() -> None:
    assert SELF.is_alive() is True
    assert SELF.pid == os.getpid()
    assert SELF.host == socket.gethostname()


def test_reused_process_number_is_not_the_run() -> None:
    assert replace(SELF, started="1").is_alive() is False
    assert replace(SELF, started="").is_alive() is False


def test_killed_process_is_dead_before_it_is_reaped() -> None:
    program = "from experiment.session.heartbeat import *\nprint(Process.own().started, flush=True)\ninput()"
    other = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with other:
        assert other.stdout is not None
        process = replace(SELF, pid=other.pid, started=other.stdout.readline().strip())
        assert process.is_alive() is True
        other.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
        assert process.is_alive() is False, "killed, and not reaped yet"
    assert process.is_alive() is False


def test_uses_ps_without_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on macOS: ps(1) reports the start of a process."""

    def no_file(path: Path, **_: object) -> str:
        raise FileNotFoundError(2, "No such file or directory", str(path))

    at_ten = "Mon Jan  1 10:00:00 2026"
    processes = {os.getpid(): f"S {at_ten}", 1: "S Mon Jan  1 09:00:00 2026", 5: f"Z {at_ten}"}

    def absent(_: Path) -> bool:
        return False

    def run(arguments: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        text = processes.get(int(arguments[-1]), "")
        return subprocess.CompletedProcess(arguments, 0 if text else 1, f"{text}\n", "")

    monkeypatch.setattr(Path, "read_text", no_file)
    monkeypatch.setattr(Path, "exists", absent)
    monkeypatch.setattr(subprocess, "run", run)
    own = Process.own()
    assert (own.started, own.boot) == ("Mon Jan 1 10:00:00 2026", "Mon Jan 1 09:00:00 2026")
    assert own.is_alive() is True
    assert replace(own, pid=4).is_alive() is False
    assert replace(own, pid=5).is_alive() is False


def test_dead_process_ends_the_run_at_once() -> None:
    assert beat(until_s=3600).is_dead(NOW, alive=False)
    assert not beat(until_s=-3600).is_dead(NOW, alive=True), "a process that is there is waited for"


def test_journal_keeps_the_newest_sign_of_life(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    Journal.create(path, [])
    with closing(Journal.open_for_run(path)) as journal:
        assert journal.heartbeat() is None
        for state in ("running", "paused"):
            journal.beat(state, f"it is {state}", NOW)
    with closing(Journal.open(path)) as journal:
        sign = journal.heartbeat()
    assert sign is not None
    assert (sign.state, sign.sentence, sign.until, sign.process) == ("paused", "it is paused", NOW, SELF)
    assert abs(sign.at - datetime.now(UTC)) < timedelta(minutes=5)


class TestPlace:
    """Identity of the folder of a sign of life; a copy has the same sign."""

    @pytest.fixture
    def run(self) -> Iterator[Path]:
        """Return the folder of a session in which a run reports that it takes frames, and stays open.

        It is on the disk for temporary files, whose file system usually distinguishes folders with reused numbers. One
        in memory does not.
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
            sign = journal.heartbeat()
            assert journal.records() == {}, "the place is no device"
        assert sign is not None
        assert here is not None
        return sign, here

    def test_renamed_folder_is_the_same(self, run: Path) -> None:
        sign, here = self.of(run)
        assert sign.belongs_to(here) is True
        sign, here = self.of(run.rename(run.with_name("moved")))
        assert sign.belongs_to(here) is True

    def test_copy_and_restored_backup_differ(self, run: Path) -> None:
        backup = run.with_name("backup")
        shutil.copytree(run, backup)
        sign, here = self.of(backup)
        assert sign.belongs_to(here) is False
        shutil.rmtree(run)
        shutil.copytree(backup, run)
        sign, here = self.of(run)
        if here.generation:  # Else numbers may be reused, and nothing distinguishes the folders.
            assert sign.belongs_to(here) is False

    def test_restored_journal_has_another_number(self, run: Path) -> None:
        _, earlier = self.of(run)
        shutil.copy(run / "journal.sqlite", run / "copy")
        (run / "copy").replace(run / "journal.sqlite")
        _, here = self.of(run)
        assert here.inode == earlier.inode
        assert here.journal != earlier.journal

    def test_generation_distinguishes_reused_numbers(self, run: Path) -> None:
        sign, here = self.of(run)
        other_generation = replace(sign, place=replace(here, generation=7))
        assert other_generation.belongs_to(replace(here, generation=8)) is False
        assert other_generation.belongs_to(replace(here, generation=0)) is True, "over NFS it is not told"

    def test_snapshot_has_another_device(self, run: Path) -> None:
        sign, here = self.of(run)
        assert sign.belongs_to(replace(here, device=here.device + 1)) is False

    def test_nfs_shows_the_numbers_of_the_server(self, run: Path) -> None:
        sign, here = self.of(run)
        elsewhere = replace(sign, process=replace(SELF, host="another"))
        assert elsewhere.belongs_to(replace(here, device=here.device + 1, folder="/mnt/night")) is True
        assert elsewhere.belongs_to(replace(here, inode=here.inode + 1)) is False

    def test_device_may_change_with_a_boot(self, run: Path) -> None:
        sign, here = self.of(run)
        earlier = replace(sign, process=replace(SELF, boot="the one before"))
        assert earlier.belongs_to(replace(here, device=here.device + 1)) is True

    @pytest.mark.parametrize("kind", ["fuse.sshfs", "cifs", "virtiofs"])
    def test_ignores_invented_numbers(self, run: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
        sign, here = self.of(run)
        monkeypatch.setattr(heartbeat, "file_system_of", lambda path: kind)  # pyrefly: ignore[implicit-any-lambda]
        mounted = SessionPlace.of(run / "journal.sqlite")
        assert mounted is not None
        assert mounted.folder == here.folder
        assert sign.belongs_to(mounted) is None

    def test_ignores_older_and_damaged_signs(self, run: Path) -> None:
        sign, here = self.of(run)
        assert replace(sign, place=None).belongs_to(here) is None
        assert sign.belongs_to(None) is None
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


def test_frame_is_a_sign_of_life(tmp_path: Path) -> None:
    Journal.create(tmp_path / "journal.sqlite", ())
    with closing(Journal.open_for_run(tmp_path / "journal.sqlite")) as journal:
        journal.beat("running", "frames are taken", NOW)
        first = journal.heartbeat()
        journal.note(NOW, "refused", "a frame")
        second = journal.heartbeat()
        assert first is not None
        assert second is not None
        assert second.at > first.at
        assert replace(second, at=first.at) == first
        journal.beat("ended", "", NOW)
        last = journal.heartbeat()
        journal.note(NOW, "complete", "what is written behind the end is none")
        assert journal.heartbeat() == last
