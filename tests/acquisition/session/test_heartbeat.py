"""Signs of life: whose they are, and when a run is given up."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest

from acquisition.session import heartbeat
from acquisition.session.heartbeat import Heartbeat, Process, signs_of_life
from acquisition.session.journal import Journal
from foundation.errors import DeviceError, StorageError

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
    program = "from acquisition.session.heartbeat import *\nprint(Process.own().started, flush=True)\ninput()"
    other = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with other:
        assert other.stdout is not None
        process = replace(SELF, pid=other.pid, started=other.stdout.readline().strip())
        assert process.is_alive() is True
        other.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
        assert process.is_alive() is False, "killed, and its parent has not looked yet"
    assert process.is_alive() is False


@pytest.mark.parametrize("elsewhere", [replace(SELF, host="another"), replace(SELF, boot="x"), replace(SELF, boot="")])
def test_what_runs_elsewhere_cannot_be_told(elsewhere: Process) -> None:
    assert elsewhere.is_alive() is None


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


def test_elsewhere_it_is_dead_half_a_minute_after_its_next_sign_was_due() -> None:
    assert not beat(until_s=10).is_dead(NOW + timedelta(seconds=39), alive=None)
    assert beat(until_s=10).is_dead(NOW + timedelta(seconds=41), alive=None)


def test_a_run_that_has_ended_is_never_dead() -> None:
    assert not beat("ended", until_s=-3600).is_dead(NOW, alive=False)


def test_what_a_reader_is_told() -> None:
    assert beat().sentence_for(NOW, alive=True) == "taking 8 frames"
    local = NOW.astimezone().strftime("%Y-%m-%d %H:%M:%S")
    told = beat().sentence_for(NOW, alive=False)
    assert told == f"stopped at {local}, killed or power lost: run the same command again"


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


class TestSignsOfLife:
    @staticmethod
    def told(block: Callable[[Callable[[], None]], None]) -> list[tuple[str, str]]:
        said: list[tuple[str, str]] = []
        signs = signs_of_life(lambda state, sentence, until: said.append((state, sentence)), lambda: None, 60.0)
        with contextlib.suppress(BaseException), signs as alive:
            block(alive)
        return said

    def test_a_run_that_comes_to_its_end_gives_no_cause(self) -> None:
        assert self.told(lambda alive: alive()) == [("running", "frames are taken"), ("ended", "")]

    def test_what_ended_it_is_told(self) -> None:
        def interrupted(alive: Callable[[], None]) -> None:
            raise KeyboardInterrupt

        def unplugged(alive: Callable[[], None]) -> None:
            raise DeviceError("the camera is gone; find it")

        def mistaken(alive: Callable[[], None]) -> None:
            raise ZeroDivisionError

        assert self.told(interrupted)[-1] == ("ended", "interrupted; run the same command again")
        assert self.told(unplugged)[-1] == ("ended", "the camera is gone; find it")
        assert self.told(mistaken)[-1][0] == "ended"
        assert "mistake of the program" in self.told(mistaken)[-1][1]

    def test_a_frame_a_second_is_no_write_a_second(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seconds = itertools.count()
        clock = SimpleNamespace(monotonic=lambda: float(next(seconds)))
        monkeypatch.setattr(heartbeat, "time", clock)

        def twelve_frames(alive: Callable[[], None]) -> None:
            for _ in range(12):
                alive()

        assert len(self.told(twelve_frames)) < 8

    def test_after_a_wait_the_first_frame_says_that_it_is_over(self, tmp_path: Path) -> None:
        Journal.create(tmp_path / "journal.sqlite", ())
        with closing(Journal.open_for_run(tmp_path / "journal.sqlite")) as journal:
            with signs_of_life(journal.beat, journal.heartbeat, 60.0) as alive:
                journal.beat("waiting", "the lamp warms up", NOW)
                alive()
                told = journal.heartbeat()
                assert told is not None
                assert told.state == "running"
            told = journal.heartbeat()
            assert told is not None
            assert told.state == "ended"

    def test_a_full_disk_does_not_end_the_run(self) -> None:
        def full(state: str, sentence: str, until: datetime) -> None:
            raise StorageError("no space")

        with signs_of_life(full, lambda: None, 60.0) as alive:
            alive()
